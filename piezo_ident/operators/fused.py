# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""
H, G and z^-d in one kernel, where nothing stands between them.

    x --> [ H ] --w--> [ G ] --y--> [ z^-d ] -->

A short stretch of the stream passes all three while it is in the cache.  The parts are those of
the single operators, so the numbers are theirs too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.operators.chain import Block, Chain, Operator
from piezo_ident.operators.dynamics import DelayOperator, DynamicsOperator
from piezo_ident.operators.hysteresis import HysteresisOperator
from piezo_ident.operators.kernels import advance, coefficients

__all__ = ['FusedOperator', 'fused']

#: samples that pass all three at once
STRETCH = 512
#: samples of a frozen array that are copied at once
COPIED = 8192


class FusedOperator:
    """
    H, G and z^-d, or the last two alone, as one link of the chain.

    Parameters
    ----------
    hysteresis : HysteresisOperator or None
        None where w arrives as it is.
    dynamics : DynamicsOperator
    delay : DelayOperator
    scale : tuple of float, optional
        (v0, V, y0, Y): takes v as (v - v0)/V, returns y as y0 + Y y.
    """

    def __init__(
        self,
        hysteresis: HysteresisOperator | None,
        dynamics: DynamicsOperator,
        delay: DelayOperator,
        scale: tuple[float, float, float, float] = (0.0, 1.0, 0.0, 1.0),
    ) -> None:
        self._links = hysteresis, dynamics, delay
        h = None if hysteresis is None else hysteresis.hysteresis
        none = np.empty(0)
        # without H, 0 v^3 + 1 v is v itself
        r, q = (none, none) if h is None else (h.thresholds, h.weights)
        p1, p2 = (0.0, 1.0) if h is None else (h.p1, h.p2)
        G, z = dynamics.dynamics, delay.delay
        b, a = coefficients(G.b, G.a)
        self._fixed = np.concatenate([scale, [p1, p2, z.fraction], r, q, b, a])
        past_w, past_y = b.size - 1, max(G.a.size, z.samples + 1)
        self._sizes = np.array([r.size, b.size, G.a.size, z.samples, past_w, past_y, 0])
        # a long delay would else spend its time on moving its past
        room = max(STRETCH, past_y)
        self._memory = np.empty(0) if hysteresis is None else hysteresis.memory.copy()
        self._w, self._y = np.zeros(past_w + room), np.zeros(past_y + room)

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest; the signal comes and goes normalised, whatever the scale."""
        hysteresis, dynamics, delay = self._links
        past_w, past_y = self._sizes[4:6]
        if hysteresis is not None:
            x0 = hysteresis.reset(v0, x0)
            self._memory[:] = hysteresis.memory
        self._w[:past_w] = x0
        x0 = dynamics.reset(v0, x0)
        self._y[:past_y] = x0
        self._sizes[6] = 0
        return delay.reset(v0, x0)

    def process(self, block: Block) -> Block:
        """Return the block with all of them applied."""
        return block.with_signal(self.run(block.x))

    def scaled(self, v0: float, V: float, y0: float, Y: float) -> FusedOperator:
        """Return a fresh operator that takes v as (v - v0)/V and returns y as y0 + Y y."""
        return FusedOperator(*self._links, (v0, V, y0, Y))

    def run(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the next stretch of the signal, scaled as the operator was told; shape (n,)."""
        out = np.empty(x.size)
        state = (self._fixed, self._sizes, self._memory, self._w, self._y)
        if x.flags.carray:
            advance(x, *state, out)
            return out
        # a frozen array would be another type to the compiler, and be compiled for
        for start in range(0, x.size, COPIED):
            cut = slice(start, start + COPIED)
            advance(np.array(x[cut]), *state, out[cut])
        return out


def fused(chain: Chain) -> Chain:
    """Return a chain of fresh operators with its neighbours (H,) G and z^-d made one."""
    operators: list[Operator] = []
    for operator in chain.operators:
        operators.append(operator)
        match operators:
            case [
                *before,
                HysteresisOperator() as h,
                DynamicsOperator() as g,
                DelayOperator() as z,
            ]:
                operators = [*before, FusedOperator(h, g, z)]
            case [*before, DynamicsOperator() as g, DelayOperator() as z]:
                operators = [*before, FusedOperator(None, g, z)]
    return Chain(tuple(operators))

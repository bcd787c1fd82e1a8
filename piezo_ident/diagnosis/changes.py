# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What the links behind H make of a small change of their signal.

Most are linear, or only add something: a change passes them without the signal itself, and many
columns of a fit pass without a run of the whole chain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.kernel import alive, kernel
from piezo_ident.operators.chain import Block, Operator
from piezo_ident.residual.stretches import block_means

__all__ = ['Behind']

Array = NDArray[np.float64]

#: samples that pass all links while they are in the cache, about
STRETCH = 1 << 15
#: filters that run side by side in vector lanes
LANES = 16


class Behind:
    """
    The links of a run behind a place in its chain, and the signal that passes them unchanged.

    Parameters
    ----------
    operators : sequence of Operator
    rests : sequence of float
        The signal at rest before each link, and behind the last.
    blocks : sequence of Block
        The same of the whole run; of links that are all linear the first is enough.
    m : int
        Samples in a row.
    new : bool, optional
        Whether the first link has changed since.
    """

    def __init__(
        self,
        operators: Sequence[Operator],
        rests: Sequence[float],
        blocks: Sequence[Block],
        m: int,
        *,
        new: bool = False,
    ) -> None:
        self._rests, self._blocks, self._m, self._new = rests, blocks, m, new
        self._n = n = blocks[0].x.size // m * m
        step = max(1, STRETCH // m) * m
        self._cuts = [slice(a, min(a + step, n)) for a in range(0, n, step)]
        kinds = [getattr(operator, 'change', 'bent') for operator in operators]
        if new:
            kinds[0] = 'bent'
        #: whether all links are filters, which may trade places
        self.is_filter = {'passed', 'filtered'} >= set(kinds)
        self._links = [
            (k, operator, kind != 'bent')
            for k, (operator, kind) in enumerate(zip(operators, kinds, strict=True))
            if kind != 'passed'
        ]

    def rows(self, change: Array | None = None, rest: float = 0.0) -> Array:
        """
        Return by how much the rows change with the incoming signal.

        Parameters
        ----------
        change : ndarray, shape (n,), optional
            None where only the first link has changed.
        rest : float
            Change of the signal at rest, before the first sample.

        Returns
        -------
        ndarray, shape (n // m,)
        """
        v0 = float(self._blocks[0].v[0])
        for k, operator, is_linear in self._links:
            if is_linear:
                rest = operator.reset(0.0, rest)
            else:
                rest = operator.reset(v0, self._rests[k] + rest) - self._rests[k + 1]
        means = [
            block_means(self._passed(cut, None if change is None else change[cut]), self._m)
            for cut in self._cuts
        ]
        return np.concatenate(means) if means else np.empty(0)

    def filtered(self, sections: Array) -> Array:
        """
        Return what filters before the first link make, of the signal itself.

        Where all links are filters, these may as well run behind the last one, all in one pass.

        Parameters
        ----------
        sections : ndarray, shape (k, 5)
            b_0, b_1, b_2, a_1 and a_2 of each, as of `piezo_ident.operators.dynamics.Dynamics`.

        Returns
        -------
        ndarray, shape (k, n // m)
        """
        c = np.zeros((5, len(sections) + -len(sections) % LANES))
        c[:, : len(sections)] = sections.T
        rest = self._rests[0]
        for _, operator, _ in self._links:
            rest = operator.reset(0.0, rest)
        b0, b1, b2, a1, a2 = c
        gain = (b0 + b1 + b2) / (1.0 + a1 + a2)
        state = rest * np.array([gain - b0, b2 - a2 * gain])
        out = np.empty((self._n // self._m, c.shape[1]))
        for cut in self._cuts:
            x = self._passed(cut, self._blocks[0].x[cut])
            _filter_means(x, c, state, self._m, out[cut.start // self._m : cut.stop // self._m])
        return out.T[: len(sections)].copy()

    def _passed(self, cut: slice, change: Array | None) -> Array:
        """Return what a stretch becomes; they come one after the other."""
        whole = self._blocks[0]
        channels = {name: x[cut] for name, x in whole.channels.items()}
        block = Block(t=whole.t[cut], v=whole.v[cut], x=whole.x[cut], channels=channels)
        if change is not None:
            block = block.with_signal(change)
        for k, operator, is_linear in self._links:
            if not is_linear:
                x = self._blocks[k].x[cut]
                block = operator.process(block.with_signal(x if change is None else x + block.x))
                block = block.with_signal(block.x - self._blocks[k + 1].x[cut])
                change = block.x
            else:
                block = operator.process(block)
        return block.x


@kernel
def _filter_means(x: Array, c: Array, state: Array, m: int, out: Array) -> None:
    # rows of c: b_0, b_1, b_2, a_1 and a_2; state: two numbers of the transposed direct form
    for row in range(out.shape[0]):
        total = out[row]
        total[:] = 0.0
        for k in range(row * m, row * m + m):
            v = x[k]
            for i in range(c.shape[1]):
                y = c[0, i] * v + state[0, i]
                state[0, i] = c[1, i] * v - c[3, i] * y + state[1, i]
                state[1, i] = c[2, i] * v - c[4, i] * y
                total[i] += y / m
    for i in range(c.shape[1]):
        state[0, i], state[1, i] = alive(state[0, i]), alive(state[1, i])

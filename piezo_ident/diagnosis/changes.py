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
from piezo_ident.operators.chain import Block, Operator
from piezo_ident.residual.stretches import block_means

__all__ = ['Behind']

Array = NDArray[np.float64]

#: samples that pass all links while they are in the cache, about
STRETCH = 1 << 15


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
        n = blocks[0].x.size // m * m
        step = max(1, STRETCH // m) * m
        self._cuts = [slice(a, min(a + step, n)) for a in range(0, n, step)]
        kinds = [getattr(operator, 'change', 'bent') for operator in operators]
        if new:
            kinds[0] = 'bent'
        self._links = [
            (k, operator, kind == 'linear')
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

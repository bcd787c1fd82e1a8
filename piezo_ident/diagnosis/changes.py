# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Pass a small change of a signal through the links of the chain behind H.

Most links are linear, or only add to the signal.  Such a link passes a change without the signal
itself.  Many columns of a fit therefore pass the links without a run of the whole chain.
"""

from __future__ import annotations

from collections.abc import Sequence
import copy
from functools import cached_property
from typing import cast, NamedTuple

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import alive, kernel
from piezo_ident.diagnosis.row_filter import group_of, RowFilter, serves
from piezo_ident.effects import Effect
from piezo_ident.operators.chain import Block, Operator
from piezo_ident.operators.dynamics import DelayOperator, Dynamics, DynamicsOperator
from piezo_ident.residual.stretches import block_means

#: approximate number of samples that pass all links together, so that they stay in the cache
STRETCH = 1 << 14
#: number of filters that run side by side in vector lanes
LANES = 16


class _Link(NamedTuple):
    """Link that alters changes, and its place."""

    place: int
    operator: Operator
    kind: str

    @property
    def has_slope(self) -> bool:
        """Whether the link multiplies a change by a factor at each sample."""
        return self.kind in ('curved', 'scaled')


class Behind:
    """
    Links of a run behind a place in its chain, with the unchanged signal at each link.

    Parameters
    ----------
    operators : sequence of Operator
    rests : sequence of float
        The signal at rest before each link, and behind the last.
    blocks : sequence of Block
        The signal of the whole run at the same places.  The first block is enough if all links are
        linear.
    m : int
        Samples in a row.
    new : bool, optional
        Whether the first link has changed since the blocks were kept.
    small : bool, optional
        Whether changes are so small that the slope of a curve describes its effect on them.
    """

    def __init__(
        self,
        operators: Sequence[Operator],
        rests: Sequence[float],
        blocks: Sequence[Block],
        m: int,
        *,
        new: bool = False,
        small: bool = False,
    ) -> None:
        self._rests, self._blocks, self._m = rests, blocks, m
        self._n = n = blocks[0].x.size // m * m
        group = group_of(m) * m
        step = max(1, STRETCH // group) * group
        self._cuts = [slice(a, min(a + step, n)) for a in range(0, n, step)]
        kinds = [getattr(operator, 'change', 'bent') for operator in operators]
        if not small:
            kinds = ['bent' if kind == 'curved' else kind for kind in kinds]
        if new:
            kinds[0] = 'bent'
        self._links = [
            _Link(k, operator, kind)
            for k, (operator, kind) in enumerate(zip(operators, kinds, strict=True))
            if kind != 'passed'
        ]

    @property
    def bends(self) -> bool:
        """Whether the response to a change is not proportional to the change."""
        return any(link.kind == 'bent' for link in self._links)

    def rows(self, change: Array | None = None, rest: float = 0.0) -> Array:
        """
        Compute the change of the rows from a change of the incoming signal; shape (n // m,).

        The change, shape (n,), is None if only the first link has changed.  `rest` is the change
        at rest, before the first sample.
        """
        m, (links, G, slopes) = self._m, self._to_rows
        rest = self._reset(links, rest)
        if G is not None:
            G.reset(rest)
        means = []
        for cut in self._cuts:
            passed = self._passed(links, cut, None if change is None else change[cut])
            means.append(block_means(passed, m) if G is None else G.process(passed))
        return slopes * np.concatenate(means) if means else np.empty(0)

    def filtered(self, sections: Array, signal: Array, rest: float) -> Array:
        """
        Compute the change of the rows if filtered copies of a signal are added in front.

        Linear filters commute, so these filters run side by side, behind the first links that
        filter.  `sections`, shape (k, 5), holds b_0, b_1, b_2, a_1 and a_2 of each filter, as in
        `piezo_ident.operators.dynamics.Dynamics`.  `rest` is the value of the signal, shape (n,),
        at rest.  The result has shape (k, n // m).
        """
        count = len(sections)
        c = np.zeros((5, count + -count % LANES))
        c[:, :count] = sections.T
        first = [link.kind == 'filtered' for link in self._links]
        at = first.index(False) if False in first else len(first)
        before, tail = self._links[:at], self._links[at:]
        slopes: Array | float = 1.0
        if all(link.has_slope for link in tail):
            tail, slopes = [], self._slopes(tail)
        rest = self._reset(before, rest)
        b0, b1, b2, a1, a2 = c
        gain = (b0 + b1 + b2) / (1.0 + a1 + a2)
        state = rest * np.array([gain - b0, b2 - a2 * gain])
        tails = [copy.deepcopy(tail) for _ in range(count if tail else 0)]
        for links, g in zip(tails, gain, strict=False):
            self._reset(links, rest * float(g))
        m = 1 if tail else self._m
        rows = np.empty((count, self._n // self._m))
        for cut in self._cuts:
            x = self._passed(before, cut, signal[cut])
            out = np.empty((count, x.size // m))
            _filter_means(x, c, state, m, out)
            row = slice(cut.start // self._m, cut.stop // self._m)
            if not tail:
                rows[:, row] = out
            for i, links in enumerate(tails):
                change = self._passed(links, cut, out[i])
                rows[i, row] = block_means(change, self._m)
        return rows * slopes

    @cached_property
    def _to_rows(self) -> tuple[Sequence[_Link], RowFilter | None, Array | float]:
        """
        Links that compute samples, a filter that computes rows, and factors of these rows.

        Linear filters commute: the filters among the last links are reordered, so that G, creep
        and a short delay come last and compute rows only.
        """
        links, end = self._links, len(self._links)
        while end > 0 and links[end - 1].has_slope:
            end -= 1
        last = end
        while last > 0 and links[last - 1].kind == 'filtered':
            last -= 1
        own = [(link, _filter_of(link.operator)) for link in links[last:end]]
        parts = [part for _, part in own if part is not None]
        if not serves(parts, self._m, self._n):
            return links, None, 1.0
        others = []
        for link, part in own:
            if part is None and not _takes_delay(parts, link.operator):
                others.append(link)
        return [*links[:last], *others], RowFilter(parts, self._m), self._slopes(links[end:])

    def _slopes(self, links: Sequence[_Link]) -> Array | float:
        """Compute the slope of links without memory in each row; it varies little within a row."""
        product: Array | float = 1.0
        for k, operator, _ in links:
            slope = self._slope(k, operator, slice(self._n))
            product = product * block_means(slope, self._m)
        return product

    def _slope(
        self, place: int, operator: Operator, cut: slice, signal: float | None = None
    ) -> Array:
        """Compute the slope of a link in a stretch, at its own signal or at a constant signal."""
        x = self._blocks[place].x[cut]
        if signal is not None:
            x = np.full(x.size, signal)
        return cast(Effect, operator).slope(self._cut(cut).with_signal(x))

    def _cut(self, cut: slice) -> Block:
        """Return a stretch of the whole run."""
        whole = self._blocks[0]
        channels = {name: x[cut] for name, x in whole.channels.items()}
        return Block(t=whole.t[cut], v=whole.v[cut], x=whole.x[cut], channels=channels)

    def _reset(self, links: Sequence[_Link], rest: float) -> float:
        """Bring links to rest; convert the change `rest` before them to the change behind them."""
        v0 = float(self._blocks[0].v[0])
        for k, operator, kind in links:
            if kind == 'curved':
                rest *= float(self._slope(k, operator, slice(1), self._rests[k])[0])
            elif kind != 'bent':
                rest = operator.reset(0.0, rest)
            else:
                rest = operator.reset(v0, self._rests[k] + rest) - self._rests[k + 1]
        return rest

    def _passed(self, links: Sequence[_Link], cut: slice, change: Array | None) -> Array:
        """Pass a change through links over a stretch; stretches must come in order."""
        block = self._cut(cut)
        if change is not None:
            block = block.with_signal(change)
        for link in links:
            k, operator, kind = link
            if link.has_slope:
                block = block.with_signal(block.x * self._slope(k, operator, cut))
                continue
            if kind != 'bent':
                block = operator.process(block)
                continue
            x = self._blocks[k].x[cut]
            block = operator.process(block.with_signal(x if change is None else x + block.x))
            change = block.x - self._blocks[k + 1].x[cut]
            block = block.with_signal(change)
        return block.x


def _filter_of(operator: Operator) -> Dynamics | Array | None:
    """Return G, or the filters whose outputs a link adds to its signal; None for another link."""
    if isinstance(operator, DynamicsOperator):
        return operator.dynamics
    if not isinstance(operator, Effect) or operator.change != 'filtered':
        return None
    found = []
    for p in operator.parameters:
        for i, share in enumerate(operator.array(p.name) if p.vector else ()):
            section = operator.section(operator.sample_rate, operator.values, p.name, i)
            if section is not None:
                found.append(section * np.array([share, share, share, 1.0, 1.0]))
    return np.array(found) if found else None


def _takes_delay(parts: list[Dynamics | Array], operator: Operator) -> bool:
    """Merge a delay into a filter with enough states, and return whether that was possible."""
    if not isinstance(operator, DelayOperator):
        return False
    share = operator.delay.fraction
    late = [1.0 - share, share] if share else [1.0]
    more = operator.delay.samples + len(late) - 1
    for i, G in enumerate(parts):
        if isinstance(G, Dynamics) and G.sections is None and G.b.size + more <= G.a.size + 1:
            b = np.convolve(G.b, [*np.zeros(operator.delay.samples), *late])
            parts[i] = Dynamics(G.a, b)
            return True
    return False


@kernel
def _filter_means(x: Array, c: Array, state: Array, m: int, out: Array) -> None:
    # rows of c: b_0, b_1, b_2, a_1 and a_2; state: both numbers of the transposed direct form
    total = np.empty(c.shape[1])
    for row in range(out.shape[1]):
        total[:] = 0.0
        for k in range(row * m, row * m + m):
            v = x[k]
            for i in range(c.shape[1]):
                y = c[0, i] * v + state[0, i]
                state[0, i] = c[1, i] * v - c[3, i] * y + state[1, i]
                state[1, i] = c[2, i] * v - c[4, i] * y
                total[i] += y / m
        for i in range(out.shape[0]):
            out[i, row] = total[i]
    for i in range(c.shape[1]):
        state[0, i], state[1, i] = alive(state[0, i]), alive(state[1, i])

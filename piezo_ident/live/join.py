# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Join the streams of several axes: a block of the first axis waits for the other axes.

`Join` joins any streams of samples, and `Reference` the reference of a stage.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array, line_between
from piezo_ident.live.sample_clock import Kind, Verdict
from piezo_ident.record.blocks import Samples, SHORTEST

#: most samples that are kept
MOST = 1_000_000
#: time after a block in which its axis is not silent [s] (taste).  The first block of a publisher
#: may come before the middleware lists the publisher.
HEARD = 1.0


def held(x: Array, before: float) -> Array:
    """
    Replace each NaN or infinite sample by the last finite sample.

    `before` is the sample before the block; NaN stands for the first finite sample of the block.

    >>> held(np.array([np.nan, 1.0, np.inf]), 3.0).tolist()
    [3.0, 1.0, 1.0]
    >>> held(np.array([np.nan, 1.0, np.inf]), np.nan).tolist()
    [1.0, 1.0, 1.0]
    """
    good = np.isfinite(x)
    if good.all():
        return x
    if good.any() and not math.isfinite(before):
        before = float(x[np.argmax(good)])
    last = np.where(good, np.arange(1, x.size + 1), 0)
    return np.append(before, x)[np.maximum.accumulate(last)]


class Join:
    """
    Blocks of the first axis, which wait for the samples of the other axes at the same times.

    Parameters
    ----------
    tails : sequence of str
        Ends of the topics of the further axes, such as ``_b``.
    sample_rate : float, optional
        Rate of the clock of the stream, or a higher rate [Hz].
    rest : sequence of float, optional
        Values of the further axes before their first sample.  Default: zero.

    Examples
    --------
    >>> join, t = Join(['_b']), np.array([0.0, 0.1])
    >>> join.add('', Samples(t, np.array([1.0, 2.0])), since=0.0)
    >>> [*join.complete(is_over=lambda since: False)]
    []
    >>> join.add('_b', Samples(t, np.array([3.0, 4.0])), since=0.0)
    >>> ((samples, *_),) = join.complete(is_over=lambda since: False)
    >>> join.rows(samples)[0].values.tolist()
    [[1.0, 2.0], [3.0, 4.0]]
    """

    def __init__(
        self,
        tails: Sequence[str],
        sample_rate: float = 1.0 / SHORTEST,
        rest: Sequence[float] = (),
    ) -> None:
        self._rate = sample_rate
        # samples of each further axis by tick, and the tick of its newest sample
        self._kept, self._newest = {tail: dict[int, float]() for tail in tails}, dict[str, int]()
        self._last = {**dict.fromkeys(tails, 0.0), **dict(zip(tails, rest, strict=False))}
        self._heard = dict.fromkeys(tails, -math.inf)
        # blocks, each with a note of the caller and its arrival
        self._waiting: deque[tuple[Samples, Any, float]] = deque()

    def add(self, tail: str, samples: Samples, since: float, note: Any = None) -> None:
        """Take a block of an axis, which came at a time `since` [s]; '' is the first axis."""
        if not tail:
            self._waiting.append((samples, note, since))
            return
        kept, ticks = self._kept[tail], self._ticks(samples.t)
        # a block whose time jumps back begins a new stream
        if ticks[0] <= self._newest.get(tail, -1) or len(kept) > MOST:
            kept.clear()
        kept.update(zip(ticks, samples.values.tolist(), strict=True))
        self._newest[tail], self._heard[tail] = ticks[-1], since

    def _ticks(self, t: NDArray[np.float64]) -> list[int]:
        ticks: list[int] = np.rint(t * self._rate).astype(np.int64).tolist()
        return ticks

    def complete(
        self, is_over: Callable[[float], bool], silent: Collection[str] = ()
    ) -> Iterator[tuple[Samples, Any, Collection[str]]]:
        """
        Yield the blocks of the first axis whose partners have come, with note and silent axes.

        `is_over` says whether a block that came at a time [s] has waited long enough.  The topic
        of a `silent` axis lacks a publisher.  A block waits for this axis only within `HEARD`
        after the last block of the axis.
        """
        while self._waiting:
            samples, note, since = self._waiting[0]
            quiet = {tail for tail in silent if since - self._heard[tail] > HEARD}
            lacking = any(
                tail not in quiet and not kept.keys() >= {*self._ticks(samples.t)}
                for tail, kept in self._kept.items()
            )
            if lacking and not is_over(since):
                return
            self._waiting.popleft()
            yield samples, note, quiet

    def take(self, tail: str, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Remove and return the samples of a further axis; NaN stands for a missing sample."""
        return np.array([self._kept[tail].pop(tick, np.nan) for tick in self._ticks(t)])

    def rows(self, samples: Samples) -> tuple[Samples, dict[str, int]]:
        """
        Add a row for each further axis to a block; without further axes return the block.

        The last sample of an axis replaces its missing samples.  The mapping counts the missing
        samples by axis.
        """
        rows, missing = [samples.values], {}
        for tail in self._kept:
            x = self.take(tail, samples.t)
            if n := int(np.count_nonzero(~np.isfinite(x))):
                missing[tail] = n
                x = held(x, self._last[tail])
            self._last[tail] = float(x[-1])
            rows.append(x)
        return (replace(samples, values=np.stack(rows)) if rows[1:] else samples), missing

    def clear(self) -> None:
        """Forget the further axes: the stream has ended."""
        for kept in self._kept.values():
            kept.clear()
        self._newest.clear()


class Reference:
    """
    Reference of all axes, as one stream.

    `tails` are the suffixes of the topics of all axes, the first one empty.  `join` holds the
    waiting blocks, and `length` is the number of samples of the last stream.
    """

    def __init__(self, tails: Sequence[str], sample_rate: float) -> None:
        self._tails, self._rate = tails, sample_rate
        self._kept: list[Array] = []
        self.length = 0
        self.reset()

    def reset(self, rest: Sequence[float] = ()) -> None:
        """Begin at `rest`, the displacements of the further axes [m]; keep the last stream."""
        self.join = Join(self._tails[1:], self._rate, rest)
        # labels, each with its first sample
        self._labels: deque[tuple[int, str]] = deque()
        self._heard = 0
        self._last = np.full(len(self._tails), math.nan)

    def take(
        self, samples: Samples, verdict: Verdict, resting: Collection[str], longest: float
    ) -> tuple[Array, list[tuple[str, str, int]]]:
        """
        Complete the next block of the first axis; return it with its faults.

        The `verdict` is the clock's verdict on this block.  The `resting` axes have no reference.
        The stream is kept up to the length `longest` [s].

        Returns
        -------
        x : ndarray, shape (k, n)
            The reference [m], with the samples of a gap before the block.
        faults : list
            Kind, text and number of samples of each fault.
        """
        rows, missing = self.join.rows(samples)
        faults = [
            ('not_finite', f'{n} samples of reference{tail} are missing: the last is repeated', n)
            for tail, n in missing.items()
            if tail not in resting
        ]
        if verdict.kind is Kind.START:
            # nothing comes before the first sample of a stream
            self._last[:] = math.nan
            self._kept, self.length = [], 0
        if bad := samples.not_finite:
            about = 'samples of the reference are no numbers: the last one stays in force'
            faults.append(('not_finite', f'{bad} {about}', bad))
        if verdict.kind is Kind.GAP:
            faults.append(('lost', verdict.reason, verdict.missing))
        parts = []
        for row, before in zip(np.atleast_2d(rows.values), self._last.tolist(), strict=True):
            x = held(row, before)
            if verdict.kind is Kind.GAP:
                x = np.append(line_between(before, float(x[0]), verdict.missing), x)
            parts.append(x)
        if not self._labels or self._labels[-1][1] != samples.segment:
            self._labels.append((self._heard, samples.segment))
        x = np.stack(parts)
        self._last, n = x[:, -1].copy(), x.shape[1]
        self._heard, self.length = self._heard + n, self.length + n
        if self.length <= longest * self._rate and np.isfinite(self._last).all():
            self._kept.append(x)
        return x, faults

    def label(self, tick: int) -> str:
        """Return the label at a sample since `reset`; later calls ask for later samples."""
        labels = self._labels
        while len(labels) > 1 and labels[1][0] <= tick:
            labels.popleft()
        return labels[0][1]

    @property
    def kept(self) -> Array | None:
        """The last stream [m], shape (k, n), as far as it is kept; None without one."""
        return np.concatenate(self._kept, axis=1) if self._kept else None

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Join the streams of several axes: a block of the first axis waits for the other axes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.record.blocks import Samples, SHORTEST

#: most samples that are kept
MOST = 1_000_000
#: time for which an axis is not silent after a block of it [s]: the middleware may tell of a
#: publisher later than it brings its first block (taste)
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


class Companion:
    """
    Samples of one topic, by the tick of a clock of `sample_rate` [Hz].

    Examples
    --------
    >>> voltage = Companion(10.0)
    >>> voltage.add(Samples(np.array([0.0, 0.1]), np.array([5.0, 6.0])))
    >>> voltage.has(np.array([0.1, 0.2])), voltage.take(np.array([0.1, 0.2])).tolist()
    (False, [6.0, nan])
    """

    def __init__(self, sample_rate: float) -> None:
        self._rate = sample_rate
        self._kept: dict[int, float] = {}
        self._newest = -1

    def add(self, samples: Samples) -> None:
        """Keep a block; a block whose time jumps back begins a new stream."""
        ticks = self._ticks(samples.t)
        if ticks[0] <= self._newest or len(self._kept) > MOST:
            self._kept.clear()
        self._kept.update(zip(ticks, samples.values.tolist(), strict=True))
        self._newest = ticks[-1]

    def clear(self) -> None:
        """Forget all samples: the stream has ended."""
        self._kept.clear()
        self._newest = -1

    def has(self, t: NDArray[np.float64]) -> bool:
        """Return whether a sample is kept for each time, shape (n,) [s]."""
        return all(tick in self._kept for tick in self._ticks(t))

    def take(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Remove and return the samples at times t [s]; NaN stands for a missing sample."""
        return np.array([self._kept.pop(tick, np.nan) for tick in self._ticks(t)])

    def _ticks(self, t: NDArray[np.float64]) -> list[int]:
        ticks: list[int] = np.rint(t * self._rate).astype(np.int64).tolist()
        return ticks


class Join:
    """
    Blocks of the first axis, each of which waits for the other axes at the same times.

    The topics of the further axes end in `tails`, such as ``_b``.  Before their first sample these
    axes have the values `rest`, or zero.  The clock of the stream has the `sample_rate` [Hz] or a
    lower one.

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
        self._companions = {tail: Companion(sample_rate) for tail in tails}
        self._last = {**dict.fromkeys(tails, 0.0), **dict(zip(tails, rest, strict=False))}
        self._heard = dict.fromkeys(tails, -math.inf)
        # blocks, each with a note of the caller and its arrival
        self._waiting: deque[tuple[Samples, Any, float]] = deque()

    def add(self, tail: str, samples: Samples, since: float, note: Any = None) -> None:
        """Take a block of an axis, which came at a time `since` [s]; '' is the first axis."""
        if tail:
            self._companions[tail].add(samples)
            self._heard[tail] = since
        else:
            self._waiting.append((samples, note, since))

    def complete(
        self, is_over: Callable[[float], bool], silent: Collection[str] = ()
    ) -> Iterator[tuple[Samples, Any, Collection[str]]]:
        """
        Yield the blocks of the first axis whose partners have come, with note and silent axes.

        `is_over` says whether a block that came at a time [s] has waited long enough.  No block
        waits for a `silent` axis, whose topic no node publishes, unless it was heard lately.
        """
        while self._waiting:
            samples, note, since = self._waiting[0]
            quiet = {tail for tail in silent if since - self._heard[tail] > HEARD}
            lacking = any(
                tail not in quiet and not companion.has(samples.t)
                for tail, companion in self._companions.items()
            )
            if lacking and not is_over(since):
                return
            self._waiting.popleft()
            yield samples, note, quiet

    def take(self, tail: str, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Remove and return the samples of a further axis; NaN stands for a missing sample."""
        return self._companions[tail].take(t)

    def rows(self, samples: Samples) -> tuple[Samples, dict[str, int]]:
        """
        Add a row for each further axis to a block; without further axes return the block.

        The last sample of an axis replaces its missing samples.  The mapping counts the missing
        samples by axis.
        """
        rows, missing = [samples.values], {}
        for tail in self._companions:
            x = self.take(tail, samples.t)
            if n := int(np.count_nonzero(~np.isfinite(x))):
                missing[tail] = n
                x = held(x, self._last[tail])
            self._last[tail] = float(x[-1])
            rows.append(x)
        return (replace(samples, values=np.stack(rows)) if rows[1:] else samples), missing

    def clear(self) -> None:
        """Forget the further axes: the stream has ended."""
        for companion in self._companions.values():
            companion.clear()

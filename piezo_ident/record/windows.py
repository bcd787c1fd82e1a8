# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Streams of blocks cut into windows that can be joined and checked one by one.

A window ends before a stamp that every stream has, among sound and uniform neighbours, with all
earlier samples before it and all later ones behind it.  A run of the sample clock ends a window
as well: when every stream has started over from its beginning.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray
from piezo_ident.record.blocks import Samples
from piezo_ident.record.capture import APPLIED
from piezo_ident.record.long_record import NeedsWhole
from piezo_ident.record.stream import Stream

__all__ = ['windows']

#: samples on either side of the end of a window that must be sound, and ends that are tried
CLEAN, TRIES = 20, 64
#: windows that may have to be kept until an end is found
MOST = 4

Vector = NDArray[np.float64]


def windows(
    blocks: Iterable[tuple[str, Samples, int]],
    quantities: Collection[str],
    size: int,
    tolerance: float,
) -> Iterator[tuple[int, dict[str, Stream]]]:
    """
    Cut streams into windows.

    Parameters
    ----------
    blocks : iterable of (str, Samples, int)
        Quantity, samples and arrival [ns] of each block, in the order of arrival.
    quantities : collection of str
        Those that come; ``voltage`` leads, and ``applied_voltage`` may be absent at times.
    size : int
        Samples of a window; it may have up to twice as many, or more where no end is found.
    tolerance : float
        Difference of command and applied voltage that counts as none [V].

    Yields
    ------
    int
        Number of the run of the sample clock.
    dict of str to Stream
        One window.

    Raises
    ------
    NeedsWhole
        When no window ends within `MOST` sizes, or time goes back behind a window.
    """
    run, here, ahead = 0, _Run(quantities), _Run(quantities)
    target = 2 * size
    for quantity, samples, arrival in blocks:
        if not samples.t.size:
            continue
        if ahead.has(quantity) or here.starts_over(quantity, samples):
            ahead.append(quantity, samples, arrival)
            if all(map(ahead.has, quantities)):
                if here.rows:
                    yield run, here.taken(None)
                run, here, ahead = run + 1, ahead, _Run(quantities)
                target = 2 * size
            elif ahead.most > size:
                raise NeedsWhole('not every stream starts over')
            continue
        here.append(quantity, samples, arrival)
        if here.rows >= target and quantity == 'voltage':
            end = _end(here.columns(), size, tolerance)
            if end is None:
                target += size // 2
                continue
            here.floor, places = end
            yield run, here.taken(places)
            target = 2 * size
        if here.most > MOST * size:
            raise NeedsWhole('no window ends')
    if any(map(ahead.has, quantities)):
        raise NeedsWhole('not every stream starts over')
    yield run, here.taken(None)


class _Run:
    """What is there of one run of the sample clock."""

    def __init__(self, quantities: Collection[str]) -> None:
        self.floor = -float('inf')  # the stamp at which the last window ended
        self._blocks: dict[str, list[tuple[Samples, int]]] = {q: [] for q in quantities}
        self._n = dict.fromkeys(quantities, 0)
        self._first: dict[str, float] = {}

    @property
    def rows(self) -> int:
        """Samples of the voltage."""
        return self._n['voltage']

    @property
    def most(self) -> int:
        """Samples of the longest stream."""
        return max(self._n.values())

    def has(self, quantity: str) -> bool:
        """Return whether a stream has begun this run."""
        return quantity in self._first

    def starts_over(self, quantity: str, samples: Samples) -> bool:
        """Return whether a block is the first of the next run."""
        return quantity in self._first and bool(samples.t[0] <= self._first[quantity])

    def append(self, quantity: str, samples: Samples, arrival: int) -> None:
        """Take a block."""
        if np.fmin.reduce(samples.t) <= self.floor:
            raise NeedsWhole('time goes back behind a window')
        if self.starts_over(quantity, samples):
            raise NeedsWhole('a stream starts over twice')
        self._first.setdefault(quantity, float(samples.t[0]))
        self._blocks[quantity].append((samples, arrival))
        self._n[quantity] += samples.t.size

    def columns(self) -> dict[str, tuple[Vector, Vector]]:
        """Return the times and values of each stream."""
        return {
            quantity: (
                np.concatenate([s.t for s, _ in blocks] or [np.empty(0)]),
                np.concatenate([s.values for s, _ in blocks] or [np.empty(0)]),
            )
            for quantity, blocks in self._blocks.items()
        }

    def taken(self, places: dict[str, int] | None) -> dict[str, Stream]:
        """Take so many samples of each stream out, None for all."""
        found = {}
        for quantity, blocks in self._blocks.items():
            left = self._n[quantity] if places is None else places[quantity]
            self._n[quantity] -= left
            found[quantity] = stream = Stream()
            used = 0
            for samples, arrival in blocks:
                n = samples.t.size
                if left < n:
                    if left:
                        stream.append(_part(samples, 0, left), arrival)
                        blocks[used] = (_part(samples, left, n), arrival)
                    break
                stream.append(samples, arrival)
                left -= n
                used += 1
            del blocks[:used]
        return found


def _part(samples: Samples, start: int, stop: int) -> Samples:
    return Samples(
        samples.t[start:stop], samples.values[start:stop], samples.segment, samples.quantity
    )


def _end(
    columns: dict[str, tuple[Vector, Vector]], size: int, tolerance: float
) -> tuple[float, dict[str, int]] | None:
    """Return a stamp before which a window can end, and the place of it in each stream."""
    t = columns['voltage'][0]
    order = {
        quantity: (np.fmax.accumulate(x), np.fmin.accumulate(x[::-1])[::-1])
        for quantity, (x, _) in columns.items()
    }
    for row in np.linspace(size, t.size - CLEAN, TRIES).astype(int).tolist():
        near = slice(row - CLEAN, row + CLEAN)
        step = np.diff(t[near])
        if not (step.size == 2 * CLEAN - 1 and 0.0 < step.max() <= 1.01 * step.min()):
            continue
        v = columns['voltage'][1][near]
        places: dict[str, int] = {}
        for quantity, (x, values) in columns.items():
            highest, lowest = order[quantity]
            place = int(np.searchsorted(highest, t[row]))
            if place < x.size and not lowest[place] >= t[row]:
                break
            around = slice(max(0, place - CLEAN), place + CLEAN)
            is_there = np.array_equal(x[around], t[near])
            if quantity == APPLIED and not is_there:
                is_absent = place == int(np.searchsorted(highest, t[near][0])) and not (
                    place < x.size and lowest[place] <= t[near][-1]
                )
                if not is_absent:
                    break
            elif not (is_there and np.isfinite(values[around]).all()):
                break
            elif quantity == APPLIED and np.any(np.abs(values[around] - v) > tolerance):
                break
            places[quantity] = place
        else:
            return float(t[row]), places
    return None

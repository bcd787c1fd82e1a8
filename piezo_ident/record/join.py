# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Streams of blocks to columns: voltage and displacement meet on equal time stamps.

Blocks may be lost, come twice, or start over with a restarted clock, and the streams need not
be cut into the same blocks.  Where a time stamp occurs more than once, the first of one stream
belongs to the first of the other; after a loss, the two that arrived closest to each other do.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import itertools

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import DataError
from piezo_ident.record.record import Fault
from piezo_ident.record.stream import BlockStream

__all__ = ['Joined', 'join']

#: rows of a stream no further apart than this are of the same run of the sample clock
NEARBY = 300


@dataclass(frozen=True, eq=False)
class Joined:
    """Columns of equal length, the segments' names and starts, and what was met on the way."""

    t: NDArray[np.float64]
    columns: dict[str, NDArray[np.float64]]
    segments: tuple[list[str], list[int]]
    faults: tuple[Fault, ...]


def join(
    streams: Mapping[str, BlockStream], beside: Mapping[str, BlockStream] | None = None
) -> Joined:
    """
    Join streams on their time stamps.

    Parameters
    ----------
    streams : mapping of str to BlockStream
        By quantity; the first gives the order and the segments.
    beside : mapping of str to BlockStream, optional
        Streams that are looked up where they have a value, and leave NaN where they have none.

    Returns
    -------
    Joined
        One column a stream.

    Raises
    ------
    DataError
        When a stream has two values for one time, or no stamp is in all streams.
    """
    beside = beside or {}
    first, lead = next(iter(streams.items()))
    t = lead.times
    laps = _in_step(t, streams, beside)
    if laps is not None:
        return _joined_in_step(t, streams, beside, laps)
    arrivals = lead.arrivals
    stamps = {name: s.times for name, s in streams.items() if name != first}
    partner = {
        name: _partners(t, arrivals, x, streams[name].arrivals) for name, x in stamps.items()
    }
    matched = np.ones(lead.n, dtype=np.bool_)
    for rows in partner.values():
        matched &= rows >= 0
    if not matched.any():
        names = ' and '.join(streams)
        raise DataError(
            f'{names} share no time stamp; a displacement row must carry the t of the voltage '
            'sample converted on the same tick'
        )
    keep = np.flatnonzero(matched)
    used = {first: keep, **{name: p[keep] for name, p in partner.items()}}
    faults: list[Fault] = []
    columns = {}
    for name, stream in streams.items():
        values = stream.values
        faults.extend(_left_over(name, stamps.get(name, t), values, used[name]))
        columns[name] = values[used[name]]
    for name, stream in beside.items():
        row = _partners(t, arrivals, stream.times, stream.arrivals)[keep]
        columns[name] = np.where(row >= 0, stream.values[row] if stream.n else np.nan, np.nan)
    return Joined(
        t[keep], columns, _labels(lead, lambda rows: np.searchsorted(keep, rows)), tuple(faults)
    )


def _labels(
    stream: BlockStream, place: Callable[[NDArray[np.int64]], NDArray[np.int64]]
) -> tuple[list[str], list[int]]:
    """Return the label of each stretch and its first row, from how many rows before one stay."""
    names, starts = stream.labels()
    at = place(np.append(starts, stream.n)).tolist()
    kept: tuple[list[str], list[int]] = ([], [])
    for name, (begin, end) in zip(names, itertools.pairwise(at), strict=True):
        if begin < end and kept[0][-1:] != [name]:
            kept[0].append(name)
            kept[1].append(begin)
    return kept


@dataclass(frozen=True, eq=False)
class _Laps:
    """
    Runs of the sample clock that all streams went through together.

    Attributes
    ----------
    starts, sizes : dict of str to ndarray of int
        For each stream the row where each run begins, and its rows.
    n : ndarray of int
        Rows of each run that all streams have; they are its first ones.
    """

    starts: dict[str, NDArray[np.int64]]
    sizes: dict[str, NDArray[np.int64]]
    n: NDArray[np.int64]

    def cut(self, name: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rows that all streams have; NaN where this one lacks some."""
        if np.array_equal(self.sizes[name], self.n):
            return values
        column, ends = np.full(int(self.n.sum()), np.nan), np.cumsum(self.n)
        have = np.minimum(self.sizes[name], self.n)
        for to, begin, n in zip(ends - self.n, self.starts[name], have, strict=True):
            column[to : to + n] = values[begin : begin + n]
        return column

    def rest(self, name: str) -> NDArray[np.int64]:
        """Return the rows of a stream that another one has not."""
        begins, ends = self.starts[name] + self.n, self.starts[name] + self.sizes[name]
        return np.concatenate([np.arange(a, b) for a, b in zip(begins, ends, strict=True)])

    def place(self, name: str, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return how many rows before some rows of a stream all streams have."""
        k = np.searchsorted(self.starts[name], rows, 'right') - 1
        inside = np.minimum(rows - self.starts[name][k], self.n[k])
        return np.asarray(np.cumsum(self.n)[k] - self.n[k] + inside)


def _in_step(
    t: NDArray[np.float64], streams: Mapping[str, BlockStream], beside: Mapping[str, BlockStream]
) -> _Laps | None:
    """
    Return the runs of the clock in which each stream has the stamps of the lead from its first on.

    That is so wherever nothing was lost: then minutes of samples are joined without a table of
    partners.  None where it is not so.
    """
    first, lead = next(iter(streams.items()))
    starts: dict[str, NDArray[np.int64]] = {}
    sizes: dict[str, NDArray[np.int64]] = {}
    for name, stream in {**streams, **beside}.items():
        x = t if stream is lead else stream.times
        begin = np.concatenate([[0], np.flatnonzero(x[1:] <= x[:-1]) + 1])
        starts[name], sizes[name] = begin, np.diff(begin, append=x.size)
        if not x.size or begin.size != starts[first].size:
            return None
        same = np.minimum(sizes[name], sizes[first])
        for a, b, n in zip(begin, starts[first], same, strict=True):
            if not np.array_equal(x[a : a + n], t[b : b + n]):
                return None
        # runs of one clock are told apart by when they came
        came, came_lead = stream.arrived(begin), lead.arrived(starts[first])
        if (came[1:] <= came_lead[:-1]).any() or (came_lead[1:] <= came[:-1]).any():
            return None
    return _Laps(starts, sizes, np.min([sizes[name] for name in streams], axis=0))


def _joined_in_step(
    t: NDArray[np.float64],
    streams: Mapping[str, BlockStream],
    beside: Mapping[str, BlockStream],
    laps: _Laps,
) -> Joined:
    """Join streams by cutting what one of them has at the end of a run and another has not."""
    first, lead = next(iter(streams.items()))
    faults: list[Fault] = []
    columns = {}
    for name, stream in {**streams, **beside}.items():
        values = stream.values
        columns[name] = laps.cut(name, values)
        rest = laps.rest(name)
        if name in streams and rest.size:
            stamps = t if stream is lead else stream.times
            faults.extend(_left_over(name, stamps[rest], values[rest], rest[:0]))
    t = laps.cut(first, t)
    for column in (t, *columns.values()):
        # nobody else has them, so that a record need not copy them
        column.setflags(write=False)
    return Joined(t, columns, _labels(lead, lambda rows: laps.place(first, rows)), tuple(faults))


def _partners(
    ta: NDArray[np.float64],
    arrived_a: NDArray[np.int64],
    tb: NDArray[np.float64],
    arrived_b: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Return for each row of a the row of b with the same time, -1 for none."""
    partner = np.full(ta.size, -1, dtype=np.int64)
    if not (ta.size and tb.size):
        return partner
    if np.all(ta[1:] > ta[:-1]) and np.all(tb[1:] > tb[:-1]):
        at = np.minimum(np.searchsorted(tb, ta), tb.size - 1)
        return np.where(tb[at] == ta, at, -1)
    by_a, by_b = np.lexsort((arrived_a, ta)), np.lexsort((arrived_b, tb))
    if np.array_equal(ta[by_a], tb[by_b]):
        partner[by_a] = by_b
        return partner
    t, arrived = np.concatenate([ta, tb]), np.concatenate([arrived_a, arrived_b])
    by = np.lexsort((arrived, t))
    nearest = _nearest(t[by], arrived[by], by >= ta.size)
    # both must be the nearest to each other: a lost row's twin of another run has its own partner
    mutual = np.flatnonzero((nearest >= 0) & (nearest[nearest] == np.arange(by.size)))
    mutual = mutual[by[mutual] < ta.size]
    partner[by[mutual]] = by[nearest[mutual]] - ta.size
    return partner


def _nearest(
    t: NDArray[np.float64], arrived: NDArray[np.int64], in_b: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """Return for sorted rows of two streams the row of the other with equal time, -1 for none."""
    here = np.arange(t.size)
    best = np.full(t.size, -1)
    distance = np.full(t.size, np.iinfo(np.int64).max)
    before = {b: np.maximum.accumulate(np.where(in_b == b, here, -1)) for b in (True, False)}
    after = {
        b: np.minimum.accumulate(np.where(in_b == b, here, t.size)[::-1])[::-1]
        for b in (True, False)
    }
    for side in (before, after):
        other = np.where(in_b, side[False], side[True])
        there = np.clip(other, 0, t.size - 1)
        gap = np.abs(arrived[there] - arrived)
        closer = (other == there) & (t[there] == t) & (gap < distance)
        best[closer], distance[closer] = there[closer], gap[closer]
    return best


def _left_over(
    name: str,
    t: NDArray[np.float64],
    x: NDArray[np.float64],
    used: NDArray[np.int64],
) -> list[Fault]:
    """Say what became of the samples of a stream that found no partner."""
    left = np.ones(t.size, dtype=np.bool_)
    left[used] = False
    if not left.any():
        return []
    by = np.argsort(t, kind='stable')
    same_time = t[by][1:] == t[by][:-1]
    same_value = x[by][1:] == x[by][:-1]
    close = np.diff(by) <= NEARBY
    one_left = left[by][1:] ^ left[by][:-1]
    clash = np.flatnonzero(same_time & ~same_value & close & one_left)
    if clash.size:
        at = t[by][clash[0]]
        raise DataError(f'two different samples of {name} at t = {at:.9g} s; keep one of them')
    twin = np.zeros(left.size, dtype=np.bool_)
    twin[by[1:][same_time & same_value]] = True
    twin[by[:-1][same_time & same_value]] = True
    faults = []
    for fault, rows, action in (
        ('repeated_rows', left & twin, 'dropped'),
        ('unmatched', left & ~twin, 'dropped, no sample of another stream has their time'),
    ):
        if rows.any():
            known = t[rows & ~np.isnan(t)]
            span = f'from {known.min():.6g} to {known.max():.6g} s' if known.size else 'at no time'
            where = f'in {name}, {span}'
            faults.append(Fault(fault, where, int(np.count_nonzero(rows)), action))
    return faults

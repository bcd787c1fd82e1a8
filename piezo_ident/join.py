# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Streams of blocks to columns: voltage and displacement meet on equal time stamps.

Blocks may be lost, come twice, or start over with a restarted clock, and the streams need not
be cut into the same blocks.  Where a time stamp occurs more than once, the first of one stream
belongs to the first of the other; after a loss, the two that arrived closest to each other do.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.errors import DataError
from piezo_ident.record import Fault
from piezo_ident.wire_format import Samples

__all__ = ['Joined', 'Stream', 'join']

#: numbers in a chunk of a stream
CHUNK = 1 << 17
#: rows of a stream no further apart than this are of the same run of the sample clock
NEARBY = 300


class Stream:
    """All blocks of one topic so far, in flat buffers that grow chunk by chunk."""

    def __init__(self) -> None:
        self._chunks = [array('d')]  # only the last one grows, so that copies share the others
        self._sizes = array('q')
        self._arrivals = array('q')
        self._segments: list[str] = []

    def append(self, samples: Samples, arrival: int) -> None:
        """Add a block that arrived at a time [ns] of a clock that all streams share."""
        rows = np.column_stack([samples.t, samples.values])
        if len(self._chunks[-1]) >= CHUNK:
            self._chunks.append(array('d'))
        self._chunks[-1].frombytes(rows.tobytes())
        self._sizes.append(samples.t.size)
        self._arrivals.append(arrival)
        # one string for all blocks of a segment, not one a block
        last = self._segments[-1] if self._segments else ''
        self._segments.append(last if last == samples.segment else samples.segment)

    def copy(self) -> Stream:
        """Return the stream as it is now, without copying what no longer changes."""
        other = Stream()
        other._chunks = [*self._chunks[:-1], self._chunks[-1][:]]
        other._sizes, other._arrivals = self._sizes[:], self._arrivals[:]
        other._segments = self._segments[:]
        return other

    def drop(self, blocks: int) -> None:
        """Forget the oldest blocks."""
        left = 2 * sum(self._sizes[:blocks])
        while left and len(self._chunks) > 1 and left >= len(self._chunks[0]):
            left -= len(self._chunks.pop(0))
        self._chunks[0] = self._chunks[0][left:]
        del self._sizes[:blocks], self._arrivals[:blocks], self._segments[:blocks]

    @property
    def n(self) -> int:
        """Number of samples."""
        return sum(len(chunk) for chunk in self._chunks) // 2

    @property
    def rows(self) -> NDArray[np.float64]:
        """Time [s] and value of each sample, a copy of shape (n, 2)."""
        chunks = [np.frombuffer(chunk, dtype=np.float64) for chunk in self._chunks if chunk]
        return np.concatenate([np.empty(0), *chunks]).reshape(-1, 2)

    @property
    def arrivals(self) -> NDArray[np.int64]:
        """When each sample arrived [ns]."""
        return np.repeat(np.array(self._arrivals, dtype=np.int64), self._sizes)

    def labels(self, rows: NDArray[np.int64]) -> tuple[list[str], list[int]]:
        """Return the label of each stretch of `rows`, and where in `rows` it begins."""
        if not rows.size:
            return [], []
        codes = {label: i for i, label in enumerate(dict.fromkeys(self._segments))}
        block = np.array([codes[label] for label in self._segments], dtype=np.int64)
        code = np.repeat(block, self._sizes)[rows]
        starts = np.concatenate([[0], np.flatnonzero(np.diff(code)) + 1])
        names = list(codes)
        return [names[c] for c in code[starts]], starts.tolist()


@dataclass(frozen=True, eq=False)
class Joined:
    """Columns of equal length, the segments' names and starts, and what was met on the way."""

    t: NDArray[np.float64]
    columns: dict[str, NDArray[np.float64]]
    segments: tuple[list[str], list[int]]
    faults: tuple[Fault, ...]


def join(streams: Mapping[str, Stream], beside: Mapping[str, Stream] | None = None) -> Joined:
    """
    Join streams on their time stamps.

    Parameters
    ----------
    streams : mapping of str to Stream
        By quantity; the first gives the order and the segments.
    beside : mapping of str to Stream, optional
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
    (first, lead), *others = streams.items()
    tables = {name: (s.rows, s.arrivals) for name, s in streams.items()}
    rows, arrivals = tables[first]
    partner = {}
    matched = np.ones(lead.n, dtype=np.bool_)
    for name, _ in others:
        partner[name] = _partners(rows[:, 0], arrivals, tables[name][0][:, 0], tables[name][1])
        matched &= partner[name] >= 0
    if not matched.any():
        names = ' and '.join(streams)
        raise DataError(
            f'{names} share no time stamp; a displacement row must carry the t of the voltage '
            'sample converted on the same tick'
        )
    keep = np.flatnonzero(matched)
    used = {first: keep, **{name: p[keep] for name, p in partner.items()}}
    faults: list[Fault] = []
    for name, (table, _) in tables.items():
        faults.extend(_left_over(name, table, used[name]))
    columns = {name: tables[name][0][used[name], 1] for name in streams}
    for name, stream in (beside or {}).items():
        table = stream.rows
        row = _partners(rows[:, 0], arrivals, table[:, 0], stream.arrivals)[keep]
        columns[name] = np.where(row >= 0, table[row, 1] if stream.n else np.nan, np.nan)
    return Joined(
        t=rows[keep, 0],
        columns=columns,
        segments=lead.labels(keep),
        faults=tuple(faults),
    )


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


def _left_over(name: str, table: NDArray[np.float64], used: NDArray[np.int64]) -> list[Fault]:
    """Say what became of the samples of a stream that found no partner."""
    left = np.ones(len(table), dtype=np.bool_)
    left[used] = False
    if not left.any():
        return []
    t, x = table[:, 0], table[:, 1]
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

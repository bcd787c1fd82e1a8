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
be cut into the same blocks.  Where a time stamp occurs more than once, the two rows that arrived
closest to each other belong together.
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

#: two blocks that came within so many messages are of the same run of the sample clock
NEARBY = 6


class Stream:
    """All blocks of one topic so far, in flat buffers that grow."""

    def __init__(self) -> None:
        self._rows = array('d')
        self._sizes = array('q')
        self._orders = array('q')
        self._segments: list[str] = []

    def append(self, samples: Samples, order: int) -> None:
        """Add a block; `order` counts the messages of all streams as they arrived."""
        rows = np.column_stack([samples.t, samples.values])
        self._rows.frombytes(rows.tobytes())
        self._sizes.append(samples.t.size)
        self._orders.append(order)
        # one string for all blocks of a segment, not one a block
        last = self._segments[-1] if self._segments else ''
        self._segments.append(last if last == samples.segment else samples.segment)

    @property
    def n(self) -> int:
        """Number of samples."""
        return len(self._rows) // 2

    @property
    def rows(self) -> NDArray[np.float64]:
        """Time [s] and value of each sample, a copy of shape (n, 2)."""
        return np.array(self._rows, dtype=np.float64).reshape(-1, 2)

    @property
    def order(self) -> NDArray[np.int64]:
        """Number of the message that brought each sample."""
        return np.repeat(np.array(self._orders, dtype=np.int64), self._sizes)

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


def join(streams: Mapping[str, Stream]) -> Joined:
    """
    Join streams on their time stamps.

    Parameters
    ----------
    streams : mapping of str to Stream
        By quantity; the first gives order and segments.

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
    tables = {name: (s.rows, s.order) for name, s in streams.items()}
    rows, order = tables[first]
    partner = {}
    matched = np.ones(lead.n, dtype=np.bool_)
    for name, _ in others:
        partner[name] = _partners(rows[:, 0], order, tables[name][0][:, 0], tables[name][1])
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
    for name, (table, arrived) in tables.items():
        faults.extend(_left_over(name, table, arrived, used[name]))
    return Joined(
        t=rows[keep, 0],
        columns={name: tables[name][0][used[name], 1] for name in streams},
        segments=lead.labels(keep),
        faults=tuple(faults),
    )


def _partners(
    ta: NDArray[np.float64],
    order_a: NDArray[np.int64],
    tb: NDArray[np.float64],
    order_b: NDArray[np.int64],
) -> NDArray[np.int64]:
    """Return for each row of a the row of b with the same time, -1 for none."""
    if not (ta.size and tb.size):
        return np.full(ta.size, -1)
    if np.all(ta[1:] > ta[:-1]) and np.all(tb[1:] > tb[:-1]):
        at = np.minimum(np.searchsorted(tb, ta), tb.size - 1)
        return np.where(tb[at] == ta, at, -1)
    _, rank = np.unique(np.concatenate([ta, tb]), return_inverse=True)
    span = 2 * int(max(order_a.max(), order_b.max())) + 2
    # rows of one time sit together on this scale, as far apart as they arrived
    key = span * rank.reshape(-1) + np.concatenate([order_a, order_b])
    key_a, key_b = key[: ta.size], key[ta.size :]
    ab = _nearest(key_a, key_b, span)
    ba = _nearest(key_b, key_a, span)
    mutual = (ab >= 0) & (ba[ab] == np.arange(ta.size))
    return np.where(mutual, ab, -1)


def _nearest(key: NDArray[np.int64], of: NDArray[np.int64], span: int) -> NDArray[np.int64]:
    by = np.argsort(of, kind='stable')
    right = np.searchsorted(of[by], key)
    best = np.full(key.size, -1)
    distance = np.full(key.size, span)
    for at in (right - 1, right):
        inside = (at >= 0) & (at < of.size)
        there = by[np.where(inside, at, 0)]
        same = inside & (of[there] // span == key // span)
        gap = np.abs(of[there] - key)
        closer = same & (gap < distance)
        best[closer], distance[closer] = there[closer], gap[closer]
    return best


def _left_over(
    name: str, table: NDArray[np.float64], arrived: NDArray[np.int64], used: NDArray[np.int64]
) -> list[Fault]:
    """Say what became of the samples of a stream that found no partner."""
    left = np.ones(arrived.size, dtype=np.bool_)
    left[used] = False
    if not left.any():
        return []
    t, x = table[:, 0], table[:, 1]
    by = np.lexsort((arrived, t))
    same_time = t[by][1:] == t[by][:-1]
    same_value = x[by][1:] == x[by][:-1]
    close = np.abs(np.diff(arrived[by])) <= NEARBY
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
            where = f'in {name}, from {np.nanmin(t[rows]):.6g} to {np.nanmax(t[rows]):.6g} s'
            faults.append(Fault(fault, where, int(np.count_nonzero(rows)), action))
    return faults

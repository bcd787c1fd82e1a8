# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Make a record of streams of blocks, live or from a bag.

Voltage and displacement are joined on equal time stamps.  Blocks may be lost, come twice, or start
over with a restarted clock, and the streams may be cut into other blocks.  If several stamps are
equal, the two stamps that arrived closest to each other belong together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array, CHUNK, Integers, Mask
from piezo_ident.common.errors import DataError, naming, OrderError
from piezo_ident.record.assemble import assemble
from piezo_ident.record.blocks import HELD, RAMPED
from piezo_ident.record.channels import APPLIED, applied_key, channel_of_quantity
from piezo_ident.record.clock import has_restarted
from piezo_ident.record.options import ReadOptions
from piezo_ident.record.ordering import at_times
from piezo_ident.record.record import Fault, Record
from piezo_ident.record.stream import BlockStream

__all__ = ['APPLIED', 'MAX_MISSING', 'Joined', 'join', 'record_of_streams']

#: equal times of two streams: first row in either stream, number of rows
Matches = list[tuple[int, int, int]]

#: commanded and applied voltage may differ by this share of the range
TOLERANCE = 1e-3
#: largest share of missing samples of a usable segment or further channel
MAX_MISSING = 0.05
#: least share of common samples, from the latest start to the earliest end: different clocks meet
#: by chance
MET = 0.1
#: largest distance of rows of one run of the sample clock [rows]
NEARBY = 300


def record_of_streams(
    streams: Mapping[str, BlockStream],
    *,
    name: str,
    options: ReadOptions | None = None,
    sample_rate: float | None = None,
    faults: Iterable[Fault] = (),
) -> Record:
    """
    Make a record of streams of blocks, by quantity: ``voltage``, ``displacement`` and further.

    Samples whose ``applied_voltage`` differs from the command are cut out, since the stage did not
    get the command.  A further axis or channel that lacks more than `MAX_MISSING` of the samples
    is left out.  The other arguments, and the errors, are those of
    `piezo_ident.record.assemble.assemble`.
    """
    n = min(streams['voltage'].n, streams['displacement'].n)
    sparse = {
        key: Fault('sparse_channel', f'{key}, {s.n} samples beside {n}', n - s.n, 'left out')
        for key, s in streams.items()
        if channel_of_quantity(key) and s.n < (1.0 - MAX_MISSING) * n
    }
    needed = {
        key: s for key, s in streams.items() if key not in sparse and not key.startswith(APPLIED)
    }
    guarded = {key: applied_key(key) for key in needed if applied_key(key) in streams}
    with naming(name):
        joined = join(needed, {key: streams[key] for key in guarded.values()})
    met = [*faults, *sparse.values(), *joined.faults]
    for key, applied in guarded.items():
        met += _driven_alone(applied, streams[applied])
        joined = _without_guarded(joined, key, name, met)
    columns = dict(joined.columns)
    try:
        return assemble(
            joined.t,
            columns.pop('voltage'),
            columns.pop('displacement'),
            joined.segments,
            {channel_of_quantity(key): x for key, x in columns.items()},
            name=name,
            options=options,
            sample_rate=sample_rate,
            faults=met,
        )
    except OrderError as error:
        raise DataError(
            f'{error.fact}; do two nodes publish voltage? end one of them, and record again'
        ) from None


class Joined(NamedTuple):
    """Columns of equal length, names and starts of the segments, and the faults."""

    t: Array
    columns: dict[str, Array]
    segments: tuple[list[str], list[int]]
    faults: tuple[Fault, ...]


def _driven_alone(name: str, stream: BlockStream) -> Iterator[Fault]:
    """Yield a fault for the voltages that a driver applied without a command."""
    (labels, starts), t = stream.labels(), stream.times
    for label, action in (
        (HELD, 'the command did not come, the driver held its voltage'),
        (RAMPED, 'no command came for long, the driver ramped to rest'),
    ):
        # a ramp after the last command changes nothing; the next stream begins with a lower t
        rows = [
            (a, b)
            for own, a, b in zip(labels[1:-1], starts[1:-1], starts[2:], strict=True)
            if own == label and t[b] > t[a - 1]
        ]
        if rows:
            where = f'in {name}, {at_times(t[[a for a, _ in rows]])}'
            yield Fault(label, where, int(sum(b - a for a, b in rows)), action)


def _without_guarded(joined: Joined, key: str, name: str, met: list[Fault]) -> Joined:
    """Cut out the samples whose applied voltage differs from the command."""
    columns = dict(joined.columns)
    v, applied, t = columns[key], columns.pop(applied_key(key)), joined.t
    joined = joined._replace(columns=columns)
    if np.array_equal(v, applied):
        return joined
    unknown = np.isnan(applied)
    if unknown.any():
        where, count = at_times(t[unknown][:1]), int(np.count_nonzero(unknown))
        met.append(Fault('applied_unknown', where, count, 'taken as commanded'))
    finite = v[np.isfinite(v)]
    span = float(np.ptp(finite)) if finite.size else 0.0
    tolerance = TOLERANCE * (span or float(np.abs(finite).max(initial=1.0)))
    wrong = np.abs(v - applied) > tolerance  # False for NaN
    if not wrong.any():
        return joined
    worst = float(np.abs(v - applied)[wrong].max())
    if wrong.all():
        raise DataError(
            f'{name}: the applied voltage is off the commanded one in all {v.size} samples, by up '
            f"to {worst:.3g} V; look at the guards of the amplifier's driver"
        )
    begins = np.flatnonzero(wrong & ~np.append(False, wrong[:-1]))
    where = f'{at_times(t[begins])}, by up to {worst:.3g} V'
    count = int(np.count_nonzero(wrong))
    met.append(Fault('guarded_voltage', where, count, 'cut out, record split there'))
    keep = np.flatnonzero(~wrong)
    names, starts = joined.segments
    columns = {key: x[keep] for key, x in columns.items()}
    return Joined(t[keep], columns, (names, np.searchsorted(keep, starts).tolist()), joined.faults)


def join(
    streams: Mapping[str, BlockStream], beside: Mapping[str, BlockStream] | None = None
) -> Joined:
    """
    Join streams, by quantity, on their time stamps: one column a stream.

    The first stream gives the order and the segments.  Columns of streams `beside` are NaN at
    times that their stream lacks.  DataError if a stream has two values for one time, or no stamp
    is in all streams.
    """
    every = {**streams, **(beside or {})}
    first, lead = next(iter(streams.items()))
    times = {name: s.times for name, s in every.items()}
    t = times[first]
    in_step = _in_step(every, times)
    matches = in_step or {
        name: _matches(t, lead.arrivals, times[name], s.arrivals) for name, s in streams.items()
    }
    keep = np.ones(lead.n, dtype=np.bool_)
    for name in streams:
        end = 0
        for i, _, n in (*matches[name], (lead.n, 0, 0)):
            keep[end:i] = False
            end = i + n
    if beside and not in_step:
        # a repeated row that is left out has no partner
        kept = np.where(keep, t, np.nan)
        for name, s in beside.items():
            matches[name] = _matches(kept, lead.arrivals, times[name], s.arrivals)
    shared = int(np.count_nonzero(keep))
    low = max(np.nanmin(times[name], initial=np.inf) for name in streams)
    high = min(np.nanmax(times[name], initial=-np.inf) for name in streams)
    fewest = min(int(np.count_nonzero((times[k] >= low) & (times[k] <= high))) for k in streams)
    if shared < MET * fewest or not shared:
        much = f'only {shared} of {fewest} time stamps' if fewest else 'no time stamp'
        raise DataError(
            f'{" and ".join(streams)} share {much}; a displacement row must carry the t of '
            'the voltage sample converted on the same tick'
        )
    faults: list[Fault] = []
    columns = {}
    for name, stream in every.items():
        values = stream.values
        columns[name] = _cut(values, matches[name], keep, alone=name not in streams)
        if name in streams:
            left = np.ones(stream.n, dtype=np.bool_)
            for i, j, n in matches[name]:
                left[j : j + n] = ~keep[i : i + n]
            # in streams in step, only rows without a partner have a twin
            rows = np.flatnonzero(left) if in_step else np.arange(left.size)
            if left.any():
                faults += _left_over(name, times[name][rows], values[rows], left[rows])
    names, starts = lead.labels()
    sizes = np.add.reduceat(keep, starts, dtype=np.int64) if names else starts
    segments = names, (np.cumsum(sizes) - sizes).tolist()
    return Joined(_cut(t, matches[first], keep), columns, segments, tuple(faults))


def _cut(x: Array, matches: Matches, keep: Mask, *, alone: bool = False) -> Array:
    """Return the values of the kept rows; with `alone`, NaN for rows that the stream lacks."""
    if alone:
        column = np.full(keep.size, np.nan)
        for i, j, n in matches:
            column[i : i + n] = x[j : j + n]
        return column if keep.all() else column[keep]
    parts = []
    for i, j, n in matches:
        kept = keep[i : i + n]
        rows = [0, *(np.flatnonzero(kept[1:] != kept[:-1]) + 1).tolist(), n]
        # rows that stay in one go need no copy
        parts += [x[j + a : j + b] for a, b in itertools.pairwise(rows) if kept[a]]
    column = parts[0] if len(parts) == 1 else np.concatenate(parts)
    column.setflags(write=False)
    return column


def _in_step(
    streams: Mapping[str, BlockStream], times: Mapping[str, Array]
) -> dict[str, Matches] | None:
    """
    Return the rows that the streams share, by runs of the sample clock.

    Return None if the runs of the streams differ, or a block is repeated.  Equal runs join hours
    of samples without a table of partners.
    """
    begins, came = {}, {}
    for name, t in times.items():
        if not t.size or np.isnan(t).any():
            return None
        begins[name] = begin = [0, *(np.flatnonzero(t[1:] <= t[:-1]) + 1).tolist()]
        for a, b in itertools.pairwise(begin):
            # in samples: a repeated block is no run
            if not has_restarted(float(np.searchsorted(t[a:b], t[b])), b - a, 0.0, 1.0):
                return None
        came[name] = streams[name].arrived(np.array(begin))
    first = next(iter(times))
    one = came[first]
    matches: dict[str, Matches] = {}
    for name, t in times.items():
        other = came[name]
        # times of arrival distinguish the runs of one clock
        if (
            one.size != other.size
            or (other[1:] <= one[:-1]).any()
            or (one[1:] <= other[:-1]).any()
        ):
            return None
        merged: Matches = []
        for (a, b), (c, d) in zip(
            itertools.pairwise([*begins[first], times[first].size]),
            itertools.pairwise([*begins[name], t.size]),
            strict=True,
        ):
            for i, j, n in _shared(times[first][a:b], t[c:d]):
                x, y, m = merged[-1] if merged else (-1, -1, 0)
                if (a + i, c + j) == (x + m, y + m):
                    merged[-1] = (x, y, m + n)
                else:
                    merged.append((a + i, c + j, n))
        matches[name] = merged
    return matches


def _shared(one: Array, other: Array) -> Iterator[tuple[int, int, int]]:
    """Yield the stretches that two rising columns of times share."""
    i = j = 0
    while i < one.size and j < other.size:
        n = min(one.size - i, other.size - j, CHUNK)
        part = one[i : i + n]
        if np.array_equal(part, other[j : j + n]):
            yield i, j, n
            end = j + n
        else:
            end = j + int(np.searchsorted(other[j:], part[-1], 'right'))
            _, rows, partners = np.intersect1d(
                part, other[j:end], assume_unique=True, return_indices=True
            )
            yield from _stretches(rows + i, partners + j)
        i, j = i + n, end


def _stretches(rows: NDArray[np.intp], partners: NDArray[np.intp]) -> Matches:
    """Return rising rows and their partners as stretches."""
    cuts = np.flatnonzero((np.diff(rows) != 1) | (np.diff(partners) != 1)) + 1
    bounds = itertools.pairwise([0, *cuts.tolist(), rows.size])
    return [(int(rows[a]), int(partners[a]), b - a) for a, b in bounds if a < b]


def _matches(ta: Array, arrived_a: Integers, tb: Array, arrived_b: Integers) -> Matches:
    """Return the rows that two streams share; rows of the same time pair by their arrival."""
    t, arrived = np.concatenate([ta, tb]), np.concatenate([arrived_a, arrived_b])
    by = np.lexsort((arrived, t))
    nearest = _nearest(t[by], arrived[by], by >= ta.size)
    # partners are nearest to each other: the twin of a lost row has its own partner
    mutual = np.flatnonzero((nearest >= 0) & (nearest[nearest] == np.arange(by.size)))
    mutual = mutual[by[mutual] < ta.size]
    order = np.argsort(by[mutual])
    return _stretches(by[mutual][order], by[nearest[mutual]][order] - ta.size)


def _nearest(t: Array, arrived: Integers, in_b: Mask) -> Integers:
    """Return the nearest row of the other stream with equal time for sorted rows, -1 for none."""
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


def _left_over(name: str, t: Array, x: Array, left: Mask) -> list[Fault]:
    """Return the faults of the samples of a stream that have no partner."""
    by = np.argsort(t, kind='stable')
    same_time = t[by][1:] == t[by][:-1]
    same_value = x[by][1:] == x[by][:-1]
    close = np.diff(by) <= NEARBY
    one_left = left[by][1:] ^ left[by][:-1]
    clash = np.flatnonzero(same_time & ~same_value & close & one_left)
    if clash.size:
        at = t[by][clash[0]]
        raise DataError(
            f'two different samples of {name} at t = {at:.9g} s; keep one of them, and end the '
            'other where two nodes publish it'
        )
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

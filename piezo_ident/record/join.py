# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
A record from streams of blocks, whether they come live or from a bag.

Voltage and displacement meet on equal time stamps.  Blocks may be lost, come twice, or start over
with a restarted clock, and the streams need not be cut into the same blocks.  Equal time stamps in
one stream are matched in turn with those of the other; after a loss, the two that arrived closest
to each other belong together.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import itertools

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.common.errors import DataError, OrderError
from piezo_ident.record.assemble import assemble
from piezo_ident.record.blocks import HELD, RAMPED
from piezo_ident.record.channels import APPLIED, applied_key, channel_of_quantity
from piezo_ident.record.clock import has_restarted
from piezo_ident.record.options import ReadOptions
from piezo_ident.record.ordering import at_times
from piezo_ident.record.record import Fault, Record
from piezo_ident.record.stream import BlockStream

__all__ = ['APPLIED', 'MAX_MISSING', 'Joined', 'join', 'record_of_streams']

#: equal times of two streams: first row of the one, first row of the other, how many rows
Matches = list[tuple[int, int, int]]

#: commanded and applied voltage may differ by this share of the range
TOLERANCE = 1e-3
#: most of a segment by time, or of a further channel, that may be missing before it is not used
MAX_MISSING = 0.05
#: least share of the samples of one clock in common, from the latest start to the earliest end
MET = 0.1
#: rows of a stream no further apart than this are of the same run of the sample clock
NEARBY = 300
#: rows that are compared together
_CHUNK = 1 << 20


def record_of_streams(
    streams: Mapping[str, BlockStream],
    *,
    name: str,
    options: ReadOptions | None = None,
    sample_rate: float | None = None,
    faults: Iterable[Fault] = (),
) -> Record:
    """
    Make a record of streams of blocks.

    Parameters
    ----------
    streams : mapping of str to BlockStream
        Those of ``voltage``, ``displacement``, ``x_<name>``, ``voltage_<name>``,
        ``displacement_<name>``, and of each voltage ``applied_voltage``.  Where command and
        applied voltage differ, the amplifier's guard was at work: the stage did not get the
        command, so these samples are cut out.  A further axis or channel that lacks more than
        `MAX_MISSING` of the samples is left out.
    name : str
        Name of the record, also in errors.
    options, sample_rate, faults
        As for `piezo_ident.record.assemble.assemble`.

    Raises
    ------
    DataError
        For data that cannot be used without a guess.
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
    try:
        joined = join(needed, {key: streams[key] for key in guarded.values()})
    except DataError as error:
        raise DataError(f'{name}: {error}') from None
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


@dataclass(frozen=True, eq=False)
class Joined:
    """Columns of equal length, the segments' names and starts, and what was met on the way."""

    t: Array
    columns: dict[str, Array]
    segments: tuple[list[str], list[int]]
    faults: tuple[Fault, ...]


def _driven_alone(name: str, stream: BlockStream) -> list[Fault]:
    """Say where a driver moved the stage by itself while commands were on their way."""
    (labels, starts), t = stream.labels(), stream.times
    faults = []
    for label, action in (
        (HELD, 'the command did not come, the driver held its voltage'),
        (RAMPED, 'no command came for long, the driver ramped to rest'),
    ):
        # a ramp behind the last command changes nothing; t starts over in the next stream
        rows = [
            (a, b)
            for own, a, b in zip(labels[1:-1], starts[1:-1], starts[2:], strict=True)
            if own == label and t[b] > t[a - 1]
        ]
        if rows:
            where = f'in {name}, {at_times(t[[a for a, _ in rows]])}'
            faults.append(Fault(label, where, int(sum(b - a for a, b in rows)), action))
    return faults


def _without_guarded(joined: Joined, key: str, name: str, met: list[Fault]) -> Joined:
    """Cut out the samples at which another voltage was applied than commanded."""
    columns = dict(joined.columns)
    v, applied, t = columns[key], columns.pop(applied_key(key)), joined.t
    if np.array_equal(v, applied):
        return replace(joined, columns=columns)
    unknown = np.isnan(applied)
    if unknown.any():
        where, count = at_times(t[unknown][:1]), int(np.count_nonzero(unknown))
        met.append(Fault('applied_unknown', where, count, 'taken as commanded'))
    finite = v[np.isfinite(v)]
    span = float(np.ptp(finite)) if finite.size else 0.0
    tolerance = TOLERANCE * (span or float(np.abs(finite).max(initial=1.0)))
    wrong = np.abs(v - applied) > tolerance  # False where either is NaN
    if wrong.all():
        raise DataError(
            f'{name}: the applied voltage is nowhere the commanded one; look at the guards of the '
            "amplifier's driver"
        )
    if not wrong.any():
        return replace(joined, columns=columns)
    worst = float(np.abs(v - applied)[wrong].max())
    begins = np.flatnonzero(wrong & ~np.concatenate([[False], wrong[:-1]]))
    where = f'{at_times(t[begins])}, by up to {worst:.3g} V'
    count = int(np.count_nonzero(wrong))
    met.append(Fault('guarded_voltage', where, count, 'cut out, record split there'))
    keep = np.flatnonzero(~wrong)
    names, starts = joined.segments
    columns = {key: x[keep] for key, x in columns.items()}
    segments = names, np.searchsorted(keep, starts).tolist()
    return Joined(t[keep], columns, segments, joined.faults)


def join(
    streams: Mapping[str, BlockStream], beside: Mapping[str, BlockStream] | None = None
) -> Joined:
    """
    Join streams, by quantity, on their time stamps: one column a stream.

    The first one gives the order and the segments.  Streams `beside` are looked up where they have
    a value, and leave NaN where they have none.  DataError when a stream has two values for one
    time, or no stamp is in all streams.
    """
    beside = beside or {}
    first, lead = next(iter(streams.items()))
    times = {name: s.times for name, s in {**streams, **beside}.items()}
    t = times[first]
    in_step = _in_step({**streams, **beside}, times)
    matches = in_step or {
        name: _matches(t, lead.arrivals, times[name], s.arrivals)
        for name, s in {**streams, **beside}.items()
    }
    keep = np.ones(lead.n, dtype=np.bool_)
    for name in streams:
        end = 0
        for i, _, n in (*matches[name], (lead.n, 0, 0)):
            keep[end:i] = False
            end = i + n
    shared, fewest = int(np.count_nonzero(keep)), _fewest([times[name] for name in streams])
    # clocks that differ meet by chance now and then
    if shared < MET * fewest or not shared:
        much = f'only {shared} of {fewest} time stamps' if shared else 'no time stamp'
        raise DataError(
            f'{" and ".join(streams)} share {much}; a displacement row must carry the t of '
            'the voltage sample converted on the same tick'
        )
    faults: list[Fault] = []
    columns = {}
    for name, stream in {**streams, **beside}.items():
        values = stream.values
        columns[name] = _cut(values, matches[name], keep, alone=name in beside)
        if name in streams:
            left = np.ones(stream.n, dtype=np.bool_)
            for i, j, n in matches[name]:
                left[j : j + n] = ~keep[i : i + n]
            # in step no row has a twin but among those that are left
            rows = np.flatnonzero(left) if in_step else np.arange(left.size)
            if left.any():
                faults += _left_over(name, times[name][rows], values[rows], left[rows])
    return Joined(_cut(t, matches[first], keep), columns, _labels(lead, keep), tuple(faults))


def _fewest(times: Sequence[Array]) -> int:
    """Return how many rows a stream has at least, from the latest start to the earliest end."""
    low = max(np.nanmin(t, initial=np.inf) for t in times)
    high = min(np.nanmax(t, initial=-np.inf) for t in times)
    return min(int(np.count_nonzero((t >= low) & (t <= high))) for t in times)


def _cut(x: Array, matches: Matches, keep: Mask, *, alone: bool = False) -> Array:
    """Return the values of the rows that are kept; `alone`, NaN where the stream has none."""
    if alone:
        column = np.full(keep.size, np.nan)
        for i, j, n in matches:
            column[i : i + n] = x[j : j + n]
        return column if keep.all() else column[keep]
    parts = []
    for i, j, n in matches:
        kept = keep[i : i + n]
        rows = np.flatnonzero(kept[1:] != kept[:-1]) + 1
        # what stays in one go needs no copy
        parts += [
            x[j + a : j + b] for a, b in itertools.pairwise([0, *rows.tolist(), n]) if kept[a]
        ]
    column = parts[0] if len(parts) == 1 else np.concatenate(parts)
    column.setflags(write=False)
    return column


def _labels(stream: BlockStream, keep: Mask) -> tuple[list[str], list[int]]:
    """Return the label of each stretch, and how many rows before it are kept."""
    names, starts = stream.labels()
    sizes = np.add.reduceat(keep, starts, dtype=np.int64) if names else starts
    return names, (np.cumsum(sizes) - sizes).tolist()


def _in_step(
    streams: Mapping[str, BlockStream], times: Mapping[str, Array]
) -> dict[str, Matches] | None:
    """
    Return what the streams share, run by run, where all went through the same runs of the clock.

    That is so wherever nothing came twice: hours of samples are then joined without a table of
    partners.  None where it is not so.
    """
    begins, came = {}, {}
    for name, t in times.items():
        if not t.size or np.isnan(t).any():
            return None
        begins[name] = begin = [0, *(np.flatnonzero(t[1:] <= t[:-1]) + 1).tolist()]
        for a, b in itertools.pairwise(begin):
            # in samples: a repeated block is no run of its own
            if not has_restarted(float(np.searchsorted(t[a:b], t[b])), b - a, 0.0, 1.0):
                return None
        came[name] = streams[name].arrived(np.array(begin))
    first = next(iter(times))
    matches: dict[str, Matches] = {}
    for name, t in times.items():
        one, other = came[first], came[name]
        if one.size != other.size:
            return None
        # runs of one clock are told apart by when they came
        if (other[1:] <= one[:-1]).any() or (one[1:] <= other[:-1]).any():
            return None
        runs = zip(
            itertools.pairwise([*begins[first], times[first].size]),
            itertools.pairwise([*begins[name], t.size]),
            strict=True,
        )
        matches[name] = _merged(
            (a + i, c + j, n)
            for (a, b), (c, d) in runs
            for i, j, n in _shared(times[first][a:b], t[c:d])
        )
    return matches


def _shared(one: Array, other: Array) -> Iterator[tuple[int, int, int]]:
    """Yield where two rising columns of times go on alike."""
    i = j = 0
    while i < one.size and j < other.size:
        n = min(one.size - i, other.size - j, _CHUNK)
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
    """Return rising rows and their partners as stretches in which both go on."""
    cuts = np.flatnonzero((np.diff(rows) != 1) | (np.diff(partners) != 1)) + 1
    bounds = itertools.pairwise([0, *cuts.tolist(), rows.size])
    return [(int(rows[a]), int(partners[a]), b - a) for a, b in bounds if a < b]


def _merged(matches: Iterable[tuple[int, int, int]]) -> Matches:
    """Return matches with those that go on where the one before ended as one."""
    merged: Matches = []
    for i, j, n in matches:
        if merged and (i, j) == (merged[-1][0] + merged[-1][2], merged[-1][1] + merged[-1][2]):
            merged[-1] = (*merged[-1][:2], merged[-1][2] + n)
        else:
            merged.append((i, j, n))
    return merged


def _matches(ta: Array, arrived_a: Integers, tb: Array, arrived_b: Integers) -> Matches:
    """Return what two streams share, rows of the same time paired by when they came."""
    t, arrived = np.concatenate([ta, tb]), np.concatenate([arrived_a, arrived_b])
    by = np.lexsort((arrived, t))
    nearest = _nearest(t[by], arrived[by], by >= ta.size)
    # both must be nearest to each other: the twin of a lost row has its own partner
    mutual = np.flatnonzero((nearest >= 0) & (nearest[nearest] == np.arange(by.size)))
    mutual = mutual[by[mutual] < ta.size]
    order = np.argsort(by[mutual])
    return _stretches(by[mutual][order], by[nearest[mutual]][order] - ta.size)


def _nearest(t: Array, arrived: Integers, in_b: Mask) -> Integers:
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


def _left_over(name: str, t: Array, x: Array, left: Mask) -> list[Fault]:
    """Say what became of the samples of a stream that found no partner."""
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

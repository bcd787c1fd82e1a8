# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Make a record of raw columns, and handle every fault of measured data the same way for all formats.

Gaps, restarts and changes of the sampling rate split the record.  Repeated rows are dropped.
NaN and infinite samples are cut out; if the displacement alone is affected, the voltage stays.  A
`Fault` reports each of these faults.  Data that need a guess are refused with the remedy.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
import itertools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, real_array, true_runs
from piezo_ident.common.errors import DataError
from piezo_ident.record.channels import role_of
from piezo_ident.record.clock import Clock, fit_clock, Resolution, split_uniform
from piezo_ident.record.options import ReadOptions, split_unit, unit_factor, UNITS
from piezo_ident.record.ordering import at_times, in_order, not_uniform, OrderedRows, unrounded
from piezo_ident.record.record import Fault, NAMED, Piece, Record, Segment

#: label of each stretch, and the row at which it begins
SegmentStarts = tuple[Sequence[str], ArrayLike]

#: highest rate of times in seconds [Hz]
MAX_RATE = 1e9
#: most pieces of a record
PIECES = 10_000
#: more pieces than this, with fewer samples than this on average, are no uniform sampling
MANY = 10
#: least samples of a piece that shows the rate of a clock, and most rates of shorter pieces
FEW, MOST_RATES = 32, 3
#: strokes of piezo stages [m]; anything else is the wrong unit
STROKE = (1e-9, 10e-3)
#: spans of a voltage [V]; squares of other spans leave the range of a float64
VOLTAGE = (1e-12, 1e12)
#: share of a motion that a float64 may lose to an offset
LOST = 1e-6
#: largest share of samples without a number that are cut out
MAX_NOT_FINITE = 0.01
#: largest share of displacements without a number; a share `MAX_NOT_FINITE` limits their places
MAX_NOT_MEASURED = 0.3
#: latest time in seconds [s]
MAX_TIME = 1e11


def label_runs(labels: Iterable[str]) -> tuple[list[str], list[int]]:
    """
    Return the label of each stretch and the row at which it begins, from one label a row.

    >>> label_runs(['noise', 'noise', '', 'sine:50Hz'])
    (['noise', '', 'sine:50Hz'], [0, 2, 3])
    """
    names, starts, row = [], [], 0
    for label, group in itertools.groupby(labels):
        names.append(label)
        starts.append(row)
        row += sum(1 for _ in group)
    return names, starts


def assemble(
    t: ArrayLike,
    v: ArrayLike | None,
    y: ArrayLike | None,
    segments: SegmentStarts | None = None,
    channels: Mapping[str, ArrayLike] | None = None,
    *,
    name: str,
    options: ReadOptions | None = None,
    sample_rate: float | None = None,
    faults: Iterable[Fault] = (),
) -> Record:
    """
    Make a record in SI units of raw columns: time [s], voltage [V] and displacement, shape (n,).

    A `v` or `y` that is None becomes NaN.  `segments` are the label of each stretch and the row
    at which it begins; an empty label means none.  `channels` are further signals, ``v_<name>``
    and ``y_<name>`` the signals of another axis.  The unit of `y` and the limits of `v` in the
    `options` hold for all axes.  The stamps must agree with the `sample_rate` [Hz] that a file
    names.  The record takes over the `faults` of the caller.  DataError for data that need a
    guess.
    """
    options = options or ReadOptions()
    met = list(faults)
    table = _table(t, v, y, segments, channels or {}, name)
    if sample_rate is None:
        table = replace(table, t=unrounded(table, met))
    table = _drop_not_finite(table, name, met)
    if not table.t.size:
        raise DataError(f'{name}: no sample has all its numbers; record again')
    table, epochs = in_order(table, name, met)
    factor = unit_factor('y', options.displacement_unit or 'm')
    if factor != 1.0:
        moved = {k: x for k, x in table.columns.items() if k == 'y' or role_of(k) == 'y'}
        scaled = {k: x / factor for k, x in moved.items()}
        table = replace(table, columns={**table.columns, **scaled})
    _check_limits(table, options.voltage_limits, name)
    _check_ranges(table, options, name)
    pieces = _pieces(table, epochs, name, sample_rate, met)
    return Record(pieces, name, tuple(met))


def _table(
    t: ArrayLike,
    v: ArrayLike | None,
    y: ArrayLike | None,
    segments: SegmentStarts | None,
    channels: Mapping[str, ArrayLike],
    name: str,
) -> OrderedRows:
    columns: dict[str, Array] = {}
    if taken := {'t', 'v', 'y'} & channels.keys():
        raise DataError(f'{name}: a further channel is called {min(taken)}; give it another name')
    signals: dict[Any, Any] = {'t': t, 'v': v, 'y': y, **channels}
    if unnamed := [key for key in signals if not isinstance(key, str)]:
        raise DataError(f'{name}: channels: {unnamed[0]!r} is no name; {NAMED}')
    for key, values in signals.items():
        if values is not None or key == 't':
            columns[key] = real_array(values, f'{name}: {key}')
    shapes = {k: x.shape for k, x in columns.items()}
    if len(set(shapes.values())) > 1 or columns['t'].ndim != 1:
        lengths = ', '.join(f'{k} {"x".join(map(str, s))}' for k, s in shapes.items())
        raise DataError(f'{name}: columns differ in length ({lengths}); give one value a sample')
    n = columns['t'].size
    if n < 2:
        content = 'one sample only' if n else 'no samples'
        raise DataError(f'{name}: {content}; a record needs at least two')
    try:
        names, starts = segments if segments is not None else ((), ())
        names = tuple(names)
        rows = np.asarray(starts if names else (), dtype=np.float64).ravel()
    except (TypeError, ValueError):
        names, rows = (), np.array([np.nan])
    inside = np.all((rows >= 0) & (rows <= n) & (rows == np.floor(rows)))
    are_texts = all(isinstance(label, str) for label in names)
    if rows.size != len(names) or not inside or np.any(np.diff(rows) < 0) or not are_texts:
        raise DataError(
            f'{name}: segments need text labels and one start for each, rising sample indices '
            f'from 0 to {n}'
        )
    empty = np.zeros(0, dtype=np.int64)
    return OrderedRows(columns.pop('t'), columns, names, rows.astype(np.int64), empty)


def _drop_not_finite(table: OrderedRows, name: str, met: list[Fault]) -> OrderedRows:
    """Drop rows without a number; a row that lacks y alone stays, with NaN."""
    finite = np.isfinite(table.t)
    for x in (x for key, x in table.columns.items() if key != 'y'):
        finite &= np.isfinite(x)
    y = table.columns.get('y', table.t)
    unmeasured = finite & ~np.isfinite(y)
    bad = finite.size - int(np.count_nonzero(finite))
    alone = int(np.count_nonzero(unmeasured))
    if not (bad or alone):
        return table
    if bad > MAX_NOT_FINITE * finite.size:
        raise DataError(
            f'{name}: {bad} of {finite.size} samples are NaN or infinite, more than 1 %; '
            'cut the bad stretch out of the file'
        )
    places = len(true_runs(unmeasured))
    if alone > MAX_NOT_MEASURED * finite.size or places > MAX_NOT_FINITE * finite.size:
        raise DataError(
            f'{name}: {alone} of {finite.size} displacements are NaN or infinite, in {places} '
            'places; cut the bad stretch out of the file, or all rows without a displacement'
        )
    where = at_times(table.t[(unmeasured | ~finite) & np.isfinite(table.t)])
    action = 'cut out' if bad else 'left out, its voltage is kept'
    met.append(Fault('not_finite', where, bad + alone, f'{action}, record split there'))
    if alone:
        y = np.where(unmeasured, np.nan, y)
        table = replace(table, columns={**table.columns, 'y': y})
    rows = np.flatnonzero(finite)
    torn = np.flatnonzero(np.diff(rows) > 1) + 1
    return replace(table.take(rows), torn=torn)


def _check_limits(table: OrderedRows, limits: tuple[float, float] | None, name: str) -> None:
    low, high = limits or (-np.inf, np.inf)
    for key, v in table.columns.items():
        if (key != 'v' and role_of(key) != 'v') or (low <= v.min() and v.max() <= high):
            continue
        outside = np.flatnonzero((v < low) | (v > high))
        worst = outside[np.argmax(np.abs(v[outside] - 0.5 * (low + high)))]
        raise DataError(
            f'{name}: {outside.size} samples leave the voltage limits {low:g}..{high:g} V, worst '
            f'{v[worst]:g} V at {table.t[worst]:.6g} s; check the limits or the unit of {key}'
        )


def _check_ranges(table: OrderedRows, options: ReadOptions, name: str) -> None:
    """Refuse times, voltages and strokes that no piezo stage has."""
    unit = options.displacement_unit or 'm'
    ends = {'t': table.t, **table.columns}
    ranges = {k: (float(np.nanmin(x)), float(np.nanmax(x))) for k, x in ends.items() if k in 'tvy'}
    latest = max(map(abs, ranges['t']))
    if latest > MAX_TIME:
        way = f'--time-unit {"1ms" if options.time_unit else "ms"}'
        cure = f'name its unit, as in {way}, or write t in seconds'
        raise DataError(f'{name}: t reaches {latest:.3g} s; {cure}', options=way)
    moved = {k: high - low for k, (low, high) in ranges.items() if k != 't'}
    span = moved.get('v', 0.0)
    idle = span == 0.0  # a stage at rest has no stroke, whatever the unit
    if not (idle or VOLTAGE[0] <= span <= VOLTAGE[1]):
        raise DataError(f'{name}: v spans {span:.3g} V, which is no voltage; write v in volts')
    stroke = moved.get('y')
    if stroke is not None and stroke == 0.0 and not idle:
        raise DataError(f'{name}: the displacement never changes; is the sensor connected?')
    if stroke is not None and (stroke > STROKE[1] or (stroke < STROKE[0] and not idle)):
        read = unit_factor('y', unit)
        for end in ranges['y']:
            rest = table.columns['y'][table.columns['y'] != end]
            if rest.size < table.t.size - 1 and np.ptp(rest) <= STROKE[1] < stroke:
                raise DataError(
                    f'{name}: y is {end * read:.6g} in {table.t.size - rest.size} samples, far '
                    'from all others; if it stands for no reading, leave these cells empty'
                )
        others = {u: stroke * read / factor for u, factor in UNITS['y'].items()}
        fitting = [u for u, s in others.items() if STROKE[0] <= s <= STROKE[1]]
        fitting = [f'1{u}' if options.displacement_unit else u for u in fitting]
        best = next((u for u in fitting if u.endswith('um')), ''.join(fitting[:1]))
        way = f'--displacement-unit {best}' if best else ''
        cure = 'no unit of y makes it one: is it the column of y?'
        if fitting:
            cure = f'name the unit of y with --displacement-unit {" or ".join(fitting)}'
        if split_unit(unit)[0]:
            way, cure = '', 'is the number before the unit right?'
        elif STROKE[0] <= span <= STROKE[1] < stroke:
            swap = 'if v and y are swapped, name their columns, as in --columns v=y,y=v'
            way, cure = '', f'v spans {span:.3g} V; {swap}, else {cure}'
        raise DataError(
            f'{name}: a stroke of {stroke:.3g} m, read in {unit}, is no piezo stage '
            f'(1 nm .. 10 mm); {cure}',
            options=way,
        )
    for key, span in moved.items():
        offset = max(map(abs, ranges[key]))
        if span and offset * np.finfo(np.float64).eps > LOST * span:
            raise DataError(
                f'{name}: {key} lies at {offset:.3g} and moves by {span:.3g}: its digits are '
                'used up by the offset; subtract it where the numbers are made'
            )


def _pieces(
    table: OrderedRows, epochs: list[int], name: str, sample_rate: float | None, met: list[Fault]
) -> tuple[Piece, ...]:
    t = table.t
    resolution = Resolution.of(t)
    parts: list[tuple[int, int]] = []
    for begin, end in zip(epochs, [*epochs[1:], t.size], strict=True):
        # a row that lost its predecessor begins a piece, also on uniform stamps
        torn = table.torn[(table.torn > begin) & (table.torn < end)]
        starts = [begin + start for start, _ in split_uniform(t[begin:end], resolution)]
        marks = np.union1d(starts, torn).astype(np.int64)
        parts.extend(itertools.pairwise([*marks.tolist(), end]))
    if len(parts) > MANY and t.size < MANY * len(parts):
        raise not_uniform(t, len(parts), name)
    if len(parts) > PIECES:
        raise DataError(
            f'{name}: {len(parts)} breaks in time, at most {PIECES} can be met; cut the file'
        )
    # a lone sample has no sampling rate
    short = [a for a, b in parts if b - a < 2]
    parts = [(a, b) for a, b in parts if b - a >= 2]
    if not parts:
        raise DataError(f'{name}: no two samples belong together; check the time column')
    y = table.columns.get('y', t)
    gone = np.isnan(y)
    lone = gone[:-2] & ~gone[1:-1] & gone[2:]
    short += (np.flatnonzero(lone) + 1).tolist()
    if short:
        met.append(Fault('lone_sample', at_times(np.sort(t[short])), len(short), 'dropped'))
    clocks = _clocks(t, parts, resolution, name, sample_rate, met)
    rates = [clock.sample_rate for clock in clocks]
    long = {rate for rate, (a, b) in zip(rates, parts, strict=True) if b - a >= FEW}
    if len({*rates} - long) > MOST_RATES:
        raise not_uniform(t, len(parts), name)
    _report_breaks(table, epochs, parts, rates, met)
    pieces = [_piece(table, p, c) for p, c in zip(parts, clocks, strict=True)]
    if 'y' not in table.columns:
        return tuple(pieces)
    return tuple(part for piece in pieces for part in piece.without(true_runs(np.isnan(piece.y))))


def _clocks(
    t: Array,
    parts: list[tuple[int, int]],
    resolution: Resolution,
    name: str,
    sample_rate: float | None,
    met: list[Fault],
) -> list[Clock]:
    known: dict[float, None] = {} if sample_rate is None else {sample_rate: None}
    clocks: dict[tuple[int, int], Clock] = {}
    for part in sorted(parts, key=lambda p: p[0] - p[1]):
        clocks[part] = clock = fit_clock(t[slice(*part)], resolution, known)
        known[clock.sample_rate] = None
        if clock.sample_rate > MAX_RATE:
            raise DataError(f'{name}: t says {clock.sample_rate:.3g} Hz; write t in seconds')
        if clock.jitter > 0.5:
            raise DataError(
                f'{name}: time stamps from {t[part[0]]:.6g} s stray {clock.jitter:.2g} samples '
                'from a uniform grid; resample on a uniform grid'
            )
    jitter = [c.jitter for c in clocks.values() if c.jitter > 0.01]
    if jitter:
        where = f'up to {max(jitter):.2g} samples'
        met.append(Fault('timing_jitter', where, len(jitter), 'read as uniformly sampled'))
    rates = {c.sample_rate for c in clocks.values()}
    if sample_rate is not None and sample_rate not in rates:
        where = f'named {sample_rate:g} Hz, stamps say {max(rates):g} Hz'
        met.append(Fault('sample_rate', where, 1, 'the stamps are believed'))
    return [clocks[p] for p in parts]


def _report_breaks(
    table: OrderedRows,
    epochs: list[int],
    parts: list[tuple[int, int]],
    rates: list[float],
    met: list[Fault],
) -> None:
    gaps, lost, changes = [], 0.0, []
    reported = {*epochs, *table.torn.tolist()}
    for (old, new), (one, other) in zip(
        itertools.pairwise(rates), itertools.pairwise(parts), strict=True
    ):
        end, start = one[1] - 1, other[0]
        if not reported.isdisjoint(range(end + 1, start + 1)):
            continue
        step = table.t[start] - table.t[end]
        if old != new:
            changes.append(float(table.t[start]))
        if old == new or step > 1.5 / min(old, new):
            gaps.append(float(table.t[end]))
            lost += float(step) - 1 / old
    if gaps:
        where = f'{at_times(np.array(gaps))}, {lost:.3g} s in all'
        met.append(Fault('gap', where, len(gaps), 'record split there'))
    if changes:
        text = ', '.join(f'{rate:g}' for rate in dict.fromkeys(rates))
        where = f'{at_times(np.array(changes))}, between {text} Hz'
        met.append(Fault('rate_change', where, len(changes), 'record split there'))


def _piece(table: OrderedRows, part: tuple[int, int], clock: Clock) -> Piece:
    start, stop = part
    columns = {k: x[start:stop] for k, x in table.columns.items()}
    segments: list[Segment] = []
    starts = table.starts
    low = max(int(np.searchsorted(starts, start, 'right')) - 1, 0)
    for i in range(low, int(np.searchsorted(starts, stop))):
        end = int(starts[i + 1]) if i + 1 < starts.size else stop
        a, b = max(int(starts[i]), start) - start, min(end, stop) - start
        label = table.names[i]
        if a >= b or not label:
            continue
        if segments and segments[-1].label == label and segments[-1].stop == a:
            a = segments.pop().start
        segments.append(Segment(label, a, b))
    v, y = (columns.pop(role, np.full(stop - start, np.nan)) for role in 'vy')
    return Piece(v, y, clock.sample_rate, clock.start_time, tuple(segments), columns)

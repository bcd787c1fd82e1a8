# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What is wrong with measured data though every number in them is in order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
import difflib

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.record.first_rise import rises_first
from piezo_ident.record.ordering import at_times
from piezo_ident.record.record import Fault, KINDS, Piece, Record

Runs = list[tuple[int, int]]

#: samples in a row with one and the same displacement that are no chance
STUCK = 50
#: samples looked at together, so that temporaries stay small beside a long record
_CHUNK = 1 << 20
#: share of its range by which the voltage moves meanwhile
MOVED = 0.01
#: a wild reading is off by this share of the stroke at least, and by so many of the steps that
#: the readings around it take; so many of them are looked at on either side
LEAST, FAR, AROUND = 2e-3, 8.0, 8
#: and by so many codes of a converter, of which noise turns two
CODES = 3.0
#: share of the stroke to either end that is not the middle, of the range of the voltage that moves
#: any stage there
MIDDLE, FIRM = 0.02, 0.03
#: samples in which noise is looked for
WINDOW = 100
#: readings of one value in a row that may be a sensor that hangs
HELD = 10
#: samples in which the step of a converter is looked for, in rows of so many
MOST, MOST_ROW = 2**17, 2**10
#: share of that step by which numbers in a file may be rounded
ROUNDED = 0.07
#: where more of a record than this looks wrong, single readings and ones that are held, it is the
#: way of the data
MAX_WILD, MAX_HELD = 0.05, 0.3
#: changes of a displacement, at least, that tell the rate of its sensor
CHANGES = 100


def without_faults(record: Record) -> Record:
    """
    Return a record without readings that cannot be the stage's.

    Up to three wild or lost readings in a row, among quiet neighbours, are bridged by a straight
    line.  Longer ones, where the sensor hangs or drops out, are left out, and the voltage there is
    kept as that of samples without a number is.  What is found is counted in the faults of the
    record; where nothing is, the same record is returned.
    """
    stroke, span = record.stroke, float(np.ptp(record.voltage_range))
    if stroke == 0.0:
        return record
    pieces: list[Piece] = []
    met: dict[str, list[float]] = {}
    counts: Counter[str] = Counter()
    for piece in record:
        wild = _wild(piece, stroke, span)
        held = [run for run in _held(piece, stroke, span) if not _overlaps(run, wild)]
        # a slow sensor holds every reading
        period = _period(piece.y)
        held = [(a, b) for a, b in held if b - a >= HELD * period or period == 1]
        for runs, is_lost in ((wild, True), (held, False)):
            for a, b in runs:
                name = 'stuck' if not is_lost else 'lost' if piece.y[a] == 0.0 else 'outliers'
                counts[name] += b - a
                met.setdefault(name, []).append(float(piece.time(a, a + 1)[0]))
        pieces += _bridged_over(piece, wild, span).without(held)
    hangs = counts['stuck']
    is_way = hangs > MAX_HELD * record.n or counts.total() - hangs > MAX_WILD * record.n
    if not counts.total() or is_way or not pieces:
        return record
    faults = [
        Fault(
            name,
            at_times(np.array(times)),
            counts[name],
            'left out, its voltage is kept, record split there'
            if name == 'stuck'
            else 'left out, bridged',
        )
        for name, times in met.items()
    ]
    return replace(record, pieces=tuple(pieces), faults=(*record.faults, *faults))


def least_step(y: Array) -> float:
    """Return the least step from one reading [m] to the next, infinite where none moves."""
    steps = np.abs(np.diff(y))
    return float(steps[steps > 0.0].min(initial=np.inf))


def wild_readings(
    error: Array, stroke: float, step: float = np.inf, measured: Array | None = None
) -> NDArray[np.bool_]:
    """
    Return which readings are wild, of measured minus predicted displacement [m].

    What the voltage does is in the prediction; `step` is the `least_step` of what was `measured`.
    A jump of the error is a wild reading only where the measured displacement makes it: a goal out
    of reach jumps as well.

    >>> error = np.array([0.0] * 9 + [1.0] + [0.0] * 9)
    >>> wild_readings(error, stroke=10.0).nonzero()[0]
    array([9])
    >>> bool(wild_readings(error, stroke=10.0, measured=np.zeros(19)).any())
    False
    """
    wild = np.zeros(error.size, dtype=bool)
    floor = max(LEAST * stroke, CODES * step if np.isfinite(step) else 0.0)
    if error.size > 1 and np.abs(np.diff(error)).max() > floor:
        for a, b in _alone(error, floor):
            wild[a:b] = measured is None or _height(measured, a, b) > 0.5 * _height(error, a, b)
    return wild


def _height(x: Array, a: int, b: int) -> float:
    """Return how far numbers lie off the line between their neighbours, at most."""
    line = np.linspace(x[a - 1], x[b], b - a + 2)[1:-1]
    return float(np.abs(x[a:b] - line).max())


def _overlaps(run: tuple[int, int], others: Runs) -> bool:
    return any(run[0] < b and a < run[1] for a, b in others)


def _wild(piece: Piece, stroke: float, span: float) -> Runs:
    """Return up to three readings in a row that stand alone while the voltage says nothing."""
    floor = _floor(piece, stroke)
    found: Runs = []
    for at in range(0, piece.n, _CHUNK):
        start = max(0, at - AROUND - 4)
        y = piece.y[start : at + _CHUNK + AROUND + 4]
        for a, b in _alone(y, floor):
            if start + a < at or start + a >= at + _CHUNK:
                continue
            near = slice(max(0, start + a - AROUND), start + b + AROUND)
            v = np.delete(piece.v[near], np.s_[start + a - near.start : start + b - near.start])
            height = abs(y[a] - y[a - 1])
            # a pulse of the voltage may be answered by one of the stage
            if span == 0.0 or np.ptp(v) / span < 0.5 * height / stroke:
                found.append((start + a, start + b))
    return found


def _alone(y: Array, floor: float) -> Runs:
    """Return runs of up to three numbers that are far from their neighbours on both sides."""
    found: Runs = []
    taken = np.zeros(y.size, dtype=bool)
    steps = np.abs(np.diff(y))
    for length in (1, 2, 3):
        n = y.size - length - 1
        if n < 2:
            break
        before, after = y[:n], y[length + 1 :]
        heights = [
            np.abs(y[1 + j : 1 + j + n] - before - (after - before) * ((j + 1) / (length + 1)))
            for j in range(length)
        ]
        height = np.minimum.reduce(heights)
        likely = (height > floor) & (height > FAR * np.abs(after - before))
        for k in np.flatnonzero(likely) + 1:  # first of the run
            beside = [steps[max(0, k - 1 - AROUND) : k - 1], steps[k + length :][:AROUND]]
            # one more wild reading nearby makes two large steps
            usual = max((float(np.sort(x)[-3:][0]) for x in beside if x.size >= 3), default=np.inf)
            run = slice(k, k + length)
            if height[k - 1] > FAR * usual and not taken[run].any():
                taken[run] = True
                found.append((int(k), int(k) + length))
    return sorted(found)


def _held(piece: Piece, stroke: float, span: float) -> Runs:
    """
    Return where the reading stays at one value, and jumps at the end to make up for it.

    A stage at rest, at the end of its range, or behind a saturated amplifier has no such jump.
    Readings that tremble do not stay in the middle of the range while the voltage moves far; else
    a backlash may hold them.
    """
    y, v = piece.y, piece.v
    floor = _floor(piece, stroke)
    ends = float(y.min()), float(y.max())
    trembles = _trembles(y)
    found: Runs = []
    for a, b in _constant(y, HELD):
        if a == 0 or b == piece.n:
            continue
        steps = np.abs(np.diff(y[max(0, a - AROUND) : a]))
        behind = np.abs(np.diff(y[b : b + AROUND]))
        usual = max(float(x.max(initial=0.0)) for x in (steps, behind))
        entry, leave = float(y[a] - y[a - 1]), float(y[b] - y[b - 1])
        least = max(floor, FAR * usual)
        late = _late(piece, a, b)
        drive = float(np.ptp(v[a:late])) / span if span else 0.0
        around = np.concatenate([v[max(0, a - AROUND) : a], v[b : b + AROUND]])
        outside = abs(float(np.median(v[a:b])) - float(np.median(around))) / span if span else 0.0
        hangs = drive > MOVED and abs(leave) > max(least, 0.3 * drive * stroke)
        if trembles and drive > FIRM and min(abs(y[a] - end) for end in ends) > MIDDLE * stroke:
            # for most of the time, as a delay may be long
            reach = float(np.ptp(np.quantile(v[a:b], (0.1, 0.9)))) / span
            hangs |= b - a >= STUCK and reach > FIRM and 0.3 * reach * stroke > floor
        drops = (
            min(abs(entry), abs(leave)) > least
            and entry * leave < 0.0
            and max(drive, outside) < 0.3 * min(abs(entry), abs(leave)) / stroke
        )
        if hangs or drops:
            # what hangs repeats the last good reading
            found.append((a if drops else a + 1, b))
    return found


def _trembles(y: Array) -> bool:
    """Return whether noise turns the readings, shape (n,), back and forth where they rest."""
    steps = np.diff(y[:_CHUNK])
    # noise below the step of a converter turns two codes at their limit, and holds one between
    far = np.abs(steps[1:]) > 1.5 * quantum_of(y)
    turns = steps[1:] * steps[:-1] < 0.0
    turn, goes_far = (
        x[: x.size // WINDOW * WINDOW].reshape(-1, WINDOW).mean(axis=1) for x in (turns, far)
    )
    return float(np.mean((turn > 0.3) & (goes_far > 0.03))) > 0.02 if turn.size else False


def _late(piece: Piece, a: int, b: int) -> int:
    """Return where a rest of the displacement ends for the voltage, which is ahead by a delay."""
    return b - min((b - a) // 4, round(0.002 * piece.sample_rate))


def _period(y: Array) -> int:
    """Return every how many samples a displacement, shape (n,), has a new reading."""
    changes = np.flatnonzero(np.diff(y))
    return int(np.gcd.reduce(np.diff(changes))) if changes.size > CHANGES else 1


def _floor(piece: Piece, stroke: float) -> float:
    """Return how far a reading must be off at least [m], noise and coarse codes considered."""
    steps = np.abs(np.diff(piece.y[:_CHUNK]))
    moved = steps[steps > 0.0]
    return max(LEAST * stroke, FAR * float(np.median(moved)) if moved.size else 0.0)


def _bridged_over(piece: Piece, runs: Runs, span: float) -> Piece:
    if not runs:
        return piece
    y, v = piece.y.copy(), piece.v.copy()
    for a, b in runs:
        for x, is_wild in ((y, True), (v, False)):
            line = np.linspace(x[a - 1], x[b], b - a + 2)[1:-1]
            steps = np.abs(np.diff(x[max(0, a - AROUND) : a])).max(initial=0.0)
            # a row that was lost as a whole has no voltage either
            if is_wild or np.abs(x[a:b] - line).min() > max(FAR * steps, 0.05 * span):
                x[a:b] = line
    return replace(piece, v=v, y=y)


def line_error(pieces: Iterable[Piece]) -> float:
    """Return the error of the best straight line from v to y, rms in % of stroke."""
    parts = list(pieces)
    v, y = (np.concatenate(x) for x in ([p.v for p in parts], [p.y for p in parts]))
    stroke = float(np.ptp(y))
    if stroke == 0.0:
        return 0.0
    v, y = v - v.mean(), y - y.mean()
    power = float(v @ v)
    error = y - (float(v @ y) / power if power > 0.0 else 0.0) * v
    return 100.0 * float(np.sqrt(np.mean(error**2))) / stroke


def misspelt(labels: Sequence[str]) -> list[str]:
    """Return 'x (did you mean y?)' for every label that is nearly a segment kind."""
    found = []
    for label in labels:
        kind = label.partition(':')[0]
        close = difflib.get_close_matches(kind.strip().lower(), KINDS, n=1, cutoff=0.75)
        if kind not in KINDS and close:
            found.append(f'{label} (did you mean {close[0]}?)')
    return found


def suspicions(record: Record) -> list[str]:
    """Return what a record makes one suspect: a first rise, a sensor at its stop, and the like."""
    return [*_first_rise(record), *_stopped(record), *_slow(record)]


def _first_rise(record: Record) -> list[str]:
    if not any(rises_first(piece) for piece in record):
        return []
    return [
        f'{record.name}: the stage does not come back to where it began at '
        f'{record.pieces[0].v[0]:g} V: it was not driven before, came from beyond that voltage, '
        'or its zero moves. The memory at the start is fitted; a model that runs by itself '
        'begins as a stage that came back. Drive it once over the range, and then record'
    ]


def _slow(record: Record) -> list[str]:
    periods = [(_period(piece.y), _period(piece.v)) for piece in record]
    m = max((y for y, v in periods if v < y), default=1)
    if m == 1:
        return []
    return [
        f'{record.name}: one reading of the displacement stands in {m} samples each: its sensor '
        'is slower than the voltage, and neither delay nor fast motion are those of the stage. '
        f'Record both at one rate, or keep one row in {m}, that with the new reading'
    ]


def _stopped(record: Record) -> list[str]:
    span = float(np.ptp(record.voltage_range))
    levels: list[float] = []
    stuck = noisy = 0
    for piece in record:
        for start, stop in _constant(piece.y):
            v = piece.v[start : _late(piece, start, stop)]
            if np.ptp(v) > MOVED * span:
                levels.append(float(piece.y[start]))
                stuck += stop - start
            # a command does not tremble, a sensor does
            turns = np.diff(v)[1:] * np.diff(v)[:-1] < 0.0
            noisy += stop - start if turns.mean() > 0.3 else 0
    v_rests = any(_constant(piece.v) for piece in record)
    if noisy > 0.02 * record.n and not v_rests:
        return [
            f'{record.name}: the displacement rests exactly while the voltage trembles: are the '
            'columns v and y swapped?'
        ]
    if not levels:
        return []
    others = len(set(levels)) - 1
    return [
        f'{record.name}: the displacement stays at exactly {levels[0]:.9g} m'
        f'{f" and {others} other values" if others else ""} for {stuck} samples while the voltage '
        'moves: the sensor is at its stop, or hangs. Where these cells are empty (NaN), the '
        'model follows the voltage, and is fitted to the rest'
    ]


def _constant(x: Array, least: int = STUCK) -> Runs:
    """Return the stretches of at least so many equal samples."""
    same = np.concatenate([[False], x[1:] == x[:-1], [False]])
    edges = np.flatnonzero(same[1:] != same[:-1]).reshape(-1, 2)
    edges = edges[edges[:, 1] + 1 - edges[:, 0] >= least]
    return [(int(a), int(b) + 1) for a, b in edges]


def quantum_of(y: Array) -> float:
    """Return the step of which all readings y, shape (n,), are multiples; 0 for none."""
    span = float(np.ptp(y))
    if span == 0.0:
        return 0.0
    # neighbours in time differ by few steps, so the rounding of numbers does not add up
    some = _pieces(y)
    jumps = np.abs(np.diff(some))
    # the ends of a clipped range need not be codes
    inner = (some > y.min()) & (some < y.max())
    jumps = jumps[(jumps > 1e-9 * span) & inner[1:] & inner[:-1]]
    usual = float(np.median(jumps)) if jumps.size > 20 else 0.0
    if usual > 0.0 and np.mean(np.abs(jumps - usual) < 1e-6 * usual) > 0.98:
        # one step at a time, and where a sensor hung or samples are missing a whole number of them
        ratio = jumps / usual
        if np.all(np.abs(ratio - np.rint(ratio)) < 1e-3):
            return usual
    jumps, counts = np.unique(np.round(jumps, 18), return_counts=True)
    # a wild reading, which need not be a code, jumps twice
    often = counts > 2
    if counts[often].sum() > max(20, 0.9 * counts.sum()):
        jumps = jumps[often]
        if jumps.size == 1:
            return float(jumps[0])
    if jumps.size < 2 or jumps.size > y.size // 4 + 50:
        return 0.0
    small = jumps[: max(20, jumps.size // 10)]
    step = float(small[0])
    for _ in range(4):
        fitted = step
        # rounded numbers tell the step the better the further they are apart
        for most in (1.5, 5.0, 15.0, 50.0):
            near = small < most * fitted
            whole = np.rint(small[near] / fitted)
            if not whole.any():
                continue
            fitted = float(np.sum(small[near] * whole) / np.sum(whole * whole))
        off = np.abs(small[near] / fitted - whole)
        if near.sum() >= 2 and np.mean(off < ROUNDED) > 0.97:
            return fitted
        # a code in between was never hit: the step divides the differences of differences
        gaps = np.diff(small)
        gaps = gaps[gaps > 0.03 * step]
        if gaps.size == 0 or float(gaps.min()) > 0.97 * step:
            return 0.0
        step = float(gaps.min())
    return 0.0


def _pieces(y: Array) -> Array:
    """Return some whole stretches of a long signal, which tell the step as well."""
    if y.size <= MOST:
        return y
    rows = y[: y.size // MOST_ROW * MOST_ROW].reshape(-1, MOST_ROW)
    return np.asarray(rows[:: max(1, y.size // MOST)].ravel())

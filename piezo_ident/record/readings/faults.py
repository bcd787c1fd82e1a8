# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Mark lost, wild, repeated and stuck readings in one mask.

Such a reading is a number, but no displacement of the stage.  The mask of a piece leaves the
reading out of every fit, error, noise floor and stroke.  A straight line replaces the reading for
filters and regressions, which need all samples.
"""

from __future__ import annotations

from dataclasses import replace
import functools

import numpy as np
from piezo_ident.common.arrays import Array, CHUNK, interpolated, Mask, robust_range, true_runs
from piezo_ident.record.channels import role_of
from piezo_ident.record.ordering import at_times
from piezo_ident.record.readings.jumps import (
    AROUND,
    CODES,
    FAR,
    JUMP,
    Jumps,
    LEAST,
    least_jump,
    RINGS,
)
from piezo_ident.record.record import Fault, Piece, Record
from scipy.special import bdtrc

#: least samples in a row with one displacement that are no chance
STUCK = 50
#: least motion of the voltage while a sensor is stuck, as a share of its range
MOVED = 0.01
#: longest delay of the displacement behind the voltage [s]
DELAY = 0.002
#: share of the stroke at either end that is not its middle
MIDDLE = 0.02
#: share of the range of the voltage that moves any stage in the middle of its stroke
FIRM = 0.03
#: samples of a window for noise
WINDOW = 100
#: least equal readings in a row of a sensor that hangs
HELD = 2 * JUMP
#: repeats are searched in motion with at most this share of repeats by chance, and at least this
#: share of the stroke a sample
CHANCE, CREEPS = 0.01, 3e-5
#: least number of repeats in a moving signal, and least share of the moving samples
REPEATS, REPEATED = 4, 2e-4
#: least share of repeats after which the signal catches up; level of the test against pauses of
#: the motion.  After a pause the signal seems to catch up in half of the cases
MADE_UP, BY_CHANCE = 0.7, 1e-3
#: samples that give the step of a converter, and samples of a row of them
MOST, MOST_ROW = 2**17, 2**10
#: share of that step by which numbers in a file may be rounded
ROUNDED = 0.07
#: largest shares of wild readings, and of held and repeated readings, that count as faults
MAX_WILD, MAX_HELD = 0.15, 0.3
#: most rounds that determine stroke and wild readings in turn
TURNS = 5
#: least changes of a displacement that give the rate of its sensor
CHANGES = 100


def without_faults(record: Record) -> Record:
    """
    Return a record whose masks leave out the readings that are no displacement of the stage.

    A straight line replaces such readings, and the voltage of a row that was lost as a whole; NaN
    replaces them in a channel with the displacement of another axis.  Faults of the record count
    them.  A record without such readings, or with masks, comes back as it is.
    """
    if any(piece.sound is not None for piece in record):
        return record
    names = dict.fromkeys(k for piece in record for k in piece.channels if role_of(k) == 'y')
    return functools.reduce(_without_faults_of, names, _without_own_faults(record))


def _without_faults_of(record: Record, name: str) -> Record:
    """Return a record without the faults of channel `name`, the displacement of another axis."""
    has = [i for i, p in enumerate(record) if np.isfinite(p.channels.get(name, np.nan)).all()]
    if not has:
        return record
    pieces = list(record.pieces)
    own = f'v{name[1:]}'

    def turned(piece: Piece) -> Piece:
        """Return a piece whose first axis is this axis."""
        channels = {**piece.channels, **({own: piece.v} if own in piece.channels else {})}
        v = piece.channels.get(own, piece.v)
        return replace(piece, v=v, y=piece.channels[name], channels=channels, sound=None)

    alone = Record(tuple(turned(pieces[i]) for i in has), record.name)
    judged = _without_own_faults(alone)
    if judged is alone:
        return record
    for i, piece in zip(has, judged, strict=True):
        channels = {**pieces[i].channels, name: piece.measured}
        if own in channels:
            channels[own] = piece.v
        pieces[i] = replace(pieces[i], channels=channels)
    faults = (replace(fault, where=f'in {name} {fault.where}') for fault in judged.faults)
    return replace(record, pieces=tuple(pieces), faults=(*record.faults, *faults))


def _without_own_faults(record: Record) -> Record:
    """Return a record without the faults of its own displacement."""
    if record.stroke == 0.0:
        return record
    span = float(np.ptp(record.voltage_range))
    stroke = record.stroke
    wild = [_wild(piece, stroke, span) for piece in record]
    for _ in range(TURNS):
        # many lost readings widen the range
        both = zip(record, wild, strict=True)
        low, high = robust_range(interpolated(piece.y, bad) for piece, bad in both)
        if high - low > 0.9 * stroke:
            break
        stroke = high - low
        wild = [_wild(piece, stroke, span) for piece in record]
    masks: dict[str, list[Mask]] = {'lost': [], 'outliers': [], 'stuck': [], 'missed_samples': []}
    for piece, bad in zip(record, wild, strict=True):
        rest = replace(piece, y=interpolated(piece.y, bad))
        lost, stuck = bad & (piece.y == 0.0), _held(rest, stroke, span) & ~bad
        kinds = lost, bad & ~lost, stuck, _repeated(rest.y, bad | stuck)
        for each, mask in zip(masks.values(), kinds, strict=True):
            each.append(mask)
    counts = {name: sum(int(mask.sum()) for mask in each) for name, each in masks.items()}
    wilds, hangs = counts['lost'] + counts['outliers'], counts['stuck'] + counts['missed_samples']
    is_way = hangs > MAX_HELD * record.n or wilds > MAX_WILD * record.n
    if is_way or not wilds + hangs:
        return record
    bads = (np.logical_or.reduce(kinds) for kinds in zip(*masks.values(), strict=True))
    pieces = tuple(_masked(p, bad, span) for p, bad in zip(record, bads, strict=True))
    faults = []
    for name, each in masks.items():
        firsts = [(p, a) for p, mask in zip(record, each, strict=True) for a, _ in true_runs(mask)]
        where = at_times(np.array([float(p.time(a, a + 1)[0]) for p, a in firsts]))
        what = {'stuck': 'the sensor hangs, ', 'missed_samples': 'repeat the reading before, '}
        action = f'{what.get(name, "")}left out of every fit and error; the voltage is kept'
        faults += [Fault(name, where, counts[name], action)] if firsts else []
    return replace(record, pieces=pieces, faults=(*record.faults, *faults))


def _masked(piece: Piece, bad: Mask, span: float) -> Piece:
    """Return a piece with a mask, and straight lines for the readings it leaves out."""
    if not bad.any():
        return piece
    v = piece.v
    # a row that was lost as a whole has no voltage either
    rows = bad & (v == 0.0) & (piece.y == 0.0)
    if rows.any():
        line = interpolated(v, rows)
        v = np.where(rows & (np.abs(v - line) > 0.05 * span), line, v)
    return replace(piece, v=v, y=interpolated(piece.y, bad), sound=~bad)


def _wild(piece: Piece, stroke: float, span: float) -> Mask:
    """Mark the readings of a piece that jump away and come back while the voltage does not."""
    y = piece.y
    # steps of the voltages as displacement [m]; other axes may move this axis, too
    asked = np.zeros(y.size)
    others = [x for k, x in piece.channels.items() if role_of(k) == 'v']
    for v, width in ((piece.v, span), *((x, float(np.ptp(x))) for x in others)):
        if width > 0.0:
            steps = np.abs(np.diff(interpolated(v, (v == 0.0) & (y == 0.0)), prepend=v[0]))
            asked = np.maximum(asked, steps * (stroke / width))
    asked[0] = 0.0
    delay = int(np.clip(round(DELAY * piece.sample_rate), 2, RINGS))
    wild = Jumps.of(y, asked, least_jump(y, stroke), stroke, delay).left_out()
    return _marked(y, wild, LEAST * stroke)


def _marked(y: Array, bad: Mask, least: float) -> Mask:
    """Return a mask of the bad readings, and of all readings with a value of many bad ones."""
    values, counts = np.unique(y[bad], return_counts=True)
    values = values[counts >= REPEATS]
    if not values.size:
        return bad
    marked, quantum = bad.copy(), quantum_of(interpolated(y, bad))
    for value in values:
        same = y == value
        # a rest, and a code that the signal passes as it does its neighbours, are no mark
        for a, b in constant(y, HELD):
            jumps = np.abs(y[[a, min(b, y.size - 1)]] - y[[max(a - 1, 0), b - 1]])
            same[a:b] &= bool(jumps.min() > max(least, CODES * quantum))
        beside = np.count_nonzero((np.abs(y - value) <= 2.5 * quantum) & (y != value)) / 4
        if np.count_nonzero(same & ~bad) > REPEATS + 3.0 * beside:
            marked |= same
    return marked


def _held(piece: Piece, stroke: float, span: float) -> Mask:
    """
    Mark readings that stay at one value, and jump to the true displacement at the end.

    A stage at rest, at the end of its range, or behind a saturated amplifier has no such jump.
    Noisy readings that stay in the middle of the range while the voltage moves far hang, too.
    Without noise, backlash may hold readings.
    """
    y, v = piece.y, piece.v
    marked = np.zeros(y.size, dtype=bool)
    # a slow sensor holds every reading
    runs = [(a, b) for a, b in constant(y, HELD * period_of(y)) if a > 0 and b < piece.n]
    if not runs or not span:
        return marked
    floor = least_jump(y, stroke)
    ends = float(y.min()), float(y.max())
    trembles = _trembles(y)
    for a, b in runs:
        beside = np.abs(np.diff(y[max(0, a - AROUND) : a])), np.abs(np.diff(y[b : b + AROUND]))
        usual = max(float(x.max(initial=0.0)) for x in beside)
        entry, leave = float(y[a] - y[a - 1]), float(y[b] - y[b - 1])
        least = max(floor, FAR * usual)
        drive = float(np.ptp(v[a : end_of_rest(piece, a, b)])) / span
        hangs = drive > MOVED and abs(leave) > max(least, 0.3 * drive * stroke)
        if trembles and drive > FIRM and min(abs(y[a] - end) for end in ends) > MIDDLE * stroke:
            # without both ends, as a delay may be long
            reach = float(np.ptp(np.quantile(v[a:b], (0.1, 0.9)))) / span
            hangs |= b - a >= STUCK and reach > FIRM and 0.3 * reach * stroke > floor
        if hangs:
            # the first reading of a run is good, unless it jumped there
            marked[a if abs(entry) > least else a + 1 : b] = True
    return marked


def _trembles(y: Array) -> bool:
    """Return whether noise turns readings at rest, shape (n,), back and forth."""
    steps = np.diff(y[:CHUNK])
    # noise below the step of a converter alternates between two codes, or holds one code
    far = np.abs(steps[1:]) > 1.5 * quantum_of(y)
    turns = steps[1:] * steps[:-1] < 0.0
    turn, goes_far = (
        x[: x.size // WINDOW * WINDOW].reshape(-1, WINDOW).mean(axis=1) for x in (turns, far)
    )
    return float(np.mean((turn > 0.3) & (goes_far > 0.03))) > 0.02 if turn.size else False


def _repeated(y: Array, known: Mask) -> Mask:
    """
    Mark readings that equal the reading before while their neighbours say that y moved.

    The neighbours are the readings before and after the equal ones.
    """
    n = y.size
    marked = np.zeros(n, dtype=bool)
    stroke, q = float(np.ptp(y)), quantum_of(y)
    if n < WINDOW or stroke == 0.0 or period_of(y) > 1:
        return marked
    # third differences leave little of smooth motion
    sigma = max(white_noise(np.diff(y, 3), q), 1e-12 * stroke)
    edges = np.concatenate([[0], np.flatnonzero(np.diff(y) != 0.0) + 1, [n]])
    start, stop = edges[:-1], edges[1:]
    inner = (start >= 1) & (stop < n) & ~known[np.minimum(start + 1, n - 1)]
    start, stop = start[inner], stop[inner]
    slope = np.abs(y[stop] - y[start - 1]) / (stop - start + 1)
    density = q / (np.sqrt(4.0 * np.pi) * sigma)
    # the slope has an error of about half a deviation
    least = 2.0 * np.sqrt(np.log(max(density / CHANCE, 1.0))) + 1.0
    length = stop - start
    # the signal moves before a missed reading, and catches up after it
    sign = np.sign(y[stop] - y[start - 1])
    before, after = sign * (y[start] - y[start - 1]), sign * (y[stop] - y[stop - 1])
    makes_up = (after - before) / np.maximum(length - 1, 1)
    for factor in (1.0, 1.5, 2.5, 4.0):
        moving = slope > factor * max(least * sigma + 1.5 * q, CREEPS * stroke)
        equal = moving & (before > 0.3 * slope) & (length > 1)
        samples, count = int(length[moving].sum()), int((length - 1)[equal].sum())
        distance = np.maximum(slope[moving] - 0.5 * sigma - q, 0.0) / (2.0 * sigma)
        expected = float(np.sum(length[moving] * density * np.exp(-(distance**2))))
        by_chance = 2.0 * expected + 6.0 * np.sqrt(expected)
        if count < max(REPEATS, REPEATED * samples) or count <= by_chance:
            continue
        made = int(np.count_nonzero(makes_up[equal] > 0.3 * slope[equal]))
        pauses = int(np.count_nonzero(equal))
        if made >= MADE_UP * pauses and bdtrc(made - 1, pauses, 0.5) < BY_CHANCE:
            for a, b in zip(start[equal], stop[equal], strict=True):
                marked[a + 1 : b] = True
            return marked
    return marked


def white_noise(third: Array, quantum: float) -> float:
    """Return the rms of the noise of readings, by their third differences and their step."""
    size = np.abs(third) / np.sqrt(20.0)
    if size.size == 0:
        return 0.0
    # quantised readings may repeat more often than not, so a median could be zero
    robust = 1.4826 * float(np.median(size))
    usual = size[size <= max(5.0 * robust, 1.01 * quantum)]
    return float(np.sqrt(np.mean(usual**2))) if usual.size else robust


def end_of_rest(piece: Piece, a: int, b: int) -> int:
    """Return the end of a rest of the displacement, for the voltage, which is ahead."""
    return b - min((b - a) // 4, round(DELAY * piece.sample_rate))


def period_of(y: Array) -> int:
    """Return the number of samples from one new reading of y, shape (n,), to the next."""
    changes = np.flatnonzero(np.diff(y))
    return int(np.gcd.reduce(np.diff(changes))) if changes.size > CHANGES else 1


def constant(x: Array, least: int = STUCK) -> list[tuple[int, int]]:
    """Return the runs of at least so many equal samples."""
    return [(a, b + 1) for a, b in true_runs(x[1:] == x[:-1]) if b + 1 - a >= least]


def quantum_of(y: Array) -> float:
    """Return the converter's step that divides all readings y, shape (n,); 0 without a step."""
    span = float(np.ptp(y))
    if span == 0.0:
        return 0.0
    # some whole stretches of a long signal give the same step
    some = y
    if y.size > MOST:
        rows = y[: y.size // MOST_ROW * MOST_ROW].reshape(-1, MOST_ROW)
        some = rows[:: max(1, y.size // MOST)].ravel()
    # neighbours in time differ by few steps, so the rounding of numbers does not add up
    jumps = np.abs(np.diff(some))
    # the ends of a clipped range need not be codes
    inner = (some > y.min()) & (some < y.max())
    jumps = jumps[(jumps > 1e-9 * span) & inner[1:] & inner[:-1]]
    usual = float(np.median(jumps)) if jumps.size > 20 else 0.0
    if usual > 0.0 and np.mean(np.abs(jumps - usual) < 1e-6 * usual) > 0.98:
        # one step at a time, or a whole number of steps behind missing samples
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
        # rounded numbers far apart give the step better
        for most in (1.5, 5.0, 15.0, 50.0):
            near = small < most * fitted
            whole = np.rint(small[near] / fitted)
            if not whole.any():
                continue
            fitted = float(np.sum(small[near] * whole) / np.sum(whole * whole))
        off = np.abs(small[near] / fitted - whole)
        if near.sum() >= 2 and np.mean(off < ROUNDED) > 0.97:
            return fitted
        # the signal missed a code in between: the step divides differences of differences
        gaps = np.diff(small)
        gaps = gaps[gaps > 0.03 * step]
        if gaps.size == 0 or float(gaps.min()) > 0.97 * step:
            return 0.0
        step = float(gaps.min())
    return 0.0

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Find doubts about a record that leave out no reading.

The first rise of a stage after a rest, or from a lower voltage, has a curve of its own.  The stage
then does not come back to its first position.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import difflib

import numpy as np
from piezo_ident.common.arrays import true_runs
from piezo_ident.record.readings.faults import constant, end_of_rest, MOVED, period_of
from piezo_ident.record.record import KINDS, Piece, Record

#: largest distance of two rests at one voltage, as a share of the range
NEAR = 0.005
#: least seconds and samples of a rest
REST, REST_SAMPLES = 0.05, 10
#: least way of the voltage between the two rests, as a share of the range
AWAY = 0.5
#: least distance of later rests from the first, as a share of the stroke; creep: 0.005 to 0.02
BEYOND = 0.03


def rises_first(piece: Piece) -> bool:
    """
    Return whether a piece begins with a first rise, by its rests at one voltage.

    >>> v = np.repeat([0.0, 100.0, 0.0], 1000)
    >>> y = np.repeat([0.0, 80e-6, 6e-6], 1000)
    >>> rises_first(Piece(v, y, 10e3)), rises_first(Piece(v, 8e-7 * v, 10e3))
    (True, False)
    """
    v, y = piece.v, piece.y
    span = float(np.ptp(v))
    least = max(REST_SAMPLES, round(REST * piece.sample_rate))
    rests = [(a, b) for a, b in true_runs(np.abs(v - v[0]) <= NEAR * span) if b - a >= least]
    if not rests or rests[0][0] > 0:
        return False
    first = float(np.mean(y[: rests[0][1]]))
    away = np.flatnonzero(np.abs(v - v[0]) > AWAY * span)
    # most of the creep is gone at the end of a later rest
    later = [float(np.mean(y[b - least // 2 : b])) for a, b in rests if a > away[:1].sum()]
    if not away.size or not later:
        return False
    out = float(y[np.argmax(np.abs(v - v[0]))]) - first
    least_beyond = min((x - first) * np.sign(out) for x in later)
    return bool(least_beyond > BEYOND * float(np.ptp(y)))


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
    texts = []
    for label in labels:
        kind = label.partition(':')[0]
        close = difflib.get_close_matches(kind.strip().lower(), KINDS, n=1, cutoff=0.75)
        if kind not in KINDS and close:
            texts.append(f'{label} (did you mean {close[0]}?)')
    return texts


def suspicions(record: Record) -> list[str]:
    """Return a text for each doubt: a first rise, a sensor at its stop, a slow sensor."""
    texts = []
    if any(rises_first(piece) for piece in record):
        texts.append(
            f'{record.name}: the stage does not come back to its first position at '
            f'{record.pieces[0].v[0]:g} V. It was not driven before, came from beyond that '
            'voltage, or its zero moves. The memory at the start is fitted; a model that runs by '
            'itself begins as a stage that came back. Drive it once over the range, then record'
        )
    texts += _stopped(record)
    periods = [(period_of(piece.y), period_of(piece.v)) for piece in record]
    m = max((y for y, v in periods if v < y), default=1)
    if m > 1:
        texts.append(
            f'{record.name}: one reading of the displacement stands in {m} samples each: its '
            'sensor is slower than the voltage, and hides the delay and the fast motion of the '
            f'stage. Record both at one rate, or keep one row in {m}, that with the new reading'
        )
    return texts


def _stopped(record: Record) -> list[str]:
    """Return a doubt about a displacement that stays while the voltage moves."""
    span = float(np.ptp(record.voltage_range))
    levels: list[float] = []
    stuck = noisy = 0
    for piece in record:
        for start, stop in constant(piece.y):
            v = piece.v[start : end_of_rest(piece, start, stop)]
            if np.ptp(v) > MOVED * span:
                levels.append(float(piece.y[start]))
                stuck += stop - start
            # a sensor trembles, a command does not
            turns = np.diff(v)[1:] * np.diff(v)[:-1] < 0.0
            noisy += stop - start if turns.mean() > 0.3 else 0
    v_rests = any(constant(piece.v) for piece in record)
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

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What looks wrong with measured data though every number in them is in order."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import difflib

import numpy as np
from numpy.typing import NDArray
from piezo_ident.record.record import KINDS, Piece, Record

__all__ = ['line_error', 'misspelt', 'suspicions']

#: samples in a row with one and the same displacement that are no chance
STUCK = 50
#: samples looked at together, so that temporaries stay small beside a long record
_CHUNK = 1 << 20
#: share of its range by which the voltage moves meanwhile
MOVED = 0.01


def line_error(pieces: Iterable[Piece]) -> float:
    """
    Return the error of the best straight line from v to y, rms in % of stroke.

    Parameters
    ----------
    pieces : iterable of Piece
    """
    parts = [
        (p.v[i : i + _CHUNK], p.y[i : i + _CHUNK]) for p in pieces for i in range(0, p.n, _CHUNK)
    ]
    n = sum(y.size for _, y in parts)
    stroke = max(float(y.max()) for _, y in parts) - min(float(y.min()) for _, y in parts)
    if stroke == 0.0:
        return 0.0
    middle_v, middle_y = (sum(float(part[k].sum()) for part in parts) / n for k in (0, 1))
    power = sum(float(np.sum((v - middle_v) ** 2)) for v, _ in parts)
    cross = sum(float((v - middle_v) @ (y - middle_y)) for v, y in parts)
    slope = cross / power if power > 0.0 else 0.0
    square = sum(float(np.sum((y - middle_y - slope * (v - middle_v)) ** 2)) for v, y in parts)
    return 100.0 * float(np.sqrt(square / n)) / stroke


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
    """
    Return what a record makes one suspect: a sensor at its stop, columns that were swapped.

    Parameters
    ----------
    record : Record
    """
    span = float(np.ptp(record.voltage_range))
    levels: list[float] = []
    stuck = noisy = 0
    for piece in record:
        for start, stop in _constant(piece.y):
            v = piece.v[start:stop]
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
        'moves: the sensor is at its stop, or hangs'
    ]


def _constant(x: NDArray[np.float64]) -> list[tuple[int, int]]:
    """Return the stretches of at least `STUCK` equal samples."""
    edges = np.concatenate([[0], np.flatnonzero(np.diff(x) != 0.0) + 1, [x.size]])
    long = np.flatnonzero(np.diff(edges) >= STUCK)
    return [(int(edges[i]), int(edges[i + 1])) for i in long]

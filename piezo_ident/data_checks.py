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

"""What looks wrong with measured data though every number in them is in order."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import difflib

import numpy as np
from numpy.typing import NDArray
from piezo_ident.record import KINDS, Piece, Record

__all__ = ['line_error', 'misspelt', 'suspicions']

#: samples in a row with one and the same displacement that are no chance
STUCK = 50
#: share of its range by which the voltage moves meanwhile
MOVED = 0.01


def line_error(pieces: Iterable[Piece]) -> float:
    """
    Return the error of the best straight line from v to y, rms in % of stroke.

    Parameters
    ----------
    pieces : iterable of Piece
    """
    pieces = list(pieces)
    v, y = (np.concatenate([getattr(p, name) for p in pieces]) for name in ('v', 'y'))
    dv, dy = v - v.mean(), y - y.mean()
    power = float(dv @ dv)
    slope = float(dv @ dy) / power if power > 0.0 else 0.0
    stroke = float(np.ptp(y))
    return 100.0 * float(np.sqrt(np.mean((dy - slope * dv) ** 2))) / stroke if stroke else 0.0


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

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Whether a stage that begins at its lowest voltage has come down to it.

One that was never driven, or came up from a voltage below, rises for the first time along another
curve, and does not come back to where it was.
"""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import true_runs
from piezo_ident.record.record import Piece

#: share of the voltage's range within which it rests where it began
NEAR = 0.005
#: seconds and samples of a rest, at least
REST, SAMPLES = 0.05, 10
#: share of its range that the voltage goes between the two rests
AWAY = 0.5
#: share of the stroke by which the later rests lie beyond the first; creep leaves 0.005 to 0.02
BEYOND = 0.03


def rises_first(piece: Piece) -> bool:
    """
    Return whether a piece begins with a first rise, as its rests at one voltage tell.

    Examples
    --------
    >>> v = np.repeat([0.0, 100.0, 0.0], 1000)
    >>> y = np.repeat([0.0, 80e-6, 6e-6], 1000)
    >>> rises_first(Piece(v, y, 10e3)), rises_first(Piece(v, 8e-7 * v, 10e3))
    (True, False)
    """
    v, y = piece.v, piece.y
    span = float(np.ptp(v))
    least = max(SAMPLES, round(REST * piece.sample_rate))
    rests = [(a, b) for a, b in true_runs(np.abs(v - v[0]) <= NEAR * span) if b - a >= least]
    if not rests or rests[0][0] > 0:
        return False
    first = float(np.mean(y[: rests[0][1]]))
    away = np.flatnonzero(np.abs(v - v[0]) > AWAY * span)
    # of a later rest its end, when most of the creep has gone
    later = [float(np.mean(y[b - least // 2 : b])) for a, b in rests if a > away[:1].sum()]
    if not away.size or not later:
        return False
    out = float(y[np.argmax(np.abs(v - v[0]))]) - first
    least_beyond = min((x - first) * np.sign(out) for x in later)
    return bool(least_beyond > BEYOND * float(np.ptp(y)))

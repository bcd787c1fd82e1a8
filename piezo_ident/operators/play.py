# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Play operators.

    F_r[v](t) = max(v(t) - r, min(v(t), F_r[v](t-)))        r >= 0                       (eqs. 1-2)

of Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868.  This is the one-sided play: F_r
stays within [v - r, v], and F_0[v] = v.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array
from piezo_ident.operators.kernels import plays


def initial_memory(v0: float, thresholds: ArrayLike) -> Array:
    """
    Compute the play outputs of a stage that last came down to zero and then went to `v0`.

    This is the state ``F_r = 0`` at ``v = 0`` of the paper, moved to `v0` in one stroke.  Voltage
    and thresholds, shape (m,), are normalised.
    """
    r = np.asarray(thresholds, dtype=np.float64)
    return np.maximum(v0 - r, np.minimum(v0, np.zeros_like(r)))


def play_columns(v: ArrayLike, thresholds: ArrayLike, memory: ArrayLike | None = None) -> Array:
    """
    Compute the outputs of plays, shape (m, n), for a normalised input, shape (n,).

    The thresholds, shape (m,), are >= 0.  The memory, shape (m,), are the outputs before the first
    sample; by default `initial_memory` of the first input.

    >>> play_columns([0.0, 1.0, 0.0], [0.25]).tolist()
    [[0.0, 0.75, 0.0]]
    """
    x = np.ascontiguousarray(v, dtype=np.float64)
    r = np.array(thresholds, dtype=np.float64)  # a frozen array would be another type
    start = initial_memory(float(x[0]), r) if memory is None else np.array(memory, np.float64)
    out = np.empty((r.size, x.size))
    plays(x, r, start, out)
    return out

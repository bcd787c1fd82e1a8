# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Hysteresis that widens with speed, for any core: a part of the field is spent on the speed."""

from __future__ import annotations

import numpy as np
from truths.linear import lag

from .cores import Array

#: the speed is smoothed with this corner [Hz]; well below this one [spans/s] it counts as slow
CORNER, SLOW = 600.0, 2.0


def spent_on_speed(u: Array, amount: float, variant: int, rate: float) -> Array:
    """
    Return the part of the drive that speed takes, shape (n,).

    Variant 0 is the excess loss of magnetic cores, amount sqrt(speed) (Bertotti, IEEE Trans.
    Magn. 24 (1988) 621); variant 1 grows as the logarithm, as thermally activated walls do.

    Parameters
    ----------
    u : ndarray, shape (n,)
        In parts of the span.
    amount : float
        Part of the span at 100 spans/s.
    """
    speed = lag(np.diff(u, prepend=u[0]) * rate, CORNER, rate=rate)
    size = np.abs(speed)
    way = speed / (size + 0.1 * SLOW)
    shape = (
        np.sqrt(size / 100.0) if variant == 0 else np.log1p(size / SLOW) / np.log1p(100.0 / SLOW)
    )
    return np.asarray(amount * way * shape)

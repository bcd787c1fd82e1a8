# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Find the samples at which the voltage turns."""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array, Integers

#: a change of direction counts from this share of the range: noise turns all the time
TURN = 0.01


def turns_of(v: Array, least: float) -> Integers:
    """
    Find the indices at which a voltage turns and then moves by `least` [V] the other way.

    >>> turns_of(np.array([0.0, 5.0, 4.9, 6.0, 1.0, 2.0]), 0.5)
    array([3, 4])
    """
    found: list[int] = []
    low = high = 0
    up: bool | None = None
    for i, x in enumerate(v.tolist()):
        if x > v[high]:
            high = i
        if x < v[low]:
            low = i
        if up is not False and x < v[high] - least:
            if up:
                found.append(high)
            up, low = False, i
        elif up is not True and x > v[low] + least:
            if up is False:
                found.append(low)
            up, high = True, i
    return np.array(found, dtype=np.int64)

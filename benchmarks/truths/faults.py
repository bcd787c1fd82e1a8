# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What goes wrong with data on their way into the file."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .table import FAULTS

__all__ = ['spoil']

Array = NDArray[np.float64]


def spoil(
    y: ArrayLike, fault: str, strength: float, rng: np.random.Generator, sample_rate: float = 2e4
) -> Array:
    """
    Return a displacement with a data fault.

    Parameters
    ----------
    y : array_like, shape (n,)
        [m]
    fault : str
        `missed_samples`: readings that repeat the one before, `strength` % of them, in runs of one
        to three.  `timing_jitter`: read early or late by a normal time of `strength` microseconds.
        `quantisation`: steps of `strength` % of the stroke.  `outliers`: `strength` % of the
        readings are off by 2 to 20 % of the stroke.  `clipping`: the top `strength` % of the
        stroke is cut off.
    strength : float
    rng : numpy.random.Generator
    sample_rate : float
        [Hz]

    Raises
    ------
    ValueError
        When the fault is unknown.
    """
    clean = np.asarray(y, dtype=np.float64)
    n, stroke = clean.size, float(np.ptp(clean))
    if fault == 'missed_samples':
        bad = clean.copy()
        starts = 1 + rng.choice(n - 4, max(1, round(0.005 * strength * n)), replace=False)
        for start, length in zip(np.sort(starts), rng.integers(1, 4, starts.size), strict=True):
            bad[start : start + length] = bad[start - 1]
        return bad
    if fault == 'timing_jitter':
        late = rng.standard_normal(n) * strength * 1e-6 * sample_rate
        at = np.clip(np.arange(n) + late, 0, n - 1)
        return np.asarray(np.interp(at, np.arange(n), clean))
    if fault == 'quantisation':
        step = 0.01 * strength * stroke
        return np.asarray(np.floor(clean / step + 0.5) * step)
    if fault == 'outliers':
        bad = clean.copy()
        where = rng.choice(n, max(1, round(0.01 * strength * n)), replace=False)
        sign = rng.choice([-1.0, 1.0], where.size)
        bad[where] += sign * rng.uniform(0.02, 0.2, where.size) * stroke
        return bad
    if fault == 'clipping':
        return np.asarray(np.minimum(clean, clean.max() - 0.01 * strength * stroke))
    raise ValueError(f'no fault {fault!r}; there are {", ".join(FAULTS)}')

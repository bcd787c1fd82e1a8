# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The error numbers, each with its formula."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

__all__ = ['FORMULA', 'fit_percent', 'percent_of_stroke', 'strokes']

#: how `percent_of_stroke` is defined, for tables and files
FORMULA = '100 rms(y - y_hat) / (max y - min y), free run'


def percent_of_stroke(
    y: NDArray[np.float64], y_hat: NDArray[np.float64], stroke: float | None = None
) -> float:
    """
    Return ``100 rms(y - y_hat) / (max y - min y)``.

    Parameters
    ----------
    y, y_hat : ndarray, shape (n,)
        Measured and simulated displacement, same unit.
    stroke : float, optional
        Replaces ``max y - min y``, where a part of a record is judged by the whole.

    Returns
    -------
    float
        Infinite when the stroke is zero and the error is not.
    """
    span = float(np.ptp(y)) if stroke is None else stroke
    rms = float(np.sqrt(np.mean((y - y_hat) ** 2)))
    if span == 0.0:
        return 0.0 if rms == 0.0 else float('inf')
    return 100.0 * rms / span


def strokes(parts: Iterable[tuple[str, NDArray[np.float64]]]) -> dict[str, float]:
    """
    Return ``max y - min y`` of each record over all its parts.

    Between two records a sensor may be set to zero anew, so their strokes are no common one.

    Parameters
    ----------
    parts : iterable of (str, ndarray)
        Name of a record, and displacement of a part of it; empty ones do not count.
    """
    ends: dict[str, tuple[float, float]] = {}
    for record, y in parts:
        if y.size:
            low, high = ends.get(record, (np.inf, -np.inf))
            ends[record] = min(low, float(y.min())), max(high, float(y.max()))
    return {record: high - low for record, (low, high) in ends.items()}


def fit_percent(y: NDArray[np.float64], y_hat: NDArray[np.float64]) -> float:
    """
    Return the NRMSE fit ``100 (1 - |y - y_hat| / |y - mean y|)``, as MATLAB's ``compare`` does.

    Parameters
    ----------
    y, y_hat : ndarray, shape (n,)
        Measured and simulated displacement, same unit.
    """
    spread = float(np.linalg.norm(y - y.mean()))
    error = float(np.linalg.norm(y - y_hat))
    if spread == 0.0:
        return 100.0 if error == 0.0 else float('-inf')
    return 100.0 * (1.0 - error / spread)

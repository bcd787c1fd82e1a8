# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Errors of rows, overall, by segment and by the frequency of a sine, and their noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.diagnosis.results import Errors
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.model.free_run import sine_frequency
from piezo_ident.residual.faults import FaultSearch
from piezo_ident.residual.noise_floor import NoiseFloor

__all__ = ['errors_of', 'row_noise']


def errors_of(rows: Rows, e: NDArray[np.float64], noise: float = 0.0) -> Errors:
    """
    Return the errors of a residual in % of stroke.

    Parameters
    ----------
    e : ndarray, shape (n,)
        Residual of the rows, normalised.
    noise : float, optional
        Mean square that averaging took out of the rows, and that single samples have.
    """

    def percent(part: NDArray[np.float64]) -> float:
        return 100.0 * float(np.sqrt(np.mean(part**2) + noise)) / rows.stroke

    by_segment: dict[str, float] = {}
    of_frequency: dict[float, list[NDArray[np.float64]]] = {}
    for label in dict.fromkeys(rows.label):
        part = e[np.array([x == label for x in rows.label])[rows.block]]
        by_segment[label] = percent(part)
        frequency = sine_frequency(label)
        if frequency is not None:
            of_frequency.setdefault(frequency, []).append(part)
    by_frequency = {
        f'{f:g}': percent(np.concatenate(of_frequency[f])) for f in sorted(of_frequency)
    }
    return Errors(percent(e), by_segment, by_frequency)


def row_noise(floor: NoiseFloor, faults: FaultSearch, m: int, span: float) -> float:
    """Return the mean square of the noise of a row of m samples, normalised by the span [m]."""
    rms = floor.at(m) or 0.0
    # a reading that rests on one step of the converter hides its rounding
    rounding = faults.quantum / np.sqrt(12.0 * m)
    return float(max(rms, rounding) / span) ** 2

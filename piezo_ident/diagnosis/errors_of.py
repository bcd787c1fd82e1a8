# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Errors of rows, overall, by segment and by the frequency of a sine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.diagnosis.fit import Fitted
from piezo_ident.diagnosis.gain import gram_of, solve
from piezo_ident.diagnosis.results import Errors
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.model.free_run import sine_frequency
from piezo_ident.residual.faults import FaultSearch
from piezo_ident.residual.floor import NoiseFloor

__all__ = ['errors_of', 'held_out_residual', 'row_noise']


def held_out_residual(rows: Rows, fitted: Fitted) -> NDArray[np.float64]:
    """
    Return the residual of every row, predicted with parameters that were fitted to other blocks.

    Near the optimum the model is linear in its parameters, so leaving a set of blocks out moves
    them by one Gauss-Newton step.

    Parameters
    ----------
    rows : Rows
    fitted : Fitted

    Returns
    -------
    ndarray, shape (n,)
        Normalised.
    """
    M, prior = fitted.J[:, fitted.free], fitted.prior[fitted.free]
    gram = gram_of(rows, M, fitted.e)
    A, b = gram.A.sum(axis=0), gram.b.sum(axis=0)
    e = fitted.e.copy()
    for one in np.unique(rows.fold):
        out = rows.fold == one
        if out.all():
            continue
        theta = solve(A - gram.A[out].sum(axis=0), b - gram.b[out].sum(axis=0), prior)
        here = out[rows.block]
        e[here] -= M[here] @ theta
    return e


def errors_of(rows: Rows, e: NDArray[np.float64], noise: float = 0.0) -> Errors:
    """
    Return the errors of a residual in % of stroke.

    Parameters
    ----------
    rows : Rows
    e : ndarray, shape (n,)
        Residual of the rows, normalised.
    noise : float, optional
        Mean square that averaging took out of the rows, and that single samples have.
    """

    def percent(part: NDArray[np.float64]) -> float:
        return 100.0 * float(np.sqrt(np.mean(part**2) + noise)) / rows.stroke

    by_segment: dict[str, float] = {}
    by_frequency: dict[str, float] = {}
    frequencies: dict[float, list[NDArray[np.float64]]] = {}
    for label in dict.fromkeys(rows.label):
        part = e[np.array([x == label for x in rows.label])[rows.block]]
        by_segment[label] = percent(part)
        frequency = sine_frequency(label)
        if frequency is not None:
            frequencies.setdefault(frequency, []).append(part)
    for frequency in sorted(frequencies):
        by_frequency[f'{frequency:g}'] = percent(np.concatenate(frequencies[frequency]))
    return Errors(percent(e), by_segment, by_frequency)


def row_noise(floor: NoiseFloor, faults: FaultSearch, m: int, span: float) -> float:
    """Return the mean square of the noise of a row, normalised by the span [m]."""
    rms = floor.at(m) or 0.0
    # a reading that rests on one step of the converter hides its rounding
    rounding = faults.quantum / np.sqrt(12.0 * m)
    return float(max(rms, rounding) / span) ** 2

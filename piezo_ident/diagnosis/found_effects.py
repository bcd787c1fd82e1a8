# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Report the effects that were added, with their shares and parameters."""

from __future__ import annotations

import numpy as np
from piezo_ident.diagnosis.cross_validation import normal_equations, summed
from piezo_ident.diagnosis.joint_fit import Fitted
from piezo_ident.diagnosis.results import FoundEffect, FoundParameter
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.verdict import Findings


def found_effects(rows: Rows, findings: Findings, last: Fitted) -> tuple[FoundEffect, ...]:
    """
    Report the effects that were added, with their parameters in the record with most rows.

    `last` is the fit behind the refined model.
    """
    if not findings.effects:
        return ()
    std = _standard_deviations(rows, last)
    found = []
    for i, (added, gain) in enumerate(zip(last.state.effects, findings.gains, strict=True)):
        values = added.values[rows.longest]
        parameters = {}
        for p in added.effect.parameters:
            keys = [(i, p.name, k) for k in range(np.size(values[p.name]) if p.vector else 1)]
            spread = tuple(std.get(key, 0.0) for key in keys)
            known = any(key in std for key in keys)
            parameters[p.name] = FoundParameter(
                value=_plain(values[p.name]),
                unit=p.unit,
                std=None if not known else spread if p.vector else spread[0],
            )
        found.append(
            FoundEffect(
                name=added.name,
                slot=added.effect.slot,
                share=float(np.clip(gain / findings.explainable, 0.0, 1.0)),
                rms_percent=rows.percent(gain),
                parameters=parameters,
            )
        )
    return tuple(found)


def _standard_deviations(rows: Rows, fitted: Fitted) -> dict[tuple[int | None, str, int], float]:
    """
    Compute the standard deviations of the free parameters in the record with most rows.

    The sandwich estimator treats each block as one observation.  A key holds the place of the
    effect, the name of the parameter, and the index in a vector (0 for a number).
    """
    M = fitted.J
    size = np.linalg.norm(M, axis=0)
    equations = normal_equations(rows, M, fitted.e[:, None])
    # the given H is not an observation, but it holds the parameters that these rows leave open
    A = summed(equations, fitted.pull)[0] / np.outer(size, size)
    A[np.diag_indices_from(A)] += 1e-10
    gradients = equations.b[:, :, 0] / size
    inverse = np.linalg.pinv(A, hermitian=True)
    covariance = inverse @ (gradients.T @ gradients) @ inverse
    deviation = np.full(fitted.free.size, np.nan)
    deviation[fitted.free] = np.sqrt(np.maximum(np.diag(covariance), 0.0)) / size
    first = fitted.free.size - len(fitted.parameters)
    known = {}
    for j, parameter in enumerate(fitted.parameters, start=first):
        if np.isfinite(deviation[j]) and parameter.record in (None, rows.longest):
            # the deviation of a logarithm is relative
            factor = abs(parameter.get(fitted.state)) if parameter.logarithmic else 1.0
            key = (parameter.effect, parameter.name, parameter.index or 0)
            known[key] = float(deviation[j]) * factor
    return known


def _plain(value: object) -> float | str | tuple[float, ...]:
    if isinstance(value, str):
        return value
    array = np.asarray(value, dtype=np.float64)
    return tuple(float(x) for x in array) if array.ndim else float(array)

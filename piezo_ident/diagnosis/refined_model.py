# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Build the refined model from what holds in other records, too; report the added effects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.diagnosis.criteria import MOVED_ZERO
from piezo_ident.diagnosis.decision import FittedSet
from piezo_ident.diagnosis.equations import normal_equations, summed
from piezo_ident.diagnosis.joint_fit import Fitted
from piezo_ident.diagnosis.results import Errors, FORMULA, FoundEffect, FoundParameter
from piezo_ident.diagnosis.rows import centred, means, Rows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import Added, DRIFT, State, TESTED, WANDERS
from piezo_ident.diagnosis.verdict import Findings
from piezo_ident.effects import find_effect
from piezo_ident.model.metrics import expected_error
from piezo_ident.model.stage_model import StageModel

#: smaller weights of H are left out of the refined model, normalised
NOTHING = 1e-9


@dataclass(frozen=True, eq=False)
class Refined:
    """
    Refined model, the state of its fit, and whether the whole model, or its H, stays as given.

    `shifts` holds the movement of the zero of the sensor in each record [m], shape (records,).
    """

    model: StageModel
    state: State
    shifts: Array
    is_given: bool
    h_is_given: bool


def refine(
    simulator: Simulator,
    given: State,
    last: FittedSet,
    findings: Findings,
    errors: tuple[Errors, Errors],
) -> Refined:
    """
    Build the refined model for the user from the last step of the walk and the findings.

    Its file records the errors of the model as given and of the last step, `errors`.
    """
    rows, model = simulator.rows, simulator.model
    fitted, h_is_given = last.fitted, last.way == 'given'
    before = means((rows.x - simulator.run(given)) ** 2, rows.of_record)
    # any wrong model has some mean error, so a shift must be several times the other error
    is_clear = np.abs(given.offsets) > MOVED_ZERO * np.sqrt(before)
    shifts = np.where(is_clear, given.offsets, 0.0)
    if h_is_given and not findings.effects:
        return Refined(model, given, shifts * model.scaling.Y, is_given=True, h_is_given=True)
    # with the effects in the model, smaller shifts are visible
    hidden = _hidden_shifts(simulator, given, fitted, before)
    shifts = np.where(shifts == 0.0, hidden, shifts)
    state = replace(fitted.state, offsets=fitted.state.offsets - shifts)
    kept = _at_given_gain(simulator, given, state)
    # gain and drift in the next record are unknown
    lasts = not findings.effects or not all(find_effect(x).time_driven for x in findings.effects)
    span, (low, high) = model.scaling.range, rows.driven
    if not h_is_given:
        # plays with thresholds beyond the driven range have no weight any more
        is_whole = rows.covers(span)
        span = (min(span[0], low), max(span[1], high)) if is_whole else (low, high)
    told = errors if lasts and kept is state else errors[:1]
    refined = _model(simulator, kept, findings, span, told)
    return Refined(refined, state, shifts * model.scaling.Y, False, h_is_given)


def _at_given_gain(simulator: Simulator, given: State, state: State) -> State:
    """Return a state in which a wandering gain has the mean gain of the model as given."""
    kept = [_elsewhere(added) for added in state.effects]
    if not any(added.name == WANDERS for added in kept):
        return state
    others, state = tuple(added for added in kept if added.name != WANDERS), state.from_rest()
    # the next record need not have the mean gain of these records, so the identified gain stays
    runs = (simulator.run(s) for s in (replace(state, effects=others), given))
    x, known = (centred(run, simulator.rows.of_record) for run in runs)
    gain = float(x @ known / (x @ x)) - 1.0
    effects = (a.changed(None, 'gain', 0, gain) if a.name == WANDERS else a for a in kept)
    return replace(state, effects=tuple(effects))


def _hidden_shifts(simulator: Simulator, given: State, fitted: Fitted, before: Array) -> Array:
    """
    Find hidden shifts of the zero of the sensor, normalised, shape (records,); 0 if none.

    An effect that the given model lacks can imitate a shift.  Two estimates must therefore agree
    in sign: the mean error of the given model, and the displacement at rest relative to the given
    model.  An effect that already acted during the identification distorts at most one of the two.
    The smaller estimate counts.  It must exceed `MOVED_ZERO` times ``min(b, max(r, m))``.  The rms
    errors are b of the given model on these records, r of the fit, and m of the given model as its
    file expects it.  `before` is b^2, shape (records,).
    """
    rows, model, state = simulator.rows, simulator.model, fitted.state
    left = np.sqrt(means(fitted.e**2, rows.of_record))
    missed = np.sqrt(rows.square(expected_error(model) or 0.0))
    limit = MOVED_ZERO * np.minimum(np.sqrt(before), np.maximum(left, missed))
    state = replace(state, effects=tuple(map(_elsewhere, state.effects)))
    models = [simulator.model_of(state, k) for k in range(limit.size)]
    rest = state.offsets + [_at_rest(m) - _at_rest(model) for m in models]
    agreed = np.where(
        given.offsets * rest > 0.0, np.minimum(np.abs(given.offsets), np.abs(rest)), 0
    )
    return np.where(agreed > limit, np.copysign(agreed, rest), 0.0)


def _at_rest(model: StageModel) -> float:
    """Return the displacement at rest at the lowest voltage, without hum and other axes."""
    own = tuple(x for x in model.effects if x.name not in TESTED)
    y = replace(model, effects=own).stream().reset(model.scaling.range[0])
    return float(model.scaling.x(y))


def _model(
    simulator: Simulator,
    state: State,
    findings: Findings,
    span: tuple[float, float],
    errors: tuple[Errors, ...],
) -> StageModel:
    """Build the model of a state, with the parameters of the record that has most rows."""
    rows = simulator.rows
    k = rows.longest
    slim = state.hysteresis.without_idle(NOTHING)
    kept = tuple(_elsewhere(added) for added in state.effects)
    model = simulator.model_of(replace(state, hysteresis=slim, effects=kept), k)
    scaling = model.scaling
    offset = float(state.offsets[k])
    if any(added.name in (DRIFT, WANDERS) for added in state.effects):
        # drift and offset compensate each other, and the next record drifts otherwise
        given = State(simulator.model.hysteresis, np.zeros(len(rows.names)))
        rest = simulator.run(given) - simulator.run(replace(state, effects=kept))
        offset += float(rest[rows.of_record == k].mean())
    moved = replace(scaling, y0=scaling.y0 + offset * scaling.Y, range=span)
    told: dict[str, Any] = {'unit': '% of stroke', 'formula': FORMULA}
    told |= zip(('before', 'after'), (float(e.overall) for e in errors), strict=False)
    if errors:
        told['worst'] = float(max(errors[-1].by_segment.values()))
    own = {
        'verdict': findings.verdict,
        'effects': list(findings.effects),
        'records': list(rows.names),
        'errors': told,
    }
    return replace(model, scaling=moved, identification={**model.identification, 'diagnosis': own})


def _elsewhere(added: Added) -> Added:
    """Return an effect without the parameters that only hold in one record."""
    if not added.effect.time_driven:
        return added
    return Added(added.name, tuple(added.effect.elsewhere(values) for values in added.values))


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

    The sandwich estimator treats each block as one observation.  A key holds the place of an
    effect, the name of a parameter, and an index.
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

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Candidates: what each effect of the catalogue would add to the prediction of these data.

Every candidate is tried by finite differences of the whole model, the effect switched slightly
on.  Its columns are scored by what they gain on held-out blocks beside everything that is in the
model already.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import ModelError
from piezo_ident.diagnosis.criteria import ON_AMPLITUDE
from piezo_ident.diagnosis.cross_validation import (
    block_products,
    held_out_errors,
    held_out_sums,
    normal_equations,
    NormalEquations,
    solve,
    with_columns,
)
from piezo_ident.diagnosis.joint_fit import Fitted
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.simulator import Added, Simulator
from piezo_ident.effects import Effect, Trial, View

__all__ = ['Scored', 'Tick', 'score_trials', 'started']

Array = NDArray[np.float64]

#: called with the share of the work that is done; may raise `Cancelled`
Tick = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Scored:
    """
    One trial of a candidate and what it would gain.

    Attributes
    ----------
    effect : type of Effect
    trial : Trial
    coefficients : ndarray, shape (c,)
        Steps of its columns that fit best.
    errors : ndarray, shape (blocks,)
        Sum of squares of each block, held out in spread sets.
    chance : float
        Largest gain in the sum of squares of a surrogate.
    visible : float
        Share of its columns that everything else in the model cannot make up for.
    is_possible : bool
        False where the data speak against it: an effect without amplitudes that should come out
        of the fit about once, and does not.
    """

    effect: type[Effect]
    trial: Trial
    coefficients: Array
    errors: Array
    chance: float
    visible: float
    is_possible: bool = True


def score_trials(
    simulator: Simulator,
    fitted: Fitted,
    effects: Sequence[type[Effect]],
    lines: Sequence[float],
    surrogates: Array,
    tick: Tick = lambda share: None,
) -> Iterator[Scored]:
    """Score every trial of every effect on the residual of a fit; surrogates (n, k)."""
    rows = simulator.rows
    now = simulator.remember(fitted.state)
    M, e, prior = fitted.J[:, fitted.free], fitted.e, fitted.prior[fitted.free]
    equations = normal_equations(rows, M, e)
    view = _view_of(simulator, lines)
    explained = block_products(rows, M, surrogates)
    squares = np.sum(surrogates**2, axis=0)
    alone = held_out_sums(equations.A, explained, squares, rows.fold, prior)
    trials = [(effect, trial) for effect in effects for trial in effect.trials(view)]
    for done, (effect, trial) in enumerate(trials):
        tick(done / len(trials))
        try:
            C = _columns(simulator, effect, trial, now)
        except ModelError:
            continue
        if not np.all(np.isfinite(C)) or not np.any(C):
            continue
        both = with_columns(rows, equations, M, C, e)
        wide = np.concatenate([prior, np.zeros(C.shape[1])])
        theta = solve(both.A.sum(axis=0), both.b.sum(axis=0), wide)[M.shape[1] :]
        visible = _visible(both, M.shape[1], wide)
        if not trial.moves and not ON_AMPLITUDE[0] <= theta[0] <= ON_AMPLITUDE[1]:
            yield Scored(effect, trial, theta, equations.s, 0.0, visible, False)
            continue
        together = np.concatenate([explained, block_products(rows, C, surrogates)], axis=1)
        with_it = held_out_sums(both.A, together, squares, rows.fold, wide)
        gains = np.maximum(alone - with_it, 0.0)
        errors = held_out_errors(both, rows.fold, wide)
        yield Scored(effect, trial, theta, errors, float(gains.max(initial=0.0)), visible)


def _columns(simulator: Simulator, effect: type[Effect], trial: Trial, now: Array) -> Array:
    """
    Return what an effect would add to the rows for a step of each of its amplitudes.

    Shape (n, c): for an effect that is driven by time, a column for each record and amplitude.
    """
    rows = simulator.rows
    count = len(rows.names)
    columns = []
    for setting in trial.settings():
        column = simulator.added(Added(effect.name, (setting,) * count)) - now
        if effect.time_driven:
            columns += [np.where(rows.of_record == k, column, 0.0) for k in range(count)]
        else:
            columns.append(column)
    return np.stack(columns, axis=1)


def _visible(equations: NormalEquations, p: int, prior: Array) -> float:
    """Return the largest share of a column that the first p columns cannot make."""
    A = equations.A.sum(axis=0)
    shares = []
    for j in range(p, A.shape[0]):
        theta = solve(A[:p, :p], A[:p, j], prior[:p])
        left = A[j, j] - 2.0 * A[:p, j] @ theta + theta @ A[:p, :p] @ theta
        shares.append(float(left / A[j, j]) if A[j, j] > 0.0 else 0.0)
    return max(shares)


def started(rows: Rows, scored: Scored) -> Added:
    """Return the effect with the amplitudes of its score, where a joint fit may start."""
    count = len(rows.names)
    records = range(count) if scored.effect.time_driven else [0]
    values: list[dict[str, Any]] = [dict(scored.trial.values) for _ in range(count)]
    known = {p.name: p for p in scored.effect.parameters}
    c = iter(scored.coefficients)
    for (name, index), step in zip(scored.trial.moves, scored.trial.steps, strict=True):
        for k in records:
            amount = float(next(c)) * step
            for j in [k] if scored.effect.time_driven else range(count):
                if index is None:
                    values[j][name] = float(known[name].clip(values[j][name] + amount))
                else:
                    vector = np.array(values[j][name], dtype=np.float64)
                    vector[index] = known[name].clip(vector[index] + amount)
                    values[j][name] = vector
    return Added(scored.effect.name, tuple(values))


def _view_of(simulator: Simulator, lines: Sequence[float]) -> View:
    rows, model = simulator.rows, simulator.model
    speeds, top = [], 0.0
    channels: dict[str, list[Array]] = {}
    for run in rows.runs:
        # over a row, so that converter steps do not count as speed
        mean = run.u[: run.u.size // rows.m * rows.m].reshape(-1, rows.m).mean(axis=1)
        speeds.append(np.abs(np.diff(mean)) * model.sample_rate / rows.m)
        top = max(top, _highest_frequency(run.u, model.sample_rate))
        for name, x in run.piece.channels.items():
            channels.setdefault(name, []).append(x)
    speed = np.concatenate(speeds)
    moving = speed[speed > 1e-3 * speed.max(initial=0.0)]
    quantiles = np.array([0.1, 0.25, 0.5, 0.75, 0.9, 0.97, 0.99, 0.999])
    # of all records that have it: the axis may rest in one of them
    whole = {name: np.concatenate(parts) for name, parts in channels.items()}
    return View(
        sample_rate=model.sample_rate,
        low=min(float(run.u.min()) for run in rows.runs),
        high=max(float(run.u.max()) for run in rows.runs),
        speeds=np.quantile(moving, quantiles) if moving.size else np.zeros(quantiles.size),
        duration=rows.duration,
        channels={name: (float(x.mean()), float(x.std())) for name, x in whole.items()},
        lines=tuple(lines),
        modes=tuple((m.frequency, m.damping) for m in model.dynamics.modes(model.sample_rate)),
        max_frequency=top,
        thresholds=model.hysteresis.thresholds,
    )


def _highest_frequency(u: Array, rate: float) -> float:
    """Return the frequency below which all but a millionth of the moving power lies."""
    du = np.diff(u)
    if du.size == 0:
        return 0.0
    size = min(du.size, 1 << 17)
    power = np.zeros(size // 2 + 1)
    for start in range(0, du.size - size + 1, size):
        power += np.abs(np.fft.rfft(du[start : start + size])) ** 2
    # power of u, not of its derivative
    frequency = np.fft.rfftfreq(size, 1.0 / rate)
    power[1:] /= frequency[1:] ** 2
    total = np.cumsum(power)
    if total[-1] == 0.0:
        return rate / 2.0
    return float(frequency[int(np.searchsorted(total, (1.0 - 1e-6) * total[-1]))])

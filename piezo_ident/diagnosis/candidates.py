# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Candidates: what each effect of the catalogue would add to the prediction of these data.

Every candidate is tried by finite differences of the whole model, the effect switched slightly
on.  Its columns are scored by what they gain on blocks that were held out, after everything that
a refit of H and of the offsets could do has had its turn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import ModelError
from piezo_ident.diagnosis.gain import (
    block_products,
    chance_errors,
    Gram,
    held_out_errors,
    joined,
    solve,
)
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.simulator import Added, Simulator
from piezo_ident.effects import Effect, Trial, View

__all__ = ['Scored', 'score_trials', 'started', 'view_of']

#: an effect that is either on or off should come out of a fit about once
ONCE = (0.2, 3.0)


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
    errors, transfer : ndarray, shape (blocks,)
        Sum of squares of each block, held out in spread sets and in whole kinds.
    chance : ndarray, shape (turns,)
        What the sum of squares of residuals falls by that have nothing to do with the data.
    visible : float
        Share of its columns that everything else in the model cannot make up for.
    is_possible : bool
        False where the data speak against it: an effect without amplitudes that should come out
        of the fit about once, and does not.
    """

    effect: type[Effect]
    trial: Trial
    coefficients: NDArray[np.float64]
    errors: NDArray[np.float64]
    transfer: NDArray[np.float64]
    chance: NDArray[np.float64]
    visible: float
    is_possible: bool = True


def view_of(simulator: Simulator, lines: Sequence[float] = ()) -> View:
    """Return what effects may know of the data."""
    rows, model = simulator.rows, simulator.model
    speeds, top = [], 0.0
    channels: dict[str, list[NDArray[np.float64]]] = {}
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
    return View(
        sample_rate=model.sample_rate,
        low=min(float(run.u.min()) for run in rows.runs),
        high=max(float(run.u.max()) for run in rows.runs),
        speeds=np.quantile(moving, quantiles) if moving.size else np.zeros(quantiles.size),
        duration=rows.duration,
        # of all that have it: the axis may rest in one of them
        channels={
            name: (float(x.mean()), float(x.std()))
            for name, parts in channels.items()
            for x in (np.concatenate(parts),)
        },
        lines=tuple(lines),
        modes=tuple(model.dynamics.modes(model.sample_rate)),
        max_frequency=top,
        thresholds=model.hysteresis.thresholds,
    )


def _highest_frequency(u: NDArray[np.float64], rate: float) -> float:
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


def columns_of(
    simulator: Simulator, effect: type[Effect], trial: Trial, now: NDArray[np.float64]
) -> NDArray[np.float64]:
    """
    Return what a trial would add to the rows, for a step of each of its amplitudes.

    Parameters
    ----------
    simulator : Simulator
        That remembers a state.
    effect : type of Effect
    trial : Trial
    now : ndarray, shape (n,)
        Prediction of the remembered state.

    Returns
    -------
    ndarray, shape (n, c)
        For an effect that is driven by time, a column a record and amplitude.

    Raises
    ------
    ModelError
        When the effect cannot run on these data.
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


def score_trials(
    simulator: Simulator,
    effects: Sequence[type[Effect]],
    view: View,
    base: tuple[NDArray[np.float64], Gram, NDArray[np.float64]],
    e: NDArray[np.float64],
    now: NDArray[np.float64],
    turned: NDArray[np.float64],
    tick: Callable[[float], None] = lambda share: None,
) -> Iterator[Scored]:
    """
    Score every trial of every effect on a residual.

    Parameters
    ----------
    simulator : Simulator
        That remembers the state of the residual.
    effects : sequence of type of Effect
    view : View
    base : (ndarray, Gram, ndarray)
        Columns of everything that is in the model already, shape (n, p), their products with the
        residual, and the prior of each.
    e : ndarray, shape (n,)
    now : ndarray, shape (n,)
        Prediction of the state.
    turned : ndarray, shape (n, turns)
        The residual moved along in time by any amount.
    tick : callable, optional
        Called with the share done.

    Yields
    ------
    Scored
    """
    rows = simulator.rows
    M, gram, prior = base
    swallowed = block_products(rows, M, turned)
    squares = np.sum(turned**2, axis=0)
    alone = chance_errors(gram.A, swallowed, squares, rows.fold, prior)
    trials = [(effect, trial) for effect in effects for trial in effect.trials(view)]
    for done, (effect, trial) in enumerate(trials):
        tick(done / len(trials))
        try:
            C = columns_of(simulator, effect, trial, now)
        except ModelError:
            continue
        if not np.all(np.isfinite(C)) or not np.any(C):
            continue
        both = joined(rows, gram, M, C, e)
        wide = np.concatenate([prior, np.zeros(C.shape[1])])
        theta = solve(both.A.sum(axis=0), both.b.sum(axis=0), wide)[M.shape[1] :]
        visible = _visible(both, M.shape[1], wide)
        if not trial.moves and not ONCE[0] <= theta[0] <= ONCE[1]:
            nothing = np.zeros(0)
            yield Scored(effect, trial, theta, gram.s, gram.s, nothing, visible, False)
            continue
        turned_b = np.concatenate([swallowed, block_products(rows, C, turned)], axis=1)
        with_it = chance_errors(both.A, turned_b, squares, rows.fold, wide)
        yield Scored(
            effect,
            trial,
            theta,
            held_out_errors(both, rows.fold, wide),
            held_out_errors(both, rows.group, wide),
            np.maximum(alone - with_it, 0.0),
            visible,
        )


def _visible(gram: Gram, p: int, prior: NDArray[np.float64]) -> float:
    """Return the largest share of a column that the first p columns cannot make."""
    A = gram.A.sum(axis=0)
    shares = []
    for j in range(p, A.shape[0]):
        theta = solve(A[:p, :p], A[:p, j], prior[:p])
        left = A[j, j] - 2.0 * A[:p, j] @ theta + theta @ A[:p, :p] @ theta
        shares.append(float(left / A[j, j]) if A[j, j] > 0.0 else 0.0)
    return max(shares)

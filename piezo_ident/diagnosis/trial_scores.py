# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Score the trials of candidates by their gain on held-out data.

A trial is an effect whose other parameters, such as time constants, are fixed.  Each amplitude has
a column: the change of the prediction per small step.  Least squares fits these columns beside the
columns of the model to the residual.  The score is the squared error on held-out blocks.

Trials cannot separate all effects.  Creep and drift must show at rest, where no hysteresis moves.
A drifting gain must show within single motions, where a gain that depends on the kind of motion
stays constant.  There the effect must have the size that was fitted to all data.  The factor

    kappa = 1 + <c, e> / <c, c>

measures this size.  c is the contribution of the effect, and e is the residual with the effect in
the model.  Terms that may differ between rests, or between motions, are projected out of c and e.
kappa must lie within `SHOWS`, beyond `STANDARD_ERRORS`.  The right effect has 1, a wrong one any.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.diagnosis.criteria import SHOWS, STANDARD_ERRORS
from piezo_ident.diagnosis.equations import held_out_errors, normal_equations, solve, with_columns
from piezo_ident.diagnosis.joint_fit import Fitted
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import Added, State
from piezo_ident.effects import Effect, Trial, View
from piezo_ident.effects.trials import number_of
from piezo_ident.fitting.equations import NormalEquations
from piezo_ident.residual.stretches import block_means, rests
from scipy.ndimage import uniform_filter1d

#: accepted range of the fitted amplitude of an effect that is either on or off; 1 is exact
ON_AMPLITUDE = (0.2, 3.0)

#: receives the share of the finished work; may raise `Cancelled`
Tick = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Scored:
    """
    One trial of a candidate and its score.

    Attributes
    ----------
    effect, trial
    coefficients : ndarray, shape (c,)
        Steps of the amplitudes, from the least-squares fit.
    error : float
        Sum of squares of all blocks, held out in interleaved sets.  Infinite for an effect that
        is either on or off if its fitted amplitude is not about one.
    chance : float
        Largest decrease of the sum of squares of a surrogate.
    visible : float
        Share of its columns that the rest of the model cannot imitate.
    """

    effect: type[Effect]
    trial: Trial
    coefficients: Array
    error: float
    chance: float
    visible: float


class TrialColumns:
    """Changes of the rows of one state through trials, computed once for several fits of H."""

    def __init__(self, simulator: Simulator, state: State, lines: Sequence[float]) -> None:
        self.simulator, self.rows = simulator, simulator.rows
        self._state = state
        self._view = _view_of(simulator, lines)
        #: for each effect, its trials that can run, with the places of their settings; then the
        #: change of the rows for each setting, in single precision to save memory
        self._kept: dict[str, tuple[list[tuple[Trial, list[int]]], NDArray[np.float32]]] = {}

    def of(
        self, effect: type[Effect], tick: Callable[[], None]
    ) -> tuple[list[tuple[Trial, Integers]], Array]:
        """
        Return the trials of an effect with the places of their columns, and all columns.

        The columns, shape (n, c), belong to a step of each amplitude, and of an effect of time in
        each record.  A trial that cannot run on these data is left out.
        """
        if effect.name not in self._kept:
            self._kept[effect.name] = self._run(effect, tick)
        trials, added = self._kept[effect.name]
        count = len(self.rows.names) if effect.time_driven else 1
        records = np.arange(count)
        own = [(one, np.add.outer(count * np.array(at), records).ravel()) for one, at in trials]
        if count > 1:
            is_own = self.rows.of_record == records[:, None]
            added = (added[:, None] * is_own).reshape(-1, self.rows.n)
        return own, added.T.astype(np.float64)

    def _run(
        self, effect: type[Effect], tick: Callable[[], None]
    ) -> tuple[list[tuple[Trial, list[int]]], NDArray[np.float32]]:
        rows = self.rows
        known: dict[tuple[bytes, ...], int | None] = {}
        found, trials = list[Array](), list[tuple[Trial, list[int]]]()
        for trial in effect.trials(self._view):
            tick()
            self.simulator.remember(self._state)
            settings = trial.settings()
            keys = [tuple(np.asarray(x).tobytes() for x in one.values()) for one in settings]
            new = {k: one for k, one in zip(keys, settings, strict=True) if k not in known}
            added = (Added(effect.name, (one,) * len(rows.names)) for one in new.values())
            changes = [(self._state.with_effect(one), effect, None) for one in added]
            for key, column in zip(new, self.simulator.varied(changes), strict=True):
                known[key] = None
                if column is not None and np.all(np.isfinite(column)):
                    known[key] = len(found)
                    found.append(column.astype(np.float32))
            places = [place for place in map(known.get, keys) if place is not None]
            if len(places) == len(keys) and any(found[place].any() for place in places):
                trials.append((trial, places))
        return trials, np.array(found, np.float32).reshape(len(found), rows.n)


def score_trials(
    columns: TrialColumns,
    fitted: Fitted,
    effects: Sequence[type[Effect]],
    surrogates: Array,
    tick: Tick = lambda share: None,
) -> Iterator[Scored]:
    """Score every trial of every effect on the residual of a fit; surrogates, shape (n, k)."""
    rows, M, prior = columns.rows, fitted.J, fitted.prior[fitted.free]
    E, p = np.column_stack([fitted.e, surrogates]), M.shape[1]
    known = normal_equations(rows, M, E)
    alone = held_out_errors(known, rows.fold, prior).sum(axis=0)
    for done, effect in enumerate(effects):
        at = partial(tick, done / len(effects))
        trials, C = columns.of(effect, at)
        whole = with_columns(rows, known, M, C, E)
        for trial, places in trials:
            at()
            both = whole.only(np.concatenate([np.arange(p), p + places]))
            wide = np.concatenate([prior, np.zeros(places.size)])
            theta = solve(both.A.sum(axis=0), both.b[:, :, 0].sum(axis=0), wide)[p:]
            visible = _visible(both, p, wide)
            if not trial.moves and not ON_AMPLITUDE[0] <= theta[0] <= ON_AMPLITUDE[1]:
                yield Scored(effect, trial, theta, np.inf, 0.0, visible)
                continue
            errors = held_out_errors(both, rows.fold, wide)
            chance = float((alone - errors.sum(axis=0))[1:].max(initial=0.0))
            yield Scored(effect, trial, theta, float(errors[:, 0].sum()), chance, visible)


def _visible(equations: NormalEquations, p: int, prior: Array) -> float:
    """Compute the largest share of a column that the first p columns cannot imitate."""
    A = equations.A.sum(axis=0)
    shares = []
    for j in range(p, A.shape[0]):
        theta = solve(A[:p, :p], A[:p, j], prior[:p])
        left = A[j, j] - 2.0 * A[:p, j] @ theta + theta @ A[:p, :p] @ theta
        shares.append(float(left / A[j, j]) if A[j, j] > 0.0 else 0.0)
    return max(shares)


def started(rows: Rows, scored: Scored) -> Added:
    """Return the effect with the amplitudes of its score, as a start of a joint fit."""
    effect, trial = scored.effect, scored.trial
    added = Added(effect.name, (trial.values,) * len(rows.names))
    known = {p.name: p for p in effect.parameters}
    steps = iter(scored.coefficients)
    for (name, index), step in zip(trial.moves, trial.steps, strict=True):
        for k in range(len(rows.names)) if effect.time_driven else (None,):
            value = number_of(added.values[k or 0], name, index) + float(next(steps)) * step
            added = added.changed(k, name, index, float(known[name].clip(value)))
    return added


def _view_of(simulator: Simulator, lines: Sequence[float]) -> View:
    rows, model = simulator.rows, simulator.model
    # differences over a row, so that converter steps do not count as speed
    steps = [np.abs(np.diff(block_means(run.u, rows.m))) for run in rows.runs]
    speed = np.concatenate(steps) * model.sample_rate / rows.m
    channels: dict[str, list[Array]] = {}
    for run in rows.runs:
        for name, x in run.piece.channels.items():
            channels.setdefault(name, []).append(x)
    moving = speed[speed > 1e-3 * speed.max(initial=0.0)]
    quantiles = np.array([0.1, 0.25, 0.5, 0.75, 0.9, 0.97, 0.99, 0.999])
    # all records with the channel together, as the axis may rest in one of them
    whole = {name: np.concatenate(parts) for name, parts in channels.items()}
    return View(
        sample_rate=model.sample_rate,
        low=rows.reach[0],
        high=rows.reach[1],
        speeds=np.quantile(moving, quantiles) if moving.size else np.zeros(quantiles.size),
        duration=rows.duration,
        channels={name: (float(x[0]), float(x.std())) for name, x in whole.items()},
        lines=tuple(lines),
        modes=tuple((m.frequency, m.damping) for m in model.dynamics.modes(model.sample_rate)),
        max_frequency=rows.highest_frequency,
        thresholds=model.hysteresis.thresholds,
        judged=rows.judged,
        first=rows.first,
        last=rows.last,
        is_fast=simulator.is_fast,
    )


#: transients of the dynamics have died away after this time at rest [s]
SETTLED = 0.05
#: smallest number of rows of a rest or a motion
FEWEST = 20
#: time over which the mean, size and speed of a motion are computed [s]
LOCAL = 0.25


def shows(simulator: Simulator, fitted: Fitted, noise: float) -> bool:
    """
    Tell whether the last added effect shows, with a plausible size, where it alone acts.

    An effect outside of `_PLACES` always shows.  `noise` is the mean square of the noise of a row.
    """
    if fitted.name not in _PLACES:
        return True
    added = fitted.state.effects[-1]
    if not all(added.effect.is_plausible(values) for values in added.values):
        return False
    rows, state = simulator.rows, fitted.state
    y = simulator.run(state)
    c = y - simulator.run(replace(state, effects=state.effects[:-1]))
    products, sizes = np.zeros(rows.edges.size - 1), np.zeros(rows.edges.size - 1)
    for part, free in _PLACES[fitted.name](rows, y):
        Q = np.linalg.qr(free)[0]
        one, e = (x[part] - Q @ (Q.T @ x[part]) for x in (c, fitted.e))
        products += np.bincount(rows.block[part], one * e, products.size)
        sizes += np.bincount(rows.block[part], one * one, sizes.size)
    size = float(sizes.sum())
    if size <= STANDARD_ERRORS**2 * noise or size == 0.0:
        return False
    kappa = 1.0 + float(products.sum()) / size
    # each block is one observation
    spread = products - (kappa - 1.0) * sizes
    error = float(np.sqrt(spread @ spread)) / size
    low, high = SHOWS
    return low <= kappa <= high and kappa > STANDARD_ERRORS * error


def _at_rest(rows: Rows, y: Array) -> Iterator[tuple[Integers, Array]]:
    """Yield the rows of each rest of the command, with a constant to project out."""
    first = 0
    for run, keep in zip(rows.runs, rows.keep, strict=True):
        number = np.cumsum(keep) - 1 + first
        rate = run.piece.sample_rate
        for start, stop in rests(run.piece.v, rate):
            part = slice(-(-(start + round(SETTLED * rate)) // rows.m), stop // rows.m)
            chosen = number[part][keep[part]]
            if chosen.size >= FEWEST:
                yield chosen, np.ones((chosen.size, 1))
        first += int(keep.sum())


def _in_motion(rows: Rows, y: Array) -> Iterator[tuple[Integers, Array]]:
    """Yield the rows of each run, and columns of a gain by local mean, size and speed."""
    first = 0
    for run, keep in zip(rows.runs, rows.keep, strict=True):
        u = block_means(run.u, rows.m)
        width = max(3, round(LOCAL * run.piece.sample_rate / rows.m))
        mean = uniform_filter1d(u, width)
        size = np.sqrt(np.maximum(uniform_filter1d(u * u, width) - mean * mean, 0.0))
        speed = np.sqrt(np.maximum(uniform_filter1d(np.gradient(u) ** 2, width), 0.0))
        parts = [x[keep] / max(float(np.abs(x).max()), 1e-12) for x in (mean, size, speed)]
        parts.insert(0, np.ones(parts[0].size))
        chosen = np.arange(first, first + parts[0].size)
        squares = [a * b for i, a in enumerate(parts) for b in parts[i:]]
        if chosen.size >= FEWEST * len(squares):
            yield chosen, np.stack([*squares, *(x * y[chosen] for x in squares)], axis=1)
        first += parts[0].size


#: rows, shape (k,), in which an effect alone acts, and columns to project out there, shape (k, p)
_PLACES: dict[str, Callable[[Rows, Array], Iterator[tuple[Integers, Array]]]] = {
    'creep': _at_rest,
    'thermal_drift': _at_rest,
    'gain_drift': _in_motion,
}

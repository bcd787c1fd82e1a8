# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit the weights of H, offsets and effects jointly by the free-run error.

The fit uses Gauss-Newton steps with the damping of Levenberg and Marquardt.  G and the delay stay,
except for a factor near one (`retuning.retuned`).  A larger change of them is an effect, and so a
candidate.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.common.errors import ModelError
from piezo_ident.diagnosis.cross_validation import (
    held_out_errors,
    held_out_residual,
    NormalEquations,
    Pull,
    right_sides,
    with_columns,
)
from piezo_ident.diagnosis.fit_steps import BaseColumns, FitStep, KEPT, next_damping, Scale, WORSE
from piezo_ident.diagnosis.parameters import free_parameters, FreeParameter
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import State
from piezo_ident.operators.hysteresis_law import HysteresisLaw

ITERATIONS, ATTEMPTS, TOLERANCE = 20, 6, 1e-3
#: first damping, as a share of the energy of each column, and smallest damping
DAMPING, LEAST_DAMPING = 1e-4, 1e-9
#: consecutive steps that gain too little of their predicted gain, after which the columns of H are
#: computed again
POOR = 2
#: lowest ratio of a gain to the gain before, as assumed for the forecast of future gains
LEAST_RATIO = 0.5
#: share of the energy of a parameter's column that other kinds of excitation must hold to
#: determine the parameter
FIRM = 0.01
#: expected size of a weight of H, and of its other coefficients, normalised: the prior that keeps
#: collinear plays small
WEIGHT_SPREAD, WIDE_SPREAD = 0.1, 1.0
#: creep of size d from before a record costs a fit as much as an rms error of this times d
EARLIER_COST = 0.003
#: finite difference of a weight of H, normalised
WEIGHT_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class Fitted:
    """
    Result of a joint fit.

    Attributes
    ----------
    state : State
    base : BaseColumns
        Columns that were used for H.
    e : ndarray, shape (n,)
        Residual of the rows, measured minus predicted, normalised.
    moving : ndarray, shape (n, q)
        Derivatives of the prediction by the free parameters.
    free : ndarray of bool, shape (p,)
        Columns that are not on a bound.
    parameters : tuple of FreeParameter
    prior : ndarray, shape (p,)
    errors, transfer : ndarray, shape (blocks,)
        Sum of squares of each block, held out in spread sets and in whole kinds of motion.
    pull : Pull or None
        Normal equations of the information besides the rows, for the free columns.
    """

    state: State
    base: BaseColumns
    e: Array
    moving: Array
    free: Mask
    parameters: tuple[FreeParameter, ...]
    prior: Array
    errors: Array
    transfer: Array
    pull: Pull | None = None

    @property
    def J(self) -> Array:
        """Derivatives by all free numbers: coefficients of H, offsets, parameters."""
        known = self.base.columns.shape[1]
        parts = (self.base.columns.T[self.free[:known]], self.moving.T[self.free[known:]])
        return np.concatenate(parts).T

    @property
    def name(self) -> str:
        """Name of the effect that was added last."""
        return self.state.effects[-1].name

    @property
    def mean_square(self) -> float:
        """Mean square error of the blocks held out in spread sets, normalised."""
        return float(self.errors.sum() / self.e.size)

    @property
    def reached(self) -> float:
        """
        Mean square error of held-out blocks, or of the fit itself if that is larger.

        If the columns belong to another state, the held-out error may promise a step that is
        impossible.
        """
        return max(self.mean_square, float(self.e @ self.e / self.e.size))

    def held_out_residual(self, rows: Rows, sets: Integers | None = None) -> Array:
        """
        Compute the residual of every row with parameters fitted to other blocks; shape (n,).

        The residual is normalised.  Blocks with the same number in `sets` are held out together;
        the default are sets spread over all data.
        """
        prior = self.prior if sets is None else _firm(rows, self.state, self.prior, self.moving)
        sets = rows.fold if sets is None else sets
        return held_out_residual(rows, self.J, self.e, prior[self.free], sets, self.pull)


def fit_base(simulator: Simulator, state: State, law: HysteresisLaw) -> tuple[State, BaseColumns]:
    """Refit H within a law while effects stay; return the state and its columns."""
    rows, m = simulator.rows, law.size
    columns, added = simulator.base_columns(law), simulator.added_columns(state)
    base = BaseColumns.of(rows, np.concatenate([columns, added.T]).T)
    effects = simulator.run(state) - added @ state.only_adds - simulator.bare(state)
    lower, upper = np.full(base.columns.shape[1], -np.inf), np.full(base.columns.shape[1], np.inf)
    lower[:m] = law.lower
    prior = np.zeros(base.columns.shape[1])
    prior[_places_of_decays(state)] = cost_of_decays(rows)
    step = FitStep(base, np.empty((rows.n, 0)), rows.x - effects, prior)
    theta = step.solve(lower, upper)
    return state.with_only_added(theta[m:]).with_coefficients(law, theta[:m]), base


def base_at(simulator: Simulator, state: State) -> BaseColumns:
    """
    Compute the columns of a refit of H in a state with its effects and a retuned G.

    An H without a law stays fixed: the columns are then the additive columns alone.
    """
    rows, added = simulator.rows, simulator.added_columns(state)
    if state.law is None:
        return BaseColumns.of(rows, added)
    simulator.remember(state)
    columns = simulator.columns(state, state.law, WEIGHT_STEP, added.T)
    return BaseColumns.of(rows, columns.T)


def _require_finite(state: State, e: Array, moving: Array) -> None:
    """Raise ModelError if an effect runs away, so that no number is left to fit."""
    if not state.effects:
        return
    with np.errstate(over='ignore', invalid='ignore'):
        squares = np.append(np.einsum('ij,ij->j', moving, moving), e @ e)
    if not np.isfinite(squares).all():
        names = ', '.join(added.name for added in state.effects)
        raise ModelError(f'the model with {names} runs away on these data')


def fit_jointly(
    simulator: Simulator,
    state: State,
    base: BaseColumns,
    *,
    iterations: int = ITERATIONS,
    enough: float = 0.0,
    goal: float = np.inf,
    tick: Callable[[], None] = lambda: None,
    pull_at: Callable[[State, int], Pull] | None = None,
) -> Fitted:
    """
    Fit all free numbers of a state by the free-run error; the thresholds of `base` stay.

    If steps gain too little of their predicted gain, the columns of H are computed again, once.
    The fit ends after a step that lowers the mean square by less than `enough`, and before a step
    that promises less.  It also ends if the remaining steps, with equal or falling gains, would
    not reach the mean square `goal` of the fitted rows.  `tick` is called between the steps, and
    may raise `piezo_ident.common.errors.Cancelled`.  `pull_at` gives information besides the rows,
    for a state and its number of free numbers.  Singular equations raise IdentificationError, and
    an effect that cannot run on these data raises ModelError.
    """
    rows = simulator.rows
    # a fixed H, or an H that is drawn to the given one, leaves changes of its gain to the effects
    free_h = state.law is not None and pull_at is None
    parameters = free_parameters(state, len(rows.names), rows.longest if free_h else None)
    p = base.columns.shape[1] + len(parameters)
    damping, last, poor, old = DAMPING, 0.0, 0, base
    e = rows.x - simulator.remember(state)
    moving = _derivatives(simulator, state, parameters, tick)
    given = pull_at and pull_at(state, p)
    for done in range(iterations):
        _require_finite(state, e, moving)
        prior = _prior(rows, e, p, state, parameters)
        pull = _with_known(state, parameters, prior, given)
        before = _loss(e, pull)
        least = max(TOLERANCE * before, enough * e.size)
        lower, upper = _room(state, parameters, p)
        step = FitStep(base, moving, e, prior, pull)
        aside = moving[:, [_only_adds(state, number) for number in parameters]]
        better, scale = None, Scale(rows, base, state.coefficients, e, aside)
        for failed in range(ATTEMPTS):
            tick()
            delta = step.solve(lower, upper, damping)
            promised = step.gain(delta)
            if promised < least:
                break
            factor = scale.of(moving @ delta[p - len(parameters) :])
            try:
                trial = _moved(state, parameters, delta, lower, factor)
                left = rows.x - simulator.remember(trial)
            except ModelError:
                damping *= WORSE ** (failed + 1)
                continue
            new = pull_at and pull_at(trial, p)
            after = _loss(left, _with_known(trial, parameters, prior, new))
            if np.isfinite(after) and after < before:
                better = trial
                break
            damping *= WORSE ** (failed + 1)
        if better is None:
            break
        gain, more = before - after, iterations - 1 - done
        damping = max(damping * next_damping(gain / promised), LEAST_DAMPING)
        state, e, given = better, left, new
        poor = poor + 1 if gain < KEPT[0] * promised else 0
        may_renew = more > 1 and base is old and state.law is not None
        is_slow = poor > 0 and may_renew
        if poor >= POOR and may_renew:
            # the effects now change H in another way than its columns assume
            base = base_at(simulator, state)
        moving = _derivatives(simulator, state, parameters, tick)
        # a first step, or steps with old columns, say little about later steps
        hopeless = done > 0 and not is_slow and after - _to_come(gain, last, more) > goal * e.size
        if hopeless or gain < least:
            break
        last = gain
    lower, upper = _room(state, parameters, p)
    alive = np.concatenate([np.diag(base.total), np.sum(moving**2, axis=0)]) > 0.0
    free = (lower < -1e-12) & (upper > 1e-12) & alive
    prior = _prior(rows, e, p, state, parameters)
    pull = _with_known(state, parameters, prior, given)
    E = e[:, None]
    known = NormalEquations(base.products, *right_sides(rows, base.columns, E))
    equations = with_columns(rows, known, base.columns, moving, E).only(free)
    own, firm = pull and pull.only(free), _firm(rows, state, prior, moving)
    return Fitted(
        state=state,
        base=base,
        e=e,
        moving=moving,
        free=free,
        parameters=parameters,
        prior=prior,
        errors=held_out_errors(equations, rows.fold, prior[free], own)[:, 0],
        transfer=held_out_errors(equations, rows.group, firm[free], own)[:, 0],
        pull=own,
    )


def _to_come(gain: float, last: float, more: int) -> float:
    """Forecast the gain of `more` steps from the gains of the last two steps."""
    if gain >= last:
        return more * gain
    # the fall between two steps may overestimate the later fall
    ratio = max(gain / last, LEAST_RATIO)
    return gain * min(more, ratio / (1.0 - ratio))


def _loss(e: Array, pull: Pull | None) -> float:
    return float(e @ e) + (0.0 if pull is None else pull.s)


def _firm(rows: Rows, state: State, prior: Array, moving: Array) -> Array:
    """
    Strengthen the prior for parameters that only a left-out kind of excitation determines.

    Example: only a multisine reaches a limit of the slew rate, so other motion leaves the limit
    open.  Creep from earlier motion is determined by the motion at the start of a record alone.
    """
    firm = prior.copy()
    firm[_places_of_decays(state)] += rows.n / FIRM
    firm[prior.size - moving.shape[1] :] += FIRM * np.sum(moving**2, axis=0)
    return firm


def _prior(
    rows: Rows, e: Array, p: int, state: State, parameters: Sequence[FreeParameter]
) -> Array:
    # neighbouring residuals are similar: a block counts as a few observations, not as thousands
    count = e.size / max(1.0, 0.2 * e.size / (rows.edges.size - 1))
    # curves and lags are nearly collinear: only large steps of them have an effect
    plays = 0 if state.law is None else state.law.thresholds.size
    spread, size = np.full(p, np.inf), state.coefficients.size
    spread[:size] = np.where(np.arange(size) < plays, WEIGHT_SPREAD, WIDE_SPREAD)
    spread[p - len(parameters) :] = [number.spread for number in parameters]
    prior: Array = float(e @ e) / count / spread**2
    prior[_places_of_decays(state)] = cost_of_decays(rows)
    return prior


def _places_of_decays(state: State) -> slice:
    """Return the places of creep from earlier motion, behind H and the offsets."""
    first = state.coefficients.size + state.offsets.size
    return slice(first, first + state.earlier.size)


def cost_of_decays(rows: Rows) -> float:
    """Return the weight of the pull of creep from earlier motion towards zero."""
    return rows.n * EARLIER_COST**2


def _with_known(
    state: State, parameters: Sequence[FreeParameter], prior: Array, pull: Pull | None
) -> Pull | None:
    """Add to a pull the pull of numbers known to be small towards zero, weighted by `prior`."""
    p = prior.size
    size = np.zeros(p)
    size[_places_of_decays(state)] = state.earlier.ravel()
    for j, number in enumerate(parameters, start=p - len(parameters)):
        if np.isfinite(number.spread):
            size[j] = number.get(state)
    b, s = -prior * size, float(prior @ size**2)
    if pull is None:
        return Pull(np.zeros((p, p)), b, s) if size.any() else None
    return Pull(pull.A, pull.b + b, pull.s + s)


def _derivatives(
    simulator: Simulator,
    state: State,
    parameters: tuple[FreeParameter, ...],
    tick: Callable[[], None],
) -> Array:
    columns = np.zeros((len(parameters), simulator.rows.n))
    tick()
    steps = [parameter.small(state) for parameter in parameters]
    quick = simulator.filtered(
        [(p.effect, p.name, p.index or 0, s) for p, s in zip(parameters, steps, strict=True)]
    )
    sloped = simulator.sloped([(p.effect, p.name) for p in parameters])
    for j, slope in sloped.items():
        value = parameters[j].get(state)
        quick[j] = slope * value if parameters[j].logarithmic else slope
    others = [(j, p) for j, p in enumerate(parameters) if j not in quick]
    effects = [None if p.effect is None else state.effects[p.effect].effect for _, p in others]
    moved = [
        (p.moved(state, steps[j]), effect, p.record)
        for (j, p), effect in zip(others, effects, strict=True)
    ]
    for j, column in quick.items():
        columns[j] = column
    for (j, _), change in zip(others, simulator.varied(moved), strict=True):
        # a bound that depends on other parameters may forbid a move: the derivative is then zero
        if change is not None:
            columns[j] = change / steps[j]
    return columns.T


def _room(state: State, parameters: tuple[FreeParameter, ...], p: int) -> tuple[Array, Array]:
    lower, upper = np.full(p, -np.inf), np.full(p, np.inf)
    if state.law is not None:
        lower[: state.coefficients.size] = np.minimum(state.law.lower - state.coefficients, 0.0)
    for j, parameter in enumerate(parameters, start=p - len(parameters)):
        lower[j], upper[j] = parameter.room(state)
    return lower, upper


def _only_adds(state: State, parameter: FreeParameter) -> bool:
    """Return whether a parameter belongs to an effect that only adds to the signal."""
    i = parameter.effect
    return i is not None and state.effects[i].effect.change == 'passed'


def _moved(
    state: State, parameters: tuple[FreeParameter, ...], step: Array, lower: Array, factor: float
) -> State:
    """Return the state after a step; `factor` divides steps of H that reach no bound."""
    m, k = state.coefficients.size, state.only_adds.size
    new = state.with_only_added(state.only_adds + step[m : m + k])
    if state.law is not None:
        of_H = np.where(step[:m] > lower[:m], step[:m] / factor, step[:m])
        new = new.with_coefficients(state.law, state.coefficients + of_H)
    for parameter, delta in zip(parameters, step[m + k :], strict=True):
        new = parameter.moved(new, float(delta))
    return new

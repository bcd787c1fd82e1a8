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
    reach : float
        Forecast of the mean square of the rows that more steps would reach; 0 if unknown.
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
    reach: float = 0.0

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
    added = simulator.added_columns(state)
    base = BaseColumns.of(rows, simulator.base_columns(law, added.T).T)
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
    fit = _Fit(simulator, state, base, tick, pull_at)
    last, reach = 0.0, 0.0
    for more in reversed(range(iterations)):
        before = fit.loss
        least = max(TOLERANCE * before, enough * fit.e.size)
        promised = fit.step(least)
        if not promised:
            break
        after = fit.loss
        gain = before - after
        fit.poor = fit.poor + 1 if gain < KEPT[0] * promised else 0
        may_renew = more > 1 and fit.base is base and fit.state.law is not None
        is_slow = fit.poor > 0 and may_renew
        if fit.poor >= POOR and may_renew:
            # the effects now change H in another way than its columns assume
            fit.base = base_at(simulator, fit.state)
        fit.linearise()
        # a first step, or steps with old columns, say little about later steps
        is_known = last > 0.0 and not is_slow
        hopeless = is_known and after - _to_come(gain, last, more) > goal * fit.e.size
        is_steady = is_known and fit.poor == 0
        reach = (after - _to_come(gain, last, ITERATIONS)) / fit.e.size if is_steady else 0.0
        if hopeless or gain < least:
            break
        last = gain
    return fit.result(reach)


class _Fit:
    """
    A fit under way: its state with residual, derivatives and damping.

    `loss` is the sum of squares, with that of the pull.  `poor` counts consecutive steps that
    gained too little of what they promised.
    """

    def __init__(
        self,
        simulator: Simulator,
        state: State,
        base: BaseColumns,
        tick: Callable[[], None],
        pull_at: Callable[[State, int], Pull] | None,
    ) -> None:
        rows = simulator.rows
        # a fixed H, or an H that is drawn to the given one, leaves changes of its gain to the
        # effects
        free_h = state.law is not None and pull_at is None
        self._parameters = free_parameters(
            state, len(rows.names), rows.longest if free_h else None
        )
        self._simulator, self._tick, self._pull_at = simulator, tick, pull_at
        self._p = base.columns.shape[1] + len(self._parameters)
        self._damping = DAMPING
        self.state, self.base, self.poor = state, base, 0
        self.e = rows.x - simulator.remember(state)
        self._given = pull_at and pull_at(state, self._p)
        self.linearise()

    def linearise(self) -> None:
        """Compute the derivatives in the present state."""
        state, parameters = self.state, self._parameters
        self._moving = _derivatives(self._simulator, state, parameters, self._tick)
        self._prior = _prior(self._simulator.rows, self.e, self._p, state, parameters)
        self._pull = _with_known(state, parameters, self._prior, self._given)
        self.loss = _loss(self.e, self._pull)

    def step(self, least: float) -> float:
        """
        Take one step that lowers the loss; return the gain that it promised.

        The result is 0 if a step promises less than `least`, or if no step lowers the loss.
        """
        rows, parameters = self._simulator.rows, self._parameters
        equations = FitStep(self.base, self._moving, self.e, self._prior, self._pull)
        if self.state.effects and not (np.isfinite(self.loss) and equations.is_finite):
            names = ', '.join(added.name for added in self.state.effects)
            raise ModelError(f'the model with {names} runs away on these data')
        lower, upper = _room(self.state, parameters, self._p)
        aside = self._moving[:, [_only_adds(self.state, number) for number in parameters]]
        scale = Scale(rows, self.base, self.state.coefficients, self.e, aside)
        for failed in range(ATTEMPTS):
            self._tick()
            delta = equations.solve(lower, upper, self._damping)
            promised = equations.gain(delta)
            if promised < least:
                break
            factor = scale.of(self._moving @ delta[self._p - len(parameters) :])
            try:
                trial = _moved(self.state, parameters, delta, lower, factor)
                left = rows.x - self._simulator.remember(trial)
            except ModelError:
                self._damping *= WORSE ** (failed + 1)
                continue
            new = self._pull_at and self._pull_at(trial, self._p)
            gain = self.loss - _loss(left, _with_known(trial, parameters, self._prior, new))
            if gain > 0.0:
                self._damping = max(self._damping * next_damping(gain / promised), LEAST_DAMPING)
                self.state, self.e, self._given = trial, left, new
                self.loss -= gain
                return promised
            self._damping *= WORSE ** (failed + 1)
        return 0.0

    def result(self, reach: float) -> Fitted:
        """Compute the errors of held-out blocks; `reach` is that of `Fitted`."""
        rows, base, moving = self._simulator.rows, self.base, self._moving
        lower, upper = _room(self.state, self._parameters, self._p)
        E = self.e[:, None]
        known = NormalEquations(base.products, *right_sides(rows, base.columns, E))
        equations = with_columns(rows, known, base.columns, moving, E)
        is_seen = np.diag(equations.A.sum(axis=0)) > 0.0
        free = (lower < -1e-12) & (upper > 1e-12) & is_seen
        equations, own = equations.only(free), self._pull and self._pull.only(free)
        firm = _firm(rows, self.state, self._prior, moving)
        return Fitted(
            state=self.state,
            base=base,
            e=self.e,
            moving=moving,
            free=free,
            parameters=self._parameters,
            prior=self._prior,
            errors=held_out_errors(equations, rows.fold, self._prior[free], own)[:, 0],
            transfer=held_out_errors(equations, rows.group, firm[free], own)[:, 0],
            pull=own,
            reach=reach,
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

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit the weights of H, offsets and effects jointly by the free-run error.

The damping of the Gauss-Newton steps is that of Levenberg and Marquardt.  G and the delay stay but
for a factor near one (`state.retuned`).  A larger change of them is an effect, so a candidate.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import ParamSpec

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.common.errors import IdentificationError, ModelError
from piezo_ident.diagnosis.equations import (
    BaseColumns,
    FitStep,
    held_out_errors,
    held_out_residual,
    KEPT,
    next_damping,
    Pull,
    right_sides,
    Scale,
    with_columns,
    WORSE,
)
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import (
    cost_of_decays,
    firm,
    free_parameters,
    FreeParameter,
    moved,
    only_adds,
    places_of_decays,
    prior_of,
    room_of,
    State,
    with_known,
)
from piezo_ident.fitting.equations import NormalEquations
from piezo_ident.operators.hysteresis_law import HysteresisLaw

P = ParamSpec('P')

#: attempts of a step with more damping, and smallest gain of a step, as a share of the loss
ATTEMPTS, TOLERANCE = 6, 1e-3
#: first damping, as a share of the energy of each column, and smallest damping
DAMPING, LEAST_DAMPING = 1e-4, 1e-9
#: consecutive steps that gain too little of their predicted gain, after which the columns of H are
#: computed again
POOR = 2
#: lowest ratio of a gain to the gain before, as assumed for the forecast of future gains
LEAST_RATIO = 0.5
#: finite difference of a weight of H, normalised
WEIGHT_STEP = 1e-3
#: most repetitions with fresh columns, and the smallest gain that justifies another one
POLISHING, POLISH = 6, 0.02


@dataclass(frozen=True)
class Until:
    """
    The end of a fit.

    A fit ends after some iterations, and after a step that lowers the mean square by less than
    `enough`.  It also ends if the remaining steps, with equal or falling gains, would not reach
    the mean square `goal` of the fitted rows.
    """

    iterations: int = 20
    enough: float = 0.0
    goal: float = np.inf


@dataclass(frozen=True, eq=False)
class Fitted:
    """
    Result of a joint fit.

    Attributes
    ----------
    state, base : State, BaseColumns
        The fitted state, and the columns of H that the fit used.
    e : ndarray, shape (n,)
        Residual of the rows, measured minus predicted, normalised.
    moving : ndarray, shape (n, q)
        Derivatives of the prediction by the free parameters.
    free : ndarray of bool, shape (p,)
        Columns that are not on a bound.
    parameters, prior : tuple of FreeParameter, ndarray, shape (p,)
    errors, transfer : ndarray, shape (blocks,)
        Sum of squares of each block, held out in interleaved sets and in whole kinds of motion.
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
        """Mean square error of the blocks held out in interleaved sets, normalised."""
        return float(self.errors.sum() / self.e.size)

    def held_out_residual(self, rows: Rows, sets: Integers | None = None) -> Array:
        """
        Compute the residual of every row with parameters fitted to other blocks; shape (n,).

        Blocks with the same number in `sets`, by default interleaved, are held out together.
        """
        prior = self.prior if sets is None else firm(rows, self.state, self.prior, self.moving)
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
    prior[places_of_decays(state)] = cost_of_decays(rows)
    step = FitStep(base, np.empty((rows.n, 0)), rows.x - effects, prior)
    theta = step.solve(lower, upper)
    return state.with_only_added(theta[m:]).with_coefficients(law, theta[:m]), base


def base_at(simulator: Simulator, state: State) -> BaseColumns:
    """Compute the columns of H, if H has a law, and of the offsets in a state."""
    rows, added = simulator.rows, simulator.added_columns(state)
    if state.law is None:
        return BaseColumns.of(rows, added)
    simulator.remember(state)
    columns = simulator.columns(state, state.law, WEIGHT_STEP, added.T)
    return BaseColumns.of(rows, columns.T)


def fit_jointly(
    simulator: Simulator,
    state: State,
    base: BaseColumns | None = None,
    *,
    until: Until = Until(),
    tick: Callable[[], None] = lambda: None,
    pull_at: Callable[[State, int], Pull] | None = None,
) -> Fitted:
    """
    Fit all free numbers of a state by the free-run error; the thresholds of H stay.

    `base` holds the columns of H, by default those of the state.  They are computed again, once,
    if steps gain too little of their predicted gain.  `tick` is called between the steps, and may
    raise `piezo_ident.common.errors.Cancelled`.  `pull_at` gives information besides the rows, for
    a state and its number of free numbers.  Singular equations raise IdentificationError, and an
    effect that cannot run on these data raises ModelError.
    """
    base = base_at(simulator, state) if base is None else base
    fit = _Fit(simulator, state, base, tick, pull_at)
    last, poor = 0.0, 0
    for more in reversed(range(until.iterations)):
        before = fit.loss
        least = max(TOLERANCE * before, until.enough * fit.e.size)
        may_renew = more > 1 and fit.base is base and fit.state.law is not None
        promised = fit.step(least)
        if not promised:
            break
        after = fit.loss
        gain = before - after
        poor = poor + 1 if gain < KEPT[0] * promised else 0
        if poor >= POOR and may_renew:
            # the effects now change H in another way than its columns assume
            fit.base = base_at(simulator, fit.state)
        fit.linearise()
        # a first step, or steps with old columns, say little about later steps
        is_known = last > 0.0 and not (poor and may_renew)
        if is_known and after - _to_come(gain, last, more) > until.goal * fit.e.size:
            break
        if gain < least:
            break
        last = gain
    return fit.result()


def tried(fit: Callable[P, Fitted], *args: P.args, **kwargs: P.kwargs) -> Fitted | None:
    """Fit; None if an effect runs away on these data, or if the equations are singular."""
    with suppress(ModelError, IdentificationError):
        return fit(*args, **kwargs)
    return None


def polished(again: Callable[[State], Fitted | None], fitted: Fitted) -> Fitted:
    """Fit again from the fitted state while the fit works and gains `POLISH` of the error."""
    for _ in range(POLISHING):
        fresh = again(fitted.state)
        if fresh is None or not fresh.mean_square <= (1.0 - POLISH) * fitted.mean_square:
            break
        fitted = fresh
    return fitted


class _Fit:
    """A fit under way; `loss` is the sum of squares of the rows and of the pull."""

    def __init__(
        self,
        simulator: Simulator,
        state: State,
        base: BaseColumns,
        tick: Callable[[], None],
        pull_at: Callable[[State, int], Pull] | None,
    ) -> None:
        rows = simulator.rows
        # a fixed H, or an H that is drawn to the given H, leaves changes of its gain to effects
        free_h = state.law is not None and pull_at is None
        self._parameters = free_parameters(
            state, len(rows.names), rows.longest if free_h else None
        )
        self._simulator, self._tick, self._pull_at = simulator, tick, pull_at
        self._p = base.columns.shape[1] + len(self._parameters)
        self._damping = DAMPING
        self.state, self.base = state, base
        self.e = rows.x - simulator.remember(state)
        self._known = pull_at and pull_at(state, self._p)
        self.linearise()

    def linearise(self) -> None:
        """Compute the derivatives in the present state."""
        state, parameters = self.state, self._parameters
        self._moving = _derivatives(self._simulator, state, parameters, self._tick)
        self._prior = prior_of(self._simulator.rows, self.e, self._p, state, parameters)
        self._pull = with_known(state, parameters, self._prior, self._known)
        self.loss = _loss(self.e, self._pull)

    def step(self, least: float) -> float:
        """Take a step that lowers the loss; return the promised gain, 0 below `least`."""
        rows, parameters = self._simulator.rows, self._parameters
        equations = FitStep(self.base, self._moving, self.e, self._prior, self._pull)
        if self.state.effects and not (np.isfinite(self.loss) and equations.is_finite):
            names = ', '.join(added.name for added in self.state.effects)
            raise ModelError(f'the model with {names} runs away on these data')
        lower, upper = room_of(self.state, parameters, self._p)
        aside = self._moving[:, [only_adds(self.state, number) for number in parameters]]
        scale = Scale(rows, self.base, self.state.coefficients, self.e, aside)
        for failed in range(ATTEMPTS):
            self._tick()
            delta = equations.solve(lower, upper, self._damping)
            promised = equations.gain(delta)
            if promised < least:
                break
            factor = scale.of(self._moving @ delta[self._p - len(parameters) :])
            try:
                trial = moved(self.state, parameters, delta, lower, factor)
                left = rows.x - self._simulator.remember(trial)
            except ModelError:
                self._damping *= WORSE ** (failed + 1)
                continue
            new = self._pull_at and self._pull_at(trial, self._p)
            gain = self.loss - _loss(left, with_known(trial, parameters, self._prior, new))
            if gain > 0.0:
                self._damping = max(self._damping * next_damping(gain / promised), LEAST_DAMPING)
                self.state, self.e, self._known = trial, left, new
                self.loss -= gain
                return promised
            self._damping *= WORSE ** (failed + 1)
        return 0.0

    def result(self) -> Fitted:
        """Compute the errors of held-out blocks."""
        rows, base, moving = self._simulator.rows, self.base, self._moving
        lower, upper = room_of(self.state, self._parameters, self._p)
        E = self.e[:, None]
        known = NormalEquations(base.products, *right_sides(rows, base.columns, E))
        equations = with_columns(rows, known, base.columns, moving, E)
        is_seen = np.diag(equations.A.sum(axis=0)) > 0.0
        free = (lower < -1e-12) & (upper > 1e-12) & is_seen
        equations, own = equations.only(free), self._pull and self._pull.only(free)
        strong = firm(rows, self.state, self._prior, moving)
        return Fitted(
            state=self.state,
            base=base,
            e=self.e,
            moving=moving,
            free=free,
            parameters=self._parameters,
            prior=self._prior,
            errors=held_out_errors(equations, rows.fold, self._prior[free], own)[:, 0],
            transfer=held_out_errors(equations, rows.group, strong[free], own)[:, 0],
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
    # a model that runs away overflows: `_Fit.step` refuses it
    with np.errstate(over='ignore'):
        return float(e @ e) + (0.0 if pull is None else pull.s)


def _derivatives(
    simulator: Simulator,
    state: State,
    parameters: tuple[FreeParameter, ...],
    tick: Callable[[], None],
) -> Array:
    """Compute the derivatives of the rows by the parameters; shape (n, q)."""
    columns = np.zeros((len(parameters), simulator.rows.n))
    tick()
    sloped = simulator.sloped([(p.effect, p.name) for p in parameters])
    for j, slope in sloped.items():
        value = parameters[j].get(state)
        columns[j] = slope * value if parameters[j].logarithmic else slope
    others = [(j, p, p.small(state)) for j, p in enumerate(parameters) if j not in sloped]
    effects = [None if p.effect is None else state.effects[p.effect].effect for _, p, _ in others]
    moved = [
        (p.moved(state, step), effect, p.record)
        for (_, p, step), effect in zip(others, effects, strict=True)
    ]
    for (j, _, step), change in zip(others, simulator.varied(moved), strict=True):
        # a bound that depends on other parameters may forbid a move: the derivative is then zero
        if change is not None:
            columns[j] = change / step
    return columns.T

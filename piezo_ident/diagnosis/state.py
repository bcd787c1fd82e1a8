# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Describe the state of a joint fit, the numbers that the fit may move, and their priors.

The state holds H, the offset of each record, a retuned G, and the effects of a model under study.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.diagnosis.equations import Pull
from piezo_ident.diagnosis.retuning import RETUNING
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.effects import Effect, find_effect
from piezo_ident.effects.trials import number_of, with_number
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import HysteresisLaw

#: effect that continues after the motion has ended
CREEP = 'creep'
#: effect that resembles creep beside an H that is not a sum of plays
DRIFT = 'thermal_drift'
#: effect that is a gain which changes with time
WANDERS = 'gain_drift'
#: effects with tests of their own: lines, and coherence with a further channel
TESTED = ('periodic_disturbance', 'cross_coupling')
#: step of a finite difference in the logarithm of a parameter
LOG_STEP = 1e-2
#: share of the energy of a parameter's column that other kinds of excitation must hold to
#: determine the parameter
FIRM = 0.01
#: expected size of a weight of H, and of its other coefficients, normalised: the prior that keeps
#: collinear plays small
WEIGHT_SPREAD, WIDE_SPREAD = 0.1, 1.0
#: creep of size d from before a record costs a fit as much as an rms error of this times d
EARLIER_COST = 0.003


@dataclass(frozen=True, eq=False)
class Added:
    """
    Effect in the model under study, with its parameters in each record.

    The parameters are the same in all records, unless the effect is driven by time.
    """

    name: str
    values: tuple[Mapping[str, Any], ...]

    def __post_init__(self) -> None:
        frozen = tuple(MappingProxyType(dict(v)) for v in self.values)
        object.__setattr__(self, 'values', frozen)

    @property
    def effect(self) -> type[Effect]:
        """Class of the effect."""
        return find_effect(self.name)

    def changed(self, record: int | None, name: str, index: int | None, value: float) -> Added:
        """Return the effect with one number changed, in one record or in all."""
        return Added(
            self.name,
            tuple(
                with_number(old, name, index, value) if record in (None, k) else old
                for k, old in enumerate(self.values)
            ),
        )


@dataclass(frozen=True, eq=False)
class State:
    """
    Fitted quantities: H, the offset of each record, and the effects added.

    Attributes
    ----------
    hysteresis : Hysteresis
    offsets : ndarray, shape (records,)
        Added to the displacement, normalised.
    effects : tuple of Added
    retuning : tuple of float
        Coefficients of `retuned`; empty if G stays unchanged.
    linear : (Dynamics, Delay) or None
        G and the delay in the place of those of the model.
    law : HysteresisLaw or None
        The law of H; None if H stays fixed.
    coefficients : ndarray, shape (size,)
        Coefficients of H in its law.
    fading : tuple of float
        Time constants of creep that continues in each record from earlier motion [s].
    earlier : ndarray, shape (records, times)
        Amplitudes of this creep at the start of each record, for each time constant, normalised.
    """

    hysteresis: Hysteresis
    offsets: Array
    effects: tuple[Added, ...] = ()
    retuning: tuple[float, ...] = ()
    linear: tuple[Dynamics, Delay] | None = None
    law: HysteresisLaw | None = None
    coefficients: Array = field(default_factory=lambda: np.empty(0))
    fading: tuple[float, ...] = ()
    earlier: Array = field(default_factory=lambda: np.empty(0))

    @property
    def only_adds(self) -> Array:
        """All amplitudes that only add to the displacement, shape (records (1 + times),)."""
        return np.concatenate([self.offsets, self.earlier.ravel()])

    def with_only_added(self, values: Array) -> State:
        """Return the state with other offsets and other creep from earlier motion."""
        k = self.offsets.size
        return replace(self, offsets=values[:k], earlier=values[k:].reshape(self.earlier.shape))

    def with_coefficients(self, law: HysteresisLaw, coefficients: Array) -> State:
        """Return the state with another H of a law."""
        theta = np.maximum(coefficients, law.lower)
        return replace(self, hysteresis=law.hysteresis(theta), law=law, coefficients=theta)

    def without(self, i: int) -> State:
        """Return the state without an effect; without creep, earlier creep is removed, too."""
        rest = replace(self, effects=self.effects[:i] + self.effects[i + 1 :])
        return rest.from_rest() if self.effects[i].name == CREEP else rest

    def from_rest(self) -> State:
        """Return the state without creep from earlier motion."""
        return replace(self, fading=(), earlier=np.empty(0))

    def with_effects_of(self, other: State) -> State:
        """Return the state with the effects and the earlier creep of another state."""
        return replace(self, effects=other.effects, fading=other.fading, earlier=other.earlier)

    def with_effect(self, added: Added) -> State:
        """Return the state with one more effect."""
        return replace(self, effects=(*self.effects, added))


@dataclass(frozen=True)
class FreeParameter:
    """
    One number that the fit may move, in one record or (None) in all records.

    `effect` is the place of its effect in the state, or None for the retuning of G.
    """

    effect: int | None
    record: int | None
    name: str
    index: int | None
    logarithmic: bool
    step: float
    lower: float
    upper: float
    spread: float = float('inf')

    def get(self, state: State) -> float:
        """Return the value of the number."""
        if self.effect is None:
            return state.retuning[self.index or 0]
        return number_of(
            state.effects[self.effect].values[self.record or 0], self.name, self.index
        )

    def small(self, state: State) -> float:
        """Choose a step for a finite difference within the bounds."""
        value = self.get(state)
        if self.logarithmic:
            is_free = self.upper / value >= np.exp(self.step)
        else:
            is_free = self.upper - value >= self.step
        return self.step if is_free else -self.step

    def moved(self, state: State, delta: float) -> State:
        """Return the state after a step within the bounds; relative if logarithmic."""
        value = self.get(state)
        if self.logarithmic:
            value *= float(np.exp(np.clip(delta, -1.0, 1.0)))
        else:
            value += delta
        value = float(np.clip(value, self.lower, self.upper))
        if self.effect is None:
            retuning = list(state.retuning)
            retuning[self.index or 0] = value
            return replace(state, retuning=tuple(retuning))
        effects = list(state.effects)
        effects[self.effect] = effects[self.effect].changed(
            self.record, self.name, self.index, value
        )
        return replace(state, effects=tuple(effects))

    def room(self, state: State) -> tuple[float, float]:
        """Return the largest steps down and up."""
        value = self.get(state)
        if self.logarithmic:
            down = max(-1.0, np.log(max(self.lower, 1e-300) / value))
            return min(down, 0.0), max(min(1.0, np.log(self.upper / value)), 0.0)
        return min(self.lower - value, 0.0), max(self.upper - value, 0.0)


def free_parameters(
    state: State, records: int, longest: int | None = None
) -> tuple[FreeParameter, ...]:
    """
    List every number of the retuning of G and of the effects that the fit may move.

    H can imitate the first number of some effects (`first_stays`).  If H is free, this number
    stays fixed in the record `longest`, so other records count relative to it.  If H is fixed,
    `longest` is None and the number is free in all records.
    """
    found = [
        FreeParameter(None, None, 'retuning', i, False, 1e-3 * size, -size, size)
        for i, size in enumerate(RETUNING[: len(state.retuning)])
    ]
    for i, added in enumerate(state.effects):
        effect = added.effect
        for p in effect.parameters:
            value = added.values[0][p.name]
            if p.scale == 'fixed' or p.kind == 'text':
                continue
            is_log = p.scale == 'log'
            step = LOG_STEP if is_log else (p.step or 1e-3)
            # an effect driven by time has another amplitude in each record
            per_record = effect.time_driven and p.step > 0.0
            for k in range(records) if per_record else (None,):
                held = 1 if p.first_stays and k == longest else 0
                for index in range(held, np.size(value)) if p.vector else (None,):
                    number = number_of(added.values[0], p.name, index)
                    if np.isfinite(number) and not (is_log and number <= 0.0):
                        found.append(
                            FreeParameter(
                                i, k, p.name, index, is_log, step, p.lower, p.upper, p.spread
                            )
                        )
    return tuple(found)


def room_of(state: State, parameters: tuple[FreeParameter, ...], p: int) -> tuple[Array, Array]:
    """Return the largest steps down and up of all p numbers of a fit."""
    lower, upper = np.full(p, -np.inf), np.full(p, np.inf)
    if state.law is not None:
        lower[: state.coefficients.size] = np.minimum(state.law.lower - state.coefficients, 0.0)
    for j, parameter in enumerate(parameters, start=p - len(parameters)):
        lower[j], upper[j] = parameter.room(state)
    return lower, upper


def only_adds(state: State, parameter: FreeParameter) -> bool:
    """Return whether a parameter belongs to an effect that only adds to the signal."""
    i = parameter.effect
    return i is not None and state.effects[i].effect.change == 'passed'


def moved(
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


def prior_of(
    rows: Rows, e: Array, p: int, state: State, parameters: Sequence[FreeParameter]
) -> Array:
    """Compute the prior of p numbers of a fit with residual e: what each must gain to move."""
    # neighbouring residuals are similar: a block counts as a few observations, not as thousands
    count = e.size / max(1.0, 0.2 * e.size / (rows.edges.size - 1))
    # curves and lags are nearly collinear: only large steps of them have an effect
    plays = 0 if state.law is None else state.law.thresholds.size
    spread, size = np.full(p, np.inf), state.coefficients.size
    spread[:size] = np.where(np.arange(size) < plays, WEIGHT_SPREAD, WIDE_SPREAD)
    spread[p - len(parameters) :] = [number.spread for number in parameters]
    prior: Array = float(e @ e) / count / spread**2
    prior[places_of_decays(state)] = cost_of_decays(rows)
    return prior


def firm(rows: Rows, state: State, prior: Array, moving: Array) -> Array:
    """
    Strengthen the prior for parameters that only a left-out kind of excitation determines.

    Example: only a multisine reaches a limit of the slew rate, so other motion leaves the limit
    open.  Creep from earlier motion is determined by the motion at the start of a record alone.
    """
    firm = prior.copy()
    firm[places_of_decays(state)] += rows.n / FIRM
    firm[prior.size - moving.shape[1] :] += FIRM * np.sum(moving**2, axis=0)
    return firm


def places_of_decays(state: State) -> slice:
    """Return the places of creep from earlier motion, behind H and the offsets."""
    first = state.coefficients.size + state.offsets.size
    return slice(first, first + state.earlier.size)


def cost_of_decays(rows: Rows) -> float:
    """Return the weight of the pull of creep from earlier motion towards zero."""
    return rows.n * EARLIER_COST**2


def with_known(
    state: State, parameters: Sequence[FreeParameter], prior: Array, pull: Pull | None
) -> Pull | None:
    """Add to a pull the pull of numbers known to be small towards zero, weighted by `prior`."""
    p = prior.size
    size = np.zeros(p)
    size[places_of_decays(state)] = state.earlier.ravel()
    for j, number in enumerate(parameters, start=p - len(parameters)):
        if np.isfinite(number.spread):
            size[j] = number.get(state)
    b, s = -prior * size, float(prior @ size**2)
    if pull is None:
        return Pull(np.zeros((p, p)), b, s) if size.any() else None
    return Pull(pull.A, pull.b + b, pull.s + s)

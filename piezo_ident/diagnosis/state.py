# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Describe the state of a joint fit, the numbers that the fit may move, and their priors.

The state holds H, the offset of each record, the factor near one of a retuned G, and the effects.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import functools
from types import MappingProxyType
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.diagnosis.equations import Pull
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.effects import Effect, find_effect
from piezo_ident.effects.trials import number_of, with_number
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import HysteresisLaw

#: corner frequencies of the relaxations in a retuned G [Hz]
RELAXATIONS = (15.0, 100.0)
#: bounds of the retuning: samples of delay, their squares, and two relaxations (approximate units)
RETUNING = (20.0, 800.0, 1.0, 1.0)
#: a retuned G follows its law up to this multiple of the highest driven frequency
BEYOND = 4.0
#: largest relative error of the product of G and its factor by rounding
ROUNDING = 1e-4
#: effect that continues after the motion has ended
CREEP = 'creep'
#: effect that is a displacement which changes with time
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
    """Effect under study, with its parameters in each record; only effects of time differ."""

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
        Another G and delay than the model has.
    law, coefficients : HysteresisLaw or None, ndarray, shape (size,)
        The law of H, and H in this law; None if H stays fixed.
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
        """Amplitudes that only add to the displacement; shape (records (1 + times),)."""
        return np.concatenate([self.offsets, self.earlier.ravel()])

    def with_only_added(self, values: Array) -> State:
        """Return the state with other offsets and other creep from earlier motion."""
        k = self.offsets.size
        return replace(self, offsets=values[:k], earlier=values[k:].reshape(self.earlier.shape))

    def with_coefficients(self, law: HysteresisLaw, coefficients: Array) -> State:
        """Return the state with another H of a law."""
        theta = np.maximum(coefficients, law.lower)
        return replace(self, hysteresis=law.hysteresis(theta), law=law, coefficients=theta)

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

    `effect` is the place of its effect in the state; the retuning of G has None.
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

    A free H can imitate the first number of some effects (`first_stays`).  This number then stays
    fixed in the record `longest`, and other records count relative to it.
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
    """Compute the ridge weight of each of p numbers: variance of the residual e over spread^2."""
    # neighbouring residuals are similar: a block counts as five observations, not as thousands
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

    Example: only a multisine reaches a limit of the slew rate.  Only the start of a record
    determines creep from earlier motion.
    """
    stronger = prior.copy()
    stronger[places_of_decays(state)] += rows.n / FIRM
    stronger[prior.size - moving.shape[1] :] += FIRM * np.sum(moving**2, axis=0)
    return stronger


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
    """Add to a pull the prior that draws amplitudes with a spread to zero."""
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


# -- G with a factor near one --------------------------------------------------------------------


@functools.lru_cache(maxsize=64)
def retuning_factor(
    retuning: tuple[float, ...], sample_rate: float, band: float = np.inf
) -> Dynamics:
    """
    Compute the factor of G.

    The factor is ``1 + c_1 D + c_2 D^2 + sum_j c_j (1 - z^-1) / (1 - p_j z^-1)`` with p_j the
    poles of `RELAXATIONS`: a delay, a roll-off, and relaxations.  D is ``1 - z^-1`` up to the band
    [Hz].  Beyond this band the data hold no motion, and D stays constant.  The factor is 1 at
    rest, and c_1 acts like minus a delay in samples at low frequencies.
    """
    c1, c2, c3, c4 = retuning
    D = np.array([1.0, -1.0])
    p = float(np.exp(-2.0 * np.pi * band / sample_rate))
    P, Q = (np.array([1.0, -np.exp(-2.0 * np.pi * f / sample_rate)]) for f in RELAXATIONS)
    limited, B = (1.0 - p) * D, np.array([1.0, -p])
    BB, PQ = np.convolve(B, B), np.convolve(P, Q)
    terms = (
        np.convolve(BB, PQ),
        c1 * np.convolve(np.convolve(limited, B), PQ),
        c2 * np.convolve(np.convolve(limited, limited), PQ),
        c3 * np.convolve(np.convolve(Q, D), BB),
        c4 * np.convolve(np.convolve(P, D), BB),
    )
    factor = np.sum([np.pad(term, (0, 5 - term.size)) for term in terms], axis=0)
    return Dynamics(a=np.convolve(BB, PQ)[1:], b=factor)


def retuned(
    dynamics: Dynamics, retuning: Sequence[float], sample_rate: float, band: float = np.inf
) -> Dynamics:
    """
    Multiply G by its factor; G alone if the product is unstable or loses digits.

    The factor adds four poles near 1.  A G of high order at a high sampling rate leaves too few
    digits for them.
    """
    if not any(retuning):
        return dynamics
    factor = retuning_factor(tuple(retuning), sample_rate, band)
    a = np.convolve([1.0, *dynamics.a], [1.0, *factor.a])[1:]
    product = Dynamics(a=a, b=np.convolve(dynamics.b, factor.b))
    f = np.geomspace(1e-5, 0.4, 60) * sample_rate
    exact = dynamics.response(f, sample_rate) * factor.response(f, sample_rate)
    lost = np.abs(product.response(f, sample_rate) - exact).max() / np.abs(exact).max()
    return product if lost < ROUNDING and product.is_stable else dynamics

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Describe the state of a joint fit: H, offsets, and the effects of a model under study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.effects import Effect, find_effect
from piezo_ident.effects.trials import with_number
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

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a joint fit moves: H, offsets, and effects in a model under study."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.effects import Effect, find_effect
from piezo_ident.effects.trials import with_number
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import HysteresisLaw

#: effect that goes on when the motion has ended
CREEP = 'creep'
#: and the one that it looks like beside an H that is no sum of plays
DRIFT = 'thermal_drift'
#: effect that is a gain which changes with time
WANDERS = 'gain_drift'
#: effects that have a test of their own, by lines and by coherence with a further channel
TESTED = ('periodic_disturbance', 'cross_coupling')


@dataclass(frozen=True, eq=False)
class Added:
    """
    An effect in the model under study, with its parameters in each record.

    They are the same in all, unless the effect is driven by time.
    """

    name: str
    values: tuple[Mapping[str, Any], ...]

    def __post_init__(self) -> None:
        frozen = tuple(MappingProxyType(dict(v)) for v in self.values)
        object.__setattr__(self, 'values', frozen)

    @property
    def effect(self) -> type[Effect]:
        """Its class."""
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
    What is fitted: H, the offset of each record, and the effects added.

    Attributes
    ----------
    hysteresis : Hysteresis
    offsets : ndarray, shape (records,)
        Added to the displacement, normalised.
    effects : tuple of Added
    retuning : tuple of float
        Coefficients of `retuned`, empty where G stays as it is.
    law : HysteresisLaw or None
        The family of H; None for an H that is taken as it is.
    coefficients : ndarray, shape (size,)
        Those of the law.
    fading : tuple of float
        Time constants of what creeps on in each record from motion before it [s].
    earlier : ndarray, shape (records, times)
        What creeps on as each record begins, of each time constant, normalised.
    """

    hysteresis: Hysteresis
    offsets: Array
    effects: tuple[Added, ...] = ()
    retuning: tuple[float, ...] = ()
    law: HysteresisLaw | None = None
    coefficients: Array = field(default_factory=lambda: np.empty(0))
    fading: tuple[float, ...] = ()
    earlier: Array = field(default_factory=lambda: np.empty(0))

    @property
    def only_adds(self) -> Array:
        """All that is added to the displacement of records, shape (records (1 + times),)."""
        return np.concatenate([self.offsets, self.earlier.ravel()])

    def with_only_added(self, values: Array) -> State:
        """Return the state with other offsets and other creep of earlier motion."""
        k = self.offsets.size
        return replace(self, offsets=values[:k], earlier=values[k:].reshape(self.earlier.shape))

    def with_coefficients(self, law: HysteresisLaw, coefficients: Array) -> State:
        """Return the state with another H of a family."""
        theta = np.maximum(coefficients, law.lower)
        return replace(self, hysteresis=law.hysteresis(theta), law=law, coefficients=theta)

    def without(self, i: int) -> State:
        """Return the state without an effect; what creeps on from before goes with creep."""
        rest = replace(self, effects=self.effects[:i] + self.effects[i + 1 :])
        return rest.from_rest() if self.effects[i].name == CREEP else rest

    def from_rest(self) -> State:
        """Return the state without what creeps on from before."""
        return replace(self, fading=(), earlier=np.empty(0))

    def with_effects_of(self, other: State) -> State:
        """Return the state with the effects of another one, and what creeps on in it."""
        return replace(self, effects=other.effects, fading=other.fading, earlier=other.earlier)

    def with_effect(self, added: Added) -> State:
        """Return the state with one more effect."""
        return replace(self, effects=(*self.effects, added))

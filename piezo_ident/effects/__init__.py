# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The catalogue of effects: those that come with the package, and a lab's own as entry points."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points
import reprlib
from types import MappingProxyType

from piezo_ident.common.errors import ModelError
from piezo_ident.effects.amplifier_lag import AmplifierLag
from piezo_ident.effects.backlash import Backlash
from piezo_ident.effects.changed_dynamics import ChangedDynamics
from piezo_ident.effects.creep import Creep
from piezo_ident.effects.cross_coupling import CrossCoupling
from piezo_ident.effects.delay_change import DelayChange
from piezo_ident.effects.effect import Effect, Parameter
from piezo_ident.effects.even_nonlinearity import EvenNonlinearity
from piezo_ident.effects.gain_drift import GainDrift
from piezo_ident.effects.input_feedthrough import InputFeedthrough
from piezo_ident.effects.noncongruent_minor_loops import NoncongruentMinorLoops
from piezo_ident.effects.periodic_disturbance import PeriodicDisturbance
from piezo_ident.effects.preload_loss import PreloadLoss
from piezo_ident.effects.rate_dependent_hysteresis import RateDependentHysteresis
from piezo_ident.effects.saturation import Saturation
from piezo_ident.effects.sensor_nonlinearity import SensorNonlinearity
from piezo_ident.effects.slew_limit import SlewLimit
from piezo_ident.effects.thermal_drift import ThermalDrift
from piezo_ident.effects.trials import Trial, View

__all__ = ['Effect', 'Parameter', 'Trial', 'View', 'catalogue', 'find_effect']

_OWN: tuple[type[Effect], ...] = (
    AmplifierLag,
    Backlash,
    ChangedDynamics,
    Creep,
    CrossCoupling,
    DelayChange,
    EvenNonlinearity,
    GainDrift,
    InputFeedthrough,
    NoncongruentMinorLoops,
    PeriodicDisturbance,
    PreloadLoss,
    RateDependentHysteresis,
    Saturation,
    SensorNonlinearity,
    SlewLimit,
    ThermalDrift,
)


@cache
def catalogue() -> Mapping[str, type[Effect]]:
    """
    Return every known effect by name.

    Raises
    ------
    ModelError
        When an entry point of the group ``piezo_ident.effects`` does not give an `Effect`, or
        takes a name that is already there.
    """
    found: dict[str, type[Effect]] = {effect.name: effect for effect in _OWN}
    for entry in entry_points(group='piezo_ident.effects'):
        try:
            effect = entry.load()
        except Exception as error:
            raise ModelError(f'effect plug-in {entry.value!r} does not load: {error}') from error
        if not (isinstance(effect, type) and issubclass(effect, Effect)):
            raise ModelError(f'effect plug-in {entry.value!r} is not a subclass of Effect')
        if effect.name in found:
            raise ModelError(f'effect plug-in {entry.value!r}: the name {effect.name!r} is taken')
        found[effect.name] = effect
    return MappingProxyType(found)


def find_effect(name: str) -> type[Effect]:
    """
    Return one effect.

    Raises
    ------
    ModelError
        When the name is not in the catalogue.
    """
    try:
        return catalogue()[name]
    except KeyError:
        known = ', '.join(sorted(catalogue()))
        raise ModelError(
            f'unknown effect {reprlib.repr(name)}; the catalogue has {known}'
        ) from None

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Catalogue of effects, from the package and from plug-ins.

An effect is a property of a stage beyond H, G and z^-d.  `catalogue` holds all effects by name.  A
lab adds an effect as an entry point in the group ``piezo_ident.effects``.

    >>> from piezo_ident import effects
    >>> effects.find_effect('slew_limit').slot
    'input'
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.metadata import entry_points
import reprlib
import sys
from types import MappingProxyType, ModuleType
import warnings

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
from piezo_ident.effects.loop_hysteresis import LoopHysteresis
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
    LoopHysteresis,
    NoncongruentMinorLoops,
    PeriodicDisturbance,
    PreloadLoss,
    RateDependentHysteresis,
    Saturation,
    SensorNonlinearity,
    SlewLimit,
    ThermalDrift,
)


class _Printed(ModuleType):
    """This module, which shows the catalogue at a prompt."""

    def __repr__(self) -> str:
        effects = sorted(catalogue().items())
        return '\n'.join(f'{name:28}{effect.description}' for name, effect in effects)


sys.modules[__name__].__class__ = _Printed


@cache
def catalogue() -> Mapping[str, type[Effect]]:
    """
    Collect every known effect by name.

    A plug-in is skipped with a warning if it cannot be imported, is not an `Effect`, or takes an
    existing name.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> pi.effects.catalogue()['creep'].slot
    'hidden'
    """
    effects: dict[str, type[Effect]] = {effect.name: effect for effect in _OWN}
    for entry in entry_points(group='piezo_ident.effects'):
        try:
            effect = entry.load()
            problem = ''
        except Exception as error:  # noqa: BLE001 - the code is not ours
            effect, problem = None, f'cannot be imported ({error})'
        if not problem and not (isinstance(effect, type) and issubclass(effect, Effect)):
            problem = 'is not a subclass of Effect'
        elif not problem and effect.name in effects:
            problem = f'takes the name {effect.name!r}, which exists'
        if problem:
            warnings.warn(f'effect plug-in {entry.value!r} {problem}; it is skipped', stacklevel=2)
        else:
            effects[effect.name] = effect
    return MappingProxyType(effects)


def find_effect(name: str) -> type[Effect]:
    """
    Find the class of an effect by its name.

    Raises
    ------
    ModelError
        If the name is not in the catalogue.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> [p.name for p in pi.effects.find_effect('creep').parameters]
    ['gain', 'time_constant']
    """
    try:
        return catalogue()[name]
    except KeyError:
        known = ', '.join(sorted(catalogue()))
        raise ModelError(
            f'unknown effect {reprlib.repr(name)}; the catalogue has {known}'
        ) from None

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Effects that imitate each other, and the experiments that tell them apart."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from piezo_ident.effects import find_effect

__all__ = ['CONTAINS', 'LOOK_ALIKES', 'look_alikes', 'separating_experiment']

#: effects that imitate each other on most data: one is no answer while another was not tried
LOOK_ALIKES = (
    ('creep', 'thermal_drift', 'gain_drift'),
    ('creep', 'rate_dependent_hysteresis'),
    ('even_nonlinearity', 'preload_loss', 'noncongruent_minor_loops'),
    ('even_nonlinearity', 'sensor_nonlinearity'),
    ('noncongruent_minor_loops', 'sensor_nonlinearity'),
    ('slew_limit', 'amplifier_lag'),
    # all linear
    ('delay_change', 'amplifier_lag', 'changed_dynamics', 'input_feedthrough'),
    # both act where a full stroke turns
    ('backlash', 'saturation'),
)
#: laws that another one can take the shape of, to first order, whatever the data
CONTAINS = {
    # any change of the dynamics
    'changed_dynamics': ('delay_change', 'amplifier_lag', 'input_feedthrough'),
    # thresholds that grow in proportion to the speed are a delay
    'rate_dependent_hysteresis': ('delay_change', 'amplifier_lag'),
}
_HOLDS = 'holds of 10 s and more after steps of both signs, with the first motion at the end again'
_TWO_SIZES = 'a sine near the first resonance at two amplitudes, one a tenth of the other'
_FAST = 'a multisine that reaches beyond the first resonance'
#: the experiment that separates two effects
_SEPARATED_BY = {
    ('creep', 'thermal_drift'): _HOLDS,
    ('creep', 'gain_drift'): _HOLDS,
    ('gain_drift', 'thermal_drift'): (
        'the same motion about a low and a high bias, at the start and at the end: a drifting '
        'gain moves the high one more'
    ),
    ('creep', 'rate_dependent_hysteresis'): (
        'a hold of 2 s after a step, and one fast sine at two amplitudes'
    ),
    ('noncongruent_minor_loops', 'sensor_nonlinearity'): (
        'minor loops of two widths, each at five biases that are reached from below and from '
        'above: a sensor bends both branches by one function of y'
    ),
    ('even_nonlinearity', 'noncongruent_minor_loops'): (
        'minor loops of two widths at five biases: a curvature of v shifts them, and does not '
        'change their width'
    ),
    ('even_nonlinearity', 'preload_loss'): (
        'small slow triangles at ten biases: a contact opens at one voltage, a curvature is '
        'everywhere'
    ),
    ('noncongruent_minor_loops', 'preload_loss'): (
        'minor loops of two widths at ten biases: a contact changes those alone that pass it'
    ),
    ('even_nonlinearity', 'sensor_nonlinearity'): (
        'a sine of the full range close to the first resonance, where y no longer follows v'
    ),
    ('preload_loss', 'sensor_nonlinearity'): (
        'a sine of the full range close to the first resonance, where y no longer follows v'
    ),
    ('backlash', 'saturation'): 'turns in the middle of the range as well as at its ends',
    ('amplifier_lag', 'slew_limit'): 'one fast sine at two amplitudes',
    ('amplifier_lag', 'rate_dependent_hysteresis'): 'one fast sine at two amplitudes',
    ('delay_change', 'rate_dependent_hysteresis'): 'one fast sine at two amplitudes',
    ('changed_dynamics', 'rate_dependent_hysteresis'): 'one fast sine at two amplitudes',
    ('backlash', 'changed_dynamics'): _TWO_SIZES,
    ('amplifier_lag', 'delay_change'): _FAST,
    ('changed_dynamics', 'delay_change'): _FAST,
    ('amplifier_lag', 'changed_dynamics'): _FAST,
    ('changed_dynamics', 'input_feedthrough'): (
        f'{_FAST}, and steps: what is fed through comes before the delay is over'
    ),
}


def look_alikes(name: str) -> list[str]:
    """
    Return the effects that imitate one.

    Examples
    --------
    >>> look_alikes('saturation')
    ['backlash']
    """
    others = dict.fromkeys(other for group in LOOK_ALIKES if name in group for other in group)
    return [other for other in others if other != name]


def separating_experiment(names: Sequence[str]) -> str:
    """
    Return what to record to tell effects apart.

    Examples
    --------
    >>> separating_experiment(['slew_limit', 'amplifier_lag'])
    'one fast sine at two amplitudes'
    """
    pairs = [tuple(sorted(pair)) for pair in combinations(names, 2)]
    known = [_SEPARATED_BY[pair] for pair in pairs if pair in _SEPARATED_BY]
    # an effect of no listed pair names what it needs itself
    listed = {name for pair in pairs if pair in _SEPARATED_BY for name in pair}
    own = [find_effect(name).needs for name in names if name not in listed]
    return '; and '.join(dict.fromkeys(text for text in (*known, *own) if text))

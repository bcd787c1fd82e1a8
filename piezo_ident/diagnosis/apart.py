# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Which candidates the data tell apart, and what would part those that they do not.

No real effect has quite the form of a textbook law.  So of two laws the one that leaves less need
not be the cause: what it leaves must be clearly less, by more than laws are off, and by more than
the difference scatters over held-out blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.scatter import SCATTER, standard_errors
from piezo_ident.diagnosis.search import Contender
from piezo_ident.effects import find_effect

__all__ = ['experiment_for', 'look_alikes', 'rivals_of']

#: a rival that leaves less than this times what the best one leaves is not told from it
AHEAD = 1.6
#: a rival with more parameters must leave less than this times what a law that fits leaves
BOUGHT = 0.95
#: share of what there was to explain from which a law fits: real effects are off by a little
SETTLED = 0.99
#: of laws that fit, a richer one must leave this many times less than a simple one: its further
#: parameters make up for the form of the other
FORM = 4.0
#: what two effects may leave without a difference, % of stroke: H is never right to more than that
INDISTINCT = 0.01
#: laws that another one can take the shape of, to first order, whatever the data
CONTAINS = {
    # any change of the dynamics
    'changed_dynamics': ('delay_change', 'amplifier_lag', 'input_feedthrough'),
    # thresholds that grow in proportion to the speed are a delay
    'rate_dependent_hysteresis': ('delay_change', 'amplifier_lag'),
}
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
_HOLDS = 'holds of 10 s and more after steps of both signs, with the first motion at the end again'
_TWO_SIZES = 'a sine near the first resonance at two amplitudes, one a tenth of the other'
_FAST = 'a multisine that reaches beyond the first resonance'
#: what parts two effects
_PARTED_BY = {
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


def rivals_of(
    rows: Rows, contenders: Sequence[Contender], noise: float, explainable: float
) -> tuple[Contender, ...]:
    """
    Return the contenders that the data do not tell from the first one.

    Parameters
    ----------
    rows : Rows
    contenders : sequence of Contender
        The one that was added first.
    noise : float
        Mean square of the noise of a row.
    explainable : float
        Mean square that there was to explain.
    """
    best, *others = contenders
    floor = (INDISTINCT * rows.stroke / 100.0) ** 2
    return tuple(c for c in others if _as_good(c, best, noise, explainable, floor))


def _as_good(
    rival: Contender, best: Contender, noise: float, explainable: float, floor: float
) -> bool:
    left = max(best.fitted.mean_square - noise, 0.0)
    other = max(rival.fitted.mean_square - noise, 0.0)
    ratio = (other + floor) / (left + floor)
    more = len(rival.fitted.handles) - len(best.fitted.handles)
    if more > 0 and (
        _settled(left, explainable, floor) or best.name in CONTAINS.get(rival.name, ())
    ):
        # nothing is left that a richer law is needed for
        return ratio <= BOUGHT
    if ratio <= AHEAD:
        return True
    if ratio > FORM:
        return False
    if more < 0 and _settled(other, explainable, floor):
        return True
    return standard_errors(rival.fitted.errors - best.fitted.errors) < SCATTER


def _settled(left: float, explainable: float, floor: float) -> bool:
    return left <= max((1.0 - SETTLED) * explainable, floor)


def look_alikes(name: str) -> list[str]:
    """Return the effects that imitate one."""
    found = dict.fromkeys(other for group in LOOK_ALIKES if name in group for other in group)
    return [other for other in found if other != name]


def experiment_for(names: Sequence[str]) -> str:
    """
    Return what to record to tell effects apart.

    Examples
    --------
    >>> experiment_for(['slew_limit', 'amplifier_lag'])
    'one fast sine at two amplitudes'
    """
    pairs = [tuple(sorted(pair)) for pair in combinations(names, 2)]
    known = [_PARTED_BY[pair] for pair in pairs if pair in _PARTED_BY]
    # a name that no pair speaks of says what it needs itself
    spoken = {name for pair in pairs if pair in _PARTED_BY for name in pair}
    own = [find_effect(name).needs for name in names if name not in spoken]
    return '; and '.join(dict.fromkeys(text for text in (*known, *own) if text))

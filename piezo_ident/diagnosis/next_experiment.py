# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Suggest the next experiment: the excitation that answers the questions these data leave open.

Some effects imitate each other if one kind of motion is missing.  Example: creep, and thresholds
that grow with the speed, both lower the slope of a loop as the frequency rises.  The suggestion
names motions that separate the doubtful effects and that the data lack.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.effects import find_effect
from piezo_ident.model.sines import sine_frequency
from piezo_ident.record.record import Record
from piezo_ident.residual.stretches import rests

Kind = Literal['sweeps', 'holds']
Motion = Callable[[Sequence[Record], float], bool]

#: smallest change of the voltage that counts as a step, share of its range
STEP = 0.15
#: duration of a hold that shows creep, of a rest that shows hum, tolerance of each duration, and
#: longest duration of a step [s]
HOLD, REST, SLACK, SUDDEN = 2.0, 1.0, 0.02, 0.5
#: smallest share of the range of a full sweep, and largest share of a minor loop
FULL, MINOR = 0.9, 0.5
#: highest speed of a slow sweep [ranges a second], lowest frequency of a fast sine [Hz]
SLOW, FAST = 8.0, 20.0
#: smallest ratio of two amplitudes that count as different
APART = 2.0


@dataclass(frozen=True)
class Experiment:
    """
    The next measurement, and the doubt that it removes, in words.

    'sweeps' are motions of many kinds, 'holds' are steps with long holds.
    """

    kind: Kind
    reason: str


def next_experiment(
    diagnosis: Diagnosis | None, records: Sequence[Record] = (), asked: Sequence[Kind] = ()
) -> Experiment | None:
    """
    Return the experiment that answers an open question; None after the last one.

    Found effects and effects that could not be separated come first, then untestable effects.
    Pass None if the data held too little motion for a diagnosis.  A kind in `asked` is not
    suggested again.

    >>> next_experiment(None).kind
    'sweeps'
    """
    if diagnosis is None:
        reason = 'no motion was captured but that of the identification'
        return None if 'sweeps' in asked else Experiment('sweeps', reason)
    low, high = diagnosis.given.scaling.range
    span = max(high - low, *(float(np.ptp(r.voltage_range)) for r in records), 1e-12)
    missing = [m for m in _MOTIONS if m[1] not in asked and not m[3](records, span)]
    for names, needed, doubt in _doubts(diagnosis):
        for name, kind, shows, _ in missing:
            shown = [effect for effect in names if effect in shows]
            if shown and needed in ('', shown[0]):
                *most, last = shown[:3]
                effects = f'{", ".join(most)} and {last}' if most else last
                doubt = doubt if most or 'tested' in doubt else 'cannot be confirmed'
                return Experiment(kind, f'{effects} {doubt} without {name}')
    return None


def _doubts(diagnosis: Diagnosis) -> Iterator[tuple[tuple[str, ...], str, str]]:
    """Yield effects in doubt, the effect that a motion must show ('': any), and the doubt."""
    alike, untested = 'cannot be separated', 'cannot be tested'
    if diagnosis.group is not None:
        yield diagnosis.group.names, '', alike
    for effect in diagnosis.effects:
        yield (effect.name, *look_alikes(effect.name)), effect.name, alike
    yield tuple(x.name for x in diagnosis.untestable), '', untested
    if diagnosis.verdict in ('partly_explained', 'unexplained'):
        yield tuple(c.name for c in diagnosis.candidates), '', untested


# -- motions in the data -------------------------------------------------------------------------


def _rests(records: Sequence[Record]) -> Iterator[tuple[float, float]]:
    """Yield the duration [s] of every rest of the voltage, and the step right before it [V]."""
    for record in records:
        for piece in record:
            before = round(SUDDEN * piece.sample_rate)
            for start, stop in rests(piece.v, piece.sample_rate):
                back = piece.v[max(0, start - before) : start + 1]
                step = float(np.abs(back - piece.v[start]).max())
                yield (stop - start) / piece.sample_rate, step


def _has_hold(records: Sequence[Record], span: float) -> bool:
    return any(t >= HOLD - SLACK and step >= STEP * span for t, step in _rests(records))


def _has_rest(records: Sequence[Record], span: float) -> bool:
    return any(t >= REST - SLACK for t, _ in _rests(records))


def _segments(records: Sequence[Record]) -> Iterator[tuple[str, Array, float]]:
    """Yield label, voltage and sampling rate of every segment; a piece without segments is one."""
    for record in records:
        for piece in record:
            for s in piece.segments:
                yield s.label, piece.v[s.start : s.stop], piece.sample_rate
            if not piece.segments:
                yield '', piece.v, piece.sample_rate


def _speed(v: Array, rate: float) -> float:
    """Return the highest speed [V/s], over 1 ms so that converter steps count less."""
    m = max(1, min(v.size - 1, round(1e-3 * rate)))
    return float(np.abs(v[m:] - v[:-m]).max(initial=0.0)) * rate / m


def _has_slow_sweep(records: Sequence[Record], span: float) -> bool:
    return any(
        np.ptp(v) >= FULL * span and _speed(v, rate) <= SLOW * span
        for _, v, rate in _segments(records)
    )


def _has_two_amplitudes(records: Sequence[Record], span: float) -> bool:
    sizes: dict[float, list[float]] = {}
    for label, v, _ in _segments(records):
        frequency = sine_frequency(label) or 0.0
        if frequency >= FAST:
            sizes.setdefault(frequency, []).append(float(np.ptp(v)))
    return any(max(s) >= APART * min(s) for s in sizes.values())


def _has_minor_loops(records: Sequence[Record], span: float) -> bool:
    # loops of one size about three biases
    biases: dict[int, set[int]] = {}
    for label, v, _ in _segments(records):
        low, high = float(v.min()), float(v.max())
        if label.startswith('triangle') and 0.0 < high - low <= MINOR * span:
            size = round(20 * (high - low) / span)
            biases.setdefault(size, set()).add(round(20 * (low + high) / 2 / span))
    return any(len(found) >= 3 for found in biases.values())


def _has_wide_band(records: Sequence[Record], span: float) -> bool:
    kinds = {label.partition(':')[0] for label, _, _ in _segments(records)}
    return bool(kinds & {'multisine', 'noise', 'step'})


def _has_repeat(records: Sequence[Record], span: float) -> bool:
    for record in records:
        for piece in record:
            starts: dict[tuple[float, ...], list[int]] = {}
            for s in piece.segments:
                v = piece.v[s.start : s.stop]
                size = float(np.ptp(v))
                if size >= STEP * span and s.kind != 'ramp':
                    # equal motions differ by a tenth at most, approximately
                    place = (round(20 * size / span), round(20 * float(v.min()) / span))
                    fast = round(4 * np.log2(_speed(v, piece.sample_rate)))
                    starts.setdefault((*place, fast), []).append(s.start)
            if any(max(x) - min(x) >= 0.5 * piece.n for x in starts.values()):
                return True
    return False


_EVEN = ('even_nonlinearity', 'preload_loss', 'noncongruent_minor_loops', 'sensor_nonlinearity')
_FAST_EFFECTS = ('delay_change', 'changed_dynamics', 'amplifier_lag', 'slew_limit')
#: motions; the program that contains each; the effects that it shows; a test whether data hold it
_MOTIONS: tuple[tuple[str, Kind, tuple[str, ...], Motion], ...] = (
    (
        f'a hold of at least {HOLD:g} s after a step',
        'holds',
        ('creep', 'thermal_drift', 'gain_drift', 'rate_dependent_hysteresis'),
        _has_hold,
    ),
    (
        'one fast sine at two amplitudes',
        'sweeps',
        ('rate_dependent_hysteresis', 'amplifier_lag', 'slew_limit', 'changed_dynamics'),
        _has_two_amplitudes,
    ),
    ('equal minor loops at three biases', 'sweeps', _EVEN, _has_minor_loops),
    (
        'a slow sweep over the full range',
        'sweeps',
        (
            'rate_dependent_hysteresis',
            'saturation',
            'even_nonlinearity',
            'preload_loss',
            'sensor_nonlinearity',
            'backlash',
        ),
        _has_slow_sweep,
    ),
    (
        'a multisine, noise, or steps',
        'sweeps',
        (*_FAST_EFFECTS, 'input_feedthrough', 'backlash', 'sensor_nonlinearity'),
        _has_wide_band,
    ),
    ('a stretch of rest', 'sweeps', ('periodic_disturbance', 'thermal_drift'), _has_rest),
    (
        'the same motion at the start and at the end',
        'sweeps',
        ('gain_drift', 'thermal_drift'),
        _has_repeat,
    ),
)


# -- effects that imitate each other -------------------------------------------------------------

#: effects that imitate each other on most data: a found effect is uncertain while a look-alike was
#: not tried
LOOK_ALIKES = (
    ('creep', 'thermal_drift', 'gain_drift'),
    ('creep', 'rate_dependent_hysteresis'),
    ('even_nonlinearity', 'preload_loss', 'noncongruent_minor_loops'),
    ('even_nonlinearity', 'sensor_nonlinearity'),
    ('noncongruent_minor_loops', 'sensor_nonlinearity'),
    ('slew_limit', 'amplifier_lag'),
    # all are linear
    ('delay_change', 'amplifier_lag', 'changed_dynamics', 'input_feedthrough'),
    # both act at the turns of a full stroke
    ('backlash', 'saturation'),
)
_HOLDS = 'holds of 10 s and more after steps of both signs, with the first motion at the end again'
_TWO_SINES = 'one fast sine at two amplitudes'
_FULL_SINE = 'a sine of the full range close to the first resonance, where y no longer follows v'
_FAST = 'a multisine that reaches beyond the first resonance'
#: experiment that separates two effects
_SEPARATED_BY = {
    ('creep', 'thermal_drift'): _HOLDS,
    ('creep', 'gain_drift'): _HOLDS,
    ('gain_drift', 'thermal_drift'): (
        'the same motion about a low and a high bias, at the start and at the end: a drifting '
        'gain moves the high one more'
    ),
    ('creep', 'rate_dependent_hysteresis'): f'a hold of 2 s after a step, and {_TWO_SINES}',
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
    ('even_nonlinearity', 'sensor_nonlinearity'): _FULL_SINE,
    ('preload_loss', 'sensor_nonlinearity'): _FULL_SINE,
    ('backlash', 'saturation'): 'turns in the middle of the range as well as at its ends',
    ('amplifier_lag', 'slew_limit'): _TWO_SINES,
    ('amplifier_lag', 'rate_dependent_hysteresis'): _TWO_SINES,
    ('delay_change', 'rate_dependent_hysteresis'): _TWO_SINES,
    ('changed_dynamics', 'rate_dependent_hysteresis'): _TWO_SINES,
    ('backlash', 'changed_dynamics'): (
        'a sine near the first resonance at two amplitudes, one a tenth of the other'
    ),
    ('amplifier_lag', 'delay_change'): _FAST,
    ('changed_dynamics', 'delay_change'): _FAST,
    ('amplifier_lag', 'changed_dynamics'): _FAST,
    ('changed_dynamics', 'input_feedthrough'): (
        f'{_FAST}, and steps: what is fed through comes before the delay is over'
    ),
}


def look_alikes(name: str) -> list[str]:
    """
    List the effects that imitate an effect.

    Examples
    --------
    >>> look_alikes('saturation')
    ['backlash']
    """
    others = dict.fromkeys(other for group in LOOK_ALIKES if name in group for other in group)
    return [other for other in others if other != name]


def separating_experiment(names: Sequence[str]) -> str:
    """
    Describe a recording that separates effects.

    Examples
    --------
    >>> separating_experiment(['slew_limit', 'amplifier_lag'])
    'one fast sine at two amplitudes'
    """
    pairs = [tuple(sorted(pair)) for pair in combinations(names, 2)]
    known = [_SEPARATED_BY[pair] for pair in pairs if pair in _SEPARATED_BY]
    # an effect without a listed pair states its own needs
    listed = {name for pair in pairs if pair in _SEPARATED_BY for name in pair}
    own = [find_effect(name).needs for name in names if name not in listed]
    return '; and '.join(dict.fromkeys(text for text in (*known, *own) if text))

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The next experiment: which excitation would decide what these data leave open.

Every effect shows in some motions and hides in others, and some imitate each other where such a
motion is missing: creep lowers the slope of the loop as the frequency rises, just as a hysteresis
does whose thresholds grow with the speed.  So what a diagnosis is in doubt about is looked up here
among the motions that would decide it, and the ones that the data do not have are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.model.free_run import sine_frequency
from piezo_ident.record.record import Piece, Record

__all__ = ['Experiment', 'next_experiment']

Kind = Literal['sweeps', 'holds']

#: what counts as standing still and as a step, shares of the voltage range
STILL, STEP = 5e-3, 0.15
#: a hold that shows creep, a stretch of rest that shows hum [s]
HOLD, REST = 2.0, 1.0
#: grid on which the voltage is looked at, and how long a step may take to be one [s]
GRID, SUDDEN = 0.01, 0.5
#: share of the range that is nearly all of it, and of one that is a minor loop
FULL, MINOR = 0.9, 0.5
#: speed of a slow sweep [ranges a second], frequency of a fast sine [Hz]
SLOW, FAST = 8.0, 20.0
#: factor between two amplitudes that are not the same
APART = 2.0


@dataclass(frozen=True)
class Experiment:
    """
    What to measure next.

    Attributes
    ----------
    kind : {'sweeps', 'holds'}
        Motions of many kinds, or steps with long holds.
    reason : str
        What is in doubt without, for people.
    """

    kind: Kind
    reason: str


@dataclass(frozen=True)
class _Motion:
    """A motion, the effects that it shows, and whether some data have it."""

    name: str
    kind: Kind
    shows: tuple[str, ...]
    is_there: Callable[[Sequence[Record], float], bool]


def next_experiment(
    diagnosis: Diagnosis | None, records: Sequence[Record] = (), asked: Sequence[Kind] = ()
) -> Experiment | None:
    """
    Return the experiment that would decide what is open, None when nothing is or none would.

    First comes what was found or could not be told apart, then what could not be tested at all.

    Parameters
    ----------
    diagnosis : Diagnosis or None
        None when there were no data to judge.
    records : sequence of Record
        Those that were judged.
    asked : sequence of {'sweeps', 'holds'}
        What was asked for already; it is not asked for again.

    Examples
    --------
    >>> next_experiment(None).kind
    'sweeps'
    """
    if diagnosis is None:
        reason = 'no motion was captured beside what the model was identified from'
        return None if 'sweeps' in asked else Experiment('sweeps', reason)
    span = _span(diagnosis, records)
    lacking = [m for m in _MOTIONS if m.kind not in asked and not m.is_there(records, span)]
    for names, doubt, must in _doubts(diagnosis):
        for motion in lacking:
            shown = [name for name in names if name in motion.shows]
            if shown and must in ('', shown[0]):
                return Experiment(motion.kind, f'{doubt(shown)} without {motion.name}')
    return None


def _doubts(
    diagnosis: Diagnosis,
) -> Iterator[tuple[tuple[str, ...], Callable[[list[str]], str], str]]:
    """
    Return groups of names that are in doubt, the gravest first.

    With each comes how to say so, and the name that a motion must show; empty for any.
    """
    if diagnosis.group is not None:
        yield diagnosis.group.names, _not_told_apart, ''
    for effect in diagnosis.effects:
        for group in _ALIKE:
            if effect.name in group:
                alike = tuple(n for n in group if n != effect.name)
                yield (effect.name, *alike), _not_told_apart, effect.name
    yield tuple(x.name for x in diagnosis.untestable), _not_tested, ''
    if diagnosis.verdict in ('partly_explained', 'unexplained'):
        yield tuple(c.name for c in diagnosis.candidates), _not_tested, ''


def _not_told_apart(names: list[str]) -> str:
    if len(names) == 1:
        return f'{names[0]} cannot be borne out'
    return f'{_listed(names)} cannot be told apart'


def _not_tested(names: list[str]) -> str:
    return f'{_listed(names)} cannot be tested'


def _listed(names: list[str]) -> str:
    *most, last = names[:3]
    return f'{", ".join(most)} and {last}' if most else last


def _span(diagnosis: Diagnosis, records: Sequence[Record]) -> float:
    """Return the voltage range that is the whole of it [V]."""
    low, high = diagnosis.given.scaling.range
    return max(high - low, *(float(np.ptp(r.voltage_range)) for r in records), 1e-12)


# what the data have


def _rests(piece: Piece, span: float) -> Iterator[tuple[float, float]]:
    """Yield how long the voltage stood still, and how far it had stepped right before [V]."""
    m = max(1, round(GRID * piece.sample_rate))
    cells = piece.v[: piece.n // m * m].reshape(-1, m)
    v, high, low = cells.mean(axis=1), cells.max(axis=1), cells.min(axis=1)
    still = np.maximum(high[1:], high[:-1]) - np.minimum(low[1:], low[:-1]) < STILL * span
    before, i = round(SUDDEN / GRID), 0
    for stands, steps in groupby(still.tolist()):
        n = len(list(steps))
        if stands:
            back = v[max(0, i - before) : i + 1]
            yield n * m / piece.sample_rate, float(np.abs(back - v[i]).max())
        i += n


def _has_hold(records: Sequence[Record], span: float) -> bool:
    return any(
        long >= HOLD - 2 * GRID and step >= STEP * span
        for record in records
        for piece in record
        for long, step in _rests(piece, span)
    )


def _has_rest(records: Sequence[Record], span: float) -> bool:
    return any(
        long >= REST - 2 * GRID
        for record in records
        for piece in record
        for long, _ in _rests(piece, span)
    )


def _parts(records: Sequence[Record]) -> Iterator[tuple[str, NDArray[np.float64], float]]:
    """Yield label, voltage and sampling rate of every segment; a piece without any is one."""
    for record in records:
        for piece in record:
            for s in piece.segments:
                yield s.label, piece.v[s.start : s.stop], piece.sample_rate
            if not piece.segments:
                yield '', piece.v, piece.sample_rate


def _speed(v: NDArray[np.float64], rate: float) -> float:
    """Return the highest speed [V/s], over a few samples so that converter steps count less."""
    m = max(1, min(v.size - 1, round(0.1 * GRID * rate)))
    return float(np.abs(v[m:] - v[:-m]).max(initial=0.0)) * rate / m


def _has_slow_sweep(records: Sequence[Record], span: float) -> bool:
    return any(
        np.ptp(v) >= FULL * span and _speed(v, rate) <= SLOW * span
        for _, v, rate in _parts(records)
    )


def _has_two_amplitudes(records: Sequence[Record], span: float) -> bool:
    sizes: dict[float, list[float]] = {}
    for label, v, _ in _parts(records):
        frequency = sine_frequency(label) or 0.0
        if frequency >= FAST:
            sizes.setdefault(frequency, []).append(float(np.ptp(v)))
    return any(max(s) >= APART * min(s) for s in sizes.values())


def _has_minor_loops(records: Sequence[Record], span: float) -> bool:
    # loops of one size about three biases
    biases: dict[int, set[int]] = {}
    for label, v, _ in _parts(records):
        low, high = float(v.min()), float(v.max())
        if label.startswith('triangle') and 0.0 < high - low <= MINOR * span:
            size = round(20 * (high - low) / span)
            biases.setdefault(size, set()).add(round(20 * (low + high) / 2 / span))
    return any(len(found) >= 3 for found in biases.values())


def _has_wide_band(records: Sequence[Record], span: float) -> bool:
    kinds = {label.partition(':')[0] for label, _, _ in _parts(records)}
    return bool(kinds & {'multisine', 'noise', 'step'})


def _has_repeat(records: Sequence[Record], span: float) -> bool:
    for record in records:
        for piece in record:
            starts: dict[tuple[float, ...], list[int]] = {}
            for s in piece.segments:
                v = piece.v[s.start : s.stop]
                size = float(np.ptp(v))
                if size >= STEP * span and s.kind != 'ramp':
                    # the same within a tenth or so
                    place = (round(20 * size / span), round(20 * float(v.min()) / span))
                    fast = round(4 * np.log2(_speed(v, piece.sample_rate)))
                    starts.setdefault((*place, fast), []).append(s.start)
            if any(max(x) - min(x) >= 0.5 * piece.n for x in starts.values()):
                return True
    return False


#: names that imitate each other where the motions that would part them are missing
_ALIKE = (
    ('creep', 'rate_dependent_hysteresis', 'thermal_drift', 'gain_drift'),
    ('even_nonlinearity', 'preload_loss', 'noncongruent_minor_loops', 'sensor_nonlinearity'),
    ('slew_limit', 'amplifier_lag', 'delay_change', 'changed_dynamics'),
    ('saturation', 'even_nonlinearity'),
)

_MOTIONS = (
    _Motion(
        f'a hold of at least {HOLD:g} s after a step',
        'holds',
        ('creep', 'thermal_drift', 'gain_drift', 'rate_dependent_hysteresis'),
        _has_hold,
    ),
    _Motion(
        'one fast sine at two amplitudes',
        'sweeps',
        ('rate_dependent_hysteresis', 'amplifier_lag', 'slew_limit', 'changed_dynamics'),
        _has_two_amplitudes,
    ),
    _Motion(
        'equal minor loops at three biases',
        'sweeps',
        ('even_nonlinearity', 'preload_loss', 'noncongruent_minor_loops', 'sensor_nonlinearity'),
        _has_minor_loops,
    ),
    _Motion(
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
    _Motion(
        'a multisine, noise, or steps',
        'sweeps',
        (
            'delay_change',
            'changed_dynamics',
            'amplifier_lag',
            'slew_limit',
            'input_feedthrough',
            'backlash',
            'sensor_nonlinearity',
        ),
        _has_wide_band,
    ),
    _Motion('a stretch of rest', 'sweeps', ('periodic_disturbance', 'thermal_drift'), _has_rest),
    _Motion(
        'the same motion at the start and at the end',
        'sweeps',
        ('gain_drift', 'thermal_drift'),
        _has_repeat,
    ),
)

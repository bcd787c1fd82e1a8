# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Diagnoses made by hand, of a stage that creeps, for tests of what is made of a diagnosis."""

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.diagnosis.results import (
    Candidate,
    Class,
    Diagnosis,
    DiagnosisSettings,
    Errors,
    FoundEffect,
    FoundParameter,
    Residual,
    Unexplained,
    Untestable,
)
from piezo_ident.excitation.program import parse_program
from piezo_ident.model.sines import sine_frequency
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.record.record import Fault, Piece, Record
from programs import SLOW, slow_model

#: what a name in somebody's file may hold
HOSTILE = '<script>alert("$x^$")</script>\x1b[31m'

NOISE = 4e-9
PROGRAM = """
limits: [0, 10]
slew: 200
segments:
  - {signal: idle, duration: 0.3}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 5, duration: 2}
  - {signal: staircase, levels: [0, 4, 8, 4, 0], hold: 1.5}
  - {signal: sine, bias: 5, amplitude: 4, frequency: 50, duration: 1}
  - {signal: idle, duration: 0.3}
"""
CREEP = {'gain': [0.012, 0.01], 'time_constant': [0.1, 1.0]}


@cache
def refined_model() -> StageModel:
    """Return the same stage with creep."""
    return with_effects(creep=CREEP)


def with_effects(**effects: dict[str, object]) -> StageModel:
    """Return the slow stage with effects, by their names."""
    return replace(slow_model(), effects=tuple(EffectSetting(*one) for one in effects.items()))


def played(model: StageModel, name: str, earlier: ArrayLike = ()) -> Record:
    """Return what is measured of a stage that played the program, behind an earlier voltage."""
    sequence = parse_program(PROGRAM, 'program').build(SLOW)
    y = model.simulate(np.concatenate([earlier, sequence.v]))[-sequence.n :]
    noise = NOISE * np.random.default_rng(3).standard_normal(y.size)
    return Record((Piece(sequence.v, y + noise, SLOW, segments=sequence.segments),), name)


@cache
def measured(name: str = 'val.npz') -> Record:
    return played(refined_model(), name)


def errors(record: Record, residual: np.ndarray) -> Errors:
    (piece,) = record.pieces

    def percent(e: np.ndarray) -> float:
        return 100.0 * float(np.sqrt(np.mean(e**2))) / record.stroke

    by_label: dict[str, list[np.ndarray]] = {}
    for s in piece.segments:
        by_label.setdefault(s.label, []).append(residual[s.start : s.stop])
    by_segment = {label: percent(np.concatenate(parts)) for label, parts in by_label.items()}
    by_frequency = {
        f'{sine_frequency(label):g}': value
        for label, value in by_segment.items()
        if sine_frequency(label)
    }
    return Errors(percent(residual), by_segment, by_frequency)


@cache
def example(verdict: str = 'named') -> Diagnosis:
    """
    Return a diagnosis with a verdict of one's choice.

    'named' has creep in it; 'class' adds what it cannot be told from, 'partly_explained' leaves
    something; 'unexplained' and 'none' have no effect, 'refitted' another H and a class.
    """
    record = measured()
    (piece,) = record.pieces
    given = piece.y - slow_model().predict_piece(piece)
    h = slow_model().hysteresis
    other_h = replace(slow_model(), hysteresis=replace(h, p2=1.02 * h.p2))
    before = given - given.mean()
    added = verdict in ('named', 'class', 'partly_explained')
    refit = verdict == 'refitted'
    after = piece.y - refined_model().predict_piece(piece) if added else before
    if verdict == 'none':
        given = before = after = NOISE * np.random.default_rng(4).standard_normal(piece.n)
    if refit:
        before = after = NOISE * np.random.default_rng(4).standard_normal(piece.n)
    effect = FoundEffect(
        name='creep',
        slot='hidden',
        share=0.93,
        rms_percent=errors(record, before - after).overall,
        parameters={
            'gain': FoundParameter((0.012, 0.01), '1', (0.0004, 0.0006)),
            'time_constant': FoundParameter((0.1, 1.0), 's', None),
        },
    )
    sentences = {
        'named': 'Creep explains 93 % of what the model missed.',
        'class': 'Creep or thermal drift explains 93 % of what the model missed.',
        'partly_explained': 'Creep explains 60 % of what the model missed; 0.2 % is left.',
        'refitted': 'The hysteresis of the model is not that of these data.',
        'unexplained': 'No candidate explains what the model misses.',
        'none': 'Nothing is missing that these data could show.',
    }
    group = Class(('creep', 'thermal_drift', 'gain_drift'), 'a hold of 10 s after a step')
    return Diagnosis(
        verdict=verdict,
        sentence=sentences[verdict],
        given=slow_model(),
        model=refined_model() if added else other_h if refit else slow_model(),
        effects=(effect,) if added else (),
        group=group if verdict in ('class', 'refitted') else None,
        unexplained=Unexplained(
            0.07 if added else 1.0,
            errors(record, after).overall,
            'no line, no dependence on v or its rate beyond chance',
        ),
        candidates=(
            Candidate('rate_dependent_hysteresis', 0.29, 'creep explains more; nothing is left'),
            Candidate('thermal_drift', 0.12, 'helps the holds and harms the sines'),
            Candidate('gain_drift', 0.11, 'no more than chance gives'),
            Candidate('backlash', 0.02, 'no more than chance gives'),
            Candidate('preload_loss', 0.01, 'no more than chance gives'),
            Candidate('saturation', 0.0, 'gains nothing'),
            Candidate('slew_limit', -0.01, 'gains nothing at all'),
        ),
        before=errors(record, given),
        refit=errors(record, before),
        after=errors(record, after),
        noise_floor=100.0 * NOISE / record.stroke,
        noise_source='2 idle stretches',
        smallest_detectable=0.02,
        untestable=(Untestable('cross_coupling', 'a recorded voltage of another axis'),),
        faults=(Fault('outliers', 'in val.npz at 1.2 s', 3, 'left out'),),
        residuals=(
            Residual(record.name, piece, given, before, after, np.ones(piece.n, dtype=bool)),
        ),
        records=(record.name,),
        blocks=40,
        warnings=('no repeated periods',),
        settings=DiagnosisSettings(seed=5),
        law='preisach' if refit else 'plays',
        errors_of_laws={'plays': 0.3, 'duhem': 0.1},
        kinds=('sine:5Hz', 'staircase', 'sine:50Hz') if refit else (),
    )


def hostile() -> Diagnosis:
    """Return a diagnosis in which every text that comes from outside tries to do harm."""
    found = example('class')
    (residual,), (effect,) = found.residuals, found.effects
    segments = tuple(replace(s, label=HOSTILE) for s in residual.piece.segments)
    values = Errors(0.1, {HOSTILE: 0.1}, {})
    return replace(
        found,
        sentence=f'Something of {HOSTILE}.',
        effects=(replace(effect, parameters={'channel': FoundParameter(HOSTILE, HOSTILE, None)}),),
        candidates=(Candidate('backlash', 0.5, HOSTILE), *found.candidates),
        unexplained=Unexplained(0.1, 0.1, HOSTILE),
        before=values,
        refit=values,
        after=values,
        noise_source=HOSTILE,
        untestable=(Untestable('creep', HOSTILE),),
        faults=(Fault('repeats', HOSTILE, 3, HOSTILE),),
        residuals=(
            replace(residual, record=HOSTILE, piece=replace(residual.piece, segments=segments)),
        ),
        records=(HOSTILE,),
        warnings=(HOSTILE,),
    )

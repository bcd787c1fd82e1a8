# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What a case of `truths` hands over: the records of a lab, and what is true of them.

    records = case_records(draw('tuning', 7))
    records.identification, records.diagnosis, records.unseen, records.truth
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from piezo_ident.excitation.program import parse_program, Program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.settings import Settings
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Piece, Record, Segment
from truths import (
    Case,
    FamilyStage,
    make_family_stage,
    make_stage,
    Motion,
    other_axis,
    program,
    record_motion,
    references,
)
from truths.faults import spoilt
from truths.linear import RATE
from truths.references import basis, FORMS, remainder, ROWS
from truths.sizes import scaled

#: of the package's own `program_identification.yaml`, in other ranges and a little shorter
PROGRAM = """
limits: [{low}, {high}]
rest: {rest}
seed: 1
slew: {slew}
segments:
  - {{signal: idle, duration: 0.3}}
  - {{signal: step, bias: {middle}, size: {step}, hold: 0.06, count: 12}}
  - {{signal: settle, bias: {middle}, amplitude: {settle}, cycles: 16, frequency: 20}}
  - {{signal: noise, bias: {middle}, amplitude: {noise}, cutoff: {cutoff}, duration: {duration}}}
  - {{signal: triangle, slope: {slope}}}
"""
#: behind it, of `program_identification_loops.yaml`
LOOPS = """
  - {{signal: decaying_triangle, name: loops, bias: {middle}, amplitude: {large}, cycles: 5,
      slope: {slew}}}
  - {{signal: multisine, name: slow, bias: {middle}, amplitude: {large}, lowest: 0.5, highest: 10,
      period: 2, periods: 1}}
  - {{signal: multisine, name: fast, bias: {middle}, amplitude: {large}, lowest: 1, highest: 100,
      period: 1, periods: 1}}
"""
IDLE = '  - {{signal: idle, duration: 0.3}}\n'


@dataclass(frozen=True, eq=False)
class Records:
    """
    What a case hands over, and what is true of it.

    `truth`: every hidden effect and its size on the diagnosis record: the rms of what it changes
    behind offset and gain, % of stroke; `left`: what a refit of forty plays leaves of each, % of
    stroke; `misfit`: error of forty plays with the true linear part, fitted on the identification,
    of the stage without its effects, on the unseen record, % of stroke; `unseen_forms`: error on
    the unseen record of each form of the hysteresis, likewise; `stage`: with the effects in it.
    """

    identification: Record
    diagnosis: Record
    unseen: Record
    truth: dict[str, float]
    left: dict[str, float]
    fault: str
    misfit: float
    unseen_forms: dict[str, float]
    stage: FamilyStage


def record_of(
    v: np.ndarray,
    y: np.ndarray,
    labels: Sequence[tuple[str, int, int]],
    name: str,
    channels: dict[str, np.ndarray] | None,
) -> Record:
    """Return a record as a lab would hand it over."""
    segments = tuple(Segment(*label) for label in labels)
    return Record((Piece(v, y, RATE, segments=segments, channels=channels or {}),), name)


@cache
def measured(
    effects: tuple[str, ...], size: float, seed: int, noise: str
) -> tuple[StageModel, Record, Record]:
    """Return model, record to diagnose and unseen record."""
    effect: Any = effects[0] if len(effects) == 1 else effects or None
    stage = make_stage(effect, size, seed, noise=noise)
    coupled = 'cross_coupling' in effects

    def other(t: np.ndarray, number: int) -> dict[str, np.ndarray] | None:
        return {'other': other_axis(t, np.random.default_rng(number))} if coupled else None

    sequence = Program.load('program_identification.yaml').build(sample_rate=RATE)
    t = np.arange(sequence.n) / RATE
    y = stage.respond(t, sequence.v, changed=False, channels=other(t, seed))
    labels = [(s.label, s.start, s.stop) for s in sequence.segments]
    record = record_of(sequence.v, y, labels, 'identification', None)
    model = identify(record, Settings(thresholds=10)).model
    records = []
    for number, kind in enumerate(('diagnosis', 'unseen')):
        t, v, labels = program(kind, seed)
        channels = other(t, 100 + 10 * number + seed)
        y = stage.respond(t, v, changed=True, channels=channels)
        records.append(record_of(v, y, labels, kind, channels))
    return model, records[0], records[1]


def motions(case: Case, stage: FamilyStage, loops: bool = False) -> dict[str, Motion]:
    """Return the motion of each record of a case in parts of the range; see `case_records`."""
    (low, high), rng = stage.limits, np.random.default_rng([606, case.seed])
    # a bipolar amplifier often rests at 0 V, which is not its lowest voltage
    rest = -low / (high - low) if low < 0 and rng.random() < 0.5 else 0.0
    found = {}
    for name in ('identification', 'diagnosis', 'unseen'):
        if name == 'identification' and case.labelled:
            found[name] = programmed(stage, rest, loops)
        else:
            found[name] = record_motion(
                name,
                stage.rate,
                np.random.default_rng([len(name), case.seed]),
                labelled=case.labelled,
                poorer=case.poorer if name == 'diagnosis' else '',
                first=stage.linear.modes[0][0],
                rest=rest,
            )
    return found


def programmed(stage: FamilyStage, rest: float, loops: bool = False) -> Motion:
    """Return the program of the identification in the stage's range."""
    low, high = stage.limits
    span, fast = high - low, stage.rate > 30_000
    text = (PROGRAM.rstrip() + (LOOPS if loops else '\n') + IDLE).format(
        low=low,
        high=high,
        rest=low + rest * span,
        slew=3.0 * span,
        middle=low + 0.5 * span,
        step=0.1 * span,
        settle=0.048 * span,
        noise=0.04 * span,
        cutoff=min(3000.0, 0.3 * stage.rate),
        duration=2.0 if fast else 3.0,
        slope=(1.6 if fast else 1.1) * span,
        large=0.45 * span,
    )
    sequence = parse_program(text).build(sample_rate=stage.rate)
    labels = tuple((s.label, s.start, s.stop) for s in sequence.segments)
    return Motion((sequence.v - low) / span, labels)


def case_records(case: Case, forms: bool = True, loops: bool = False) -> Records:
    """
    Return the records of a case, and the truth.

    `case`: of `truths.draw`; `forms`: also compare forms of the hysteresis, which takes some
    seconds; `loops`: a labelled identification follows the program with loops of all sizes.
    """
    stage = make_family_stage(case.core, case.seed, case.effects, further=case.group != 'tuning')
    low, high = stage.limits
    moved = motions(case, stage, loops)
    volts = {name: low + (high - low) * m.u for name, m in moved.items()}
    plain = {
        name: (v, stage.read(stage.respond(v, name, {}, clean=True), name))
        for name, v in volts.items()
        if name != 'diagnosis'
    }
    sweeps = [x[1:] for x in moved['identification'].labels if x[0].startswith('triangle')]
    best = references(stage, plain, FORMS if forms else ('forty plays',), sweeps)
    misfit = best['forty plays']
    coupled = 'cross_coupling' in case.effects
    others = {
        name: other_axis(
            np.arange(v.size) / stage.rate, np.random.default_rng([len(name), 7, case.seed])
        )
        * (high - low)
        / 10.0
        for name, v in volts.items()
        if name != 'identification' and (coupled or case.idle_channel)
    }
    gains, truth, left = {}, {}, {}
    v = volts['diagnosis']
    if case.effects:
        X, _ = basis(stage, v, 'diagnosis', 'forty plays')
        without = stage.respond(v, 'diagnosis', {}, clean=True)
    for effect, factor in zip(case.effects, case.factors, strict=True):
        other = others.get('diagnosis')
        gains[effect], truth[effect] = scaled(stage, effect, factor * misfit, v, other)
        change = stage.respond(v, 'diagnosis', {effect: gains[effect]}, other, clean=True)
        change = (change - without)[:: max(1, v.size // ROWS)]
        left[effect] = 100.0 * remainder(X, change) / float(np.ptp(without))
    stage = replace(stage, gains=gains)
    made = {}
    for name, v in volts.items():
        other = others.get(name) if coupled else None
        y = stage.respond(v, name, other=other)
        if case.fault and name == 'diagnosis':
            y = stage.respond(v, name, clean=True)
            rng = np.random.default_rng([77, case.seed])
            # a clock's jitter is older than the sensor's noise
            if case.fault == 'jitter':
                y = stage.read(spoilt(y, case.fault, stage.rate, rng), name)
            else:
                y = spoilt(stage.read(y, name), case.fault, stage.rate, rng)
            y = stage.offset + stage.stroke * y
        labels = moved[name].labels
        made[name] = Record.from_arrays(
            v,
            y,
            sample_rate=stage.rate,
            segments=([x[0] for x in labels], [x[1] for x in labels]) if labels else None,
            channels={'other': others[name]} if name in others else None,
            name=name,
        )
    return Records(
        **made,
        truth=truth,
        left=left,
        fault=case.fault,
        misfit=misfit,
        unseen_forms=best,
        stage=stage,
    )

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What `bench_growth` measures of identification and diagnosis.

Each function takes a length [s] and a folder, and returns a time [s] and the number of samples.
"""

from __future__ import annotations

import os

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from collections.abc import Callable
from pathlib import Path
import time

from growth_of_bags import Measure, RATE
import numpy as np
from numpy.typing import NDArray
from piezo_ident.diagnosis import diagnose, DiagnosisSettings
from piezo_ident.excitation.program import parse_program, Program
from piezo_ident.identification.identify import identify
from piezo_ident.model.files import load
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Piece, Record, Segment

__all__ = ['EFFECT', 'FIT_MEASURES', 'base_model', 'labelled', 'to_diagnose']

#: the effect that the diagnosed stage has, and its size [% of stroke]
EFFECT, SIZE = 'creep', 0.3
#: longest program of an identification; what is longer is several records [s]
LONGEST = 1800.0
#: seconds of the identification record of which the longer ones are multiples
SHIPPED = 15.5
PROGRAM = """
limits: [0, 10]
sample_rate: 20000
seed: 1
slew: 20
segments:
  - {{signal: idle, duration: 0.3}}
  - {{signal: step, bias: 5, size: 1, hold: 0.06, count: {steps}}}
  - {{signal: settle, bias: 5, amplitude: 0.48, cycles: 24, frequency: 20}}
  - {{signal: noise, bias: 5, amplitude: 0.4, cutoff: 3000, duration: {noise}}}
  - {{signal: triangle, slope: {slope}}}
  - {{signal: idle, duration: 0.3}}
"""


def labelled(times: float) -> Record:
    """Return the identification record with noise, steps and triangle so many times as long."""
    text = PROGRAM.format(steps=2 * round(8 * times), noise=5 * times, slope=6 / times)
    stage = SimulatedStage.load('paper')
    return stage.play(parse_program(text).build(RATE), np.random.default_rng(0))


def identifying(size: float, folder: Path) -> Measure:
    """Identify by the three steps; the record of 15.5 s has everything as it is shipped."""
    identify(labelled(0.5))
    count = int(-(-size // LONGEST))
    records = [labelled(size / count / SHIPPED) for _ in range(count)]
    start = time.perf_counter()
    identify(records)
    return time.perf_counter() - start, sum(record.n for record in records)


def _command(size: float, seed: int) -> tuple[NDArray[np.float64], tuple[Segment, ...]]:
    """Return the diagnosis program over and over, and its segments."""
    from truths import program

    _, v, labels = program('diagnosis', seed)
    n = round(size * RATE)
    count = -(-n // v.size)
    segments = [
        (
            label if not k else f'{label}{"" if ":" in label else ":"}r{k}',
            a + k * v.size,
            b + k * v.size,
        )
        for k in range(count)
        for label, a, b in labels
    ]
    kept = tuple(Segment(label, a, min(b, n)) for label, a, b in segments if a < n)
    return np.tile(v, count)[:n], kept


def _answer(v: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """Return what a stage with an effect answers [m]."""
    from truths import make_stage

    stage = make_stage(EFFECT, SIZE, seed, noise='white')
    return stage.respond(np.arange(v.size) / RATE, v, changed=True, channels=None)


def to_diagnose(size: float, seed: int = 1) -> Record:
    """Return the answer of a stage with an effect to the diagnosis program, over and over."""
    v, segments = _command(size, seed)
    return Record((Piece(v, _answer(v, seed), RATE, segments=segments),), 'diagnosis')


def base_model(folder: Path, seed: int = 1) -> StageModel:
    """Return the model of the stage that is diagnosed, identified before the effect."""
    from truths import make_stage

    path = folder / 'base.yaml'
    if not path.exists():
        stage = make_stage(EFFECT, SIZE, seed, noise='white')
        sequence = Program.load('identification').build(RATE)
        t = np.arange(sequence.n) / RATE
        y = stage.respond(t, sequence.v, changed=False, channels=None)
        piece = Piece(sequence.v, y, RATE, segments=tuple(sequence.segments))
        identify(Record((piece,), 'identification')).model.save(path)
    return load(path)


def diagnosing(size: float, folder: Path) -> Measure:
    """Diagnose with the whole catalogue."""
    model = base_model(folder)
    diagnose(model, to_diagnose(17.0), DiagnosisSettings(effects=(EFFECT,)))
    record = to_diagnose(size)
    start = time.perf_counter()
    diagnose(model, record, DiagnosisSettings())
    return time.perf_counter() - start, record.n


FIT_MEASURES: dict[str, Callable[[float, Path], Measure]] = {
    'identify': identifying,
    'diagnose': diagnosing,
}

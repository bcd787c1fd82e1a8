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
import json
from pathlib import Path
import sys
import time

from growth_of_bags import Measure, RATE
import numpy as np
from numpy.typing import NDArray
from piezo_ident.diagnosis import diagnose, DiagnosisSettings
from piezo_ident.diagnosis.beginnings import rest_of
from piezo_ident.excitation.program import parse_program, Program
from piezo_ident.identification.identify import identify
from piezo_ident.model.files import load
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Piece, Record, Segment
from side_by_side import last_line, markdown, peak_memory, seconds

__all__ = ['EFFECT', 'FIT_MEASURES', 'base_model', 'beginnings', 'labelled', 'to_diagnose']

#: the effect that the diagnosed stage has, and its size [% of stroke]
EFFECT, SIZE = 'creep', 0.3
#: longest programme of an identification; what is longer is several records [s]
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
    """Return the diagnosis programme over and over, and its segments."""
    from truths import programme

    _, v, labels = programme('diagnosis', seed)
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
    """Return the answer of a stage with an effect to the diagnosis programme, over and over."""
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


# -- a long record from its beginning ------------------------------------------------------------


def beginnings(quick: bool, folder: Path) -> str:
    """Return the table of long records that are diagnosed from their beginnings."""
    base_model(folder)
    most = DiagnosisSettings().most_samples
    pairs = [(300, 20), (300, 60), (300, 300), (3600, most / RATE)]
    rows = []
    for size, used in [(20, 17), (20, 20)] if quick else pairs:
        here = [sys.executable, str(Path(__file__).resolve())]
        sizes = [f'{size:g}', f'{used:g}', str(folder)]
        last_line('the answer', [*here, '--answer', *sizes])
        cells = last_line(f'diagnosis of {size:g} s', [*here, '--beginning', *sizes])
        rows.append([f'{size:g} s', f'{used:g} s', *json.loads(cells)])
    heads = (
        'record',
        'searched',
        'found',
        'whole record: as given, refined',
        'unseen record: as given, refined',
        'time',
        'peak memory',
    )
    return '\n\n'.join(
        (
            '**Diagnosis of a long record: its beginning is searched, what was found is fitted to '
            f'all of it.** More than {most:,} samples are not searched unless asked for. Errors '
            'in % of stroke, free run; the unseen record is another programme.',
            markdown(heads, rows),
        )
    )


def answer(size: float, folder: Path) -> None:
    """Leave the answer over so many seconds in the folder: its memory is none of a diagnosis."""
    path = folder / f'answer_{size:g}.npy'
    if not path.exists():
        np.save(path, _answer(_command(size, 1)[0], 1))


def beginning(size: float, used: float, folder: Path) -> list[str]:
    """Diagnose the beginning of a record; return the cells of its row."""
    from truths import make_stage, programme

    model = base_model(folder)
    diagnose(model, to_diagnose(17.0), DiagnosisSettings(effects=(EFFECT,)))
    v, segments = _command(size, 1)
    y = np.load(folder / f'answer_{size:g}.npy')
    record = Record((Piece(v, y, RATE, segments=segments),), 'long')
    del v, y
    start = time.perf_counter()
    found = diagnose(model, record, DiagnosisSettings(most_samples=round(used * RATE)))
    took, peak = time.perf_counter() - start, peak_memory()
    t, v, _ = programme('unseen', 1)
    unseen = Piece(v, make_stage(EFFECT, SIZE, 1, noise='white').respond(t, v), RATE)
    errors = [
        ', '.join(f'{rest_of(m, [r], [r]).used:.4f}' for m in (model, found.model))
        for r in (record, Record((unseen,), 'unseen'))
    ]
    names = ', '.join(effect.name for effect in found.effects)
    return [f'{found.verdict}: {names}', *errors, seconds(took), f'{peak:.0f} MiB']


if __name__ == '__main__':
    what, length, most, place = sys.argv[1:]
    if what == '--answer':
        answer(float(length), Path(place))
    else:
        print(json.dumps(beginning(float(length), float(most), Path(place))))

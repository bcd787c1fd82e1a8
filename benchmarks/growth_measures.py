# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What `bench_growth` measures over the length of a record, each in a process of its own.

A measure takes a length [s] and a folder, in which `write` has left a bag of that length, and
returns a time [s] and the number of samples.
"""

from __future__ import annotations

import os

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from collections.abc import Callable
import contextlib
import io
from pathlib import Path
import time

import numpy as np
import piezo_ident as pi
from piezo_ident.cli import main as piezo_ident
from piezo_ident.excitation.program import parse_program
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Piece, Record, Segment
from side_by_side import take_turns
from truths import make_stage, program

RATE = 20_000.0
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

Measure = tuple[float, float]


def paper() -> StageModel:
    """Return the paper's stage."""
    return pi.SimulatedStage.load('paper').model


def sine(n: int) -> Piece:
    """Return a record of a 50 Hz sine without its answer."""
    v = 5.0 + 5.0 * np.sin(2 * np.pi * 50.0 * np.arange(n) / RATE)
    return Piece(v, np.zeros(n), RATE)


def labelled(times: float) -> Record:
    """Return the identification record with noise, steps and triangle so many times as long."""
    text = PROGRAM.format(steps=2 * round(8 * times), noise=5 * times, slope=6 / times)
    stage = pi.SimulatedStage.load('paper')
    return stage.play(parse_program(text).build(RATE), np.random.default_rng(0))


def to_diagnose(size: float) -> Record:
    """Return the answer of a stage with an effect to the diagnosis program, over and over."""
    _, v, labels = program('diagnosis', 1)
    n = round(size * RATE)
    segments = []
    for k in range(-(-n // v.size)):
        for label, start, stop in labels:
            name = label if not k else f'{label}{"" if ":" in label else ":"}r{k}'
            if start + k * v.size < n:
                segments.append(Segment(name, start + k * v.size, min(stop + k * v.size, n)))
    v = np.resize(v, n)
    y = make_stage(EFFECT, SIZE, 1, noise='white').respond(np.arange(n) / RATE, v)
    return Record((Piece(v, y, RATE, segments=tuple(segments)),), 'diagnosis')


def base_model(folder: Path) -> StageModel:
    """Return the model of the stage that is diagnosed, identified before the effect."""
    path = folder / 'base.yaml'
    if not path.exists():
        sequence = pi.Program.load('identification').build(RATE)
        stage = make_stage(EFFECT, SIZE, 1, noise='white')
        y = stage.respond(np.arange(sequence.n) / RATE, sequence.v, changed=False)
        piece = Piece(sequence.v, y, RATE, segments=tuple(sequence.segments))
        pi.identify(Record((piece,), 'identification')).model.save(path)
    return pi.load(path)


def nothing(size: float, folder: Path) -> Measure:
    """Import all, and predict a little: the memory that is there before any record."""
    paper().stream().process(np.zeros(10))
    return 0.0, 0


def predict(size: float, folder: Path) -> Measure:
    """Predict a record that is in memory."""
    model, piece = paper(), sine(round(size * RATE))
    model.predict_piece(sine(1000))
    turn = take_turns({'': lambda k: model.predict_piece(piece)}, 5 if piece.n < 5e6 else 2)['']
    return turn.median, piece.n


def stream(size: float, folder: Path) -> Measure:
    """Predict second by second and forget what is done."""
    model, v = paper(), sine(int(RATE)).v
    model.stream().process(v)
    running = model.stream()
    start = time.perf_counter()
    for _ in range(round(size)):
        running.process(v)
    return time.perf_counter() - start, round(size) * v.size


def write(size: float, folder: Path) -> Measure:
    """Write a record as a bag."""
    model = paper()
    took = 0.0
    # the short one is what the other measures warm up on
    for seconds, name in ((1.0, 'short'), (size, f'bag_{size:g}')):
        piece = sine(round(seconds * RATE))
        record = Record((Piece(piece.v, model.predict_piece(piece), RATE),), 'long')
        start = time.perf_counter()
        pi.write(record, folder / name, overwrite=True)
        took = time.perf_counter() - start
    return took, record.n


def read(size: float, folder: Path) -> Measure:
    """Read a bag into a record."""
    for bag in ('short', f'bag_{size:g}'):
        start = time.perf_counter()
        record = pi.read(folder / bag)
    return time.perf_counter() - start, record.n


def convert(size: float, folder: Path) -> Measure:
    """Measure ``piezo_ident convert BAG OUT.npz``."""
    return _command(size, folder, lambda bag, out: ['convert', bag, out])


def predict_bag(size: float, folder: Path) -> Measure:
    """Measure ``piezo_ident predict MODEL BAG --out OUT.npz``."""
    model = folder / 'paper.yaml'
    paper().save(model)
    return _command(
        size, folder, lambda bag, out: ['predict', str(model), bag, '--overwrite', '--out', out]
    )


def _command(size: float, folder: Path, arguments: Callable[[str, str], list[str]]) -> Measure:
    out = folder / 'out.npz'
    took = 0.0
    for bag in ('short', f'bag_{size:g}'):
        start = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()) as output:
            status = piezo_ident([*arguments(str(folder / bag), str(out))])
        took = time.perf_counter() - start
        if status:
            raise RuntimeError(output.getvalue())
        out.unlink()
    return took, round(size * RATE)


def identify(size: float, folder: Path) -> Measure:
    """Identify by the three steps; the record of 15.5 s has everything as it is shipped."""
    pi.identify(labelled(0.5))
    count = int(-(-size // LONGEST))
    records = [labelled(size / count / SHIPPED) for _ in range(count)]
    start = time.perf_counter()
    pi.identify(records)
    return time.perf_counter() - start, sum(record.n for record in records)


def diagnose(size: float, folder: Path) -> Measure:
    """Diagnose with the whole catalogue."""
    model = base_model(folder)
    pi.diagnose(model, to_diagnose(17.0), pi.DiagnosisSettings(effects=(EFFECT,)))
    record = to_diagnose(size)
    start = time.perf_counter()
    pi.diagnose(model, record)
    return time.perf_counter() - start, record.n


MEASURES: dict[str, Callable[[float, Path], Measure]] = {
    measure.__name__: measure
    for measure in (
        *(nothing, stream, predict, write, read, convert, predict_bag),
        *(identify, diagnose),
    )
}

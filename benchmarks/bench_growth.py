# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
How time and memory grow with the record, the thresholds, the orders and the candidates.

    .venv-bench/bin/python benchmarks/bench_growth.py [--quick]
    .venv-bench/bin/python benchmarks/bench_growth.py --measure identify 3600 FOLDER

Each length is measured in a process of its own, which warms up on a short record and tells its
peak resident memory.  The exponent is the slope of log time over log size at the large end: 1 is a
straight line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import contextlib
from dataclasses import replace
import io
import json
from pathlib import Path
import shutil
import sys
import tempfile
import time

import alone  # noqa: F401 - one thread of BLAS
import any_record
from bench_inverse import EFFECTS as INVERTED
from bench_inverse import motion
import numpy as np
import piezo_ident as pi
from piezo_ident.cli import main as piezo_ident
from piezo_ident.effects import catalogue
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.solvers.arx import arx_factor, scan_orders
from piezo_ident.identification.step3_hysteresis import factorise, fit_hysteresis
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.record import Piece, Record, Segment
from side_by_side import last_line, markdown, peak_memory, seconds, show, take_turns
from truths import make_stage, program

RATE, HOUR = 20_000.0, 3600.0
#: points at the large end through which the exponent is drawn
LARGE_END = 3
#: bytes that a second of voltage and displacement takes in a bag, and how much must stay free
BAG_BYTES, SPARE = 2 * 16 * RATE * 1.1, 4e9
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


def paper() -> StageModel:
    """Return the paper's stage."""
    return pi.SimulatedStage.load('paper').model


def sine(n: int) -> Piece:
    """Return a record of a 50 Hz sine without its answer."""
    return Piece(5.0 + 5.0 * np.sin(2 * np.pi * 50.0 * np.arange(n) / RATE), np.zeros(n), RATE)


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


# -- measures: each takes a length [s] and a folder, in which `write` has left a bag of that
# -- length, and returns a time [s] and the number of samples


def clocked(work: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the time of a work."""
    start = clock()
    work()
    return clock() - start


def nothing(size: float, folder: Path) -> tuple[float, int]:
    """Import all, and predict a little: the memory that is there before any record."""
    paper().stream().process(np.zeros(10))
    return 0.0, 0


def predict(size: float, folder: Path) -> tuple[float, int]:
    """Predict a record that is in memory."""
    model, piece = paper(), sine(round(size * RATE))
    model.predict_piece(sine(1000))
    turn = take_turns({'': lambda k: model.predict_piece(piece)}, 5 if piece.n < 5e6 else 2)['']
    return turn.median, piece.n


def stream(size: float, folder: Path) -> tuple[float, int]:
    """Predict second by second and forget what is done."""
    model, v = paper(), sine(int(RATE)).v
    model.stream().process(v)
    running = model.stream()
    return clocked(lambda: [running.process(v) for _ in range(round(size))]), round(size) * v.size


def write(size: float, folder: Path) -> tuple[float, int]:
    """Write a record as a bag."""
    model, took = paper(), 0.0
    # the short one is what the other measures warm up on
    for length_, name in ((1.0, 'short'), (size, f'bag_{size:g}')):
        piece = sine(round(length_ * RATE))
        record = Record((Piece(piece.v, model.predict_piece(piece), RATE),), 'long')
        took = clocked(lambda r=record, n=name: pi.write(r, folder / n, overwrite=True))
    return took, record.n


def read(size: float, folder: Path) -> tuple[float, int]:
    """Read a bag into a record."""
    took = [clocked(lambda b=bag: pi.read(folder / b)) for bag in ('short', f'bag_{size:g}')]
    return took[-1], round(size * RATE)


def convert(size: float, folder: Path) -> tuple[float, int]:
    """Measure ``piezo_ident convert BAG OUT.npz``."""
    return _command(size, folder, 'convert')


def predict_bag(size: float, folder: Path) -> tuple[float, int]:
    """Measure ``piezo_ident predict MODEL BAG --out OUT.npz``."""
    paper().save(folder / 'paper.yaml')
    return _command(size, folder, 'predict', str(folder / 'paper.yaml'), out='--out')


def _command(size: float, folder: Path, *given: str, out: str = '') -> tuple[float, int]:
    target, took = folder / 'out.npz', 0.0
    for bag in ('short', f'bag_{size:g}'):
        words = [*given, str(folder / bag), *([out] if out else []), str(target)]
        with contextlib.redirect_stdout(io.StringIO()) as output:
            took = clocked(lambda w=words: piezo_ident(w))
        if not target.exists():
            raise RuntimeError(output.getvalue())
        target.unlink()
    return took, round(size * RATE)


def identify(size: float, folder: Path) -> tuple[float, int]:
    """Identify by the three steps; the record of 15.5 s has everything as it is shipped."""
    pi.identify(labelled(0.5))
    count = int(-(-size // LONGEST))
    records = [labelled(size / count / SHIPPED) for _ in range(count)]
    return clocked(lambda: pi.identify(records)), sum(record.n for record in records)


def unlabelled(size: float, folder: Path) -> tuple[float, int]:
    """Identify a record of noise without labels, of a stage whose law is not the model's."""
    short, case = (any_record.draw('preisach', 'noise', 1, seconds=s) for s in (2.0, size))
    any_record.program(short.fit)
    took = clocked(lambda: any_record.program(case.fit), time.process_time)
    return took, sum(v.size for v, _ in case.fit)


def diagnose(size: float, folder: Path) -> tuple[float, int]:
    """Diagnose with the whole catalogue."""
    model, record = base_model(folder), to_diagnose(size)
    pi.diagnose(model, to_diagnose(17.0), pi.DiagnosisSettings(effects=(EFFECT,)))
    return clocked(lambda: pi.diagnose(model, record), time.process_time), record.n


def inverse(size: float, folder: Path) -> tuple[float, int]:
    """Invert a motion of a model with amplifier lag, creep and a bent sensor."""
    model = replace(paper(), effects=INVERTED)
    y = motion(model, round(size * RATE))
    model.inverse(motion(model, 20_000))
    return clocked(lambda: model.inverse(y)), y.size


BAGS = (10, 60, 600, HOUR)
#: of each measure its title, lengths [s], and those of a quick run
PLANS = {
    stream: ('prediction, streamed', BAGS, (10, 60)),
    predict: ('prediction in memory', (10, 30, 60, 120, 300, 600), (10, 60)),
    write: ('bag written', BAGS, (10, 60)),
    read: ('bag read', BAGS, (10, 60)),
    convert: ('bag converted to npz', BAGS, (10,)),
    predict_bag: ('bag predicted to npz', BAGS, (10, 60)),
    inverse: ('inversion', (1, 4, 16, 64), (1, 4, 16)),
    identify: ('identification', (15.5, 31, 62, 124, HOUR), (15.5,)),
    unlabelled: ('identification, no labels, 10 kHz, processor time', (6, 30, 100), (6,)),
    diagnose: (
        f'diagnosis, {len(catalogue())} candidates, processor time',
        (15, 30, 60, 120),
        (17,),
    ),
}
MEASURES = {measure.__name__: measure for measure in (nothing, *PLANS)}
OF_BAGS = (write, read, convert, predict_bag)


def measured(kind: str, size: float, folder: Path) -> tuple[float, float, float]:
    """Return time [s], samples and peak memory [MiB] of a measure in a process of its own."""
    command = [sys.executable, str(Path(__file__).resolve()), '--measure', kind, f'{size:g}']
    took, n, peak = json.loads(last_line(f'{kind} of {size:g} s', [*command, str(folder)]))
    return took, n, peak


def exponent(sizes: Sequence[float], times: Sequence[float]) -> float:
    """Return the slope of log time over log size at the large end."""
    if len(sizes) < 2:
        return float('nan')
    x, y = (np.log(np.asarray(z[-LARGE_END:], dtype=float)) for z in (sizes, times))
    return float(np.polyfit(x, y, 1)[0])


def length(size: float) -> str:
    """Return a time in words."""
    if size < 120:
        return f'{size:g} s'
    return f'{size / 60:g} min' if size < 3600 else f'{size / 3600:g} h'


def along_the_record(
    kind: str, title: str, sizes: Sequence[float], folder: Path
) -> list[list[str]]:
    """Return the rows of one measure over the record length; the last one says how it grows."""
    found = [measured(kind, size, folder) for size in sizes]
    times, peaks = [f[0] for f in found], [f[2] for f in found]
    rows = [
        [title, length(size), f'{n:,.0f}', seconds(t), f'{peak:.0f}', '', '']
        for size, (t, n, peak) in zip(sizes, found, strict=True)
    ]
    if len(sizes) > 1:
        more, samples = peaks[-1] - peaks[0], (found[-1][1] - found[0][1]) / 1e6
        rows[-1][-2:] = [f'{exponent(sizes, times):.2f}', f'{more / samples:.2f}']
    return rows


HEADS = (
    *('work', 'record', 'samples', 'time', 'peak / MiB'),
    *('exponent', 'MiB per million samples'),
)


def of_length(quick: bool, folder: Path) -> str:
    """Return the text over the record length."""
    base = measured('nothing', 0.0, folder)[2]
    rows, notes = [], []
    # the hour as a bag takes some gigabytes for a moment, and what is made of it too
    has_room = shutil.disk_usage(folder).free >= 4 * HOUR * BAG_BYTES + SPARE
    for measure, (title, sizes, few) in PLANS.items():
        lengths = few if quick else sizes
        if measure in OF_BAGS and HOUR in lengths and not has_room:
            lengths = lengths[:-1]
            notes.append(f'Too little room on the disk for a bag of 1 h ({title.lower()}).')
        rows += along_the_record(measure.__name__, title, lengths, folder)
    for path in folder.glob('bag_*'):
        shutil.rmtree(path)
    intro = (
        f'At {RATE / 1000:g} kHz, each length in a process of its own. The exponent is the slope '
        f'of log time over log length through the {LARGE_END} longest. A process that does next '
        f'to nothing peaks at {base:.0f} MiB.'
    )
    return '\n'.join([intro, '', markdown(HEADS, rows), '', *notes])


def table_of(what: str, sizes: Sequence[int], columns: dict[str, list[float]]) -> str:
    """Return a table of times over a size, with its exponents as the last row."""
    rows = [[f'{n}', *(seconds(t[i]) for t in columns.values())] for i, n in enumerate(sizes)]
    rows.append(['exponent', *(f'{exponent(sizes, times):.2f}' for times in columns.values())])
    return markdown((what, *columns), rows)


def timed(work: Callable[[], object], runs: int) -> float:
    """Return the median time of a work after a first run."""
    return take_turns({'': lambda k: work()}, runs, warm=[''])[''].median


def of_thresholds(quick: bool) -> str:
    """Return the table over the number of thresholds."""
    sizes = (5, 20) if quick else (5, 10, 20, 50, 100, 200)
    model, n = paper(), 100_000 if quick else 400_000
    (piece,) = labelled(0.5 if quick else 1.0).pieces
    (triangle,) = piece.find('triangle')
    use = np.zeros(piece.n, dtype=bool)
    use[triangle.start : triangle.stop] = True
    excerpt = Excerpt(model.scaling.u(piece.v), model.scaling.x(piece.y), use)
    predictions, weights, long = [], [], sine(n)
    for m in sizes:
        r = np.arange(1, m + 1) / (m + 1)
        h = Hysteresis(r, np.full(m, 1.0 / m), 0.0, 0.5)
        wide = StageModel(model.sample_rate, model.scaling, h, model.dynamics, model.delay)
        predictions.append(timed(lambda w=wide: w.predict_piece(long), 3))

        def fit(r: np.ndarray = r) -> object:
            R = factorise([excerpt], r, model.dynamics, model.delay)
            return fit_hysteresis(R, r, int(use.sum()))

        weights.append(timed(fit, 1 if m > 50 else 3))
    fitted = f'weights from {triangle.stop - triangle.start:,} samples'
    columns = {f'prediction, {n:,} samples': predictions, fitted: weights}
    return table_of('thresholds', sizes, columns)


def of_orders(quick: bool) -> str:
    """Return the table over the largest order."""
    sizes = (2, 5) if quick else (2, 5, 10, 15, 20, 30)
    model, (piece,) = paper(), labelled(0.5 if quick else 1.0).pieces
    (noise,) = piece.find('noise')
    cut = slice(noise.start, noise.stop)
    u, y = model.scaling.u(piece.v[cut]), model.scaling.x(piece.y[cut])
    u, y = u - u.mean(), y - y.mean()
    n, d = int(0.8 * u.size), model.delay.samples
    factors, scans = [], []
    for most in sizes:
        factors.append(timed(lambda m=most: arx_factor(u[:n], y[:n], m, m + d), 3))
        factor = arx_factor(u[:n], y[:n], most, most + d)
        scans.append(
            timed(lambda f=factor, m=most: scan_orders(f, d, m, u[n:], y[n:]), 1 if quick else 3)
        )
    columns = {f'factor of {n:,} samples': factors, 'all orders from it, with free runs': scans}
    return table_of('largest na and nb', sizes, columns)


def of_candidates(quick: bool, folder: Path) -> str:
    """Return the table over the number of candidates."""
    sizes = (1, 2) if quick else (1, 2, 4, 8, len(catalogue()))
    model, record = base_model(folder), to_diagnose(17.0)
    names = [EFFECT, *(name for name in catalogue() if name != EFFECT)]
    asked = [pi.DiagnosisSettings(effects=tuple(names[:k])) for k in sizes]
    times = [timed(lambda s=s: pi.diagnose(model, record, s), 1) for s in asked]
    return table_of('candidates', sizes, {'diagnosis of 17 s': times})


def sections(quick: bool = False) -> list[tuple[str, str]]:
    """Return titles and texts."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        base_model(folder)
        record = of_length(quick, folder)
        parts = [
            'At one length of the record. Up to order m there are m² orders.',
            of_thresholds(quick),
            of_orders(quick),
            f'The stage has {EFFECT}; the first candidate is that one.',
            of_candidates(quick, folder),
        ]
    return [
        ('Growth with the record', record),
        ('Growth with thresholds, orders and candidates', '\n\n'.join(parts)),
    ]


if __name__ == '__main__':
    if sys.argv[1:2] == ['--measure']:
        kind, size, folder = sys.argv[2:5]
        took, n = MEASURES[kind](float(size), Path(folder))
        print(json.dumps([took, n, peak_memory()]))
    else:
        show(sections)

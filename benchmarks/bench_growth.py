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

import os

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from collections.abc import Callable, Sequence
import json
from pathlib import Path
import shutil
import sys
import tempfile

from growth_measures import base_model, EFFECT, labelled, MEASURES, paper, RATE, sine, to_diagnose
import numpy as np
from piezo_ident.diagnosis import diagnose, DiagnosisSettings
from piezo_ident.effects import catalogue
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.step2_dynamics import arx_factor, scan_orders
from piezo_ident.identification.step3_hysteresis import factorise, fit_hysteresis
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.hysteresis import Hysteresis
from side_by_side import last_line, markdown, peak_memory, seconds, show, take_turns

#: points at the large end through which the exponent is drawn
LARGE_END = 3

#: bytes that a second of voltage and displacement takes in a bag, and how much must stay free
BAG_BYTES, SPARE = 2 * 16 * RATE * 1.1, 4e9
HOUR = 3600.0
#: title, lengths [s], and those of a quick run, of each measure
PLANS: dict[str, tuple[str, tuple[float, ...], tuple[float, ...]]] = {
    'stream': ('prediction, streamed', (10, 60, 600, HOUR), (10, 60)),
    'predict': ('prediction in memory', (10, 30, 60, 120, 300, 600), (10, 60)),
    'write': ('bag written', (10, 60, 600, HOUR), (10, 60)),
    'read': ('bag read', (10, 60, 600, HOUR), (10, 60)),
    'convert': ('bag converted to npz', (10, 60, 600, HOUR), (10,)),
    'predict_bag': (
        'bag predicted to npz',
        (10, 60, 600, HOUR),
        (10, 60),
    ),
    'identify': ('identification', (15.5, 31, 62, 124, HOUR), (15.5,)),
    'diagnose': (f'diagnosis, {len(catalogue())} candidates', (15, 30, 60, 120), (17,)),
}
OF_BAGS = ('write', 'read', 'convert', 'predict_bag')


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


def along_the_record(kind: str, sizes: Sequence[float], folder: Path) -> list[list[str]]:
    """Return the rows of one measure over the record length; the last one says how it grows."""
    found = [measured(kind, size, folder) for size in sizes]
    times, peaks = [f[0] for f in found], [f[2] for f in found]
    rows = [
        [PLANS[kind][0], length(size), f'{n:,.0f}', seconds(t), seconds(t / n), f'{peak:.0f}']
        for size, (t, n, peak) in zip(sizes, found, strict=True)
    ]
    growth = ['', '']
    if len(sizes) > 1:
        more, samples = peaks[-1] - peaks[0], (found[-1][1] - found[0][1]) / 1e6
        growth = [f'{exponent(sizes, times):.2f}', f'{more / samples:.2f}']
    return [*([*row, '', ''] for row in rows[:-1]), [*rows[-1], *growth]]


HEADS = (
    *('work', 'record', 'samples', 'time', 'a sample', 'peak / MiB'),
    *('exponent', 'MiB per million samples'),
)


def of_length(quick: bool, folder: Path) -> list[tuple[str, str]]:
    """Return the sections over the record length."""
    base = measured('nothing', 0.0, folder)[2]
    rows, notes = [], []
    # the hour as a bag takes some gigabytes for a moment, and what is made of it too
    has_room = shutil.disk_usage(folder).free >= 4 * HOUR * BAG_BYTES + SPARE
    for kind, (title, sizes, few) in PLANS.items():
        lengths = few if quick else sizes
        if kind in OF_BAGS and HOUR in lengths and not has_room:
            lengths = lengths[:-1]
            notes.append(f'Too little room on the disk for a bag of 1 h ({title.lower()}).')
        rows += along_the_record(kind, lengths, folder)
    for path in folder.glob('bag_*'):
        shutil.rmtree(path)
    intro = (
        f'At {RATE / 1000:g} kHz, each length in a process of its own. The exponent is the slope '
        'of log time over log length through the '
        f'{LARGE_END} longest. A process that does next to nothing peaks at {base:.0f} MiB.'
    )
    text = [intro, '', markdown(HEADS, rows), '', *notes]
    return [('Growth with the record', '\n'.join(text))]


def table_of(what: str, sizes: Sequence[int], columns: dict[str, list[float]]) -> str:
    """Return a table of times over a size, with its exponents as the last row."""
    rows = [
        [f'{size}', *(seconds(times[i]) for times in columns.values())]
        for i, size in enumerate(sizes)
    ]
    rows.append(['exponent', *(f'{exponent(sizes, times):.2f}' for times in columns.values())])
    return markdown((what, *columns), rows)


def timed(work: Callable[[], object], runs: int) -> float:
    """Return the median time of a work after a first run."""
    return take_turns({'': lambda k: work()}, runs, warm=[''])[''].median


def of_thresholds(quick: bool) -> str:
    """Return the table over the number of thresholds."""
    sizes = (5, 20) if quick else (5, 10, 20, 50, 100, 200)
    model = paper()
    n = 100_000 if quick else 400_000
    record = labelled(0.5 if quick else 1.0)
    piece = record.pieces[0]
    (triangle,) = piece.find('triangle')
    u, x = model.scaling.u(piece.v), model.scaling.x(piece.y)
    use = np.zeros(piece.n, dtype=bool)
    use[triangle.start : triangle.stop] = True
    excerpt = Excerpt(u, x, use)
    columns: dict[str, list[float]] = {
        f'prediction, {n:,} samples': [],
        f'weights from {triangle.stop - triangle.start:,} samples': [],
    }
    predictions, weights = columns.values()
    long = sine(n)
    for m in sizes:
        r = np.arange(1, m + 1) / (m + 1)
        h = Hysteresis(r, np.full(m, 1.0 / m), 0.0, 0.5)
        wide = StageModel(model.sample_rate, model.scaling, h, model.dynamics, model.delay)
        predictions.append(timed(lambda w=wide: w.predict_piece(long), 3))

        def fit(r: np.ndarray = r) -> object:
            R = factorise([excerpt], r, model.dynamics, model.delay)
            return fit_hysteresis(R, r, int(use.sum()))

        weights.append(timed(fit, 1 if m > 50 else 3))
    return table_of('thresholds', sizes, columns)


def of_orders(quick: bool) -> str:
    """Return the table over the largest order."""
    sizes = (2, 5) if quick else (2, 5, 10, 15, 20, 30)
    model, record = paper(), labelled(0.5 if quick else 1.0)
    piece = record.pieces[0]
    (noise,) = piece.find('noise')
    cut = slice(noise.start, noise.stop)
    u, y = model.scaling.u(piece.v[cut]), model.scaling.x(piece.y[cut])
    u, y = u - u.mean(), y - y.mean()
    n, d = int(0.8 * u.size), model.delay.samples
    name = f'factor of {n:,} samples'
    columns: dict[str, list[float]] = {name: [], 'all orders from it, with free runs': []}
    factors, scans = columns.values()
    for most in sizes:
        factors.append(timed(lambda m=most: arx_factor(u[:n], y[:n], m, m + d), 3))
        factor = arx_factor(u[:n], y[:n], most, most + d)
        scans.append(
            timed(lambda f=factor, m=most: scan_orders(f, d, m, u[n:], y[n:]), 1 if quick else 3)
        )
    return table_of('largest na and nb', sizes, columns)


def of_candidates(quick: bool, folder: Path) -> str:
    """Return the table over the number of candidates."""
    sizes = (1, 2) if quick else (1, 2, 4, 8, len(catalogue()))
    model, record = base_model(folder), to_diagnose(17.0)
    names = [EFFECT, *(name for name in catalogue() if name != EFFECT)]
    times = [
        timed(lambda k=k: diagnose(model, record, DiagnosisSettings(effects=tuple(names[:k]))), 1)
        for k in sizes
    ]
    return table_of('candidates', sizes, {'diagnosis of 17 s': times})


def sections(quick: bool = False) -> list[tuple[str, str]]:
    """Return titles and texts."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        base_model(folder)
        found = of_length(quick, folder)
        parts = [
            'Sizes of the model and of the search, at one length of the record. Up to order m '
            'there are m² orders, and the free run of each takes its time by its size.',
            of_thresholds(quick),
            of_orders(quick),
            f'The stage has {EFFECT}; the first candidate is that one.',
            of_candidates(quick, folder),
        ]
    return [*found, ('Growth with thresholds, orders and candidates', '\n\n'.join(parts))]


if __name__ == '__main__':
    if sys.argv[1:2] == ['--measure']:
        kind, size, folder = sys.argv[2:5]
        took, n = MEASURES[kind](float(size), Path(folder))
        print(json.dumps([took, n, peak_memory()]))
    else:
        show(sections)

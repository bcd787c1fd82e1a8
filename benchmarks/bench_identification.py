# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Identification of 17 s at 20 kHz, as a whole and step by step.

    .venv-bench/bin/python benchmarks/bench_identification.py [--quick]

The record is the simulated stage of the paper under the shipped program with a slower triangle.
All is warm: compiled kernels are loaded before the clock starts.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import time

import alone  # noqa: F401 - one thread of BLAS
import numpy as np
from piezo_ident.common.config import find_config
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.prepare import excerpts_of, prepare, Run
from piezo_ident.identification.settings import Settings, silent
from piezo_ident.identification.solvers.arx import arx_factor, scan_orders
from piezo_ident.identification.spectra import excited_band, prefilter
from piezo_ident.identification.step1_delay import first_step
from piezo_ident.identification.step2_dynamics import second_step
from piezo_ident.identification.step3_hysteresis import even_thresholds, factorise, fit_hysteresis
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.operators.dynamics import Delay
from piezo_ident.record.record import Record
from side_by_side import markdown, seconds, show, take_turns, Turn

RUNS = 5
#: what the three steps may take [s]
LIMIT = 1.5
#: slope of the triangle that makes the program 17 s long [V/s]
SLOPE = 4.9
MAX_ORDER = 15

Work = Callable[[int], object]


def record_of_17_s() -> Record:
    """Return what the simulated stage answers to the program."""
    stage = SimulatedStage.load('paper')
    path = Path(find_config('identification', 'program'))
    text = path.read_text(encoding='utf-8').replace('slope: 6}', f'slope: {SLOPE}}}')
    sequence = parse_program(text, path.name).build(stage.model.sample_rate)
    return stage.play(sequence, np.random.default_rng(0))


def whole(record: Record, runs: int) -> tuple[str, str]:
    """Return the table of all three steps."""
    ways = {
        f'ten operators, orders up to ({MAX_ORDER}, {MAX_ORDER}), swarm': Settings(
            thresholds=10, solver='swarm'
        ),
        'the same, least squares in place of the swarm': Settings(thresholds=10),
        'number and places of the thresholds chosen too': Settings(),
    }

    def timed(settings: Settings) -> tuple[float, float]:
        start = time.process_time()
        error = identify(record, settings).error('selection')
        return time.process_time() - start, error

    works: dict[str, Work] = {name: lambda _, s=s: timed(s) for name, s in ways.items()}
    turns = take_turns(works, runs, warm=works)
    rows = []
    for name, turn in turns.items():
        span = f'{min(turn.times):.3g} .. {seconds(max(turn.times))}'
        spent = seconds(float(np.median([spent for spent, _ in turn.results])))
        error = f'{turn.results[0][1]:.3g} %'
        rows.append([name, seconds(turn.median), span, spent, error])
    heads = ('way', 'median', 'from .. to', 'time of the processor', 'error, held out')
    title = f'Three steps of {record.duration:.1f} s at {record.pieces[0].sample_rate:g} Hz'
    return title, f'{markdown(heads, rows)}\n\nAllowed: {LIMIT} s.'


def by_steps(record: Record, runs: int) -> tuple[str, str]:
    """Return the table of the steps, each alone."""
    settings = Settings(thresholds=10)
    data = prepare([record])
    delay = Delay(first_step(data.runs, settings, silent).samples)
    _, G = second_step(data.runs, delay, settings, silent)
    excerpts = excerpts_of(data.runs, 'triangle')
    n = int(sum(e.use.sum() for e in excerpts))
    r = even_thresholds(max(float(np.ptp(e.u[e.use])) for e in excerpts), settings.thresholds)
    R = factorise(excerpts, r, G, delay)
    u, y, n_fit = noise_of(data.runs[0])

    def search(_: int) -> tuple[int, int]:
        factor = arx_factor(u[:n_fit], y[:n_fit], MAX_ORDER, MAX_ORDER + delay.samples)
        table = scan_orders(factor, delay.samples, MAX_ORDER, u[n_fit:], y[n_fit:])
        return table.best('held_out')

    def swarm(turn: int) -> float:
        fit = fit_hysteresis(R, r, n, solver='swarm', rng=np.random.default_rng(turn))
        return float(fit.swarm_loss or np.nan) / fit.optimum_loss - 1.0

    works: dict[str, Work] = {
        'normalisation, masks, checks': lambda _: prepare([record]),
        'step 1: delay': lambda _: first_step(data.runs, settings, silent).samples,
        'step 2: dynamics': lambda _: second_step(data.runs, delay, settings, silent)[0].order,
        f'of it, one search of all {MAX_ORDER}^2 orders': search,
        'step 3: reduction of the triangle': lambda _: factorise(excerpts, r, G, delay),
        'step 3: swarm and least squares': swarm,
    }
    turns: dict[str, Turn] = take_turns(works, runs, warm=works)
    found = {
        'step 1: delay': '{} samples',
        'step 2: dynamics': 'order {}',
        f'of it, one search of all {MAX_ORDER}^2 orders': 'least held-out error at {}',
        'step 3: swarm and least squares': 'swarm {:.1e} above the optimum before polishing',
    }
    rows = [
        [name, seconds(turn.median), found.get(name, '').format(turn.results[0])]
        for name, turn in turns.items()
    ]
    return 'Step by step', markdown(('', 'median', 'found'), rows)


def noise_of(run: Run) -> tuple[np.ndarray, np.ndarray, int]:
    """Return input and output of the noise, filtered to its band, and how many are fitted."""
    (segment,) = run.piece.find('noise')
    cut, rate = slice(segment.start, segment.stop), run.piece.sample_rate
    band = excited_band(run.u[cut] - run.u[cut].mean(), rate)
    u, y = (prefilter(x[cut], rate, band)[500:] for x in (run.u, run.x))
    return u, y, int(0.8 * u.size)


def sections(quick: bool = False) -> list[tuple[str, str]]:
    """Return titles and texts."""
    record, runs = record_of_17_s(), 2 if quick else RUNS
    return [whole(record, runs), by_steps(record, runs)]


if __name__ == '__main__':
    show(sections)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""
Where the time of identification and prediction goes, and what was done about it.

    .venv-bench/bin/python benchmarks/bench_profile.py [--quick]

Shares of an identification come from cProfile on the clock of the process, which makes small calls
dearer than they are; those of a prediction from the kernels themselves, each run alone.  What was
done is timed against the straightforward way, in turns.
"""

from __future__ import annotations

import os

# tall, narrow factorisations only get slower on more threads
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from collections.abc import Callable
import cProfile
import pstats
import sys
import time
from typing import Any

from bench_identification import record_of_17_s
from bench_prediction import BLOCK, fused_plays, voltage
from numba import njit
import numpy as np
from piezo_ident.identification.filtered_plays import filtered_plays
from piezo_ident.identification.identify import identify
from piezo_ident.identification.solvers.output_error import _Problem, Stretch
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.chain import Block
from piezo_ident.operators.dynamics import Dynamics, filter_arx
from piezo_ident.operators.fused import STRETCH
from piezo_ident.operators.kernels import coefficients, recursion, sum_of_plays
from piezo_ident.operators.play import play_columns, weighted_plays
from piezo_ident.record.record import Piece
from side_by_side import markdown, ratio, seconds, take_turns, versions

RUNS = 5
#: samples that a row of step 3 averages
ROW = 12

#: stage, function, and the caller that it is counted under; None counts all calls
STAGES: tuple[tuple[str, str, str | None], ...] = (
    ('step 1: delay from steps and from the ARX loss', 'first_step', None),
    ('step 2: all orders, each judged in free run', 'scan_orders', None),
    ('step 2: factor of the noise for these orders', '_factor', None),
    ('step 2: instrumental variables', 'instrumental_variables', None),
    ('step 2: output error on the noise', '_refined_on_noise', None),
    ('step 2: output error on steps and noise', 'output_error', 'second_step'),
    ('step 2: fine H, to undo it in the noise', 'undo', None),
    ('step 2: frequency response, for the report', 'frequency_response', None),
    ('step 3: reduction, swarm, least squares', '_third_step', None),
    ('errors of every segment', 'errors_of', None),
)

Works = dict[str, Callable[[int], Any]]


@njit(cache=True, nogil=True, fastmath={'reassoc'})
def transposed_form(b, a, x, z, out):
    """Filter in the transposed direct form II, one sample after the other."""
    m = a.size
    for k in range(x.size):
        u = x[k]
        y = z[0] + b[0] * u
        for i in range(m - 1):
            z[i] = z[i + 1] + b[i + 1] * u - a[i] * y
        z[m - 1] = b[m] * u - a[m - 1] * y
        out[k] = y


def of_identification() -> tuple[str, str]:
    """Return the table of stages of an identification."""
    record = record_of_17_s()
    identify(record)
    profile = cProfile.Profile(time.process_time)
    profile.runcall(identify, record)
    stats: dict[Any, Any] = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    total = next(times[3] for (_, _, name), times in stats.items() if name == 'identify')
    rows, left = [], total
    for stage, function, caller in STAGES:
        spent = 0.0
        for (_, _, name), (_, _, _, cumulative, callers) in stats.items():
            if name != function:
                continue
            if caller is None:
                spent += cumulative
            else:
                spent += sum(t[3] for (_, _, by), t in callers.items() if by == caller)
        left -= spent
        rows.append([stage, seconds(spent), f'{100 * spent / total:.0f} %'])
    rows.append(['everything else', seconds(left), f'{100 * left / total:.0f} %'])
    return f'Where the time of an identification goes ({record.duration:.0f} s at 20 kHz)', (
        markdown(('stage', 'time of the processor', 'share'), rows)
    )


def of_prediction(model: StageModel, n: int, runs: int) -> tuple[str, str]:
    """Return the table of what a prediction consists of."""
    v, h, g = voltage(model, n), model.hysteresis, model.dynamics
    piece, u = Piece(v, np.zeros(n), model.sample_rate), model.scaling.u(v)
    b, a = coefficients(g.b, g.a)
    memory, out = np.zeros(h.thresholds.size), np.empty(STRETCH)
    w, y = np.zeros(b.size - 1 + STRETCH), np.zeros(g.a.size + STRETCH)
    starts = range(0, n - STRETCH + 1, STRETCH)

    def plays(_: int) -> None:
        for k in starts:
            part = u[k : k + STRETCH]
            sum_of_plays(part, h.thresholds, h.weights, h.p1, h.p2, memory, out)

    def dynamics(_: int) -> None:
        for _start in starts:
            recursion(b, a, w, y)

    def record(_: int) -> None:
        model.predict_piece(piece)

    def blocks(_: int) -> None:
        in_blocks(model.stream().process, v)

    works: Works = {'all': record, 'H': plays, 'G': dynamics, 'blocks': blocks}
    turns = take_turns(works, runs, warm=works)
    ns = {name: 1e9 * turn.median / n for name, turn in turns.items()}
    whole = ns['all']
    rows = [
        [what, f'{t:.3g}', f'{100 * t / whole:.0f} %']
        for what, t in (
            ('the whole', whole),
            (f'H: {h.thresholds.size} plays and the cubic', ns['H']),
            (f'G: {g.b.size} + {g.a.size} coefficients', ns['G']),
            ('scaling, delay, new memory for the result', whole - ns['H'] - ns['G']),
        )
    ]
    return 'Where the time of a prediction goes', (
        f'{markdown(("", "ns a sample", "share"), rows)}\n\nIn blocks of {BLOCK} samples it is '
        f'{ns["blocks"]:.3g} ns a sample: the way from Python into the kernel and back costs '
        f'{(ns["blocks"] - whole) * BLOCK / 1000:.2g} µs a block, whatever its size.'
    )


def in_blocks(process: Callable[[np.ndarray], object], v: np.ndarray) -> None:
    """Pass a record in blocks."""
    for k in range(0, v.size, BLOCK):
        process(v[k : k + BLOCK])


def normal_by_matrix(w: np.ndarray, y: np.ndarray, model: Dynamics) -> np.ndarray:
    """Return the normal matrix of output error, from the matrix of all lags."""
    one, na, nb = np.ones(1), model.a.size, model.b.size
    y_sim = filter_arx(model.a, model.b, w)
    w_f, y_f = filter_arx(model.a, one, w), filter_arx(model.a, one, y_sim)
    lags = []
    for x, count, first in ((-y_f, na, 1), (w_f, nb, 0)):
        padded = np.concatenate([np.full(first + count, x[0]), x])
        lags += [padded[count - i : count - i + x.size] for i in range(count)]
    J = np.stack(lags)
    J -= J.mean(axis=1, keepdims=True)
    e = y - y_sim
    return np.column_stack([J @ J.T, J @ (e - e.mean())])


def columns_by_themselves(u: np.ndarray, r: np.ndarray, G: Dynamics) -> np.ndarray:
    """Return the columns of step 3, each played, filtered and averaged as a whole."""
    played = (play_columns(u, [width])[0] for width in r)
    filtered = (filter_arx(G.a, G.b, column) for column in played)
    n = u.size // ROW * ROW
    return np.array([y[:n].reshape(-1, ROW).sum(axis=1) / np.sqrt(ROW) for y in filtered])


def measures(model: StageModel, n: int, runs: int) -> tuple[str, str]:
    """Return the table of what was done, each against the straightforward way."""
    h, g, v = model.hysteresis, model.dynamics, voltage(model, n)
    u, out = model.scaling.u(v), np.empty(n)
    zero = np.zeros(h.thresholds.size)
    w = np.random.default_rng(0).standard_normal(n)
    start = Dynamics(g.a, 1.01 * g.b)
    y = filter_arx(g.a, g.b, w)
    problem = _Problem([Stretch(w, y, np.ones(n, dtype=bool))], g.a.size, g.b.size)
    b = np.append(g.b, 0.0)
    still = np.zeros(n)
    still[:100] = 1.0

    def one_by_one() -> None:
        chain, s = model.chain(), model.scaling
        chain.reset(0.0, 0.0)

        def process(part: np.ndarray) -> None:
            x = s.u(part)
            s.y(chain.process(Block(t=x, v=x, x=x)).x)

        in_blocks(process, v)

    pairs: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
        'plays: four samples share one way through the memory': (
            lambda: fused_plays(u, h.thresholds, h.weights, h.p1, h.p2, zero.copy(), out),
            lambda: weighted_plays(u, h.thresholds, h.weights, h.p1, h.p2, zero),
        ),
        'G: four outputs begun side by side, in fixed order of sums': (
            lambda: transposed_form(b, g.a, u, np.zeros(g.a.size), out),
            lambda: filter_arx(g.a, g.b, u),
        ),
        'G at rest: what has died away is zero': (
            lambda: transposed_form(b, g.a, still, np.zeros(g.a.size), out),
            lambda: filter_arx(g.a, g.b, still),
        ),
        f'step 3: {zero.size} columns, four at a time from the voltage to the rows': (
            lambda: columns_by_themselves(u, h.thresholds, g),
            lambda: filtered_plays(u, h.thresholds, zero, g, np.array([[0, n]]), ROW),
        ),
        f'stream in blocks of {BLOCK}: H, G, delay and scaling in one kernel': (
            one_by_one,
            lambda: in_blocks(model.stream().process, v),
        ),
        'output error: products of lags from their first row': (
            lambda: normal_by_matrix(w, y, start),
            lambda: problem.normal(start, problem.errors(start)[0]),
        ),
    }
    works: Works = {}
    for name, (plain, ours) in pairs.items():
        works[f'{name}, plain'] = silenced(plain)
        works[name] = silenced(ours)
    turns = take_turns(works, runs, warm=works)
    rows = []
    for name in pairs:
        plain, ours = turns[f'{name}, plain'], turns[name]
        times = (f'{1e9 * turn.median / n:.3g}' for turn in (plain, ours))
        rows.append([name, *times, ratio(plain.over(ours))])
    heads = ('', 'straightforward, ns a sample', 'here, ns a sample', 'times faster')
    return 'What was done about it', markdown(heads, rows)


def silenced(work: Callable[[], object]) -> Callable[[int], None]:
    """Return a work of which nothing is kept."""

    def run(_: int) -> None:
        work()

    return run


def sections(quick: bool = False) -> list[tuple[str, str]]:
    """Return titles and texts."""
    model = SimulatedStage.load('paper').model
    runs = 3 if quick else RUNS
    return [
        of_identification(),
        of_prediction(model, 200_000 if quick else 2_000_000, runs),
        measures(model, 50_000 if quick else 200_000, runs),
    ]


def main() -> None:
    """Print the tables."""
    print(versions('numpy', 'scipy', 'numba'))
    for title, text in sections('--quick' in sys.argv[1:]):
        print(f'\n### {title}\n\n{text}')


if __name__ == '__main__':
    main()

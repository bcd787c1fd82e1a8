# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Prediction and identification, timed side by side in one run.

    .venv/bin/python benchmarks/bench_prediction.py

Prediction of the paper's stage is set against a kernel fused by hand, which does nothing but this
one model in one loop, and against ``scipy.signal.lfilter``, which does the linear part alone.
Every figure is the median over paired runs; only ratios are worth comparing between machines.
"""

from __future__ import annotations

import os

# tall, narrow factorisations only get slower on more threads
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from collections.abc import Callable
import platform
import time

from numba import njit
import numpy as np
from piezo_ident.identification import identify
from piezo_ident.model import StageModel
from piezo_ident.program import load_program
from piezo_ident.record import Piece
from piezo_ident.results import Settings
from piezo_ident.shipped import find_config
from piezo_ident.simulation import load_stage, simulate
from scipy.signal import lfilter

RUNS = 7


@njit(cache=True, nogil=True, fastmath={'reassoc'})
def fused(v, v0, V, r, q, p1, p2, b, a, d, y0, Y, memory, z, line, out):
    """Scale, H, G, delay and scale back, one sample after the other."""
    m, n_r, at = a.size, r.size, 0
    for k in range(v.size):
        x = (v[k] - v0) / V
        w = 0.0
        for i in range(n_r):
            f = memory[i]
            f = x if f > x else f
            low = x - r[i]
            f = low if f < low else f
            memory[i] = f
            w += q[i] * f
        w += (p1 * x * x + p2) * x
        y = z[0] + b[0] * w
        for i in range(m - 1):
            z[i] = z[i + 1] + b[i + 1] * w - a[i] * y
        z[m - 1] = -a[m - 1] * y
        line[at] = y
        at = at + 1 if at < d else 0
        out[k] = y0 + Y * line[at]


class Fused:
    """The hand-fused kernel with the state of one run."""

    def __init__(self, model: StageModel) -> None:
        h, g, s = model.hysteresis, model.dynamics, model.scaling
        b, a = np.zeros(max(g.b.size, g.a.size)), np.zeros(max(g.b.size, g.a.size))
        b[: g.b.size], a[: g.a.size] = g.b, g.a
        d = model.delay.samples
        self.fixed = (s.v0, s.V, h.thresholds, h.weights, h.p1, h.p2, b, a, d, s.y0, s.Y)
        self.state = (np.zeros(h.thresholds.size), np.zeros(a.size), np.zeros(d + 1))

    def __call__(self, v: np.ndarray) -> np.ndarray:
        """Return the displacement for the next stretch of voltage."""
        out = np.empty(v.size)
        fused(v, *self.fixed, *self.state, out)
        return out


def clock(work: Callable[[], object]) -> float:
    """Return the seconds that a call takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def paired(works: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Return the median time of each, after one warm-up, run in turns."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for work in works.values():
        work()
    for _ in range(RUNS):
        for name, work in works.items():
            times[name].append(clock(work))
    return {name: float(np.median(t)) for name, t in times.items()}


def table(title: str, times: dict[str, float], n: int, base: str) -> None:
    """Print one comparison."""
    print(f'\n{title} ({n:,} samples, median of {RUNS} paired runs)')
    for name, t in times.items():
        print(
            f'  {name:42s} {1e9 * t / n:8.1f} ns/sample {n / t / 1e6:8.2f} Msamples/s '
            f'{t / times[base]:7.2f} x {base}'
        )


def main() -> None:
    """Print all tables."""
    stage = load_stage(find_config('paper', 'stage'))
    model = stage.model
    print(f'Python {platform.python_version()}, numpy {np.__version__}, {platform.processor()}')
    n = 2_000_000
    v = 5.0 + 5.0 * np.sin(2 * np.pi * 50 * np.arange(n) / model.sample_rate)
    piece = Piece(v, np.zeros(n), model.sample_rate)
    u = model.scaling.u(v)
    b = model.dynamics.b
    a = np.concatenate([[1.0], model.dynamics.a])
    gap = np.abs(Fused(model)(v) - model.predict_piece(piece))[1000:].max() / model.scaling.Y
    print(f'largest difference between the two predictions: {gap:.1e} of stroke')

    whole = paired(
        {
            'fused': lambda: Fused(model)(v),
            'StageModel.predict_piece': lambda: model.predict_piece(piece),
            'lfilter alone (linear part)': lambda: lfilter(b, a, u),
        }
    )
    table('Prediction of a record', whole, n, 'fused')

    short = v[:200_000]

    def blocks(process: Callable[[np.ndarray], object]) -> None:
        for k in range(0, short.size, 100):
            process(short[k : k + 100])

    streamed = paired(
        {
            'fused': lambda: blocks(Fused(model)),
            'Stream.process': lambda: blocks(model.stream().process),
        }
    )
    table('Prediction in blocks of 100', streamed, short.size, 'fused')

    program = load_program(find_config('identification', 'program'))
    sequence = program.build(model.sample_rate)
    record = simulate(stage, sequence, np.random.default_rng(0))
    print(f'\nIdentification of {record.duration:.1f} s at {model.sample_rate:g} Hz, warm')
    for name, settings in (
        ('ten thresholds, order scan to 15, swarm', Settings()),
        ('ten thresholds, least squares', Settings(solver='least_squares')),
        ('refined thresholds', Settings(refine=True)),
    ):
        identify(record, settings)
        times = [clock(lambda s=settings: identify(record, s)) for _ in range(5)]
        print(f'  {name:42s} {np.median(times):6.2f} s (median of 5)')


if __name__ == '__main__':
    main()

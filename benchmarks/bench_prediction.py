# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""
Prediction and play simulation beside a kernel fused by hand, and beside memory itself.

    .venv-bench/bin/python benchmarks/bench_prediction.py [--quick]

The hand-fused kernel does nothing but this one model in one loop, sample after sample, as one
would write it.  All works of a table run in turns in one process; times are medians over the
turns, ratios medians of the ratios turn by turn.
"""

from __future__ import annotations

import os

# tall, narrow factorisations only get slower on more threads
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from collections.abc import Callable, Mapping
from dataclasses import replace

from numba import njit
import numpy as np
from piezo_ident.live.predictor import Predictor
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.model.stream import CHUNK
from piezo_ident.operators.chain import Block
from piezo_ident.operators.play import weighted_plays
from piezo_ident.record.blocks import Samples
from piezo_ident.record.record import Piece
from scipy.signal import lfilter
from side_by_side import markdown, ratio, show, take_turns, Turn

RUNS = 7
#: samples of a block, as they come on a topic
BLOCK = 100
#: bytes that a prediction must move for each sample: the voltage in, the displacement out
BYTES = 16

Work = Callable[[], object]


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


@njit(cache=True, nogil=True, fastmath={'reassoc'})
def fused_plays(v, r, q, p1, p2, memory, out):
    """H alone, one sample after the other."""
    for k in range(v.size):
        x = v[k]
        w = 0.0
        for i in range(r.size):
            f = memory[i]
            f = x if f > x else f
            low = x - r[i]
            f = low if f < low else f
            memory[i] = f
            w += q[i] * f
        out[k] = w + (p1 * x * x + p2) * x


class Fused:
    """The hand-fused kernel with the state of one run, which starts at zero."""

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


class Plays:
    """H in the ways in which one may write it, from a rest at zero."""

    def __init__(self, model: StageModel) -> None:
        h = model.hysteresis
        self.r, self.q, self.p1, self.p2 = h.thresholds, h.weights, h.p1, h.p2

    def polynomial(self, u: np.ndarray) -> np.ndarray:
        """Return the part without memory."""
        return (self.p1 * u * u + self.p2) * u

    def ours(self, u: np.ndarray) -> np.ndarray:
        """Return w by this package."""
        zero = np.zeros(self.r.size)
        return weighted_plays(u, self.r, self.q, self.p1, self.p2, zero)[0]

    def fused(self, u: np.ndarray) -> np.ndarray:
        """Return w by the hand-written kernel."""
        out = np.empty(u.size)
        fused_plays(u, self.r, self.q, self.p1, self.p2, np.zeros(self.r.size), out)
        return out

    def numpy_loop(self, u: np.ndarray) -> np.ndarray:
        """Return w by a loop over time, all plays at once."""
        f, w = np.zeros(self.r.size), np.empty(u.size)
        for k, x in enumerate(u):
            f = np.maximum(x - self.r, np.minimum(x, f))
            w[k] = self.q @ f
        return w + self.polynomial(u)

    def python_loop(self, u: np.ndarray) -> np.ndarray:
        """Return w by plain loops over time and plays."""
        r, q, memory, w = self.r.tolist(), self.q.tolist(), [0.0] * self.r.size, []
        for x in u.tolist():
            total = 0.0
            for i, (width, weight) in enumerate(zip(r, q, strict=True)):
                memory[i] = max(x - width, min(x, memory[i]))
                total += weight * memory[i]
            w.append(total)
        return np.array(w) + self.polynomial(u)

    def prefix_scan(self, u: np.ndarray) -> np.ndarray:
        """
        Return w by a scan over stretches of the record, all stretches and plays at once.

        A play is a clamp of its memory to [x - r, x], and clamps in a row are one clamp: so every
        stretch is reduced to a clamp, the memory is handed from stretch to stretch, and then
        every stretch runs from its own start.
        """
        n_rows = int(np.sqrt(u.size))
        n = n_rows * (u.size // n_rows)
        x = np.ascontiguousarray(u[:n].reshape(n_rows, -1).T)
        r, q = self.r[:, None], self.q
        low = np.full((r.size, n_rows), -np.inf)
        high = np.full((r.size, n_rows), np.inf)
        bottom = np.empty_like(low)
        for column in x:
            np.subtract(column, r, out=bottom)
            for end in (low, high):
                np.minimum(end, column, out=end)
                np.maximum(end, bottom, out=end)
        start, f = np.empty((r.size, n_rows)), np.zeros(r.size)
        for j in range(n_rows):
            start[:, j] = f
            f = np.maximum(low[:, j], np.minimum(high[:, j], f))
        w = np.empty_like(x)
        for k, column in enumerate(x):
            np.subtract(column, r, out=bottom)
            np.minimum(start, column, out=start)
            np.maximum(start, bottom, out=start)
            np.dot(q, start, out=w[k])
        rest = np.empty(u.size - n)
        for k, value in enumerate(u[n:]):
            f = np.maximum(value - self.r, np.minimum(value, f))
            rest[k] = q @ f
        return np.concatenate([w.T.ravel(), rest]) + self.polynomial(u)


def unfused(model: StageModel, v: np.ndarray) -> np.ndarray:
    """Return the prediction by the single operators, stretch by stretch."""
    chain, u0 = model.chain(), float(model.scaling.u(v[0]))
    chain.reset(u0, u0)
    y = np.empty(v.size)
    for start in range(0, v.size, CHUNK):
        cut = slice(start, start + CHUNK)
        u = model.scaling.u(v[cut])
        y[cut] = model.scaling.y(chain.process(Block(t=u, v=u, x=u)).x)
    return y


def timed(works: Mapping[str, Work], runs: int) -> dict[str, Turn]:
    """Run works in turns, after one warm-up each; their results are thrown away."""

    def without_result(work: Work) -> Callable[[int], None]:
        def run(_: int) -> None:
            work()

        return run

    return take_turns({n: without_result(w) for n, w in works.items()}, runs, warm=works)


def rows(turns: Mapping[str, Turn], sizes: Mapping[str, int], base: str) -> list[list[str]]:
    """Return name, samples, ns a sample, Msamples/s and ratio to the base, size for size."""
    found = []
    for name, turn in turns.items():
        n = sizes[name]
        found.append(
            [
                name,
                f'{n:,}',
                f'{1e9 * turn.median / n:.3g}',
                f'{n / turn.median / 1e6:.3g}',
                ratio(turn.over(turns[base]) * sizes[base] / n),
            ]
        )
    return found


HEADS = ('', 'samples', 'ns a sample', 'Msamples/s', 'times the hand-fused kernel')


def whole_record(model: StageModel, n: int, runs: int) -> tuple[str, str]:
    """Return the table of records in one go."""
    v = voltage(model, n)
    piece = Piece(v, np.zeros(n), model.sample_rate)
    u, out = model.scaling.u(v), np.empty(n)
    b, a = model.dynamics.b, np.concatenate([[1.0], model.dynamics.a])
    creep = EffectSetting('creep', {'gain': [0.01, 0.02], 'time_constant': [0.1, 1.0]})
    lag = EffectSetting('amplifier_lag', {'time_constant': 2e-4})
    nonlinear = EffectSetting('sensor_nonlinearity', {'square': 0.004, 'cubic': -0.002})
    base = 'kernel fused by hand'
    works: dict[str, Work] = {
        base: lambda: Fused(model)(v),
        '`StageModel.predict_piece`': lambda: model.predict_piece(piece),
        'the same operators one by one': lambda: unfused(model, v),
    }
    for text, effects in (
        ('with an effect on either side (amplifier lag, sensor)', (lag, nonlinear)),
        ('with an effect between H and G (creep)', (creep,)),
    ):
        other = replace(model, effects=effects)
        works[f'`predict_piece` {text}'] = lambda m=other: m.predict_piece(piece)
    works['`scipy.signal.lfilter`, G alone'] = lambda: lfilter(b, a, u)
    works['copy of the record (memory)'] = lambda: np.copyto(out, v)
    works['copy into new memory'] = lambda: v.copy()
    turns = timed(works, runs)
    gap = np.abs(Fused(model)(v) - model.predict_piece(piece))[1000:].max() / abs(model.scaling.Y)
    ours, copy = turns['`StageModel.predict_piece`'], turns['copy of the record (memory)']
    text = markdown(HEADS, rows(turns, dict.fromkeys(turns, n), base))
    text += (
        f'\n\nLargest difference between the two predictions: {gap:.1e} of stroke.  Copying moves '
        f'{BYTES * n / copy.median / 1e9:.1f} GB/s; the prediction moves the same {BYTES} bytes a '
        f'sample at {BYTES * n / ours.median / 1e9:.2f} GB/s, {ratio(ours.over(copy))} times the '
        f'time of the copy: it is bound by arithmetic, not by memory.  H has '
        f'{model.hysteresis.thresholds.size} plays, G {model.dynamics.a.size} and '
        f'{model.dynamics.b.size} coefficients, the delay is {model.delay.samples} samples.'
    )
    return 'Prediction of a record', text


def in_blocks(model: StageModel, n: int, runs: int) -> tuple[str, str]:
    """Return the table of streams in blocks."""
    v = voltage(model, n)
    t = np.arange(n) / model.sample_rate
    cuts = [slice(k, k + BLOCK) for k in range(0, n, BLOCK)]
    samples = [Samples(t[cut], v[cut], 'sine') for cut in cuts]
    lag = EffectSetting('amplifier_lag', {'time_constant': 2e-4})
    with_effect = replace(model, effects=(lag,))

    def each(process: Callable[[np.ndarray], object]) -> None:
        for cut in cuts:
            process(v[cut])

    def one_by_one() -> None:
        chain, s = model.chain(), model.scaling
        chain.reset(float(s.u(v[0])), float(s.u(v[0])))
        for cut in cuts:
            u = s.u(v[cut])
            s.y(chain.process(Block(t=t[cut], v=u, x=u)).x)

    def live() -> None:
        predictor = Predictor()
        predictor.set_model(model)
        for block in samples:
            predictor.process(block)

    base = 'kernel fused by hand'
    turns = timed(
        {
            base: lambda: each(Fused(model)),
            '`Stream.process`': lambda: each(model.stream().process),
            'the same operators one by one': one_by_one,
            '`Stream.process` with an effect (amplifier lag)': lambda: each(
                with_effect.stream().process
            ),
            '`Predictor.process` (checks, gaps, memory)': live,
        },
        runs,
    )
    return f'Prediction in blocks of {BLOCK}', markdown(
        HEADS, rows(turns, dict.fromkeys(turns, n), base)
    )


def plays(model: StageModel, n: int, short: int, runs: int) -> tuple[str, str]:
    """Return the table of ways to simulate H."""
    h, u = Plays(model), model.scaling.u(voltage(model, n))
    base = 'kernel fused by hand'
    works = {
        base: (h.fused, n),
        '`piezo_ident.operators.play.weighted_plays`': (h.ours, n),
        'NumPy, vectorised prefix scan': (h.prefix_scan, n // 4),
        'NumPy, loop over time': (h.numpy_loop, short),
        'Python, loops over time and plays': (h.python_loop, short),
    }
    turns = timed({name: lambda f=f, m=m: f(u[:m]) for name, (f, m) in works.items()}, runs)
    reference = h.fused(u)
    gap = max(float(np.abs(f(u[:m]) - reference[:m]).max()) for f, m in works.values())
    text = markdown(HEADS, rows(turns, {name: m for name, (_, m) in works.items()}, base))
    return 'Play simulation: H alone', (
        f'{text}\n\nAll agree to {gap:.1e}; slow ways run on the beginning of the record.'
    )


def voltage(model: StageModel, n: int) -> np.ndarray:
    """Return a sine of 50 Hz over the full range [V]."""
    return 5.0 - 5.0 * np.cos(2 * np.pi * 50 * np.arange(n) / model.sample_rate)


def sections(quick: bool = False) -> list[tuple[str, str]]:
    """Return titles and texts."""
    model = SimulatedStage.load('paper').model
    runs = 3 if quick else RUNS
    return [
        whole_record(model, 300_000 if quick else 4_000_000, runs),
        in_blocks(model, 50_000 if quick else 400_000, runs),
        plays(model, 200_000 if quick else 2_000_000, 5_000 if quick else 20_000, runs),
    ]


if __name__ == '__main__':
    show(sections)

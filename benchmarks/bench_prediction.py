# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Prediction and play simulation beside a kernel fused by hand.

    .venv-bench/bin/python benchmarks/bench_prediction.py [--quick]

The hand-fused kernel does nothing but this one model in one loop, sample after sample, as one
would write it.  All works of a table run in turns in one process; times are medians over the
turns, ratios medians of the ratios turn by turn.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
import warnings

import alone  # noqa: F401 - one thread of BLAS
from numba import njit
import numpy as np
from piezo_ident.live.predictor import Predictor
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.record.blocks import Samples
from piezo_ident.record.record import Piece
from scipy.signal import lfilter
from side_by_side import markdown, ratio, show, take_turns

RUNS = 7
#: samples of a block, as they come on a topic
BLOCK = 100
LAG = EffectSetting('amplifier_lag', {'time_constant': 2e-4})
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
        self.h = h = model.hysteresis
        self.r, self.q, self.p1, self.p2 = h.thresholds, h.weights, h.p1, h.p2

    def polynomial(self, u: np.ndarray) -> np.ndarray:
        """Return the part without memory."""
        return (self.p1 * u * u + self.p2) * u

    def ours(self, u: np.ndarray) -> np.ndarray:
        """Return w by this package."""
        return self.h.follow(u, np.zeros(self.r.size))[0]

    def fused(self, u: np.ndarray) -> np.ndarray:
        """Return w by the hand-written kernel."""
        out = np.empty(u.size)
        fused_plays(u, self.r, self.q, self.p1, self.p2, np.zeros(self.r.size), out)
        return out

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
        rows = int(np.sqrt(u.size))
        # the end is filled up with the last value, at which nothing moves
        x = np.pad(u, (0, -u.size % rows), mode='edge').reshape(rows, -1).T.copy()
        r = self.r[:, None]
        low, high = np.full((r.size, rows), -np.inf), np.full((r.size, rows), np.inf)
        for column in x:
            bottom = column - r
            low = np.maximum(bottom, np.minimum(low, column))
            high = np.maximum(bottom, np.minimum(high, column))
        start, f = np.empty((r.size, rows)), np.zeros(r.size)
        for j in range(rows):
            start[:, j] = f
            f = np.maximum(low[:, j], np.minimum(high[:, j], f))
        w = np.empty_like(x)
        for k, column in enumerate(x):
            start = np.maximum(column - r, np.minimum(start, column))
            w[k] = self.q @ start
        return w.T.ravel()[: u.size] + self.polynomial(u)


def table(works: Mapping[str, tuple[Work, int]], runs: int) -> str:
    """Run works in turns, after one warm-up each; return their times for a sample."""
    # without their results, which would fill the memory
    called = {name: lambda _, w=w: w() is None for name, (w, _) in works.items()}
    turns = take_turns(called, runs, warm=works)
    base, size = next(iter(turns.values())), next(iter(works.values()))[1]
    rows = []
    for (name, turn), (_, n) in zip(turns.items(), works.values(), strict=True):
        a_sample = f'{1e9 * turn.median / n:.3g}'
        rows.append([name, f'{n:,}', a_sample, ratio(turn.over(base) * size / n)])
    return markdown(HEADS, rows)


HEADS = ('', 'samples', 'ns a sample', 'times the hand-fused kernel')


def linear_parts(model: StageModel, v: np.ndarray, few: int) -> dict[str, tuple[Work, int]]:
    """Return how others run G and the delay alone: python-control on the first `few` samples."""
    import control

    warnings.filterwarnings('ignore', module='control')
    G, w = model.dynamics, model.hysteresis(model.scaling.u(v))
    a, b = np.append(1.0, G.a), np.append(np.zeros(model.delay.samples), G.b)
    # powers of z, highest first, and as many of them above as below
    size = max(a.size, b.size)
    numerator, denominator = (np.pad(x, (0, size - x.size)) for x in (b, a))
    transfer = control.tf(numerator, denominator, 1.0 / model.sample_rate)
    t = np.arange(few) / model.sample_rate
    return {
        'SciPy `lfilter`, G and delay alone': (lambda: lfilter(b, a, w), v.size),
        'python-control `forced_response`, G and delay alone, in Python': (
            lambda: control.forced_response(transfer, t, w[:few]),
            few,
        ),
    }


def whole_record(model: StageModel, n: int, runs: int) -> tuple[str, str]:
    """Return the table of records in one go."""
    v = voltage(model, n)
    piece = Piece(v, np.zeros(n), model.sample_rate)
    creep = EffectSetting('creep', {'gain': [0.01, 0.02], 'time_constant': [0.1, 1.0]})
    nonlinear = EffectSetting('sensor_nonlinearity', {'square': 0.004, 'cubic': -0.002})
    models = {
        '`StageModel.predict_piece`': model,
        '`predict_piece` with an effect on either side (amplifier lag, sensor)': replace(
            model, effects=(LAG, nonlinear)
        ),
        '`predict_piece` with an effect between H and G (creep)': replace(model, effects=(creep,)),
    }
    works: dict[str, tuple[Work, int]] = {'kernel fused by hand': (lambda: Fused(model)(v), n)}
    works |= {name: (lambda m=m: m.predict_piece(piece), n) for name, m in models.items()}
    works |= linear_parts(model, v, max(5000, n // 20))
    works['copy of the record (memory)'] = (lambda: v.copy(), n)
    gap = np.abs(Fused(model)(v) - model.predict_piece(piece))[1000:].max() / abs(model.scaling.Y)
    return 'Prediction of a record', (
        f'{table(works, runs)}\n\nBoth predictions differ by at most {gap:.1e} of stroke. H has '
        f'{model.hysteresis.thresholds.size} plays, G {model.dynamics.a.size} and '
        f'{model.dynamics.b.size} coefficients.'
    )


def in_blocks(model: StageModel, n: int, runs: int) -> tuple[str, str]:
    """Return the table of streams in blocks."""
    v = voltage(model, n)
    t = np.arange(n) / model.sample_rate
    cuts = [slice(k, k + BLOCK) for k in range(0, n, BLOCK)]
    samples = [Samples(t[cut], v[cut], 'sine') for cut in cuts]
    with_effect = replace(model, effects=(LAG,))

    def each(process: Callable[[np.ndarray], object]) -> None:
        for cut in cuts:
            process(v[cut])

    def live() -> None:
        predictor = Predictor()
        predictor.set_model(model)
        for block in samples:
            predictor.process(block)

    works: dict[str, tuple[Work, int]] = {
        'kernel fused by hand': (lambda: each(Fused(model)), n),
        '`Stream.process`': (lambda: each(model.stream().process), n),
        '`Stream.process` with an effect (amplifier lag)': (
            lambda: each(with_effect.stream().process),
            n,
        ),
        '`Predictor.process` (checks, gaps, memory)': (live, n),
    }
    return f'Prediction in blocks of {BLOCK}', table(works, runs)


def plays(model: StageModel, n: int, short: int, runs: int) -> tuple[str, str]:
    """Return the table of ways to simulate H."""
    h, u = Plays(model), model.scaling.u(voltage(model, n))
    ways = {
        'kernel fused by hand': (h.fused, n),
        '`Hysteresis.follow` of `piezo_ident`': (h.ours, n),
        'NumPy, vectorised prefix scan': (h.prefix_scan, n // 4),
        'Python, loops over time and plays': (h.python_loop, short),
    }
    works = {name: (lambda f=f, m=m: f(u[:m]), m) for name, (f, m) in ways.items()}
    reference = h.fused(u)
    gap = max(float(np.abs(f(u[:m]) - reference[:m]).max()) for f, m in ways.values())
    return 'Play simulation: H alone', (
        f'{table(works, runs)}\n\nAll agree to {gap:.1e}; slow ways run on the beginning of the '
        'record.'
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

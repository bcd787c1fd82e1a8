# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Hysteresis beside a NARX model of SysIdentPy and a model of pysindy.

    .venv-bench/bin/python benchmarks/bench_peers_hysteresis.py [--quick]

On the measured 1 Hz record, of which the last 1.5 s are held out, and on a simulated stage, where
the held-out record moves otherwise than what was fitted.  The measured record lies outside this
project (``PIEZO_IDENT_DATA``, else ../shared/data); without it that part says so.

The settings of the peers are the best of 192 (SysIdentPy) and 324 (pysindy) that were tried on
each record: inputs with the speed and its sign or without, degrees, lags, numbers of terms,
thresholds, ridges, smoothing and averaging, judged by free runs over the part that may be fitted,
of models of all of it and of its first 70 %. Of settings within a tenth of the best the smallest
was taken. The peers work on averaged samples, which suits them better than 5 or 20 kHz, and start
from measured values; their prediction is judged at full rate like ours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import os
from pathlib import Path
from typing import Any
import warnings

import alone  # noqa: F401 - one thread of BLAS
from numba import njit
import numpy as np
import piezo_ident as pi
from piezo_ident.excitation.program import Program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.settings import Settings
from piezo_ident.model.metrics import FORMULA, percent_of_stroke
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.record.record import Record
from side_by_side import markdown, seconds, show, take_turns

DATA = Path(
    os.environ.get('PIEZO_IDENT_DATA', Path(__file__).resolve().parents[2] / 'shared' / 'data')
)
MEASURED = 'piezo_1hz.csv'
#: held-out end of the measured record, and where its sine has rung in [s]
HELD, BEGIN = 1.5, 3.6
#: averaged samples that a peer gets as its start
START = 5
#: a free run beyond this has run away, in strokes
AWAY = 3.0

Array = np.ndarray


@dataclass(frozen=True, eq=False)
class Motion:
    """Voltage over its largest value, displacement over the stroke, both centred; rate [Hz]."""

    v: Array
    y: Array
    rate: float

    def cut(self, start: int, stop: int | None = None) -> Motion:
        """Return a part."""
        return Motion(self.v[start:stop], self.y[start:stop], self.rate)

    def averaged(self, r: int) -> Motion:
        """Return the means of r samples each."""
        n = self.v.size // r * r
        v, y = (x[:n].reshape(-1, r).mean(axis=1) for x in (self.v, self.y))
        return Motion(v, y, self.rate / r)


@dataclass(frozen=True)
class Narx:
    """
    A polynomial NARX model, its terms chosen by FROLS.

    `rate`: samples that are averaged; `inputs`: 'v', or with its speed 'v, dv'.
    """

    rate: int
    inputs: str
    degree: int
    lag: int
    terms: int

    def _inputs(self, data: Motion) -> Array:
        speed = np.gradient(data.v) * data.rate
        columns = {'v': data.v, 'dv': speed / 10.0}
        return np.stack([columns[name] for name in self.inputs.split(', ')], axis=1)

    def fit(self, data: Motion) -> Any:
        """Return the model for averaged samples."""
        from sysidentpy.basis_function import Polynomial
        from sysidentpy.model_structure_selection import FROLS
        from sysidentpy.parameter_estimation import LeastSquares

        X, lags = self._inputs(data), list(range(1, self.lag + 1))
        model = FROLS(
            ylag=self.lag,
            xlag=lags if X.shape[1] == 1 else [lags] * X.shape[1],
            order_selection=False,
            n_terms=self.terms,
            estimator=LeastSquares(),
            basis_function=Polynomial(degree=self.degree),
        )
        return model.fit(X=X, y=data.y[:, None])

    def run(self, model: Any, data: Motion) -> Array:
        """Return a free run from the first samples of averaged data."""
        return np.ravel(model.predict(X=self._inputs(data), y=data.y[:, None]))

    def text(self, model: Any) -> str:
        """Return the setting in words."""
        return (
            f'inputs {self.inputs}; degree {self.degree}, lags to {self.lag}, {self.terms} terms, '
            f'{self.rate} samples averaged'
        )


@njit(cache=True)
def _slope(c, powers, y, v, s):
    up, size = 0.0, 0.0
    for i in range(powers.shape[0]):
        z = y ** powers[i, 0] * v ** powers[i, 1]
        up += c[0, i] * z
        size += c[1, i] * z
    return s * up + abs(s) * size


@njit(cache=True)
def _integrate(c, powers, v, s, dt, first, out):
    """Integrate by the midpoint method."""
    y = out[first]
    for k in range(first, v.size - 1):
        middle = y + 0.5 * dt * _slope(c, powers, y, v[k], s[k])
        vm, sm = 0.5 * (v[k] + v[k + 1]), 0.5 * (s[k] + s[k + 1])
        y += dt * _slope(c, powers, middle, vm, sm)
        if not abs(y) < AWAY:
            out[k + 1 :] = np.inf
            break
        out[k + 1] = y


@dataclass(frozen=True)
class Sindy:
    """
    dy/dt = dv/dt P(y, v) + |dv/dt| Q(y, v) with sparse polynomials, which knows no rate.

    `rate`: samples that are averaged; `threshold`, `alpha`: of the sequentially thresholded least
    squares; `window`: samples over which the derivative is smoothed.
    """

    rate: int
    degree: int
    threshold: float
    alpha: float
    window: int

    @property
    def powers(self) -> Array:
        """Powers of y and v in P and Q."""
        size = range(self.degree + 1)
        return np.array([(i, j) for i in size for j in size if i + j <= self.degree])

    def fit(self, data: Motion) -> Any:
        """Return the model for averaged samples."""
        import pysindy

        def term(i: int, j: int, up: bool) -> Callable[..., Array]:
            return lambda y, v, dv, size: (dv if up else size) * y**i * v**j

        speed = np.gradient(data.v) * data.rate
        model = pysindy.SINDy(
            optimizer=pysindy.STLSQ(threshold=self.threshold, alpha=self.alpha),
            feature_library=pysindy.CustomLibrary(
                [term(i, j, up) for up in (True, False) for i, j in self.powers]
            ),
            differentiation_method=pysindy.SmoothedFiniteDifference(
                smoother_kws={'window_length': self.window}
            ),
        )
        u = np.stack([data.v, speed, np.abs(speed)], axis=1)
        return model.fit(data.y[:, None], t=1.0 / data.rate, u=u)

    def run(self, model: Any, data: Motion) -> Array:
        """Return a free run of the equation found, integrated by a compiled loop."""
        out = np.full(data.v.size, float(data.y[:START].mean()))
        speed = np.gradient(data.v) * data.rate
        coefficients = np.ravel(model.coefficients()).reshape(2, -1)
        _integrate(coefficients, self.powers, data.v, speed, 1.0 / data.rate, START // 2, out)
        return out

    def text(self, model: Any) -> str:
        """Return the setting in words."""
        return (
            f'degree {self.degree}, threshold {self.threshold:g}, ridge {self.alpha:g}, '
            f'{model.complexity} terms, derivative over {self.window}, {self.rate} samples '
            'averaged'
        )


Peer = Narx | Sindy


def error(y_hat: Array, y: Array) -> float:
    """Return the error of normalised signals [% of stroke], infinite when one has run away."""
    e = y_hat - y
    return 100.0 * float(np.sqrt(np.mean(e**2))) if np.all(np.abs(e) < AWAY) else float('inf')


def judged(setting: Peer, model: Any, data: Motion, held: int) -> float:
    """Return the error over the samples from `held` on; the start lies before it."""
    first = max(0, held - START * setting.rate)
    part = data.cut(first)
    with np.errstate(all='ignore'):
        averaged = setting.run(model, part.averaged(setting.rate))
    # averaged samples as samples
    at = (np.arange(part.v.size) + 0.5) / setting.rate - 0.5
    y_hat = np.interp(at, np.arange(averaged.size), averaged)
    return error(y_hat[held - first :], part.y[held - first :])


@dataclass(frozen=True, eq=False)
class Case:
    """What may be fitted by the peers, what judges from a sample on, and their settings."""

    fit: Motion
    test: Motion
    held: int
    peers: dict[str, Peer]


def peer_rows(case: Case, runs: int) -> tuple[list[list[str]], str]:
    """Return the rows of the peers, and their settings in words."""
    rows, notes = [], []
    for name, setting in case.peers.items():
        averaged = case.fit.averaged(setting.rate)
        fit = take_turns({'': lambda k, s=setting, a=averaged: s.fit(a)}, runs, warm=[''])['']
        model = fit.results[-1]
        predict = take_turns(
            {'': lambda k, s=setting, m=model: judged(s, m, case.test, case.held)}, runs, warm=['']
        )['']
        percent = predict.results[-1]
        held = f'{percent:.3f}' if np.isfinite(percent) else 'runs away'
        rows.append([name, held, seconds(fit.median), seconds(predict.median)])
        notes.append(f'- {name}: {setting.text(model)}.')
    return rows, '\n'.join(notes)


def our_rows(
    record: Record, settings: Settings, errors: Callable[[Any], tuple[float, float]], runs: int
) -> list[list[str]]:
    """Return the rows of ten and of chosen thresholds; `errors` returns the error and its time."""
    rows = []
    for name, count in (('ten thresholds', 10), ('chosen thresholds', None)):
        asked = replace(settings, thresholds=count)
        fit = take_turns({'': lambda k, s=asked: identify(record, s)}, runs, warm=[''])['']
        percent, took = errors(fit.results[-1])
        times = (seconds(fit.median), seconds(took))
        rows.append([f'piezo_ident, {name}', f'{percent:.3f}', *times])
    return rows


HEADS = ('model', 'held-out error, % of stroke', 'fit', 'predict')


def measured(quick: bool) -> str:
    """Return the section on the measured record."""
    path = DATA / MEASURED
    if not path.is_file():
        return (
            f'Not run: {MEASURED} is not in {DATA.name}/; set `PIEZO_IDENT_DATA` to the folder of '
            'measured records.'
        )
    record = pi.read(path)
    (piece,) = record.pieces
    rate = piece.sample_rate
    n_fit = piece.n - round(HELD * rate)
    begin = round(BEGIN * rate)
    centre, stroke = piece.y[begin:n_fit].mean(), np.ptp(piece.y)
    motion = Motion(piece.v / np.abs(piece.v).max(), (piece.y - centre) / stroke, rate)
    peers: dict[str, Peer] = {
        'SysIdentPy NARX': Narx(50, 'v', degree=3, lag=2, terms=16),
        'pysindy': Sindy(10, degree=3, threshold=0.1, alpha=1e-3, window=51),
    }
    case = Case(motion.cut(begin, n_fit), motion.cut(begin), n_fit - begin, peers)

    def errors(result: Any) -> tuple[float, float]:
        (held,) = [row for row in result.errors if row.data == 'held out']
        memory = next(iter(result.memories.values()), None)
        turn = take_turns({'': lambda k: result.model.predict_piece(piece, memory)}, 5)['']
        return held.percent, turn.median

    rows = our_rows(record, Settings(hold_out=HELD), errors, 2 if quick else 5)
    more, notes = peer_rows(case, 2 if quick else 5)
    floor = 100.0 * float(piece.y[: round(3.0 * rate)].std()) / stroke
    return f"""\
`{MEASURED}`: {piece.n:,} samples at {rate:g} Hz, rest, a step that rings, then a 1 Hz sine of
full size; the last {HELD} s are held out. Errors are {FORMULA}. Ours fits everything
before them, delay and resonance included. The peers fit the sine alone
({(n_fit - begin) / rate:.1f} s from {BEGIN} s on) and predict from the measured start.
Sensor noise at rest, {floor:.3f} % of stroke, remains in every error.

{markdown(HEADS, rows + more)}

{notes}

Where one loop repeats, a NARX polynomial of few terms is enough. The peers know this loop at this
frequency alone, and find neither a delay nor a resonance."""


def other_motions(quick: bool) -> str:
    """Return the section on the simulated stage."""
    stage = SimulatedStage.load('dense')
    rate = stage.model.sample_rate

    def program(name: str) -> Any:
        return Program.load(name).build(rate)

    record = stage.play(program('identification'), np.random.default_rng(0))
    truth = stage.ideal.play(program('minor_loops'))
    (piece,), (loops,) = record.pieces, truth.pieces
    (triangle,) = piece.find('triangle')
    stroke = np.ptp(loops.y)

    def motion(v: Array, y: Array) -> Motion:
        return Motion(v / 10.0 - 0.5, (y - 0.5 * stroke) / stroke, rate)

    cut = slice(triangle.start, triangle.stop)
    test = motion(loops.v, loops.y)
    peers: dict[str, Peer] = {
        'SysIdentPy NARX': Narx(100, 'v, dv', degree=3, lag=2, terms=24),
        'pysindy': Sindy(40, degree=2, threshold=0.0, alpha=0.0, window=7),
    }
    case = Case(motion(piece.v[cut], piece.y[cut]), test, 0, peers)

    def errors(result: Any) -> tuple[float, float]:
        turn = take_turns({'': lambda k: result.model.predict_piece(loops)}, 5)['']
        return percent_of_stroke(loops.y, turn.results[-1], stroke), turn.median

    settings = Settings(max_order=6 if quick else 15)
    rows = our_rows(record, settings, errors, 1 if quick else 5)
    more, notes = peer_rows(case, 2 if quick else 5)
    return f"""\
`stage_dense` has forty thresholds of its own. The peers fit the triangle of growing amplitude
({(triangle.stop - triangle.start) / rate:.1f} s), ours the whole identification record
({record.duration:.1f} s). Held out: minor loops at three biases and a decaying triangle
({truth.duration:.1f} s), against the noise-free stage, in free run from rest.

{markdown(HEADS, rows + more)}

{notes}

A NARX model of few lags, or an equation in y and v alone, remembers no earlier turning points."""


def sections(quick: bool = False) -> list[tuple[str, str]]:
    """Return titles and texts."""
    warnings.filterwarnings('ignore')
    return [
        ('Hysteresis: a measured loop', measured(quick)),
        ('Hysteresis: other motions than the fitted one', other_motions(quick)),
    ]


if __name__ == '__main__':
    show(sections)

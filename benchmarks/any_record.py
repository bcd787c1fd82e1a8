# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Records as any lab has them, without labels, and four peers of twenty lines beside the program.

Each case is a stage whose hysteresis is not the model's, a kind of motion, and two realisations
of it: one is fitted, the other judged.  Every record begins at the lowest voltage, at rest.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
import time
import warnings

import alone  # noqa: F401 - one thread of BLAS
import bouc_wen
import numpy as np
from numpy.typing import NDArray
import piezo_ident as pi
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.operators.dynamics import Delay, Dynamics
from scipy.optimize import least_squares, nnls
from scipy.signal import butter, chirp, lfilter, sosfiltfilt
from side_by_side import markdown
from study_rows import write_cases
from truths import FamilyStage
from truths.families import make_core
from truths.linear import make_linear

Array = NDArray[np.float64]
Pairs = list[tuple[Array, Array]]

RATE = 10_000.0
SECONDS = 6.0
#: families of hysteresis, none of which is the model's
LAWS = ('preisach', 'bouc-wen', 'duhem', 'kp-kernels', 'turning-curves')


def _in(x: Array, low: float, high: float) -> Array:
    """Return a motion scaled between two shares of the range."""
    return low + (high - low) * (x - x.min()) / np.ptp(x)


def _soft(x: Array) -> Array:
    """Return a motion behind a rest at zero and a ramp to its first value."""
    ramp = x[0] * 0.5 * (1 - np.cos(np.pi * np.linspace(0, 1, int(0.3 * RATE))))
    return np.concatenate([np.zeros(int(0.05 * RATE)), ramp, x])


def _band(rng: np.random.Generator, n: int, low: float, high: float) -> Array:
    sos = butter(4, (low, high), 'bandpass', fs=RATE, output='sos')
    return np.asarray(sosfiltfilt(sos, rng.standard_normal(n)))


def _multisine(rng: np.random.Generator, n: int, top: float) -> Array:
    period = int(RATE)
    f = np.arange(1, int(top) + 1)
    spectrum = np.zeros(period // 2 + 1, complex)
    spectrum[f] = np.exp(2j * np.pi * rng.random(f.size)) / np.sqrt(1 + (f / 20.0) ** 2)
    return np.resize(np.fft.irfft(spectrum, period), n)


def _levels(rng: np.random.Generator, n: int, hold: float, levels: int) -> Array:
    size = int(hold * RATE)
    return np.repeat(rng.integers(0, levels, n // size + 1) / (levels - 1), size)[:n]


def motion(kind: str, rng: np.random.Generator, seconds: float = SECONDS) -> list[Array]:
    """Return the normalised voltages of one realisation of a kind; pairs have two records."""
    n = int(seconds * RATE)
    t = np.arange(n) / RATE
    if kind.startswith('pair'):
        return [x for one in kind.split(': ')[1].split(' + ') for x in motion(one, rng, seconds)]
    a, b = rng.uniform(0.25, 0.35), rng.uniform(0.6, 0.7)
    slow = rng.uniform(0.8, 1.2)
    made = {
        'multisine': lambda: _in(_multisine(rng, n, 400.0), 0.02, 0.98),
        'multisine, small': lambda: _in(_multisine(rng, n, 400.0), a, a + 0.2),
        'noise': lambda: _in(_band(rng, n, 0.5, 300.0), 0.02, 0.98),
        'noise, small': lambda: _in(_band(rng, n, 0.5, 300.0), b, b + 0.15),
        'slow noise': lambda: _in(_band(rng, n, 0.3, 20.0), 0.02, 0.98),
        'random binary': lambda: _in(
            lfilter([0.02], [1, -0.98], _levels(rng, n, 0.01, 2)), 0.05, 0.95
        ),
        'random binary, small': lambda: _in(_levels(rng, n, 0.005, 2), b, b + 0.1),
        'random steps': lambda: _in(lfilter([0.05], [1, -0.95], _levels(rng, n, 0.15, 12)), 0, 1),
        'chirp': lambda: _in(chirp(t, 0.5, t[-1], rng.uniform(250, 350), 'log', -90), 0.05, 0.95),
        'sine': lambda: _in(-np.cos(2 * np.pi * slow * t), 0.0, 1.0),
        'two sines': lambda: _in(
            -np.cos(2 * np.pi * slow * t) - 0.4 * np.cos(2 * np.pi * rng.uniform(30, 60) * t), 0, 1
        ),
        'growing sine': lambda: _in(-np.cos(2 * np.pi * 3 * slow * t) * t, 0.0, 1.0),
        'triangles': lambda: _in(
            np.interp(t * slow, np.arange(9), [0, 0.4, 0.1, 0.7, 0.2, 1, 0.5, 0.9, 0]), 0.0, 1.0
        ),
        'staircase': lambda: _in(
            lfilter([0.01], [1, -0.99], np.round(6 * np.abs(np.sin(np.pi * 0.3 * slow * t))) / 6),
            0.0,
            1.0,
        ),
        'raster': lambda: _in(
            np.abs((10 * slow * t) % 1 - 0.5) + 0.15 * np.sin(2 * np.pi * 0.2 * t), 0.05, 0.95
        ),
    }
    x = made[kind]()
    return [_soft(np.asarray(x))]


KINDS = (
    *('multisine', 'multisine, small', 'noise', 'noise, small', 'slow noise', 'random binary'),
    *('random binary, small', 'random steps', 'chirp', 'sine', 'two sines', 'growing sine'),
    *('triangles', 'staircase', 'raster', 'pair: chirp + staircase', 'pair: noise + triangles'),
)


@dataclass(frozen=True, eq=False)
class Case:
    """A stage, a kind of motion, and voltage [V] and displacement [m] to fit and to judge."""

    stage: FamilyStage
    kind: str
    fit: Pairs
    judge: Pairs


def draw(law: str, kind: str, seed: int, seconds: float = SECONDS) -> Case:
    """Draw a case; the same law and seed give the same stage."""
    rng = np.random.default_rng([4711, seed, *law.encode()])
    core, linear = make_core(law, rng), make_linear(rng, RATE, 600.0)
    noise = float(np.exp(rng.uniform(np.log(5e-5), np.log(5e-4))))
    stage = FamilyStage(core, linear, RATE, (0.0, 100.0), 50e-6, 1e-6, 'white', noise, seed=seed)
    own = np.random.default_rng([4712, seed, *law.encode(), *kind.encode()])

    def records(name: str) -> Pairs:
        return [
            (100.0 * u, stage.respond(100.0 * u, f'{name} {i}'))
            for i, u in enumerate(motion(kind, own, seconds))
        ]

    return Case(stage, kind, records('fit'), records('judge'))


# --- the peers: each takes records to fit, returns a function from voltage to displacement -----


def line(records: Pairs):
    """Fit a straight line."""
    v, y = (np.concatenate(x) for x in zip(*records, strict=True))
    p = np.polyfit(v, y, 1)
    return lambda v: np.polyval(p, v)


def _plays(v: Array, high: float) -> Array:
    r = high * np.arange(40) / 40
    w, out = np.maximum(v[0] - r, 0.0), np.empty((v.size, 41))
    out[:, 40] = 1.0
    for k in range(v.size):
        w = np.maximum(v[k] - r, np.minimum(v[k], w))
        out[k, :40] = w
    return out


def plays(records: Pairs):
    """Fit forty plays by non-negative least squares."""
    high = max(v.max() for v, _ in records)
    X, y = np.vstack([_plays(v, high) for v, _ in records]), np.hstack([y for _, y in records])
    level = y.min()
    R = np.linalg.qr(np.column_stack([X, (y - level) / np.ptp(y)]), mode='r')
    q = nnls(R[:, :-1], R[:, -1])[0] * np.ptp(y)
    return lambda v: _plays(v, high) @ q + level


def _oe(theta: Array, n: int, w: Array) -> Array:
    a, b = np.concatenate([[1.0], theta[:n]]), theta[n:-1]
    zi = w[0] * b.sum() / a.sum()
    return zi + lfilter(b, a, w - w[0]) + theta[-1]


def _fit_oe(pairs: Pairs, n: int = 4):
    """Return the best linear output error over delays, from least squares, by Gauss-Newton."""
    best = None
    for m in (2, n):
        for d in range(8):
            rows, right, s = [], [], d + m + 2
            for w, y in pairs:
                w, y = w - w.mean(), y - y.mean()
                past = [-y[s - i : -i] for i in range(1, m + 1)]
                past += [w[s - d - j : w.size - d - j] for j in range(m + 1)]
                rows.append(np.column_stack(past))
                right.append(y[s:])
            theta = np.linalg.lstsq(np.vstack(rows), np.hstack(right), rcond=None)[0]
            a, b = np.concatenate([[1.0], theta[:m]]), theta[m:]
            roots = np.roots(a)
            a = np.poly(np.where(abs(roots) >= 1, 0.999 / np.conj(roots), roots)).real
            theta = np.concatenate([a[1:], np.zeros(d), b, [0.0]])
            theta[-1] = np.mean([np.mean(y - _oe(theta, m, w)) for w, y in pairs])
            left = sum(np.sum((y - _oe(theta, m, w)) ** 2) for w, y in pairs)
            if best is None or left < best[0]:
                best = left, m, d, theta
    _, m, d, theta = best
    free = np.r_[0:m, m + d : theta.size]

    def errors(x: Array) -> Array:
        full = theta.copy()
        full[free] = x
        if np.abs(np.roots(np.concatenate([[1.0], full[:m]]))).max() > 0.99999:
            return np.full(sum(y.size for _, y in pairs), 1e3)
        return np.hstack([_oe(full, m, w) - y for w, y in pairs])

    found = least_squares(errors, theta[free], x_scale='jac', max_nfev=30)
    full = theta.copy()
    full[free] = found.x
    return m, full


def linear(records: Pairs):
    """Fit linear output error of order 2 or 4 with delays of 0 to 7 samples."""
    scale = np.ptp(records[0][1])
    m, theta = _fit_oe([(v / 100, y / scale) for v, y in records])
    return lambda v: scale * _oe(theta, m, v / 100)


def plays_then_linear(records: Pairs):
    """Fit plays, then output error behind them."""
    scale, h = np.ptp(records[0][1]), plays(records)
    m, theta = _fit_oe([(h(v) / scale, y / scale) for v, y in records])
    return lambda v: scale * _oe(theta, m, h(v) / scale)


PEERS = (line, plays, linear, plays_then_linear)


def percent(predict, records: Pairs) -> float:
    """Return rms(y - y_hat) / (max y - min y) over all records, mean included [%]."""
    e = np.hstack([y - predict(v) for v, y in records])
    y = np.hstack([y for _, y in records])
    return 100.0 * float(np.sqrt(np.mean(e**2)) / np.ptp(y))


def program(records: Pairs, settings: pi.Settings | None = None) -> pi.StageModel:
    """Identify a model as a user does: no labels, and of the study no settings."""
    read = pi.Record.from_arrays
    named = [read(*r, sample_rate=RATE, name=f'record {i}') for i, r in enumerate(records)]
    return pi.identify(named, settings).model


def slow_motion(model: pi.StageModel, rng: np.random.Generator) -> Array:
    """
    Return a random motion [m] in the middle of the stroke, slower than half the first mode.

    It begins and ends at rest, as `invert` lets the stage rest before and after it.  One that
    begins at speed has a corner there, which holds all frequencies: the drive that makes up for
    it has to kick the mode, and the stage then follows better than under the drive without G.
    """
    rate = model.sample_rate
    top = min([0.5 * m.frequency for m in model.dynamics.modes(rate)] + [0.02 * rate])
    n = int(0.5 * rate)
    sos = butter(4, 0.5 * top, fs=rate, output='sos')
    # by five periods of its slowest pole the filter is at rest
    x = sosfiltfilt(sos, np.pad(rng.standard_normal(n), int(10.0 * rate / top)))
    reach = model.simulate(np.linspace(*model.scaling.range, n))
    low, high = np.quantile(reach, [0.3, 0.7])
    return np.asarray(low + (high - low) * (x - x.min()) / np.ptp(x))


def drive_fault(model: pi.StageModel, rng: np.random.Generator) -> str:
    """
    Return what is wrong with H or the drive of an inverse, nothing where all is well.

    H has to rise on its range.  Under `slow_motion` the drive may be 1.2 times as wide as that of
    the model without G, and its largest step 1.2 times as large.  A refusal is a fault, too.
    """
    if model.hysteresis.lowest_slope() <= 0.0:
        return 'H falls'
    wanted = slow_motion(model, rng)
    try:
        drive = pi.invert(model, wanted).v
        still = replace(model, dynamics=Dynamics.unit(), delay=Delay(0), effects=())
        static = pi.invert(still, wanted).v
    except (DataError, ModelError) as error:
        return f'refuses: {error}'
    if np.ptp(drive) > 1.2 * np.ptp(static):
        return f'drive {np.ptp(drive) / np.ptp(static):.2f} times as wide'
    steps = [float(np.abs(np.diff(v)).max()) for v in (drive, static)]
    if steps[0] > 1.2 * steps[1]:
        return f'step {steps[0] / steps[1]:.2f} times as large'
    return ''


def judge(law: str, kind: str, seed: int) -> Row:
    """Return the errors of the program and of each peer on what was not fitted [%]."""
    case = draw(law, kind, seed)
    with warnings.catch_warnings():
        # small motion of one realisation leaves the range of another by a little
        warnings.simplefilter('ignore', UserWarning)
        peers = [percent(peer(case.fit), case.judge) for peer in PEERS]
        began = time.process_time()
        model = program(case.fit)
        spent = time.process_time() - began
        own = percent(model.simulate, case.judge)
    fault = drive_fault(model, np.random.default_rng(seed))
    return Row(law, kind, seed, own, tuple(peers), spent, fault)


@dataclass(frozen=True)
class Row:
    """
    One case: errors of the program and of its peers on the second realisation [%].

    `seconds` is the processor time of the program [s], `fault` what is wrong with its inverse.
    """

    law: str
    kind: str
    seed: int
    own: float
    peers: tuple[float, ...]
    seconds: float
    fault: str

    @property
    def ratio(self) -> float:
        """Error of the program over that of the best peer."""
        return self.own / min(self.peers)


def springs(seed: int) -> list[tuple[str, float, float, float]]:
    """Return name, rms, error of the program and of a linear model of the Bouc-Wen benchmark."""
    made = bouc_wen.records(seed)
    u, y = made.pop('fit')
    record = pi.Record.from_arrays(u, y, sample_rate=bouc_wen.RATE, name='Bouc-Wen')
    models = pi.identify([record]).model.simulate, linear([(u, y)])
    return [
        (name, float(y.std()), *(bouc_wen.rms_error(m(u), y, name) for m in models))
        for name, (u, y) in made.items()
    ]


TEXT = """\
# Any record

This page shows how much a model errs that was identified from a record without labels, or
from a pair, beside four peers of twenty lines each. The simulated stages have another
hysteresis than the model, two or three light modes and a delay of any part of a sample. A
record has 6 s at 10 kHz, noise of 0.005 to 0.05 % of stroke. The error is
100 rms(y - y_hat) / (max y - min y) in free run on another realisation of the motion.
Realisations differ in speed, so triangles may be judged on a branch that was not fitted.
`make any-record` writes this page (seeds {seeds}).

Of {cases} cases {good} err at most 1.05 times as much as the best peer; the median is {median:.2f}
times, the worst {worst:.2f}. An identification took {seconds:.1f} s of processor time (median).

Median errors of all kinds of motion, % of stroke:

{laws}

{link}

The peers are a straight line, forty plays by non-negative least squares, linear output
error of order 2 or 4 with delays of 0 to 7 samples, and plays with such an output error
behind them.

## Inverse

For a random motion slower than half the first mode, which begins and ends at rest, the
drive has to be at most 1.2 times as wide, and its largest step 1.2 times as large, as
without G; H has to rise.
{faults}

## Bouc-Wen benchmark

A mass on a Bouc-Wen spring, from the equations of doi:10.4121/12967592: two periods of
a multisine from rest are fitted, with the noise of the benchmark. The hysteresis is in
the loop, and neither model has it there. Rms error [m]:

{springs}
"""


def page(rows: Sequence[Row], springs: Sequence[tuple[object, ...]], cases: str) -> str:
    """Return the page, in Markdown; `cases` is its link to the file of all cases."""
    ratios = np.array([row.ratio for row in rows])
    laws = []
    for law in dict.fromkeys(row.law for row in rows):
        pairs = [(row.own, min(row.peers)) for row in rows if row.law == law]
        laws.append([law, *(f'{x:.3g}' for x in np.median(pairs, axis=0))])
    faults = [f'- {row.law}, {row.kind}: {row.fault}' for row in rows if row.fault]
    judged = [[name, *(f'{x:.3g}' for x in errors)] for name, *errors in springs]
    return TEXT.format(
        seeds=', '.join(map(str, sorted({row.seed for row in rows}))),
        cases=len(rows),
        good=np.sum(ratios <= 1.05),
        median=np.median(ratios),
        worst=ratios.max(),
        seconds=np.median([row.seconds for row in rows]),
        laws=markdown(['hysteresis of the stage', '`identify`', 'best peer'], laws),
        link=cases,
        faults='\n'.join(faults or ['All models do.']),
        springs=markdown(['judged on', 'rms of y', '`identify`', 'linear output error'], judged),
    )


def main() -> None:
    """Judge all cases in two processes, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('out', type=Path)
    parser.add_argument('--seeds', type=int, nargs='+', default=[1])
    parser.add_argument('--laws', nargs='+', default=LAWS)
    parser.add_argument('--kinds', nargs='+', default=KINDS)
    given = parser.parse_args()
    cases = [(a, k, s) for s in given.seeds for a in given.laws for k in given.kinds]
    rows = []
    with ProcessPoolExecutor(2) as pool:
        for row in pool.map(judge, *zip(*cases, strict=True)):
            rows.append(row)
            peers = ' '.join(f'{x:.3g}' for x in row.peers)
            print(
                f'{len(rows)}/{len(cases)} {row.law}, {row.kind}, seed {row.seed}: {row.own:.3g} '
                f'({row.ratio:.2f}, {row.seconds:.0f} s); peers {peers}',
                flush=True,
            )
    given.out.parent.mkdir(parents=True, exist_ok=True)
    heads = 'motion, hysteresis, seed, identify, best peer'
    lines = ([r.kind, r.law, r.seed, f'{r.own:.3g}', f'{min(r.peers):.3g}'] for r in rows)
    link = write_cases(given.out, heads, lines)
    given.out.write_text(page(rows, springs(given.seeds[0]), link), encoding='utf-8')


if __name__ == '__main__':
    main()

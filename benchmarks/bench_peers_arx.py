# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Search for the order of an ARX model: piezo_ident beside sippy_unipi and SysIdentPy.

    .venv-bench/bin/python benchmarks/bench_peers_arx.py [--quick]

All get the same noise segment of the simulated stage, filtered in the same way, one second of it,
and may use its first four fifths as they like; the last fifth judges, in free run.  Every turn has
another noise of the sensor.  Free runs of all models are done by the same filter, untimed.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
from dataclasses import dataclass
from functools import cache
import io
from typing import Any
import warnings

import alone  # noqa: F401 - one thread of BLAS
import numpy as np
from piezo_ident.excitation.program import Program
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.solvers.arx import arx_factor, scan_orders, stabilised
from piezo_ident.identification.solvers.output_error import output_error
from piezo_ident.identification.spectra import excited_band, prefilter
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.operators.dynamics import Dynamics
from scipy.signal import lfilter
from side_by_side import markdown, ratio, seconds, show, take_turns, Turn

#: delay of the stage [samples], which all are told
DELAY = 3
#: samples of the noise that are used: 1 s, left out at the start for the filter to settle
SAMPLES, SETTLE = 20_000, 500
#: shares that are fitted and that may choose the order; the rest is the test
FIT, CHOOSE = 0.6, 0.2
#: samples of the test before the first that counts
WARM_UP = 800
#: errors closer than this share are equal
EQUAL = 1e-6

Coefficients = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True, eq=False)
class Data:
    """Input and output of one turn: what may be used, and what judges."""

    u: np.ndarray
    y: np.ndarray
    u_test: np.ndarray
    y_test: np.ndarray

    @property
    def n_fit(self) -> int:
        """Samples to fit where a part of the data chooses the order."""
        return round(self.u.size * FIT / (FIT + CHOOSE))

    def error(self, found: Coefficients) -> float:
        """Return the free-run error on the test [% of the rms of the output]."""
        b, a = found
        if np.abs(np.roots(np.concatenate([[1.0], a]))).max(initial=0.0) >= 1.0:
            return float('inf')
        simulated = lfilter(b, np.concatenate([[1.0], a]), self.u_test)
        e = (self.y_test - simulated)[WARM_UP:]
        return float(100.0 * (e - e.mean()).std() / self.y_test[WARM_UP:].std())


@cache
def data_of(turn: int) -> Data:
    """Return the noise segment of the paper's stage with the sensor noise of a turn."""
    stage = SimulatedStage.load('paper')
    program = Program.load('identification')
    record = stage.play(program.build(20_000.0), np.random.default_rng(turn))
    piece = record.pieces[0]
    (segment,) = piece.find('noise')
    cut, scaling = slice(segment.start, segment.stop), stage.model.scaling
    u, y = scaling.u(piece.v[cut]), scaling.x(piece.y[cut])
    band = excited_band(u - u.mean(), piece.sample_rate)
    use = slice(SETTLE, SETTLE + SAMPLES)
    u, y = (prefilter(x, piece.sample_rate, band)[use] for x in (u, y))
    split = round((FIT + CHOOSE) * SAMPLES)
    return Data(u[:split], y[:split], u[split:], y[split:])


def delayed(b: np.ndarray) -> np.ndarray:
    """Return the coefficients of B with the delay in front."""
    return np.concatenate([np.zeros(DELAY), b])


def ours(data: Data, most: int, refine: bool = False) -> Coefficients:
    """Search by free run on the part that chooses, then fit the order found to all."""
    n = data.n_fit
    factor = arx_factor(data.u[:n], data.y[:n], most, most + DELAY)
    na, nb = scan_orders(factor, DELAY, most, data.u[n:], data.y[n:]).best('held_out')
    theta, _ = arx_factor(data.u, data.y, na, nb + DELAY).fit(na, nb, DELAY)
    found = stabilised(Dynamics(a=theta[:na], b=theta[na:]))
    if refine:
        u = np.concatenate([np.zeros(DELAY), data.u[:-DELAY]])
        use = np.arange(u.size) >= u.size // 50
        found = output_error([Excerpt(u, data.y, use)], found, maxiter=10).dynamics
    return delayed(found.b), found.a


def sippy(data: Data, most: int) -> Coefficients:
    """Search with sippy_unipi: all orders, BIC on all data."""
    from sippy_unipi import system_identification

    with contextlib.redirect_stdout(io.StringIO()):
        model = system_identification(
            data.y,
            data.u,
            'ARX',
            IC='BIC',
            na_ord=[1, most],
            nb_ord=[1, most],
            # its input starts one sample back
            delays=[DELAY - 1, DELAY - 1],
            tsample=5e-5,
        )
    # its numerator starts at z^-1 as well
    return np.concatenate([[0.0], np.ravel(model.NUMERATOR)]), np.ravel(model.DENOMINATOR)[1:]


def _frols(**settings: Any) -> Any:
    from sysidentpy.basis_function import Polynomial
    from sysidentpy.model_structure_selection import FROLS
    from sysidentpy.parameter_estimation import LeastSquares

    return FROLS(
        estimator=LeastSquares(),
        basis_function=Polynomial(degree=1),
        model_type='NARMAX',
        **settings,
    )


def _terms(model: Any, most: int) -> Coefficients:
    a, b = np.zeros(most), np.zeros(DELAY + most)
    for code, theta in zip(model.final_model, np.ravel(model.theta), strict=True):
        kind, lag = divmod(int(code.max()), 1000)
        if kind == 1:
            a[lag - 1] = -theta
        elif kind == 2:
            b[lag] = theta
    return b, a


def frols(data: Data, most: int) -> Coefficients:
    """Let SysIdentPy choose its terms, of any lag, one after the other, by BIC."""
    model = _frols(
        ylag=most,
        xlag=list(range(DELAY, DELAY + most)),
        order_selection=True,
        info_criteria='bic',
        n_info_values=2 * most,
    )
    model.fit(X=data.u[:, None], y=data.y[:, None])
    return _terms(model, most)


def frols_orders(data: Data, most: int) -> Coefficients:
    """Let SysIdentPy fit every order, and take the best by BIC."""
    X, Y = data.u[:, None], data.y[:, None]
    best: tuple[float, Any] = (np.inf, None)
    for na in range(1, most + 1):
        for nb in range(1, most + 1):
            model = _frols(
                ylag=list(range(1, na + 1)),
                xlag=list(range(DELAY, DELAY + nb)),
                order_selection=False,
                n_terms=na + nb,
            )
            model.fit(X=X, y=Y)
            # its errors would need another pass over the data; what FROLS explains is enough
            unexplained = max(1.0 - float(np.sum(model.err[: na + nb])), 1e-300)
            score = data.u.size * np.log(unexplained) + np.log(data.u.size) * (na + nb)
            if score < best[0]:
                best = (score, model)
    return _terms(best[1], most)


def sections(quick: bool = False) -> list[tuple[str, str]]:
    """Return titles and texts."""
    warnings.filterwarnings('ignore', module='sysidentpy')
    most, runs = (6, 2) if quick else (10, 5)
    for turn in range(runs):
        data_of(turn)
    works: dict[str, Callable[[Data, int], Coefficients]] = {
        'piezo_ident: search': ours,
        'piezo_ident: search, then output error': lambda data, m: ours(data, m, refine=True),
        'sippy_unipi: all orders, BIC': sippy,
        'SysIdentPy: FROLS at every order, BIC': frols_orders,
        'SysIdentPy: FROLS, its own terms, BIC': frols,
    }
    base, *others = works
    turns = take_turns(
        {name: lambda k, f=work: f(data_of(k), most) for name, work in works.items()},
        runs,
        warm=[base, others[0]],
    )
    errors = {
        name: np.array([data_of(k).error(found) for k, found in enumerate(turn.results)])
        for name, turn in turns.items()
    }
    rows = []
    for name, turn in turns.items():
        better = sum(errors[base] <= errors[name] * (1 + EQUAL))
        judged = '' if name.startswith('piezo_ident') else f'{better} of {runs}'
        times = (seconds(turn.median), ratio(turn.over(turns[base])))
        rows.append([name, *times, f'{np.median(errors[name]):.4f}', judged])
    times = f'over `{base}`'
    heads = ('search', 'median time', times, 'test error, % of rms', 'ours equal or better')
    text = _text(turns, base, most, runs, markdown(heads, rows))
    return [(f'Order search, {most}² ARX models', text)]


def _text(turns: dict[str, Turn], base: str, most: int, runs: int, table: str) -> str:
    peers = {name: t for name, t in turns.items() if name.startswith(('sippy', 'SysIdentPy'))}
    same = {name: t for name, t in peers.items() if 'own terms' not in name}
    fastest = min(same, key=lambda name: same[name].median)
    return f"""\
Orders na, nb = 1..{most} at a known delay, {SAMPLES:,} samples of the noise of `stage_paper`,
{runs} paired turns, each with another sensor noise. The last 20 % judge a free run.

{table}

Fastest peer over the same orders: {fastest}, {ratio(same[fastest].over(turns[base]))} times our
time. sippy_unipi runs `system_identification` with `"ARX"`, `IC="BIC"` and our delay. SysIdentPy
runs linear `FROLS` with `LeastSquares`: at every order, for which it is not made, or over
{2 * most} nested models of the same lags. We lack the nonlinear terms of SysIdentPy, and
the search for the delay and the further models of sippy_unipi."""


if __name__ == '__main__':
    show(sections)

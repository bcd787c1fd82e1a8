# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Step 3: fit the weights of H by bounded least squares, or by particle swarm as in the paper.

With thresholds and dynamics fixed, the output is linear in the offset, q_i, p1 and p2:

    y = offset + sum_i q_i (G F_ri[v]) + p1 (G v^3) + p2 (G v),        q_i >= 0.

The filtered plays are therefore columns of a regression, and so are the terms of a wider law
(`HysteresisLaw`).  The columns are reduced once to the triangular factor R, with the offsets in
front.  The rows of R below the offsets hold the problem without the offsets.  The swarm needs only
the Gram matrix of these rows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.common.errors import IdentificationError
from piezo_ident.common.kernel import kernel
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.settings import Solver
from piezo_ident.identification.solvers.least_squares import (
    bounded_least_squares,
    triangular_factor,
)
from piezo_ident.identification.solvers.particle_swarm import particle_swarm, Quadratic
from piezo_ident.operators.dynamics import Delay, Dynamics, filter_arx
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import HysteresisLaw, LawName
from piezo_ident.operators.kernels import hysteresis
from scipy.optimize import OptimizeResult

#: box in which the swarm starts and stays, in units of full stroke over full voltage range
WEIGHT_BOX, P1_BOX, P2_BOX = (0.0, 2.0), (-2.0, 2.0), (-2.0, 4.0)
#: share of the column of v^3, or of a column itself, below which a rest of a column is rounding
STILL = 1e-8
#: weight that pulls lags along the path to zero, as a share of the size of the linear term
PULL = 0.01
#: share of the transient of G that is left at the first used sample
FORGOTTEN = 1e-13


def even_thresholds(swing: float, count: int) -> Array:
    """
    Space thresholds evenly from 0 over the excited swing, without the 0.

    The play at r = 0 is the linear term, so `count` operators have ``count - 1`` thresholds.
    Raises IdentificationError if there is no swing.

    Examples
    --------
    >>> even_thresholds(1.0, 4)
    array([0.25, 0.5 , 0.75])
    """
    if not swing > 0.0:
        raise IdentificationError(
            'hysteresis: the voltage never moves in the data fitted; record a triangle over the '
            'range'
        )
    return swing * np.arange(1, count) / count


def fine_thresholds(swing: float, excursion: float) -> Array:
    """
    Space thresholds for a temporary H that only serves to find G.

    40 operators cover the swing of the record.  A dozen more thresholds cover the excursion of
    the noise.  Swing and excursion are peak to peak.  Without thresholds inside the excursion,
    the fit of G would take hysteresis inside the noise for slow dynamics.
    """
    fine = excursion * np.arange(1, 13) / 12.0
    return np.unique(np.concatenate([even_thresholds(swing, 40), fine[fine < 0.9 * swing]]))


@kernel
def _average(x: Array, stretches: Integers, row: int, out: Array) -> None:
    # a mean never crosses a hole in the mask; the last incomplete row is left out
    place = 0
    for m in range(stretches.shape[0]):
        for i in range((stretches[m, 1] - stretches[m, 0]) // row):
            start = stretches[m, 0] + i * row
            out[place] = x[start : start + row].sum() / np.sqrt(row)
            place += 1


def factorise(
    excerpts: Sequence[Excerpt], law: HysteresisLaw | Array, dynamics: Dynamics, delay: Delay
) -> Array:
    """
    Reduce the data to the factor R of ``[offsets | G times the columns of the law | y]``.

    Each excerpt has an offset of its own.  Thresholds alone, shape (m,), stand for the law of
    plays.
    """
    law = _law(law)
    rows = filtered_rows(excerpts, law, dynamics, delay)
    return triangular_factor(rows, len(excerpts) + law.size + 1)


def filtered_rows(
    excerpts: Sequence[Excerpt], law: HysteresisLaw, dynamics: Dynamics, delay: Delay
) -> Iterator[Array]:
    """Yield the rows that `factorise` reduces, in order of time, one block per excerpt."""
    k, r = len(excerpts), law.thresholds
    # a fraction of a sample of delay is a mean of two samples; G can apply it behind the plays
    part = np.array([1.0 - delay.fraction, delay.fraction])
    G = replace(dynamics, b=np.convolve(dynamics.b, part)) if delay.fraction else dynamics
    for i, excerpt in enumerate(excerpts):
        row, memory = excerpt.row, excerpt.start(r).copy()
        stretches = np.array(excerpt.averaged, dtype=np.int64).reshape(-1, 2)
        n = excerpt.rows
        block = np.zeros((k + law.size + 1, n))
        block[i] = np.sqrt(row)
        # the plays need all earlier samples, G only as many as it remembers
        begin, end = (stretches[0, 0], stretches[-1, 1]) if n else (0, 1)
        begin = max(0, begin - dynamics.memory(FORGOTTEN) - delay.samples - 1)
        # lags along the path start with the excerpt, so they need it from its first sample
        begin = 0 if law.lags else begin
        stretches -= begin
        before, u = excerpt.u[:begin], excerpt.u[begin:end]
        # advance the memory alone; a frozen array would be another type to the compiler
        hysteresis(before, np.array(r), np.zeros(r.size), 0.0, 0.0, memory, np.empty(begin))
        for j, column in enumerate(law.columns(Delay(delay.samples).apply(u), memory), start=k):
            _average(filter_arx(G.a, G.b, column), stretches, row, block[j])
        _average(excerpt.x[begin:end], stretches, row, block[-1])
        yield block.T


def _law(law: HysteresisLaw | Array) -> HysteresisLaw:
    return law if isinstance(law, HysteresisLaw) else HysteresisLaw('plays', law)


def _independent(A: Array, m: int, densities: int) -> Mask:
    """
    Mark the columns that the data can tell apart.

    The columns are m plays, further densities, and powers of v.  A voltage with only two levels
    makes every play and the cubic a multiple of v.  The linear term is then kept, so that large
    weights cannot cancel each other.  Further densities are sums of plays.  Their weights are
    >= 0, so they cannot cancel plays, only powers of v.
    """
    size = A.shape[1]
    keep, basis = np.zeros(size, dtype=bool), np.empty((A.shape[0], 0))
    for j in (*reversed(range(densities, size)), *range(m, densities), *range(m)):
        length = np.linalg.norm(A[:, j])
        if length == 0.0:
            continue
        rest = A[:, j] / length
        for _ in range(2):
            rest = rest - basis @ (basis.T @ rest)
        length = np.linalg.norm(rest)
        if length > STILL:
            keep[j] = True
            if not m <= j < densities:
                basis = np.column_stack([basis, rest / length])
    return keep


@dataclass(frozen=True, eq=False)
class HysteresisFit:
    """
    Result of step 3.

    Attributes
    ----------
    hysteresis : Hysteresis
    offsets : ndarray
        Displacement at u = 0 of each excerpt, normalised.
    solver : {'least_squares', 'swarm'}
    polished : bool
        Whether bounded least squares finished the fit of the swarm.
    loss : float
        Sum of squares with the returned weights, over `n` samples.
    swarm_loss : float or None
        Sum of squares that the swarm reached.
    optimum_loss : float
        Sum of squares of bounded least squares.
    n : int
        Samples fitted.
    std : ndarray, shape (m + 2,)
        Standard deviation of the weights, p1 and p2 for white residuals.  It is zero for a weight
        on a bound, and for a play that the data do not excite.
    swarm : scipy.optimize.OptimizeResult or None
    coefficients : ndarray, shape (size,)
        Coefficients of the columns of the law.
    law : str
        Name of the law (`piezo_ident.operators.hysteresis_law.LAWS`).
    errors_of_laws : mapping of str to float
        Error of each law that was tried.  Parts of the data are predicted from all others
        (`piezo_ident.identification.step3_choice.Choice`).  Empty if no law could be better.
    """

    hysteresis: Hysteresis
    offsets: Array
    solver: Solver
    polished: bool
    loss: float
    swarm_loss: float | None
    optimum_loss: float
    n: int
    std: Array
    swarm: OptimizeResult | None
    coefficients: Array
    law: LawName = 'plays'
    errors_of_laws: Mapping[str, float] = field(default_factory=dict)

    @property
    def rms(self) -> float:
        """Root mean square of the residual, averaged over the rows of the fit, normalised."""
        return float(np.sqrt(self.loss / self.n))

    def left(self, R: Array) -> float:
        """Compute the sum of squares of the residual; R is of the same runs as in `factorise`."""
        theta = np.concatenate([self.offsets, self.coefficients])
        return float(np.sum((R[:, :-1] @ theta - R[:, -1]) ** 2))


def fit_hysteresis(
    R: Array,
    law: HysteresisLaw | Array,
    n: int = 1,
    *,
    solver: Solver = 'least_squares',
    polish: bool = False,
    rows: int | None = None,
    **flight: Any,
) -> HysteresisFit:
    """
    Find the weights of H from the R of `factorise`.

    Parameters
    ----------
    R : ndarray
    law : HysteresisLaw, or ndarray of shape (m,)
    n : int, optional
        Number of samples behind R; only `rms` and `std` of the result depend on it.
    solver : {'least_squares', 'swarm'}
        Solver whose weights are returned; the losses of both are kept.
    polish : bool, optional
        Whether bounded least squares finishes the fit of the swarm.
    rows : int, optional
        Number of rows to which the samples were averaged (`Excerpt.rows`); `n` by default.
    **flight
        `rng` and options of `piezo_ident.identification.solvers.particle_swarm.particle_swarm`.

    Raises IdentificationError if the displacement does not move in the data.
    """
    law = _law(law)
    m = law.densities
    k = R.shape[0] - law.size - 1
    inner = R[k:, k:].copy()
    # a play that stands still leaves only rounding in its column, which any weight would fit
    still = np.linalg.norm(inner[:, :m], axis=0) <= STILL * np.linalg.norm(R[:, -3])
    inner[:, :m][:, still] = 0.0
    inner[:, :-1][:, ~_independent(inner[:, :-1], law.thresholds.size, m)] = 0.0
    if not np.all(np.isfinite(R)) or np.linalg.norm(inner[:, -1]) == 0.0:
        raise IdentificationError('hysteresis: the displacement does not move; check the sensor')
    lower = law.lower
    # lags of neighbouring rates, fitted without a prior, become large and cancel each other
    pull = np.zeros((law.lags, inner.shape[1]))
    pull[:, m : m + law.lags] = PULL * np.linalg.norm(inner[:, -2]) * np.eye(law.lags)
    pulled = np.asarray(np.linalg.qr(np.vstack([inner, pull]), mode='r')) if law.lags else inner
    x, optimum = bounded_least_squares(pulled, lower, np.full(law.size, np.inf))
    if law.lags:
        optimum = float(np.sum((inner[:, :-1] @ x - inner[:, -1]) ** 2))
    x[np.linalg.norm(inner[:, :-1], axis=0) == 0.0] = 0.0
    swarm, swarm_loss = None, None
    if solver == 'swarm':
        low, high = np.array([WEIGHT_BOX] * m + [P1_BOX, P2_BOX]).T
        A, y = inner[:, :-1], inner[:, -1]
        problem = Quadratic(A.T @ A, A.T @ y, float(y @ y))
        swarm = particle_swarm(problem, low, high, tol=1e-3, **flight)
        # computed by the factor: the Gram matrix takes differences of large squares, losing digits
        swarm_loss = float(np.sum((A @ swarm.x - y) ** 2))
        if not polish:
            x = np.where(A.any(axis=0), swarm.x, 0.0)
    offsets = np.linalg.solve(R[:k, :k], R[:k, -1] - R[:k, k:-1] @ x)
    free = (x > lower) & inner[:, :-1].any(axis=0)
    gram = inner[:, :-1][:, free].T @ inner[:, :-1][:, free]
    loss = optimum if swarm_loss is None or polish else swarm_loss
    covariance = np.zeros((law.size, law.size))
    covariance[np.ix_(free, free)] = np.linalg.pinv(gram, hermitian=True) * loss
    covariance /= max((n if rows is None else rows) - law.size, 1)
    return HysteresisFit(
        hysteresis=law.hysteresis(x),
        offsets=np.asarray(offsets),
        solver=solver,
        polished=solver == 'swarm' and polish,
        loss=loss,
        swarm_loss=swarm_loss,
        optimum_loss=optimum,
        n=n,
        std=law.deviations(covariance),
        swarm=swarm,
        coefficients=x,
        law=law.name,
    )


def fit_again(
    fit: HysteresisFit, excerpts: Sequence[Excerpt], dynamics: Dynamics, delay: Delay
) -> HysteresisFit:
    """Fit the weights of the same law on the same thresholds to other data."""
    h = fit.hysteresis
    law = HysteresisLaw(fit.law, h.thresholds, h.span)
    R = factorise(excerpts, law, dynamics, delay)
    n, rows = int(sum(e.use.sum() for e in excerpts)), sum(e.rows for e in excerpts)
    return replace(fit_hysteresis(R, law, n, rows=rows), errors_of_laws=fit.errors_of_laws)

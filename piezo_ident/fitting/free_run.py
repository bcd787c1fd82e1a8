# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit a stage by Gauss-Newton on the free-run error, inside bounds, with priors and damping.

Damping after D. W. Marquardt, J. Soc. Indust. Appl. Math. 11(2), 1963, pp. 431-441,
doi:10.1137/0111030.  Each step solves one bounded least-squares problem for all parameters
together, and so finds the linear parameters, mainly the weights of H, almost exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import itertools
import math

import numpy as np
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.common.errors import IdentificationError, ModelError
from piezo_ident.fitting.equations import bounded_step, Equations
from piezo_ident.fitting.stage import Stage
from piezo_ident.fitting.stretch import Stretch

#: damping as a share of the energy of each column: the first damping, the factors after a failed
#: and after a good step, the smallest damping, and the damping that ends the fit
DAMPING, WORSE, BETTER, LEAST, MOST = 1e-4, 5.0, 0.1, 1e-9, 1e6
#: the fit ends if a step lowers the loss, or promises to, by less than this share
SLOW = 1e-4
#: independent observations in a block, as neighbouring residuals are alike (taste)
OBSERVATIONS = 5.0
#: most passes over the weight of the prior; the passes end once one of them leaves more than this
#: share of the loss.  Smallest share of the loss that a step may promise, and smallest loss: a
#: smaller loss is rounding
PASSES, ALIKE, EXACT, TINY = 10, 0.9, 1e-12, 1e-290


@dataclass(frozen=True, eq=False)
class Fit:
    """
    Result of a fit.

    Attributes
    ----------
    stage : Stage
    loss : float
        Sum of squared residuals over the samples that count, normalised.
    equations : Equations
        Normal equations at the result, block by block.
    iterations : int
        Number of steps.
    """

    stage: Stage
    loss: float
    equations: Equations
    iterations: int

    @property
    def n(self) -> int:
        """Number of samples that count."""
        return int(self.equations.rows.sum())

    @property
    def rms(self) -> float:
        """Root mean square of the residual, normalised."""
        return float(np.sqrt(self.loss / max(self.n, 1)))

    def prior_weight(self) -> Array:
        """Compute the information that the prior adds to the equations, shape (p, p)."""
        return _prior_weight(self.stage, self.loss, self.equations.rows)

    def held_out(self, sets: Integers) -> Array:
        """Predict every block from the other sets, and sum its squared errors; shape (n_b,)."""
        values, (lower, upper) = self.stage.values, self.stage.bounds
        bounds = lower - values, upper - values
        return self.equations.held_out(sets, self.prior_weight(), *bounds, self.stage.rising)

    def covariance(self) -> Array:
        """Compute the covariance of the values for white residuals; zero on a bound."""
        free = self.stage.free(self.stage.values)
        A = self.equations.A.sum(axis=0)[np.ix_(free, free)]
        size = np.sqrt(np.maximum(np.diag(A), np.finfo(float).tiny))
        whole = np.zeros((free.size, free.size))
        inverse = np.linalg.pinv(A / np.outer(size, size), 1e-12, hermitian=True)
        whole[np.ix_(free, free)] = inverse / np.outer(size, size) * self.loss / max(self.n, 1)
        return whole


def residuals(stage: Stage, stretches: Sequence[Stretch]) -> list[Array]:
    """Compute measured minus predicted displacement of each stretch, shapes (n,)."""
    return [s.x - stage.signals(s)[2] - stage.added(s) for s in stretches]


def fit(
    stage: Stage,
    stretches: Sequence[Stretch],
    *,
    iterations: int = 15,
    tick: Callable[[], None] = lambda: None,
) -> Fit:
    """
    Fit all parameters of a stage.

    Parameters
    ----------
    stage : Stage
        Start of the fit; orders, delay, thresholds and time constants are kept.
    stretches : sequence of Stretch
    iterations : int, optional
        Most steps.
    tick : callable, optional
        Called once a step; it may raise to stop the work.

    Raises
    ------
    IdentificationError
        If no sample counts, or the prediction of the start is not finite.
    """
    if not any(s.use.any() for s in stretches):
        raise IdentificationError('no sample is left to fit; hold out less')
    here = _at(stage, stretches)
    if not np.isfinite(here.loss):
        raise IdentificationError(
            'the first guess of the free-run fit diverges on these data; are all values of a '
            'plausible size?'
        )
    equations, damping, done = _linearised(here, stretches), DAMPING, 0
    for _ in range(iterations):
        tick()
        better, gained, damping = _step(here, equations, stretches, damping)
        if better is None:
            break
        fall, here = gained, better
        damping = max(damping * BETTER, LEAST)
        equations, done = _linearised(here, stretches), done + 1
        if fall < SLOW or here.loss == 0.0:
            break
    return Fit(here.stage, here.loss, equations, done)


@dataclass(frozen=True, eq=False)
class _Point:
    """Stage with its signals on each stretch, and its sum of squares."""

    stage: Stage
    signals: Sequence[tuple[Array, Array, Array]]
    loss: float


def _at(stage: Stage, stretches: Sequence[Stretch]) -> _Point:
    signals = [stage.signals(s) for s in stretches]
    return _Point(stage, signals, _loss(stage, stretches, signals))


def _step(
    here: _Point, equations: Equations, stretches: Sequence[Stretch], damping: float
) -> tuple[_Point | None, float, float]:
    """Find the first better point with its gain and its damping; None if no step helps."""
    stage, count = here.stage, _observations(equations.rows)
    values = stage.values
    now = _cost(here.loss, count, stage, values)
    while damping < MOST:
        step, left = _solved(here, equations, damping)
        if now - _cost(left, count, stage, values + step) < SLOW * count:
            break
        try:
            there = _at(stage.moved(values + step), stretches)
        except ModelError:
            damping *= WORSE
            continue
        gained = now - _cost(there.loss, count, stage, there.stage.values)
        if gained > 0.0:
            return there, gained / count, damping
        damping *= WORSE
    return None, 0.0, damping


def _solved(here: _Point, equations: Equations, damping: float) -> tuple[Array, float]:
    """
    Solve the linearised equations; return the step and the loss that it promises.

    The prior counts like one observation with the rms of the remaining residual.  The equations
    promise another residual, so they are solved again with the promised residual.
    """
    stage, left = here.stage, here.loss
    values, (lower, upper) = stage.values, stage.bounds
    A, b, step = equations.A.sum(axis=0), equations.b.sum(axis=0), np.zeros(values.size)
    for _ in range(PASSES):
        weight = _prior_weight(stage, left, equations.rows)
        step = bounded_step(
            A + weight,
            b + weight @ (stage.prior[0] - values),
            lower - values,
            upper - values,
            damping=damping,
            rising=stage.rising,
        )
        before = left
        left = max(here.loss - float(step @ (2.0 * b - A @ step)), EXACT * here.loss)
        if left > ALIKE * before:
            break
    return step, left


def _cost(loss: float, count: float, stage: Stage, values: Array) -> float:
    """Compute minus twice the logarithm of the posterior density, with the noise left open."""
    middle, information = stage.prior
    away = values - middle
    return count * math.log(max(loss, TINY)) + float(away @ information @ away)


def _observations(rows: Integers) -> float:
    return max(1.0, OBSERVATIONS * float(np.count_nonzero(rows)))


def _prior_weight(stage: Stage, loss: float, rows: Integers) -> Array:
    return stage.prior[1] * (loss / _observations(rows))


def _loss(
    stage: Stage, stretches: Sequence[Stretch], signals: Sequence[tuple[Array, Array, Array]]
) -> float:
    with np.errstate(over='ignore', invalid='ignore'):
        return float(
            sum(
                np.sum((s.x - y - stage.added(s))[s.use] ** 2)
                for s, (_, _, y) in zip(stretches, signals, strict=True)
            )
        )


def _linearised(here: _Point, stretches: Sequence[Stretch]) -> Equations:
    """Compute the normal equations of all stretches, block by block."""
    count = 1 + max(int(s.block[-1]) for s in stretches)
    stage = here.stage
    p = stage.values.size
    A, b, total = np.zeros((count, p, p)), np.zeros((count, p)), np.zeros(count)
    rows = np.zeros(count, dtype=np.int64)
    for s, own in zip(stretches, here.signals, strict=True):
        at = np.flatnonzero(s.use)
        if not at.size:
            continue
        e, block = (s.x - own[2] - stage.added(s))[at], s.block[at]
        M = np.zeros((p, at.size))
        for row, column in zip(M, stage.columns(s, own), strict=True):
            if column is not None:
                np.take(column, at, out=row, mode='clip')
        edges = np.concatenate([[0], np.flatnonzero(np.diff(block)) + 1, [at.size]])
        for start, stop in itertools.pairwise(edges):
            k, part = block[start], M[:, start:stop]
            A[k] += part @ part.T
            b[k] += part @ e[start:stop]
            total[k] += e[start:stop] @ e[start:stop]
            rows[k] += stop - start
    return Equations(A, b, total, rows)

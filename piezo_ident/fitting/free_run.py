# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit a stage by Gauss-Newton on the free-run error, inside bounds, with priors and damping.

Each step solves one bounded least-squares problem for all parameters together, and so finds the
linear parameters, mainly the weights of H, almost exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
import itertools
import math

import numpy as np
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.common.errors import IdentificationError
from piezo_ident.fitting.damped import DampingSchedule, descend
from piezo_ident.fitting.equations import bounded_step, NormalEquations
from piezo_ident.fitting.stage import Stage
from piezo_ident.fitting.stretch import block_count, Stretch

#: damping of the steps
SCHEDULE = DampingSchedule(first=1e-4, least=1e-9, worse=5.0, better=10.0, most=1e6)
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
    equations : NormalEquations
        Normal equations at the result, block by block.
    rows : ndarray of int, shape (blocks,)
        Number of samples of each block that count.
    """

    stage: Stage
    loss: float
    equations: NormalEquations
    rows: Integers

    @property
    def n(self) -> int:
        """Number of samples that count."""
        return int(self.rows.sum())

    @property
    def rms(self) -> float:
        """Root mean square of the residual, normalised."""
        return float(np.sqrt(self.loss / max(self.n, 1)))

    def prior_weight(self) -> Array:
        """Compute the information that the prior adds to the equations, shape (p, p)."""
        return self.stage.prior[1] * (self.loss / _observations(self.rows))

    def held_out(self, sets: Integers) -> Array:
        """Predict every block from the other sets, and sum its squared errors; shape (n_b,)."""
        stage, equations = self.stage, self.equations
        lower, upper = (bound - stage.values for bound in stage.bounds)
        solve = partial(bounded_step, lower=lower, upper=upper, rising=stage.rising)
        A, b = equations.A.sum(axis=0) + self.prior_weight(), equations.b.sum(axis=0)
        errors = equations.errors(equations.solved_without(sets, A, b, solve))
        # far from its minimum the linear prediction fails, and could claim less than the fit error
        return np.asarray(np.maximum(errors, equations.s))

    def covariance(self) -> Array:
        """Compute the covariance of the values for white residuals; zero on a bound."""
        free = self.stage.free(self.stage.values)
        A = self.equations.A.sum(axis=0)[np.ix_(free, free)]
        size = np.sqrt(np.maximum(np.diag(A), np.finfo(float).tiny))
        whole = np.zeros((free.size, free.size))
        inverse = np.linalg.pinv(A / np.outer(size, size), 1e-12, hermitian=True)
        whole[np.ix_(free, free)] = inverse / np.outer(size, size) * self.loss / max(self.n, 1)
        return whole


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
        n = sum(s.use.size for s in stretches)
        raise IdentificationError(f'none of {n} samples is left to fit; hold out less')
    start = _Point(stage, stretches)
    if not np.isfinite(start.loss):
        raise IdentificationError(
            'the first guess of the free-run fit diverges on these data; are all values of a '
            'plausible size?'
        )
    n = block_count(stretches)
    rows = np.sum([np.bincount(s.block[s.use], minlength=n) for s in stretches], axis=0)
    count = _observations(rows)
    schedule = replace(SCHEDULE, enough=SLOW * count)

    def cost(here: _Point) -> float:
        return _cost(here.loss, count, stage, here.stage.values)

    def step(here: _Point, equations: NormalEquations, damping: float) -> _Point | None:
        move, left = _solved(here, equations, count, damping)
        values = here.stage.values + move
        if cost(here) - _cost(left, count, stage, values) < schedule.enough:
            return None
        return _Point(here.stage.moved(values), stretches)

    end = descend(start, cost, lambda one: one.equations, step, schedule, iterations, tick)
    return Fit(end.stage, end.loss, end.equations, rows)


class _Point:
    """Stage with its signals on each stretch, its sum of squares, and its normal equations."""

    def __init__(self, stage: Stage, stretches: Sequence[Stretch]) -> None:
        self.stage, self._stretches = stage, stretches
        self._signals = [stage.signals(s) for s in stretches]
        with np.errstate(over='ignore', invalid='ignore'):
            both = zip(stretches, self._signals, strict=True)
            self._errors = [s.x - y - stage.added(s) for s, (_, _, y) in both]
            used = zip(self._errors, stretches, strict=True)
            self.loss = float(sum(np.sum(e[s.use] ** 2) for e, s in used))

    @cached_property
    def equations(self) -> NormalEquations:
        """Normal equations of all stretches, block by block."""
        stage, count = self.stage, block_count(self._stretches)
        p = stage.values.size
        A, b, total = np.zeros((count, p, p)), np.zeros((count, p)), np.zeros(count)
        for s, own, error in zip(self._stretches, self._signals, self._errors, strict=True):
            at = np.flatnonzero(s.use)
            if not at.size:
                continue
            e, block = error[at], s.block[at]
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
        return NormalEquations(A, b, total)


def _solved(
    here: _Point, equations: NormalEquations, count: float, damping: float
) -> tuple[Array, float]:
    """
    Solve the linearised equations; return the step and the loss that it promises.

    The prior counts like one observation with the rms of the remaining residual.  The equations
    promise another residual, so they are solved again with the promised residual.
    """
    stage, left = here.stage, here.loss
    values, (lower, upper) = stage.values, stage.bounds
    bounds, away = (lower - values, upper - values), stage.prior[0] - values
    A, b, step = equations.A.sum(axis=0), equations.b.sum(axis=0), np.zeros(values.size)
    for _ in range(PASSES):
        W, before = stage.prior[1] * (left / count), left
        step = bounded_step(A + W, b + W @ away, *bounds, damping=damping, rising=stage.rising)
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

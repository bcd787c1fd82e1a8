# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Refine G by output error: the parameters minimise the error of the free run, not of one step.

Gauss-Newton with the damping of Levenberg minimises  sum (y - B/A z^-d w - offset)^2.  With
w_f = w/A and y_f = y_sim/A the gradients are shifts of two filtered signals:

    d y_sim / d b_j = w_f(k-d-j+1),      d y_sim / d a_i = - y_f(k-i)

after Ljung, System Identification, 2nd ed. (1999), section 10.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.common.kernel import kernel
from piezo_ident.fitting.damped import DampingSchedule, descend
from piezo_ident.fitting.stage import RADIUS
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.operators.dynamics import Dynamics, filter_arx

#: number of samples whose products are summed at once
STRETCH = 1024
#: damping of the steps, and the end of the refinement
SCHEDULE = DampingSchedule(1e-3, 1e-12, worse=4.0, better=10.0, most=1e8, slow=1e-7)


@dataclass(frozen=True, eq=False)
class OutputErrorFit:
    """Result of the refinement; the covariance of (a, b) assumes white output noise."""

    dynamics: Dynamics
    covariance: Array

    @property
    def normalised_covariance(self) -> Array:
        """Covariance of (a, b) of ``dynamics.normalised()``, whose b depend on the gain."""
        G, na = self.dynamics, self.dynamics.a.size
        J = np.eye(na + G.b.size)
        # b / g with the gain g = sum(b) / (1 + sum(a))
        share = (G.b / G.b.sum())[:, None]
        J[na:, :na] = share
        J[na:, na:] -= share
        J[na:, na:] /= G.gain
        return np.asarray(J @ self.covariance @ J.T)


@kernel
def _first_row(x: Array, z: Array, x_at: int, z_at: int, n: int, lags: int) -> Array:
    row = np.zeros(lags)
    # all lags of a stretch are summed while it is in the cache
    for start in range(0, n, STRETCH):
        size = min(STRETCH, n - start)
        a = x[x_at + start : x_at + start + size]
        for j in range(lags):
            # slices have no negative indices, which lets the compiler vectorise the loop
            b = z[z_at + start - j : z_at + start - j + size]
            total = 0.0
            for k in range(size):
                total += a[k] * b[k]
            row[j] += total
    return row


def lag_products(x: Array, z: Array, x_at: int, z_at: int, n: int, n_x: int, n_z: int) -> Array:
    """
    Sum the products of lagged signals, without the matrix of their lags.

    ``S(i, j)`` is the sum over n samples of ``x(k - i) z(k - j)``.  Row 0 and column 0 are summed
    directly.  Each further row follows from the row above:

        S(i+1, j+1) = S(i, j) + x(s-1-i) z(s-1-j) - x(e-1-i) z(e-1-j)

    `x_at` and `z_at` are the places of the first of the n samples s .. e-1 in each signal.  At
    least as many samples as lags come before them.  The sums have shape (n_x, n_z), the numbers
    of lags.

    Examples
    --------
    >>> x = np.arange(5.0)
    >>> lag_products(x, x, 2, 2, 3, 2, 2)
    array([[29., 20.],
           [20., 14.]])
    """
    S = np.empty((n_x, n_z))
    S[0] = _first_row(x, z, x_at, z_at, n, n_z)
    if x is z and x_at == z_at and n_x == n_z:
        S[:, 0] = S[0]
    else:
        S[:, 0] = _first_row(z, x, z_at, x_at, n, n_x)
    _fill_rows(S, x, z, x_at, z_at, n)
    return S


@kernel
def _fill_rows(S: Array, x: Array, z: Array, x_at: int, z_at: int, n: int) -> None:
    for i in range(1, S.shape[0]):
        for j in range(1, S.shape[1]):
            first = x[x_at - i] * z[z_at - j]
            last = x[x_at + n - i] * z[z_at + n - j]
            S[i, j] = S[i - 1, j - 1] + (first - last)


Stretches = list[tuple[int, int]]
#: model with the errors of its free run
Point = tuple[Dynamics, list[Array]]


def _mean(x: Array, stretches: Stretches) -> float:
    total = sum(float(np.sum(x[start:stop])) for start, stop in stretches)
    return total / sum(stop - start for start, stop in stretches)


def _past(x: Array, stretches: Stretches, count: int, negative: bool = False) -> Array:
    # the stage counts as at rest before the record.  Signals without their level keep more digits
    # in the sums; the offsets are eliminated, so the level has no effect on the result
    level = _mean(x, stretches)
    past = np.empty(count + x.size)
    if negative:
        np.subtract(level, x, out=past[count:])
    else:
        np.subtract(x, level, out=past[count:])
    past[:count] = past[count]
    return past


class _Problem:
    """Normal equations of the linearised problem, offsets eliminated stretch by stretch."""

    def __init__(self, stretches: Sequence[Excerpt], na: int, nb: int) -> None:
        self.stretches, self.na, self.nb = stretches, na, nb
        self.n = int(sum(s.use.sum() for s in stretches))
        self.used = [s.stretches for s in stretches]

    def errors(self, model: Dynamics) -> list[Array]:
        """Compute the free-run error of each stretch, without its mean."""
        errors = []
        for s, used in zip(self.stretches, self.used, strict=True):
            e = filter_arx(model.a, model.b, s.u)
            np.subtract(s.x, e, out=e)
            e -= _mean(e, used)
            errors.append(e)
        return errors

    def loss(self, errors: Sequence[Array]) -> float:
        total = 0.0
        for e, used in zip(errors, self.used, strict=True):
            total += sum(float(np.sum(np.square(e[start:stop]))) for start, stop in used)
        return total / self.n

    def normal(self, model: Dynamics, errors: Sequence[Array]) -> tuple[Array, Array]:
        na, p = self.na, self.na + self.nb
        H, g = np.zeros((p, p)), np.zeros(p)
        one = np.ones(1)
        for s, e, used in zip(self.stretches, errors, self.used, strict=True):
            # lagged signals of the products: y(k-1), y(k-2), ... and w(k), w(k-1), ...
            groups = []
            if na:
                # x - e is the simulated output plus a constant, which `_past` removes
                y_f = _past(filter_arx(model.a, one, s.x - e), used, p, negative=True)
                groups.append((y_f, p - 1, slice(0, na), na))
            w_f = _past(filter_arx(model.a, one, s.u), used, p)
            groups.append((w_f, p, slice(na, p), p - na))
            sums, n = np.zeros(p), 0
            for start, stop in used:
                n += stop - start
                here = stop - start
                for x, x_at, rows, n_x in groups:
                    at = start + x_at
                    g[rows] += lag_products(x, e, at, start, here, n_x, 1)[:, 0]
                    back = np.arange(1, n_x)
                    sums[rows] += float(np.sum(x[at : at + here]))
                    sums[rows][1:] += np.cumsum(x[at - back] - x[at + here - back])
                    for z, z_at, columns, n_z in groups:
                        if columns.start >= rows.start:
                            H[rows, columns] += lag_products(
                                x, z, at, start + z_at, here, n_x, n_z
                            )
            H -= np.outer(sums, sums) / n
        H[na:, :na] = H[:na, na:].T
        return H, g


def simulation_error(stretches: Sequence[Excerpt], model: Dynamics) -> float:
    """Compute the rms of the free-run error, around the mean of each stretch."""
    problem = _Problem(stretches, model.a.size, model.b.size)
    return float(np.sqrt(problem.loss(problem.errors(model))))


def output_error(
    stretches: Sequence[Excerpt],
    start: Dynamics,
    maxiter: int = 30,
    tick: Callable[[], None] = lambda: None,
) -> OutputErrorFit:
    """
    Refine stable dynamics by free-run simulation error; the orders stay.

    The result is stable, and the start itself if no step lowers the error.  `tick` is called once
    an iteration; it may raise to stop the work.
    """
    na, nb = start.a.size, start.b.size
    problem = _Problem(stretches, na, nb)

    def loss(point: Point) -> float:
        return problem.loss(point[1])

    def normal(point: Point) -> tuple[Array, Array]:
        return problem.normal(*point)

    def step(point: Point, equations: tuple[Array, Array], damping: float) -> Point:
        (model, _), (H, g) = point, equations
        diagonal = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
        scaled = H / np.outer(diagonal, diagonal)
        delta = np.linalg.solve(scaled + damping * np.eye(na + nb), g / diagonal) / diagonal
        trial = Dynamics(a=model.a + delta[:na], b=model.b + delta[na:])
        if not trial.is_within(RADIUS):
            raise ModelError('dynamics: unstable')
        return trial, problem.errors(trial)

    first = start, problem.errors(start)
    end = descend(first, loss, normal, step, SCHEDULE, maxiter, tick)
    H, _ = problem.normal(*end)
    covariance = np.asarray(
        loss(end) / problem.n * np.linalg.pinv(H / problem.n, 1e-14, hermitian=True)
    )
    return OutputErrorFit(end[0], covariance)

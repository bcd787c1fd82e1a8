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
Refinement of G by output error: the parameters that simulate best, not those that predict a step.

Gauss-Newton with Levenberg's damping on  sum (y - B/A z^-d w - offset)^2.  With w_f = w/A and
y_f = y_sim/A the gradients are shifts of two filtered signals:

    d y_sim / d b_j = w_f(k-d-j+1),      d y_sim / d a_i = - y_f(k-i)

after Ljung, System Identification, 2nd ed. (1999), section 10.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.dynamics import Dynamics, filter_arx
from piezo_ident.lagged import lag_products, stretches_of

__all__ = ['OutputErrorFit', 'Stretch', 'output_error', 'simulation_error']

#: poles beyond this radius count as unstable: they would ring for longer than any record
RADIUS = 0.99999


@dataclass(frozen=True, eq=False)
class Stretch:
    """
    Data for one simulation.

    Attributes
    ----------
    w, y : ndarray, shape (n,)
        Input, already delayed by d, and output; the run starts in equilibrium with ``w[0]``.
    use : ndarray of bool, shape (n,)
        Samples that count.
    """

    w: NDArray[np.float64]
    y: NDArray[np.float64]
    use: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class OutputErrorFit:
    """
    Result of the refinement.

    Attributes
    ----------
    dynamics : Dynamics
    covariance : ndarray, shape (na + nb, na + nb)
        Of (a, b), for white output noise.
    rms : float
        Root mean square of the simulation error.
    offsets : ndarray
        Constant added to each stretch.
    iterations : int
    improved : bool
        Whether anything better than the start was found.
    """

    dynamics: Dynamics
    covariance: NDArray[np.float64]
    rms: float
    offsets: NDArray[np.float64]
    iterations: int
    improved: bool


def _past(
    x: NDArray[np.float64], use: NDArray[np.bool_], count: int, sign: float = 1.0
) -> NDArray[np.float64]:
    # before the record the stage was at rest; a constant has no part in what is eliminated with
    # the offsets, and without it the sums lose no digits
    level = float(x[use].mean())
    past = np.empty(count + x.size)
    past[:count] = x[0] - level
    np.subtract(x, level, out=past[count:])
    past *= sign
    return past


class _Problem:
    """Normal equations of the linearised problem, offsets eliminated stretch by stretch."""

    def __init__(self, stretches: Sequence[Stretch], na: int, nb: int) -> None:
        self.stretches, self.na, self.nb = stretches, na, nb
        self.n = int(sum(s.use.sum() for s in stretches))
        self.used = [stretches_of(s.use) for s in stretches]
        self.ones = np.ones(max(s.use.size for s in stretches))

    def loss(self, model: Dynamics) -> tuple[float, NDArray[np.float64]]:
        total, offsets = 0.0, []
        for s in self.stretches:
            e = filter_arx(model.a, model.b, s.w)
            np.subtract(s.y, e, out=e)
            e = e[s.use]
            offsets.append(float(e.mean()))
            e -= offsets[-1]
            np.square(e, out=e)
            total += float(np.sum(e))
        return total / self.n, np.array(offsets)

    def normal(self, model: Dynamics) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        na, p = self.na, self.na + self.nb
        H, g = np.zeros((p, p)), np.zeros(p)
        one = np.ones(1)
        for s, stretches in zip(self.stretches, self.used, strict=True):
            e = filter_arx(model.a, model.b, s.w)
            # what is y(k-1), y(k-2), ... and w(k), w(k-1), ... to the products
            groups = []
            if na:
                y_f = _past(filter_arx(model.a, one, e), s.use, p, -1.0)
                groups.append((y_f, p - 1, slice(0, na), na))
            w_f = _past(filter_arx(model.a, one, s.w), s.use, p)
            groups.append((w_f, p, slice(na, p), p - na))
            np.subtract(s.y, e, out=e)
            e -= e[s.use].mean()
            sums, n = np.zeros(p), 0
            for start, stop in stretches:
                n += stop - start
                here = stop - start
                for x, x_at, rows, n_x in groups:
                    at = start + x_at
                    g[rows] += lag_products(x, e, at, start, here, n_x, 1)[:, 0]
                    sums[rows] += lag_products(x, self.ones, at, 0, here, n_x, 1)[:, 0]
                    for z, z_at, columns, n_z in groups:
                        if columns.start >= rows.start:
                            H[rows, columns] += lag_products(
                                x, z, at, start + z_at, here, n_x, n_z
                            )
            H -= np.outer(sums, sums) / n
        H[na:, :na] = H[:na, na:].T
        return H, g


def simulation_error(stretches: Sequence[Stretch], model: Dynamics) -> float:
    """Return the rms of the free-run error, an offset taken out of each stretch."""
    return float(np.sqrt(_Problem(stretches, model.a.size, model.b.size).loss(model)[0]))


def output_error(
    stretches: Sequence[Stretch],
    start: Dynamics,
    maxiter: int = 30,
    tol: float = 1e-7,
    tick: Callable[[], None] | None = None,
) -> OutputErrorFit:
    """
    Refine dynamics by free-run simulation error.

    Parameters
    ----------
    stretches : sequence of Stretch
    start : Dynamics
        Stable start; its orders are kept.
    maxiter : int, optional
    tol : float, optional
        Stop when the loss falls by less than this share.
    tick : callable, optional
        Called once an iteration; may raise to stop the work.

    Returns
    -------
    OutputErrorFit
        Always stable; the start itself when nothing better was found.
    """
    na, nb = start.a.size, start.b.size
    problem = _Problem(stretches, na, nb)
    model = start
    loss, offsets = problem.loss(model)
    first_loss = loss
    damping, iterations = 1e-3, 0
    H, g = problem.normal(model)
    while iterations < maxiter:
        iterations += 1
        if tick is not None:
            tick()
        diagonal = np.sqrt(np.maximum(np.diag(H), np.finfo(float).tiny))
        scaled = H / np.outer(diagonal, diagonal)
        accepted = False
        while damping < 1e8:
            step = np.linalg.solve(scaled + damping * np.eye(na + nb), g / diagonal) / diagonal
            trial = Dynamics(a=model.a + step[:na], b=model.b + step[na:])
            if trial.radius < RADIUS:
                new, new_offsets = problem.loss(trial)
                if new < loss:
                    accepted = True
                    break
            damping *= 4.0
        if not accepted:
            break
        fall = 1.0 - new / loss
        model, loss, offsets = trial, new, new_offsets
        damping = max(damping / 10.0, 1e-12)
        if fall < tol or loss == 0.0:
            break
        H, g = problem.normal(model)
    H, _ = problem.normal(model)
    covariance = np.asarray(
        loss / problem.n * np.linalg.pinv(H / problem.n, 1e-14, hermitian=True)
    )
    rms = float(np.sqrt(loss))
    return OutputErrorFit(model, covariance, rms, offsets, iterations, loss < first_loss)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit ARX models of every order from one factorisation, and refine them by instruments.

    y(k) = - sum_{i=1..na} a_i y(k-i) + sum_{j=1..nb} b_j u(k-d-j+1) + e(k)             (eqs. 4-5)

The data matrix of the largest order is reduced once to its triangular factor R of a few dozen
rows.  A smaller order or another delay is a choice of columns of R:

        [ y(k-1) .. y(k-na_max) | u(k) .. u(k-d_max-nb_max+1) | y(k) ]   =   Q R
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.solvers.least_squares import ROWS, triangular_factor
from piezo_ident.identification.solvers.output_error import lag_products
from piezo_ident.operators.dynamics import Dynamics, filter_arx
from scipy.linalg import solve_triangular

#: a column counts as independent if it keeps more than this share of its length once the columns
#: before it are projected out
INDEPENDENT = 1e-10
#: largest radius of a pole that was mirrored into the unit circle
RADIUS = 0.9995
#: number of refinements by instrumental variables
REFINEMENTS = 3


@dataclass(frozen=True, eq=False)
class ArxFactor:
    """
    Triangular factor R of the ARX data matrix, which has n rows and the columns drawn above.

    `na_max` is the number of lags of the output.
    """

    R: Array
    n: int
    na_max: int

    def _columns(self, na: int, nb: int, d: int) -> tuple[Array, Array]:
        # columns of the order, and their lengths
        A = self.R[:, [*range(na), *range(self.na_max + d, self.na_max + d + nb)]]
        scale = np.linalg.norm(A, axis=0)
        scale[scale == 0.0] = 1.0
        return A, scale

    def fit(self, na: int, nb: int, d: int) -> tuple[Array, float]:
        """Solve one order for a_1 .. a_na, b_1 .. b_nb, with the mean square one-step error."""
        (A, scale), y = self._columns(na, nb, d), self.R[:, -1]
        x = np.linalg.lstsq(A / scale, y, rcond=1e-13)[0] / scale
        loss = float(np.sum((y - A @ x) ** 2)) / self.n
        theta = x.copy()
        theta[:na] *= -1.0
        return theta, loss

    def losses(self, order: int, delays: int) -> Array:
        """Compute the one-step loss of na = nb = `order` for the first `delays` delays."""
        return np.array([self.fit(order, order, d)[1] for d in range(delays)])

    def dynamics(self, na: int, nb: int, d: int) -> Dynamics:
        """Fit one order by least squares; the dynamics may be unstable."""
        theta, _ = self.fit(na, nb, d)
        return Dynamics(a=theta[:na], b=theta[na:])

    def fits(self, na: int, nb_max: int, d: int) -> list[tuple[Array, float]]:
        """
        Solve the orders (na, 1) .. (na, nb_max) from one more factorisation.

        Each result equals the result of `fit`, which is called instead if the data cannot tell
        the columns apart.
        """
        A, scale = self._columns(na, nb_max, d)
        both = np.column_stack([A / scale, self.R[:, -1]])
        R = np.asarray(np.linalg.qr(both, mode='r'))
        left = np.square(R[:, -1])
        size = np.abs(np.diag(R))
        fits = []
        for p in range(na + 1, na + nb_max + 1):
            if size[:p].min() < INDEPENDENT:
                fits.append(self.fit(na, p - na, d))
                continue
            theta = solve_triangular(R[:p, :p], R[:p, -1], check_finite=False) / scale[:p]
            theta[:na] *= -1.0
            fits.append((theta, float(np.sum(left[p:])) / self.n))
        return fits


def arx_factor(u: Array, y: Array, na_max: int, n_lags: int) -> ArxFactor:
    """
    Reduce input and output to the triangular factor of their lags.

    u and y, shape (n,), have no mean.  The lags are 1 .. na_max of y and 0 .. n_lags - 1 of u.
    Raises IdentificationError if the samples are fewer than twice the columns.
    """
    first = max(na_max, n_lags - 1)
    n = y.size - first
    p = na_max + n_lags + 1
    if n < 2 * p:
        raise IdentificationError(
            f'{y.size} samples are too few for {na_max} + {n_lags} lags; measure longer'
        )
    windows_y = np.lib.stride_tricks.sliding_window_view(y, na_max + 1)
    windows_u = np.lib.stride_tricks.sliding_window_view(u, n_lags)

    def rows() -> Iterator[Array]:
        for start in range(first, y.size, ROWS):
            stop = min(start + ROWS, y.size)
            past_y = windows_y[start - na_max : stop - na_max, ::-1]
            past_u = windows_u[start - n_lags + 1 : stop - n_lags + 1, ::-1]
            yield np.hstack([past_y[:, 1:], past_u, past_y[:, :1]])

    R = triangular_factor(rows(), p)
    return ArxFactor(R, n, na_max)


def factor_of(parts: Sequence[tuple[Array, Array]], na_max: int, n_lags: int) -> ArxFactor:
    """Reduce several stretches of input and output, each long enough, to one triangular factor."""
    factors = [arx_factor(u, y, na_max, n_lags) for u, y in parts]
    R = triangular_factor([factor.R for factor in factors], na_max + n_lags + 1)
    return ArxFactor(R, sum(factor.n for factor in factors), na_max)


def delayed(u: Array, d: int) -> Array:
    """Delay a signal by whole samples, with zeros first; shape (n,)."""
    return np.concatenate([np.zeros(d), u[: u.size - d]])


def free_run_error(model: Dynamics, d: int, u: Array, y: Array, first: int | None = None) -> float:
    """
    Compute the rms free-run error around its mean; infinite for an unstable model.

    Samples before `first` (a fifth of them by default) are left to the transient.
    """
    if not model.is_stable:
        return float('inf')
    e = y - filter_arx(model.a, model.b, delayed(u, d), at_rest=False)
    return float(e[y.size // 5 if first is None else first :].std())


@dataclass(frozen=True, eq=False)
class OrderTable:
    """
    Table of all orders; arrays have shape (na_max, nb_max) with entry [na-1, nb-1].

    `loss` is the one-step loss on the fitted samples; `aic` and `bic` are the criteria of Akaike
    and of Schwarz.  `held_out` is the free-run rms error on the held-out samples, infinite for an
    unstable model.
    """

    loss: Array
    aic: Array
    bic: Array
    held_out: Array

    def best(self, criterion: str) -> tuple[int, int]:
        """Give (na, nb) of the smallest ``aic``, ``bic`` or ``held_out``."""
        table = getattr(self, criterion)
        i, j = np.unravel_index(int(np.argmin(table)), table.shape)
        return int(i) + 1, int(j) + 1

    def ranked(self, slack: float = 0.0) -> list[tuple[int, int]]:
        """
        Sort the stable orders by held-out error, then by size.

        Errors within the same step of `slack`, relative to the best, count as equal.
        """
        order = []
        best = float(self.held_out.min())
        for i, j in np.ndindex(self.held_out.shape):
            error = float(self.held_out[i, j])
            if np.isfinite(error):
                excess = error / best - 1.0 if best > 0.0 else 0.0
                step = int(excess / slack) if slack > 0.0 else excess
                order.append((step, i + j + 2, error, (i + 1, j + 1)))
        return [orders for *_, orders in sorted(order)]


def scan_orders(
    factor: ArxFactor,
    d: int,
    nb_max: int,
    u_held: Array,
    y_held: Array,
    tick: Callable[[float], None] = lambda share: None,
) -> OrderTable:
    """
    Fit all orders up to (na_max, nb_max), and judge each by its free run on held-out data.

    The factor holds the fitted data, `u_held` and `y_held` the other data; d is the delay
    [samples].  `tick` is called with the share of the work done, and may raise to stop it.
    """
    shape = (factor.na_max, nb_max)
    loss, held = np.full(shape, np.inf), np.full(shape, np.inf)
    size = np.add.outer(np.arange(1, shape[0] + 1), np.arange(1, shape[1] + 1))
    for na in range(1, shape[0] + 1):
        for nb, (theta, one_step) in enumerate(factor.fits(na, nb_max, d), 1):
            loss[na - 1, nb - 1] = one_step
            model = Dynamics(a=theta[:na], b=theta[na:])
            held[na - 1, nb - 1] = free_run_error(model, d, u_held, y_held)
        tick(na / shape[0])
    log_loss = factor.n * np.log(np.maximum(loss, np.finfo(float).tiny))
    return OrderTable(
        loss=loss, aic=log_loss + 2.0 * size, bic=log_loss + np.log(factor.n) * size, held_out=held
    )


def stabilised(dynamics: Dynamics) -> Dynamics:
    """Mirror poles outside the unit circle into it, and keep the static gain."""
    poles = dynamics.poles
    if poles.size == 0 or np.abs(poles).max() < 1.0:
        return dynamics
    outside = np.abs(poles) >= 1.0
    poles[outside] = 1.0 / np.conj(poles[outside])
    size = np.abs(poles)
    poles = np.where(size > RADIUS, poles * RADIUS / np.maximum(size, RADIUS), poles)
    a = np.real(np.poly(poles))[1:]
    gain = dynamics.gain
    b = dynamics.b
    if np.isfinite(gain) and b.sum() != 0.0:
        b = b * (gain * (1.0 + a.sum()) / b.sum())
    return Dynamics(a=a, b=b)


_Lags = tuple[Array, int, float, int]


def _inner(one: _Lags, other: _Lags, n: int) -> Array:
    """Sum the products of two groups of lags, each (signal, first row, sign, number of lags)."""
    (x, x_at, x_sign, n_x), (z, z_at, z_sign, n_z) = one, other
    return x_sign * z_sign * lag_products(x, z, x_at, z_at, n, n_x, n_z)


def instrumental_variables(u: Array, y: Array, start: Dynamics, d: int) -> Dynamics:
    """
    Refine an ARX model by instrumental variables.

    The instruments are the lags of the input and of the simulated output.  Data and instruments
    are filtered by 1/A of the previous model.  This removes the bias that output noise gives to
    least squares.  After Ljung, System Identification, 2nd ed. (1999), section 7.6.

    u and y, shape (n,), have no mean; d is the delay [samples].  The start is made stable first.
    The result may be unstable: the caller judges.
    """
    na, nb = start.a.size, start.b.size
    model, u, one = stabilised(start), delayed(u, d), np.ones(1)
    at = max(na, nb)
    n = u.size - at
    for _ in range(REFINEMENTS):
        simulated = filter_arx(model.a, model.b, u, at_rest=False)
        yf, uf, sf = (filter_arx(model.a, one, x, at_rest=False) for x in (y, u, simulated))
        u_lags = (uf, at, 1.0, nb)
        z, phi = ((sf, at - 1, -1.0, na), u_lags), ((yf, at - 1, -1.0, na), u_lags)
        A = np.block([[_inner(x, other, n) for other in phi] for x in z])
        right = np.concatenate([_inner(x, (yf, at, 1.0, 1), n) for x in z])[:, 0]
        size = np.sqrt(np.concatenate([np.diag(_inner(x, x, n)) for x in z]))
        size[size == 0.0] = 1.0
        theta = np.linalg.lstsq(A / size[:, None], right / size, rcond=None)[0].astype(float)
        candidate = Dynamics(a=theta[:na], b=theta[na:])
        if not candidate.is_stable:
            return candidate
        model = candidate
    return model

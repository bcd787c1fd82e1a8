# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Compute the steps of a joint fit: normal equations and damping.

The steps are Gauss-Newton steps with the damping of Levenberg and Marquardt.  The damping follows
the ratio of the actual gain of a step to its predicted gain: D. W. Marquardt, J. Soc. Indust.
Appl. Math. 11(2), 1963, pp. 431-441, doi:10.1137/0111030.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.diagnosis.cross_validation import block_products, Pull
from piezo_ident.diagnosis.rows import centred, Rows
from piezo_ident.fitting.equations import bounded_step

#: factor of the damping after a failed step; its k-th power after the k-th failure in a row
WORSE = 3.0
#: ratios of actual to predicted gain: above the first the damping falls, below the second it grows
KEPT = (0.75, 0.25)
#: accepted range of the factor of H; a factor outside of it has another cause
SCALES = (0.2, 5.0)
#: smallest share of the energy of H that additive columns must leave for the factor to be computed
SEEN = 0.01


@dataclass(frozen=True, eq=False)
class BaseColumns:
    """
    Columns of a refit of the base model, shape (n, size + records), and ``columns' columns``.

    The columns belong to the coefficients of H, filtered through G, and to the offset of each
    record.  `products` holds the products of each block, shape (blocks, p, p), and `total` their
    sum.
    """

    columns: Array
    products: Array
    total: Array

    @classmethod
    def of(cls, rows: Rows, columns: Array) -> BaseColumns:
        """Compute the products of columns."""
        products = block_products(rows, columns, columns)
        return cls(columns, products, products.sum(axis=0))


class Scale:
    """
    Ratio of H at the output of the chain to H as its columns predict it.

    Links behind H multiply H: creep, a gain, and parts that the columns omit.  A joint step of H
    and such a link contains a product.  Without this product a fit takes many small steps.  The
    columns `aside`, shape (n, k), only add to the signal, so they do not change the ratio.
    """

    def __init__(
        self, rows: Rows, base: BaseColumns, coefficients: Array, e: Array, aside: Array
    ) -> None:
        h = centred(base.columns[:, : coefficients.size] @ coefficients, rows.of_record)
        across = h
        if aside.shape[1]:
            C = np.array([centred(column, rows.of_record) for column in aside.T]).T
            across = h - C @ np.linalg.lstsq(C.T @ C, C.T @ h, rcond=None)[0]
        self._x = centred(rows.x - e, rows.of_record)
        self._across, self._size = across, float(across @ across)
        self._is_seen = self._size > SEEN * float(h @ h)

    def of(self, change: Array) -> float:
        """Return the ratio after a change of the rows, shape (n,)."""
        if not self._is_seen:
            return 1.0
        factor = float((self._x + change) @ self._across) / self._size
        return factor if SCALES[0] < factor < SCALES[1] else 1.0


class FitStep:
    """Normal equations of one step."""

    def __init__(
        self, base: BaseColumns, moving: Array, e: Array, prior: Array, pull: Pull | None = None
    ) -> None:
        mixed, own = _products(base.columns, moving, e)
        A = np.block([[base.total, mixed[:, :-1]], [mixed[:, :-1].T, own[:-1, :-1]]])
        b = np.concatenate([mixed[:, -1], own[:-1, -1]])
        if pull is not None:
            A, b = A + pull.A, b + pull.b
        self._A, self._b, self._prior = A, b, prior

    @property
    def is_finite(self) -> bool:
        """Whether all energies of the columns are finite numbers."""
        return bool(np.isfinite(np.diag(self._A)).all())

    def solve(self, lower: Array, upper: Array, damping: float = 0.0) -> Array:
        """Compute the bounded step; `damping` is a share of the energy of each column."""
        return bounded_step(self._A, self._b, lower, upper, prior=self._prior, damping=damping)

    def gain(self, delta: Array) -> float:
        """Predict the decrease of the sum of squares by a step of a linear model."""
        return float(delta @ (2.0 * self._b - self._A @ delta))


def _products(columns: Array, moving: Array, e: Array) -> tuple[Array, Array]:
    """Multiply ``[moving, e]`` by the columns and by itself."""

    def of(part: slice) -> tuple[Array, Array]:
        # one pass over the many columns saves time
        own = np.concatenate([moving[part].T, e[None, part]]).T
        with np.errstate(over='ignore', invalid='ignore'):
            return columns[part].T @ own, own.T @ own

    # two threads, as the command line and the nodes keep BLAS to one thread
    half = e.size // 2
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(of, (slice(half), slice(half, None)))
    return first[0] + second[0], first[1] + second[1]


def next_damping(kept: float) -> float:
    """Return the factor of the damping for a ratio of actual to predicted gain."""
    if kept > KEPT[0]:
        return 0.1
    return 1.0 if kept > KEPT[1] else WORSE

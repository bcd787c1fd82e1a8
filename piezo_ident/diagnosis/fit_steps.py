# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The steps of a joint fit: their equations and their damping.

Gauss-Newton steps with the damping of Levenberg and Marquardt, which follows how much of what a
step promised came true: D. W. Marquardt, J. Soc. Indust. Appl. Math. 11(2), 1963, pp. 431-441,
doi:10.1137/0111030.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.diagnosis.cross_validation import block_products, Pull
from piezo_ident.diagnosis.rows import centred, Rows
from piezo_ident.fitting.equations import bounded_step

#: factor of the damping after a step that failed; its square after the next one, and so on
WORSE = 3.0
#: shares of what a step promised: above the first damping falls, below the second it grows
KEPT = (0.75, 0.25)
#: factors of H beyond which something else is the matter
SCALES = (0.2, 5.0)
#: share of H that must not be like what only adds to it
SEEN = 0.01


@dataclass(frozen=True, eq=False)
class BaseColumns:
    """
    Columns of a refit of the base model, shape (n, size + records), and ``columns' columns``.

    They are those of the law of H behind G, and the offset of each record; the products are those
    of each block, shape (blocks, p, p), and of all.
    """

    columns: Array
    products: Array
    total: Array

    @classmethod
    def of(cls, rows: Rows, columns: Array) -> BaseColumns:
        """Return columns with their products."""
        products = block_products(rows, columns, columns)
        return cls(columns, products, products.sum(axis=0))


class Scale:
    """
    How much larger H comes out of the chain than its columns tell.

    What is behind H multiplies it: creep, a gain, and what the columns left out of both.  A step
    of both is no sum of the two, and without the product a fit takes many small steps.  What only
    adds to the signal, the columns `aside` of shape (n, k), is no scale.
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
        """Return the factor once the rows have changed, shape (n,)."""
        if not self._is_seen:
            return 1.0
        factor = float((self._x + change) @ self._across) / self._size
        return factor if SCALES[0] < factor < SCALES[1] else 1.0


class FitStep:
    """Normal equations of a step."""

    def __init__(
        self, base: BaseColumns, moving: Array, e: Array, prior: Array, pull: Pull | None = None
    ) -> None:
        mixed, own = _products(base.columns, moving, e)
        A = np.block([[base.total, mixed[:, :-1]], [mixed[:, :-1].T, own[:-1, :-1]]])
        b = np.concatenate([mixed[:, -1], own[:-1, -1]])
        if pull is not None:
            A, b = A + pull.A, b + pull.b
        self._A, self._b, self._prior = A, b, prior

    def solve(self, lower: Array, upper: Array, damping: float = 0.0) -> Array:
        """Return the bounded step; damping is a share of each column's own energy."""
        return bounded_step(self._A, self._b, lower, upper, prior=self._prior, damping=damping)

    def gain(self, delta: Array) -> float:
        """Return by how much a step lowers the sum of squares, were the model linear."""
        return float(delta @ (2.0 * self._b - self._A @ delta))


def _products(columns: Array, moving: Array, e: Array) -> tuple[Array, Array]:
    """Return the products of moving and e, side by side, with the columns and with themselves."""

    def of(part: slice) -> tuple[Array, Array]:
        # one pass over the many columns
        own = np.concatenate([moving[part].T, e[None, part]]).T
        return columns[part].T @ own, own.T @ own

    # the command line and the nodes keep BLAS to one thread
    half = e.size // 2
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(of, (slice(half), slice(half, None)))
    return first[0] + second[0], first[1] + second[1]


def next_damping(kept: float) -> float:
    """Return the factor of the damping after a step that kept a share of what it promised."""
    if kept > KEPT[0]:
        return 0.1
    return 1.0 if kept > KEPT[1] else WORSE

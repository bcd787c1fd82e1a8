# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Build the normal equations of blocks, cross-validate by them, and solve for the steps of a fit.

`piezo_ident.fitting.equations` describes normal equations and their sets of blocks.  The steps are
Gauss-Newton steps with the damping of Levenberg and Marquardt.  The damping follows the ratio of
the actual gain of a step to its predicted gain: D. W. Marquardt, J. Soc. Indust. Appl. Math.
11(2), 1963, pp. 431-441, doi:10.1137/0111030.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.common.errors import IdentificationError
from piezo_ident.diagnosis.rows import centred, Rows
from piezo_ident.fitting.equations import bounded_step, NormalEquations

#: share of a column's own energy that is added to the diagonal: it keeps collinear columns small
RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class Pull:
    """Normal equations of a prior or the given H, (p, p) and (p,), and its sum of squares."""

    A: Array
    b: Array
    s: float

    def only(self, chosen: Mask) -> Pull:
        """Select some columns by a mask of shape (p,)."""
        return Pull(self.A[np.ix_(chosen, chosen)], self.b[chosen], self.s)


def block_products(rows: Rows, M: Array, N: Array) -> Array:
    """Compute ``M_k' N_k`` of every block; shape (blocks, p, q)."""
    found = np.empty((rows.edges.size - 1, M.shape[1], N.shape[1]))
    for out, (a, b) in zip(found, itertools.pairwise(rows.edges), strict=True):
        np.matmul(M[a:b].T, N[a:b], out=out)
    return found


def normal_equations(rows: Rows, M: Array, E: Array) -> NormalEquations:
    """Compute the normal equations of columns M, shape (n, p), and residuals E, shape (n, k)."""
    return NormalEquations(block_products(rows, M, M), *right_sides(rows, M, E))


def right_sides(rows: Rows, M: Array, E: Array) -> tuple[Array, Array]:
    """Compute b and s of the normal equations of columns M and residuals E."""
    return block_products(rows, M, E), np.add.reduceat(E**2, rows.edges[:-1])


def with_columns(
    rows: Rows, equations: NormalEquations, M: Array, C: Array, E: Array
) -> NormalEquations:
    """Extend the normal equations of M to ``[M C]``."""
    right = block_products(rows, M, C)
    lower = block_products(rows, C, C)
    A = np.concatenate(
        [
            np.concatenate([equations.A, right], axis=2),
            np.concatenate([right.transpose(0, 2, 1), lower], axis=2),
        ],
        axis=1,
    )
    b = np.concatenate([equations.b, block_products(rows, C, E)], axis=1)
    return NormalEquations(A, b, equations.s)


def solve(A: Array, b: Array, prior: Array) -> Array:
    """
    Solve a ridge regression for its coefficients; b has shape (p,) or (p, k).

    The diagonal grows by the prior, shape (p,), and by `RIDGE` times the energy of each column.
    Singular equations raise IdentificationError.
    """
    # a column may be nonzero in one set alone; rounding then leaves a slightly negative energy
    size = np.sqrt(np.maximum(np.diag(A), 0.0))
    size = np.where(size > 0.0, size, 1.0)
    scaled = A / np.outer(size, size)
    scaled[np.diag_indices_from(scaled)] += RIDGE + prior / size**2
    # columns without energy get the coefficient 0
    scaled[np.diag_indices_from(scaled)] += np.where(np.diag(A) > 0.0, 0.0, 1.0)
    right = b.T / size
    try:
        return np.asarray((np.linalg.solve(scaled, right.T).T / size).T)
    except np.linalg.LinAlgError:
        raise IdentificationError(
            'the equations of the joint fit are singular: its parameters do not follow from '
            'these data; give a longer record, or fewer candidates'
        ) from None


def summed(equations: NormalEquations, pull: Pull | None) -> tuple[Array, Array]:
    """Sum the normal equations of all blocks and of a pull."""
    A, b = equations.A.sum(axis=0), equations.b.sum(axis=0)
    return (A, b) if pull is None else (A + pull.A, b + pull.b[:, None])


def _held_out(
    equations: NormalEquations, sets: Integers, prior: Array, pull: Pull | None
) -> Iterator[tuple[Mask, Array]]:
    return equations.solved_without(sets, *summed(equations, pull), partial(solve, prior=prior))


def held_out_errors(
    equations: NormalEquations, sets: Integers, prior: Array, pull: Pull | None = None
) -> Array:
    """
    Compute the squared error of every block, predicted from other sets; shape (blocks, k).

    Blocks with the same number in `sets`, shape (blocks,), are left out together.
    """
    return np.maximum(equations.errors(_held_out(equations, sets, prior, pull)), 0.0)


def held_out_residual(
    rows: Rows, M: Array, e: Array, prior: Array, sets: Integers, pull: Pull | None = None
) -> Array:
    """
    Compute the residual of every row, predicted with parameters fitted to other blocks.

    M holds the derivatives of the prediction, and e is the residual of the fit to all rows.  Near
    the optimum one Gauss-Newton step gives the parameters of a fit without a set of blocks.
    """
    left = e.copy()
    for out, theta in _held_out(normal_equations(rows, M, e[:, None]), sets, prior, pull):
        here = out[rows.block]
        left[here] -= (M @ theta[:, 0])[here]
    return left


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
    Columns of a refit of H and of the offsets, shape (n, size + records), and their products.

    `products` holds the products of each block, shape (blocks, p, p), and `total` their sum.
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

    Creep, a gain, and parts that the columns omit multiply H.  A joint step of H and such a link
    contains a product, and a fit without this product takes many small steps.  The columns
    `aside`, shape (n, k), only add to the signal, so they do not change the ratio.
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
        self.is_finite = bool(np.isfinite(np.diag(A)).all())

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

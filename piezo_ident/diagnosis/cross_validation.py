# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Cross-validation of a linear model over blocks, from its normal equations.

With ``A_k = M_k' M_k``, ``b_k = M_k' e_k`` and ``s_k = e_k' e_k`` of every block k, a set of
blocks is left out by a subtraction, and its error needs no sample again:

    theta = (sum_train A + D)^-1 sum_train b,     E_k = s_k - 2 b_k' theta + theta' A_k theta.
"""

from __future__ import annotations

from dataclasses import dataclass
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.common.errors import IdentificationError
from piezo_ident.diagnosis.rows import Rows

#: share of a column's own energy that is added to the diagonal: keeps collinear columns small
RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """
    Normal equations of columns M and one residual or several, block by block.

    A, b and s have shapes (blocks, p, p), (blocks, p, k) and (blocks, k).
    """

    A: Array
    b: Array
    s: Array

    def only(self, chosen: Mask | Integers) -> NormalEquations:
        """Return those of some columns; a mask of shape (p,), or their places."""
        return NormalEquations(self.A[:, chosen][:, :, chosen], self.b[:, chosen], self.s)


@dataclass(frozen=True, eq=False)
class Pull:
    """
    Normal equations of what is known besides the blocks; s is the sum of squares as it is.

    A and b have shapes (p, p) and (p,).
    """

    A: Array
    b: Array
    s: float

    def only(self, chosen: Mask) -> Pull:
        """Return those of some columns; shape (p,)."""
        return Pull(self.A[np.ix_(chosen, chosen)], self.b[chosen], self.s)


def block_products(rows: Rows, M: Array, N: Array) -> Array:
    """Return ``M_k' N_k`` of every block; shape (blocks, p, q)."""
    return np.stack([M[a:b].T @ N[a:b] for a, b in itertools.pairwise(rows.edges)])


def normal_equations(rows: Rows, M: Array, E: Array) -> NormalEquations:
    """Return the normal equations of columns M, shape (n, p), and residuals E, shape (n, k)."""
    return NormalEquations(block_products(rows, M, M), *right_sides(rows, M, E))


def right_sides(rows: Rows, M: Array, E: Array) -> tuple[Array, Array]:
    """Return b and s of normal equations, of columns M and residuals E."""
    return block_products(rows, M, E), np.add.reduceat(E**2, rows.edges[:-1])


def with_columns(
    rows: Rows, equations: NormalEquations, M: Array, C: Array, E: Array
) -> NormalEquations:
    """Return the normal equations of ``[M C]`` from those of M."""
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
    Return the coefficients of a ridge regression; b has shape (p,) or (p, k).

    The prior, shape (p,), is added to the diagonal, besides `RIDGE` of the column's own energy.
    Singular equations raise IdentificationError.
    """
    # of a column that a set holds alone, rounding leaves less than nothing
    size = np.sqrt(np.maximum(np.diag(A), 0.0))
    size = np.where(size > 0.0, size, 1.0)
    scaled = A / np.outer(size, size)
    scaled[np.diag_indices_from(scaled)] += RIDGE + prior / size**2
    # columns without any energy stay out
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
    """Return the normal equations of all blocks, and of a pull."""
    A, b = equations.A.sum(axis=0), equations.b.sum(axis=0)
    return (A, b) if pull is None else (A + pull.A, b + pull.b[:, None])


def held_out_errors(
    equations: NormalEquations, sets: Integers, prior: Array, pull: Pull | None = None
) -> Array:
    """
    Return the squares of every block, each predicted from other sets; shape (blocks, k).

    Blocks of one number in `sets`, shape (blocks,), are left out together; prior as in `solve`.
    The pull never is.
    """
    A, b = summed(equations, pull)
    errors = equations.s.copy()
    for one in np.unique(sets):
        out = sets == one
        if not out.all():
            A_out, b_out = equations.A[out], equations.b[out]
            theta = solve(A - A_out.sum(axis=0), b - b_out.sum(axis=0), prior)
            errors[out] += np.sum(theta * (A_out @ theta - 2.0 * b_out), axis=1)
    return np.maximum(errors, 0.0)


def held_out_residual(
    rows: Rows, M: Array, e: Array, prior: Array, sets: Integers, pull: Pull | None = None
) -> Array:
    """
    Return the residual of every row, predicted with parameters fitted to other blocks.

    M are the derivatives of the prediction and e is the residual of the fit to all rows; blocks of
    one number in `sets`, shape (blocks,), are left out together.  Near the
    optimum the model is linear in its parameters, so leaving a set of blocks out moves them by one
    Gauss-Newton step.
    """
    equations = normal_equations(rows, M, e[:, None])
    A, b = summed(equations, pull)
    left = e.copy()
    for one in np.unique(sets):
        out = sets == one
        if out.all():
            continue
        theta = solve(A - equations.A[out].sum(axis=0), b - equations.b[out].sum(axis=0), prior)
        here = out[rows.block]
        left[here] -= (M @ theta[:, 0])[here]
    return left

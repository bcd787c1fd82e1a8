# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Cross-validate a linear model over blocks by its normal equations.

Each block k has ``A_k = M_k' M_k``, ``b_k = M_k' e_k`` and ``s_k = e_k' e_k``.  A set of blocks is
left out by a subtraction, and its error follows without the samples:

    theta = (sum_train A + D)^-1 sum_train b,     E_k = s_k - 2 b_k' theta + theta' A_k theta.
"""

from __future__ import annotations

from dataclasses import dataclass
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.common.errors import IdentificationError
from piezo_ident.diagnosis.rows import Rows

#: share of a column's own energy that is added to the diagonal: it keeps collinear columns small
RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """
    Normal equations of columns M and one or several residuals, block by block.

    A, b and s have shapes (blocks, p, p), (blocks, p, k) and (blocks, k).
    """

    A: Array
    b: Array
    s: Array

    def only(self, chosen: Mask | Integers) -> NormalEquations:
        """Select some columns by a mask of shape (p,), or by their places."""
        return NormalEquations(self.A[:, chosen][:, :, chosen], self.b[:, chosen], self.s)


@dataclass(frozen=True, eq=False)
class Pull:
    """
    Normal equations of information besides the blocks.

    A and b have shapes (p, p) and (p,).  s is the present sum of squares.
    """

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

    The diagonal grows by the prior, shape (p,), and by `RIDGE` times each column's own energy.
    Singular equations raise IdentificationError.
    """
    # a column may live in one set alone; rounding then leaves a slightly negative energy
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


def held_out_errors(
    equations: NormalEquations, sets: Integers, prior: Array, pull: Pull | None = None
) -> Array:
    """
    Compute the squared error of every block, predicted from other sets; shape (blocks, k).

    Blocks with the same number in `sets`, shape (blocks,), are left out together.  The prior is
    that in `solve`.  The pull always counts.
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
    Compute the residual of every row, predicted with parameters fitted to other blocks.

    M holds the derivatives of the prediction, and e is the residual of the fit to all rows.
    Blocks with the same number in `sets`, shape (blocks,), are left out together.  Near the
    optimum the model is linear in its parameters.  Without a set of blocks, the parameters
    therefore move by one Gauss-Newton step.
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

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What columns would gain on data that were not fitted, from their Gram matrices a block.

With ``A_k = M_k' M_k``, ``b_k = M_k' e_k`` and ``s_k = e_k' e_k`` of every block k, leaving
out any set of blocks is a subtraction, and the error on what was left out needs no sample again:

    theta = (sum_train A + D)^-1 sum_train b,     E_k = s_k - 2 b_k' theta + theta' A_k theta.
"""

from __future__ import annotations

from dataclasses import dataclass
import itertools

import numpy as np
from numpy.typing import NDArray
from piezo_ident.diagnosis.rows import Rows

__all__ = [
    'Gram',
    'block_products',
    'chance_errors',
    'gram_of',
    'held_out_errors',
    'joined',
    'solve',
]

#: share of a column's own energy that is added to the diagonal: keeps collinear columns quiet
RIDGE = 1e-9


@dataclass(frozen=True, eq=False)
class Gram:
    """
    Products of columns M and a residual e, block by block.

    Attributes
    ----------
    A : ndarray, shape (blocks, p, p)
    b : ndarray, shape (blocks, p)
    s : ndarray, shape (blocks,)
    n : ndarray, shape (blocks,)
        Rows of each block.
    """

    A: NDArray[np.float64]
    b: NDArray[np.float64]
    s: NDArray[np.float64]
    n: NDArray[np.int64]


def block_products(
    rows: Rows, M: NDArray[np.float64], N: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return ``M_k' N_k`` of every block; shape (blocks, p, q)."""
    edges = rows.edges
    out = np.empty((edges.size - 1, M.shape[1], N.shape[1]))
    for k, (start, stop) in enumerate(itertools.pairwise(edges)):
        out[k] = M[start:stop].T @ N[start:stop]
    return out


def gram_of(rows: Rows, M: NDArray[np.float64], e: NDArray[np.float64]) -> Gram:
    """Return the products of columns and a residual."""
    column = e[:, None]
    return Gram(
        A=block_products(rows, M, M),
        b=block_products(rows, M, column)[:, :, 0],
        s=block_products(rows, column, column)[:, 0, 0],
        n=np.diff(rows.edges),
    )


def joined(
    rows: Rows, gram: Gram, M: NDArray[np.float64], C: NDArray[np.float64], e: NDArray[np.float64]
) -> Gram:
    """
    Return the products of ``[M C]`` from those of M.

    Parameters
    ----------
    rows : Rows
    gram : Gram
        Of M and e.
    M, C : ndarray, shape (n, p) and (n, c)
    e : ndarray, shape (n,)
    """
    right = block_products(rows, M, C)
    lower = block_products(rows, C, np.column_stack([C, e]))
    c = C.shape[1]
    A = np.concatenate(
        [
            np.concatenate([gram.A, right], axis=2),
            np.concatenate([right.transpose(0, 2, 1), lower[:, :, :c]], axis=2),
        ],
        axis=1,
    )
    return Gram(A, np.concatenate([gram.b, lower[:, :, c]], axis=1), gram.s, gram.n)


def solve(
    A: NDArray[np.float64], b: NDArray[np.float64], prior: NDArray[np.float64]
) -> NDArray[np.float64]:
    """
    Return the coefficients of a ridge regression.

    Parameters
    ----------
    A : ndarray, shape (p, p)
    b : ndarray, shape (p,) or (p, k)
    prior : ndarray, shape (p,)
        What is added to the diagonal, besides a trace of the columns' own size.
    """
    size = np.sqrt(np.diag(A))
    size = np.where(size > 0.0, size, 1.0)
    scaled = A / np.outer(size, size)
    scaled[np.diag_indices_from(scaled)] += RIDGE + prior / size**2
    # columns without any energy stay out
    scaled[np.diag_indices_from(scaled)] += np.where(np.diag(A) > 0.0, 0.0, 1.0)
    right = b.T / size
    return np.asarray((np.linalg.solve(scaled, right.T).T / size).T)


def held_out_errors(
    gram: Gram, sets: NDArray[np.int64], prior: NDArray[np.float64]
) -> NDArray[np.float64]:
    """
    Return the sum of squares of every block, each predicted from the blocks of other sets.

    Parameters
    ----------
    gram : Gram
    sets : ndarray of int, shape (blocks,)
        Blocks of one set are left out together.
    prior : ndarray, shape (p,)
        As in `solve`.

    Returns
    -------
    ndarray, shape (blocks,)
    """
    A, b = gram.A.sum(axis=0), gram.b.sum(axis=0)
    errors = np.empty(gram.s.size)
    for one in np.unique(sets):
        out = sets == one
        here = gram.A[out]
        theta = np.zeros(b.size)
        if not out.all():
            theta = solve(A - here.sum(axis=0), b - gram.b[out].sum(axis=0), prior)
        errors[out] = gram.s[out] - 2.0 * gram.b[out] @ theta + (here @ theta) @ theta
    return np.maximum(errors, 0.0)


def chance_errors(
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    s: NDArray[np.float64],
    sets: NDArray[np.int64],
    prior: NDArray[np.float64],
) -> NDArray[np.float64]:
    """
    Return the sum of the held-out squares of many residuals at once.

    Parameters
    ----------
    A : ndarray, shape (blocks, p, p)
    b : ndarray, shape (blocks, p, k)
        Products of the columns with k residuals.
    s : ndarray, shape (k,)
        Their sums of squares.
    sets, prior
        As in `held_out_errors`.

    Returns
    -------
    ndarray, shape (k,)
    """
    total_A, total_b = A.sum(axis=0), b.sum(axis=0)
    errors = s.copy()
    for one in np.unique(sets):
        out = sets == one
        A_out, b_out = A[out].sum(axis=0), b[out].sum(axis=0)
        if out.all():
            continue
        theta = solve(total_A - A_out, total_b - b_out, prior)
        errors += np.sum(theta * (A_out @ theta - 2.0 * b_out), axis=0)
    return np.asarray(errors)

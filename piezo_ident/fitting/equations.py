# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Normal equations of a linearised fit, block by block.

With the columns M_k, the residual e_k of every block k, and the weights W_k of its rows,

    A_k = M_k' W_k M_k,      b_k = M_k' W_k e_k,      s_k = e_k' W_k e_k.

A set of blocks is left out by a subtraction, and its error needs no sample again:

    theta = (sum_train A + D)^-1 sum_train b,      E_k = s_k - 2 b_k' theta + theta' A_k theta.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.common.errors import IdentificationError
from scipy.optimize import lsq_linear

#: share of the energy of a column that is added to the diagonal, so that rounding cannot make it
#: negative: single precision of the products of double precision numbers
RIDGE = 1e-10


@dataclass(frozen=True, eq=False)
class Equations:
    """
    Normal equations of p parameters in n_b blocks.

    A, b and s have shapes (n_b, p, p), (n_b, p) and (n_b,); `rows` counts the rows of each block.
    """

    A: Array
    b: Array
    s: Array
    rows: Integers

    def held_out(self, sets: Integers, prior: Array, lower: Array, upper: Array) -> Array:
        """
        Return the sum of squares of every block, predicted from the other sets; shape (n_b,).

        Blocks of one number in `sets`, shape (n_b,), are left out together, those of -1 never.
        The prior, shape (p, p), is what is known of the step before; bounds are those of the step.
        """
        A, b = self.A.sum(axis=0) + prior, self.b.sum(axis=0)
        errors = self.s.copy()
        for one in np.unique(sets[sets >= 0]):
            out = sets == one
            if out.all():
                continue
            A_out, b_out = self.A[out], self.b[out]
            theta = bounded_step(A - A_out.sum(axis=0), b - b_out.sum(axis=0), lower, upper)
            errors[out] += np.sum(theta * (A_out @ theta - 2.0 * b_out), axis=1)
        # far from its minimum a fit promises by its derivatives what it does not keep
        return np.asarray(np.maximum(errors, self.s))


def bounded_step(
    A: Array,
    b: Array,
    lower: Array,
    upper: Array,
    *,
    prior: Array | float = 0.0,
    damping: float = 0.0,
) -> Array:
    """
    Return the step that minimises ``x'A x - 2 b'x + x' diag(prior) x`` inside bounds; shape (p,).

    `damping` is a share of the energy of each column.  Equations that are no numbers raise
    IdentificationError.

    Examples
    --------
    >>> inside = bounded_step(np.eye(2), np.array([1.0, -1.0]), np.zeros(2), np.full(2, np.inf))
    >>> np.round(inside, 6) + 0.0
    array([1., 0.])
    """
    energy = np.diag(A)
    size = np.sqrt(np.where(energy > 0.0, energy, 1.0))
    scaled = A / np.outer(size, size)
    # a column of zeros stays where it is
    more = RIDGE + damping + np.where(energy > 0.0, 0.0, 1.0) + prior / size**2
    scaled[np.diag_indices_from(scaled)] += more
    wide = upper > lower
    x = np.zeros(size.size)
    try:
        L = np.linalg.cholesky(scaled)
        target = np.linalg.solve(L, b / size)
        bounds = ((lower * size)[wide], (upper * size)[wide])
        with np.errstate(divide='ignore', invalid='ignore'):
            x[wide] = lsq_linear(L.T[:, wide], target, bounds, method='bvls').x
        if not np.isfinite(x).all():
            # an active set that is a rounding error away from its bound divides by zero
            x[wide] = lsq_linear(L.T[:, wide], target, bounds, method='trf').x
    except (np.linalg.LinAlgError, ValueError) as error:
        raise IdentificationError(
            f'the free-run fit is singular ({error}): its parameters do not follow from these '
            'data; record a longer motion over the whole range'
        ) from None
    return np.asarray(np.clip(x / size, lower, upper))

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Build and solve the normal equations of a linearised fit, block by block.

For the columns M_k, the residual e_k and the row weights W_k of every block k they are

    A_k = M_k' W_k M_k,      b_k = M_k' W_k e_k,      s_k = e_k' W_k e_k.

A set of blocks is left out by a subtraction, and its error needs no samples:

    theta = (sum_train A + D)^-1 sum_train b,      E_k = s_k - 2 b_k' theta + theta' A_k theta.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.common.errors import IdentificationError
from scipy.optimize import lsq_linear, nnls

#: share of the energy of a column that is added to the diagonal.  Products square the condition of
#: the columns, and rounding could make a pivot negative
RIDGE = 1e-10
#: largest violation of a row, a rounding error of slopes of about one, and most rows in one step
UNDERCUT, CUTS = 1e-7, 40


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """
    Normal equations of p parameters in n_b blocks.

    A, b and s have shapes (n_b, p, p), (n_b, p) and (n_b,).  The b and s of k residuals have
    shapes (n_b, p, k) and (n_b, k).
    """

    A: Array
    b: Array
    s: Array

    def only(self, chosen: Mask | Integers) -> NormalEquations:
        """Select some columns by a mask of shape (p,), or by their places."""
        return NormalEquations(self.A[:, chosen][:, :, chosen], self.b[:, chosen], self.s)

    def solved_without(
        self, sets: Integers, A: Array, b: Array, solve: Callable[[Array, Array], Array]
    ) -> Iterator[tuple[Mask, Array]]:
        """
        Yield each set of blocks as a mask, and the parameters that follow from the other sets.

        Blocks with the same number in `sets`, shape (n_b,), are left out together.  Blocks with
        the number -1 stay in every fit.  A and b are the sums over all blocks, with the
        information besides blocks.
        """
        for one in np.unique(sets[sets >= 0]):
            out = sets == one
            if not out.all():
                yield out, solve(A - self.A[out].sum(axis=0), b - self.b[out].sum(axis=0))

    def errors(self, solved: Iterable[tuple[Mask, Array]]) -> Array:
        """Sum the squared errors of every block, predicted by `solved_without`; shape of s."""
        errors = self.s.copy()
        for out, theta in solved:
            errors[out] += np.sum(theta * (self.A[out] @ theta - 2.0 * self.b[out]), axis=1)
        return errors


def bounded_step(
    A: Array,
    b: Array,
    lower: Array,
    upper: Array,
    *,
    prior: Array | float = 0.0,
    damping: float = 0.0,
    rising: tuple[Array, Array] | None = None,
) -> Array:
    """
    Minimise ``x'A x - 2 b'x + x' diag(prior) x`` inside bounds; the step has shape (p,).

    `damping` is a share of the energy of each column.  `rising` holds rows, shape (k, q), and the
    least value of ``rows x[:q]``, shape (k,), which the step keeps if such an x exists.
    Raises IdentificationError if the equations are not finite.

    Examples
    --------
    >>> inside = bounded_step(np.eye(2), np.array([1.0, -1.0]), np.zeros(2), np.full(2, np.inf))
    >>> np.round(inside, 6) + 0.0
    array([1., 0.])
    """
    energy = np.diag(A)
    size = np.sqrt(np.where(energy > 0.0, energy, 1.0))
    scaled = A / np.outer(size, size)
    # a column of zeros keeps its parameter unchanged
    more = RIDGE + damping + np.where(energy > 0.0, 0.0, 1.0) + prior / size**2
    scaled[np.diag_indices_from(scaled)] += more
    wide = upper > lower
    x = np.zeros(size.size)
    try:
        L = np.linalg.cholesky(scaled)
        target = np.asarray(np.linalg.solve(L, b / size), dtype=np.float64)
        bounds = ((lower * size)[wide], (upper * size)[wide])
        with np.errstate(divide='ignore', invalid='ignore'):
            x[wide] = lsq_linear(L.T[:, wide], target, bounds, method='bvls').x
        if not np.isfinite(x).all():
            # bvls divides by zero if an active set is within rounding of its bound
            x[wide] = lsq_linear(L.T[:, wide], target, bounds, method='trf').x
        if rising is not None:
            x[wide] = _no_less(x[wide], L.T[:, wide], target, bounds, rising, wide, size)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise IdentificationError(
            f'the free-run fit is singular ({error}): its parameters do not follow from these '
            'data; record a longer motion over the whole range'
        ) from None
    return np.asarray(np.clip(x / size, lower, upper))


def _no_less(
    x: Array,
    M: Array,
    target: Array,
    bounds: tuple[Array, Array],
    rising: tuple[Array, Array],
    wide: Mask,
    size: Array,
) -> Array:
    """
    Minimise ``|M x - target|`` inside bounds, with ``rows x`` at least as large as required.

    The step is x over `size` in the columns `wide`, and zero elsewhere.  In each turn the most
    violated row joins the inequalities.  The problem of least distance then meets them:
    C. L. Lawson and R. J. Hanson, Solving Least Squares Problems, 1974, chapter 23,
    doi:10.1137/1.9781611971217.
    """
    (lower, upper), (rows, least) = bounds, rising
    step, row = np.zeros(size.size), np.zeros(size.size)
    step[wide] = x / size[wide]
    short = least - rows @ step[: rows.shape[1]]
    if short.max() <= UNDERCUT:
        return x
    Q, R = np.linalg.qr(M)
    middle, one = np.linalg.solve(R, Q.T @ target), np.eye(x.size)
    below, above = np.isfinite(lower), np.isfinite(upper)
    E = np.vstack([one[below], -one[above]])
    f = np.concatenate([lower[below], -upper[above]])
    for _ in range(CUTS):
        k = int(np.argmax(short))
        if short[k] <= UNDERCUT:
            break
        row[: rows.shape[1]] = rows[k]
        E, f = np.vstack([E, (row / size)[wide]]), np.append(f, least[k])
        G, h = np.linalg.solve(R.T, E.T), f - E @ middle
        # the distance of the farthest half-space is the unit of the distance
        unit = float(np.max(h / np.linalg.norm(G, axis=0)))
        system, last = np.vstack([G, h / unit]), np.eye(x.size + 1)[-1]
        try:
            left = last - system @ nnls(system, last)[0]
        except RuntimeError:
            break
        if not left[-1] > RIDGE:
            # no x meets all inequalities
            break
        x = middle - unit * np.linalg.solve(R, left[:-1] / left[-1])
        step[wide] = x / size[wide]
        short = least - rows @ step[: rows.shape[1]]
    return x

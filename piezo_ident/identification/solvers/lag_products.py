# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""
Sums of products of lagged signals, without the matrix of their lags.

All of them follow from those in which one of the two signals has no lag:

    S(i, j) = sum_{k=s}^{e-1} x(k-i) z(k-j)
    S(i+1, j+1) = S(i, j) + x(s-1-i) z(s-1-j) - x(e-1-i) z(e-1-j)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.kernel import kernel

__all__ = ['lag_products', 'lag_sums', 'stretches_of']

#: samples whose products are summed while they are in the cache
STRETCH = 1024


@kernel
def _products(
    x: NDArray[np.float64],
    z: NDArray[np.float64],
    x_at: int,
    z_at: int,
    n: int,
    out: NDArray[np.float64],
) -> None:
    out[:] = 0.0
    for start in range(0, n, STRETCH):
        size = min(STRETCH, n - start)
        a = x[x_at + start : x_at + start + size]
        fours = out.size // 4 * 4
        # four lags share one reading of the signal that has none
        for j in range(0, fours, 4):
            b = z[z_at + start - j - 3 : z_at + start - j + size]
            t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
            for k in range(size):
                t0 += a[k] * b[k + 3]
                t1 += a[k] * b[k + 2]
                t2 += a[k] * b[k + 1]
                t3 += a[k] * b[k]
            out[j] += t0
            out[j + 1] += t1
            out[j + 2] += t2
            out[j + 3] += t3
        for j in range(fours, out.size):
            b = z[z_at + start - j : z_at + start - j + size]
            total = 0.0
            for k in range(size):
                total += a[k] * b[k]
            out[j] += total


@kernel
def lag_products(
    x: NDArray[np.float64],
    z: NDArray[np.float64],
    x_at: int,
    z_at: int,
    n: int,
    n_x: int,
    n_z: int,
) -> NDArray[np.float64]:
    """
    Return ``S(i, j)`` for the lags ``0 .. n_x - 1`` of x and ``0 .. n_z - 1`` of z.

    Parameters
    ----------
    x, z : ndarray, shape (any,)
    x_at, z_at : int
        Where the n samples begin in each; at least as many samples as there are lags come before.
    n : int
    n_x, n_z : int
        At least 1.

    Returns
    -------
    ndarray, shape (n_x, n_z)
    """
    S = np.empty((n_x, n_z))
    row, column = np.empty(n_z), np.empty(n_x)
    _products(x, z, x_at, z_at, n, row)
    if n_x == n_z and x_at == z_at and x.ctypes.data == z.ctypes.data:
        column[:] = row
    else:
        _products(z, x, z_at, x_at, n, column)
    S[0, :] = row
    S[:, 0] = column
    for i in range(n_x - 1):
        for j in range(n_z - 1):
            first = x[x_at - 1 - i] * z[z_at - 1 - j]
            last = x[x_at + n - 1 - i] * z[z_at + n - 1 - j]
            S[i + 1, j + 1] = S[i, j] + (first - last)
    return S


def lag_sums(x: NDArray[np.float64], at: int, n: int, lags: int) -> NDArray[np.float64]:
    """
    Return ``sum_{k=s}^{e-1} x(k-i)`` for the lags i = 0 .. lags - 1.

    Parameters
    ----------
    x : ndarray, shape (any,)
    at : int
        Where the n samples begin; at least as many samples as there are lags come before.
    n, lags : int

    Returns
    -------
    ndarray, shape (lags,)
    """
    back = np.arange(1, lags)
    moved = np.cumsum(x[at - back] - x[at + n - back])
    return float(np.sum(x[at : at + n])) + np.concatenate([[0.0], moved])


def stretches_of(use: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """
    Return (start, stop) of every stretch of true values.

    >>> stretches_of(np.array([True, True, False, True]))
    [(0, 2), (3, 4)]
    """
    padded = np.concatenate([[False], use, [False]])
    edges = np.flatnonzero(padded[1:] != padded[:-1]).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))

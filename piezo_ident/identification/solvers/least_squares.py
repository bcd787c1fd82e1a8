# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Solve least squares on a triangular factor: samples are read once, and all fits are small."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import IdentificationError
from scipy.optimize import lsq_linear

#: number of rows that are factorised at once: a block of some dozen columns fits into the cache
ROWS = 1024


@contextmanager
def singular_is_ours() -> Iterator[None]:
    """Replace the error of numpy for a singular fit by an error that asks for better data."""
    try:
        yield
    except np.linalg.LinAlgError as error:
        raise IdentificationError(
            f'the data do not tell the parameters apart ({error}); drive the stage over its '
            'range, by steps, noise and a triangle'
        ) from error


def triangular_factor(blocks: Iterable[Array], width: int) -> Array:
    """
    Compute R of the QR factorisation of all rows, in constant memory; shape (width, width).

    The blocks have shape (rows, width); ``R'R`` is the Gram matrix of the columns.
    """
    R = np.zeros((width, width))
    for block in blocks:
        for start in range(0, block.shape[0], ROWS):
            rows = np.vstack([R, block[start : start + ROWS]])
            R = np.asarray(np.linalg.qr(rows, mode='r'))
    return R


def bounded_least_squares(R: Array, lower: Array, upper: Array) -> tuple[Array, float]:
    """
    Minimise ``|A x - y|^2`` inside bounds, where R is the factor of ``[A y]``.

    The bounds, shape (n,), may be infinite.  The result is x and the sum of squares there.

    Examples
    --------
    >>> rows = np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 2.0]])
    >>> R = triangular_factor([rows], 3)
    >>> x, loss = bounded_least_squares(R, np.zeros(2), np.full(2, np.inf))
    >>> np.round(x, 6) + 0.0, round(loss, 6)
    (array([0., 2.]), 1.0)
    """
    A, y = R[:, :-1], R[:, -1]
    scale = np.linalg.norm(A, axis=0)
    scale[scale == 0.0] = 1.0
    result = lsq_linear(A / scale, y, (lower * scale, upper * scale), method='bvls')
    if result.status <= 0:
        result = lsq_linear(A / scale, y, (lower * scale, upper * scale), method='trf')
    x = np.clip(result.x / scale, lower, upper)
    return x, float(np.sum((A @ x - y) ** 2))

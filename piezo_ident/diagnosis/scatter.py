# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What a gain on held-out blocks is worth beside its own scatter.

Errors of two models on the same blocks are compared block by block, so what makes a block hard
for both of them cancels.  The scatter of the differences over the blocks says how far their sum
may be trusted, and whole kinds of excitation, held out, say whether it holds elsewhere.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.diagnosis.fit import Fitted
from piezo_ident.diagnosis.rows import centred, Rows

__all__ = ['SCATTER', 'refit_holds', 'standard_errors']

#: a difference below this many standard errors is none
SCATTER = 2.0
#: how much worse a refit of H may predict a kind of excitation that was held out
WORSE = 1.05
#: what counts as no difference, % of stroke
NOTHING = 0.01


def standard_errors(difference: NDArray[np.float64]) -> float:
    """
    Return a sum over blocks in units of its standard error.

    Parameters
    ----------
    difference : ndarray, shape (blocks,)
        Of each block; blocks count as independent.

    Examples
    --------
    >>> round(standard_errors(np.array([3.0, 1.0, 2.0, 2.0])), 2)
    4.9
    """
    total = float(difference.sum())
    if total == 0.0 or difference.size < 2:
        return 0.0
    deviation = float(np.sqrt(difference.size * difference.var(ddof=1)))
    return total / deviation if deviation > 0.0 else float(np.copysign(np.inf, total))


def refit_holds(rows: Rows, given: NDArray[np.float64], base: Fitted) -> bool:
    """
    Return whether a refit of H is better than the model as given on kinds of excitation it missed.

    A drift, or steps of the converter, can lower the error of a refit on blocks between those that
    were fitted; a kind of excitation that was left out as a whole tells.  What a shift of each
    record could do is no merit of the refit.

    Parameters
    ----------
    rows : Rows
    given : ndarray, shape (n,)
        Residual of the model as given, normalised.
    base : Fitted
        Without effects.
    """
    squares = centred(given, rows.of_record) ** 2
    before = np.bincount(rows.block, squares, minlength=rows.group.size)
    if standard_errors(before - base.transfer) < SCATTER:
        return False
    size = np.bincount(rows.group[rows.block], minlength=len(rows.labels))
    one = np.bincount(rows.group, before, len(rows.labels))
    other = np.bincount(rows.group, base.transfer, len(rows.labels))
    return bool(np.all(other <= WORSE**2 * one + size * (NOTHING * rows.stroke / 100.0) ** 2))

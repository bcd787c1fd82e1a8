# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The fast noise of readings, and the step of the converter behind it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.residual.stretches import ResidualPart

__all__ = ['Scatter', 'quantum_of', 'scatter_of']

#: samples in which a quantum is looked for, in rows of so many
MOST, MOST_ROW = 2**17, 2**10


@dataclass(frozen=True)
class Scatter:
    """
    Fast noise of the readings.

    Attributes
    ----------
    rms : float
        From third differences [m].
    quantum : float
        Step of the converter, or of the file's decimals [m]; 0 when there is none.
    rest : float
        Rms without the quantum's own q / sqrt(12) [m].
    """

    rms: float
    quantum: float
    rest: float


def quantum_of(y: NDArray[np.float64]) -> float:
    """
    Return the step of which all readings are multiples, 0 when there is none.

    Parameters
    ----------
    y : ndarray, shape (n,)
    """
    span = float(np.ptp(y))
    if span == 0.0:
        return 0.0
    # neighbours in time differ by few steps, so the rounding of numbers does not add up
    some = _pieces(y)
    jumps = np.abs(np.diff(some))
    # the ends of a clipped range need not be codes
    inner = (some > y.min()) & (some < y.max())
    jumps = jumps[(jumps > 1e-9 * span) & inner[1:] & inner[:-1]]
    total = jumps.size
    jumps = np.unique(np.round(jumps, 18))
    if jumps.size and total > 20 and np.ptp(jumps) < 1e-6 * jumps[0]:
        return float(jumps.mean())
    if jumps.size < 2 or jumps.size > y.size // 4 + 50:
        return 0.0
    small = jumps[: max(20, jumps.size // 10)]
    step = float(small[0])
    for _ in range(4):
        ratio = small / step
        off = np.abs(ratio - np.rint(ratio))
        near = np.rint(ratio) < 50
        if near.sum() >= 2 and np.mean(off[near] < 0.03) > 0.97:
            whole = np.rint(ratio)[near]
            return float(np.sum(small[near] * whole) / np.sum(whole * whole))
        # a code in between was never hit: the step divides the differences of differences
        gaps = np.diff(small)
        gaps = gaps[gaps > 0.03 * step]
        if gaps.size == 0 or float(gaps.min()) > 0.97 * step:
            return 0.0
        step = float(gaps.min())
    return 0.0


def _pieces(y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return some whole stretches of a long signal, which tell the step as well."""
    if y.size <= MOST:
        return y
    rows = y[: y.size // MOST_ROW * MOST_ROW].reshape(-1, MOST_ROW)
    return np.asarray(rows[:: max(1, y.size // MOST)].ravel())


def scatter_of(part: ResidualPart) -> Scatter:
    """Return the fast noise of a part's readings; a model's misfit is too slow to matter."""
    y = part.piece.y
    quantum = quantum_of(y)
    third = np.diff(part.e, 3)[part.mask[3:]] / np.sqrt(20.0)
    if third.size == 0:
        return Scatter(0.0, quantum, 0.0)
    size = np.abs(third)
    # quantised readings may repeat more often than not, so a median could be zero
    robust = 1.4826 * float(np.median(size))
    usual = size[size <= max(5.0 * robust, 1.01 * quantum)]
    rms = float(np.sqrt(np.mean(usual**2))) if usual.size else robust
    rest = float(np.sqrt(max(rms * rms - quantum * quantum / 12.0, 0.0)))
    return Scatter(rms, quantum, rest)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Uniformly sampled motion for a fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from scipy.signal import lfilter


@dataclass(frozen=True, eq=False)
class Stretch:
    """
    Motion with a mask of the samples that count, and their blocks.

    Attributes
    ----------
    u, x : ndarray, shape (n,)
        Normalised voltage and displacement.  The simulation uses all of the voltage.
    use : ndarray of bool, shape (n,)
        Samples that count.
    block : ndarray of int, shape (n,)
        Number of the block of each sample; it never falls along a stretch.
    rate : float
        Sampling rate [Hz].
    number : int
        Index among all stretches.
    record : int
        Index of the record among all records.
    before : ndarray, shape (k,)
        Earlier voltages of the record that the plays remember; empty at the start of a record.
    """

    u: Array
    x: Array
    use: Mask
    block: Integers
    rate: float
    number: int = 0
    record: int = 0
    before: Array = field(default_factory=lambda: np.empty(0))

    @property
    def times(self) -> Array:
        """Time since the first sample [s], shape (n,)."""
        return np.arange(self.u.size) / self.rate

    def lagged(self, h: Array, tau: float) -> Array:
        """Filter a signal by 1 / (1 + tau p) from rest; tau in seconds, shape (n,)."""
        share = -np.expm1(-1.0 / (self.rate * tau))
        return np.asarray(h[0] + lfilter([share], [1.0, share - 1.0], h - h[0]))

    def with_use(self, use: Mask) -> Stretch:
        """Replace the mask of samples that count."""
        return replace(self, use=use)


def block_count(stretches: Sequence[Stretch]) -> int:
    """Count the blocks of all stretches together."""
    return 1 + max(int(s.block[-1]) for s in stretches)


def delayed(x: Array, samples: int) -> Array:
    """
    Delay a signal that was constant before its first sample; shape (n,).

    Examples
    --------
    >>> delayed(np.array([1.0, 2.0, 3.0]), 1).tolist()
    [1.0, 1.0, 2.0]
    """
    if samples == 0:
        return x
    return np.concatenate([np.full(min(samples, x.size), x[0]), x[: -samples or None]])


def remembered(u: Array) -> Array:
    """
    Reduce u to its first value, the turning points that plays remember, and its last value.

    The result has shape (k,).  Plays forget the inner two of four values in a row if the inner
    two lie between the outer two (wiping out).

    Examples
    --------
    >>> remembered(np.array([0.0, 4.0, 1.0, 3.0, 2.0, 5.0])).tolist()
    [0.0, 5.0]
    """
    x = u[np.concatenate([[True], np.diff(u) != 0.0])]
    turns = np.diff(np.sign(np.diff(x))) != 0.0
    kept: list[float] = []
    for value in x[np.concatenate([[True], turns, [True]])[: x.size]].tolist():
        kept.append(value)
        while len(kept) > 3:
            a, b, c, d = kept[-4:]
            if not min(a, d) <= min(b, c) <= max(b, c) <= max(a, d):
                break
            del kept[-3:-1]
    return np.array(kept)

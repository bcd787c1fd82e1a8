# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Keep the voltage of a further axis until the block of the first axis at the same time comes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.record.blocks import Samples

#: most samples that are kept
MOST = 1_000_000


class Companion:
    """
    Samples of one topic by their tick.

    Parameters
    ----------
    sample_rate : float
        [Hz]

    Examples
    --------
    >>> voltage = Companion(10.0)
    >>> voltage.add(Samples(np.array([0.0, 0.1]), np.array([5.0, 6.0])))
    >>> voltage.has(np.array([0.1, 0.2])), voltage.take(np.array([0.1, 0.2])).tolist()
    (False, [6.0, nan])
    """

    def __init__(self, sample_rate: float) -> None:
        self._rate = sample_rate
        self._kept: dict[int, float] = {}
        self._newest = -1

    def add(self, samples: Samples) -> None:
        """Keep a block; a block whose time jumps back begins a new stream."""
        ticks = self._ticks(samples.t)
        if ticks[0] <= self._newest or len(self._kept) > MOST:
            self._kept.clear()
        self._kept.update(zip(ticks, samples.values.tolist(), strict=True))
        self._newest = ticks[-1]

    def clear(self) -> None:
        """Forget all samples: the stream has ended."""
        self._kept.clear()
        self._newest = -1

    def has(self, t: NDArray[np.float64]) -> bool:
        """Return whether a sample is kept for each time, shape (n,) [s]."""
        return all(tick in self._kept for tick in self._ticks(t))

    def take(self, t: NDArray[np.float64]) -> NDArray[np.float64]:
        """Remove and return the samples at the given times; NaN stands for a missing sample."""
        return np.array([self._kept.pop(tick, np.nan) for tick in self._ticks(t)])

    def _ticks(self, t: NDArray[np.float64]) -> list[int]:
        ticks: list[int] = np.rint(t * self._rate).astype(np.int64).tolist()
        return ticks

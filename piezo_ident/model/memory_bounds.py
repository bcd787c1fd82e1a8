# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Bound the memory of a stage whose earlier motion is unknown, from its voltage."""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.operators.hysteresis import Hysteresis


class MemoryBounds:
    """
    Bounds of the play outputs, and of lags along the path, after unknown motion.

    The voltage was within `span` before the start.  The output F of a play stays within
    ``[v - r, v]``, so a stroke as wide as the play leaves a single possible output.

    Parameters
    ----------
    h : Hysteresis
    v0 : float
        Voltage at the start, normalised.
    span : tuple of float
        Smallest and largest voltage that the stage has seen, normalised.

    Attributes
    ----------
    low, high : ndarray, shape (m,) or, with k lags, (m + k + 1,)
        Bounds in the form of a memory of `Hysteresis.follow`; once equal, they stay equal.

    Examples
    --------
    >>> bounds = MemoryBounds(Hysteresis([0.1, 0.5], [1.0, 1.0], 0.0, 1.0), 0.5, (0.0, 1.0))
    >>> bounds.follow(np.array([0.5, 0.6])).round(3).tolist(), bounds.known.tolist()
    ([0.6, 0.4], [True, False])
    """

    def __init__(self, h: Hysteresis, v0: float, span: tuple[float, float]) -> None:
        self._h, self._span = h, span
        self.forget(v0)

    def forget(self, v0: float) -> None:
        """Start again at a voltage, after unknown motion."""
        h, (low, high) = self._h, self._span
        r = h.thresholds
        floor = np.maximum(v0 - r, min(v0, low))
        ceiling = np.maximum(floor, np.minimum(v0, np.maximum(low, high - r)))
        ends = [floor, ceiling]
        if h.relaxations is not None:
            ends = [np.concatenate([f, z, [v0]]) for f, z in zip(ends, h.lag_range, strict=True)]
        self.low, self.high = ends

    def came_down(self, v0: float) -> None:
        """Take the memory of a stage that last came down to the lowest voltage."""
        plays, h = self._h.initial_memory(v0), self._h
        self.low = plays if h.relaxations is None else np.append(plays, h.settled(v0))
        self.high = self.low.copy()

    @property
    def known(self) -> Mask:
        """Whether the output of each play is known, shape (m,)."""
        m = self._h.thresholds.size
        return np.asarray(self.low[:m] == self.high[:m])

    def follow(self, v: Array) -> Array:
        """Follow the next voltages; the result is the uncertainty of w, shapes (n,)."""
        if np.array_equal(self.low, self.high):
            # the memory is known, so the free run needs no bounds from here on
            return np.zeros(v.size)
        floor, self.low = self._h.follow(v, self.low)
        ceiling, self.high = self._h.follow(v, self.high)
        return np.maximum(ceiling - floor, 0.0)

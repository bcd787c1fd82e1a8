# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Scaling of a model: from volts and metres to numbers between zero and one, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError

#: share of the range that counts as its lower end, where the memory of a stage is known
REST = 0.01


@dataclass(frozen=True)
class Scaling:
    """
    Signed affine normalisation: u = (v - v0)/V and (y - y0)/Y.

    Attributes
    ----------
    v0, V : float
        Voltage at u = 0 and span [V].
    y0, Y : float
        Displacement at zero and span [m]; Y is negative for a stage that retracts.
    range : tuple of float
        Voltages between which the model was identified [V].
    """

    v0: float
    V: float
    y0: float
    Y: float
    range: tuple[float, float]

    def __post_init__(self) -> None:
        numbers = (self.v0, self.V, self.y0, self.Y, *self.range)
        if not np.all(np.isfinite(numbers)):
            raise ModelError('scaling: v0, V, y0, Y and range must be finite numbers')
        if self.V <= 0 or self.Y == 0:
            raise ModelError('scaling: V must be positive and Y not zero')
        if self.range[0] >= self.range[1]:
            raise ModelError('scaling: range must be [lowest, highest] voltage')

    def u(self, v: ArrayLike) -> Array:
        """Convert volts to the normalised input."""
        return (np.asarray(v, dtype=np.float64) - self.v0) / self.V

    def v(self, u: float) -> float:
        """Convert the normalised input to volts."""
        return self.v0 + self.V * float(u)

    def y(self, x: ArrayLike) -> Array:
        """Convert the normalised output to metres."""
        return self.y0 + self.Y * np.asarray(x, dtype=np.float64)

    def x(self, y: ArrayLike) -> Array:
        """Convert metres to the normalised output."""
        return (np.asarray(y, dtype=np.float64) - self.y0) / self.Y

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Check the inputs of an inverse: motion, limits and further channels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import DataError
from piezo_ident.model.stage_model import StageModel


def checked_motion(wanted: ArrayLike) -> Array:
    """Convert a wanted motion to a vector, or raise DataError."""
    y = _vector(wanted)
    if y.size < 2 or not np.all(np.isfinite(y)):
        raise DataError(
            'invert: the wanted motion must be a vector of finite numbers, in metres, two at least'
        )
    return y


def _vector(values: ArrayLike) -> Array:
    """Convert values to a vector: empty if they are no numbers, NaN where they are masked."""
    try:
        given: Any = np.ma.asarray(values)
        if given.ndim == 1 and np.isrealobj(given):
            return np.asarray(given.astype(np.float64).filled(np.nan))
    except (TypeError, ValueError):
        pass
    return np.empty(0)


def checked_limits(
    model: StageModel, limits: tuple[float, float] | None, slew: float
) -> tuple[float, float, float]:
    """
    Convert limits and slew to lowest voltage, highest voltage and speed, or raise DataError.

    Limits of None stand for the identified range.
    """
    given = model.scaling.range if limits is None else limits
    try:
        (low, high), speed = map(float, given), float(slew)
    except (TypeError, ValueError):
        low = high = speed = np.nan
    if not (-np.inf < low < high < np.inf and speed > 0.0):
        raise DataError('limits must be (lowest, highest) voltage, finite, and a slew above zero')
    return low, high, speed


def padded(channels: Mapping[str, ArrayLike], n: int, around: tuple[int, int]) -> dict[str, Array]:
    """Extend further signals to the length of the voltage; DataError if a length is wrong."""
    found = {name: _vector(z) for name, z in channels.items()}
    for name, z in found.items():
        if z.shape != (n,) or not np.all(np.isfinite(z)):
            raise DataError(
                f'invert: the channel {name!r} must be a vector of {n} finite numbers, one for '
                'each of the wanted motion'
            )
    return {name: np.pad(z, around, mode='edge') for name, z in found.items()}

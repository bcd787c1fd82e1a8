# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Check the inputs of an inverse: motion, its reach and unit, limits and further channels."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, finite_vector, real_array
from piezo_ident.common.errors import DataError
from piezo_ident.control.expectation import known_rms
from piezo_ident.model.stage_model import StageModel
from scipy.optimize import brentq

#: error at rest, normalised, above which a position is out of reach
SHORT = 1e-4
#: largest excess over the limits that is accepted from a less accurate model [of the span]
SLIGHT = 1e-2
#: motions larger or smaller than these spans of the model probably have a wrong unit
FAR, FAINT = 30.0, 2e-3


def checked_motion(wanted: ArrayLike) -> Array:
    """Convert a wanted motion to a vector, or raise DataError."""
    return finite_vector(
        wanted, 'invert', 'wanted motion', 'at least two finite numbers, in metres', least=2
    )


def check_rate(rate: float, sample_rate: float | None) -> None:
    """Refuse a sampling rate [Hz] of a motion other than the rate of the model, by a DataError."""
    if sample_rate is not None and not np.isclose(sample_rate, rate, rtol=1e-6):
        raise DataError(
            f'the wanted motion is sampled at {sample_rate:g} Hz, the model at {rate:g} Hz; give '
            'the motion at that rate'
        )


def checked_limits(
    model: StageModel, limits: tuple[float, float] | None, slew: float
) -> tuple[float, float, float]:
    """
    Convert limits and slew to lowest voltage, highest voltage and speed, or raise DataError.

    Limits of None stand for the identified range.
    """
    ends = model.scaling.range if limits is None else limits
    try:
        (low, high), speed = map(float, ends), float(slew)
    except (TypeError, ValueError):
        low = high = speed = np.nan
    if not (-np.inf < low < high < np.inf and speed > 0.0):
        raise DataError(
            f'limits {limits!r} and slew {slew!r}: the limits must be two finite numbers '
            '(lowest, highest), and the slew must be above zero'
        )
    return low, high, speed


def padded(channels: Mapping[str, ArrayLike], n: int, around: tuple[int, int]) -> dict[str, Array]:
    """Extend further signals to the length of the voltage; DataError if a length is wrong."""
    signals = {name: real_array(z, f'invert, channel {name!r}') for name, z in channels.items()}
    for name, z in signals.items():
        if z.shape != (n,) or not np.all(np.isfinite(z)):
            raise DataError(
                f'invert: the channel {name!r} must be a vector of {n} finite numbers, one for '
                'each of the wanted motion'
            )
    return {name: np.pad(z, around, mode='edge') for name, z in signals.items()}


def rest_at(model: StageModel, y: Array, bounds: tuple[float, float], clip: bool) -> float:
    """Find the normalised voltage at which the model rests at the first position."""
    s = model.scaling
    x0 = float(s.x(y[0]))

    def miss(u: float) -> float:
        return float(model.chain().reset(u, u)) - x0

    below, above = miss(bounds[0]), miss(bounds[1])
    near = max(SHORT, tolerance(model, y) / abs(s.Y))
    if (below > near or above < -near) and not (clip and max(below, -above) < FAR):
        ends = sorted(1e6 * float(s.y(x0 + d)) for d in (below, above))
        is_far, um = max(below, -above) > FAR, 1e6 * y
        # the whole motion, not its start alone, has to come within reach
        missed = 1e-6 * (ends[0] - um.min() if um[0] < ends[0] else ends[1] - um.max())
        way = shifted(missed, float(np.ptp(y)), 1e-6 * (ends[1] - ends[0]))
        raise DataError(
            f'the wanted motion starts at {1e6 * y[0]:.4g} um; between {s.v(bounds[0]):g} and '
            f'{s.v(bounds[1]):g} V the stage rests at {ends[0]:.4g} .. {ends[1]:.4g} um'
            + ('; is the motion in metres?' if is_far else f'; {way}'),
            options='' if is_far else '--clip',
        )
    if below >= 0.0 or above <= 0.0:
        return bounds[0] if below >= 0.0 else bounds[1]
    return float(brentq(miss, *bounds, xtol=1e-14))


def tolerance(model: StageModel, y: Array) -> float:
    """Excess over the limits that is accepted: below the error of the model [m]."""
    return min(known_rms(model) or 0.0, SLIGHT * float(np.ptp(y)))


def extrapolated(model: StageModel, v: Array, y: Array) -> list[str]:
    """Warn of voltages outside the identified range, and of a motion that is very small."""
    s = model.scaling
    (low, high), warnings = s.range, []
    outside = np.mean((v < low - SHORT * s.V) | (v > high + SHORT * s.V))
    if outside:
        warnings.append(
            f'{outside:.1%} of the voltage, {v.min():.4g} .. {v.max():.4g} V, lie outside the '
            f'identified range {low:g} .. {high:g} V, where the model is an extrapolation'
        )
    return [*warnings, *faint(model, y)]


def faint(model: StageModel, y: Array) -> list[str]:
    """Warn of a motion so small that its unit is doubtful."""
    s = model.scaling
    if not 0.0 < np.abs(y - s.y0).max() < FAINT * abs(s.Y):
        return []
    return [
        f'the wanted motion stays within {1e6 * np.abs(y - s.y0).max():.2g} um of zero, of '
        f'{1e6 * abs(s.Y):.3g} um; is it in metres?'
    ]


def shifted(by: float, size: float, reach: float) -> str:
    """Say by how much a motion must be raised or lowered, or that it must be narrower [m]."""
    if size > reach:
        return f'make the motion narrower than the {1e6 * reach:.4g} um within reach'
    return f'{"raise" if by > 0.0 else "lower"} the motion by {1e6 * abs(by):.3g} um'

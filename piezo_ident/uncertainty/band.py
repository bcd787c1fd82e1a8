# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Bound the error of a free run by a half width that follows the motion.

The scale of the error is

    q^2 = c_0^2 + (c_S S)^2 + (c_D D)^2 + (c_N N)^2,

in spans, with swing S, speed D and nesting N of `piezo_ident.uncertainty.motion`.  On kind k of K
kinds of motion q is fitted to the others, and r_k^2 is the mean square of error over q.  A new
kind has each r_k with equal probability, and normal errors: pooling of R. Dunn, L. Wasserman and
A. Ramdas, J. Am. Stat. Assoc. 118(544), 2023, doi:10.1080/01621459.2022.2060112.  The half width
at level p is q lambda sqrt(1 + 1/K), where lambda solves

    mean_k erf(lambda / (sqrt(2) r_k)) = p.

The root stands for the error of the r_k; with it, draws of 3 to 20 kinds keep the level.  The
share p counts samples over kinds of motion: a whole record may leave its band.

Limits: the band holds for the stage at the time of the record, with the zero of its sensor.
Outside the excited range of the voltage the band widens by the distance, as the slope of H is
unknown there.  The band is infinite, which means unknown, `FAR` outside the range or at `FAST`
times the highest speed of the records.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ConfigError, ModelError
from piezo_ident.model.initial_memory import creep_elements
from piezo_ident.model.memory_bounds import MemoryBounds
from piezo_ident.model.observer import BEYOND
from piezo_ident.model.stage_model import StageModel
from piezo_ident.uncertainty.motion import Motion
from scipy.optimize import brentq
from scipy.special import erf, erfinv

#: entry of a model file, below `identification`
KEY = 'prediction_band'
#: largest distance outside the excited range with a known error, as a share of the range; taste
FAR = 0.25
#: largest speed with a known error, over the highest speed of the records; taste
FAST = 3.0


@dataclass(frozen=True, eq=False)
class PredictionBand:
    """
    Half width of the error of a free run as a function of the motion.

    Attributes
    ----------
    coefficients : ndarray, shape (4,)
        c_0, c_S, c_D and c_N in spans; a file without c_N has three.
    ratios : ndarray, shape (K,)
        Ratios r_k of the kinds of motion.
    speed : float
        Highest speed of the records [spans/s].
    """

    coefficients: Array
    ratios: Array
    speed: float

    def scale(self, motion: Array) -> Array:
        """Compute q of swing, speed and nesting, shape (3, n)."""
        squares = self.coefficients**2
        return np.asarray(np.sqrt(squares[0] + squares[1:] @ motion[: squares.size - 1] ** 2))

    def factor(self, level: float) -> float:
        """Compute lambda, the half width over q at a level."""
        if not 0.0 < level < 1.0:
            raise ConfigError(f'interval must lie between 0 and 1, got {level:g}')
        r, quantile = self.ratios, float(erfinv(level))
        ends = 0.99 * quantile * r.min(), 1.01 * quantile * r.max()
        half = brentq(lambda x: float(np.mean(erf(x / r))) - level, *ends)
        return math.sqrt(2.0 * (1.0 + 1.0 / r.size)) * float(half)

    def to_dict(self) -> dict[str, Any]:
        """Convert to plain data for a model file."""
        return {k: x.tolist() if isinstance(x, np.ndarray) else x for k, x in vars(self).items()}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> PredictionBand:
        """Read a band of a model file; raise ModelError if it is damaged."""
        try:
            # an older file has the rms of the ratios
            ratios = data.get('ratios') or [data['ratio']] * int(data['kinds'])
            c, r = (np.array(x, dtype=np.float64) for x in (data['coefficients'], ratios))
            band = cls(c, r, float(data['speed']))
            is_known = np.isfinite([*c, *r, band.speed]).all()
            is_sound = c.shape in ((3,), (4,)) and r.size > 0 and r.min() > 0.0 and is_known
        except (KeyError, TypeError, ValueError):
            is_sound = False
        if not is_sound:
            raise ModelError(f'{KEY}: is damaged; identify again')
        return band


def band_of(model: StageModel) -> PredictionBand:
    """Read the band of a model; raise ModelError if the model carries none."""
    data = model.identification.get(KEY)
    if not isinstance(data, Mapping):
        raise ModelError(f'{KEY}: is missing in the model; identify the stage again')
    return PredictionBand.from_dict(data)


class BandStream:
    """
    Half width of a stream of predictions, block by block.

    `plays` and `creep` say whether the memory of the plays, and the creep of earlier motion, are
    known at the start.  Otherwise the band contains all possible outputs of the plays until the
    voltage has swept them, and the largest possible creep.  Raises ModelError if the model carries
    no band, and ConfigError if the level does not lie between 0 and 1.
    """

    def __init__(
        self, model: StageModel, level: float, *, plays: bool = True, creep: bool = True
    ) -> None:
        self._model, self._level, self._plays = model, level, plays
        self._band = band_of(model)
        self._factor = self._band.factor(level)
        self._motion = Motion(model)
        low, high = model.scaling.u(np.array(model.scaling.range)).tolist()
        self._low, self._high = low, high
        h = model.hysteresis
        self._slope = abs(float(np.ptp(h(np.array([low, high])))) / (high - low))
        self._bounds: MemoryBounds | None = None
        shares, times = creep_elements(model)
        reach = BEYOND * float(np.ptp(h(np.linspace(low, high, 65))))
        self._creep = (reach * shares, times) if shares.size and not creep else None
        self._count = 0

    def follow(self, v: Array, y: Array) -> Array:
        """Compute the half width at voltages [V] and predictions [m]; infinite if unknown."""
        model, band = self._model, self._band
        if not v.size:
            return np.empty(0)
        u = model.scaling.u(v)
        motion = self._motion.follow(u, model.scaling.x(y))
        beyond = np.maximum(np.maximum(self._low - u, u - self._high), 0.0)
        half = self._factor * np.hypot(band.scale(motion), self._slope * beyond)
        half = half + self._level * self._of_start(u)
        far = beyond > FAR * (self._high - self._low)
        half[far | (motion[1] > FAST * band.speed)] = np.inf
        return np.asarray(half * abs(model.scaling.Y))

    def _of_start(self, u: Array) -> Array:
        """Compute the largest effect of the unknown start, normalised, shape (n,)."""
        gain, left = self._model.dynamics.gain, np.zeros(u.size)
        if not self._plays:
            if self._bounds is None:
                span = self._low, self._high
                self._bounds = MemoryBounds(self._model.hysteresis, float(u[0]), span)
            left = gain * self._bounds.follow(u)
        if self._creep is not None:
            sizes, times = self._creep
            t = (self._count + np.arange(u.size)) / self._model.sample_rate
            faded = sizes[:, None] * np.exp(-t / times[:, None])
            left = left + gain * np.sqrt(np.sum(faded**2, axis=0))
        self._count += u.size
        return np.asarray(left)

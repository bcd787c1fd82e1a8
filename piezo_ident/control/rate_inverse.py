# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Invert H with plays that widen with speed.

With known thresholds each sample is a root in one unknown, as for H alone.  The thresholds depend
on the speed of the unknown voltage.  Each pass takes the smoothed speed of the voltage from the
previous pass.  An exact solution for voltage and speed together is useless, because it jumps from
sample to sample: a faster voltage widens the plays by more than it moves them.

The passes do not converge if plays widen much.  The voltage must then change before a turn, as
before a zero outside the unit circle.  Gauss-Newton steps correct the whole voltage in this case;
they are small, smooth and solved by least squares.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.control.hysteresis_inverse import HysteresisInverse, rising
from piezo_ident.control.linear_inverse import smoothed
from piezo_ident.control.rate_tangent import tangent
from piezo_ident.effects.rate_dependent_hysteresis import RateDependentHysteresis
from piezo_ident.operators.chain import Block
from piezo_ident.operators.hysteresis import Hysteresis
from scipy.sparse.linalg import LinearOperator, lsmr

#: most passes, and corner of the smoothing of the speed in cutoffs of the effect
PASSES, SMOOTH = 4, 0.5
#: passes go on while one leaves at most this share of the squared error
PASS_LEAVES = 0.7
#: largest rms error of the passes without Gauss-Newton steps [of the span of the motion]
SETTLED = 1e-4
#: Gauss-Newton steps for a new motion, and for a motion similar to the one before
STEPS, AGAIN = 12, 3
#: a step: corner of its smoothing in cutoffs of the effect, weight of its size, relative
#: tolerance, and most products with the tangent
STEP_CORNER, STEP_SIZE, STEP_ERROR, PRODUCTS = 3.0, 1.0, 1e-3, 30

#: squared error, voltage, and H
_Found = tuple[float, Array, Array]


class RateInverse:
    """
    The inverse of H with `rate_dependent_hysteresis`, in normalised units.

    Parameters
    ----------
    hysteresis : Hysteresis
        Without lags along the path.
    parameters : mapping
        Parameters of the effect.
    sample_rate : float
        [Hz]
    limits : tuple of float, optional
        Lowest and highest voltage.
    step : float, optional
        Largest change of the voltage from one sample to the next.

    Examples
    --------
    >>> from piezo_ident.operators.hysteresis import Hysteresis
    >>> h = Hysteresis([0.2, 0.4], [0.3, 0.1], 0.0, 1.0)
    >>> law = {'exponent': 1.0, 'cutoff': 400.0, 'stretch': 0.01}
    >>> inverse = RateInverse(h, law, 10e3)
    >>> inverse.reset(0.0)
    0.0
    >>> inverse.process(np.array([0.01, 0.02, 0.02]))[1].round(9).tolist()
    [0.01, 0.02, 0.02]
    """

    def __init__(
        self,
        hysteresis: Hysteresis,
        parameters: Mapping[str, Any],
        sample_rate: float,
        limits: tuple[float, float] = (-np.inf, np.inf),
        step: float = np.inf,
    ) -> None:
        hysteresis = rising(hysteresis)
        self._effect = RateDependentHysteresis(sample_rate, parameters, hysteresis)
        self._inverse = HysteresisInverse(hysteresis, limits, step, growth=self._effect.growth)
        self._smoothing = SMOOTH * self._effect.number('cutoff'), sample_rate
        self._step = float(step)
        self._u0, self._before = 0.0, np.empty(0)

    @property
    def limits(self) -> tuple[float, float]:
        """The given limits, cut to the range in which H rises."""
        return self._inverse.limits

    def reset(self, u0: float) -> float:
        """Come to rest at a voltage, with plays as after a stroke from the lowest voltage."""
        self._u0 = u0
        return self._inverse.reset(u0)

    def begin_at(self, u: Array) -> None:
        """Begin the next search at the voltage of a similar motion, shape (n,)."""
        self._before = u

    def process(self, w: Array) -> tuple[Array, Array]:
        """
        Find the voltage for a whole motion w of H from rest, and H under it (approximately).

        All are of shape (n,).  H comes as near to w as the limits allow.
        """
        best = self._passed(w)
        if best[0] > SETTLED**2 * w.size * float(np.ptp(w)) ** 2:
            u, steps = best[1], STEPS
            if self._before.size == w.size:
                steps = AGAIN
                if self._left(self._before, w) < best[0]:
                    u = self._before
            best = self._corrected(w, u, steps, best)
        self._before = best[1]
        return best[1:]

    def _passed(self, w: Array) -> _Found:
        """Repeat passes, each with the speed of the previous pass; return the best pass."""
        u, reached = self._inverse.process(w)
        best, passes = (self._left(u, w), u, reached), PASSES
        if self._before.size == w.size:
            # voltage of a similar motion
            u, passes = self._before, 1
        for _ in range(passes):
            power = self._effect.power(smoothed(u, *self._smoothing), self._u0)
            self._inverse.reset(self._u0)
            u, reached = self._inverse.process(w, power)
            left, before = self._left(u, w), best[0]
            if left < before:
                best = left, u, reached
            if not left < PASS_LEAVES * before:
                break
        return best

    def _corrected(self, w: Array, u: Array, steps: int, best: _Found) -> _Found:
        """Correct a voltage by Gauss-Newton steps; return the best result, or `best`."""
        n = w.size
        for _ in range(steps):
            J = tangent(self._effect, u, self._u0)
            smooth = LinearOperator((n, n), self._smooth, self._smooth, dtype=np.float64)
            change = lsmr(
                J @ smooth,
                w - self._under(u),
                damp=STEP_SIZE,
                atol=STEP_ERROR,
                btol=STEP_ERROR,
                maxiter=PRODUCTS,
            )[0]
            # a step that increases the error may lead to a better region, so it is kept
            u = np.clip(u + self._smooth(change), *self.limits)
            best = min(best, self._found(u, w), key=lambda x: x[0])
        return best

    def _found(self, u: Array, w: Array) -> _Found:
        """Rate a voltage by its squared error, which is infinite if it is too steep."""
        if np.abs(np.diff(u, prepend=self._u0)).max() > self._step:
            return np.inf, u, w
        at_limit = (u <= self.limits[0]) | (u >= self.limits[1])
        return self._left(u, w), u, np.where(at_limit, self._under(u), w)

    def _smooth(self, x: Array) -> Array:
        corner, rate = STEP_CORNER * self._effect.number('cutoff'), self._effect.sample_rate
        return smoothed(x.ravel(), corner, rate)

    def _under(self, u: Array) -> Array:
        """H under a voltage, with the speed of this voltage."""
        self._effect.reset(self._u0, self._u0)
        return self._effect.process(Block(t=np.zeros(u.size), v=u, x=u)).x

    def _left(self, u: Array, w: Array) -> float:
        """Squared error of H under a voltage, with the speed of this voltage."""
        e = self._under(u) - w
        return float(e @ e)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The inverse of H with plays that widen with speed.

With known thresholds each sample is the root of one unknown, as for H alone.  The thresholds
follow from the speed of the voltage that is sought: it is that of the voltage found before,
smoothed.  To solve for both at once would be exact and of no use: a faster voltage widens the
plays by more than it moves them, so the root jumps from sample to sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.control.hysteresis_inverse import HysteresisInverse
from piezo_ident.control.linear_inverse import smoothed
from piezo_ident.effects.rate_dependent_hysteresis import RateDependentHysteresis
from piezo_ident.operators.chain import Block
from piezo_ident.operators.hysteresis import Hysteresis

__all__ = ['RateInverse']

Array = NDArray[np.float64]

#: times that the speed is taken anew, and the corner of its smoothing in cutoffs of the effect
PASSES, SMOOTH = 4, 0.5
#: share of the square of what a pass misses that it must leave at most for another one
WORTH = 0.7


class RateInverse:
    """
    The inverse of H with `rate_dependent_hysteresis`, in normalised units.

    Parameters
    ----------
    hysteresis : Hysteresis
        Without lags along the path.
    parameters : mapping
        Of the effect.
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
        self._effect = RateDependentHysteresis(sample_rate, parameters, hysteresis)
        names = 'gain', 'stretch', 'lead', 'lead_stretch'
        growth = [self._effect.number(name) for name in names]
        self._inverse = HysteresisInverse(hysteresis, limits, step, growth=growth)
        self._smoothing = SMOOTH * self._effect.number('cutoff'), sample_rate
        self._u0, self._before = 0.0, np.empty(0)

    @property
    def limits(self) -> tuple[float, float]:
        """Those given, as far as H rises up to them."""
        return self._inverse.limits

    def reset(self, u0: float) -> float:
        """Come to rest at a voltage, the plays as of a stage that last came down to zero."""
        self._u0 = u0
        return self._inverse.reset(u0)

    def process(self, w: Array) -> tuple[Array, Array]:
        """
        Return the voltages of a motion from rest, and what H is under them.

        Parameters
        ----------
        w : ndarray, shape (n,)
            What H is wanted to be, the whole motion.

        Returns
        -------
        u, w : ndarray, shape (n,)
            H comes as near as the limits allow.
        """
        u, reached = self._inverse.process(w)
        best = self._left(u, w), u, reached
        passes = PASSES
        if self._before.size == w.size:
            # of nearly the same motion
            u, passes = self._before, 1
        for _ in range(passes):
            power = self._effect.power(smoothed(u, *self._smoothing), self._u0)
            self._inverse.reset(self._u0)
            u, reached = self._inverse.process(w, power)
            left, before = self._left(u, w), best[0]
            if left < before:
                best = left, u, reached
            if not left < WORTH * before:
                break
        self._before = best[1]
        return best[1:]

    def _left(self, u: Array, w: Array) -> float:
        """Return by how much H with its own speed misses what is wanted, squared."""
        self._effect.reset(self._u0, self._u0)
        e = self._effect.process(Block(t=np.zeros(u.size), v=u, x=u)).x - w
        return float(e @ e)

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
from piezo_ident.common.kernel import kernel, ordered_kernel
from piezo_ident.control.hysteresis_inverse import HysteresisInverse
from piezo_ident.control.linear_inverse import smoothed
from piezo_ident.effects.rate_dependent_hysteresis import RateDependentHysteresis
from piezo_ident.operators.chain import Block
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.kernels import curve, held

__all__ = ['RateInverse']

Array = NDArray[np.float64]

#: difference of H from what is wanted that is none, and between voltages, normalised
NONE = 1e-13
#: evaluations of H for a sample, at most
TRIALS = 100
#: first step of all, and least first step from the sample before
FIRST, LEAST = 1e-4, 1e-7
#: times that the speed is taken anew, and the corner of its smoothing in cutoffs of the effect
PASSES, SMOOTH = 4, 0.5
#: share of the square of what a pass misses that it must leave at most for another one
WORTH = 0.7


@kernel
def _widened(
    u: float,
    r: Array,
    q: Array,
    p1: float,
    p2: float,
    p0: float,
    low: float,
    c: Array,
    growth: Array,
    s: float,
    memory: Array,
    after: Array,
) -> float:
    """Return H at u where plays are as wide as at speed s^eps; `after` takes their outputs."""
    more, wide, ahead, ahead_wide = (
        growth[0] * s,
        1.0 + growth[1] * s,
        growth[2] * s,
        growth[3] * s,
    )
    w = ((p1 * u + p0) * u + p2) * u
    for i in range(r.size):
        width = r[i] * wide + more
        least = u - (width if width > 0.0 else 0.0)
        most = u + r[i] * ahead_wide + ahead
        f = held(memory[i], least, most if least < most else least)
        after[i] = f
        w += q[i] * f
    if c.shape[0]:
        for i in range(r.size):
            t = after[i] - low
            w += c[3, i] * (u - low) * t + curve(c, i, t)
    return w


@ordered_kernel
def _invert(
    wanted: Array,
    r: Array,
    q: Array,
    p1: float,
    p2: float,
    p0: float,
    low: float,
    c: Array,
    growth: Array,
    power: Array,
    memory: Array,
    u0: float,
    least: float,
    most: float,
    step: float,
    out: Array,
    reached: Array,
) -> None:
    """Write voltages to `out` and H to `reached`; `power`, shape (n,), is the speed^eps."""
    after, last, move = memory.copy(), u0, FIRST
    for k in range(wanted.size):
        goal, s = wanted[k], power[k]
        lowest, highest = max(least, last - step), min(most, last + step)
        # where the voltage stays, and from there outwards until the sign changes
        a = min(max(last, lowest), highest)
        w = _widened(a, r, q, p1, p2, p0, low, c, growth, s, memory, after)
        fa = w - goal
        # about as far as the voltage went before
        b, fb, move = a, fa, max(move, LEAST)
        while abs(fa) > NONE and (fb > 0.0) == (fa > 0.0):
            a, fa = b, fb
            end = lowest if fa > 0.0 else highest
            if b == end:
                break
            b = max(b - move, lowest) if fa > 0.0 else min(b + move, highest)
            w = _widened(b, r, q, p1, p2, p0, low, c, growth, s, memory, after)
            fb, move = w - goal, 4.0 * move
        for _ in range(TRIALS):
            if abs(fb) <= NONE or (fa > 0.0) == (fb > 0.0) or abs(b - a) < NONE:
                break
            x = b - fb * (b - a) / (fb - fa)
            w = _widened(x, r, q, p1, p2, p0, low, c, growth, s, memory, after)
            f = w - goal
            if (f > 0.0) == (fb > 0.0):
                # the other end stood still twice: it counts for half
                fa *= 0.5
            else:
                a, fa = b, fb
            b, fb = x, f
        for i in range(memory.size):
            memory[i] = after[i]
        move, last = 1.1 * abs(b - last), b
        out[k], reached[k] = b, w


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

    Attributes
    ----------
    limits : tuple of float
        Those given.

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
        self._h, self.limits, self._step = hysteresis, limits, float(step)
        self._effect = RateDependentHysteresis(sample_rate, parameters, hysteresis)
        r, q, p1, p2, p0, low, c = hysteresis.for_kernel
        names = 'gain', 'stretch', 'lead', 'lead_stretch'
        growth = np.array([self._effect.number(name) for name in names])
        self._parameters = r, q, p1, p2, p0, low, c, growth
        self._still = HysteresisInverse(hysteresis, limits, step)
        corner = SMOOTH * self._effect.number('cutoff')
        self._smoothing = corner, sample_rate
        self._u0, self._before = 0.0, np.empty(0)

    def reset(self, u0: float) -> float:
        """Come to rest at a voltage, the plays as of a stage that last came down to zero."""
        self._u0 = u0
        return self._still.reset(u0)

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
        u, reached = self._still.process(w)
        best = self._left(u, w), u, reached
        passes = PASSES
        if self._before.size == w.size:
            # of nearly the same motion
            u, passes = self._before, 1
        r = self._parameters[0]
        rest = self._h.initial_memory(self._u0)
        rest = np.append(rest, np.zeros(r.size - rest.size))
        limits = float(self.limits[0]), float(self.limits[1]), self._step
        for _ in range(passes):
            power = self._effect.power(smoothed(u, *self._smoothing), self._u0)
            u, reached = np.empty(w.size), np.empty(w.size)
            _invert(
                np.ascontiguousarray(w),
                *self._parameters,
                power,
                rest.copy(),
                self._u0,
                *limits,
                u,
                reached,
            )
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

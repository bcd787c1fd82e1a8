# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The inverse of H with plays that widen with speed, sample by sample.

The speed of a sample depends on its voltage, so that voltage is the root of one unknown again, as
for H alone; it is bracketed from the sample before and found by false position.  An iteration over
the whole motion does not find it: the speed magnifies what changes fast, and each pass moves the
reversals of the next.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.kernel import alive, ordered_kernel
from piezo_ident.effects.rate_dependent_hysteresis import RateDependentHysteresis
from piezo_ident.operators.hysteresis import Hysteresis, POWERS
from piezo_ident.operators.kernels import curve, held

__all__ = ['RateInverse']

Array = NDArray[np.float64]

#: difference of H from what is wanted that is none, and between voltages, normalised
NONE = 1e-13
#: evaluations of H for a sample, at most
TRIALS = 100
#: first step from the sample before
FIRST = 1e-4


@ordered_kernel
def _widened(
    u: float,
    last: float,
    r: Array,
    q: Array,
    p1: float,
    p2: float,
    p0: float,
    low: float,
    c: Array,
    law: Array,
    speed: float,
    memory: Array,
    after: Array,
) -> tuple[float, float]:
    """Return H at u and the speed there; `after` takes the outputs of the plays."""
    pole, rate, power, levelling = law[0], law[1], law[2], law[3]
    speed = alive(pole * speed + (1.0 - pole) * (u - last) * rate)
    s = abs(speed)
    s = (s / (1.0 + levelling * s)) ** power
    more, wide, ahead, ahead_wide = law[4] * s, 1.0 + law[5] * s, law[6] * s, law[7] * s
    w = ((p1 * u + p0) * u + p2) * u
    for i in range(r.size):
        width = r[i] * wide + more
        least = u - (width if width > 0.0 else 0.0)
        most = u + r[i] * ahead_wide + ahead
        f = held(memory[i], least, most if least < most else least)
        after[i] = f
        w += (q[i] + c[3, i] * (u - low)) * f - c[3, i] * (u - low) * low + curve(c, i, f - low)
    return w, speed


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
    law: Array,
    memory: Array,
    least: float,
    most: float,
    step: float,
    state: Array,
    out: Array,
    reached: Array,
) -> None:
    """Write voltages to `out` and H to `reached`; `state`: the last voltage and its speed."""
    after = memory.copy()
    last, speed = state[0], state[1]
    for k in range(wanted.size):
        goal = wanted[k]
        lowest, highest = max(least, last - step), min(most, last + step)
        # where the voltage stays, and from there outwards until the sign changes
        a = min(max(last, lowest), highest)
        w, s = _widened(a, last, r, q, p1, p2, p0, low, c, law, speed, memory, after)
        fa = w - goal
        b, fb, move = a, fa, FIRST
        while abs(fa) > NONE and (fb > 0.0) == (fa > 0.0):
            a, fa = b, fb
            end = lowest if fa > 0.0 else highest
            if b == end:
                break
            b = max(b - move, lowest) if fa > 0.0 else min(b + move, highest)
            w, s = _widened(b, last, r, q, p1, p2, p0, low, c, law, speed, memory, after)
            fb, move = w - goal, 4.0 * move
        for _ in range(TRIALS):
            if abs(fb) <= NONE or (fa > 0.0) == (fb > 0.0) or abs(b - a) < NONE:
                break
            x = b - fb * (b - a) / (fb - fa)
            w, s = _widened(x, last, r, q, p1, p2, p0, low, c, law, speed, memory, after)
            f = w - goal
            if (f > 0.0) == (fb > 0.0):
                # the other end stood still twice: it counts for half
                fa *= 0.5
            else:
                a, fa = b, fb
            b, fb = x, f
        for i in range(memory.size):
            memory[i] = after[i]
        last, speed = b, s
        out[k], reached[k] = b, w
    state[0], state[1] = last, speed


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
        self._h, self.limits = hysteresis, limits
        effect = RateDependentHysteresis(sample_rate, parameters)
        names = 'exponent', 'levelling', 'gain', 'stretch', 'lead', 'lead_stretch'
        pole = float(np.exp(-2 * np.pi * effect.number('cutoff') / sample_rate))
        law = np.array([pole, sample_rate, *map(effect.number, names)])
        r, q, p1, p2, p0, low, c = hysteresis.for_kernel
        c = c if c.size else np.zeros((POWERS + 2, r.size))
        self._parameters = r, q, p1, p2, p0, low, c, law
        self._bounds = float(limits[0]), float(limits[1]), float(step)
        self._memory = self._state = np.zeros(0)

    def reset(self, u0: float) -> float:
        """Come to rest at a voltage, the plays as of a stage that last came down to zero."""
        w, memory = self._h.follow(np.array([u0]), self._h.initial_memory(u0))
        # the kernels take thresholds in whole lanes
        self._memory = np.append(memory, np.zeros(self._parameters[0].size - memory.size))
        self._state = np.array([u0, 0.0])
        return float(w[0])

    def process(self, w: Array) -> tuple[Array, Array]:
        """Return the voltages under which H comes as near to w as they may, and H; shape (n,)."""
        u, reached = np.empty(w.size), np.empty(w.size)
        _invert(
            np.ascontiguousarray(w),
            *self._parameters,
            self._memory,
            *self._bounds,
            self._state,
            u,
            reached,
        )
        return u, reached

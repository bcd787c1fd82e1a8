# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The inverse of H: the voltage under which H is what is wanted, sample by sample.

Between two samples H is a function of the new voltage alone, and a rising one where H has an
inverse.  So each sample is a root of one unknown, which a bracketed secant finds to the last
digits from the sample before; the plays then move on, as under the voltage that was found.  That
serves every law of H alike.  For a sum of plays without a cubic the inverse is a sum of plays
again: K. Kuhnen, "Modeling, identification and compensation of complex hysteretic nonlinearities",
European Journal of Control 9(4), 2003, doi:10.3166/ejc.9.407-418.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import ModelError
from piezo_ident.common.kernel import ordered_kernel
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.kernels import hysteresis, relaxing, wide_hysteresis

__all__ = ['HysteresisInverse']

Array = NDArray[np.float64]

#: difference of H from what is wanted that is none, normalised
NONE = 1e-13
#: evaluations of H between two ends, at most
TRIALS = 80
#: change of the voltage, and slope, below which a secant says nothing
FLAT = 1e-6


@ordered_kernel
def _value(
    u: float,
    r: Array,
    q: Array,
    p1: float,
    p2: float,
    p0: float,
    low: float,
    c: Array,
    lags: Array,
    memory: Array,
    after: Array,
) -> float:
    """Return H at its next voltage u, and the memory after it in `after`."""
    one, w = np.empty(1), np.empty(1)
    one[0] = u
    after[:] = memory
    if c.shape[0] == 0:
        hysteresis(one, r, q, p1, p2, after[: r.size], w)
    else:
        wide_hysteresis(one, r, q, p1, p2, p0, low, c, after[: r.size], w)
    if lags.shape[0]:
        relaxing(one, lags, after[r.size :], w)
    return float(w[0])


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
    lags: Array,
    memory: Array,
    least: float,
    most: float,
    step: float,
    last: Array,
    out: Array,
    reached: Array,
) -> None:
    """
    Write the voltages under which H is as wanted to `out`, and what H is to `reached`.

    `last` holds the voltage and H before, and a slope of H; it is carried on with `memory`.
    """
    after = np.empty(memory.size)
    slope = last[2]
    for k in range(wanted.size):
        goal = wanted[k]
        near, f_near = last[0], last[1] - goal
        u, f = near, f_near
        if abs(f_near) > NONE:
            bound = min(most, near + step) if f_near < 0.0 else max(least, near - step)
            far, f_far = near - f_near / slope, f_near
            while True:
                if (far - bound) * f_near <= 0.0:
                    far = bound
                f_far = _value(far, r, q, p1, p2, p0, low, c, lags, memory, after) - goal
                if far == bound or f_far * f_near <= 0.0:
                    break
                width = far - near
                near, f_near = far, f_far
                far = near + 2.0 * width
            u, f = far, f_far
            if f_far * f_near < 0.0:
                # the secant of Illinois: the value at an end that stays is halved
                for _ in range(TRIALS):
                    if abs(f) <= NONE or near == far:
                        break
                    u = far - f_far * (far - near) / (f_far - f_near)
                    f = _value(u, r, q, p1, p2, p0, low, c, lags, memory, after) - goal
                    if f * f_far < 0.0:
                        near, f_near = far, f_far
                    else:
                        f_near *= 0.5
                    far, f_far = u, f
            memory[:] = after
            if abs(u - last[0]) > FLAT:
                slope = max((f + goal - last[1]) / (u - last[0]), FLAT)
        out[k], reached[k] = u, f + goal
        last[0], last[1], last[2] = u, f + goal, slope


class HysteresisInverse:
    """
    The inverse of H with its memory, block by block, in normalised units.

    Parameters
    ----------
    hysteresis : Hysteresis
    limits : tuple of float, optional
        Lowest and highest voltage.
    step : float, optional
        Largest change of the voltage from one sample to the next.

    Raises
    ------
    ModelError
        When H falls somewhere under a rising voltage.

    Examples
    --------
    >>> from piezo_ident.operators.hysteresis import Hysteresis
    >>> h = Hysteresis([0.2, 0.4], [0.3, 0.1], 0.0, 1.0)
    >>> inverse = HysteresisInverse(h)
    >>> _ = inverse.reset(0.0)
    >>> u = inverse.process(np.array([0.5, 1.0, 0.7]))[0]
    >>> h(np.append(0.0, u))[1:].round(12).tolist()
    [0.5, 1.0, 0.7]
    """

    def __init__(
        self,
        hysteresis: Hysteresis,
        limits: tuple[float, float] = (-np.inf, np.inf),
        step: float = np.inf,
    ) -> None:
        slope = hysteresis.lowest_slope()
        if not slope > 0.0:
            raise ModelError(
                f'the hysteresis of this model has no inverse: its slope falls to {slope:.2g} '
                'within its range; identify again from a record with larger sweeps'
            )
        self.hysteresis = hysteresis
        lags = hysteresis.relaxations
        self._parameters = (*hysteresis.for_kernel, np.empty((0, 4)) if lags is None else +lags)
        self._bounds = (float(limits[0]), float(limits[1]), float(step))
        self._memory = self._last = np.zeros(0)

    def reset(self, u0: float) -> float:
        """Come to rest at a voltage, the plays as of a stage that last came down to zero."""
        h, m = self.hysteresis, self.hysteresis.thresholds.size
        w, memory = h.follow(np.array([u0]), h.initial_memory(u0))
        self._memory = np.concatenate(
            [memory[:m], np.zeros(self._parameters[0].size - m), memory[m:]]
        )
        self._last = np.array([u0, w[0], 1.0])
        return float(w[0])

    def process(self, w: Array) -> tuple[Array, Array]:
        """
        Return the voltages under which H comes as near to w as they may, and what H is then.

        Parameters
        ----------
        w : ndarray, shape (n,)

        Returns
        -------
        u, w : ndarray, shape (n,)
        """
        u, reached = np.empty(w.size), np.empty(w.size)
        _invert(
            np.ascontiguousarray(w),
            *self._parameters,
            self._memory,
            *self._bounds,
            self._last,
            u,
            reached,
        )
        return u, reached

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Invert H sample by sample.

Given the memory of H, its next value is a function of the next voltage alone.  This function
rises if H has an inverse.  Each sample is therefore a root in one unknown.  Newton steps within a
bracket find the root, starting at the sample before.  The memory then moves on under this voltage.
This works for every law of H.  After a turn of the voltage, H may fall until its narrowest plays
move.  Straight lines then replace these plays, because otherwise the voltage would jump at each
small turn, even at rest.

For a sum of plays without a cubic the inverse is a sum of plays again:
K. Kuhnen, "Modeling, identification and compensation of complex hysteretic nonlinearities",
European Journal of Control 9(4), 2003, doi:10.3166/ejc.9.407-418.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.common.kernel import kernel, ordered_kernel
from piezo_ident.effects.moving_plays import edges, Growth
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.kernels import curve, curve_slope, held, lag_after

#: largest error of H at a root, normalised
TOLERANCE = 1e-13
#: most evaluations of H for a sample
TRIALS = 80
#: smallest slope of H by which a Newton step divides
FLAT = 1e-6
#: number of voltages at which H is checked beyond its span
FINE = 513
#: largest threshold of a play that a line may replace, as a share of the span (taste).  A line
#: errs by half the threshold, and a real loop is several times as wide
NARROW = 0.02


@kernel
def _plays(u: float, band: Array, q: Array, memory: Array, after: Array) -> tuple[float, float]:
    """
    Compute the sum of the plays of H at u and its slope; write the plays to `after`.

    Each play stays between ``u + band[0]`` and ``u + band[1]``.
    """
    w, slope = 0.0, 0.0
    for i in range(q.size):
        f = held(memory[i], u + band[0, i], u + band[1, i])
        after[i] = f
        w += q[i] * f
        slope += 0.0 if f == memory[i] else q[i]
    return w, slope


@kernel
def _wide_plays(
    u: float, band: Array, q: Array, low: float, c: Array, memory: Array, after: Array
) -> tuple[float, float]:
    """Do the same as `_plays` with curves and bias; one loop is a third faster than two."""
    w, slope = 0.0, 0.0
    for i in range(q.size):
        f = held(memory[i], u + band[0, i], u + band[1, i])
        after[i] = f
        t = f - low
        w += q[i] * f + c[3, i] * (u - low) * t + curve(c, i, t)
        rise = q[i] + c[3, i] * (u - low) + curve_slope(c, i, t)
        slope += c[3, i] * t + (0.0 if f == memory[i] else rise)
    return w, slope


@ordered_kernel
def _lags(u: float, lags: Array, z: Array, after: Array) -> tuple[float, float]:
    """
    Compute the sum of the lags along the path at u and its slope; write the lags to `after`.

    Equals `piezo_ident.operators.kernels.relaxing` for a single sample.
    """
    w, slope, before, left, last = 0.0, 0.0, 0.0, 1.0, float(z[lags.shape[0]])
    way = 1.0 if u > last else -1.0
    for j in range(lags.shape[0]):
        a, d1, d2, d3 = lags[j, 0], lags[j, 1], lags[j, 2], lags[j, 3]
        # a lag of twice the rate decays by the square
        left = left * left if a == 2.0 * before else np.exp(-a * abs(u - last))
        before, b = a, way / a
        # answer of the lag to its own curve
        c2 = d2 - 3.0 * b * d3
        c1 = d1 - 2.0 * b * c2
        c0 = -b * c1
        after[j] = lag_after(z[j], c0, c1, c2, d3, last, u, left)
        behind = u * (d1 + u * (d2 + u * d3)) - after[j]
        w -= behind
        slope += way * a * behind - (d1 + u * (2.0 * d2 + u * 3.0 * d3))
    after[lags.shape[0]] = u
    return w, slope


@ordered_kernel
def _invert(
    wanted: Array,
    power: Array,
    growth: Growth,
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
    pole: float,
    last: Array,
    out: Array,
    reached: Array,
) -> None:
    """
    Write the voltage for each wanted value of H to `out`, and the value reached to `reached`.

    `last` holds the last voltage of H, H, its slope, and the voltage before the lag; the function
    updates it and `memory`.  With `power`, shape (n,), the plays widen as `growth` says.
    """
    after, grows = memory.copy(), power.size > 0
    band = np.zeros((2, r.size))
    band[0] = -r
    u, w, slope, v = last[0], last[1], last[2], last[3]
    for k in range(wanted.size):
        goal, start = wanted[k], u
        for i in range(r.size if grows else 0):
            band[0, i], band[1, i] = edges(0.0, r[i], power[k], growth)
        lowest, highest = max(least, v - step), min(most, v + step)
        # bracket of the voltage of H
        below = pole * start + (1.0 - pole) * lowest
        above = pole * start + (1.0 - pole) * highest
        before, asked = np.inf, False
        for trial in range(TRIALS + 1):
            # plays that widen move H although the voltage stays
            if trial or grows:
                if c.shape[0] == 0:
                    w, slope = _plays(u, band, q, memory, after)
                else:
                    w, slope = _wide_plays(u, band, q, low, c, memory, after)
                w += ((p1 * u + p0) * u + p2) * u
                slope += (3.0 * p1 * u + 2.0 * p0) * u + p2
                if lags.shape[0]:
                    more, steeper = _lags(u, lags, memory[q.size :], after[q.size :])
                    w, slope = w + more, slope + steeper
                slope, asked = max(slope, FLAT), True
            f = w - goal
            if abs(f) <= TOLERANCE and below <= u <= above:
                break
            if f < 0.0:
                below = max(below, min(u, above))
            else:
                above = min(above, max(u, below))
            # Newton step; clipped to the bracket, and replaced by bisection if it is slow
            new = u - f / slope
            if abs(f) > 0.5 * before and above - below < np.inf:
                new = 0.5 * (below + above)
            new = min(max(new, below), above)
            if new == u or trial == TRIALS:
                break
            before, u = abs(f), new
        if asked:
            for i in range(memory.size):
                memory[i] = after[i]
        v = min(max((u - pole * start) / (1.0 - pole), lowest), highest)
        out[k], reached[k] = v, w
    last[0], last[1], last[2], last[3] = u, w, slope, v


class HysteresisInverse:
    """
    Inverse of H with its memory, block by block, in normalised units.

    Parameters
    ----------
    hysteresis : Hysteresis
    limits : tuple of float, optional
        Lowest and highest voltage.
    step : float, optional
        Largest change of the voltage from one sample to the next.
    pole : float, optional
        Pole of a lag before H: ``u(k) = pole u(k-1) + (1 - pole) v(k)``.
    growth : tuple of four float, optional
        Growth of the plays with a power of the speed: gain, stretch, lead and lead_stretch of
        `rate_dependent_hysteresis`.

    Attributes
    ----------
    hysteresis : Hysteresis
        H that is inverted, see `rising`.
    limits : tuple of float
        The given limits, cut to the range in which H rises.

    Raises
    ------
    ModelError
        When H falls somewhere under a rising voltage, within its span.

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
        pole: float = 0.0,
        growth: Growth = (0.0, 0.0, 0.0, 0.0),
    ) -> None:
        self.hysteresis = hysteresis = rising(hysteresis)
        lags = hysteresis.relaxations
        self._parameters = (*hysteresis.for_kernel, np.empty((0, 4)) if lags is None else +lags)
        self.limits = _rising_limits(hysteresis, float(limits[0]), float(limits[1]))
        self._bounds = (*self.limits, float(step), float(pole))
        self._growth = growth
        self._memory = self._last = np.zeros(0)

    def reset(self, u0: float) -> float:
        """Come to rest at a voltage, with plays as after a stroke from the lowest voltage."""
        h = self.hysteresis
        w, memory = h.follow(np.array([u0]), h.initial_memory(u0))
        self._take(memory, np.array([u0, w[0], 1.0, u0]))
        return float(w[0])

    def follow(self, u: Array) -> None:
        """Follow voltages that another source has applied, shape (n,)."""
        m, lanes = self.hysteresis.thresholds.size, self._parameters[0].size
        memory = np.concatenate([self._memory[:m], self._memory[lanes:]])
        w, memory = self.hysteresis.follow(u, memory)
        self._take(memory, np.array([u[-1], w[-1], self._last[2], u[-1]]))

    @property
    def value(self) -> float:
        """H at the last voltage."""
        return float(self._last[1])

    def _take(self, memory: Array, last: Array) -> None:
        m, lanes = self.hysteresis.thresholds.size, self._parameters[0].size
        self._memory = np.concatenate([memory[:m], np.zeros(lanes - m), memory[m:]])
        self._last = last

    def process(self, w: Array, power: Array | None = None) -> tuple[Array, Array]:
        """
        Find the voltages for wanted values w of H, and the values of H that they reach.

        All are of shape (n,).  The plays grow with a `power` of the speed, if it is given.
        """
        u, reached = np.empty(w.size), np.empty(w.size)
        _invert(
            np.ascontiguousarray(w),
            np.empty(0) if power is None else power,
            self._growth,
            *self._parameters,
            self._memory,
            *self._bounds,
            self._last,
            u,
            reached,
        )
        return u, reached


def rising(hysteresis: Hysteresis, volts: Callable[[float], float] = float) -> Hysteresis:
    """
    Make H rise with the voltage: replace its narrowest plays by lines, as few as possible.

    Raises ModelError if H still falls; `volts` converts the normalised voltage in the message.
    """
    low, high = hysteresis.span
    narrow = int(np.sum(hysteresis.thresholds <= NARROW * (high - low)))
    risen, lines = hysteresis, 0
    while risen.lowest_slope() <= 0.0 and lines < narrow:
        lines += 1
        risen = hysteresis.with_lines(lines)
    slope, u = risen.flattest
    if not slope > 0.0:
        raise ModelError(
            f'the hysteresis of this model has no inverse: its slope falls to {slope:.2g} at '
            f'{volts(u):.4g} V; identify again from a record with larger sweeps'
        )
    return risen


def with_rising_hysteresis(model: StageModel) -> tuple[StageModel, tuple[str, ...]]:
    """
    Replace H of a model by an H that rises with the voltage; a warning says if it differs.

    Raises ModelError if H falls by more than its narrowest plays.
    """
    h = model.hysteresis
    risen = rising(h, model.scaling.v)
    if risen is h:
        return model, ()
    slope, u = h.flattest
    widest = float(h.thresholds[risen.thresholds != h.thresholds].max()) * model.scaling.V
    return replace(model, hysteresis=risen), (
        f'where the voltage turns, at {model.scaling.v(u):.4g} V, the slope of the hysteresis '
        f'falls to {slope:.2g}: plays of up to {widest:.3g} V are inverted as lines',
    )


def _rising_limits(hysteresis: Hysteresis, low: float, high: float) -> tuple[float, float]:
    """Cut the limits to the range in which H rises, at most one span beyond the span of H."""
    least, most = hysteresis.span
    if not -np.inf < low < high < np.inf or least <= low < high <= most:
        return low, high
    width = most - least
    v = np.linspace(least - width, most + width, FINE)
    w = hysteresis(np.concatenate([v, v[::-1]]))
    up, down = np.diff(w[:FINE]), -np.diff(w[FINE:])[::-1]
    # also directly after a turn, while all plays stand
    stands = hysteresis.slope_at_turns(v[1:]) <= 0.0
    falls = (up <= 0.0) | (down <= 0.0) | stands
    below, above = v[1:][falls & (v[1:] <= least)], v[:-1][falls & (v[:-1] >= most)]
    return max([low, v[0], *below]), min([high, v[-1], *above])

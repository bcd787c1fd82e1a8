# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Compiled loops of plays whose thresholds grow with the speed.

`piezo_ident.effects.rate_dependent_hysteresis.RateDependentHysteresis` has their equations.  The
thresholds r and weights q, shapes (m,), include idle plays that fill the vector lanes.  `power` is
``|s|^eps`` of the speed s, shape (n,).
"""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import alive, kernel, ordered_kernel
from piezo_ident.operators.kernels import curve, curve_slope, held
from piezo_ident.operators.parts import four_sums

#: growth of the lower edge, equal for all plays and relative; both for the upper edge
Growth = tuple[float, float, float, float]


@ordered_kernel
def edges(x: float, r: float, power: float, growth: Growth) -> tuple[float, float]:
    """Compute the edges of the band of a play; if they cross, the lower edge counts."""
    gain, stretch, lead, lead_stretch = growth
    width = r * (1.0 + stretch * power) + gain * power
    low = x - (width if width > 0.0 else 0.0)
    high = x + r * (lead_stretch * power) + lead * power
    return low, low if high < low else high


@kernel
def growth_of_plays(
    v: Array,
    r: Array,
    q: Array,
    low_v: float,
    c: Array,
    power: Array,
    growth: Growth,
    memory: Array,
    still: Array,
    out: Array,
) -> None:
    """
    Write the change of the sum of all plays by growth into `out`, shape (n,).

    `memory` belongs to the plays whose thresholds grow, `still` to the same plays with fixed
    thresholds; both are updated.  `low_v` and c are as in
    `piezo_ident.operators.kernels.wide_hysteresis`.
    """
    # separate loops over few arrays vectorise
    n_r = r.size
    for k in range(v.size):
        x, p = v[k], power[k]
        w = 0.0
        for i in range(n_r):
            still[i] = held(still[i], x - r[i], x)
        for i in range(n_r):
            low, high = edges(x, r[i], p, growth)
            memory[i] = held(memory[i], low, high)
        for i in range(n_r):
            w += q[i] * (memory[i] - still[i])
        if c.shape[0]:
            for i in range(n_r):
                f, g = memory[i] - low_v, still[i] - low_v
                w += c[3, i] * (x - low_v) * (f - g) + curve(c, i, f) - curve(c, i, g)
        out[k] = w


@ordered_kernel
def moved_play(v: Array, r: float, power: Array, growth: Growth, f: float, out: Array) -> None:
    """Write a play whose threshold grows into `out`, shape (n,); f is its output before."""
    for k in range(v.size):
        low, high = edges(v[k], r, power[k], growth)
        f = held(f, low, high)
        out[k] = f


@kernel
def moved_plays_apart(
    v: Array,
    r: Array,
    low_v: float,
    q: Array,
    c: Array,
    power: Array,
    growth: Growth,
    memory: Array,
    out: Array,
) -> None:
    """Write four sums of plays whose thresholds grow into `out`, shape (4, n); see `four_sums`."""
    for k in range(v.size):
        x, p = v[k], power[k]
        for i in range(r.size):
            low, high = edges(x, r[i], p, growth)
            memory[i] = held(memory[i], low, high)
        out[0, k], out[1, k], out[2, k], out[3, k] = four_sums(low_v, q, c, memory)


@kernel
def growth_slopes(
    v: Array,
    r: Array,
    q: Array,
    low_v: float,
    c: Array,
    power: Array,
    bends: Array,
    growth: Growth,
    memory: Array,
    out: Array,
) -> None:
    """
    Write the derivatives of the output of `growth_of_plays` into `out`, shape (7, n).

    Rows 0 to 3 are the derivatives by gain, stretch, lead and lead_stretch.  Rows 4 to 6 are the
    derivatives by the three parameters that shape the power; `bends`, shape (3, n), holds the
    derivatives of the power by these parameters.
    """
    # the three sums are written out, so that the loops over plays vectorise.  A moving play has
    # the derivative of the edge that moves it.  A resting play keeps its last derivative
    n_r, (gain, stretch, lead, lead_stretch) = r.size, growth
    by_low, by_high, weight = np.zeros(n_r), np.zeros(n_r), np.empty(n_r)
    one, two, three = np.zeros(n_r), np.zeros(n_r), np.zeros(n_r)
    for k in range(v.size):
        x, p = v[k], power[k]
        bend_1, bend_2, bend_3 = bends[0, k], bends[1, k], bends[2, k]
        for i in range(n_r):
            low, high = edges(x, r[i], p, growth)
            f = memory[i]
            new = held(f, low, high)
            memory[i] = new
            moves, is_low, is_wide = new != f, new == low, low < x
            lower = -gain - stretch * r[i] if is_wide else 0.0
            edge = lower if is_low else lead + lead_stretch * r[i]
            by_low[i] = (-p if is_low and is_wide else 0.0) if moves else by_low[i]
            by_high[i] = (0.0 if is_low else p) if moves else by_high[i]
            one[i] = edge * bend_1 if moves else one[i]
            two[i] = edge * bend_2 if moves else two[i]
            three[i] = edge * bend_3 if moves else three[i]
        for i in range(n_r):
            weight[i] = q[i]
        if c.shape[0]:
            for i in range(n_r):
                weight[i] += c[3, i] * (x - low_v) + curve_slope(c, i, memory[i] - low_v)
        g, s, h, t, j_1, j_2, j_3 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(n_r):
            w = weight[i]
            g += w * by_low[i]
            s += w * by_low[i] * r[i]
            h += w * by_high[i]
            t += w * by_high[i] * r[i]
            j_1 += w * one[i]
            j_2 += w * two[i]
            j_3 += w * three[i]
        out[0, k], out[1, k], out[2, k], out[3, k] = g, s, h, t
        out[4, k], out[5, k], out[6, k] = j_1, j_2, j_3


@kernel
def speed_of(v: Array, pole: float, rate: float, state: Array) -> Array:
    """Compute the speed of v behind a low-pass; updates `state`, the last input and speed."""
    speed = np.empty(v.size)
    last, s = state[0], state[1]
    for k in range(v.size):
        s = alive(pole * s + (1.0 - pole) * (v[k] - last) * rate)
        last = v[k]
        speed[k] = s
    state[0], state[1] = last, s
    return speed

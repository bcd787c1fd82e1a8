# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Compiled loops of H, of G, and of H, G and the delay together.

    F_r[v](k) = max(v(k) - r, min(v(k), F_r[v](k-1)))                                  (eqs. 1-2)

    w(k) = p1 v(k)^3 + p2 v(k) + sum_i q_i F_ri[v](k)                                 (eqs. 3, 6)
           [+ p0 v(k)^2 + sum_i psi_i(F_ri[v](k)) + kappa_i (v(k) - low) (F_ri[v](k) - low)]

    y(k) = sum_{j=1..nb} b_j w(k-j+1) - sum_{i=1..na} a_i y(k-i)                      (eqs. 4-5)

of Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868; the terms in brackets are explained
in `piezo_ident.operators.hysteresis`.

Every sum of G runs from the oldest term to the newest, for every sample of a block.  The result
therefore does not depend on how a stream is cut.  An output of G that has died away is set to zero
(`piezo_ident.common.kernel.alive`): otherwise a stage at rest would take 17 times as long to
simulate as a stage in motion.  The test for zero would delay every output.  A stretch is therefore
filtered without the test, and filtered again with the test only if an output died away.  The loops
share one file because a compiled loop is kept on disk until its own file changes.
"""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import alive, kernel, ordered_kernel, STILL

#: number of samples that pass the loops while they are in the cache
STRETCH = 1024


@ordered_kernel
def held(f: float, low: float, high: float) -> float:
    """Compute max(low, min(high, f)): a play moves only as far as its bounds demand."""
    # max() and min() have rules for NaN that keep loops from vectorising; comparisons do not
    f = high if f > high else f
    return low if f < low else f


@kernel
def plays(v: Array, r: Array, memory: Array, out: Array) -> None:
    """Write F_r[v] of every threshold into `out`, shape (m, n), and update `memory`."""
    for i in range(r.size):
        f = memory[i]
        for k in range(v.size):
            f = held(f, v[k] - r[i], v[k])
            out[i, k] = f
        memory[i] = f


@kernel
def hysteresis(
    v: Array, r: Array, q: Array, p1: float, p2: float, memory: Array, out: Array
) -> None:
    """Write w of eqs. (3) and (6) into `out`, shape (n,), and update `memory`."""
    for k in range(v.size):
        x, w = v[k], 0.0
        for i in range(r.size):
            f = held(memory[i], x - r[i], x)
            memory[i] = f
            w += q[i] * f
        out[k] = w + (p1 * x * x + p2) * x


@ordered_kernel
def curve(c: Array, i: int, t: float) -> float:
    """Compute c_1 t^2 + c_2 t^3 + c_3 t^4 of a play; flat below 0 and beyond its width (row 4)."""
    t = held(t, 0.0, c[4, i])
    bent: float = t * t * (c[0, i] + t * (c[1, i] + t * c[2, i]))
    return bent


@ordered_kernel
def curve_slope(c: Array, i: int, t: float) -> float:
    """Compute the slope of `curve`."""
    slope: float = t * (2.0 * c[0, i] + t * (3.0 * c[1, i] + t * 4.0 * c[2, i]))
    return slope if 0.0 < t < c[4, i] else 0.0


@kernel
def wide_hysteresis(
    v: Array,
    r: Array,
    q: Array,
    p1: float,
    p2: float,
    p0: float,
    low: float,
    c: Array,
    memory: Array,
    out: Array,
) -> None:
    """Write w with the terms in brackets; rows of c, shape (5, m): c_1 .. c_3, kappa, width."""
    for k in range(v.size):
        x, w = v[k], 0.0
        for i in range(r.size):
            f = held(memory[i], x - r[i], x)
            memory[i] = f
            w += q[i] * f + c[3, i] * (x - low) * (f - low) + curve(c, i, f - low)
        out[k] = w + ((p1 * x + p0) * x + p2) * x


@ordered_kernel
def path_lines(x: Array) -> Array:
    """
    Compute the steady answer of each lag of `relaxing` to a falling and to a rising voltage u.

    The answer is phi - phi' s/a + phi'' (s/a)^2 - ... with s = -1 for falling and 1 for rising.
    The result holds its coefficients of 1, u and u^2, shape (2, 3, j); u^3 keeps d_3.
    """
    n = x.shape[0]
    lines = np.empty((2, 3, n))
    for j in range(n):
        d1, d2, d3 = x[j, 1], x[j, 2], x[j, 3]
        for s in range(2):
            # s/a changes its sign with the direction
            b = 1.0 / x[j, 0] if s else -1.0 / x[j, 0]
            lines[s, 0, j] = b * (2.0 * b * d2 - d1 - 6.0 * b * b * d3)
            lines[s, 1, j] = d1 + b * (6.0 * b * d3 - 2.0 * d2)
            lines[s, 2, j] = d2 - 3.0 * b * d3
    return lines


@ordered_kernel
def lag_after(
    z: float, c0: float, c1: float, c2: float, d3: float, last: float, u: float, left: float
) -> float:
    """Move a lag to the voltage u; its distance to the steady answer shrinks to a share `left`."""
    new = c0 + u * (c1 + u * (c2 + u * d3))
    old = c0 + last * (c1 + last * (c2 + last * d3))
    return new + (z - old) * left


@kernel
def relaxing(v: Array, x: Array, state: Array, out: Array) -> None:
    """
    Add the lags along the path of v to `out`, and update `state`.

    Rows of x, shape (j, 4), are a rate a and d_1 .. d_3 of ``phi(v) = d_1 v + d_2 v^2 + d_3 v^3``.
    Each row adds ``z - phi(v)`` with ``dz = a |dv| (phi(v) - z)``, exactly for straight lines
    between the samples.  `state` holds each z, and then the last v.
    """
    n = x.shape[0]
    lines = path_lines(x)
    last = float(state[n])
    for k in range(v.size):
        u = float(v[k])
        length = abs(u - last)
        line = lines[1 if u > last else 0]
        total, before, left = 0.0, 0.0, 0.0
        for j in range(n):
            a, d1, d2, d3 = x[j, 0], x[j, 1], x[j, 2], x[j, 3]
            if length > 0.0:
                # at twice the rate the remaining share is the square; exp takes ten times as long
                left = left * left if a == 2.0 * before else np.exp(-a * length)
                before = a
                c0, c1, c2 = line[0, j], line[1, j], line[2, j]
                state[j] = lag_after(state[j], c0, c1, c2, d3, last, u, left)
            total += state[j] - u * (d1 + u * (d2 + u * d3))
        last = u
        out[k] += total
    state[n] = last


@ordered_kernel
def dynamics(w: Array, b: Array, a: Array, y: Array) -> None:
    """
    Continue y by eqs. (4) and (5), without the delay.

    w, shape (nb - 1 + n,), and y, shape (na + n,), begin with earlier samples and outputs.  The
    coefficients b_nb .. b_1 and a_na .. a_1 run from the oldest sample to the newest.
    """
    nb, na = b.size, a.size
    for start in range(0, y.size - na, STRETCH):
        # slices end with their arrays
        inputs = w[start : start + nb - 1 + STRETCH]
        outputs = y[start : start + na + STRETCH]
        _forward(inputs, b, outputs[na:])
        _backward(a, outputs)
        if _dies_away(outputs[na:]):
            _forward(inputs, b, outputs[na:])
            _backward_to_rest(a, outputs)


@ordered_kernel
def _forward(w: Array, b: Array, y: Array) -> None:
    y[:] = 0.0
    n, nb = y.size, b.size
    fours = nb - nb % 4
    # slices have no negative indices, which lets the compiler vectorise the loops
    for j in range(0, fours, 4):
        past = w[j : j + n + 3]
        b0, b1, b2, b3 = b[j], b[j + 1], b[j + 2], b[j + 3]
        for k in range(n):
            x = (y[k] + b0 * past[k]) + b1 * past[k + 1]
            y[k] = (x + b2 * past[k + 2]) + b3 * past[k + 3]
    for j in range(fours, nb):
        past = w[j : j + n]
        for k in range(n):
            y[k] += b[j] * past[k]


@ordered_kernel
def _backward(a: Array, y: Array) -> None:
    na, n = a.size, y.size - a.size
    if na == 0:
        return
    # four outputs side by side: an output waits for the outputs before it in three terms only
    whole = n - n % 4 if na > 3 else 0
    for k in range(0, whole, 4):
        new = y[k : k + na + 4]
        x0, x1, x2, x3 = new[na], new[na + 1], new[na + 2], new[na + 3]
        for i in range(na - 3):
            x0 -= a[i] * new[i]
            x1 -= a[i] * new[i + 1]
            x2 -= a[i] * new[i + 2]
            x3 -= a[i] * new[i + 3]
        a3, a2, a1 = a[na - 3], a[na - 2], a[na - 1]
        y3, y2, y1 = new[na - 3], new[na - 2], new[na - 1]
        x0 = ((x0 - a3 * y3) - a2 * y2) - a1 * y1
        x1 = ((x1 - a3 * y2) - a2 * y1) - a1 * x0
        x2 = ((x2 - a3 * y1) - a2 * x0) - a1 * x1
        x3 = ((x3 - a3 * x0) - a2 * x1) - a1 * x2
        new[na], new[na + 1], new[na + 2], new[na + 3] = x0, x1, x2, x3
    for k in range(whole, n):
        x = y[k + na]
        for i in range(na):
            x -= a[i] * y[k + i]
        y[k + na] = x


@ordered_kernel
def _dies_away(y: Array) -> bool:
    # a count over all samples vectorises; a search that stops at the first hit does not
    count = 0
    for k in range(y.size):
        count += (abs(y[k]) < STILL) & (y[k] != 0.0)
    return count > 0


@ordered_kernel
def _backward_to_rest(a: Array, y: Array) -> None:
    for k in range(a.size, y.size):
        x = y[k]
        for i in range(a.size):
            x -= a[i] * y[k - a.size + i]
        y[k] = alive(x)


@ordered_kernel
def cascade(
    v: Array,
    scale: Array,
    r: Array,
    q: Array,
    p1: float,
    p2: float,
    p0: float,
    low: float,
    c: Array,
    lags: Array,
    memory: Array,
    b: Array,
    a: Array,
    w: Array,
    y: Array,
    d: int,
    fraction: float,
    out: Array,
) -> None:
    """
    Pass a voltage v [V] through H, G and the delay to `out` [m], shapes (n,).

    `scale` is v0, V, y0 and Y.  Without rows of c, H is `hysteresis`, else `wide_hysteresis`; the
    `lags` are the rows of `relaxing`.  The memory of H holds its plays, then its lags.  The delay
    is d samples and a fraction.  w, shape (nb - 1 + k,), and y, shape (past + k,), hold the last
    outputs of H and G, and room for k new ones.  `past` is at least na, and above d.
    """
    v0, V, y0, Y = scale[0], scale[1], scale[2], scale[3]
    past_w = b.size - 1
    room = w.size - past_w
    past_y = y.size - room
    for start in range(0, v.size, room):
        new = out[start : start + room]
        n = new.size
        for k in range(n):
            new[k] = (v[start + k] - v0) / V
        if c.shape[0] == 0:
            hysteresis(new, r, q, p1, p2, memory[: r.size], w[past_w : past_w + n])
        else:
            wide_hysteresis(
                new, r, q, p1, p2, p0, low, c, memory[: r.size], w[past_w : past_w + n]
            )
        if lags.shape[0]:
            relaxing(new, lags, memory[r.size :], w[past_w : past_w + n])
        dynamics(w[: past_w + n], b, a, y[past_y - a.size : past_y + n])
        now, before = y[past_y - d :], y[past_y - d - 1 :]
        for k in range(n):
            x = now[k] if fraction == 0.0 else (1.0 - fraction) * now[k] + fraction * before[k]
            new[k] = y0 + Y * x
        # move from front to back, so that no sample is overwritten before it has moved
        for k in range(past_w):
            w[k] = w[n + k]
        for k in range(past_y):
            y[k] = y[n + k]

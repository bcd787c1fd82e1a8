# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""
The compiled loops of H, of G, and of both with the delay in one.

    w(k) = p1 v(k)^3 + p2 v(k) + sum_i q_i F_ri[v](k)                                (eqs. 1-3, 6)
    y(k) = sum_{j=1..nb} b_j w(k-j+1) - sum_{i=1..na} a_i y(k-i)                        (eqs. 4-5)

of Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868.  Both go four samples at a time.  In
G, four outputs are begun side by side with all that is known before the first of them; what they
owe each other is taken off afterwards:

    | y(k)   |   | 0                | | y(k)   |
    | y(k+1) | = | a1  0            | | y(k+1) | (-1)  +  what w and y(k-1), y(k-2), ... give
    | y(k+2) |   | a2  a1  0        | | y(k+2) |
    | y(k+3) |   | a3  a2  a1  0    | | y(k+3) |

Every sum of G runs from the oldest term to the newest, wherever a sample lies among its four, so
the result does not show where a stream was cut.

An output that has died away is zero (`piezo_ident.common.kernel.alive`): without that a stage at
rest would be ten times as slow to simulate as one that moves.

The loops share one file because a compiled loop is kept on disk until its own file changes: one
that calls a loop of another file would go on with what that was.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.kernel import alive, kernel, ordered_kernel, STILL

__all__ = ['advance', 'coefficients', 'dies_away', 'recursion', 'sum_of_plays']

#: samples whose sums stay in the cache
STRETCH = 1024

# an index without sign spares the test for one that counts from the end
ONE, TWO, THREE, FOUR = np.uintp(1), np.uintp(2), np.uintp(3), np.uintp(4)


@kernel
def sum_of_plays(
    v: NDArray[np.float64],
    r: NDArray[np.float64],
    q: NDArray[np.float64],
    p1: float,
    p2: float,
    memory: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """
    Write ``p1 v^3 + p2 v + sum_i q_i F_ri[v]`` into `out` and carry `memory` on.

    Parameters
    ----------
    v, out : ndarray, shape (n,)
    r, q, memory : ndarray, shape (m,)
    p1, p2 : float
    """
    # Four samples share one way through the memory.  At the end the last sample is repeated: a
    # play that sees the same voltage twice stays, and all samples take the same instructions.
    n, n_r = v.size, r.size
    for k in range(0, n, 4):
        x0 = v[k]
        x1 = v[k + 1] if k + 1 < n else x0
        x2 = v[k + 2] if k + 2 < n else x1
        x3 = v[k + 3] if k + 3 < n else x2
        w0, w1, w2, w3 = 0.0, 0.0, 0.0, 0.0
        for i in range(n_r):
            width, weight, f = r[i], q[i], memory[i]
            low = x0 - width
            f = x0 if f > x0 else f
            f = low if f < low else f
            w0 += weight * f
            low = x1 - width
            f = x1 if f > x1 else f
            f = low if f < low else f
            w1 += weight * f
            low = x2 - width
            f = x2 if f > x2 else f
            f = low if f < low else f
            w2 += weight * f
            low = x3 - width
            f = x3 if f > x3 else f
            f = low if f < low else f
            w3 += weight * f
            memory[i] = f
        out[k] = w0 + (p1 * x0 * x0 + p2) * x0
        if k + 1 < n:
            out[k + 1] = w1 + (p1 * x1 * x1 + p2) * x1
        if k + 2 < n:
            out[k + 2] = w2 + (p1 * x2 * x2 + p2) * x2
        if k + 3 < n:
            out[k + 3] = w3 + (p1 * x3 * x3 + p2) * x3


def coefficients(
    b: NDArray[np.float64], a: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """
    Return the coefficients as `recursion` reads them.

    Parameters
    ----------
    b : ndarray, shape (nb,)
        b_1 .. b_nb, at least one.
    a : ndarray, shape (na,)
        a_1 .. a_na, possibly none.

    Returns
    -------
    forward : ndarray, shape (nb,)
        b from the oldest sample to the newest.
    backward : ndarray, shape (4 na + 4,)
        For each earlier output, from the oldest to the newest, its four coefficients in y(k) ..
        y(k+3); then a_1, a_2, a_3.
    """
    na = a.size
    longer = np.zeros(na + 4)
    longer[:na] = a
    oldest_first = np.arange(na - 1, -1, -1)[:, None] + np.arange(4)
    last = longer[:4].copy()
    last[3] = 0.0
    return b[::-1].copy(), np.concatenate([longer[oldest_first].ravel(), last])


@ordered_kernel
def _forward(
    b: NDArray[np.float64], w: NDArray[np.float64], y: NDArray[np.float64], at: int, n: int
) -> None:
    # y[at + k] = sum_i b[i] w[k + i], four coefficients in each pass
    nb, start = np.uintp(b.size), np.uintp(at)
    fours = nb // FOUR
    for j in range(n):
        y[start + np.uintp(j)] = 0.0
    for four in range(fours):
        i = FOUR * np.uintp(four)
        b0, b1, b2, b3 = b[i], b[i + ONE], b[i + TWO], b[i + THREE]
        for j in range(n):
            k = np.uintp(j)
            first = (y[start + k] + b0 * w[k + i]) + b1 * w[k + i + ONE]
            y[start + k] = (first + b2 * w[k + i + TWO]) + b3 * w[k + i + THREE]
    for one in range(FOUR * fours, nb):
        i = np.uintp(one)
        b0 = b[i]
        for j in range(n):
            k = np.uintp(j)
            y[start + k] += b0 * w[k + i]


@ordered_kernel
def _backward(a: NDArray[np.float64], y: NDArray[np.float64], count: int, size: int) -> None:
    # y[na + k] -= sum_i a_i y[na + k - i]
    if not count:
        return
    na, n = np.uintp(count), np.uintp(size)
    whole = n - n % FOUR
    a1, a2, a3 = a[FOUR * na], a[FOUR * na + ONE], a[FOUR * na + TWO]
    for four in range(whole // FOUR):
        k = FOUR * np.uintp(four)
        y0, y1, y2, y3 = y[k + na], y[k + na + ONE], y[k + na + TWO], y[k + na + THREE]
        for earlier in range(na):
            i = np.uintp(earlier)
            past = y[k + i]
            y0 -= a[FOUR * i] * past
            y1 -= a[FOUR * i + ONE] * past
            y2 -= a[FOUR * i + TWO] * past
            y3 -= a[FOUR * i + THREE] * past
        y1 -= a1 * y0
        y2 -= a2 * y0
        y3 -= a3 * y0
        y2 -= a1 * y1
        y3 -= a2 * y1
        y3 -= a1 * y2
        y[k + na] = y0
        y[k + na + ONE] = y1
        y[k + na + TWO] = y2
        y[k + na + THREE] = y3
    for one in range(whole, n):
        k = np.uintp(one)
        y0 = y[k + na]
        for earlier in range(na):
            i = np.uintp(earlier)
            y0 -= a[FOUR * i] * y[k + i]
        y[k + na] = y0


@ordered_kernel
def dies_away(y: NDArray[np.float64], start: int, n: int) -> bool:
    """Return whether some of n outputs ought to be zero, and are not."""
    # counted, not looked for: that runs in vector lanes
    count = 0
    for k in range(start, start + n):
        x = y[np.uintp(k)]
        count += (abs(x) < STILL) & (x != 0.0)
    return count > 0


@ordered_kernel
def _backward_to_rest(
    a: NDArray[np.float64], y: NDArray[np.float64], count: int, size: int
) -> None:
    # the sums of `_backward`, one after the other; what has died away is zero to the next
    na = np.uintp(count)
    for sample in range(size):
        k = np.uintp(sample)
        y0 = y[k + na]
        for earlier in range(na):
            i = np.uintp(earlier)
            y0 -= a[FOUR * i] * y[k + i]
        y[k + na] = alive(y0)


@ordered_kernel
def recursion(
    b: NDArray[np.float64],
    a: NDArray[np.float64],
    w: NDArray[np.float64],
    y: NDArray[np.float64],
) -> None:
    """
    Continue y by the recursion.

    Parameters
    ----------
    b, a : ndarray
        From `coefficients`.
    w : ndarray, shape (nb - 1 + n,)
        Input, the earlier samples first.
    y : ndarray, shape (na + n,)
        Earlier outputs, and room for the new ones.
    """
    past_w, past_y = b.size - 1, (a.size - 4) // 4
    n = y.size - past_y
    for start in range(0, n, STRETCH):
        size = min(STRETCH, n - start)
        new_w, new_y = w[start : start + past_w + size], y[start:]
        _forward(b, new_w, new_y, past_y, size)
        _backward(a, new_y, past_y, size)
        if dies_away(new_y, past_y, size):
            _forward(b, new_w, new_y, past_y, size)
            _backward_to_rest(a, new_y, past_y, size)


@ordered_kernel
def advance(
    v: NDArray[np.float64],
    fixed: NDArray[np.float64],
    sizes: NDArray[np.int64],
    memory: NDArray[np.float64],
    w: NDArray[np.float64],
    y: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """
    Pass a stretch of the stream through H, G and z^-d, and carry the state on.

    `w` and `y` hold the past that G and the delay need, then room for the present.  It fills up
    over several calls; the past is moved to the front only when it is full.  Few arrays cross the
    border between Python and the kernel, for each costs as much as ten samples.
    """
    n_r, nb, na, d = sizes[0], sizes[1], sizes[2], sizes[3]
    past_w, past_y, at = sizes[4], sizes[5], sizes[6]
    v0, V, y0, Y = fixed[0], fixed[1], fixed[2], fixed[3]
    p1, p2, fraction = fixed[4], fixed[5], fixed[6]
    r, q = fixed[7 : 7 + n_r], fixed[7 + n_r : 7 + 2 * n_r]
    b, a = fixed[7 + 2 * n_r : 7 + 2 * n_r + nb], fixed[7 + 2 * n_r + nb :]
    room = w.size - past_w
    done = 0
    while done < v.size:
        if at == room:
            w[:past_w] = w[at : at + past_w].copy()
            y[:past_y] = y[at : at + past_y].copy()
            at = 0
        n = min(room - at, v.size - done)
        new = out[done : done + n]
        for k in range(n):
            new[k] = (v[done + k] - v0) / V
        sum_of_plays(new, r, q, p1, p2, memory, w[at + past_w : at + past_w + n])
        recursion(
            b, a, w[at + past_w - nb + 1 : at + past_w + n], y[at + past_y - na : at + past_y + n]
        )
        now = at + past_y - d
        if fraction == 0.0:
            for k in range(n):
                new[k] = y0 + Y * y[now + k]
        else:
            for k in range(n):
                new[k] = y0 + Y * ((1.0 - fraction) * y[now + k] + fraction * y[now + k - 1])
        at += n
        done += n
    sizes[6] = at

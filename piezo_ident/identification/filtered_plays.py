# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The columns of step 3, ``G F_r``, averaged into rows: four thresholds side by side.

    F_r[v](k) = max(v(k) - r, min(v(k), F_r[v](k-1)))                                  (eqs. 1-2)
    y(k) = sum_{j=1..nb} b_j w(k-j+1) - sum_{i=1..na} a_i y(k-i)                        (eqs. 4-5)

of Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868.  What lies between voltage and rows
never leaves the cache.  Numbers of four columns lie next to each other, so that one instruction
serves all four; each sum runs from the oldest term to the newest, as in
`piezo_ident.operators.kernels`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.kernel import alive, ordered_kernel, STILL
from piezo_ident.operators.dynamics import Dynamics

__all__ = ['filtered_plays']

#: samples between two looks at the rows
STRETCH = 256

# an index without sign spares the test for one that counts from the end
ONE, TWO, THREE, FOUR = np.uintp(1), np.uintp(2), np.uintp(3), np.uintp(4)


@ordered_kernel
def _play(
    v: NDArray[np.float64], r: NDArray[np.float64], f: NDArray[np.float64], w: NDArray[np.float64]
) -> None:
    # f: the four plays before the first sample, and after the last
    f0, f1, f2, f3 = f[0], f[1], f[2], f[3]
    r0, r1, r2, r3 = r[0], r[1], r[2], r[3]
    for sample in range(v.size):
        k = np.uintp(sample)
        x = v[k]
        f0 = x if f0 > x else f0
        f1 = x if f1 > x else f1
        f2 = x if f2 > x else f2
        f3 = x if f3 > x else f3
        f0 = x - r0 if f0 < x - r0 else f0
        f1 = x - r1 if f1 < x - r1 else f1
        f2 = x - r2 if f2 < x - r2 else f2
        f3 = x - r3 if f3 < x - r3 else f3
        w[FOUR * k] = f0
        w[FOUR * k + ONE] = f1
        w[FOUR * k + TWO] = f2
        w[FOUR * k + THREE] = f3
    f[0], f[1], f[2], f[3] = f0, f1, f2, f3


@ordered_kernel
def _forward(
    b: NDArray[np.float64], w: NDArray[np.float64], y: NDArray[np.float64], n: int
) -> None:
    # b and a from the oldest sample to the newest; w and y: the past first
    nb, new = np.uintp(b.size), y[: 4 * n]
    new[:] = 0.0
    pairs = nb // TWO
    for pair in range(pairs):
        j = TWO * np.uintp(pair)
        b0, b1 = b[j], b[j + ONE]
        for lane in range(new.size):
            k = np.uintp(lane)
            new[k] = (new[k] + b0 * w[FOUR * j + k]) + b1 * w[FOUR * j + FOUR + k]
    if nb % TWO:
        j = nb - ONE
        b0 = b[j]
        for lane in range(new.size):
            k = np.uintp(lane)
            new[k] += b0 * w[FOUR * j + k]


@ordered_kernel
def _backward(a: NDArray[np.float64], y: NDArray[np.float64], n: int) -> None:
    na = np.uintp(a.size)
    for sample in range(n):
        k = FOUR * np.uintp(sample)
        now = k + FOUR * na
        y0, y1, y2, y3 = y[now], y[now + ONE], y[now + TWO], y[now + THREE]
        for earlier in range(na):
            i = k + FOUR * np.uintp(earlier)
            weight = a[np.uintp(earlier)]
            y0 -= weight * y[i]
            y1 -= weight * y[i + ONE]
            y2 -= weight * y[i + TWO]
            y3 -= weight * y[i + THREE]
        y[now] = y0
        y[now + ONE] = y1
        y[now + TWO] = y2
        y[now + THREE] = y3


@ordered_kernel
def _dies_away(y: NDArray[np.float64], start: int, n: int) -> bool:
    # counted, not looked for: that runs in vector lanes
    count = 0
    for k in range(start, start + n):
        x = y[np.uintp(k)]
        count += (abs(x) < STILL) & (x != 0.0)
    return count > 0


@ordered_kernel
def _backward_to_rest(a: NDArray[np.float64], y: NDArray[np.float64], n: int) -> None:
    # the same, number by number; what has died away is zero to the next
    na = np.uintp(a.size)
    for number in range(4 * n):
        k = np.uintp(number)
        y0 = y[k + FOUR * na]
        for earlier in range(na):
            i = np.uintp(earlier)
            y0 -= a[i] * y[k + FOUR * i]
        y[k + FOUR * na] = alive(y0)


@ordered_kernel
def _four_columns(
    v: NDArray[np.float64],
    r: NDArray[np.float64],
    memory: NDArray[np.float64],
    b: NDArray[np.float64],
    a: NDArray[np.float64],
    gain: float,
    stretches: NDArray[np.int64],
    row: int,
    out: NDArray[np.float64],
) -> None:
    # averages never reach across a hole in the mask; the last incomplete row is left out
    past_w, past_y = 4 * (b.size - 1), 4 * a.size
    w, y = np.empty(past_w + 4 * STRETCH), np.empty(past_y + 4 * STRETCH)
    f = memory.copy()
    _play(v[:1], r, f, w)
    for i in range(past_w):
        w[i] = f[i % 4]
    for i in range(past_y):
        y[i] = gain * f[i % 4]
    share = 1.0 / np.sqrt(row)
    total, count, place, m = np.zeros(4), 0, 0, 0
    for start in range(0, v.size, STRETCH):
        n = min(STRETCH, v.size - start)
        _play(v[start : start + n], r, f, w[past_w:])
        _forward(b, w, y[past_y:], n)
        _backward(a, y, n)
        if _dies_away(y, past_y, 4 * n):
            _forward(b, w, y[past_y:], n)
            _backward_to_rest(a, y, n)
        at = start
        while at < start + n and m < stretches.shape[0]:
            if at >= stretches[m, 1]:
                m += 1
                count, total[:] = 0, 0.0
                continue
            if at < stretches[m, 0]:
                at = min(stretches[m, 0], start + n)
                continue
            stop = min(stretches[m, 1], start + n, at + row - count)
            t0, t1, t2, t3 = total[0], total[1], total[2], total[3]
            for sample in range(at - start, stop - start):
                k = np.uintp(past_y) + FOUR * np.uintp(sample)
                t0 += y[k]
                t1 += y[k + ONE]
                t2 += y[k + TWO]
                t3 += y[k + THREE]
            total[0], total[1], total[2], total[3] = t0, t1, t2, t3
            count += stop - at
            at = stop
            if count == row:
                for i in range(4):
                    out[i, place] = share * total[i]
                count, total[:] = 0, 0.0
                place += 1
        w[:past_w] = w[4 * n : past_w + 4 * n].copy()
        y[:past_y] = y[4 * n : past_y + 4 * n].copy()


def filtered_plays(
    v: NDArray[np.float64],
    thresholds: NDArray[np.float64],
    memory: NDArray[np.float64],
    dynamics: Dynamics,
    stretches: NDArray[np.int64],
    row: int,
) -> NDArray[np.float64]:
    """
    Return every play, filtered and averaged.

    Parameters
    ----------
    v : ndarray, shape (n,)
        Normalised voltage, already delayed; G starts in equilibrium with the first sample.
    thresholds, memory : ndarray, shape (m,)
        Thresholds r >= 0, of which r = 0 gives v itself, and the plays before the first sample.
    dynamics : Dynamics
        G.
    stretches : ndarray of int, shape (k, 2)
        Start and stop of what counts, in growing order.
    row : int
        Samples of a row, whose mean times ``sqrt(row)`` is returned.

    Returns
    -------
    ndarray, shape (m, rows)
    """
    lanes = 4 * -(-thresholds.size // 4)
    r, f = np.zeros(lanes), np.zeros(lanes)
    r[: thresholds.size], f[: thresholds.size] = thresholds, memory
    rows = int(np.sum((stretches[:, 1] - stretches[:, 0]) // row))
    out = np.empty((lanes, rows))
    b, a = dynamics.b[::-1].copy(), dynamics.a[::-1].copy()
    for i in range(0, lanes, 4):
        four = slice(i, i + 4)
        _four_columns(v, r[four], f[four], b, a, dynamics.gain, stretches, row, out[four])
    return out[: thresholds.size]

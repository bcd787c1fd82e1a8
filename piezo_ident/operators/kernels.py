# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The compiled loops of H, of G, and of both with the delay in one.

    F_r[v](k) = max(v(k) - r, min(v(k), F_r[v](k-1)))                                  (eqs. 1-2)
    w(k) = p1 v(k)^3 + p2 v(k) + sum_i q_i F_ri[v](k)                                 (eqs. 3, 6)
    y(k) = sum_{j=1..nb} b_j w(k-j+1) - sum_{i=1..na} a_i y(k-i)                      (eqs. 4-5)

of Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868.

Every sum runs from the oldest term to the newest wherever a sample stands, so the result does not
depend on how a stream is cut.  An output of G that has died away is zero
(`piezo_ident.common.kernel.alive`): without that a stage at rest is 17 times as slow to simulate
as one that moves.  The loops share one file because a compiled loop is kept on disk until its own
file changes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.kernel import alive, kernel, ordered_kernel

__all__ = ['cascade', 'dynamics', 'held', 'hysteresis', 'plays']

#: samples that pass the loops while they are in the cache
STRETCH = 512


@ordered_kernel
def held(f: float, low: float, high: float) -> float:
    """Return max(low, min(high, f)): a play moves only as far as its bounds demand."""
    # comparisons, not max() and min(), whose rules for NaN would keep loops from vectorising
    f = high if f > high else f
    return low if f < low else f


@kernel
def plays(
    v: NDArray[np.float64],
    r: NDArray[np.float64],
    memory: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Write F_r[v] of every threshold into `out`, shape (m, n), and carry `memory` on."""
    for i in range(r.size):
        f = memory[i]
        for k in range(v.size):
            f = held(f, v[k] - r[i], v[k])
            out[i, k] = f
        memory[i] = f


@kernel
def hysteresis(
    v: NDArray[np.float64],
    r: NDArray[np.float64],
    q: NDArray[np.float64],
    p1: float,
    p2: float,
    memory: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Write w of eqs. (3) and (6) into `out`, shape (n,), and carry `memory` on."""
    for k in range(v.size):
        x, w = v[k], 0.0
        for i in range(r.size):
            f = held(memory[i], x - r[i], x)
            memory[i] = f
            w += q[i] * f
        out[k] = w + (p1 * x * x + p2) * x


@ordered_kernel
def dynamics(
    w: NDArray[np.float64],
    b: NDArray[np.float64],
    a: NDArray[np.float64],
    y: NDArray[np.float64],
) -> None:
    """
    Continue y by eqs. (4) and (5), without the delay.

    Parameters
    ----------
    w : ndarray, shape (nb - 1 + n,)
        Input, the earlier samples first.
    b, a : ndarray, shape (nb,) and (na,)
        Coefficients from the oldest sample to the newest: b_nb .. b_1 and a_na .. a_1.
    y : ndarray, shape (na + n,)
        Earlier outputs, and room for the new ones.
    """
    nb, na = b.size, a.size
    for k in range(y.size - na):
        x = 0.0
        for j in range(nb):
            x += b[j] * w[k + j]
        for i in range(na):
            x -= a[i] * y[k + i]
        y[k + na] = alive(x)


@ordered_kernel
def cascade(
    v: NDArray[np.float64],
    scale: NDArray[np.float64],
    r: NDArray[np.float64],
    q: NDArray[np.float64],
    p1: float,
    p2: float,
    memory: NDArray[np.float64],
    b: NDArray[np.float64],
    a: NDArray[np.float64],
    past_w: NDArray[np.float64],
    past_y: NDArray[np.float64],
    d: int,
    fraction: float,
    out: NDArray[np.float64],
) -> None:
    """
    Pass a voltage through H, G and the delay, and carry their states on.

    Parameters
    ----------
    v, out : ndarray, shape (n,)
        [V] and [m].
    scale : ndarray, shape (4,)
        v0, V, y0 and Y.
    r, q, p1, p2, memory
        As in `hysteresis`.
    b, a
        As in `dynamics`.
    past_w : ndarray, shape (nb - 1,)
        Last outputs of H.
    past_y : ndarray, shape (k,), k >= na, k > d
        Last outputs of G.
    d, fraction : int and float
        The delay [samples].
    """
    v0, V, y0, Y = scale[0], scale[1], scale[2], scale[3]
    nw, ny = past_w.size, past_y.size
    room = min(v.size, max(STRETCH, ny))
    w, y = np.empty(nw + room), np.empty(ny + room)
    w[:nw], y[:ny] = past_w, past_y
    for start in range(0, v.size, room):
        new = out[start : start + room]
        n = new.size
        for k in range(n):
            new[k] = (v[start + k] - v0) / V
        hysteresis(new, r, q, p1, p2, memory, w[nw : nw + n])
        dynamics(w[: nw + n], b, a, y[ny - a.size : ny + n])
        now = ny - d
        for k in range(n):
            x = y[now + k]
            if fraction != 0.0:
                x = (1.0 - fraction) * x + fraction * y[now + k - 1]
            new[k] = y0 + Y * x
        w[:nw], y[:ny] = w[n : n + nw].copy(), y[n : n + ny].copy()
    past_w[:], past_y[:] = w[:nw], y[:ny]

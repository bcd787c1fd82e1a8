# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a fit of G takes for dynamics and is none: slow real poles, and pairs below the modes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.operators.dynamics import Dynamics

__all__ = ['fast_part', 'without_pairs', 'without_slow_part']

#: real poles below this are creep or what H lacks, never dynamics [Hz]
SLOWEST = 40.0
#: at low sampling rates, as a share of the rate
SLOWEST_SHARE = 0.01
#: a real pole and a real zero whose frequencies differ by less than this factor may be what H
#: lacks of small motion, below this share of the frequency of the lowest mode that rings (damping)
PAIR, BELOW_MODES, RINGS = 4.0 / 3.0, 1.0 / 3.0, 0.3


def without_slow_part(G: Dynamics, rate: float) -> Dynamics | None:
    """Return G with G(1) = 1 and without its slow real poles; None where slow poles stay."""
    slowest = min(SLOWEST, SLOWEST_SHARE * rate)
    poles = G.poles
    size = -np.log(np.maximum(np.abs(poles), 1e-300)) * rate / (2.0 * np.pi)
    slow = np.hypot(size, np.angle(poles) * rate / (2.0 * np.pi)) < slowest
    if not slow.any():
        return G.normalised()
    if np.any(poles[slow].imag != 0.0):
        return None
    faster = G.without_slow_poles(slowest, rate)
    return faster.normalised() if faster.a.size < G.a.size else None


def fast_part(G: Dynamics, rate: float, lean: bool = False) -> Dynamics:
    """Return G with G(1) = 1, without slow real poles where it can; `lean`, without pairs too."""
    G = without_pairs(G, rate) if lean else G
    return without_slow_part(G, rate) or G.normalised()


def without_pairs(G: Dynamics, rate: float) -> Dynamics:
    """
    Return G without pairs of a real pole and a near real zero far below its modes.

    Small loops that open less than H says make such a pair, and so does hysteresis that depends on
    the rate.
    """
    rings = [mode.frequency for mode in G.modes(rate) if mode.damping < RINGS]
    poles, zeros = np.asarray(G.poles, dtype=complex), np.asarray(np.roots(G.b), dtype=complex)
    highest = BELOW_MODES * min(rings, default=0.0)
    for pole in sorted(poles[_between(poles, 0.0, highest, rate)].real, reverse=True):
        size = -np.log(pole) * rate / (2.0 * np.pi)
        near = np.flatnonzero(_between(zeros, size / PAIR, size * PAIR, rate))
        if near.size:
            zeros = np.delete(zeros, near[np.argmin(np.abs(zeros[near] - pole))])
            poles = np.delete(poles, np.argmin(np.abs(poles - pole)))
    if poles.size == G.a.size:
        return G
    a, b = (np.atleast_1d(np.real(np.poly(roots))) for roots in (poles, zeros))
    return Dynamics(a[1:], b * G.gain * a.sum() / b.sum())


def _between(
    roots: NDArray[np.complex128], low: float, high: float, rate: float
) -> NDArray[np.bool_]:
    """Return the real roots that decay, with frequencies between two [Hz]."""
    ends = np.exp(-2.0 * np.pi * np.array([high, low]) / rate)
    return np.asarray((roots.imag == 0.0) & (roots.real > ends[0]) & (roots.real < ends[1]))

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Remove poles of G that do not belong to the dynamics: slow real poles, pairs below the modes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.operators.dynamics import Dynamics

#: real poles below this frequency come from creep or from errors of H, not from dynamics [Hz]
SLOWEST = 40.0
#: same limit at low sampling rates, as a share of the rate
SLOWEST_SHARE = 0.01
#: a pole and a zero whose frequencies differ by less than the factor `PAIR` may come from errors
#: of H on small motion, if they lie below the share `BELOW_MODES` of the lowest mode that rings; a
#: mode rings if its damping is below `RINGS`
PAIR, BELOW_MODES, RINGS = 4.0 / 3.0, 1.0 / 3.0, 0.3


def without_slow_part(G: Dynamics, rate: float) -> Dynamics | None:
    """Remove the slow real poles of G, with G(1) = 1; None if a slow pole cannot be removed."""
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


def fast_part(G: Dynamics, rate: float, lean: bool) -> Dynamics:
    """Normalise G to G(1) = 1, without removable slow poles; `lean` removes pairs as well."""
    G = without_pairs(G, rate) if lean else G
    return without_slow_part(G, rate) or G.normalised()


def without_pairs(G: Dynamics, rate: float) -> Dynamics:
    """
    Remove decaying poles far below the modes of G, each with a zero of nearly its frequency.

    Such a pair arises if small loops open less than H predicts, or if the hysteresis depends on
    the rate.  Least squares may also place two such poles off the real axis, strongly damped.
    """
    rings = [mode.frequency for mode in G.modes(rate) if mode.damping < RINGS]
    highest = BELOW_MODES * min(rings, default=0.0)
    poles, zeros = (np.asarray(roots, dtype=complex) for roots in (G.poles, np.roots(G.b)))
    for pole in sorted(poles[_decaying(poles, 0.0, highest, rate)], key=abs, reverse=True):
        size = float(_size(pole, rate))
        near = np.flatnonzero(_decaying(zeros, size / PAIR, size * PAIR, rate))
        # a conjugate pair of poles goes with a conjugate pair of zeros
        count = 1 if pole.imag == 0.0 else 2
        chosen = near[np.argsort(np.abs(zeros[near] - pole))][:count]
        if pole.imag < 0.0 or chosen.size < count or abs(zeros[chosen].sum().imag) > 1e-9:
            continue
        zeros = np.delete(zeros, chosen)
        poles = poles[~np.isin(poles, (pole, pole.conjugate()))]
    if poles.size == G.a.size:
        return G
    a, b = (np.atleast_1d(np.real(np.poly(roots))) for roots in (poles, zeros))
    return Dynamics(a[1:], b * G.gain * a.sum() / b.sum())


def _size(roots: ArrayLike, rate: float) -> Array:
    """Compute the natural frequencies of roots [Hz]."""
    z = np.asarray(roots, dtype=complex)
    return np.asarray(np.abs(np.log(np.where(z == 0.0, 1e-300, z))) * rate / (2.0 * np.pi))


def _decaying(roots: NDArray[np.complex128], low: float, high: float, rate: float) -> Mask:
    """Mark the roots that do not ring, with frequencies between two limits [Hz]."""
    size = _size(roots, rate)
    decay = -np.log(np.maximum(np.abs(roots), 1e-300)) * rate / (2.0 * np.pi)
    return np.asarray((size > low) & (size < high) & (decay > RINGS * size))

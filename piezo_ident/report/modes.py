# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The poles of G as modes with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray
from piezo_ident.operators.dynamics import Dynamics

__all__ = ['Mode', 'modes']


@dataclass(frozen=True)
class Mode:
    """
    A pole of G, or a pair of them, in continuous time.

    Attributes
    ----------
    frequency, frequency_std : float
        Natural frequency, or corner frequency of a real pole [Hz].
    damping, damping_std : float
        Damping ratio; 1 for a real pole.
    oscillates : bool
        Whether it is a pair.
    """

    frequency: float
    frequency_std: float
    damping: float
    damping_std: float
    oscillates: bool


def modes(dynamics: Dynamics, sample_rate: float, covariance: NDArray[np.float64]) -> list[Mode]:
    """
    Return the poles of G as modes, with the uncertainty that follows from that of a_1 .. a_na.

    Parameters
    ----------
    dynamics : Dynamics
    sample_rate : float
        [Hz]
    covariance : ndarray
        Of (a, b); the block of a is used.

    Notes
    -----
    To first order, a change of a_i moves a pole p by ``-p^(na-i) / A'(p)``.  Poles at zero and on
    the negative real axis are no modes of a sampled motion and are left out.
    """
    a = np.concatenate([[1.0], dynamics.a])
    na = dynamics.a.size
    slope = np.polyder(a) if na else np.zeros(1)
    block = covariance[:na, :na] if covariance.shape[0] >= na else np.full((na, na), np.nan)
    rate = sample_rate / (2.0 * math.pi)
    result = []
    for pole in dynamics.poles:
        if pole.imag < 0.0 or (pole.imag == 0.0 and pole.real <= 0.0):
            continue
        s = np.log(pole)
        ds = -(pole ** np.arange(na - 1, -1, -1)) / np.polyval(slope, pole) / pole
        size = abs(s)
        d_size = np.real(np.conj(s) * ds) / size
        d_damping = -ds.real / size + s.real * d_size / size**2
        std = [math.sqrt(max(float(d @ block @ d), 0.0)) for d in (d_size, d_damping)]
        pair = pole.imag != 0.0
        result.append(
            Mode(rate * size, rate * std[0], -s.real / size, std[1] if pair else 0.0, pair)
        )
    return sorted(result, key=lambda mode: mode.frequency)

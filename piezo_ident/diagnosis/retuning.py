# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Retune G by a factor near one."""

from __future__ import annotations

from collections.abc import Sequence
import functools

import numpy as np
from piezo_ident.operators.dynamics import Dynamics

#: corner frequencies of the relaxations in a retuned G [Hz]
RELAXATIONS = (15.0, 100.0)
#: bounds of the retuning: samples of delay, their squares, and two relaxations (approximate units)
RETUNING = (20.0, 800.0, 1.0, 1.0)
#: a retuned G follows its law up to this multiple of the highest driven frequency
BEYOND = 4.0
#: largest relative error of the product of G and its factor by rounding
ROUNDING = 1e-4


@functools.lru_cache(maxsize=64)
def retuning_factor(
    retuning: tuple[float, ...], sample_rate: float, band: float = np.inf
) -> Dynamics:
    """
    Compute the factor of G.

    The factor is ``1 + c_1 D + c_2 D^2 + sum_j c_j (1 - z^-1) / (1 - p_j z^-1)`` with p_j the
    poles of `RELAXATIONS`: a delay, a roll-off, and relaxations.  D is ``1 - z^-1`` up to the band
    [Hz].  Beyond this band the data hold no motion, and D stays constant.  The factor is 1 at
    rest, and c_1 acts like minus a delay in samples at low frequencies.
    """
    c1, c2, c3, c4 = retuning
    D = np.array([1.0, -1.0])
    p = float(np.exp(-2.0 * np.pi * band / sample_rate))
    P, Q = (np.array([1.0, -np.exp(-2.0 * np.pi * f / sample_rate)]) for f in RELAXATIONS)
    limited, B = (1.0 - p) * D, np.array([1.0, -p])
    BB, PQ = np.convolve(B, B), np.convolve(P, Q)
    terms = (
        np.convolve(BB, PQ),
        c1 * np.convolve(np.convolve(limited, B), PQ),
        c2 * np.convolve(np.convolve(limited, limited), PQ),
        c3 * np.convolve(np.convolve(Q, D), BB),
        c4 * np.convolve(np.convolve(P, D), BB),
    )
    factor = np.sum([np.pad(term, (0, 5 - term.size)) for term in terms], axis=0)
    return Dynamics(a=np.convolve(BB, PQ)[1:], b=factor)


def retuned(
    dynamics: Dynamics, retuning: Sequence[float], sample_rate: float, band: float = np.inf
) -> Dynamics:
    """
    Multiply G by its factor; G alone if the product is unstable or loses digits.

    The factor adds four poles near 1.  A G of high order at a high sampling rate leaves too few
    digits for them.
    """
    if not any(retuning):
        return dynamics
    factor = retuning_factor(tuple(retuning), sample_rate, band)
    a = np.convolve([1.0, *dynamics.a], [1.0, *factor.a])[1:]
    product = Dynamics(a=a, b=np.convolve(dynamics.b, factor.b))
    f = np.geomspace(1e-5, 0.4, 60) * sample_rate
    exact = dynamics.response(f, sample_rate) * factor.response(f, sample_rate)
    lost = np.abs(product.response(f, sample_rate) - exact).max() / np.abs(exact).max()
    return product if lost < ROUNDING and product.is_stable else dynamics

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Compute spectra of two signals, and the coherence of voltage and residual with a bound."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.residual.stretches import ResidualPart
from scipy import fft, signal

#: number of samples that are transformed at once
TOGETHER = 1 << 18
#: confidence of the bound
CONFIDENCE = 0.99
#: number of averages of a coherence, and longest segment [samples]
AVERAGES, SEGMENT = 32, 8192
#: least density of an input, as a share of its largest density
EXCITED = 1e-7
#: independent averages in each Hann segment that overlaps by half
OVERLAP = 1.0 / 1.056


@dataclass(frozen=True, eq=False)
class Coherence:
    """
    Coherence ``|S_ve|^2 / (S_vv S_ee)`` of voltage and residual over frequency [Hz], shapes (p,).

    `tested` are the frequencies at which the voltage has power.  The bound is
    ``1 - (1 - c)^(1/(L - 1))`` of L independent averages: unrelated signals stay below it in a
    share c of cases.  `share` is the coherent share of the residual's power, without bias.
    """

    frequency: Array
    coherence: Array
    tested: Mask
    bound: float
    share: float


def cross_spectra(
    u: Array, y: Array, size: int, *, linear: bool = True
) -> tuple[Array, Array, NDArray[np.complex128]]:
    """
    Sum the spectra of two signals by Welch's method: S_uu, S_yy and S_uy.

    The Hann segments of `size` samples overlap by half.  Each loses its linear trend, or without
    `linear` its mean.  The sums, shape (size // 2 + 1,), have no unit: only their ratios count.
    """
    window, step = signal.get_window('hann', size), size - size // 2
    segments = [np.lib.stride_tricks.sliding_window_view(x, size)[::step] for x in (u, y)]
    s_uu, s_yy = np.zeros((2, size // 2 + 1))
    s_uy = np.zeros(size // 2 + 1, dtype=np.complex128)
    rows = max(1, TOGETHER // size)
    for start in range(0, len(segments[0]), rows):
        U, Y = (fft.rfft(window * _detrended(x[start : start + rows], linear)) for x in segments)
        s_uu += np.sum(np.abs(U) ** 2, axis=0)
        s_yy += np.sum(np.abs(Y) ** 2, axis=0)
        s_uy += np.sum(np.conj(U) * Y, axis=0)
    return s_uu, s_yy, s_uy


def _detrended(x: Array, linear: bool) -> Array:
    # as `scipy.signal.detrend`, without a least-squares problem for each segment
    x = x - x.mean(axis=-1, keepdims=True)
    t = np.arange(x.shape[-1]) - 0.5 * (x.shape[-1] - 1)
    slope = (x @ t)[..., None] / max(float(t @ t), 1.0)
    return np.asarray(x - slope * t) if linear else x


def coherence(parts: Sequence[ResidualPart]) -> Coherence | None:
    """
    Compute the coherence of voltage and residual by Welch's method; None for short records.

    Parts at the rate with most samples count.  Bendat and Piersol, Random Data, 4th ed. (2010),
    section 9.2, doi:10.1002/9781118032428.
    """
    rates: Counter[float] = Counter()
    for part in parts:
        rates[part.piece.sample_rate] += part.piece.n
    rate = max(rates, key=rates.__getitem__, default=1.0)
    chosen = [p for p in parts if abs(p.piece.sample_rate / rate - 1.0) < 1e-6]
    runs = [(p, a, b) for p in chosen for a, b in p.runs()]
    total = sum(b - a for _, a, b in runs)
    if total < 256:
        return None
    n = min(int(2 ** np.floor(np.log2(max(64, 2 * total // AVERAGES)))), SEGMENT)
    long = [(p.piece.v[a:b], p.e[a:b]) for p, a, b in runs if b - a >= n]
    count = sum(1 + (v.size - n) // (n // 2) for v, _ in long)
    if count < 4:
        return None
    vv, ee, ve = (sum(x) for x in zip(*(cross_spectra(v, e, n) for v, e in long), strict=True))
    averages = max(2.0, count * OVERLAP)
    tiny = np.finfo(float).tiny
    c = np.clip(np.abs(ve) ** 2 / np.maximum(vv * ee, tiny), 0.0, 1.0)
    tested = vv > EXCITED * float(vv.max())
    # detrending leaves little in the first bins
    tested[:2] = False
    bound = 1.0 - (1.0 - CONFIDENCE) ** (1.0 / (averages - 1.0))
    unbiased = np.clip((c - 1.0 / averages) / (1.0 - 1.0 / averages), 0.0, 1.0)
    power = float(ee[2:].sum())
    coherent = float(np.sum((unbiased * ee)[tested & (c > bound)]))
    return Coherence(
        frequency=np.arange(n // 2 + 1) * rate / n,
        coherence=c,
        tested=tested,
        bound=float(bound),
        share=coherent / power if power > 0.0 else 0.0,
    )

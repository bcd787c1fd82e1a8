# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Whether a residual follows the input: cross-correlation and coherence, with honest bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.residual.stretches import block_means, ResidualPart
from scipy import fft, linalg, signal, stats

__all__ = ['Coherence', 'CrossCorrelation', 'coherence', 'cross_correlation']

Array = NDArray[np.float64]

#: samples after averaging, at most; lags looked at; highest order of the noise model
SAMPLES, LAGS, ORDER = 2**17, 200, 40
#: confidence of bands and bounds
CONFIDENCE = 0.99
#: averages asked of a coherence, longest segment [samples]
AVERAGES, SEGMENT = 32, 8192
#: share of the input's largest density below which there is no input to cohere with
EXCITED = 1e-7
#: independent averages in one that overlaps by half, with a Hann window
OVERLAP = 1.0 / 1.056


@dataclass(frozen=True, eq=False)
class CrossCorrelation:
    """
    Cross-correlation of an input ('v' or 'dv/dt') with a residual that follows it by lags [s].

    Unrelated signals stay within `band`, shape (m,), at all lags together in 99 % of cases.
    """

    input: str
    lag: Array
    correlation: Array
    band: Array


@dataclass(frozen=True, eq=False)
class Coherence:
    """
    Coherence of voltage and residual.

    Attributes
    ----------
    frequency, coherence : ndarray, shape (p,)
        [Hz], and ``|S_ve|^2 / (S_vv S_ee)``.
    tested : ndarray of bool, shape (p,)
        Frequencies at which the voltage has power.
    bound : float
        ``1 - (1 - c)^(1/(L - 1))`` of L independent averages: unrelated signals stay below it in
        a share c of cases.
    share : float
        Share of the residual's power that is coherent with the voltage, bias taken away.
    """

    frequency: Array
    coherence: Array
    tested: NDArray[np.bool_]
    bound: float
    share: float


def _chosen(parts: Sequence[ResidualPart]) -> tuple[list[ResidualPart], float]:
    """Return the parts of the rate at which most was sampled."""
    rates: dict[float, int] = {}
    for part in parts:
        rates[part.piece.sample_rate] = rates.get(part.piece.sample_rate, 0) + part.piece.n
    if not rates:
        return [], 1.0
    rate = max(rates, key=lambda r: rates[r])
    return [p for p in parts if abs(p.piece.sample_rate / rate - 1.0) < 1e-6], rate


def _blocks(parts: Sequence[ResidualPart]) -> int:
    return max(1, -(-sum(part.piece.n for part in parts) // SAMPLES))


def _products(x: Array, y: Array, lags: int) -> Array:
    """Return ``sum_t x(t) y(t + k)`` for k = -lags .. lags, shape (2 lags + 1,)."""
    size = fft.next_fast_len(x.size + lags + 1, real=True)
    c = fft.irfft(np.conj(fft.rfft(x, size)) * fft.rfft(y, size), size)
    return np.concatenate([c[-lags:], c[: lags + 1]])


def cross_correlation(
    parts: Sequence[ResidualPart], which: str = 'v', lags: int = LAGS
) -> CrossCorrelation | None:
    """
    Return the cross-correlation of an input with the residual, and its band.

    The variance of ``sum_t u(t) e(t + k)`` for a given u and an unrelated e of autocovariance g
    is ``sum_j g(j) sum_t u(t) u(t + j)``, Bartlett's formula with the input as it was.  A band
    for white residuals, 2.58 / sqrt(N), would be too narrow by far.  g comes from an
    autoregression, so that slow residuals do not need lags without end.

    `which` is 'v' or 'dv/dt'; lags go to either side, in samples after averaging to about 1e5.
    None when there is too little to correlate.

    Notes
    -----
    Bartlett (1946), J. R. Stat. Soc. Suppl. 8, 27-41, doi:10.2307/2983611; Box, Jenkins and
    Reinsel, Time Series Analysis, 5th ed. (2015), section 12.1.
    """
    chosen, rate = _chosen(parts)
    m = _blocks(chosen)
    products = np.zeros(2 * lags + 1)
    variance = uu = ee = 0.0
    for part in chosen:
        for start, stop in part.runs():
            v = block_means(part.piece.v[start:stop], m)
            u = np.gradient(v) if which == 'dv/dt' and v.size > 2 else v
            e = block_means(part.e[start:stop], m)
            if u.size <= 4 * lags:
                continue
            u, e = u - u.mean(), e - e.mean()
            products += _products(u, e, lags)
            variance += _unrelated(u, e)
            uu, ee = uu + float(u @ u), ee + float(e @ e)
    if uu <= 0.0 or ee <= 0.0:
        return None
    scale = np.sqrt(uu * ee)
    std = np.sqrt(variance) / scale
    r = products / scale
    # lags are not independent, so counting each errs on the safe side
    wide = float(stats.norm.isf(0.5 * (1.0 - CONFIDENCE) / r.size)) * std
    return CrossCorrelation(
        input=which,
        lag=np.arange(-lags, lags + 1) * m / rate,
        correlation=r,
        band=np.full(r.size, wide),
    )


def _unrelated(u: Array, e: Array) -> float:
    """Return the variance of ``sum u e`` if e had nothing to do with u."""
    a, innovation = _autoregression(e)
    size = fft.next_fast_len(2 * u.size, real=True)
    # the density of e on the grid of u's transform; Parseval turns the sum over lags into one
    response = np.abs(fft.rfft(np.concatenate([[1.0], a]), size)) ** 2
    power = np.abs(fft.rfft(u, size)) ** 2 / response
    whole = 2.0 * power.sum() - power[0] - (power[-1] if size % 2 == 0 else 0.0)
    return float(innovation * whole / size)


def _autoregression(e: Array) -> tuple[Array, float]:
    """Return the coefficients and innovation variance of e by Levinson's recursion and BIC."""
    order = min(ORDER, e.size // 20)
    c = _products(e, e, order)[order:] / e.size
    if c[0] <= 0.0:
        return np.zeros(0), 0.0
    best, chosen = np.inf, (np.zeros(0), float(c[0]))
    for p in sorted({0, 1, 2, 4, 8, 16, order}):
        if p > order:
            continue
        # a trace of white noise keeps the recursion stable
        column = np.concatenate([c[:1] * (1.0 + 1e-9), c[1:p]])
        a = -linalg.solve_toeplitz(column, c[1 : p + 1]) if p else np.zeros(0)
        left = float(c[0] + a @ c[1 : p + 1])
        if left <= 0.0:
            break
        score = e.size * np.log(left) + p * np.log(e.size)
        if score < best:
            best, chosen = score, (a, left)
    return chosen


def coherence(parts: Sequence[ResidualPart]) -> Coherence | None:
    """
    Return the coherence of voltage and residual by Welch's method; None when too short.

    Notes
    -----
    Bendat and Piersol, Random Data, 4th ed. (2010), section 9.2, doi:10.1002/9781118032428.
    """
    chosen, rate = _chosen(parts)
    runs = [(p, a, b) for p in chosen for a, b in p.runs()]
    total = sum(b - a for _, a, b in runs)
    if total < 256:
        return None
    n = int(2 ** np.floor(np.log2(max(64, 2 * total // AVERAGES))))
    n = min(n, SEGMENT)
    window = signal.windows.hann(n, sym=False)
    vv, ee, ve, count = np.zeros(n // 2 + 1), np.zeros(n // 2 + 1), 0j, 0
    for part, start, stop in runs:
        for k in range(start, stop - n + 1, n // 2):
            v = window * signal.detrend(part.piece.v[k : k + n])
            e = window * signal.detrend(part.e[k : k + n])
            V, E = fft.rfft(v), fft.rfft(e)
            vv += np.abs(V) ** 2
            ee += np.abs(E) ** 2
            ve = ve + np.conj(V) * E
            count += 1
    if count < 4:
        return None
    averages = max(2.0, count * OVERLAP)
    tiny = np.finfo(float).tiny
    c = np.clip(np.abs(ve) ** 2 / np.maximum(vv * ee, tiny), 0.0, 1.0)
    tested = vv > EXCITED * float(vv.max())
    # the first bins are what detrending left
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

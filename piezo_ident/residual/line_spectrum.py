# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Stretches of a residual at a lower rate, their transforms, and the noise around a line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.residual.stretches import block_means, ResidualPart, Stretch
from scipy import fft, signal
from scipy.ndimage import maximum_filter1d, median_filter

__all__ = ['FEWEST', 'Series', 'Spectrum', 'series_of']

Array = NDArray[np.float64]

#: the search goes to this share of half the rate after averaging, which is about this rate [Hz]
TOP, RATE = 0.8, 2500.0
#: shortest stretch that is looked at [s]
SHORTEST = 0.3
#: neighbours on either side that a line is held against, and fewest of them [bins]
NEIGHBOURS, FEWEST = 31, 7
#: a median of exponential variables is worth this share of a mean as an estimate of their scale
MEDIAN_WORTH = 0.48


@dataclass(frozen=True, eq=False)
class Series:
    """A stretch of the residual at the lower rate, as differences where the drive repeats."""

    record: str
    t: float
    x: Array
    window: Array
    lag: float
    offset: int
    block: int
    rate: float
    driven: Array | None = None

    def gain(self, f: Array) -> NDArray[np.complex128]:
        """Return what the block means, and the differences, make of a wave at f."""
        x = np.pi * np.asarray(f) / self.rate
        mean = np.where(
            x > 0.0, np.sin(x) / np.maximum(self.block * np.sin(x / self.block), 1e-300), 1.0
        )
        if self.lag == 0.0:
            return mean.astype(np.complex128)
        return np.asarray(mean * (np.exp(2j * np.pi * f * self.lag) - 1.0))

    def comb(self, f: Array) -> Array:
        """
        Return what the differences make of the spectrum of white noise, relative to its mean.

        Averaging folds higher frequencies back, where the comb has its teeth elsewhere.
        """
        lag = round(self.lag * self.rate)
        if not 0 < lag < self.x.size:
            return np.ones(f.size)
        power = float(self.window @ self.window)
        overlap = float(self.window[lag:] @ self.window[:-lag]) / power
        if self.block == 1:
            return np.asarray(1.0 - overlap * np.cos(2.0 * np.pi * f * self.lag))
        folded = [f, self.rate - f, self.rate + f, 2.0 * self.rate - f]
        weights = [np.sinc(g / self.rate) ** 2 for g in folded]
        teeth = sum(
            w * np.cos(2.0 * np.pi * g * self.lag) for w, g in zip(weights, folded, strict=True)
        )
        return np.asarray(1.0 - overlap * teeth / sum(weights))


def series_of(
    parts: Sequence[ResidualPart], stretches: Sequence[Stretch]
) -> tuple[list[Series], float, float]:
    """Return the stretches that are long enough, their rate, and the highest frequency [Hz]."""
    found: list[Series] = []
    rate = max((p.piece.sample_rate for p in parts), default=0.0)
    m = max(1, int(rate / RATE))
    for s in stretches:
        piece = parts[s.part].piece
        if abs(piece.sample_rate / rate - 1.0) > 1e-6:
            continue
        start = s.start
        if s.kind == 'rest' and s.step:
            # what still answers to the step is no line
            start += min(s.n // 5, round(0.1 * rate))
        # on the ticks of the lower rate, so that stretches of a record differ by whole samples
        first = round(piece.start_time * rate) + start
        start += -first % m
        e = parts[s.part].e[start : s.stop]
        if s.period:
            e = e[s.period :] - e[: -s.period]
        x = block_means(e, m)
        if x.size < SHORTEST * rate / m:
            continue
        x = signal.detrend(x)
        window = signal.windows.hann(x.size)
        driven = None
        if s.kind == 'motion':
            driven = _driven(block_means(piece.v[start : s.stop], m), x, window)
        # at the middle of its first block
        t = piece.start_time + (start + 0.5 * (m - 1)) / rate
        found.append(
            Series(
                parts[s.part].record,
                t,
                x,
                window,
                s.period / rate,
                (first + -first % m) // m,
                m,
                rate / m,
                driven,
            )
        )
    return found, rate / m, TOP * 0.5 * rate / m


def _driven(v: Array, x: Array, window: Array) -> Array:
    """
    Return the power that the drive may have put into a residual, were it all the drive's.

    The residual is shared out like v, its square, its cube, and its direction, which has the
    harmonics of hysteresis.
    """
    u = v - v.mean()
    power = np.zeros(x.size // 2 + 1)
    for wave in (u, u * u, u**3, np.sign(np.gradient(u))):
        wave = signal.detrend(wave)
        size = float(wave @ wave)
        if size > 0.0:
            power += np.abs(fft.rfft(window * wave)) ** 2 * (float(x @ x) / size)
    return np.asarray(maximum_filter1d(power, 3))


@dataclass(frozen=True, eq=False)
class Spectrum:
    """
    Windowed transform of a series on a grid of frequencies, seen from a time common to all.

    Attributes
    ----------
    series : Series
    values : ndarray of complex, shape (p,)
    noise : ndarray, shape (p,)
        Mean square of the transform around each frequency without a line.
    worth : ndarray, shape (p,)
        Averages that the noise is worth.
    """

    series: Series
    values: NDArray[np.complex128]
    noise: Array
    worth: Array

    @classmethod
    def of(cls, s: Series, f: Array, size: int) -> Spectrum:
        """Return the spectrum on the first frequencies of a transform of some size."""
        x, offset = s.window * s.x, s.offset % size
        # on the grid a stretch may be put anywhere modulo its size
        placed = np.zeros(size)
        head = min(x.size, size - offset)
        placed[offset : offset + head] = x[:head]
        placed[: x.size - head] = x[head:]
        return cls(s, np.asarray(fft.rfft(placed))[: f.size], *_noise_around(s, f))


def _noise_around(s: Series, f: Array) -> tuple[Array, Array]:
    """
    Return the mean square of the transform around each f without a line, and its worth.

    The geometric mean of the medians on both sides leaves a power law as it is.  Differences over
    a lag make a comb of the noise, as deep as the window overlaps itself shifted by that lag.
    Where the drive does not repeat, what it may have left at a frequency counts as noise.
    """
    rate = s.rate
    power = np.abs(fft.rfft(s.window * s.x)) ** 2
    k = np.arange(power.size)
    power /= s.comb(k * (rate / s.x.size))
    tiny = np.finfo(float).tiny
    logs = np.log(np.maximum(power, tiny))
    level, worth = np.full(power.size, np.inf), np.ones(power.size)
    half = FEWEST
    # the window makes three bins of one, so the next three belong to the line itself
    gap = 4
    while True:
        sides = median_filter(logs, size=half, mode='nearest')
        offset = gap + half // 2
        left = np.concatenate([np.full(offset, np.nan), sides[:-offset]])
        right = np.concatenate([sides[offset:], np.full(offset, np.nan)])
        fits = (k >= 2 * half) & np.isfinite(left) & np.isfinite(right)
        level[fits] = np.exp(0.5 * (left[fits] + right[fits])) / np.log(2.0)
        # neighbouring bins share two thirds of a Hann window's noise
        worth[fits] = 2 * half * MEDIAN_WORTH * 0.52
        if half >= NEIGHBOURS or 4 * half > power.size // 2:
            break
        half = min(2 * half + 1, NEIGHBOURS)
    at = np.clip(np.rint(f * s.x.size / rate).astype(np.int64), 0, power.size - 1)
    if s.driven is not None:
        level = np.maximum(level, s.driven)
    # a record without any noise must not make a line of its rounding
    least = max(np.finfo(float).eps ** 2 * float(power.max(initial=0.0)), 1e-40)
    return np.maximum(level[at], least) * s.comb(f), worth[at]

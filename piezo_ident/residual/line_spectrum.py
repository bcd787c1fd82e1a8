# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Compute stretches of a residual at a lower rate, their transforms, and noise around lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array, Integers, Mask, true_runs
from piezo_ident.residual.beyond_drive import without_drive
from piezo_ident.residual.stretches import block_means, DriveStretch, ResidualPart
from scipy import fft, signal
from scipy.interpolate import make_interp_spline
from scipy.ndimage import maximum_filter1d, median_filter

#: highest frequency of a search over half of the lower rate, and that rate, approximately [Hz]
TOP, RATE = 0.8, 2500.0
#: shortest stretch of a search [s]
SHORTEST = 0.3
#: most and fewest bins on either side with which a line is compared
NEIGHBOURS, FEWEST = 31, 7
#: least power of a line of the drive, in multiples of the bins around and of the largest bin
LOCKED, ROUNDING = 16.0, 1e-12
#: least gain of the differences of periods, or of means, at which a line can show
FAINT = 0.15
#: efficiency of a median of exponential variables, over that of a mean, as estimate of their scale
MEDIAN_WORTH = 0.48
#: least motion behind a turn of the voltage, as a share of its range: noise turns all the time
TURN = 0.01
#: number of further grid points at either end of a spline of the transform
WIDER = 6


@dataclass(frozen=True, eq=False)
class Series:
    """
    A stretch of the residual at the lower rate; differences of periods if the drive repeats.

    `driven` is power that the drive may have caused; `locked` marks bins of lines of the drive.
    """

    record: str
    t: float
    x: Array
    window: Array
    lag: float
    offset: int
    block: int
    rate: float
    driven: Array | None = None
    locked: Mask | None = None

    def gain(self, f: Array) -> NDArray[np.complex128]:
        """Compute the gain of block means and differences for a wave at f [Hz]."""
        x = np.pi * np.asarray(f) / self.rate
        mean = np.where(
            x > 0.0, np.sin(x) / np.maximum(self.block * np.sin(x / self.block), 1e-300), 1.0
        )
        if self.lag == 0.0:
            return mean.astype(np.complex128)
        return np.asarray(mean * (np.exp(2j * np.pi * f * self.lag) - 1.0))

    def comb(self, f: Array) -> Array:
        """
        Compute the spectrum of differences of white noise, relative to its mean.

        Averaging folds higher frequencies back, with the teeth of their comb at other places.
        """
        lag = round(self.lag * self.rate)
        if not 0 < lag < self.x.size:
            return np.ones(f.size)
        power = float(self.window @ self.window)
        overlap = float(self.window[lag:] @ self.window[:-lag]) / power
        if self.block == 1:
            return np.asarray(1.0 - overlap * np.cos(2.0 * np.pi * f * self.lag))
        folded = np.array([f, self.rate - f, self.rate + f, 2.0 * self.rate - f])
        weights = np.sinc(folded / self.rate) ** 2
        teeth = np.sum(weights * np.cos(2.0 * np.pi * folded * self.lag), axis=0)
        return np.asarray(1.0 - overlap * teeth / weights.sum(axis=0))


def series_of(
    parts: Sequence[ResidualPart], stretches: Sequence[DriveStretch]
) -> tuple[list[Series], float, float]:
    """Collect the stretches that are long enough, their rate, and the highest frequency [Hz]."""
    found: list[Series] = []
    rate = max((p.piece.sample_rate for p in parts), default=0.0)
    m = max(1, int(rate / RATE))
    shortest = SHORTEST * rate / m
    used: dict[int, list[tuple[int, int]]] = {}
    for s in stretches:
        piece = parts[s.part].piece
        if s.kind == 'motion' or abs(piece.sample_rate / rate - 1.0) > 1e-6:
            continue
        start = s.start
        if s.kind == 'rest' and s.step:
            # leave out the answer to the step, which is not a line
            start += min(s.n // 5, round(0.1 * rate))
        # begin at a tick of the lower rate, so that stretches differ by whole samples of this rate
        first = round(piece.start_time * rate) + start
        start += -first % m
        e = parts[s.part].e[start : s.stop]
        if s.period:
            e = e[s.period :] - e[: -s.period]
        x = block_means(e, m)
        if x.size < shortest:
            continue
        used.setdefault(s.part, []).append((s.start, s.stop))
        found.append(_series(parts[s.part], start, x, m, s.period))
    for k, part in enumerate(parts):
        if abs(part.piece.sample_rate / rate - 1.0) < 1e-6:
            found += _motions(part, used.get(k, []), m, shortest)
    return found, rate / m, TOP * 0.5 * rate / m


def _series(part: ResidualPart, start: int, x: Array, m: int, period: int = 0) -> Series:
    rate, begin = part.piece.sample_rate, part.piece.start_time
    return Series(
        part.record,
        # at the middle of its first block
        begin + (start + 0.5 * (m - 1)) / rate,
        signal.detrend(x),
        signal.windows.hann(x.size),
        period / rate,
        (round(begin * rate) + start) // m,
        m,
        rate / m,
    )


def _motions(
    part: ResidualPart, used: Sequence[tuple[int, int]], m: int, shortest: float
) -> list[Series]:
    """Collect the stretches between the used stretches, less the best functions of the drive."""
    piece, free = part.piece, part.joined
    for start, stop in used:
        free[start:stop] = False
    runs = [(a, b) for a, b in true_runs(free) if b - a >= (shortest + 1) * m]
    if not runs:
        return []
    tick = -round(piece.start_time * piece.sample_rate) % m
    e, v = (block_means(x[tick:], m) for x in (part.e, piece.v))
    use: Mask = np.all(part.joined[tick : tick + e.size * m].reshape(-1, m), axis=1)
    e = without_drive(e, v, piece.sample_rate / m, use)
    found = []
    for start, stop in runs:
        a, b = -(-(start - tick) // m), (stop - tick) // m
        series = _series(part, tick + a * m, e[a:b], m)
        driven = _driven(v[a:b], series.x, series.window)
        found.append(replace(series, driven=driven, locked=_locked(v[a:b])))
    return found


def turns_of(v: Array, least: float) -> Integers:
    """
    Find the indices at which a voltage turns and then moves by `least` [V] the other way.

    >>> turns_of(np.array([0.0, 5.0, 4.9, 6.0, 1.0, 2.0]), 0.5)
    array([3, 4])
    """
    found: list[int] = []
    low = high = 0
    up: bool | None = None
    for i, x in enumerate(v.tolist()):
        if x > v[high]:
            high = i
        if x < v[low]:
            low = i
        if up is not False and x < v[high] - least:
            if up:
                found.append(high)
            up, low = False, i
        elif up is not True and x > v[low] + least:
            if up is False:
                found.append(low)
            up, high = True, i
    return np.array(found, dtype=np.int64)


def _locked(v: Array) -> Mask:
    """
    Mark the bins at which a periodic drive may leave a line, shape (n // 2 + 1,).

    Impulses at the turns of the drive have every harmonic, also harmonics at which a mode rings.
    """
    turns = turns_of(v, TURN * float(np.ptp(v)))
    signed, plain = np.zeros(v.size), np.zeros(v.size)
    if turns.size > 1:
        signed[turns], plain[turns] = np.sign(np.diff(v[turns], prepend=v[turns[0] - 1])), 1.0
    locked = np.zeros(v.size // 2 + 1, dtype=bool)
    window = signal.windows.hann(v.size)
    for wave in (v, v * v, np.diff(v, prepend=v[0]), signed, plain):
        power = np.abs(fft.rfft(window * signal.detrend(wave))) ** 2
        top = float(power.max(initial=0.0))
        usual = median_filter(power, size=2 * NEIGHBOURS + 1, mode='nearest')
        peak = power == maximum_filter1d(power, 5)
        locked |= peak & (power > LOCKED * usual) & (power > ROUNDING * top)
    return np.asarray(maximum_filter1d(locked, 7))


def _driven(v: Array, x: Array, window: Array) -> Array:
    """
    Bound the power that the drive may have caused in a residual, in each bin.

    The bound is the sum of the spectra of v, its square, its cube, and its direction, which has
    the harmonics of hysteresis; each spectrum has the power of the residual.
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
    Windowed transform of a series on a grid of frequencies; all series share the time zero.

    `noise` is the mean square of the transform around each frequency without a line, and `worth`
    the number of independent bins in this mean; shapes (p,).
    """

    series: Series
    values: NDArray[np.complex128]
    noise: Array
    worth: Array

    @classmethod
    def of(cls, s: Series, f: Array, size: int) -> Spectrum:
        """Compute the spectrum at the frequencies f, the first of a transform of `size` points."""
        x, offset = s.window * s.x, s.offset % size
        # on the grid a stretch may be put anywhere modulo its size
        placed = np.zeros(size)
        head = min(x.size, size - offset)
        placed[offset : offset + head] = x[:head]
        placed[: x.size - head] = x[head:]
        return cls(s, np.asarray(fft.rfft(placed))[: f.size], *_noise_around(s, f))

    def between(self, f: Array, near: Integers) -> Callable[[Array], NDArray[np.complex128]]:
        """
        Interpolate the transform at any frequency [Hz] near some points of the grid f.

        The transform is smooth if time counts from the middle of the stretch.  A spline of fifth
        degree errs by 1e-5 of the maximum for the longest stretch, and by far less for others.
        """
        s = self.series
        # some more points, since a spline is worse at its ends
        wider = slice(max(int(near[0]) - WIDER, 0), int(near[-1]) + WIDER + 1)
        grid = f[wider]
        middle = 0.5 * (s.x.size - 1) / s.rate
        turn = np.exp(2j * np.pi * grid * (s.offset / s.rate + middle))
        smooth = make_interp_spline(grid, self.values[wider] * turn, k=5)
        return lambda at: np.asarray(smooth(at) * np.exp(-2j * np.pi * at * (s.t + middle)))


def _noise_around(s: Series, f: Array) -> tuple[Array, Array]:
    """
    Estimate `noise` and `worth` of a `Spectrum`.

    The geometric mean of the medians on both sides leaves a power law as it is.  Differences over
    a lag make a comb of the noise, as deep as the window overlaps the window shifted by this lag.
    Power that a drive without periods may have caused counts as noise.
    """
    rate = s.rate
    power = np.abs(fft.rfft(s.window * s.x)) ** 2
    k = np.arange(power.size)
    power /= s.comb(k * (rate / s.x.size))
    tiny = np.finfo(float).tiny
    logs = np.log(np.maximum(power, tiny))
    level, worth = np.full(power.size, np.inf), np.ones(power.size)
    half = FEWEST
    # the Hann window spreads a line over three bins, and the line may lie between two bins
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
    if s.locked is not None:
        level = np.where(s.locked, np.inf, level)
    # rounding must not count as a line in a record without noise
    least = max(np.finfo(float).eps ** 2 * float(power.max(initial=0.0)), 1e-40)
    level = np.maximum(level[at], least) * s.comb(f)
    # a period that is no whole number of samples leaves a rest of the drive in the differences
    return np.where(np.abs(s.gain(f)) < FAINT, np.inf, level), worth[at]

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Estimate the noise floor of a residual: the part that differs between equal motions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.residual.stretches import DriveStretch, ResidualPart
from scipy import signal

#: order of the slow change that is subtracted from a frame of differences
ORDER = 3
#: shortest frame [s]: slower changes count as drift
FRAME = 0.25
#: share at the start of a rest that is left out, and least time that is left out [s]
SETTLING, SETTLING_TIME = 0.2, 0.02
#: least ratio of the rms of a white residual by its third differences to its whole rms, and fewest
#: samples (level of the test: the estimate then scatters by 2 %)
WHITE, FEWEST = 0.95, 2000
#: longest block of a table of block lengths [samples]
LONGEST_BLOCK = 4096
#: least power of a line over its surroundings: white noise exceeds this ratio once in e^10 bins.
#: Places in an octave at which the surroundings are measured, over two octaves (taste)
LINE, AN_OCTAVE = 10.0, 4


@dataclass(frozen=True, eq=False)
class NoiseFloor:
    """
    Noise that no model of the voltage can explain.

    `rms` is the rms of single samples [m], None if it is unknown; `source` tells its origin.
    `block_rms` is the rms of means [m] over `blocks` of 1, 2, 4, ... samples, shapes (k,).  The
    power spectral `density` [m^2/Hz] over `frequency` [Hz], shapes (p,), may be empty.
    """

    rms: float | None
    source: str
    blocks: Integers = field(default_factory=lambda: np.zeros(0, np.int64))
    block_rms: Array = field(default_factory=lambda: np.zeros(0))
    frequency: Array = field(default_factory=lambda: np.zeros(0))
    density: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def known(self) -> bool:
        """Whether there is a floor."""
        return self.rms is not None

    def at(self, m: float) -> float | None:
        """
        Compute the rms of the noise in means over blocks of m samples [m], None if unknown.

        A power law interpolates between the measured block lengths.  Longer blocks continue the
        mean slope of the last two octaves.
        """
        if self.rms is None:
            return None
        if self.rms == 0.0 or self.blocks.size < 2:
            return float(self.rms / np.sqrt(m))
        x = np.log(self.blocks.astype(np.float64))
        y = np.log(np.maximum(self.block_rms, np.finfo(float).tiny))
        at = float(np.log(m))
        if at <= x[-1]:
            return float(np.exp(np.interp(at, x, y)))
        k = max(-3, -x.size)
        slope = float(np.clip((y[-1] - y[k]) / (x[-1] - x[k]), -0.5, 0.0))
        return float(np.exp(y[-1] + slope * (at - x[-1])))

    def squares(self, quantum: float, m: int, span: float) -> tuple[float, float | None]:
        """
        Compute the mean squares of means over m samples and of samples, in units of a span [m].

        The second is None if the floor is unknown; `quantum` is the step of the readings [m].
        """

        def square(rms: float, m: int) -> float:
            # a reading that rests on one step of the converter hides its rounding
            return float(max(rms, quantum / np.sqrt(12.0 * m)) / span) ** 2

        single = None if self.rms is None else square(self.rms, 1)
        return square(self.at(m) or 0.0, m), single


class _Reading(NamedTuple):
    """Noise of a stretch, its rate [Hz], and the variances of means over 1, 2, 4, .. samples."""

    series: Array
    sample_rate: float
    variances: Array


def residual_noise_floor(
    parts: Sequence[ResidualPart], stretches: Sequence[DriveStretch]
) -> NoiseFloor:
    """
    Estimate the noise floor of residuals.

    The difference of two consecutive periods of a repeating v, from the second period on, has
    twice the variance of the noise.  The error of the model repeats and drops out; slow drift is
    subtracted, and lines of the spectrum are lowered.  Records without repeats use rests, less
    parabolas in time and in the logarithm of time, which describe creep.  The weighted median over
    the stretches counts, so that a settling stretch hardly matters.  Without repeats and rests, a
    white residual is noise, because the error of a model is correlated in time.  Noise slower than
    a period or a rest counts as drift.

    Pintelon and Schoukens, System Identification: A Frequency Domain Approach, 2nd ed. (2012),
    section 2.5, doi:10.1002/9781118287422.
    """
    for kind, read in (('repeat', _repeat), ('rest', _rest)):
        every = [read(parts[s.part], s) for s in stretches if s.kind == kind]
        readings = [reading for reading in every if reading is not None]
        if readings:
            return _pooled(readings, kind)
    return _white(parts)


def _white(parts: Sequence[ResidualPart]) -> NoiseFloor:
    """Estimate the floor of a white residual, whose third differences show all of its power."""
    own = [part.e[part.mask] - part.e[part.mask].mean() for part in parts if part.mask.any()]
    third = [
        np.diff(part.e, 3)[np.lib.stride_tricks.sliding_window_view(part.mask, 4).all(axis=1)]
        for part in parts
        if part.piece.n > 3
    ]
    n = sum(x.size for x in third)
    if n >= FEWEST:
        # the third difference of white noise has 20 times the variance
        fast = float(np.sqrt(sum(float(x @ x) for x in third) / (20.0 * n)))
        whole = float(np.sqrt(sum(float(x @ x) for x in own) / sum(x.size for x in own)))
        if WHITE * whole <= fast <= whole / WHITE:
            return NoiseFloor(min(fast, whole), f'the residual is white noise, {n} samples')
    return NoiseFloor(None, 'floor unknown: the voltage neither repeats three times nor rests')


def _repeat(part: ResidualPart, s: DriveStretch) -> _Reading | None:
    p, rate = s.period, part.piece.sample_rate
    difference = part.e[s.start + 2 * p : s.stop] - part.e[s.start + p : s.stop - p]
    frame = min(max(p, round(FRAME * rate)), difference.size)
    order = ORDER if frame > 16 * ORDER else 0
    basis = np.asarray(np.polynomial.legendre.legvander(np.linspace(-1, 1, frame), order), float)
    series = _detrended(difference, frame, basis) / np.sqrt(2.0)
    # longer means would compare the end of one period with the start of the next
    return _reading(part, series, frame, min(p // 2, frame // 16), ORDER + 1)


def _rest(part: ResidualPart, s: DriveStretch) -> _Reading | None:
    rate = part.piece.sample_rate
    skip = max(round(SETTLING * s.n), round(SETTLING_TIME * rate))
    n = s.n - skip
    if n < 100:
        return None
    t = (np.arange(n) + skip + 1.0) / s.n
    lg = np.log(t)
    # the squares follow creep that is not an exact logarithm of time
    basis = np.column_stack([np.ones(n), t, t * t, lg, lg * lg])
    series = _detrended(part.e[s.start + skip : s.stop], n, basis)
    # without a window a mode that rings from the start would leak into every bin
    window = np.hanning(n + 2)[1:-1]
    series *= window / np.sqrt(np.mean(window**2))
    return _reading(part, series, n, n // 16, basis.shape[1])


def _detrended(x: Array, frame: int, basis: Array) -> Array:
    """Subtract from each whole frame of x its projection on a basis."""
    rows = x[: x.size // frame * frame].reshape(-1, frame)
    q, _ = np.linalg.qr(basis)
    return np.asarray((rows - (rows @ q) @ q.T).ravel())


def _reading(
    part: ResidualPart, series: Array, frame: int, longest: int, removed: int
) -> _Reading | None:
    if series.size < 16:
        return None
    series = _without_ringing(series)
    top = int(np.log2(max(1, min(longest, LONGEST_BLOCK))))
    rows = series.reshape(-1, frame)
    variances = []
    for m in 2 ** np.arange(top + 1):
        count = frame // m
        means = rows[:, : count * m].reshape(rows.shape[0], count, m).mean(axis=2)
        # the median of several frames, as drift may have bent one frame
        power = np.sum(means**2, axis=1) / max(count - removed, 1)
        variances.append(float(np.median(power) if power.size > 2 else power.mean()))
    return _Reading(series, part.piece.sample_rate, np.array(variances))


def _without_ringing(x: Array) -> Array:
    """Lower the lines of a spectrum to its surroundings: a mode that rings is not noise."""
    X = np.fft.rfft(x)
    power, n = np.abs(X[1:]) ** 2, X.size - 1
    at = np.unique(np.geomspace(1, n, AN_OCTAVE * int(np.log2(n)) + 2).astype(int))
    # the median of an exponential distribution is ln 2 of its mean
    level = [np.median(power[max(0, k // 2 - 4) : 2 * k + 4]) / np.log(2.0) for k in at]
    limit = np.interp(np.log(np.arange(1, n + 1)), np.log(at), level)
    X[1:] *= np.sqrt(np.where(power > LINE * limit, limit / np.maximum(power, 1e-300), 1.0))
    return np.asarray(np.fft.irfft(X, x.size))


def _pooled(readings: Sequence[_Reading], kind: str) -> NoiseFloor:
    """Take the median of readings, weighted by their samples."""
    longest = max(r.variances.size for r in readings)
    medians = []
    for i in range(longest):
        known = sorted((r.variances[i], r.series.size) for r in readings if r.variances.size > i)
        total = np.cumsum([size for _, size in known])
        medians.append(known[int(np.searchsorted(total, 0.5 * total[-1]))][0])
    # averaging never adds noise
    block_rms = np.sqrt(np.minimum.accumulate(medians))
    widest = max(readings, key=lambda r: r.series.size)
    segment = min(4096, max(16, widest.series.size // 8))
    frequency, density = signal.welch(widest.series, widest.sample_rate, nperseg=segment)
    seconds = sum(r.series.size / r.sample_rate for r in readings)
    way = 'differences of repeated periods'
    way = way if kind == 'repeat' else 'rests of the voltage without creep'
    source = f'{way}, {len(readings)} stretches, {seconds:.3g} s'
    rms, blocks = float(block_rms[0]), 2 ** np.arange(longest)
    return NoiseFloor(rms, source, blocks, block_rms, frequency, density)

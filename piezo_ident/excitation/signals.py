# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Make input signals, each a vector of volts.

Every signal is half-open: its first value would follow its last sample (in a staircase, its last
value).  Signals and ramps therefore join without a repeated sample.  The generator in the
arguments is the only source of randomness.
"""

from __future__ import annotations

from collections.abc import Sequence as Many

import numpy as np
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.common.errors import ConfigError
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

#: eq. (7) of Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868: peaks [V], slope [V/s]
PAPER_PEAKS = (3.0, 6.0, 9.0)
PAPER_SLOPE = 6.0

#: number of neighbouring odd lines of which one is left out
GROUP = 4

#: longest signal, for the memory of a lab computer [samples]
MAX_SAMPLES = 50_000_000


def sample_count(seconds: float, sample_rate: float) -> int:
    """Count the samples of a signal; ConfigError for less than one sample, or too many."""
    n = seconds * sample_rate
    if n < 0.5:
        raise ConfigError(f'{seconds:g} s is shorter than one sample; make it longer')
    if not n <= MAX_SAMPLES:
        raise ConfigError(f'{seconds:g} s are more than {MAX_SAMPLES} samples; make it shorter')
    return round(n)


def _below_nyquist(frequency: float, sample_rate: float) -> None:
    if not 0.0 < frequency < sample_rate / 2:
        raise ConfigError(
            f'{frequency:g} Hz does not lie between 0 and half the sampling rate '
            f'({sample_rate / 2:g} Hz)'
        )


def ramp(start: float, stop: float, slew: float, sample_rate: float) -> Array:
    """
    Make a smooth ramp from one level to another [V]; `stop` would be the next sample.

    The speed is a raised cosine.  It starts and ends at zero; its largest value is `slew` [V/s].
    """
    seconds = max(1.0 / sample_rate, 2.0 * abs(stop - start) / slew)
    sample_count(seconds, sample_rate)
    n = max(1, int(np.ceil(seconds * sample_rate)))
    tau = np.arange(n) / n
    return start + (stop - start) * (tau - np.sin(2 * np.pi * tau) / (2 * np.pi))


def staircase(levels: Many[float], hold: Many[float], sample_rate: float) -> Array:
    """Make a staircase of levels [V], each held for its time [s]."""
    n = [sample_count(t, sample_rate) for t in hold]
    sample_count(sum(n) / sample_rate, sample_rate)
    return np.repeat(np.asarray(levels, dtype=np.float64), n)


def corners(levels: Many[float], slope: float, sample_rate: float) -> Array:
    """
    Make straight lines through levels [V], all with the same magnitude of slope [V/s].

    Every line takes a whole number of samples, so each corner is exact, and the slope is rounded.
    """
    v = np.asarray(levels, dtype=np.float64)
    seconds = np.abs(np.diff(v)) / slope
    sample_count(float(seconds.sum()), sample_rate)
    n = np.maximum(1, np.rint(seconds * sample_rate).astype(np.int64))
    at = np.concatenate([[0], np.cumsum(n)])
    return np.interp(np.arange(at[-1]), at, v)


def triangle(peaks: Many[float], base: float, slope: float, sample_rate: float) -> Array:
    """
    Make triangles from a base to each of the peaks and back: eq. (7) of the paper, six seconds.

    >>> triangle(PAPER_PEAKS, 0.0, PAPER_SLOPE, 1000.0).size
    6000
    """
    levels = [base]
    for peak in peaks:
        levels += [peak, base]
    return corners(levels, slope, sample_rate)


def settling_sweep(
    bias: float, amplitude: float, cycles: int, frequency: float, sample_rate: float
) -> Array:
    """
    Make sine cycles around a bias, which decay linearly after a full first cycle.

    The sweep leaves every narrower play in the middle of its band, and every wider play at rest.
    Noise slightly smaller than the sweep then moves neither kind of play to new extremes.
    """
    _below_nyquist(frequency, sample_rate)
    n = sample_count(cycles / frequency, sample_rate)
    tau = np.arange(n) / n
    envelope = np.minimum(1.0, (1.0 - tau) * cycles / max(1.0, cycles - 1.0))
    return bias + amplitude * envelope * np.sin(2 * np.pi * cycles * tau)


def sine(
    bias: float,
    amplitude: float,
    frequency: float,
    periods: int,
    sample_rate: float,
    phase: float = 0.0,
) -> Array:
    """
    Make a whole number of periods of ``bias + amplitude sin(2 pi f t + phase)``.

    The length is rounded to a whole number of samples.
    """
    _below_nyquist(frequency, sample_rate)
    n = sample_count(periods / frequency, sample_rate)
    angle = 2 * np.pi * frequency * (np.arange(n) / sample_rate)
    return bias + amplitude * np.sin(angle + phase)


def noise(
    bias: float,
    amplitude: float,
    cutoff: float,
    duration: float,
    sample_rate: float,
    rng: np.random.Generator,
    crest: float = 2.5,
    fade: float = 0.01,
) -> Array:
    """
    Make Gaussian noise with a flat spectrum up to a cut-off and limited peaks.

    Clipping lowers the peaks and widens the spectrum.  Filtering restores the spectrum and
    slightly raises the peaks.  In turn, both converge.

    The amplitude is the largest deviation from the bias [V].  The band is flat to the cutoff [Hz];
    a raised cosine falls to zero at 1.2 times this frequency.  A crest factor of about 2 is the
    smallest possible.  The noise rises from the bias and falls back to it in the time `fade` [s].
    """
    _below_nyquist(cutoff, sample_rate)
    n = sample_count(duration, sample_rate)
    m = next_fast_len(max(n, 2), real=True)
    over = rfftfreq(m, 1.0 / sample_rate) / cutoff
    shape = 0.5 + 0.5 * np.cos(np.pi * np.clip((over - 1.0) / 0.2, 0.0, 1.0))
    shape[0] = 0.0
    if not shape.any():
        raise ConfigError(
            f'{duration:g} s hold no whole period below {cutoff:g} Hz; make the noise longer'
        )
    x = irfft(rfft(rng.standard_normal(m)) * shape, m)
    for _ in range(30):
        limit = crest * np.sqrt(np.mean(x**2))
        if np.abs(x).max() <= 1.01 * limit:
            break
        x = irfft(rfft(np.clip(x, -limit, limit)) * (shape > 0), m)
    x = x[:n]
    edge = np.minimum(np.arange(n), n - np.arange(n)) / max(1.0, fade * sample_rate)
    x = x * (0.5 - 0.5 * np.cos(np.pi * np.minimum(1.0, edge)))
    peak = float(np.abs(x).max())
    scaled: Array = bias + amplitude * x / max(peak, np.finfo(float).tiny)
    return scaled


def odd_lines(lowest: int, highest: int, rng: np.random.Generator) -> Integers:
    """
    Choose odd harmonic numbers, with one of every `GROUP` left out at random.

    The missing odd and even lines detect odd and even nonlinearity: this is the random-odd
    multisine of Pintelon and Schoukens, System Identification, 2nd ed., Wiley 2012.
    """
    odd = np.arange(lowest | 1, highest + 1, 2)
    keep = np.ones(odd.size, dtype=bool)
    for start in range(0, odd.size - GROUP + 1, GROUP):
        keep[start + rng.integers(GROUP)] = False
    return odd[keep]


def multisine(
    bias: float,
    amplitude: float,
    lines: Integers,
    period: float,
    periods: int,
    sample_rate: float,
    rng: np.random.Generator,
) -> Array:
    """
    Make whole periods of a random-phase multisine with equal lines.

    The amplitude is the largest deviation from the bias [V].  The lines are harmonic numbers of
    ``1 / period``; see `odd_lines`.  The period [s] is rounded to a sample.
    """
    n = sample_count(period, sample_rate)
    sample_count(n * periods / sample_rate, sample_rate)
    if lines.size == 0:
        raise ConfigError('no odd line lies between the two frequencies; widen the band')
    _below_nyquist(float(lines[-1]) * sample_rate / n, sample_rate)
    spectrum = np.zeros(n // 2 + 1, dtype=np.complex128)
    spectrum[lines] = np.exp(2j * np.pi * rng.random(lines.size))
    x = irfft(spectrum, n)
    return bias + amplitude * np.tile(x / np.abs(x).max(), periods)

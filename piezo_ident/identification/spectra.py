# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Estimate spectra of an input and its output: driven band, coherence, frequency response."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.prepare import END_HELD, Run
from piezo_ident.residual.coherence import cross_spectra
from scipy import fft, ndimage, signal

#: longest segment of a frequency response [samples]
SEGMENT = 8192
#: largest relative standard deviation of a point of a response to arbitrary motion
TRUSTED = 0.1
#: corner below which the slow part of a signal is removed [Hz]
HIGH_PASS = 30.0
#: averaging time of a running rms [s]
WINDOW = 0.1
#: smallest number of points of a response: fewer points come from a few sines
POINTS = 20


def excited_band(u: Array, sample_rate: float, depth: float = 1e-3) -> float:
    """
    Find the highest frequency [Hz] at which u, shape (n,), still has power.

    `depth` is the share of the largest spectral density that counts as power.

    Examples
    --------
    >>> t = np.arange(4096) / 1000.0
    >>> 95.0 < excited_band(np.sin(2.0 * np.pi * 100.0 * t), 1000.0) < 105.0
    True
    """
    f, power = signal.welch(u, sample_rate, nperseg=min(u.size, 2048))
    return float(f[np.flatnonzero(power >= depth * power.max())[-1]])


def prefilter(x: Array, sample_rate: float, cutoff: float) -> Array:
    """Remove the mean and the frequencies above the cut-off from x; shape (n,)."""
    centred = np.asarray(x - x.mean())
    if cutoff >= 0.45 * sample_rate:
        return centred
    sos = signal.butter(4, cutoff, fs=sample_rate, output='sos')
    return np.asarray(signal.sosfilt(sos, centred))


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """
    Response ``S_uy / S_uu`` of an output to an input at frequencies [Hz], all of shape (n,).

    The coherence is ``c = |S_uy|^2 / (S_uu S_yy)``.  The relative standard deviation of the
    magnitude is ``sqrt((1 - c) / (2 c L))`` for L segments.
    """

    frequency: Array
    response: NDArray[np.complex128]
    coherence: Array
    std: Array

    def at(self, kept: Mask) -> FrequencyResponse:
        """Select some frequencies of the response."""
        names = ('frequency', 'response', 'coherence', 'std')
        return replace(self, **{name: getattr(self, name)[kept] for name in names})


def frequency_response(
    u: Array, y: Array, sample_rate: float, band: float | None = None
) -> FrequencyResponse:
    """
    Estimate the response from u to y, shape (n,), by Welch's method, up to a frequency [Hz].

    Linear trends are removed segment by segment.  After Bendat and Piersol, Random Data, 4th ed.
    (2010), table 9.6, doi:10.1002/9781118032428.
    """
    response = _response([(u, y)], min(_power_of_two(u.size // 16), SEGMENT), sample_rate)
    f = response.frequency
    return response.at((f > 0.0) & (f <= (np.inf if band is None else band)))


def broadband_response(
    parts: Sequence[tuple[Array, Array, Array]], sample_rate: float
) -> FrequencyResponse | None:
    """
    Estimate the response from the output of a hysteresis to the displacement, from any motion.

    The parts are unbroken stretches of any length: voltage, output of the hysteresis,
    displacement.  The result holds the frequencies that both voltage and displacement show.  The
    result is None if these frequencies are too few, as with a single sine.
    """
    longest = max((v.size for v, _, _ in parts), default=0)
    segment = min(_power_of_two(longest // 16), SEGMENT)
    parts = [part for part in parts if part[0].size >= segment]
    if not parts:
        return None
    driven = _response([(v, y) for v, _, y in parts], segment, sample_rate)
    response = _response([(w, y) for _, w, y in parts], segment, sample_rate)
    # H has output at frequencies without voltage, where the response would only describe H itself
    told = np.maximum(driven.std, response.std) <= TRUSTED
    # a Hann window blurs the lowest two bins, next to the trend that was removed
    told[:3] = False
    return response.at(told) if told.sum() >= POINTS else None


def _power_of_two(n: int) -> int:
    return int(2 ** np.floor(np.log2(max(n, 16))))


def _response(
    parts: Sequence[tuple[Array, Array]], segment: int, sample_rate: float
) -> FrequencyResponse:
    sums = [cross_spectra(u, y, segment) for u, y in parts]
    s_uu, s_yy = (np.sum([each[i] for each in sums], axis=0) for i in (0, 1))
    s_uy = np.sum([each[2] for each in sums], axis=0)
    averages = sum(max(1, 2 * u.size // segment - 1) for u, _ in parts)
    tiny = np.finfo(float).tiny
    coherence = np.clip(np.abs(s_uy) ** 2 / np.maximum(s_uu * s_yy, tiny), 0.0, 1.0)
    return FrequencyResponse(
        frequency=fft.rfftfreq(segment, 1.0 / sample_rate),
        response=s_uy / np.maximum(s_uu, tiny),
        coherence=coherence,
        std=np.sqrt((1.0 - coherence) / (2.0 * np.maximum(coherence, 1e-12) * averages)),
    )


def highest_frequency(u: Array, rate: float) -> float:
    """Find the frequency [Hz] below which all but a millionth of the power of changing u lies."""
    du = np.diff(u)
    if du.size == 0:
        return 0.0
    size = min(du.size, 1 << 17)
    power = np.zeros(size // 2 + 1)
    for start in range(0, du.size - size + 1, size):
        power += np.abs(np.fft.rfft(du[start : start + size])) ** 2
    # power of u, not of its derivative
    frequency = np.fft.rfftfreq(size, 1.0 / rate)
    power[1:] /= frequency[1:] ** 2
    total = np.cumsum(power)
    if total[-1] == 0.0:
        return rate / 2.0
    return float(frequency[int(np.searchsorted(total, (1.0 - 1e-6) * total[-1]))])


def high_passed(x: Array, rate: float) -> Array:
    """High-pass a signal at `HIGH_PASS`, or only subtract its start if the rate is too low."""
    if 4.0 * HIGH_PASS > rate:
        return np.asarray(x - x[0])
    sos = signal.butter(2, HIGH_PASS, btype='highpass', fs=rate, output='sos')
    return np.asarray(signal.sosfilt(sos, x - x[0]))


def rms_above(u: Array, rate: float, edge: float) -> Array:
    """Compute the running rms of the part of u above the frequency `edge` [Hz], shape (n,)."""
    if 4.0 * edge > rate:
        return np.zeros(u.size)
    width = max(1, int(WINDOW * rate))
    sos = signal.butter(2, edge, btype='highpass', fs=rate, output='sos')
    # filter both ways with mirrored ends, so that a record that starts in motion does not jump
    pad = min(u.size - 1, int(3.0 * rate / edge))
    power = ndimage.uniform_filter1d(signal.sosfiltfilt(sos, u, padlen=pad) ** 2, width)
    return np.asarray(np.sqrt(np.maximum(power, 0.0)))


class NoiseSegment(NamedTuple):
    """Input and output of a noise segment, prefiltered to its band [Hz]; the end is held out."""

    fitted: tuple[Array, Array]
    held: tuple[Array, Array]
    band: float


def noise_segment(run: Run, signal: Array, start: int, stop: int) -> NoiseSegment:
    """Cut out noise with another input; IdentificationError if v or y is constant there."""
    rate = run.piece.sample_rate
    for name, x in (('voltage', run.u), ('displacement', run.x)):
        if np.ptp(x[start:stop]) == 0.0:
            raise IdentificationError(
                f'{run.record}: the {name} is constant in the noise at {run.piece.t[start]:.4g} s'
            )
    band = band_of(run, start, stop)
    u, y = (prefilter(x[start:stop], rate, band) for x in (signal, run.x))
    fit = slice(min(500, u.size // 20), u.size - int(END_HELD * u.size))
    return NoiseSegment((u[fit], y[fit]), (u[fit.stop :], y[fit.stop :]), band)


def band_of(run: Run, start: int, stop: int) -> float:
    """Find the highest frequency of the voltage between two samples [Hz]."""
    u = run.u[start:stop]
    return excited_band(u - u.mean(), run.piece.sample_rate)


def longest_noise(runs: Sequence[Run]) -> tuple[Run, int, int]:
    """
    Find the longest unbroken noise: its run, its first sample and the sample behind its last.

    Raises IdentificationError if it is too short.
    """
    stretches = [
        (stop - start, run, start, stop)
        for run in runs
        for s in run.piece.find('noise')
        for start, stop in run.unbroken(s.start, s.stop)
    ]
    n, run, start, stop = max(stretches, key=lambda item: item[0])
    if n < 2000:
        raise IdentificationError(
            f'{run.record}: the noise segment has {n} samples; at least 2000 are needed'
        )
    return run, start, stop

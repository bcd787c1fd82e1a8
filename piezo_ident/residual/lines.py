# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Narrow lines in a residual that the drive did not make: hum, its harmonics, any other source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.residual.line_series import (
    FEWEST,
    Noise,
    noise_around,
    Series,
    series_of,
    spectrum_of,
)
from piezo_ident.residual.stretches import ResidualPart, Stretch, strokes_of
from scipy import fft
from scipy.special import gammaincc

__all__ = ['Line', 'LineSearch', 'find_lines', 'without_lines']

#: most lines that are looked for
LINES = 6
#: chance of one false line in a search
SIGNIFICANT = 1e-3
#: lines below this share of the stroke are nothing's cause; converters make them
SMALLEST = 1e-5
#: points of the common grid in one bin of the whole search
FINE = 2.5
#: between two bins the largest score is found more often than at them; seen in white noise
TRIALS = 4.0
#: a line is the same everywhere: in each half of the data this share of its amplitude, at least
STEADY = 0.5
#: harmonics that are grouped under their base
HARMONICS = (2, 3)


@dataclass(frozen=True)
class Line:
    """
    One narrow line.

    Attributes
    ----------
    frequency : float
        [Hz]
    std : float
        Of the frequency [Hz].
    amplitude : float
        Largest over the records [m].
    p_value : float
        Chance of such a peak anywhere in the search without a line.
    harmonics : tuple of (int, Line)
        Order of each harmonic found with it, and the harmonic.
    records : tuple of (str, float, float)
        Record, amplitude [m] and phase [rad] of the sine at the record's time zero.
    """

    frequency: float
    std: float
    amplitude: float
    p_value: float
    harmonics: tuple[tuple[int, Line], ...] = ()
    records: tuple[tuple[str, float, float], ...] = ()


@dataclass(frozen=True)
class LineSearch:
    """
    The lines found, and what the search could see.

    Attributes
    ----------
    lines : tuple of Line
        By falling amplitude.
    lowest, highest : float
        Band that was searched [Hz]; zero when no stretch is long enough.
    smallest : float
        Amplitude that would just have been found in the middle of the band [m].
    """

    lines: tuple[Line, ...]
    lowest: float = 0.0
    highest: float = 0.0
    smallest: float = float('inf')


def find_lines(parts: Sequence[ResidualPart], stretches: Sequence[Stretch]) -> LineSearch:
    """
    Search for narrow lines that are not locked to the drive.

    Where v repeats, the residual of consecutive periods is subtracted: what the drive makes,
    with all its harmonics, is gone, and a line of any other frequency stays with a known gain.
    A stretch is weighted by its own noise around each frequency, so the score is that of the best
    common sine of a record, each with its own phase.

    Parameters
    ----------
    parts : sequence of ResidualPart
        Of one sampling rate.
    stretches : sequence of Stretch

    Returns
    -------
    LineSearch

    Notes
    -----
    The test holds a peak against its neighbours, as Fisher (1929), Proc. R. Soc. A 125, 54-59,
    doi:10.1098/rspa.1929.0151, and is corrected for the number of bins.
    """
    series, rate, high = series_of(parts, stretches)
    if not series:
        return LineSearch(())
    seconds = max(s.t + s.x.size / rate for s in series) - min(s.t for s in series)
    size = fft.next_fast_len(round(FINE * seconds * rate), real=True)
    longest = max(s.x.size for s in series) / rate
    f = np.arange(1 + int(high / rate * size)) * (rate / size)
    keep = (f >= (FEWEST + 2) / longest) & (f <= high)
    bins = max(1.0, TRIALS * float(keep.sum()) / FINE)
    records = sorted({s.record for s in series})
    found: list[Line] = []
    spectra = [spectrum_of(s, size)[: f.size] for s in series]
    noises = [noise_around(s, rate, f) for s in series]
    negligible = SMALLEST * max(strokes_of(parts).values())
    smallest = float('inf')
    for _ in range(2 * LINES):
        score, information, gain = _score(series, spectra, noises, f, records)
        score = np.where(keep, score, 0.0)
        if not found:
            with np.errstate(divide='ignore'):
                least = np.sqrt(4.0 * np.log(bins / SIGNIFICANT) / information)
            smallest = float(np.median(least[keep])) if keep.any() else smallest
            smallest = max(smallest, negligible)
        # strong lines are significant beside themselves too; the strongest is where it is
        chances = np.minimum(1.0, bins * np.exp(-score))
        significant = keep & (chances <= SIGNIFICANT)
        if len(found) == LINES or not significant.any():
            break
        best = int(np.argmax(np.where(significant, gain, -1.0)))
        p_value = float(chances[best])
        frequency, std = _refined(series, noises, f, best, rate, float(f[1]))
        fits = [(name, *_sine(series, noises, f, frequency, rate, name)) for name in records]
        amplitude = max(float(a) for _, a, _ in fits)
        if amplitude >= negligible and _steady(series, noises, f, frequency, rate, records):
            found.append(Line(frequency, std, amplitude, p_value, (), tuple(fits)))
            series = [_without(s, frequency, fits, rate) for s in series]
            spectra = [spectrum_of(s, size)[: f.size] for s in series]
            noises = [noise_around(s, rate, f) for s in series]
        keep &= np.abs(f - frequency) > 2.0 / longest
    band = f[(f >= (FEWEST + 2) / longest) & (f <= high)]
    lowest, highest = (float(band[0]), float(band[-1])) if band.size else (0.0, 0.0)
    return LineSearch(_grouped(found, 2.0 / longest), lowest, highest, smallest)


def _parts_of(
    s: Series,
    spectrum: NDArray[np.complex128],
    noise: Noise,
    f: NDArray[np.float64],
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Return the matched filter and its information at each f."""
    response = s.gain(f) * (0.5 * s.window.sum())
    weight = 1.0 / noise[0]
    return (
        np.asarray(np.conj(response) * spectrum * weight),
        np.asarray(np.abs(response) ** 2 * weight),
    )


def _score(
    series: Sequence[Series],
    spectra: Sequence[NDArray[np.complex128]],
    noises: Sequence[Noise],
    f: NDArray[np.float64],
    records: Sequence[str],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """
    Return for every f -ln of its chance under noise alone, the information, and the gain.

    The gain is what a sine takes off the weighted squares: its maximum is the frequency, while
    the chance also depends on how well the noise is known there.
    """
    total, most, gain = np.zeros(f.size), np.zeros(f.size), np.zeros(f.size)
    for name in records:
        top = np.zeros(f.size, dtype=np.complex128)
        information, doubt = np.zeros(f.size), np.zeros(f.size)
        for s, spectrum, noise in zip(series, spectra, noises, strict=True):
            if s.record != name:
                continue
            matched, told = _parts_of(s, spectrum, noise, f)
            top += matched
            information += told
            doubt += told * told / noise[1]
        safe = np.maximum(information, np.finfo(float).tiny)
        ratio = np.abs(top) ** 2 / safe
        # F with 2 and 2k degrees of freedom, since the noise is itself an estimate: that of each
        # stretch for itself, so their doubts average (Welch and Satterthwaite)
        k = np.maximum(safe**2 / np.maximum(doubt, np.finfo(float).tiny), 1.0)
        gain += ratio
        total += k * np.log1p(ratio / k)
        most = np.maximum(most, information)
    if len(records) > 1:
        # a sum of exponential variables; far out the asymptotic form, which does not underflow
        n = len(records)
        p = gammaincc(n, total)
        with np.errstate(divide='ignore', invalid='ignore'):
            far = total - (n - 1) * np.log(np.maximum(total, 1.0)) + _log_factorial(n - 1)
            total = np.where(total > 500.0, far, -np.log(np.maximum(p, 1e-300)))
    return total, most, gain


def _log_factorial(n: int) -> float:
    return float(np.sum(np.log(np.arange(1, n + 1))))


def _at(s: Series, f: float, rate: float, part: slice = slice(None)) -> tuple[complex, float]:
    """Return the windowed transform at one f, of a part of the stretch, and the window's sum."""
    x = (s.window * s.x)[part]
    start = part.start or 0
    t = s.t + (start + np.arange(x.size)) / rate
    return complex(np.sum(x * np.exp(-2j * np.pi * f * t))), float(s.window[part].sum())


def _fit(
    series: Sequence[Series],
    noises: Sequence[Noise],
    f: NDArray[np.float64],
    frequency: float,
    rate: float,
    record: str,
    half: int | None = None,
) -> tuple[complex, float]:
    """Return the best common amplitude of a record's stretches, and the information on it."""
    k = int(np.clip(np.rint(frequency / f[1]), 0, f.size - 1))
    top, bottom = 0j, 0.0
    for s, noise in zip(series, noises, strict=True):
        if s.record != record:
            continue
        middle = s.x.size // 2
        part = slice(None) if half is None else (slice(0, middle), slice(middle, None))[half]
        z, weight = _at(s, frequency, rate, part)
        response = complex(s.gain(np.array(frequency))) * 0.5 * weight
        top += np.conj(response) * z / noise[0][k]
        bottom += abs(response) ** 2 / noise[0][k]
    return (top / bottom if bottom > 0.0 else 0j), bottom


def _refined(
    series: Sequence[Series],
    noises: Sequence[Noise],
    f: NDArray[np.float64],
    best: int,
    rate: float,
    step: float,
) -> tuple[float, float]:
    """Return the frequency of the least squared error and its standard deviation."""

    def gain(frequency: float) -> float:
        total = 0.0
        for name in {s.record for s in series}:
            a, information = _fit(series, noises, f, frequency, rate, name)
            total += abs(a) ** 2 * information
        return total

    centre, curvature = float(f[best]), 0.0
    for width in (0.5 * step, 0.1 * step):
        left, middle, right = (gain(centre + d) for d in (-width, 0.0, width))
        bend = left - 2.0 * middle + right
        if bend < 0.0:
            centre += float(np.clip(0.5 * width * (left - right) / bend, -width, width))
            curvature = -bend / width**2
    # the gain is half of twice the logarithm of the likelihood
    return centre, float(1.0 / np.sqrt(2.0 * curvature)) if curvature > 0.0 else float('inf')


def _sine(
    series: Sequence[Series],
    noises: Sequence[Noise],
    f: NDArray[np.float64],
    frequency: float,
    rate: float,
    record: str,
) -> tuple[float, float]:
    """Return amplitude and phase of A sin(2 pi f t + phase)."""
    a, _ = _fit(series, noises, f, frequency, rate, record)
    return float(abs(a)), float(np.angle(1j * a))


def _steady(
    series: Sequence[Series],
    noises: Sequence[Noise],
    f: NDArray[np.float64],
    frequency: float,
    rate: float,
    records: Sequence[str],
) -> bool:
    """Return whether both halves of the stretches see the same sine; a transient does not."""
    for name in records:
        whole, information = _fit(series, noises, f, frequency, rate, name)
        if abs(whole) ** 2 * information < 12.0:
            continue
        for half in (0, 1):
            a, told = _fit(series, noises, f, frequency, rate, name, half)
            off = abs(a - whole)
            if off > (1.0 - STEADY) * abs(whole) + 3.0 / np.sqrt(max(told, 1e-300)):
                return False
    return True


def _without(
    s: Series, frequency: float, fits: Sequence[tuple[str, float, float]], rate: float
) -> Series:
    amplitude, phase = next((a, b) for name, a, b in fits if name == s.record)
    t = s.t + np.arange(s.x.size) / rate
    gain = complex(s.gain(np.array(frequency)))
    wave = gain * amplitude * np.exp(1j * (2.0 * np.pi * frequency * t + phase))
    return replace(s, x=s.x - wave.imag)


def _grouped(found: Sequence[Line], width: float) -> tuple[Line, ...]:
    left = sorted(found, key=lambda line: line.frequency)
    grouped = []
    while left:
        base = left.pop(0)
        harmonics = []
        for order in HARMONICS:
            for line in left:
                if abs(line.frequency - order * base.frequency) <= width:
                    harmonics.append((order, line))
                    left.remove(line)
                    break
        grouped.append(
            Line(
                base.frequency,
                base.std,
                base.amplitude,
                base.p_value,
                tuple(harmonics),
                base.records,
            )
        )
    return tuple(sorted(grouped, key=lambda line: -line.amplitude))


def without_lines(part: ResidualPart, lines: Sequence[Line]) -> ResidualPart:
    """
    Return a part without the lines found in its record, harmonics included as they were fitted.

    Parameters
    ----------
    part : ResidualPart
    lines : sequence of Line
    """
    own = [
        (line.frequency, amplitude, phase)
        for base in lines
        for line in (base, *(harmonic for _, harmonic in base.harmonics))
        for name, amplitude, phase in line.records
        if name == part.record
    ]
    if not own:
        return part
    e, t = part.e.copy(), part.piece.t
    for frequency, amplitude, phase in own:
        e -= amplitude * np.sin(2.0 * np.pi * frequency * t + phase)
    return part.with_residual(e)

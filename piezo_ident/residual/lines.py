# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Find narrow lines in a residual that the drive did not cause: hum, its harmonics, other sources.

The best common sine of all stretches is tested against its neighbours, as by Fisher (1929), Proc.
R. Soc. A 125, 54-59, doi:10.1098/rspa.1929.0151.  Each stretch is weighted by its own noise around
the frequency (`line_spectrum`).  The test is corrected for the number of bins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.residual.line_spectrum import FAINT, FEWEST, Series, series_of, Spectrum
from piezo_ident.residual.stretches import DriveStretch, ResidualPart, strokes_of
from scipy import fft
from scipy.ndimage import maximum_filter1d
from scipy.special import gammaincc, gammaln

#: most lines of a search
LINES = 6
#: chance of one false line in a search
SIGNIFICANT = 1e-3
#: least amplitude of a line as a share of the stroke, and of the rms residual.  Converters make
#: smaller lines, and so does motion that is nearly locked to the drive
SMALLEST, SIDELINE = 1e-5, 0.01
#: points of the common grid in one bin of the whole time of a search
FINE = 2.5
#: independent trials in one bin: the largest score is mostly between two bins (white noise)
TRIALS = 4.0
#: least share of the amplitude of a line in each half of the data
STEADY = 0.5
#: least maximum of the gain near a line that is refined, as a share of the largest gain
LOBE = 0.4
#: two lines ring as one mode if their amplitudes (this ratio) and frequencies (share) are alike
COMPARABLE, BESIDE = 0.5, 0.02
#: harmonics that are grouped under their base
HARMONICS = (2, 3, 4, 5, 6, 7, 8, 9)


@dataclass(frozen=True)
class Line:
    """
    One narrow line [Hz], with its largest amplitude over the records [m].

    `harmonics` are (order, line); `records` are (record, amplitude [m], phase [rad] of the sine at
    time zero of the record).
    """

    frequency: float
    amplitude: float
    harmonics: tuple[tuple[int, Line], ...] = ()
    records: tuple[tuple[str, float, float], ...] = ()


@dataclass(frozen=True)
class LineSearch:
    """Lines by falling amplitude, and whether a stretch was long enough for a search."""

    lines: tuple[Line, ...] = ()
    searched: bool = False


def find_lines(parts: Sequence[ResidualPart], stretches: Sequence[DriveStretch]) -> LineSearch:
    """
    Search residuals of one sampling rate for narrow lines that are not locked to the drive.

    Where v repeats, the residuals of consecutive periods are subtracted.  Their difference holds
    nothing that the drive causes, and lines of other frequencies with a known gain.
    """
    series, rate, high = series_of(parts, stretches)
    if not series:
        return LineSearch()
    strokes = strokes_of(parts)
    seconds = max(s.t + s.x.size / rate for s in series) - min(s.t for s in series)
    size = fft.next_fast_len(round(FINE * seconds * rate), real=True)
    longest = max(s.x.size for s in series) / rate
    f = np.arange(1 + int(high / rate * size)) * (rate / size)
    keep = (f >= (FEWEST + 2) / longest) & (f <= high)
    searched = bool(keep.any())
    bins = max(1.0, TRIALS * float(keep.sum()) / FINE)
    residuals = {name: [p.e[p.mask] for p in parts if p.record == name] for name in strokes}
    rms = min(float(np.std(np.concatenate(e))) for e in residuals.values())
    negligible = max(SMALLEST * max(strokes.values()), SIDELINE * rms)
    search = _Search(series, f, size)
    found: list[Line] = []
    score, gain = search.score()
    for _ in range(2 * LINES):
        # a strong line is significant beside its frequency, too: the largest gain is the line
        significant = keep & (bins * np.exp(-score) <= SIGNIFICANT)
        if len(found) == LINES or not significant.any():
            break
        best = int(np.argmax(np.where(significant, gain, -1.0)))
        frequency = search.refined(best)
        sines = [(name, *search.sine(frequency, name, best)) for name in search.records]
        amplitude = max(a for _, a, _ in sines)
        if amplitude >= negligible and search.is_steady(frequency, best):
            found.append(Line(frequency, amplitude, (), tuple(sines)))
            search = search.without(found[-1])
            score, gain = search.score()
            # the last line, and lines of similar size and frequency
            crowd = [
                line
                for line in found
                if abs(line.frequency - frequency) <= BESIDE * frequency
                and COMPARABLE <= amplitude / line.amplitude <= 1.0 / COMPARABLE
            ]
            if len(crowd) > 1:
                found = [line for line in found if line not in crowd]
                keep &= np.abs(f - frequency) > BESIDE * frequency
        # the refined frequency may lie some bins away from the highest gain
        keep &= np.minimum(np.abs(f - frequency), np.abs(f - f[best])) > 2.0 / longest
    return LineSearch(_grouped(found, 2.0 / longest), searched)


class _Search:
    """The series with their spectra on a common grid of frequencies f [Hz]."""

    def __init__(self, series: Sequence[Series], f: Array, size: int) -> None:
        self._f, self._size = f, size
        self._spectra = [Spectrum.of(s, f, size) for s in series]
        self.records = sorted({s.record for s in series})

    def without(self, line: Line) -> _Search:
        """Subtract a line from all series."""
        sines = {name: (amplitude, phase) for name, amplitude, phase in line.records}
        series = []
        for spectrum in self._spectra:
            s = spectrum.series
            amplitude, phase = sines[s.record]
            t = s.t + np.arange(s.x.size) / s.rate
            gain = complex(s.gain(np.array(line.frequency)))
            wave = gain * amplitude * np.exp(1j * (2.0 * np.pi * line.frequency * t + phase))
            series.append(replace(s, x=s.x - wave.imag))
        return _Search(series, self._f, self._size)

    def score(self) -> tuple[Array, Array]:
        """
        Compute -ln of the chance under noise alone for every f, and the gain.

        The gain is the sum of weighted squares that a sine explains, and has its maximum at the
        frequency of the line.  The chance depends on the uncertainty of the noise there, too.
        """
        n = self._f.size
        total, gain = np.zeros(n), np.zeros(n)
        tiny = np.finfo(float).tiny
        for name in self.records:
            top = np.zeros(n, dtype=np.complex128)
            information, doubt = np.zeros(n), np.zeros(n)
            for s in self._spectra:
                if s.series.record != name:
                    continue
                response = s.series.gain(self._f) * (0.5 * s.series.window.sum())
                weight = 1.0 / s.noise
                own = np.abs(response) ** 2 * weight
                top += np.conj(response) * s.values * weight
                information += own
                doubt += own * own / s.worth
            safe = np.maximum(information, tiny)
            ratio = np.abs(top) ** 2 / safe
            # F with 2 and 2k degrees of freedom, as each noise is an estimate (Satterthwaite)
            k = np.maximum(safe**2 / np.maximum(doubt, tiny), 1.0)
            gain += ratio
            total += k * np.log1p(ratio / k)
        return _log_chance(total, len(self.records)), gain

    def refined(self, best: int) -> float:
        """
        Find the frequency of the least squared error near a grid point, with the noise there.

        The noise of one point is used, as a strong line counts as noise of the bins beside it.
        Stretches far apart agree nearly as well at many frequencies between two points of the
        grid, so every maximum is refined.
        """
        power = [abs(s.values[best]) ** 2 / s.noise[best] for s in self._spectra]
        series = self._spectra[int(np.argmax(power))].series
        reach = round(3.0 * series.rate / series.x.size / float(self._f[1]))
        near = np.arange(max(best - reach, 1), min(best + reach + 1, self._f.size))
        transforms = [s.between(self._f, near) for s in self._spectra]

        def gain(f: Array) -> Array:
            return self._gains(f, [transform(f) for transform in transforms], best)

        centres, step = self._f[near], float(self._f[1])
        gains = gain(centres)
        centres = centres[(gains == maximum_filter1d(gains, 3)) & (gains > LOBE * gains.max())]
        for width in (0.5 * step, 0.1 * step):
            left, middle, right = (gain(centres + d) for d in (-width, 0.0, width))
            bend = left - 2.0 * middle + right
            move = 0.5 * width * (left - right) / np.where(bend < 0.0, bend, -np.inf)
            centres = centres + np.clip(move, -width, width)
        return float(centres[np.argmax(gain(centres))])

    def _gains(self, f: Array, values: Sequence[NDArray[np.complex128]], best: int) -> Array:
        """Compute the weighted squares that a sine at f explains, by the transforms there."""
        gains = np.zeros(f.size)
        for name in self.records:
            top, information = np.zeros(f.size, np.complex128), np.zeros(f.size)
            for s, value in zip(self._spectra, values, strict=True):
                if s.series.record == name:
                    response = s.series.gain(f) * (0.5 * s.series.window.sum())
                    top += np.conj(response) * value / s.noise[best]
                    information += np.abs(response) ** 2 / s.noise[best]
            gains += np.abs(top) ** 2 / np.maximum(information, np.finfo(float).tiny)
        return gains

    def sine(self, frequency: float, record: str, best: int) -> tuple[float, float]:
        """Fit amplitude and phase of A sin(2 pi f t + phase) to a record."""
        a, _ = self._fit(frequency, record, best)
        return float(abs(a)), float(np.angle(1j * a))

    def is_steady(self, frequency: float, best: int) -> bool:
        """Tell whether both halves of the stretches hold the same sine, unlike a transient."""
        for name in self.records:
            whole, information = self._fit(frequency, name, best)
            if abs(whole) ** 2 * information < 12.0:
                continue
            for half in (0, 1):
                a, own = self._fit(frequency, name, best, half)
                spread = 3.0 / np.sqrt(max(own, 1e-300))
                if abs(a - whole) > (1.0 - STEADY) * abs(whole) + spread:
                    return False
        return True

    def _fit(
        self, frequency: float, record: str, k: int, half: int | None = None
    ) -> tuple[complex, float]:
        """
        Fit the common complex amplitude of a record's stretches; also return its information.

        The noise is taken at index k; stretches with a faint gain do not count.
        """
        top, bottom = 0j, 0.0
        for spectrum in self._spectra:
            s = spectrum.series
            if s.record != record:
                continue
            middle = s.x.size // 2
            part = slice(None) if half is None else (slice(0, middle), slice(middle, None))[half]
            x = (s.window * s.x)[part]
            t = s.t + ((part.start or 0) + np.arange(x.size)) / s.rate
            z = complex(np.sum(x * np.exp(-2j * np.pi * frequency * t)))
            gain = complex(s.gain(np.array(frequency)))
            if abs(gain) < FAINT:
                continue
            response = gain * 0.5 * float(s.window[part].sum())
            top += np.conj(response) * z / spectrum.noise[k]
            bottom += abs(response) ** 2 / spectrum.noise[k]
        return (top / bottom if bottom > 0.0 else 0j), bottom


def _log_chance(total: Array, n: int) -> Array:
    """Compute -ln of the chance that a sum of n exponential variables exceeds a total."""
    if n == 1:
        return total
    p = gammaincc(n, total)
    # the asymptotic form of a large total does not underflow
    with np.errstate(divide='ignore', invalid='ignore'):
        far = total - (n - 1) * np.log(np.maximum(total, 1.0)) + float(gammaln(n))
        return np.asarray(np.where(total > 500.0, far, -np.log(np.maximum(p, 1e-300))))


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
        grouped.append(replace(base, harmonics=tuple(harmonics)))
    return tuple(sorted(grouped, key=lambda line: -line.amplitude))


def without_lines(part: ResidualPart, lines: Sequence[Line]) -> ResidualPart:
    """Subtract from a part the lines of its record and their harmonics."""
    e, t = part.e.copy(), part.piece.t if lines else np.zeros(0)
    for base in lines:
        for line in (base, *(harmonic for _, harmonic in base.harmonics)):
            for name, amplitude, phase in line.records:
                if name == part.record:
                    e -= amplitude * np.sin(2.0 * np.pi * line.frequency * t + phase)
    return part.with_residual(e) if lines else part

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Everything that the residual of a model shows, in one result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import DataError
from piezo_ident.model.free_run import sine_frequency
from piezo_ident.model.metrics import percent_of_stroke
from piezo_ident.record.record import Fault, Segment
from piezo_ident.residual.dependence import Curve, curves_of
from piezo_ident.residual.faults import find_faults
from piezo_ident.residual.lines import find_lines, LineSearch, without_lines
from piezo_ident.residual.noise_floor import NoiseFloor, residual_noise_floor
from piezo_ident.residual.stretches import find_repeats, ResidualPart, stretches_of, strokes_of
from piezo_ident.residual.whiteness import (
    Coherence,
    coherence,
    cross_correlation,
    CrossCorrelation,
    Whiteness,
    whiteness,
)

__all__ = ['FrequencyRow', 'ResidualAnalysis', 'SegmentRow', 'analyse']

#: what is dropped at the start of a sine: this time and at least one period [s]
SETTLING = 1.0


@dataclass(frozen=True)
class SegmentRow:
    """
    The residual of n sound samples of one segment, 'all' for a piece without segments.

    `percent` is ``100 rms(e) / stroke`` by the stroke of the whole record, `mean` in metres,
    `share` of the sum of squares of all records, `explainable` the share of the mean square that
    is above the noise floor (None without a floor).
    """

    record: str
    segment: str
    start_time: float
    n: int
    percent: float
    mean: float
    share: float
    explainable: float | None


@dataclass(frozen=True)
class FrequencyRow:
    """
    The residual of one sine in steady state; frequency in Hz, amplitude of the voltage in V.

    `percent` is by the stroke of the samples compared.
    """

    record: str
    segment: str
    frequency: float
    amplitude: float
    percent: float
    n: int


@dataclass(frozen=True, eq=False)
class ResidualAnalysis:
    """
    What the residual of a model shows.

    Attributes
    ----------
    parts : tuple of ResidualPart
        As they were given.
    stroke : float
        Largest ``max y - min y`` of a record [m].
    percent : float
        Rms of all sound residuals in % of the stroke of their records.
    floor : NoiseFloor
    explainable : float or None
        Share of the mean square that a model could explain; None when the floor is unknown.
    segments : tuple of SegmentRow
    frequencies : tuple of FrequencyRow
    whiteness : Whiteness or None
    correlations : tuple of CrossCorrelation
        With v and with dv/dt.
    coherence : Coherence or None
    lines : LineSearch
    curves : tuple of Curve
    faults : tuple of Fault
    bad : tuple of ndarray of bool
        For each part the samples that are missed, outliers or clipped; a fit leaves them out.
    """

    parts: tuple[ResidualPart, ...]
    stroke: float
    percent: float
    floor: NoiseFloor
    explainable: float | None
    segments: tuple[SegmentRow, ...]
    frequencies: tuple[FrequencyRow, ...]
    whiteness: Whiteness | None
    correlations: tuple[CrossCorrelation, ...]
    coherence: Coherence | None
    lines: LineSearch
    curves: tuple[Curve, ...]
    faults: tuple[Fault, ...]
    bad: tuple[NDArray[np.bool_], ...]

    def curve(self, against: str, branch: str | None = None) -> Curve | None:
        """Return the curve over a quantity, the first branch without a name; None without data."""
        for curve in self.curves:
            if curve.against == against and branch in (None, curve.branch):
                return curve
        return None

    @property
    def floor_percent(self) -> float | None:
        """Noise floor in % of the stroke."""
        if self.floor.rms is None or self.stroke == 0.0:
            return None
        return 100.0 * self.floor.rms / self.stroke


def analyse(
    parts: Sequence[ResidualPart], tick: Callable[[float], None] = lambda share: None
) -> ResidualAnalysis:
    """
    Look at the residual of a model from every side.

    Faults of the data come first: missed readings and outliers are bridged, clipped ones left out
    before anything else is read from the residual; the tables hold the residual as it was.

    `tick` is called with the share of the work done, and may raise to stop it.

    Raises
    ------
    DataError
        When there is no sound sample.
    """
    parts = tuple(parts)
    if not any(part.mask.any() for part in parts):
        raise DataError('there is no sound sample whose residual could be looked at')
    faults = find_faults(parts)
    tick(0.2)
    clean = [
        _repaired(p, bad, out) for p, bad, out in zip(parts, faults.bad, faults.out, strict=True)
    ]
    stretches = [s for i, part in enumerate(clean) for s in stretches_of(part, i)]
    tick(0.3)
    lines = find_lines(clean, stretches)
    tick(0.6)
    # a line is no noise: a model may carry it
    quiet = [without_lines(part, lines.lines) for part in clean]
    floor = residual_noise_floor(quiet, stretches)
    tick(0.7)
    correlations = [cross_correlation(quiet, which) for which in ('v', 'dv/dt')]
    white, coherent = whiteness(clean), coherence(clean)
    tick(0.9)
    strokes = strokes_of(parts)
    squares = np.concatenate([clean[i].e[p.mask] ** 2 for i, p in enumerate(clean)])
    relative = sum(
        float(np.sum((p.e[p.mask] / strokes[p.record]) ** 2)) for p in parts if strokes[p.record]
    )
    return ResidualAnalysis(
        parts=parts,
        stroke=max(strokes.values()),
        percent=100.0 * float(np.sqrt(relative / sum(int(p.mask.sum()) for p in parts))),
        floor=floor,
        explainable=floor.share(float(squares.mean())) if squares.size else None,
        segments=_segment_rows(parts, floor),
        frequencies=_frequency_rows(parts),
        whiteness=white,
        correlations=tuple(c for c in correlations if c is not None),
        coherence=coherent,
        lines=lines,
        curves=curves_of(quiet, stretches),
        faults=faults.faults,
        bad=faults.bad,
    )


def _repaired(part: ResidualPart, bad: NDArray[np.bool_], out: NDArray[np.bool_]) -> ResidualPart:
    """Return a part with bad samples bridged, and without those that are to be left out."""
    if not bad.any():
        return part
    e, good = part.e.copy(), ~bad & part.mask
    if not good.any():
        return part
    e[bad] = np.interp(np.flatnonzero(bad), np.flatnonzero(good), e[good])
    return ResidualPart(part.record, part.piece, e, part.mask & ~out)


# -- tables ---------------------------------------------------------------------------------------


def _segment_rows(parts: Sequence[ResidualPart], floor: NoiseFloor) -> tuple[SegmentRow, ...]:
    """Return one row a segment, in order of time."""
    strokes = strokes_of(parts)
    total = sum(float(np.sum(p.e[p.mask] ** 2)) for p in parts)
    rows = []
    for part in parts:
        for s in part.piece.segments or (Segment('all', 0, part.piece.n),):
            mask = part.mask[s.start : s.stop]
            e = part.e[s.start : s.stop][mask]
            if e.size == 0:
                continue
            y = part.piece.y[s.start : s.stop][mask]
            power = float(e @ e)
            rows.append(
                SegmentRow(
                    record=part.record,
                    segment=s.label,
                    start_time=float(part.piece.start_time + s.start / part.piece.sample_rate),
                    n=e.size,
                    percent=percent_of_stroke(y, y - e, strokes[part.record]),
                    mean=float(e.mean()),
                    share=power / total if total > 0.0 else 0.0,
                    explainable=floor.share(power / e.size),
                )
            )
    return tuple(rows)


def _frequency_rows(parts: Sequence[ResidualPart]) -> tuple[FrequencyRow, ...]:
    """
    Return one row a sine, by frequency.

    The first second and at least one period are dropped where as much is left; of shorter sines
    one period.
    """
    rows = []
    for part in parts:
        rate = part.piece.sample_rate
        for s in part.piece.find('sine'):
            frequency = sine_frequency(s.label) or _frequency(part, s)
            if frequency is None:
                continue
            period = rate / frequency
            start = s.start + int(np.ceil(max(SETTLING * rate, period)))
            if s.stop - start < period - 0.5:
                start = s.start + int(np.ceil(period))
            mask = part.mask[start : s.stop]
            if mask.sum() < period - 0.5:
                continue
            y, e = part.piece.y[start : s.stop][mask], part.e[start : s.stop][mask]
            rows.append(
                FrequencyRow(
                    record=part.record,
                    segment=s.label,
                    frequency=float(frequency),
                    amplitude=0.5 * float(np.ptp(part.piece.v[start : s.stop])),
                    percent=percent_of_stroke(y, y - e),
                    n=int(mask.sum()),
                )
            )
    return tuple(sorted(rows, key=lambda row: (row.frequency, row.amplitude)))


def _frequency(part: ResidualPart, s: Segment) -> float | None:
    """Return the frequency of a sine whose label does not say it."""
    v = part.piece.v[s.start : s.stop]
    repeats = find_repeats(v)
    if not repeats:
        return None
    start, _, period = max(repeats, key=lambda r: r[1] - r[0])
    spectrum = np.abs(np.fft.rfft(v[start : start + period] - v[start : start + period].mean()))
    return float(np.argmax(spectrum) * part.piece.sample_rate / period)

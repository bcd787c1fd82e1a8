# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The residual in numbers, segment by segment and frequency by frequency."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.model.free_run import sine_frequency
from piezo_ident.model.metrics import percent_of_stroke
from piezo_ident.record.record import Segment
from piezo_ident.residual.floor import NoiseFloor
from piezo_ident.residual.stretches import find_repeats, ResidualPart, strokes_of

__all__ = ['FrequencyRow', 'RecordRow', 'SegmentRow', 'frequency_rows', 'record_rows', 'rows_of']

#: what is dropped at the start of a sine: this time and at least one period [s]
SETTLING = 1.0


@dataclass(frozen=True)
class RecordRow:
    """
    The residual of one record.

    Attributes
    ----------
    record : str
    n : int
        Sound samples.
    stroke : float
        ``max y - min y`` [m].
    percent : float
        `piezo_ident.model.metrics.percent_of_stroke`.
    mean : float
        Of the residual [m].
    explainable : float or None
        Share of the mean square that is above the noise floor; None without a floor.
    """

    record: str
    n: int
    stroke: float
    percent: float
    mean: float
    explainable: float | None


@dataclass(frozen=True)
class SegmentRow:
    """
    The residual of one segment.

    Attributes
    ----------
    record, segment : str
        The label; 'all' for a piece without segments.
    start_time : float
        [s]
    n : int
        Sound samples.
    percent : float
        ``100 rms(e) / (max y - min y)``, by the stroke of the whole record.
    mean : float
        Of the residual [m].
    share : float
        Of the sum of squares of all records.
    explainable : float or None
        As in `RecordRow`.
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
    The residual of one sine in steady state.

    Attributes
    ----------
    record, segment : str
    frequency : float
        [Hz]
    amplitude : float
        Of the voltage [V].
    percent : float
        ``100 rms(e) / (max y - min y)``, by the stroke of the samples compared.
    n : int
    """

    record: str
    segment: str
    frequency: float
    amplitude: float
    percent: float
    n: int


def _segments(part: ResidualPart) -> tuple[Segment, ...]:
    return part.piece.segments or (Segment('all', 0, part.piece.n),)


def record_rows(parts: Sequence[ResidualPart], floor: NoiseFloor) -> tuple[RecordRow, ...]:
    """Return one row a record, in order of appearance."""
    rows = []
    for name, stroke in strokes_of(parts).items():
        e = np.concatenate([p.e[p.mask] for p in parts if p.record == name])
        y = np.concatenate([p.piece.y[p.mask] for p in parts if p.record == name])
        if e.size:
            percent = percent_of_stroke(y, y - e, stroke)
            share = floor.share(float(np.mean(e * e)))
            rows.append(RecordRow(name, e.size, stroke, percent, float(e.mean()), share))
    return tuple(rows)


def rows_of(parts: Sequence[ResidualPart], floor: NoiseFloor) -> tuple[SegmentRow, ...]:
    """Return one row a segment, in order of time."""
    strokes = strokes_of(parts)
    total = sum(float(np.sum(p.e[p.mask] ** 2)) for p in parts)
    rows = []
    for part in parts:
        for s in _segments(part):
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


def frequency_rows(parts: Sequence[ResidualPart]) -> tuple[FrequencyRow, ...]:
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

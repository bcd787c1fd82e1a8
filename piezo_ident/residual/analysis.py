# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Everything that the residual of a model shows, in one result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import DataError
from piezo_ident.record.record import Fault
from piezo_ident.residual.dependence import Curve, curves_of
from piezo_ident.residual.faults import find_faults
from piezo_ident.residual.floor import noise_floor, NoiseFloor
from piezo_ident.residual.lines import find_lines, LineSearch, without_lines
from piezo_ident.residual.stretches import ResidualPart, stretches_of, strokes_of
from piezo_ident.residual.tables import (
    frequency_rows,
    FrequencyRow,
    record_rows,
    RecordRow,
    rows_of,
    SegmentRow,
)
from piezo_ident.residual.whiteness import (
    Coherence,
    coherence,
    cross_correlation,
    CrossCorrelation,
    Whiteness,
    whiteness,
)

__all__ = ['ResidualAnalysis', 'analyse']


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
    records : tuple of RecordRow
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
    jitter : float
        Rms of the sampling instants [s], 0 when none is seen.
    quantum : float
        Step of the readings [m], 0 when there is none.
    """

    parts: tuple[ResidualPart, ...]
    stroke: float
    percent: float
    floor: NoiseFloor
    explainable: float | None
    records: tuple[RecordRow, ...]
    segments: tuple[SegmentRow, ...]
    frequencies: tuple[FrequencyRow, ...]
    whiteness: Whiteness | None
    correlations: tuple[CrossCorrelation, ...]
    coherence: Coherence | None
    lines: LineSearch
    curves: tuple[Curve, ...]
    faults: tuple[Fault, ...]
    bad: tuple[NDArray[np.bool_], ...]
    jitter: float
    quantum: float

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

    Parameters
    ----------
    parts : sequence of ResidualPart
    tick : callable, optional
        Called with the share of the work done; may raise to stop it.

    Returns
    -------
    ResidualAnalysis

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
    floor = noise_floor(quiet, stretches)
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
        records=record_rows(parts, floor),
        segments=rows_of(parts, floor),
        frequencies=frequency_rows(parts),
        whiteness=white,
        correlations=tuple(c for c in correlations if c is not None),
        coherence=coherent,
        lines=lines,
        curves=curves_of(quiet, stretches),
        faults=faults.faults,
        bad=faults.bad,
        jitter=faults.jitter,
        quantum=faults.quantum,
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

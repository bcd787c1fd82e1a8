# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Prepare records for fitting: one sampling rate, one scaling, normalised runs with masks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import functools

import numpy as np
from piezo_ident.common.arrays import Array, closed, interpolated, Mask, true_runs
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.refusals import refuse_closed_loop, refuse_undriven
from piezo_ident.model.initial_memory import forgotten
from piezo_ident.model.scaling import REST, Scaling
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.play import initial_memory
from piezo_ident.record.readings.faults import without_faults
from piezo_ident.record.readings.gaps import bridged, FEW
from piezo_ident.record.readings.quiet_voltage import with_quiet_voltage
from piezo_ident.record.readings.suspicions import rises_first, suspicions
from piezo_ident.record.record import Piece, Record

#: number of blocks into which a triangle is cut; one in `EVERY` is held out
BLOCKS, EVERY = 60, 5
#: share at the end of every noise and step segment that is not fitted
END_HELD = 0.2
#: share of its range by which the voltage of a run must move
MOVES = 0.02
#: largest change of the voltage within one averaged row, as a share of its range
ROW_SPAN = 2e-3
#: most lost readings in a row that `Excerpt.span` bridges (taste).  The voltage may turn at lost
#: readings, but not in a held-out block, and held-out blocks are longer
LOST = 50
#: smallest number of averages that tells a correlation (taste)
AVERAGES = 20
#: number of samples of all records that are used, at some 60 bytes each; longer records are cut
MOST_SAMPLES = 40_000_000


@dataclass(frozen=True, eq=False)
class Excerpt:
    """
    Normalised input and displacement of a fit, shape (n,), and a mask of the samples that count.

    Plays and dynamics need the whole input.  `memory` gives the play outputs before the first
    sample as a function of the thresholds.  By default, the voltage last came down to its lowest
    value.
    """

    u: Array
    x: Array
    use: Mask
    memory: Callable[[Array], Array] | None = None

    def start(self, thresholds: Array) -> Array:
        """Compute the play outputs before the first sample."""
        if self.memory is None:
            return initial_memory(float(self.u[0]), thresholds)
        return self.memory(thresholds)

    @functools.cached_property
    def stretches(self) -> list[tuple[int, int]]:
        """Unbroken stretches of samples that count, as (start, stop)."""
        return true_runs(self.use)

    @functools.cached_property
    def span(self) -> tuple[float, float]:
        """Lowest and highest input of the stretches; the voltage of a lost reading is known."""
        u = self.u[closed(self.use, LOST)]
        return (float(u.min()), float(u.max())) if u.size else (np.inf, -np.inf)

    @property
    def swing(self) -> float:
        """Width of `span`; zero if no sample counts."""
        return max(self.span[1] - self.span[0], 0.0)

    @functools.cached_property
    def averaged(self) -> list[tuple[int, int]]:
        """Stretches whose rows are averaged, joined over gaps shorter than a row."""
        return true_runs(closed(self.use, min(FEW, self.row - 1)))

    @functools.cached_property
    def row(self) -> int:
        """Number of samples that one row of a fit of H may average."""
        if not self.use.any():
            return 1
        speed = float(np.abs(np.diff(self.u)).max(initial=0.0, where=self.use[1:]))
        span = ROW_SPAN * self.swing
        return max(
            1, min(int(span / speed) if speed > 0.0 else 1, int(self.use.sum()) // 10_000, 50)
        )

    @property
    def rows(self) -> int:
        """Number of rows after averaging; white noise is independent from row to row."""
        return sum((stop - start) // self.row for start, stop in self.averaged)


@dataclass(frozen=True, eq=False, kw_only=True)
class Run(Excerpt):
    """
    Normalised piece of a record; the samples that count were measured, away from a bridged gap.

    `known` marks the samples that also come after an unknown memory at the start was forgotten.
    """

    record: str
    piece: Piece
    known: Mask

    def through(self, hysteresis: Hysteresis) -> Array:
        """Compute the output of H for the input, from the start of this run."""
        return hysteresis(self.u, self.start(hysteresis.thresholds))

    def excerpt(self, use: Mask) -> Excerpt:
        """Cut out this run with another mask of samples that count."""
        return Excerpt(self.u, self.x, use, self.memory)

    def mask(self, *kinds: str) -> Mask:
        """Mark the samples in segments of these kinds."""
        chosen = np.zeros(self.piece.n, dtype=bool)
        for s in self.piece.segments:
            if s.kind in kinds:
                chosen[s.start : s.stop] = True
        return chosen

    def unbroken(self, start: int, stop: int) -> list[tuple[int, int]]:
        """Find the stretches between two samples without a gap so long that it biases a fit."""
        whole = np.ones(stop - start, dtype=bool)
        for a, b in true_runs(~self.use[start:stop]):
            if b - a > max(FEW, 0.0125 * self.piece.sample_rate):
                whole[a:b] = False
        return [(start + a, start + b) for a, b in true_runs(whole)]

    def held_out(self) -> Mask:
        """Mark every fifth triangle block without a turn, and the end of noise and steps."""
        held = np.zeros(self.piece.n, dtype=bool)
        for s in self.piece.segments:
            if s.kind in ('noise', 'step'):
                held[s.stop - int(END_HELD * s.n) : s.stop] = True
            elif s.kind == 'triangle':
                edges = np.linspace(s.start, s.stop, BLOCKS + 1).astype(int)
                for start, stop in zip(edges[2::EVERY], edges[3::EVERY], strict=False):
                    dv = np.diff(self.u[start:stop])
                    if dv.size and (np.all(dv >= 0) or np.all(dv <= 0)):
                        held[start:stop] = True
        return held


@dataclass(frozen=True, eq=False)
class Prepared:
    """
    Records ready for the steps.

    Faulty readings are removed from the records.  The pieces have one sampling rate [Hz], and the
    runs are the normalised pieces.  The warnings name faults of the data, and data left out.
    """

    rate: float
    scaling: Scaling
    records: list[Record]
    pieces: list[Piece]
    runs: list[Run]
    warnings: list[str]

    @property
    def kinds(self) -> set[str]:
        """Kinds of the segments."""
        return {s.kind for p in self.pieces for s in p.segments}

    @property
    def labelled(self) -> bool:
        """Whether the records hold noise and a triangle, as the three steps need."""
        return {'noise', 'triangle'} <= self.kinds


def prepare(records: Sequence[Record]) -> Prepared:
    """Prepare records; refuse records whose displacement does not answer the voltage."""
    if not records:
        raise IdentificationError('identify: no record was given; give one record, or a list')
    for record in records:
        record.require_displacement()
    measured = [without_faults(record.first(MOST_SAMPLES // len(records))) for record in records]
    records = [with_quiet_voltage(record) for record in measured]
    rate, left = common_rate(records)
    refuse_undriven(records)
    for record in records:
        refuse_closed_loop(record)
    pieces = [p for record in records for p in record if same_rate(p.sample_rate, rate)]
    scaling = scaling_of(pieces)
    faults = fault_lines(records)
    for record in records:
        parts = bridged(record)
        gaps, filled = sum(p.gaps for p in parts), sum(p.filled for p in parts)
        if gaps:
            lost = sum(p.filled / p.piece.sample_rate for p in parts)
            faults.append(
                f'{record.name}: gaps were bridged by straight lines, {gaps} with {filled} '
                f'samples or {lost:.2g} s; the fit and its errors leave out each gap and the '
                'moment after it'
            )
    # if the columns are swapped, v has the noise of a sensor, which quiet voltage would hide
    faults += [text for record in measured for text in suspicions(record)]
    runs = runs_of(records, rate, scaling)
    return Prepared(rate, scaling, measured, pieces, runs, faults + left)


def filled_in(run: Run, simulated: Array, scaling: Scaling) -> Run:
    """Replace lost readings by a simulated displacement [m], plus a line between its errors."""
    y = simulated + interpolated(run.piece.y - simulated, ~run.use)
    return replace(run, x=scaling.x(y), piece=replace(run.piece, y=y))


def fault_lines(records: Sequence[Record]) -> list[str]:
    """List the faults of records, one line each."""
    return [f'{r.name}: {fault}' for r in records for fault in r.faults if not fault.is_note]


def same_rate(one: float, other: float) -> bool:
    """
    Compare two sampling rates; differences below 1e-6 are rounding.

    Examples
    --------
    >>> same_rate(1000.0, 1000.0001), same_rate(1000.0, 1000.1)
    (True, False)
    """
    return abs(one / other - 1.0) < 1e-6


def common_rate(records: Sequence[Record]) -> tuple[float, list[str]]:
    """Choose the sampling rate with the most voltage travel, and list the data of other rates."""
    travel: dict[float, float] = {}
    time: dict[float, float] = {}
    for record in records:
        for piece in record:
            rate = next((r for r in travel if same_rate(r, piece.sample_rate)), piece.sample_rate)
            travel[rate] = travel.get(rate, 0.0) + float(np.abs(np.diff(piece.v)).sum())
            time[rate] = time.get(rate, 0.0) + piece.duration
    best = max(travel, key=lambda rate: travel[rate])
    names = ', '.join(record.name for record in records)
    if travel[best] == 0.0:
        raise IdentificationError(
            f'{names}: the voltage never moves; record the stage while it is driven'
        )
    left = [
        f'{time[rate]:.3g} s sampled at {rate:g} Hz are left out: the model holds for one rate, '
        f'{best:g} Hz'
        for rate in travel
        if rate != best
    ]
    return best, left


def scaling_of(pieces: Sequence[Piece]) -> Scaling:
    """Normalise: voltage range and stroke become 1, and Y takes the sign of the gain."""
    low = min(float(p.v.min()) for p in pieces)
    high = max(float(p.v.max()) for p in pieces)
    if high <= low:
        raise IdentificationError('the voltage is constant; record the stage while it is driven')
    stroke = max(float(p.y.max()) for p in pieces) - min(float(p.y.min()) for p in pieces)
    if stroke == 0.0:
        raise IdentificationError('the displacement is constant; is the sensor connected?')
    sign = 1.0 if max(map(_correlation, pieces), key=abs) >= 0.0 else -1.0
    widest = max(pieces, key=lambda p: float(np.ptp(p.v)))
    y0 = float(widest.y[np.argmin(widest.v)])
    return Scaling(v0=low, V=high - low, y0=y0, Y=sign * stroke, range=(low, high))


def _correlation(piece: Piece) -> float:
    """
    Correlate averages of voltage and displacement, over the averaging time of best correlation.

    Above a resonance a stage moves against its voltage, so fast motion does not tell the sign.
    The correlation of n averages by chance, 1 / sqrt(n), is subtracted.
    """
    best = 0.0
    size = 1
    while (n := piece.n // size) >= AVERAGES or size == 1:
        v, y = (x[: n * size].reshape(n, size).mean(axis=1) for x in (piece.v, piece.y))
        v, y = v - v.mean(), y - y.mean()
        energy = float(np.sqrt((v @ v) * (y @ y)))
        r = float(v @ y) / energy if energy > 0.0 else 0.0
        best = max(best, float(np.copysign(max(0.0, abs(r) - 1.0 / np.sqrt(n)), r)), key=abs)
        size *= 2
    return best


def runs_of(
    records: Sequence[Record], rate: float, scaling: Scaling, enough: float = np.inf
) -> list[Run]:
    """
    Normalise the pieces of one sampling rate, joined over short gaps.

    After an unknown start, samples count as known once the voltage has swept nearly all of its
    range, or `enough` of it (normalised).
    """
    runs = []
    for record in records:
        for part in bridged(record):
            piece = part.piece
            if not same_rate(piece.sample_rate, rate):
                continue
            u = scaling.u(piece.v)
            known = part.sound.copy()
            if abs(u[0]) > REST or rises_first(piece):
                known[: forgotten(u, enough=enough)] = False
            x = scaling.x(piece.y)
            runs.append(
                Run(u=u, x=x, use=part.sound, record=record.name, piece=piece, known=known)
            )
    return runs


def excerpts_of(runs: Sequence[Run], *kinds: str, held: bool = False) -> list[Excerpt]:
    """Cut out the segments of some kinds, without (or only) their held-out samples."""
    excerpts = []
    for run in runs:
        out, use = run.held_out(), run.mask(*kinds) & run.known
        # fitted and held-out excerpts come from the same runs, so that each run keeps its offset
        if np.any(use & ~out):
            excerpts.append(run.excerpt(use & (out if held else ~out)))
    return excerpts

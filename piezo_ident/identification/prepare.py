# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Records made ready for fitting: one rate, one scaling, normalised runs with their masks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import functools

import numpy as np
from piezo_ident.common.arrays import Array, closed, interpolated, Mask, true_runs
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.refusals import refuse_closed_loop, refuse_undriven
from piezo_ident.model.initial_memory import forgotten
from piezo_ident.model.scaling import Scaling
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.play import initial_memory
from piezo_ident.record.faults import without_faults
from piezo_ident.record.gaps import bridged, FEW
from piezo_ident.record.quiet_voltage import with_quiet_voltage
from piezo_ident.record.record import Piece, Record
from piezo_ident.record.suspicions import rises_first, suspicions

#: share of a triangle that is one block of held-out data, and how many blocks share one
BLOCKS, EVERY = 60, 5
#: share at the end of every noise and step segment that is not fitted
END_HELD = 0.2
#: a record starts from a known memory when its voltage starts within this share of the lowest
REST = 0.01
#: how far the voltage may move within one averaged row, as a share of its range
ROW_SPAN = 2e-3
#: samples in a row whose readings may be lost where the voltage turns (taste; held-out blocks,
#: which hold no turn, are longer)
LOST = 50
#: averages that tell a correlation at least (taste)
AVERAGES = 20
#: samples of all records that are used, at some 60 bytes each; of longer ones the first
MOST_SAMPLES = 40_000_000


@dataclass(frozen=True, eq=False)
class Excerpt:
    """
    Input and output of a fit, and which samples count.

    Attributes
    ----------
    u, x : ndarray, shape (n,)
        Normalised input and displacement; plays and dynamics need all of the input.
    use : ndarray of bool, shape (n,)
        Samples that count.
    memory : callable, optional
        Play outputs before the first sample, as a function of the thresholds; that of a stage
        which last came down to zero when absent.
    """

    u: Array
    x: Array
    use: Mask
    memory: Callable[[Array], Array] | None = None

    def start(self, thresholds: Array) -> Array:
        """Return the play outputs before the first sample."""
        if self.memory is None:
            return initial_memory(float(self.u[0]), thresholds)
        return self.memory(thresholds)

    @functools.cached_property
    def stretches(self) -> list[tuple[int, int]]:
        """The unbroken stretches of samples that count, as (start, stop)."""
        return true_runs(self.use)

    @functools.cached_property
    def joined(self) -> list[tuple[int, int]]:
        """
        The stretches, which go on over a few samples that do not count.

        Lost readings do no harm where a regression runs through the straight line in their place.
        """
        return true_runs(closed(self.use, FEW))

    @functools.cached_property
    def span(self) -> tuple[float, float]:
        """Lowest and highest input of the stretches: a lost reading has its voltage."""
        u = self.u[closed(self.use, LOST)]
        return (float(u.min()), float(u.max())) if u.size else (np.inf, -np.inf)

    @property
    def swing(self) -> float:
        """Width of `span`; zero where no sample counts."""
        return max(self.span[1] - self.span[0], 0.0)

    @functools.cached_property
    def averaged(self) -> list[tuple[int, int]]:
        """
        The stretches whose rows are averaged, which go on over gaps shorter than a row.

        Within a row the voltage hardly moves, and a straight line is what the stage does.
        """
        return true_runs(closed(self.use, min(FEW, self.row - 1)))

    @functools.cached_property
    def row(self) -> int:
        """Samples that one row of a fit of H may average."""
        if not self.use.any():
            return 1
        speed = float(np.abs(np.diff(self.u)).max(initial=0.0, where=self.use[1:]))
        span = ROW_SPAN * self.swing
        return max(
            1, min(int(span / speed) if speed > 0.0 else 1, int(self.use.sum()) // 10_000, 50)
        )

    @property
    def rows(self) -> int:
        """Rows that these samples become; white noise is independent from row to row."""
        return sum((stop - start) // self.row for start, stop in self.averaged)


@dataclass(frozen=True, eq=False, kw_only=True)
class Run(Excerpt):
    """
    One piece, normalised; the samples that count were measured, away from a bridged gap.

    Attributes
    ----------
    record : str
        Name of the record it belongs to.
    piece : Piece
    known : ndarray of bool, shape (n,)
        Samples that count and at which the memory of the start no longer matters, or was known.
    """

    record: str
    piece: Piece
    known: Mask

    def through(self, hysteresis: Hysteresis) -> Array:
        """Return what H makes of the input, from the start of this run."""
        return hysteresis(self.u, self.start(hysteresis.thresholds))

    def excerpt(self, use: Mask) -> Excerpt:
        """Return this run with other samples that count."""
        return Excerpt(self.u, self.x, use, self.memory)

    def mask(self, *kinds: str) -> Mask:
        """Return which samples belong to segments of these kinds."""
        chosen = np.zeros(self.piece.n, dtype=bool)
        for s in self.piece.segments:
            if s.kind in kinds:
                chosen[s.start : s.stop] = True
        return chosen

    def unbroken(self, start: int, stop: int) -> list[tuple[int, int]]:
        """
        Return the stretches between two samples that hold no long gap.

        A sample or two that were bridged do no harm where a regression runs through them; a
        straight line of many does.
        """
        whole = np.ones(stop - start, dtype=bool)
        for a, b in true_runs(~self.use[start:stop]):
            if b - a > max(FEW, 0.0125 * self.piece.sample_rate):
                whole[a:b] = False
        return [(start + a, start + b) for a, b in true_runs(whole)]

    def held_out(self) -> Mask:
        """
        Return which samples of triangle, noise and steps are kept from every fit.

        Of a triangle every fifth block that holds no turning point, of the others the end.
        """
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

    Attributes
    ----------
    rate : float
        [Hz]
    scaling : Scaling
    records : list of Record
        The records, their faulty readings left out.
    pieces : list of Piece
        Of this rate.
    runs : list of Run
        The pieces, normalised.
    warnings : list of str
        Faults of the data, and what is left out.
    """

    rate: float
    scaling: Scaling
    records: list[Record]
    pieces: list[Piece]
    runs: list[Run]
    warnings: list[str]

    @property
    def kinds(self) -> set[str]:
        """Kinds of segments that there are."""
        return {s.kind for p in self.pieces for s in p.segments}

    @property
    def labelled(self) -> bool:
        """Whether there are noise and a triangle, so that the three steps can be taken."""
        return {'noise', 'triangle'} <= self.kinds


def prepare(records: Sequence[Record]) -> Prepared:
    """
    Make records ready for the steps.

    Records that carry no response of a stage to a voltage raise IdentificationError, one without
    displacement DataError.
    """
    if not records:
        raise IdentificationError('no record was given')
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
                f'samples or {lost:.2g} s; neither they nor the moment after each were fitted or '
                'judged'
            )
    # of columns that are swapped, v has the noise of a sensor
    faults += [text for record in measured for text in suspicions(record)]
    runs = runs_of(records, rate, scaling)
    return Prepared(rate, scaling, measured, pieces, runs, faults + left)


def filled_in(run: Run, simulated: Array, scaling: Scaling) -> Run:
    """
    Return a run in which a simulated displacement [m] stands in for what was not measured.

    What it leaves of the samples around goes on in between by a straight line.
    """
    y = simulated + interpolated(run.piece.y - simulated, ~run.use)
    return replace(run, x=scaling.x(y), piece=replace(run.piece, y=y))


def fault_lines(records: Sequence[Record]) -> list[str]:
    """Return what was wrong with records, a line for each fault."""
    return [f'{r.name}: {fault}' for r in records for fault in r.faults if not fault.is_note]


def same_rate(one: float, other: float) -> bool:
    """
    Return whether two sampling rates differ by no more than rounding (1e-6).

    Examples
    --------
    >>> same_rate(1000.0, 1000.0001), same_rate(1000.0, 1000.1)
    (True, False)
    """
    return abs(one / other - 1.0) < 1e-6


def common_rate(records: Sequence[Record]) -> tuple[float, list[str]]:
    """
    Return the sampling rate that carries the most voltage travel, and what is left out.

    A voltage that never moves raises IdentificationError.
    """
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
    """
    Return the normalisation: voltage range and stroke to 1, the sign of the gain in Y.

    Where voltage or displacement never move it raises IdentificationError.
    """
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
    Return the correlation of voltage and displacement, of averages over the time that shows most.

    Above a resonance a stage moves against its voltage, so that fast motion tells no sign.  Few
    averages correlate by chance: n of them by 1 / sqrt(n).
    """
    best = 0.0
    size = 1
    while (n := piece.n // size) >= AVERAGES or size == 1:
        v, y = (x[: n * size].reshape(n, size).mean(axis=1) for x in (piece.v, piece.y))
        v, y = v - v.mean(), y - y.mean()
        energy = float(np.sqrt((v @ v) * (y @ y)))
        r = float(v @ y) / energy if energy > 0.0 else 0.0
        r = float(np.copysign(max(0.0, abs(r) - 1.0 / np.sqrt(n)), r))
        best = max(best, r, key=abs)
        size *= 2
    return best


def runs_of(
    records: Sequence[Record], rate: float, scaling: Scaling, enough: float = np.inf
) -> list[Run]:
    """
    Return the pieces of one rate, joined over short gaps and normalised.

    Behind an unknown start they are known once the voltage has swept nearly all of its range, or
    `enough`, normalised.
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

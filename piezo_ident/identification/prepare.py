# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Records made ready for fitting: one rate, one scaling, normalised runs with their masks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import functools

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import IdentificationError
from piezo_ident.model.initial_memory import forgotten
from piezo_ident.model.stage_model import Scaling
from piezo_ident.operators.play import initial_memory
from piezo_ident.record.faults import suspicions, without_faults
from piezo_ident.record.gaps import bridged
from piezo_ident.record.record import Piece, Record
from scipy import signal

__all__ = [
    'Excerpt',
    'Prepared',
    'Run',
    'common_rate',
    'drive_creep',
    'prepare',
    'refuse_closed_loop',
    'refuse_undriven',
    'runs_of',
    'same_rate',
    'scaling_of',
    'true_runs',
]

#: share of a triangle that is one block of held-out data, and how many blocks share one
BLOCKS, EVERY = 60, 5
#: share at the end of every noise and step segment that is not fitted
END_HELD = 0.2
#: a record starts from a known memory when its voltage starts within this share of the lowest
REST = 0.01
#: how far the voltage may move within one averaged row, as a share of its range
ROW_SPAN = 2e-3
#: samples of all records that are used, at some 60 bytes each; of longer ones the first
MOST_SAMPLES = 40_000_000
#: chance below which the displacement answers the voltage, and samples that it takes to tell
CHANCE, MIN_COHERENCE = 1e-7, 256
#: means into which a ramp is divided
RAMP = 64
#: a measured stage under position control stays this close to a straight line, as a share of its
#: travel (2.4e-4), while its drive bends by 18 times as much or more
STRAIGHT, BENT = 5e-4, 15.0


def true_runs(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """
    Return (start, stop) of every stretch of true values.

    Examples
    --------
    >>> true_runs(np.array([True, True, False, True]))
    [(0, 2), (3, 4)]
    """
    padded = np.concatenate([[False], mask, [False]])
    edges = np.flatnonzero(padded[1:] != padded[:-1]).tolist()
    return list(zip(edges[::2], edges[1::2], strict=True))


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

    u: NDArray[np.float64]
    x: NDArray[np.float64]
    use: NDArray[np.bool_]
    memory: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None

    def start(self, thresholds: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the play outputs before the first sample."""
        if self.memory is None:
            return initial_memory(float(self.u[0]), thresholds)
        return self.memory(thresholds)

    @functools.cached_property
    def stretches(self) -> list[tuple[int, int]]:
        """The unbroken stretches of samples that count, as (start, stop)."""
        return true_runs(self.use)

    @functools.cached_property
    def row(self) -> int:
        """Samples that one row of a fit of H may average."""
        if not self.use.any():
            return 1
        speed = float(np.abs(np.diff(self.u)).max(initial=0.0, where=self.use[1:]))
        span = ROW_SPAN * float(np.ptp(self.u[self.use]))
        return max(
            1, min(int(span / speed) if speed > 0.0 else 1, int(self.use.sum()) // 10_000, 50)
        )

    @property
    def rows(self) -> int:
        """Rows that these samples become; white noise is independent from row to row."""
        return sum((stop - start) // self.row for start, stop in self.stretches)


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
    known: NDArray[np.bool_]

    def mask(self, *kinds: str) -> NDArray[np.bool_]:
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
            if b - a > 0.0125 * self.piece.sample_rate:
                whole[a:b] = False
        return [(start + a, start + b) for a, b in true_runs(whole)]

    def held_out(self) -> NDArray[np.bool_]:
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
    pieces : list of Piece
        Of this rate.
    runs : list of Run
        The pieces, normalised.
    warnings : list of str
        Faults of the data, and what is left out.
    """

    rate: float
    scaling: Scaling
    pieces: list[Piece]
    runs: list[Run]
    warnings: list[str]

    @property
    def labelled(self) -> bool:
        """Whether there are noise and a triangle, so that the three steps can be taken."""
        return {'noise', 'triangle'} <= {s.kind for p in self.pieces for s in p.segments}


def prepare(records: Sequence[Record]) -> Prepared:
    """
    Make records ready for the steps.

    Raises
    ------
    IdentificationError
        When they carry no response of a stage to a voltage.
    DataError
        When one holds no displacement.
    """
    if not records:
        raise IdentificationError('no record was given')
    for record in records:
        record.require_displacement()
    records = [without_faults(record.first(MOST_SAMPLES // len(records))) for record in records]
    rate, left = common_rate(records)
    refuse_undriven(records)
    for record in records:
        refuse_closed_loop(record)
    pieces = [p for record in records for p in record if same_rate(p.sample_rate, rate)]
    scaling = scaling_of(pieces)
    faults = [f'{record.name}: {fault}' for record in records for fault in record.faults]
    for record in records:
        parts = bridged(record)
        gaps, filled = sum(p.gaps for p in parts), sum(p.filled for p in parts)
        if gaps:
            faults.append(
                f'{record.name}: {gaps} short gaps ({filled} samples) were bridged by straight '
                'lines; neither they nor the moment after each were fitted or judged'
            )
    faults += [said for record in records for said in suspicions(record)]
    return Prepared(rate, scaling, pieces, runs_of(records, rate, scaling), faults + left)


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

    Raises
    ------
    IdentificationError
        When the voltage never moves.
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

    Raises
    ------
    IdentificationError
        When voltage or displacement never move.
    """
    low = min(float(p.v.min()) for p in pieces)
    high = max(float(p.v.max()) for p in pieces)
    if high <= low:
        raise IdentificationError('the voltage is constant; record the stage while it is driven')
    stroke = max(float(p.y.max()) for p in pieces) - min(float(p.y.min()) for p in pieces)
    if stroke == 0.0:
        raise IdentificationError('the displacement is constant; is the sensor connected?')
    covariance = sum(float(np.sum((p.v - p.v.mean()) * (p.y - p.y.mean()))) for p in pieces)
    sign = 1.0 if covariance >= 0.0 else -1.0
    widest = max(pieces, key=lambda p: float(np.ptp(p.v)))
    y0 = float(widest.y[np.argmin(widest.v)])
    return Scaling(v0=low, V=high - low, y0=y0, Y=sign * stroke, range=(low, high))


def runs_of(records: Sequence[Record], rate: float, scaling: Scaling) -> list[Run]:
    """Return the pieces of one rate, joined over short gaps and normalised."""
    runs = []
    for record in records:
        for part in bridged(record):
            piece = part.piece
            if not same_rate(piece.sample_rate, rate):
                continue
            u = scaling.u(piece.v)
            known = part.sound.copy()
            if abs(u[0]) > REST:
                known[: forgotten(u)] = False
            x = scaling.x(piece.y)
            runs.append(
                Run(u=u, x=x, use=part.sound, record=record.name, piece=piece, known=known)
            )
    return runs


def refuse_undriven(records: Sequence[Record]) -> None:
    """
    Refuse records whose displacement is no answer to the voltage.

    Somewhere the spectra of voltage and displacement have to be coherent, by more than chance
    (1e-7): for Gaussian noise ``1 - c`` raised to ``L - 1`` is the chance of a coherence c over L
    segments, whatever the displacement does.  A line is taken out of each segment.  Kept, it
    counts where the voltage moves by far more than its own noise: two drifts agree by chance.

    Raises
    ------
    IdentificationError
        When no piece shows it.
    """
    pieces = [piece for record in records for piece in record]
    if any(piece.n < MIN_COHERENCE and np.ptp(piece.v) > 0.0 for piece in pieces):
        return
    if any(
        _chance(piece, 'linear') < CHANCE or (_moves(piece.v) and _chance(piece) < CHANCE)
        for piece in pieces
        if np.ptp(piece.v) > 0.0
    ):
        return
    low, high = (f([getattr(p.v, f.__name__)() for p in pieces]) for f in (min, max))
    raise IdentificationError(
        f'{", ".join(record.name for record in records)}: the displacement does not answer the '
        f'voltage, which stays within {low:.4g} .. {high:.4g} V and moves as noise does; record '
        'the stage while it is driven'
    )


def _moves(v: NDArray[np.float64]) -> bool:
    """Return whether a voltage moves by far more than its noise."""
    rows = v[: v.size // 64 * 64].reshape(64, -1)
    noise = float(np.median(np.std(signal.detrend(rows), axis=1)))
    return bool(np.ptp(rows.mean(axis=1)) > 10.0 * noise)


def _chance(piece: Piece, detrend: str = 'constant') -> float:
    """Return the chance that noise is as coherent with the displacement as the voltage is."""
    chance = 1.0
    for size in (piece.n // 16, 256):
        if piece.n < 8 * size or chance < CHANCE:
            continue
        how = {'nperseg': size, 'detrend': detrend}
        s_vv, s_yy = (signal.welch(x, **how)[1] for x in (piece.v, piece.y))
        s_vy = signal.csd(piece.v, piece.y, **how)[1]
        # what detrending leaves of a straight line is rounding
        power = (s_vv > 1e-12 * s_vv.max(initial=0.0)) & (s_yy > 1e-12 * s_yy.max(initial=0.0))
        if power.any():
            coherence = np.abs(s_vy[power]) ** 2 / (s_vv[power] * s_yy[power])
            # Hann segments that overlap by half are worth 0.6 of their number
            left = (1.0 - min(1.0, float(coherence.max()))) ** (1.2 * piece.n / size - 1.6)
            chance = min(chance, float(power.sum()) * left)
    return chance


def refuse_closed_loop(record: Record) -> None:
    """
    Refuse a record under position control, where the voltage is the answer.

    Two signs are known: the drive moves while the position is held, and the position follows a
    straight line more closely than the drive.  A stage under voltage control does neither: it
    creeps, and its hysteresis bends the displacement, not the voltage.

    Raises
    ------
    IdentificationError
    """
    if np.ptp(record.voltage_range) == 0.0 or record.stroke == 0.0:
        return
    for refuse in (_refuse_hold, _refuse_ramp):
        for piece in record:
            refuse(record, piece)


def _refuse_hold(record: Record, piece: Piece) -> None:
    span = np.ptp(record.voltage_range)
    window = max(16, int(0.5 * piece.sample_rate))
    if piece.n < 4 * window:
        return
    n = piece.n // window
    v = piece.v[: n * window].reshape(n, window).mean(axis=1)
    y = piece.y[: n * window].reshape(n, window).mean(axis=1)
    for start, stop in true_runs(np.abs(np.diff(y)) < 1e-4 * record.stroke):
        moved = abs(v[stop] - v[start]) / span
        followed = abs(y[stop] - y[start]) / record.stroke
        if stop - start < 4 or moved <= 0.005 or followed >= 0.05 * moved:
            continue
        t = piece.t[[start * window, min(stop * window, piece.n - 1)]]
        creep = drive_creep(piece, start * window, stop * window)
        text = ''
        if creep is not None:
            text = (
                f'; there the drive makes up for creep of {creep:.2g} V a decade of time, '
                f'{100.0 * creep / span:.2g} % of its range'
            )
        cause = 'a position controller was on'
        if np.ptp(piece.y[(start + 1) * window : stop * window]) == 0.0:
            cause += ', or the sensor is at its stop, as it reads one value there'
        raise IdentificationError(
            f'{record.name}: from {t[0]:.3g} to {t[1]:.3g} s the voltage moves by {moved:.1%} of '
            f'its range while the position moves by {followed:.2%} of its stroke: {cause}, so the '
            f'position is no response to the voltage{text}; record in open loop'
        )


def _refuse_ramp(record: Record, piece: Piece) -> None:
    span = np.ptp(record.voltage_range)
    for parts in (1, 2, 4):
        m = piece.n // parts // RAMP
        if m < 4:
            return
        for start in range(0, piece.n - m * RAMP + 1, m * RAMP // 2):
            stop = start + m * RAMP
            v, y = (x[start:stop].reshape(RAMP, m).mean(axis=1) for x in (piece.v, piece.y))
            if np.ptp(v) < 0.05 * span or np.ptp(y) < 0.05 * record.stroke:
                continue
            bend_v, bend_y = _bend(v), _bend(y)
            if bend_y < STRAIGHT and bend_v > BENT * max(bend_y, STRAIGHT / 2.0):
                raise IdentificationError(
                    f'{record.name}: from {piece.t[start]:.3g} to {piece.t[stop - 1]:.3g} s the '
                    f'position follows a straight line to {bend_y:.3%} of its travel and the '
                    f'voltage only to {bend_v:.2%}: a position controller was on, so the position '
                    'is no response to the voltage; record in open loop'
                )


def _bend(x: NDArray[np.float64]) -> float:
    """Return the rms deviation from a straight line, as a share of the line's travel."""
    k = np.linspace(-0.5, 0.5, x.size)
    travel = float(k @ x / (k @ k))
    return float(np.std(x - travel * k)) / max(abs(travel), np.finfo(float).tiny)


def drive_creep(piece: Piece, start: int, stop: int) -> float | None:
    """
    Return by how much the drive moves a decade of time while the position is held [V].

    Parameters
    ----------
    piece : Piece
    start, stop : int
        The hold.

    Returns
    -------
    float or None
        None where a straight line in time describes the drive as well: that is drift.
    """
    t, v = piece.t[start:stop] - piece.t[start] + 1.0 / piece.sample_rate, piece.v[start:stop]
    left, slope = {}, {}
    # a second, and a tenth of the whole, for what the controller does at first
    late = t > min(1.0, 0.1 * t[-1])
    for name, x in (('log', np.log10(t)), ('line', t)):
        fit = np.polynomial.Polynomial.fit(x[late], v[late], 1)
        left[name] = float(np.sum((v[late] - fit(x[late])) ** 2))
        slope[name] = float(fit.convert().coef[-1])
    return abs(slope['log']) if left['log'] < 0.5 * left['line'] else None

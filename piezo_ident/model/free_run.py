# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Free runs: the displacement that a model predicts from the voltage of a record, and its errors.

The early part of a record tells the memory of the stage from earlier motion.  A short gap is
crossed along its voltage, or along a straight line if the voltage is unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from piezo_ident.common.arrays import Array, CHUNK
from piezo_ident.common.errors import expect, ModelError
from piezo_ident.common.showable import Showable
from piezo_ident.model.estimate import observe_pieces
from piezo_ident.model.initial_memory import crept, EARLY, early_part, fit_start
from piezo_ident.model.metrics import doubts, nrmse_fit, percent
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import Start, StartLike
from piezo_ident.record.readings.faults import without_faults
from piezo_ident.record.readings.gaps import bridged, connected_pieces
from piezo_ident.record.readings.quiet_voltage import with_quiet_voltage
from piezo_ident.record.record import Piece, Record


@dataclass(frozen=True)
class FreeRunErrors:
    """
    Errors of a free run against the measurement.

    Attributes
    ----------
    n : int
        Number of judged samples; faulty readings are never judged.
    percent : float
        `piezo_ident.model.metrics.percent_of_stroke` with the stroke of the whole record.
    fit : float
        `piezo_ident.model.metrics.fit_percent`.
    offset : float
        Mean of measured minus predicted [m]; a sensor that was zeroed again shifts it.
    percent_without_offset : float
        `percent` after subtracting `offset`.
    """

    n: int
    percent: float
    fit: float
    offset: float
    percent_without_offset: float

    @property
    def mostly_offset(self) -> bool:
        """Whether subtracting the offset at least halves the error."""
        return self.percent_without_offset <= 0.5 * self.percent and self.percent > 0.0

    @property
    def only_offset(self) -> bool:
        """Whether subtracting the offset leaves less than a tenth of the error."""
        return self.percent_without_offset < 0.1 * self.percent


@dataclass(frozen=True, eq=False, repr=False)
class FreeRun(Showable):
    """
    Free run of a model over a record, with the measurement.

    Attributes
    ----------
    model : StageModel
    record : Record
        Record with masks that leave out faulty readings; its faults count them.
    pieces : tuple of ndarray
        Predicted displacement of each piece of the record [m].
    estimated : tuple of bool
        For each piece, whether its start was estimated from its early part.
    late : tuple of int
        For each piece, the first sample that does not depend on an estimated start.
    errors : FreeRunErrors
        Errors over all samples.
    errors_after_start : FreeRunErrors or None
        Errors over the samples from `late` on; None without such samples.
    warnings : tuple of str
        Limits of the trust in the prediction.
    interval : float or None
        Level of the band; None without a band.
    half_widths : tuple of ndarray
        Half width of the band of each piece [m], infinite where nothing is known.
    alone : StageModel or None
        Axis without the motion by other axes, which the observer of `estimate` corrects; None
        without an estimate.
    coupled : bool
        Whether `model` adds the motion by other axes to that of `alone`.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> stage = pi.SimulatedStage.load('paper')
    >>> run = pi.free_run(stage.model, stage.play(pi.Program.load('minor_loops')))
    >>> run.errors.percent < 0.01
    True
    """

    model: StageModel
    record: Record
    pieces: tuple[Array, ...]
    estimated: tuple[bool, ...]
    late: tuple[int, ...]
    errors: FreeRunErrors
    errors_after_start: FreeRunErrors | None
    warnings: tuple[str, ...] = ()
    interval: float | None = None
    half_widths: tuple[Array, ...] = ()
    alone: StageModel | None = None
    coupled: bool = False

    @property
    def inside(self) -> float:
        """Share of the judged samples with a known band that lie inside it; NaN without any."""
        inside = known = 0
        for piece, y_hat, half in zip(self.record, self.pieces, self.half_widths, strict=False):
            judged = piece.mask & np.isfinite(half)
            known += int(judged.sum())
            inside += int((np.abs(piece.y - y_hat)[judged] <= half[judged]).sum())
        return inside / known if known else float('nan')

    @property
    def predicted(self) -> Array:
        """Predicted displacement of all pieces [m], shape (n,)."""
        return np.concatenate(self.pieces)

    @cached_property
    def estimate(self) -> tuple[Array, ...]:
        """
        Displacement of each piece by an observer [m], as by the model node; empty without `alone`.

        The observer begins at rest, and uses displacement that is at least
        `piezo_ident.model.observer.HORIZON` samples old.
        """
        if self.alone is None:
            return ()
        record, groups = self.record, connected_pieces(self.record)
        rest, at_rest = list(self.pieces), [None] * len(groups)
        if any(self.estimated):
            rest = _predicted(self.model, record, groups, at_rest)
        felt = [np.zeros(y.size) for y in rest]
        if self.coupled:
            own = _predicted(self.alone, record, groups, at_rest)
            felt = [y - y_own for y, y_own in zip(rest, own, strict=True)]
        done: list[Array] = []
        for pieces in groups:
            cut = slice(len(done), len(done) + len(pieces))
            seen = observe_pieces(self.alone, pieces, rest[cut], felt[cut])
            done += [one.estimate for one in seen]
        return tuple(done)

    @cached_property
    def errors_of_estimate(self) -> FreeRunErrors | None:
        """Errors of `estimate` over all samples; None without an estimate."""
        return (
            _errors(self.record, self.estimate, [0] * len(self.pieces)) if self.estimate else None
        )

    @property
    def measured(self) -> Array:
        """Measured displacement of all pieces [m], shape (n,)."""
        return np.concatenate([piece.y for piece in self.record])


def free_run(model: StageModel, record: Record) -> FreeRun:
    """Predict a record with a model of one axis; see `piezo_ident.free_run`."""
    expect(model, StageModel, 'free_run, first argument', 'read a model with load')
    expect(record, Record, 'free_run, second argument', 'read a file with read')
    record.require_displacement()
    record = with_quiet_voltage(without_faults(record))
    groups = connected_pieces(record)
    _check_rates(model, record)
    joined = bridged(record)
    starts = [fit_start(model, one.piece, one.sound) for one in joined]
    predicted = _predicted(model, record, groups, starts)
    estimated: list[bool] = []
    late: list[int] = []
    for pieces, one, start in zip(groups, joined, starts, strict=True):
        estimated += [start is not None, *[False] * (len(pieces) - 1)]
        left = 0 if start is None else _late(model, one.piece, start)
        for piece in pieces:
            # bridged samples count, including the gaps before this piece
            gone = round((piece.start_time - pieces[0].start_time) * piece.sample_rate)
            late.append(min(max(left - gone, 0), piece.n))
    run = compared(model, record, predicted, late)
    warnings = (*_on_starts(model, record, starts), *run.warnings)
    return replace(run, estimated=tuple(estimated), warnings=warnings)


def compared(
    model: StageModel, record: Record, predicted: Sequence[Array], late: Sequence[int]
) -> FreeRun:
    """Compare predictions with a record without faults; `model` holds scaling and range."""
    pairs = [(piece.y, y_hat) for piece, y_hat in zip(record, predicted, strict=True)]
    warnings = [f'{record.name}: {doubt}' for doubt in doubts(pairs, model.scaling.Y)]
    return FreeRun(
        model=model,
        record=record,
        pieces=tuple(predicted),
        estimated=(False,) * len(late),
        late=tuple(late),
        errors=_errors(record, predicted, [0] * len(late)),
        errors_after_start=_errors(record, predicted, late) if _judged(record, late) else None,
        warnings=(*warnings, *model.extrapolation(record)),
    )


def same_part_errors(*runs: FreeRun) -> list[FreeRunErrors]:
    """
    Compute the errors of runs over one record, on the samples `late` for all of them.

    The errors are those of the whole record if no such sample exists.
    """
    late = [max(starts) for starts in zip(*(run.late for run in runs), strict=True)]
    if not _judged(runs[0].record, late):
        return [run.errors for run in runs]
    return [_errors(run.record, run.pieces, late) for run in runs]


def predict(model: StageModel, record: Record) -> tuple[Array, ...]:
    """
    Predict the displacement of each piece [m] from the voltage alone; the measurement is not used.

    The stage is at rest under the first sample of pieces that short gaps connect.

    Raises
    ------
    ModelError
        If a piece has another sampling rate than the model, or the prediction overflows.
    """
    _check_rates(model, record)
    record = with_quiet_voltage(record)
    groups = connected_pieces(record)
    return tuple(_predicted(model, record, groups, [None] * len(groups)))


def _late(model: StageModel, piece: Piece, start: Start) -> int:
    """Find the first sample of a bridged piece that does not depend on its estimated start."""
    memory = start.memory is not None
    # a resting voltage never makes the stage forget
    if memory and np.ptp(piece.v) == 0.0:
        return piece.n
    return early_part(model, piece, memory=memory) if memory or start.creep.size else 0


def _on_starts(model: StageModel, record: Record, starts: Sequence[Start | None]) -> Iterator[str]:
    """Yield warnings about estimated motion before a record."""
    estimates = [start for start in starts if start is not None]
    elsewhere = sum(start.memory is not None for start in estimates)
    if elsewhere:
        yield (
            f'{record.name}: {elsewhere} of {len(starts)} pieces do not start at the '
            f'lowest voltage, {model.scaling.range[0]:g} V, or had not come down to it; the '
            'memory at their start is estimated from their early part'
        )
    most = max((crept(model, start) for start in estimates), key=abs, default=0.0)
    if most:
        yield (
            f'{record.name}: creep of earlier motion goes on, by '
            f'{100.0 * abs(most / model.scaling.Y):.2g} % of the span of the model at the start; '
            f'it is estimated from the first {EARLY:.0%}'
        )


def _check_rates(model: StageModel, record: Record) -> None:
    try:
        for piece in record:
            model.check_rate(piece)
    except ModelError as error:
        raise ModelError(f'{record.name}: {error}') from None


def _predicted(
    model: StageModel,
    record: Record,
    groups: Sequence[Sequence[Piece]],
    starts: Sequence[Start | None],
) -> list[Array]:
    predicted: list[Array] = []
    for pieces, start in zip(groups, starts, strict=True):
        predicted += run_pieces(model, pieces, start)
    if not all(np.isfinite(y_hat).all() for y_hat in predicted):
        raise ModelError(f'{record.name}: the model diverges on this record; identify it again')
    return predicted


def run_pieces(model: StageModel, pieces: Sequence[Piece], start: StartLike) -> list[Array]:
    """
    Predict the displacement [m] of pieces that follow each other over short gaps.

    `piezo_ident.record.readings.gaps.connected_pieces` gives such pieces.  `start` is the start of
    the first piece, as in `StageModel.simulate`.
    """
    stream = model.stream(start)
    predicted = [stream.follow(pieces[0])]
    for before, piece in pairwise(pieces):
        stream.bridge(before, piece)
        predicted.append(stream.follow(piece))
    return predicted


def _judged(record: Record, starts: Sequence[int]) -> int:
    """Count the valid samples of each piece from a given sample on."""
    return sum(int(piece.mask[start:].sum()) for piece, start in zip(record, starts, strict=True))


def _errors(record: Record, predicted: Sequence[Array], starts: Sequence[int]) -> FreeRunErrors:
    """Compute the errors of a record, each piece from a sample on, in blocks to save memory."""
    pieces = list(zip(record, predicted, starts, strict=True))

    def total(f: Callable[[Array, Array], Array]) -> float:
        return sum(
            float(np.sum(f(piece.y[part], y_hat[part])[piece.mask[part]]))
            for piece, y_hat, start in pieces
            for part in (slice(i, i + CHUNK) for i in range(start, piece.n, CHUNK))
        )

    n = _judged(record, starts)
    offset, mean = total(lambda y, y_hat: y - y_hat) / n, total(lambda y, y_hat: y) / n
    square = total(lambda y, y_hat: (y - y_hat) ** 2)
    centred = total(lambda y, y_hat: (y - y_hat - offset) ** 2)
    spread = total(lambda y, y_hat: (y - mean) ** 2)
    return FreeRunErrors(
        n=n,
        percent=percent(np.sqrt(square / n), record.stroke),
        fit=nrmse_fit(np.sqrt(square), np.sqrt(spread)),
        offset=offset,
        percent_without_offset=percent(np.sqrt(centred / n), record.stroke),
    )


@dataclass(frozen=True, eq=False)
class PieceRun:
    """
    Free run of a model on one piece of a record.

    y_hat and y_static, shape (n,), are the displacement by the whole model, and by its
    hysteresis alone [m].
    """

    record: str
    piece: Piece
    y_hat: Array
    y_static: Array


def piece_runs(
    model: StageModel,
    records: Iterable[Record] | Record,
    memories: Mapping[tuple[str, float], StartLike] | None = None,
) -> list[PieceRun]:
    """
    Run a model over all pieces that have its sampling rate.

    `memories` are the starts of pieces, by the name of the record and the start time of the
    piece.  Unknown starts are estimated as in `free_run`.
    """
    static = model.without_dynamics()
    known = memories or {}
    runs = []
    for record in [records] if isinstance(records, Record) else records:
        record = with_quiet_voltage(without_faults(record))
        for pieces, one in zip(connected_pieces(record), bridged(record), strict=True):
            if not model.takes(pieces[0]):
                continue
            start: StartLike = known.get((record.name, pieces[0].start_time))
            if start is None:
                start = fit_start(model, one.piece, one.sound)
            both = (run_pieces(m, pieces, start) for m in (model, static))
            for piece, y_hat, y_static in zip(pieces, *both, strict=True):
                runs.append(PieceRun(record.name, piece, y_hat, y_static))
    return runs

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A long record through a model, part by part; see `piezo_ident.model.free_run`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
import itertools

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import ModelError
from piezo_ident.model.free_run import DIVERGES, Errors, FreeRun, start_warning
from piezo_ident.model.initial_memory import (
    fit_memory,
    forgotten,
    is_at_rest,
    SHARE,
    Sweep,
    sweeps_of,
)
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import Stream
from piezo_ident.record.gaps import follows
from piezo_ident.record.long_record import LongRecord, NeedsWhole, Outline, Progress
from piezo_ident.record.record import Piece

__all__ = ['predict_long']

#: samples of a piece that are kept to estimate its start from
MOST = 4_000_000

Vector = NDArray[np.float64]


@dataclass
class _Moments:
    """Number, mean, and sum of squares about the mean of numbers that come in parts."""

    n: int = 0
    mean: float = 0.0
    squares: float = 0.0

    def add(self, x: Vector) -> None:
        if not x.size:
            return
        mean = float(np.mean(x))
        step, n = mean - self.mean, self.n + x.size
        self.squares += float(np.sum((x - mean) ** 2)) + step**2 * self.n * x.size / n
        self.mean += step * x.size / n
        self.n = n


class _Errors:
    """`Errors` of samples that come in parts."""

    def __init__(self) -> None:
        self._e, self._y = _Moments(), _Moments()

    def add(self, y: Vector, y_hat: Vector) -> None:
        self._e.add(y - y_hat)
        self._y.add(y)

    def result(self, stroke: float) -> Errors:
        n, offset = self._e.n, self._e.mean
        squares = self._e.squares + n * offset**2
        spread = self._y.squares
        if spread == 0.0:
            fit = 100.0 if squares == 0.0 else float('-inf')
        else:
            fit = 100.0 * (1.0 - float(np.sqrt(squares / spread)))

        def percent(total: float) -> float:
            rms = float(np.sqrt(total / n))
            if stroke == 0.0:
                return 0.0 if rms == 0.0 else float('inf')
            return 100.0 * rms / stroke

        return Errors(n, percent(squares), fit, offset, percent(self._e.squares))

    def __bool__(self) -> bool:
        return self._e.n > 0


@dataclass
class _Run:
    """A piece under way: the model's stream, its plays, and whether its start was estimated."""

    stream: Stream
    is_estimated: bool


def predict_long(
    model: StageModel,
    record: LongRecord,
    *,
    add: Callable[[Piece, Vector], None] = lambda part, y_hat: None,
    progress: Progress = lambda step, share: None,
) -> FreeRun:
    """
    Predict a long record in free run, as `piezo_ident.model.free_run.free_run` does.

    Parameters
    ----------
    model : StageModel
    record : LongRecord
        Its displacement serves only the estimate of unknown starts and the errors.
    add : callable, optional
        Gets each part of the record with its prediction [m], shape (n,).
    progress : callable, optional
        Called as ``progress(step, share)`` while the record is read.

    Returns
    -------
    FreeRun
        Its prediction keeps the warnings alone.

    Raises
    ------
    ModelError
        When a piece has another sampling rate than the model, or the prediction overflows.
    NeedsWhole
        When a start can only be estimated from more samples than are kept.
    """
    whole, after = _Errors(), _Errors()
    estimated: list[bool] = []
    outside = 0
    last: Piece | None = None
    run: _Run | None = None
    sweep: Sweep | None = None
    sweeps = sweeps_of(record.pieces, [(p.v.low, p.v.high) for p in record])
    for (outline, parts), own in zip(record.parts(progress), sweeps, strict=True):
        first = next(parts)
        try:
            model.check_rate(first)
        except ModelError as error:
            raise ModelError(f'{record.name}: {error}') from None
        held = [first]
        if run and last and follows(last, first) is not None:
            run.stream.bridge(last, first)
            run.is_estimated = False
        else:
            run, held = _started(model, outline, first, parts)
            sweep = own if run.is_estimated else None
        estimated.append(run.is_estimated)
        for part in itertools.chain(held, parts):
            y_hat = run.stream.follow(part)
            if not np.all(np.isfinite(y_hat)):
                raise ModelError(f'{record.name}: {DIVERGES}')
            whole.add(part.y, y_hat)
            late = sweep.before(part.v) if sweep else 0
            after.add(part.y[late:], y_hat[late:])
            outside += model.outside(part.v)
            add(part, y_hat)
            last = part
    warnings = [start_warning(model, record.name, estimated)] if any(estimated) else []
    warnings += model.range_warnings(record.name, outside / record.n, record.voltage_range)
    return FreeRun(
        record=record,  # type: ignore[arg-type]
        pieces=(),
        estimated=tuple(estimated),
        errors=whole.result(record.stroke),
        errors_after_start=after.result(record.stroke) if after else None,
        warnings=tuple(warnings),
    )


def _started(
    model: StageModel, outline: Outline, first: Piece, parts: Iterator[Piece]
) -> tuple[_Run, list[Piece]]:
    """Return the run of a piece that follows no other, and the parts that this took."""
    if is_at_rest(model, first):
        return _Run(model.stream(), False), [first]
    held = [first]
    low, high = np.inf, -np.inf
    # as far as the piece needs to sweep its range
    while True:
        low, high = min(low, float(held[-1].v.min())), max(high, float(held[-1].v.max()))
        if high - low >= SHARE * outline.v.span and sum(p.n for p in held) >= min(10, outline.n):
            break
        if sum(p.n for p in held) > MOST:
            raise NeedsWhole('the range is swept too late')
        held.append(next(parts))
    early = Piece(
        np.concatenate([p.v for p in held]),
        np.concatenate([p.y for p in held]),
        first.sample_rate,
        first.start_time,
        channels={c: np.concatenate([p.channels[c] for p in held]) for c in first.channels},
    )
    start = forgotten(early.v, SHARE, outline.v.span)
    memory = fit_memory(model, early, max(start, 10))
    return _Run(model.stream(memory), True), held

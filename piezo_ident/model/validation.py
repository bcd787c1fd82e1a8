# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Free runs of a model over measured records, and the steady-state error at each sine."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
import re

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.errors import ModelError
from piezo_ident.model.initial_memory import memories_of
from piezo_ident.model.metrics import percent_of_stroke
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Piece, Record

__all__ = ['FreeRun', 'SineError', 'free_runs', 'sine_errors', 'sine_frequency', 'sines_of']

#: what is dropped at the start of a sine: this time and at least one period [s]
SETTLING = 1.0

_SINE = re.compile(r'sine:([0-9]+(?:\.[0-9]*)?(?:e[+-]?[0-9]+)?) ?Hz(?![^-_. ])', re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class FreeRun:
    """
    One piece with what the model makes of its voltage.

    Attributes
    ----------
    record : str
        Name of the record.
    piece : Piece
    y_hat, y_static : ndarray, shape (n,)
        Displacement from the whole model, and from its hysteresis alone [m].
    """

    record: str
    piece: Piece
    y_hat: NDArray[np.float64]
    y_static: NDArray[np.float64]


@dataclass(frozen=True)
class SineError:
    """
    Steady-state error of one sine segment.

    Attributes
    ----------
    frequency : float
        [Hz]
    percent, static_percent : float
        `piezo_ident.model.metrics.percent_of_stroke` of the whole model and of the hysteresis
        alone;
        the stroke is that of the samples compared.
    n : int
        Samples compared.
    """

    frequency: float
    percent: float
    static_percent: float
    n: int


def free_runs(
    model: StageModel,
    records: Iterable[Record] | Record,
    memories: Mapping[tuple[str, float], ArrayLike] | None = None,
) -> list[FreeRun]:
    """
    Run a model over all pieces that have its sampling rate.

    Parameters
    ----------
    model : StageModel
    records : iterable of Record, or Record
    memories : mapping, optional
        Play outputs at the start of a piece, by the record's name and the piece's start time.

    Returns
    -------
    list of FreeRun
        The unknown memory of a piece that does not start at rest is estimated from its beginning.
    """
    static = model.without_dynamics()
    runs = []
    for record in [records] if isinstance(records, Record) else records:
        starts = memories_of(model, record)
        for piece, start in zip(record, starts, strict=True):
            try:
                model.check_rate(piece)
            except ModelError:
                continue
            memory: ArrayLike | None = (memories or {}).get((record.name, piece.start_time))
            if memory is None:
                memory = start
            y_hat, y_static = (m.predict_piece(piece, memory) for m in (model, static))
            runs.append(FreeRun(record.name, piece, y_hat, y_static))
    return runs


def sine_frequency(label: str) -> float | None:
    """
    Return the frequency in a segment label [Hz], None when it names no sine.

    Examples
    --------
    >>> sine_frequency('sine:50Hz'), sine_frequency('noise')
    (50.0, None)
    """
    match = _SINE.match(label)
    frequency = float(match.group(1)) if match else 0.0
    return frequency if 0.0 < frequency < float('inf') else None


def sines_of(runs: Sequence[FreeRun]) -> tuple[SineError, ...]:
    """
    Return the steady-state error of every sine segment of some free runs, by frequency.

    Parameters
    ----------
    runs : sequence of FreeRun

    Returns
    -------
    tuple of SineError
        Segments that hold less than one period after the first second and period are left out.
    """
    found = []
    for run in runs:
        rate = run.piece.sample_rate
        for s in run.piece.segments:
            frequency = sine_frequency(s.label)
            if frequency is None:
                continue
            start = s.start + int(np.ceil(max(SETTLING, 1.0 / frequency) * rate))
            # half a sample is forgiven: the period need not be a whole number of them
            if s.stop - start < rate / frequency - 0.5:
                continue
            steady = slice(start, s.stop)
            y = run.piece.y[steady]
            found.append(
                SineError(
                    frequency=frequency,
                    percent=percent_of_stroke(y, run.y_hat[steady]),
                    static_percent=percent_of_stroke(y, run.y_static[steady]),
                    n=y.size,
                )
            )
    return tuple(sorted(found, key=lambda row: row.frequency))


def sine_errors(model: StageModel, record: Record) -> tuple[SineError, ...]:
    """
    Return the steady-state error of every sine segment of a record.

    The first second and at least one period of each segment are dropped, and the stroke is
    ``max y - min y`` of what is left.

    Parameters
    ----------
    model : StageModel
    record : Record
        With segments labelled by their frequency, as ``sine:50Hz``.

    Returns
    -------
    tuple of SineError
        By frequency.

    Raises
    ------
    ModelError
        When a piece with sines has another sampling rate than the model.
    """
    for piece in record:
        if piece.find('sine'):
            model.check_rate(piece)
    return sines_of(free_runs(model, record))

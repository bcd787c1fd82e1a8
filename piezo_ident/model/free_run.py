# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A recorded drive through a model: free run, with the unknown start estimated, and its errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import ModelError
from piezo_ident.model.initial_memory import memories_of, Sweep, sweeps_of
from piezo_ident.model.metrics import fit_percent, percent_of_stroke
from piezo_ident.model.stage_model import Prediction, StageModel
from piezo_ident.record.gaps import follows
from piezo_ident.record.record import Record

__all__ = ['DIVERGES', 'RecordErrors', 'RecordPrediction', 'predict_record', 'start_warning']

#: what is said of a prediction that is not finite
DIVERGES = 'the model diverges on this record; identify it again'


@dataclass(frozen=True)
class RecordErrors:
    """
    How far a free run is from the measurement.

    Attributes
    ----------
    n : int
        Samples judged.
    percent : float
        `piezo_ident.model.metrics.percent_of_stroke`, by the stroke of the whole record.
    fit : float
        `piezo_ident.model.metrics.fit_percent`.
    offset : float
        Mean of measured minus predicted [m]; a sensor that was set to zero anew shows here.
    percent_without_offset : float
        `percent` when `offset` is taken away.
    """

    n: int
    percent: float
    fit: float
    offset: float
    percent_without_offset: float

    @property
    def mostly_offset(self) -> bool:
        """Whether taking the offset away at least halves the error."""
        return self.percent_without_offset <= 0.5 * self.percent and self.percent > 0.0


@dataclass(frozen=True, eq=False)
class RecordPrediction:
    """
    Free run over a record.

    Attributes
    ----------
    prediction : Prediction
        With what a reader has to know before trusting it.
    estimated : tuple of bool
        For each piece, whether its memory at the start was estimated from its early part.
    whole : RecordErrors
        Of every sample.
    after : RecordErrors or None
        Of the samples at which the start is forgotten, or was known; None when there are none.
    """

    prediction: Prediction
    estimated: tuple[bool, ...]
    whole: RecordErrors
    after: RecordErrors | None


def predict_record(model: StageModel, record: Record) -> RecordPrediction:
    """
    Predict a record in free run.

    A piece that does not start at the lowest voltage starts from an unknown memory, which is
    estimated from its early part; the error behind that part is the one that nothing was fitted
    to.

    Parameters
    ----------
    model : StageModel
    record : Record
        Its displacement serves only the estimate and the errors.

    Raises
    ------
    ModelError
        When a piece has another sampling rate than the model, or the prediction overflows.
    """
    for piece in record:
        try:
            model.check_rate(piece)
        except ModelError as error:
            raise ModelError(f'{record.name}: {error}') from None
    memories = tuple(memories_of(model, record))
    before = (None, *record.pieces[:-1])
    estimated = tuple(
        memory is not None and (last is None or follows(last, piece) is None)
        for memory, last, piece in zip(memories, before, record, strict=True)
    )
    prediction = model.predict(record, memories)
    if any(estimated):
        said = start_warning(model, record.name, estimated)
        prediction = replace(prediction, warnings=(said, *prediction.warnings))
    late = []
    sweeps = sweeps_of(record.pieces, [(float(p.v.min()), float(p.v.max())) for p in record])
    sweep: Sweep | None = None
    for piece, last, unknown, own in zip(record, before, estimated, sweeps, strict=True):
        if last is None or follows(last, piece) is None:
            sweep = own if unknown else None
        mask = np.ones(piece.n, dtype=bool)
        mask[: sweep.before(piece.v) if sweep else 0] = False
        late.append(mask)
    y = np.concatenate([piece.y for piece in record])
    y_hat = np.concatenate(prediction.pieces)
    if not np.all(np.isfinite(y_hat)):
        raise ModelError(f'{record.name}: {DIVERGES}')
    mask = np.concatenate(late)
    return RecordPrediction(
        prediction=prediction,
        estimated=estimated,
        whole=_errors(y, y_hat, record.stroke),
        after=_errors(y[mask], y_hat[mask], record.stroke) if mask.any() else None,
    )


def start_warning(model: StageModel, name: str, estimated: Sequence[bool]) -> str:
    """Return what to say of a record where the memory at the start of pieces was estimated."""
    return (
        f'{name}: {sum(estimated)} of {len(estimated)} pieces do not start at the '
        f'lowest voltage, {model.scaling.range[0]:g} V; the memory at their start was '
        'estimated from their early part'
    )


def _errors(y: NDArray[np.float64], y_hat: NDArray[np.float64], stroke: float) -> RecordErrors:
    offset = float(np.mean(y - y_hat))
    return RecordErrors(
        n=y.size,
        percent=percent_of_stroke(y, y_hat, stroke),
        fit=fit_percent(y, y_hat),
        offset=offset,
        percent_without_offset=percent_of_stroke(y, y_hat + offset, stroke),
    )

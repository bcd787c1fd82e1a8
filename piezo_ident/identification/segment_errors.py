# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Free-run errors of every segment of a record: fitted, chosen by, and held out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.prepare import Run, runs_of
from piezo_ident.identification.results import ErrorRow
from piezo_ident.model.initial_memory import start_memory
from piezo_ident.model.metrics import fit_percent, percent_of_stroke, strokes
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record

__all__ = ['Memories', 'errors_of', 'key_of', 'validation_errors']

#: memory at the start of a run, by `key_of`
Memories = dict[tuple[str, float], NDArray[np.float64]]


def key_of(run: Run) -> tuple[str, float]:
    """Return record and start time of a run [s]; a clock that restarts may give it to several."""
    return run.record, run.piece.start_time


def errors_of(
    model: StageModel,
    runs: Sequence[Run],
    masks: Sequence[tuple[NDArray[np.bool_], NDArray[np.bool_]]],
    memories: Memories | None = None,
) -> list[ErrorRow]:
    """
    Return the free-run error of every segment, split into what was fitted and what was not.

    Parameters
    ----------
    model : StageModel
    runs : sequence of Run
    masks : sequence of (fitted, selection)
        For each run, the samples that were fitted and those that only chose between models.
    memories : dict, optional
        Memory at the start of a run, by record name and start time; that of other runs which do
        not start at rest is estimated.
    """
    static = model.without_dynamics()
    stroke_of = strokes((run.record, run.piece.y) for run in runs)
    rows = []
    for run, (fitted, selection) in zip(runs, masks, strict=True):
        memory = (memories or {}).get(key_of(run))
        # a start that is estimated here is estimated from samples that are then no test
        judged = run.known if memory is None else run.sound
        if memory is None:
            memory = start_memory(model, run.piece)
        y = run.piece.y
        y_hat, y_static = (m.predict_piece(run.piece, memory) for m in (model, static))
        stroke = stroke_of[run.record]
        names = [(s.label, s.start, s.stop) for s in run.piece.segments]
        for label, start, stop in names or [('', 0, run.piece.n)]:
            part = np.zeros(run.piece.n, dtype=bool)
            part[start:stop] = run.sound[start:stop]
            for data, mask in (
                ('fitted', part & fitted),
                ('selection', part & selection),
                ('held out', part & judged & ~fitted & ~selection),
            ):
                if not mask.any():
                    continue
                rows.append(
                    ErrorRow(
                        record=run.record,
                        segment=label,
                        percent=percent_of_stroke(y[mask], y_hat[mask], stroke),
                        static_percent=percent_of_stroke(y[mask], y_static[mask], stroke),
                        fit=fit_percent(y[mask], y_hat[mask]),
                        n=int(mask.sum()),
                        data=data,
                    )
                )
    return rows


def validation_errors(model: StageModel, records: Sequence[Record]) -> list[ErrorRow]:
    """
    Return the free-run errors of records that were given for validation.

    Raises
    ------
    IdentificationError
        When a record has no piece at the sampling rate of the model.
    """
    rows: list[ErrorRow] = []
    for record in records:
        runs = runs_of([record], model.sample_rate, model.scaling)
        if not runs:
            raise IdentificationError(
                f'{record.name}: no piece is sampled at {model.sample_rate:g} Hz, the rate of the '
                'model; record the data for validation at that rate'
            )
        nothing = [(np.zeros(run.piece.n, dtype=bool),) * 2 for run in runs]
        rows += [replace(row, data='validation') for row in errors_of(model, runs, nothing)]
    return rows

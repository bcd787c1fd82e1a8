# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Errors of an identified model on the runs of its fit, and the noise floor below them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.prepare import Excerpt, Run, runs_of
from piezo_ident.identification.results import ErrorRow, Memories
from piezo_ident.identification.spectra import high_passed
from piezo_ident.identification.step3_hysteresis import factorise, fine_thresholds, fit_hysteresis
from piezo_ident.model.initial_memory import early_part, fit_start
from piezo_ident.model.metrics import fit_percent, percent_of_stroke, strokes
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import StartLike
from piezo_ident.record.readings.faults import quantum_of
from piezo_ident.record.readings.quiet_voltage import with_quiet_voltage
from piezo_ident.record.record import Record
from piezo_ident.residual.noise_floor import NoiseFloor, residual_noise_floor
from piezo_ident.residual.stretches import all_stretches, ResidualPart

#: smallest difference of the mean errors in `moves_on`, over the rms error on the triangles
ELSEWHERE = 2.0


@dataclass(frozen=True, eq=False)
class Prediction:
    """
    Free run of a model, and of its hysteresis alone, over a run [m].

    `judged` leaves out the samples that estimate an unknown memory at the start, because they
    cannot test the model.  `zero` is the zero of displacement of the run.
    """

    run: Run
    y_hat: Array
    y_static: Array
    judged: Mask
    zero: float = 0.0


def key_of(run: Run) -> tuple[str, float]:
    """Key of a run: record and start time [s]; runs after a clock restart may share a key."""
    return run.record, run.piece.start_time


def fitted_memories(runs: Sequence[Run], model: StageModel) -> Memories:
    """
    Estimate the unknown memories at the starts of runs; runs that share a key have none.

    The memories of the three steps belong to temporary plays.  With the plays of the model these
    memories may be off by 3 % of stroke.
    """
    keys = [key_of(run) for run in runs]
    starts = {
        key: fit_start(model, run.piece, run.use)
        for key, run in zip(keys, runs, strict=True)
        if run.memory is not None and keys.count(key) == 1
    }
    return {key: start for key, start in starts.items() if start is not None}


def predictions_of(
    model: StageModel,
    runs: Sequence[Run],
    memories: Memories | None = None,
    offsets: Mapping[tuple[str, float], float] | None = None,
) -> list[Prediction]:
    """Simulate each run freely; estimate its memory at the start if `memories` lacks it."""
    static, predictions = model.without_dynamics(), []
    for run in runs:
        start: StartLike = (memories or {}).get(key_of(run))
        judged = run.use
        if start is None:
            start, judged = fit_start(model, run.piece, run.use), run.known
            if start is not None:
                late = early_part(model, run.piece, memory=start.memory is not None)
                judged = judged & (np.arange(judged.size) >= late)
        # a sensor may have been zeroed between two records
        zero = (offsets or {}).get(key_of(run), 0.0)
        y_hat, y_static = (m.predict_piece(run.piece, start) + zero for m in (model, static))
        predictions.append(Prediction(run, y_hat, y_static, judged, zero))
    return predictions


def errors_of(
    predictions: Sequence[Prediction], masks: Sequence[tuple[Mask, Mask]]
) -> list[ErrorRow]:
    """
    Compute the free-run error of every segment, separately for each use of its samples.

    The masks give for each run the fitted samples, and the samples that only chose between models.
    """
    stroke_of = strokes((p.run.record, p.run.piece.y) for p in predictions)
    rows = []
    for p, (fitted, selection) in zip(predictions, masks, strict=True):
        piece, stroke = p.run.piece, stroke_of[p.run.record]
        names, rest = [(s.label, s.start, s.stop) for s in piece.segments], p.run.use.copy()
        for label, start, stop in (*names, ('', 0, piece.n)):
            part = np.zeros(piece.n, dtype=bool)
            part[start:stop], rest[start:stop] = rest[start:stop].copy(), False
            for data, mask in (
                ('fitted', part & fitted),
                ('selection', part & selection),
                ('held out', part & p.judged & ~fitted & ~selection),
            ):
                if mask.any():
                    y = piece.y[mask]
                    whole, static = (
                        percent_of_stroke(y, x[mask], stroke) for x in (p.y_hat, p.y_static)
                    )
                    fit = fit_percent(y, p.y_hat[mask])
                    rows.append(ErrorRow(p.run.record, label, whole, static, fit, y.size, data))
    return rows


def noise_floor_of(predictions: Sequence[Prediction]) -> NoiseFloor:
    """
    Estimate the noise floor from the residuals of all runs.

    The floor is at least q / sqrt(12), the rounding of a converter with steps of q.  Readings that
    rest on one step hide this rounding.
    """
    parts = [
        ResidualPart(p.run.record, p.run.piece, p.run.piece.y - p.y_hat, p.run.use)
        for p in predictions
    ]
    floor = residual_noise_floor(parts, all_stretches(parts))
    rounding = max(quantum_of(p.run.piece.y) for p in predictions) / np.sqrt(12.0)
    if floor.rms is None or floor.rms >= rounding:
        return floor
    return replace(floor, rms=float(rounding), source='the rounding of the converter')


def with_fine_plays(model: StageModel, excerpts: Sequence[Excerpt]) -> StageModel:
    """Refit H with many plays, because few plays err on small loops, hence on fast motion."""
    swing = max(e.swing for e in excerpts)
    r = fine_thresholds(swing, swing / 10.0)
    R = factorise(excerpts, r, model.dynamics, model.delay)
    return replace(model, hysteresis=fit_hysteresis(R, r).hysteresis)


def fast_error(model: StageModel, law: str, runs: Sequence[Run]) -> tuple[float, float]:
    """
    Compute the error on fast motion with a fine H, and the fast motion itself.

    Both are rms values in % of stroke.  A diagnosis fits a fine H of its own, so this error uses a
    fine H, too.  A high-pass removes a moved zero and creep.
    """
    if law == 'plays':
        model = with_fine_plays(model, [run.excerpt(run.use) for run in runs])
    predictions = predictions_of(model, runs)
    stroke_of = strokes((p.run.record, p.run.piece.y) for p in predictions)

    def fast_rms(signals: Iterable[Array]) -> float:
        parts = [
            high_passed(y, p.run.piece.sample_rate)[p.run.use] / stroke_of[p.run.record]
            for y, p in zip(signals, predictions, strict=True)
        ]
        return 100.0 * float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))

    left = (p.run.piece.y - p.y_hat for p in predictions)
    return fast_rms(left), fast_rms(p.run.piece.y for p in predictions)


def validation_errors(model: StageModel, records: Sequence[Record]) -> list[ErrorRow]:
    """
    Compute the free-run errors of validation records.

    Readings that `without_faults` removed do not count.  Raises IdentificationError if a record
    has no piece at the sampling rate of the model.
    """
    rows: list[ErrorRow] = []
    for record in records:
        runs = runs_of([with_quiet_voltage(record)], model.sample_rate, model.scaling)
        if not runs:
            raise IdentificationError(
                f'{record.name}: no piece is sampled at {model.sample_rate:g} Hz, the rate of the '
                'model; record the data for validation at that rate'
            )
        nothing = [(np.zeros(run.piece.n, dtype=bool),) * 2 for run in runs]
        judged = errors_of(predictions_of(model, runs), nothing)
        rows += [replace(row, data='validation') for row in judged]
    return rows


def _residual(model: StageModel, run: Run) -> Array:
    """Compute the free-run residual of a run [m]."""
    return run.piece.y - model.predict_piece(run.piece, run.start(model.hysteresis.thresholds))


def moves_on(model: StageModel, runs: Sequence[Run]) -> bool:
    """
    Tell whether the mean errors of small motion and of triangles differ clearly.

    If a stage is not a sum of plays, its small loops stay open.  Under steps and noise the
    displacement drifts towards the middle of the large loop.  A triangle hides this drift.
    """
    for run in runs:
        e = _residual(model, run)
        sweeps, small = (
            e[run.mask(*kinds) & run.known & ~run.held_out()]
            for kinds in (('triangle',), ('step', 'settle', 'noise'))
        )
        if sweeps.size and small.size:
            shift = float(small.mean() - sweeps.mean())
            if abs(shift) > ELSEWHERE * float(sweeps.std()):
                return True
    return False


def squares_left(model: StageModel, runs: Sequence[Run]) -> float:
    """Sum the squared residuals over the held-out samples, around the mean of each run [m^2]."""
    left = 0.0
    for run in runs:
        kept = run.held_out() & run.use
        if kept.any():
            e = _residual(model, run)[kept]
            left += float(np.sum((e - e.mean()) ** 2))
    return left

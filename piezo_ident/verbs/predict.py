# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Predict a record by a model of one axis or of several axes."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from numbers import Real
from typing import overload

from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import DataError, expect
from piezo_ident.model.axis_records import axis_record, is_measured
from piezo_ident.model.free_run import compared, FreeRun
from piezo_ident.model.free_run import free_run as run_axis
from piezo_ident.model.free_run import predict as predict_axis
from piezo_ident.model.initial_memory import unknown_starts
from piezo_ident.model.multi_axis import (
    alone,
    EachAxis,
    models_of,
    MultiAxisModel,
    without_other_axes,
)
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.readings.faults import without_faults
from piezo_ident.record.record import Record
from piezo_ident.uncertainty.prediction import half_widths, with_half_widths
from piezo_ident.verbs.shared_modes import modes_half_widths


@overload
def free_run(model: StageModel, record: Record, interval: float | None = ...) -> FreeRun: ...


@overload
def free_run(
    model: StageModel | MultiAxisModel,
    record: Record,
    interval: float | None = ...,
    axes: Collection[str] = ...,
) -> FreeRun | EachAxis[FreeRun]: ...


def free_run(
    model: StageModel | MultiAxisModel,
    record: Record,
    interval: float | None = None,
    axes: Collection[str] = (),
) -> FreeRun | EachAxis[FreeRun]:
    """
    Predict a record in free run, and compare it with the measured displacement.

    If a record does not start at rest at the lowest voltage, the unknown memory is estimated from
    its early part.  A model with creep also gets the creep from earlier motion if the early part
    shows it.  Later samples are predicted without a fit.

    An observer estimates the displacement, too, as the model node does live: from rest, and from
    displacement that is at least 100 samples older.

    Parameters
    ----------
    model : StageModel or MultiAxisModel
    record : Record
        The displacement serves only for the start, the estimate and the errors.
    interval : float, optional
        Level of a band of the error, for example 0.9; see `piezo_ident.uncertainty.band`.
    axes : collection of str, optional
        Axes to compare.  Default: all axes of the model.

    Returns
    -------
    FreeRun, or EachAxis of FreeRun

    Raises
    ------
    ModelError
        When a piece has another sampling rate than the model, the prediction overflows, or the
        model carries no band.
    DataError
        When the record lacks the displacement or an axis; `simulate` of a model takes voltages
        alone.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> stage = pi.SimulatedStage.load('paper')
    >>> record = stage.play(pi.Program.load('minor_loops'))
    >>> run = pi.free_run(stage.model, record)
    >>> run.predicted.shape == run.measured.shape
    True
    >>> run.errors.percent < 0.01
    True
    """
    if interval is not None:
        expect(interval, Real, 'free_run, interval', 'give a level between 0 and 1, as in 0.9')
    known = model.axes if isinstance(model, MultiAxisModel) else ('y',)
    if absent := [axis for axis in axes if axis not in known]:
        raise DataError(
            f'free_run, axes: the model has no axis {", ".join(absent)}; give a list of '
            f'{", ".join(known)}'
        )
    if not isinstance(model, MultiAxisModel):
        run = run_axis(model, record)
        own_motion = without_other_axes(model)
        run = replace(run, alone=own_motion, coupled=own_motion.effects != model.effects)
        if interval is None:
            return run
        own = half_widths(model, run.record, run.pieces, interval, run.estimated)
        return with_half_widths(run, interval, own)
    expect(record, Record, 'free_run, second argument', 'read a file with read')
    seen = model.seen(record)
    unknown = [a for a in axes or model.axes if a not in seen or not is_measured(record, a)]
    if unknown:
        raise DataError(
            f'{record.name}: has no displacement of {", ".join(unknown)} to compare with; name '
            "the other axes in 'axes', or predict from the voltages alone"
        )
    kept = {axis: seen[axis] for axis in axes or model.axes}
    if model.modes is not None:
        predicted = model.predicted(record)
        # no prediction knows the motion before a record
        late = [min(model.modes.settling, piece.n) for piece in record]
        runs = {
            axis: compared(model.axes[axis], without_faults(one), predicted[axis], late)
            for axis, one in kept.items()
        }
        single = alone(model)
        runs = {a: replace(x, alone=single[a]) for a, x in runs.items()}
        if interval is not None:
            half = modes_half_widths(model, model.modes, seen, predicted, interval)
            runs = {a: with_half_widths(x, interval, half[a]) for a, x in runs.items()}
        return EachAxis(runs)
    return EachAxis({axis: free_run(model.axes[axis], x, interval) for axis, x in kept.items()})


def predict(
    model: StageModel | MultiAxisModel, record: Record
) -> tuple[Array, ...] | EachAxis[tuple[Array, ...]]:
    """Predict the displacement from the voltages alone; an array for each piece [m]."""
    if not isinstance(model, MultiAxisModel):
        return predict_axis(model, record)
    return EachAxis(model.predicted(record))


def bands(
    model: StageModel | MultiAxisModel,
    record: Record,
    predicted: Mapping[str, Sequence[Array]],
    interval: float,
) -> dict[str, tuple[Array, ...]]:
    """
    Compute the half widths [m] of predictions from voltages alone, by axis.

    Shared modes need the predictions of all axes.
    """
    seen = model.seen(record) if isinstance(model, MultiAxisModel) else {'y': record}
    if isinstance(model, MultiAxisModel) and model.modes is not None:
        return modes_half_widths(model, model.modes, seen, predicted, interval)
    models = models_of(model)
    return {k: half_widths(models[k], seen[k], x, interval) for k, x in predicted.items()}


def prediction_doubts(model: StageModel | MultiAxisModel, record: Record) -> tuple[str, ...]:
    """List reasons to doubt a prediction from voltages alone, as warnings."""
    if not isinstance(model, MultiAxisModel):
        return (*unknown_starts(model, record), *model.extrapolation(record))
    return tuple(
        f'axis {axis}: {text}'
        for axis, x in model.axes.items()
        for text in prediction_doubts(x, axis_record(record, axis))
    )

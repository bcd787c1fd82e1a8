# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Identify and diagnose a stage, axis by axis where it has several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import overload

import numpy as np
from piezo_ident.common.arrays import Array, Mask, true_runs
from piezo_ident.diagnosis import diagnose as diagnose_axis
from piezo_ident.diagnosis import Diagnosis, DiagnosisSettings
from piezo_ident.identification.identify import identify as identify_axis
from piezo_ident.identification.results import (
    Identification,
    Progress,
    Settings,
    silent,
    Steps,
)
from piezo_ident.model.multi_axis import (
    axes_of,
    axis_record,
    EachAxis,
    MultiAxisModel,
    voltage_of,
)
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.channels import role_of
from piezo_ident.record.record import Piece, Record, records_of

#: share of the range of a voltage below which it rests
RESTS = 1e-3
#: seconds of rest, while another axis moves, that are no part of an identification
LONG = 1.0
#: seconds that are judged at once
BLOCK = 0.25


def identify(
    records: Sequence[Record] | Record,
    settings: Settings | None = None,
    *,
    validation: Sequence[Record] | Record = (),
    progress: Progress = silent,
    steps: Steps | None = None,
) -> Identification | EachAxis[Identification]:
    """
    Learn a stage from its records, each axis where they hold several.

    Parameters
    ----------
    records : sequence of Record, or Record
        With segments ``noise`` and ``triangle`` (and ``step``) the three steps are taken; segments
        of other kinds are then left for validation.  Without them every run is fitted in one
        go, but for what is held out.  With ``v_<name>`` and ``y_<name>`` beside ``v`` and ``y``
        the stage has several axes.  They may move one after the other, in one record or in
        several, or at once.
    settings : Settings, optional
    validation : sequence of Record, or Record, optional
        Records that are neither fitted nor looked at; the headline is about them.
    progress : callable, optional
        Called with the name of the step and its share done; may raise `Cancelled`.
    steps : Steps, optional
        Steps of the three that were taken already, of a stage of one axis; where they are given,
        even empty ones, records without labelled segments are refused.

    Returns
    -------
    Identification, or EachAxis of Identification
        Of several axes without the paths between them, which `diagnose` finds.

    Raises
    ------
    IdentificationError
        When the data do not carry a model; the message says what they lack.
    DataError
        When records hold different axes.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> v = 5.0 - 5.0 * np.cos(2.0 * np.pi * np.arange(4000) / 1000.0)
    >>> record = pi.Record.from_arrays(v, 1e-6 * v, sample_rate=1000.0)
    >>> result = pi.identify(record, pi.Settings(thresholds=4))
    >>> bool(result.headline.percent < 0.1)
    True
    """
    records, validation = (records_of(x, 'identify') for x in (records, validation))
    of_axes = {
        axis: [part for record in records for part in _moved(record, axis)]
        for axis in axes_of([*records, *validation])
    }
    still = tuple(
        f'{voltage_of(axis)} never moves; axis {axis} is not identified'
        for axis, parts in of_axes.items()
        if not parts
    )
    if len(of_axes) == 1 or not any(of_axes[axis] for axis in of_axes if axis != 'y'):
        one = identify_axis(
            records, settings, validation=validation, progress=progress, steps=steps
        )
        return replace(one, warnings=(*one.warnings, *still))
    found = {}
    for axis, parts in of_axes.items():
        if parts:
            unseen, told = [axis_record(r, axis) for r in validation], _named(progress, axis)
            one = identify_axis(parts, settings, validation=unseen, progress=told)
            found[axis] = replace(one, warnings=(*one.warnings, *still))
    return EachAxis(found)


@overload
def diagnose(
    model: StageModel,
    records: Sequence[Record] | Record,
    settings: DiagnosisSettings | None = ...,
    *,
    progress: Progress = ...,
) -> Diagnosis: ...


@overload
def diagnose(
    model: StageModel | MultiAxisModel,
    records: Sequence[Record] | Record,
    settings: DiagnosisSettings | None = ...,
    *,
    progress: Progress = ...,
) -> Diagnosis | EachAxis[Diagnosis]: ...


def diagnose(
    model: StageModel | MultiAxisModel,
    records: Sequence[Record] | Record,
    settings: DiagnosisSettings | None = None,
    *,
    progress: Progress = silent,
) -> Diagnosis | EachAxis[Diagnosis]:
    """
    Find what a model lacks, add it, and say how sure that is.

    Parameters
    ----------
    model : StageModel or MultiAxisModel
        From `identify`; it may hold effects already.
    records : Record, or sequence of Record
        Measured data that the model was not identified from, of its sampling rate.  Of more than
        ``settings.most_samples`` the beginnings of the records are searched and fitted, and a
        warning says how much that is.
    settings : DiagnosisSettings, optional
    progress : callable, optional
        Called with the name of the step and the share done; may raise `Cancelled`.

    Returns
    -------
    Diagnosis, or EachAxis of Diagnosis
        Of several axes each is judged with the motions of the others known: the channel of its
        `cross_coupling` names the axis that it comes from.

    Raises
    ------
    IdentificationError
        When the records carry nothing to judge, the displacement does not follow the voltage, or
        the joint fit is singular.

    Examples
    --------
    A stage whose amplifier saturates, which its model does not know:

    >>> from dataclasses import replace
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> from piezo_ident.model.stage_model import EffectSetting
    >>> model = pi.SimulatedStage.load('paper').model
    >>> stage = replace(model, effects=(EffectSetting('saturation', {'high': 0.8}),))
    >>> t = np.arange(20_000) / 20_000
    >>> v = 2.5 * (1 + np.floor(20 * t) % 2) * (1 - np.cos(40 * np.pi * t))
    >>> record = pi.Record.from_arrays(v, stage.simulate(v), sample_rate=20_000)
    >>> few = pi.DiagnosisSettings(effects=('saturation', 'backlash'))
    >>> result = pi.diagnose(model, record, few)
    >>> result.verdict, round(result.effects[0].parameters['high'].value, 2)
    ('named', 0.8)
    >>> result.after.overall < 0.01 * result.before.overall
    True
    """
    if not isinstance(model, MultiAxisModel):
        return diagnose_axis(model, records, settings, progress=progress)
    seen = [model.seen(record) for record in records_of(records, 'diagnose, second argument')]
    return EachAxis(
        {
            axis: diagnose_axis(
                x, [of[axis] for of in seen], settings, progress=_named(progress, axis)
            )
            for axis, x in model.axes.items()
        }
    )


def _named(progress: Progress, axis: str) -> Progress:
    return lambda step, share: progress(f'{axis}: {step}', share)


def _moved(record: Record, axis: str) -> list[Record]:
    """Return a record as an axis sees it, without long rests in which only others move."""
    seen = axis_record(record, axis)
    pieces: list[Piece] = []
    moves = False
    for piece, whole in zip(seen, record, strict=True):
        others = {k: x for k, x in whole.channels.items() if role_of(k) == 'v'} | {'v': whole.v}
        del others[voltage_of(axis)]
        span = max(float(np.ptp(x)) for x in (piece.v, *others.values()))
        size = max(2, round(BLOCK * piece.sample_rate))
        still = np.all([_rests(x, span, size) for x in others.values()], axis=0)
        rests = _rests(piece.v, span, size)
        moves |= not rests.all()
        runs = true_runs(rests & ~still)
        long = [(a * size, b * size) for a, b in runs if (b - a) * size > LONG * piece.sample_rate]
        pieces += piece.without((a, min(b, piece.n)) for a, b in long)
    return [replace(seen, pieces=tuple(pieces))] if moves else []


def _rests(v: Array, span: float, size: int) -> Mask:
    """Return for each block of a size whether a voltage rests in it, beside a span."""
    starts = np.arange(0, v.size, size)
    spans = np.maximum.reduceat(v, starts) - np.minimum.reduceat(v, starts)
    return np.asarray(spans <= RESTS * span)

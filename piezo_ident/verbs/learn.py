# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Identify and diagnose a stage of one axis, or several axes one by one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import functools
from typing import Any, overload

import numpy as np
from piezo_ident.common.arrays import Array, Mask, true_runs
from piezo_ident.common.errors import ConfigError
from piezo_ident.diagnosis import diagnose as diagnosis_alone
from piezo_ident.diagnosis import Diagnosis, DiagnosisSettings
from piezo_ident.diagnosis.shared_modes import find_shared_modes, Multisines, with_shared_modes
from piezo_ident.diagnosis.shared_modes import NAME as LOOP
from piezo_ident.identification.identify import identify_and_judge
from piezo_ident.identification.results import Identification, Steps
from piezo_ident.identification.settings import Progress, Settings, silent
from piezo_ident.model.axis_records import axes_of, axis_record, voltage_of
from piezo_ident.model.multi_axis import EachAxis, MultiAxisModel
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.channels import role_of
from piezo_ident.record.record import Piece, Record, records_of
from piezo_ident.uncertainty.parameters import with_deviations
from piezo_ident.uncertainty.promises import promised_diagnosis, promised_identification
from piezo_ident.verbs.learn_modes import (
    AxesData,
    chains_were_kept,
    diagnosed_modes,
    with_better_modes,
)
from piezo_ident.verbs.promised_modes import promised_modes

#: largest change of a voltage at rest, as a share of its range
RESTS = 1e-3
#: longest rest of an axis that its identification keeps while another axis moves [s]
LONG = 1.0
#: length of the blocks in which rest is judged [s]
BLOCK = 0.25
#: notes of a diagnosis on the choice of an identification between chains and shared modes
ALREADY_TRIED = (
    'modes that the axes share were not tried: identify kept chains on the multisines of these '
    'records'
)
TRIED_AGAIN = (
    'modes that the axes share were tried again: identify kept chains, on other multisines'
)


def identify_axis(
    records: Sequence[Record] | Record, settings: Settings | None = None, **options: Any
) -> Identification:
    """Identify a stage of one axis, with the band and the promise; see `identify`."""
    result, judged = identify_and_judge(records, settings, **options)
    return promised_identification(with_deviations(result, judged), judged)


def diagnose_axis(
    model: StageModel,
    records: Sequence[Record] | Record,
    settings: DiagnosisSettings | None = None,
    *,
    progress: Progress = silent,
) -> Diagnosis:
    """Diagnose a stage of one axis, with the band and the promise; see `diagnose`."""
    return promised_diagnosis(diagnosis_alone(model, records, settings, progress=progress))


def identify(
    records: Sequence[Record] | Record,
    settings: Settings | None = None,
    *,
    validation: Sequence[Record] | Record = (),
    progress: Progress = silent,
    steps: Steps | None = None,
) -> Identification | EachAxis[Identification]:
    """
    Identify a stage from its records, axis by axis.

    Parameters
    ----------
    records : sequence of Record, or Record
        Records with segments ``noise`` and ``triangle`` (and ``step``) are identified in three
        steps; their other segments serve for validation.  Records without these segments are
        fitted as a whole, except for a part that is held out.  Columns ``v_<name>`` and
        ``y_<name>`` beside ``v`` and ``y`` are further axes.  The axes may move at once or one
        after the other, in one record or in several.  The last record gives the zero of
        displacement, so records come in the order of recording.
    settings : Settings, optional
    validation : sequence of Record, or Record, optional
        Unseen records, which take no part in the fit; the headline gives the error on them.
    progress : callable, optional
        Called with the name of the step and its share done; may raise `Cancelled`.
    steps : Steps, optional
        Results of earlier steps, for a stage of one axis.  With `steps`, even if it holds no
        results, records must have labelled segments.

    Returns
    -------
    Identification, or EachAxis of Identification
        The models of several axes lack the paths between the axes, which `diagnose` finds.  With
        multisines of all axes at once, modes that the axes share replace the chains if the modes
        err clearly less on multisines held out.

    Raises
    ------
    IdentificationError
        When the data are not enough for a model; the message names the missing data.
    DataError
        When records hold different axes.
    ConfigError
        When there are steps, and records of several axes.

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> v = 5.0 - 5.0 * np.cos(2.0 * np.pi * np.arange(4000) / 1000.0)
    >>> record = pi.Record.from_arrays(v, 1e-6 * v, sample_rate=1000.0)
    >>> result = pi.identify(record, pi.Settings(thresholds=4))
    >>> bool(result.headline.percent < 0.1)
    True
    """
    records, validation = (records_of(x, 'identify') for x in (records, validation))
    axes = axes_of([*records, *validation])
    if len(axes) == 1:
        return identify_axis(
            records, settings, validation=validation, progress=progress, steps=steps
        )
    if steps is not None:
        raise ConfigError(
            f'identify: steps are of a stage of one axis, and the records hold {", ".join(axes)}; '
            'leave the steps out, or give records of one axis'
        )
    of_axes = {axis: [part for r in records for part in _moved(r, axis)] for axis in axes}
    still = tuple(
        f'{voltage_of(axis)} never moves; axis {axis} is not identified'
        for axis, parts in of_axes.items()
        if not parts
    )
    if not any(of_axes[axis] for axis in axes if axis != 'y'):
        one = identify_axis(records, settings, validation=validation, progress=progress)
        return replace(one, warnings=(*one.warnings, *still))
    results = {}
    for axis, parts in of_axes.items():
        if parts:
            unseen, told = [axis_record(r, axis) for r in validation], _named(progress, axis)
            one = identify_axis(parts, settings, validation=unseen, progress=told)
            results[axis] = replace(one, warnings=(*one.warnings, *still))
    data = AxesData(records, validation, of_axes)
    return with_better_modes(EachAxis(results), data, progress)


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
    Find the effects that a model lacks, add them, and state their certainty.

    Parameters
    ----------
    model : StageModel or MultiAxisModel
        From `identify`; it may hold effects already.
    records : Record, or sequence of Record
        Measured data that took no part in the identification, at the sampling rate of the model.
        If the records have more than ``settings.most_samples``, their beginnings alone are
        searched and fitted, and a warning gives the length of these beginnings.
    settings : DiagnosisSettings, optional
    progress : callable, optional
        Called with the name of the step and the share done; may raise `Cancelled`.

    Returns
    -------
    Diagnosis, or EachAxis of Diagnosis
        Each axis is judged with the motions of the other axes.  The channel of a `cross_coupling`
        names the axis that the coupling comes from.  A model with shared modes is judged as it is.

    Raises
    ------
    IdentificationError
        When the voltage always rests, the displacement does not follow the voltage, too few
        samples are left, or the joint fit is singular.

    Examples
    --------
    A stage whose amplifier saturates, and whose model lacks this saturation:

    >>> from dataclasses import replace
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> from piezo_ident.model.stage_model import EffectSetting
    >>> model = pi.SimulatedStage.load('paper').model
    >>> stage = replace(model, effects=(EffectSetting('saturation', {'high': 0.8}),))
    >>> t = np.arange(10_000) / 20_000
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
    settings = DiagnosisSettings() if settings is None else settings
    records = records_of(records, 'diagnose, second argument')
    if model.modes is not None:
        return diagnosed_modes(model, records, settings)
    seen = [model.seen(record) for record in records]
    results = EachAxis(
        {
            axis: diagnose_axis(
                x, [of[axis] for of in seen], settings, progress=_named(progress, axis)
            )
            for axis, x in model.axes.items()
        }
    )
    names = {*(settings.effects or (LOOP,))} - {*settings.without}
    sines = Multisines.of(model.axes, records) if LOOP in names else None
    if sines is None:
        return results
    if known := chains_were_kept(model, sines):
        return results.mapped(functools.partial(_warned, ALREADY_TRIED))
    shared = find_shared_modes(results.model, sines, records, progress)
    if known is not None:
        results = results.mapped(functools.partial(_warned, TRIED_AGAIN))
    if shared is None:
        return results
    results = replace(results, modes=shared.modes)
    predicted = [(record, results.model.predicted(record)) for record in records]
    order = sorted(results)

    def judged_and_promised(axis: str, x: Diagnosis) -> Diagnosis:
        runs = {
            (record.name, piece.start_time): y
            for record, of in predicted
            for piece, y in zip(record, of[axis], strict=True)
        }
        own = {label: float(of[order.index(axis)]) for label, of in shared.held_out.items()}
        return promised_modes(with_shared_modes(x, shared, runs), own)

    return results.mapped(judged_and_promised)


def _warned(text: str, _: str, result: Diagnosis) -> Diagnosis:
    return replace(result, warnings=(*result.warnings, text))


def _named(progress: Progress, axis: str) -> Progress:
    return lambda step, share: progress(f'{axis}: {step}', share)


def _moved(record: Record, axis: str) -> list[Record]:
    """Reduce a record to one axis, without its long rests while other axes move."""
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
    """Return for each block of `size` samples whether v changes by at most `RESTS` of `span`."""
    starts = np.arange(0, v.size, size)
    spans = np.maximum.reduceat(v, starts) - np.minimum.reduceat(v, starts)
    return np.asarray(spans <= RESTS * span)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Identify a stage: in three steps if noise and a triangle are labelled, else by one fit.

Gu, Li, Zhu and Su, "Modeling and Identification of Piezoelectric-Actuated Stages Cascading
Hysteresis Nonlinearity With Linear Dynamics", IEEE/ASME Trans. Mechatronics 21(3), 2016,
doi:10.1109/TMECH.2015.2465868.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from platform import python_version
from typing import Any

import numpy as np
from piezo_ident.common.errors import expect, IdentificationError
from piezo_ident.identification.errors import (
    errors_of,
    fast_error,
    noise_floor_of,
    Prediction,
    predictions_of,
    validation_errors,
)
from piezo_ident.identification.free_run_fit import fit_free_run
from piezo_ident.identification.prepare import fault_lines, filled_in, prepare, Prepared, Run
from piezo_ident.identification.refusals import refuse_delay
from piezo_ident.identification.results import FitOutcome, Identification, Steps
from piezo_ident.identification.settings import Progress, Settings, silent
from piezo_ident.identification.solvers.least_squares import singular_is_ours
from piezo_ident.identification.starts import with_starts
from piezo_ident.identification.step1_delay import first_step
from piezo_ident.identification.step2_dynamics import second_step
from piezo_ident.identification.three_steps import fit_three_steps
from piezo_ident.identification.warnings import warn_of_shape, warnings_of
from piezo_ident.model.metrics import FORMULA, percent, strokes
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.dynamics import Delay
from piezo_ident.record.readings.faults import without_faults
from piezo_ident.record.record import named_apart, Record, records_of
from piezo_ident.selection.judged import Judged, JudgedRun
from scipy import __version__ as scipy_version

_UNLABELLED = (
    '{}: no segments are labelled {}; drive the stage with the program identification, or '
    'identify unlabelled data in one go'
)


def identify(
    records: Sequence[Record] | Record,
    settings: Settings | None = None,
    *,
    validation: Sequence[Record] | Record = (),
    progress: Progress = silent,
    steps: Steps | None = None,
) -> Identification:
    """Identify one axis; `piezo_ident.identify` adds the promise, the error on other records."""
    return identify_and_judge(records, settings, validation, progress, steps)[0]


def identify_and_judge(
    records: Sequence[Record] | Record,
    settings: Settings | None = None,
    validation: Sequence[Record] | Record = (),
    progress: Progress = silent,
    steps: Steps | None = None,
) -> tuple[Identification, Judged]:
    """Identify a stage of one axis; also return the runs for promise, band and deviations."""
    records, validation = (records_of(x, 'identify') for x in (records, validation))
    settings = Settings() if settings is None else settings
    hint = 'make them with Settings(...), and give several records as one list'
    expect(settings, Settings, 'identify, settings', hint)
    with singular_is_ours():
        return _identify(records, settings, validation, progress, steps)


def _identify(
    records: Sequence[Record],
    settings: Settings,
    validation: Sequence[Record],
    progress: Progress,
    steps: Steps | None,
) -> tuple[Identification, Judged]:
    records, validation = named_apart(records, validation)
    data, validation = prepare(records), [without_faults(record) for record in validation]
    refuse_delay(data.pieces, settings.delay)
    fit = _fitted(data, settings, progress, steps)
    model, (judged, predictions) = fit.model, _predicted(fit, data.runs)
    # a sensor may have been zeroed between two records
    stroke = max(strokes((p.run.record, p.run.piece.y) for p in predictions).values())
    beyond = [text for record in validation for text in model.extrapolation(record)]
    floor, shape = noise_floor_of(predictions), warn_of_shape(predictions, data.scaling)
    result = Identification(
        model=model,
        delay=fit.delay,
        dynamics=fit.dynamics,
        hysteresis=fit.hysteresis,
        errors=(*errors_of(predictions, fit.masks), *validation_errors(model, validation)),
        noise_floor=None if floor.rms is None else percent(floor.rms, stroke),
        noise_source=floor.source,
        stroke=stroke,
        warnings=(*data.warnings, *fault_lines(validation), *fit.warnings, *shape, *beyond),
        not_identified=tuple(fit.not_identified),
        settings=settings,
        records=(*data.records, *validation),
        memories=fit.memories,
    )
    warnings = (*result.warnings, *warnings_of(result, records, data.pieces))
    result = replace(result, warnings=warnings)
    provenance = _provenance(result, records, fast_error(judged, fit.hysteresis.law, data.runs))
    judged_runs = (
        JudgedRun(p.run.record, p.run.piece, p.y_hat, p.judged, ~fitted, p.zero)
        for p, (fitted, _) in zip(predictions, fit.masks, strict=True)
    )
    result = replace(result, model=replace(model, identification=provenance))
    return result, Judged(tuple(judged_runs), fit.fit)


def _fitted(
    data: Prepared, settings: Settings, progress: Progress, steps: Steps | None
) -> FitOutcome:
    """Fit in three steps; without the labels, or for the solver joint, fit all by free runs."""
    runs, scaling = data.runs, data.scaling
    in_steps = data.labelled and settings.solver != 'joint'
    if not in_steps and steps is not None:
        own = 'hysteresis: the solver joint has no single steps; identify in one go'
        other = _UNLABELLED.format('hysteresis', 'noise and triangle')
        raise IdentificationError(own if data.labelled else other)

    def fitted(runs: Sequence[Run]) -> FitOutcome:
        if in_steps:
            return fit_three_steps(runs, data.rate, scaling, settings, progress, steps or Steps())
        return fit_free_run(runs, data.rate, scaling, settings, progress)

    fit = fitted(runs)
    if any(piece.sound is not None for piece in data.pieces):
        # fit again with lost readings replaced by the prediction, which is better than a line
        fit = fitted([filled_in(p.run, p.y_hat, scaling) for p in _predicted(fit, runs)[1]])
    return fit


def _predicted(fit: FitOutcome, runs: Sequence[Run]) -> tuple[StageModel, list[Prediction]]:
    judged, memories = fit.judged or (fit.model, fit.memories)
    return judged, predictions_of(judged, runs, memories, fit.offsets)


def first_steps(
    records: Sequence[Record],
    settings: Settings,
    *,
    which: str,
    steps: Steps | None,
    progress: Progress,
) -> Steps:
    """
    Take the step `which`, 'delay' or 'dynamics'; the dynamics take a missing delay first.

    The delay needs segments ``step`` or ``noise``.  The dynamics need ``noise`` and ``triangle``,
    because the hysteresis has to be undone.  Raises IdentificationError without these segments.
    """
    data, steps = prepare(records), (steps or Steps()).beside(settings.delay)
    with singular_is_ours():
        if which == 'delay':
            if not data.kinds & {'step', 'noise'}:
                raise IdentificationError(_UNLABELLED.format('delay', 'step or noise'))
            return Steps(delay=first_step(data.runs, settings, progress))
        if not data.labelled:
            raise IdentificationError(_UNLABELLED.format('dynamics', 'noise and triangle'))
        delay = steps.delay or first_step(data.runs, settings, progress)
        dynamics = second_step(with_starts(data.runs), Delay(delay.samples), settings, progress)
    return replace(steps, delay=delay, dynamics=dynamics)


def _provenance(
    result: Identification, records: Sequence[Record], fast: Sequence[float]
) -> dict[str, Any]:
    """Collect the entry of the model file about its origin."""
    fit, dynamics = result.hysteresis, result.dynamics
    m, na = fit.hysteresis.thresholds.size, dynamics.order[0]
    sigma = np.sqrt(np.maximum(np.diag(dynamics.covariance), 0.0))
    return {
        'method': 'three steps' if dynamics.table is not None else 'joint free-run fit',
        'reference': 'doi:10.1109/TMECH.2015.2465868',
        'solver': fit.solver,
        'polished': fit.polished,
        'law': fit.law,
        'delay_source': result.delay.source,
        'errors_of_laws': dict(fit.errors_of_laws),
        'losses': {'model': fit.loss, 'swarm': fit.swarm_loss, 'optimum': fit.optimum_loss},
        'seed': result.settings.seed,
        'records': [record.name for record in records],
        'versions': {'python': python_version(), 'numpy': np.__version__, 'scipy': scipy_version},
        'errors': {
            'unit': '% of stroke',
            'formula': FORMULA,
            **{
                data.replace(' ', '_'): result.error(data)
                for data in ('fitted', 'selection', 'held out', 'validation')
                if np.isfinite(result.error(data))
            },
            'fast_motion': fast[0],
            'worst': max((row.percent for row in result.errors if row.driven), default=np.nan),
        },
        'uncertainties': {
            'delay': result.delay.std if np.isfinite(result.delay.std) else None,
            'weights': fit.std[:m].tolist(),
            'p1': float(fit.std[m]),
            'p2': float(fit.std[m + 1]),
            'a': sigma[:na].tolist(),
            'b': sigma[na : na + dynamics.order[1]].tolist(),
        },
        'fast_displacement': {'percent_of_stroke': fast[1]},
        'noise_floor': {'percent_of_stroke': result.noise_floor, 'source': result.noise_source},
        'warnings': list(result.warnings),
        'not_identified': [f'{what}: {why}' for what, why in result.not_identified],
    }

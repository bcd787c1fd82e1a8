# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
From records to a model: the three steps in order, or all at once where nothing is labelled.

Gu, Li, Zhu and Su, "Modeling and Identification of Piezoelectric-Actuated Stages Cascading
Hysteresis Nonlinearity With Linear Dynamics", IEEE/ASME Trans. Mechatronics 21(3), 2016,
doi:10.1109/TMECH.2015.2465868.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
import platform
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import Cancelled, IdentificationError
from piezo_ident.identification.prepare import noise_floor, prepare, Run
from piezo_ident.identification.results import (
    DelayResult,
    DynamicsResult,
    ErrorRow,
    Identification,
    Progress,
    rms_percent,
    Settings,
    silent,
    Steps,
)
from piezo_ident.identification.segment_errors import (
    errors_of,
    key_of,
    Memories,
    validation_errors,
)
from piezo_ident.identification.solvers.least_squares import singular_is_ours
from piezo_ident.identification.step3_hysteresis import (
    even_thresholds,
    Excerpt,
    factorise,
    fit_hysteresis,
    HysteresisFit,
)
from piezo_ident.identification.three_steps import first_step, second_step, triangle_excerpts
from piezo_ident.identification.threshold_choice import choose_thresholds
from piezo_ident.identification.unlabelled import joint_fit
from piezo_ident.identification.warnings import remark_on_range, remarks_on_errors, remarks_on_fit
from piezo_ident.model.initial_memory import fit_memory
from piezo_ident.model.metrics import FORMULA
from piezo_ident.model.stage_model import Scaling, StageModel
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.record.faults import misspelt
from piezo_ident.record.record import Record
import scipy
from scipy.optimize import OptimizeResult

__all__ = ['identify']

#: plays of the paper, where the data cannot choose their number
PAPER_COUNT = 10
#: samples at the end of an unlabelled record that an error needs at least
MIN_HELD = 10


def identify(
    records: Sequence[Record] | Record,
    settings: Settings | None = None,
    *,
    validation: Sequence[Record] | Record = (),
    progress: Progress = silent,
    steps: Steps | None = None,
) -> Identification:
    """
    Learn a stage from its records.

    Parameters
    ----------
    records : sequence of Record, or Record
        With segments ``noise`` and ``triangle`` (and ``step``) the three steps are taken; segments
        of other kinds are then left for validation.  Without them the longest run is fitted as a
        whole, but for its end.
    settings : Settings, optional
    validation : sequence of Record, or Record, optional
        Records that are neither fitted nor looked at; the headline is about them.
    progress : callable, optional
        Called with the name of the step and its share done; may raise `Cancelled`.
    steps : Steps, optional
        Steps of the three that were taken already; see `piezo_ident.identification.single_steps`.

    Returns
    -------
    Identification

    Raises
    ------
    IdentificationError
        When the data do not carry a model; the message says what they lack.
    """
    with singular_is_ours():
        return _identify(records, settings or Settings(), validation, progress, steps)


def _identify(
    records: Sequence[Record] | Record,
    settings: Settings,
    validation: Sequence[Record] | Record,
    progress: Progress,
    steps: Steps | None,
) -> Identification:
    records = [records] if isinstance(records, Record) else list(records)
    further = [validation] if isinstance(validation, Record) else list(validation)
    data = prepare(records)
    runs, rate, scaling = data.runs, data.rate, data.scaling
    floor, source = noise_floor(data.pieces)
    warnings = list(data.warnings)
    if data.labelled:
        found = _labelled(runs, rate, scaling, settings, progress, steps or Steps())
    else:
        found = _unlabelled(runs, rate, scaling, settings, progress)
    model, delay, dynamics, fit, rows, said, missing, memories = found
    warnings += [*said, *remarks_on_fit(model, delay, dynamics, fit, floor)]
    wrong = misspelt([label for record in records for label in record.labels])
    if wrong:
        warnings.append(f'segment labels that mean nothing here: {", ".join(wrong)}')
    stroke = abs(scaling.Y)
    result = Identification(
        model=model,
        delay=delay,
        dynamics=dynamics,
        hysteresis=fit,
        errors=(*rows, *validation_errors(model, further)),
        noise_floor=None if floor is None else 100.0 * floor / stroke,
        noise_source=source,
        stroke=stroke,
        warnings=tuple(warnings),
        not_identified=tuple(missing),
        settings=settings,
        records=(*records, *further),
        memories=memories,
    )
    result = replace(result, warnings=(*result.warnings, *remarks_on_errors(result, data.pieces)))
    story = _story(result, [record.name for record in records])
    return replace(result, model=replace(model, identification=story))


Found = tuple[
    StageModel,
    DelayResult,
    DynamicsResult,
    HysteresisFit,
    list[ErrorRow],
    list[str],
    list[tuple[str, str]],
    Memories,
]


def _stop_on_request(
    progress: Progress, total: int
) -> tuple[Callable[[OptimizeResult], bool], list[Cancelled]]:
    """Return a swarm callback that reports progress, and where it leaves a request to stop."""
    request: list[Cancelled] = []

    def callback(intermediate_result: OptimizeResult) -> bool:
        try:
            progress('hysteresis', 0.3 + 0.6 * intermediate_result.nit / total)
        except Cancelled as stop:
            request.append(stop)
            return True
        return False

    return callback, request


def _third_step(
    fit: list[Excerpt],
    held: list[Excerpt],
    G: Dynamics,
    delay: Delay,
    settings: Settings,
    progress: Progress,
    whole: list[Excerpt] | None = None,
) -> HysteresisFit:
    progress('hysteresis', 0.0)
    fitted = whole or fit
    swing = max(float(np.ptp(e.u[e.use])) for e in fitted)
    n, rows = int(sum(e.use.sum() for e in fitted)), sum(e.rows for e in fitted)
    if settings.thresholds is not None:
        r = even_thresholds(swing, settings.thresholds)
    elif any(e.use.any() for e in held):
        r = choose_thresholds(
            fit, held, swing, G, delay, lambda share: progress('hysteresis', 0.3 * share)
        )
    else:
        r = even_thresholds(swing, PAPER_COUNT)
    R = factorise(fitted, r, G, delay)
    progress('hysteresis', 0.3)
    callback, request = _stop_on_request(progress, settings.swarm_iterations)
    result = fit_hysteresis(
        R,
        r,
        n,
        rows=rows,
        solver=settings.solver,
        polish=settings.polish,
        rng=np.random.default_rng(settings.seed),
        swarm_size=settings.swarm_size,
        maxiter=settings.swarm_iterations,
        callback=callback,
    )
    if request:
        raise request[0]
    progress('hysteresis', 1.0)
    return result


def _labelled(
    runs: list[Run],
    rate: float,
    scaling: Scaling,
    settings: Settings,
    progress: Progress,
    steps: Steps,
) -> Found:
    fit = triangle_excerpts(runs)
    if not fit:
        raise IdentificationError(
            'no triangle starts from a known memory or sweeps its range twice; start it from the '
            'lowest voltage'
        )
    delay_result = steps.delay or first_step(runs, settings, progress)
    delay = Delay(delay_result.samples)
    dynamics, G = steps.dynamics or second_step(runs, delay, settings, progress)
    if delay_result.agree is False and steps.delay is None and steps.dynamics is None:
        delay_result, dynamics, G = _either(runs, delay_result, dynamics, G, settings, progress)
        delay = Delay(delay_result.samples)
    held = triangle_excerpts(runs, held=True)
    result = _third_step(fit, held, G, delay, settings, progress)
    model = _model(rate, scaling, result, G, delay)
    said = []
    if settings.thresholds is None and not any(e.use.any() for e in held):
        said.append(
            'the triangle turns too often to hold a part of it out: the number of thresholds '
            f'could not be chosen and is {PAPER_COUNT}; use a slower triangle'
        )
    if delay_result.source == 'scan' and delay_result.agree is None:
        said.append('no step rises above the noise; the delay was read from the ARX loss alone')
    lowest = min(float(e.u[e.use].min()) for e in fit)
    highest = max(float(e.u[e.use].max()) for e in fit)
    if lowest > 0.01 or highest < 0.99:
        said.append(
            'the triangle does not cover the voltages of the record: it reaches '
            f'{scaling.v0 + scaling.V * lowest:.3g} .. {scaling.v0 + scaling.V * highest:.3g} V'
        )
        span = (scaling.v0 + scaling.V * lowest, scaling.v0 + scaling.V * highest)
        model = replace(model, scaling=replace(model.scaling, range=span))
    masks = []
    for run in runs:
        kept = run.held_out()
        masks.append((run.mask('triangle', 'noise', 'settle', 'step') & ~kept, kept))
    rows = errors_of(model, runs, masks)
    return model, delay_result, dynamics, result, rows, said, [], {}


def _either(
    runs: list[Run],
    delay: DelayResult,
    dynamics: DynamicsResult,
    G: Dynamics,
    settings: Settings,
    progress: Progress,
) -> tuple[DelayResult, DynamicsResult, Dynamics]:
    """Return delay and G with the delay of the steps or of the scan, whichever errs less."""
    # the loss was scanned in whole samples
    other = replace(delay, samples=delay.scan or 0, std=0.5, source='scan')
    result, other_G = second_step(runs, Delay(other.samples), settings, progress)
    # slow noise is averaged out of few steps badly; a free run does not care who was right
    if min(result.methods.values()) < min(dynamics.methods.values()):
        return other, result, other_G
    return delay, dynamics, G


def _unlabelled(
    runs: list[Run], rate: float, scaling: Scaling, settings: Settings, progress: Progress
) -> Found:
    run = max(runs, key=lambda r: (round(float(np.ptp(r.u)), 2), r.piece.n))
    piece = run.piece
    share = max(1.5, 0.2 * piece.duration)
    held_time = settings.hold_out or min(share, 0.25 * piece.duration)
    n_held = round(held_time * rate)
    if n_held < MIN_HELD:
        raise IdentificationError(
            f'{run.record}: holding out {held_time:.3g} s leaves {n_held} samples to judge by; '
            f'hold out at least {MIN_HELD / rate:.3g} s (--hold-out)'
        )
    n_fit = piece.n - n_held
    if n_fit < 100:
        raise IdentificationError(
            f'{run.record}: {piece.n} samples, of which {max(n_fit, 0)} are left to fit after '
            f'holding out {held_time:.3g} s; record longer or hold out less (--hold-out)'
        )
    joint = joint_fit(run, n_fit, scaling, settings, progress)
    delay = Delay(joint.delay.samples)
    u, x = run.u[:n_fit], run.x[:n_fit]
    use = run.known[:n_fit].copy()
    if use.sum() < n_fit // 5:
        use[:] = True
    # what chooses the thresholds is a part of what is fitted in the end, never the held-out end
    late = np.zeros(n_fit, dtype=bool)
    late[n_fit - int(0.25 * use.sum()) :] = True
    fit_part = [Excerpt(u, x, use & ~late, joint.memory)]
    late_part = [Excerpt(u, x, use & late, joint.memory)]
    whole = [Excerpt(u, x, use, joint.memory)]
    result = _third_step(fit_part, late_part, joint.G, delay, settings, progress, whole)
    model = _model(rate, scaling, result, joint.G, delay)
    low, high = float(u.min()), float(u.max())
    span = (scaling.v0 + scaling.V * low, scaling.v0 + scaling.V * high)
    model = replace(model, scaling=replace(model.scaling, range=span))
    # the start of these very thresholds; the rule carried over from other ones is an approximation
    memories = {key_of(run): fit_memory(model, piece.cut(0, n_fit))}
    if sum(key_of(other) == key_of(run) for other in runs) > 1:
        # nobody could tell whose start it is
        memories = {}
    masks: list[tuple[NDArray[np.bool_], NDArray[np.bool_]]] = []
    for other in runs:
        fitted = np.zeros(other.piece.n, dtype=bool)
        if other is run:
            fitted[:n_fit] = True
        masks.append((fitted, np.zeros(other.piece.n, dtype=bool)))
    rows = errors_of(model, runs, masks, memories)
    reach = remark_on_range(run, n_fit, scaling)
    said = [
        'no segments labelled noise and triangle: delay, dynamics and hysteresis were fitted '
        f'together on the first {n_fit / rate:.4g} s of {run.record}'
    ]
    if reach:
        said.append(reach)
    fitted_error = [row for row in rows if row.data == 'fitted' and row.record == run.record]
    held_error = [row for row in rows if row.data == 'held out' and row.record == run.record]
    # a record without noise may be fitted exactly
    ratio = (
        rms_percent(held_error) / max(rms_percent(fitted_error), 1e-9)
        if fitted_error and held_error
        else 0
    )
    if ratio > 3.0:
        said.append(
            f'the held-out error is {ratio:.1f} times the fitted one: '
            'this record does not pin the model down; drive the range more than once'
        )
    progress('hysteresis', 1.0)
    missing = list(joint.not_identified)
    return model, joint.delay, joint.dynamics, result, rows, said, missing, memories


def _model(
    rate: float, scaling: Scaling, fit: HysteresisFit, G: Dynamics, delay: Delay
) -> StageModel:
    moved = replace(scaling, y0=scaling.y0 + float(fit.offsets[0]) * scaling.Y)
    return StageModel(rate, moved, fit.hysteresis, G, delay)


def _story(result: Identification, names: list[str]) -> dict[str, Any]:
    """Return what the model file tells about its own origin."""
    fit, dynamics = result.hysteresis, result.dynamics
    m = fit.hysteresis.thresholds.size
    na = dynamics.order[0]
    sigma = np.sqrt(np.maximum(np.diag(dynamics.covariance), 0.0))
    return {
        'method': 'three steps' if dynamics.table is not None else 'joint free-run fit',
        'reference': 'doi:10.1109/TMECH.2015.2465868',
        'solver': fit.solver,
        'polished': fit.polished,
        'losses': {'model': fit.loss, 'swarm': fit.swarm_loss, 'optimum': fit.optimum_loss},
        'seed': result.settings.seed,
        'records': names,
        'versions': {
            'python': platform.python_version(),
            'numpy': np.__version__,
            'scipy': scipy.__version__,
        },
        'errors': {
            'unit': '% of stroke',
            'formula': FORMULA,
            **{
                data.replace(' ', '_'): result.error(data)
                for data in ('fitted', 'selection', 'held out', 'validation')
                if np.isfinite(result.error(data))
            },
        },
        'uncertainties': {
            'delay': result.delay.std if np.isfinite(result.delay.std) else None,
            'weights': fit.std[:m].tolist(),
            'p1': float(fit.std[m]),
            'p2': float(fit.std[m + 1]),
            'a': sigma[:na].tolist(),
            'b': sigma[na : na + dynamics.order[1]].tolist(),
        },
        'noise_floor': {'percent_of_stroke': result.noise_floor, 'source': result.noise_source},
        'warnings': list(result.warnings),
        'not_identified': [f'{what}: {why}' for what, why in result.not_identified],
    }

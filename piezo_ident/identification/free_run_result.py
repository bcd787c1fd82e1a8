# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Turn the free-run fits of unlabelled records into a model, starts, results and warnings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.common.arrays import Array, Mask, true_runs
from piezo_ident.fitting.free_run import Fit
from piezo_ident.fitting.stage import memory_of, Stage
from piezo_ident.identification.errors import key_of
from piezo_ident.identification.prepare import Run
from piezo_ident.identification.results import FitOutcome
from piezo_ident.identification.settings import Settings
from piezo_ident.identification.spectra import broadband_response, excited_band, highest_frequency
from piezo_ident.identification.step1_delay import DelayResult
from piezo_ident.identification.step2_dynamics import DynamicsResult
from piezo_ident.identification.step3_hysteresis import HysteresisFit
from piezo_ident.identification.three_steps import within
from piezo_ident.identification.warnings import only_jumps, warn_of_range, warn_of_zeros
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.model.stream import Start
from piezo_ident.operators.dynamics import Delay
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.selection.comparison import RatedFit, shown_effect


@dataclass(frozen=True, eq=False)
class FreeRunFits:
    """
    Fits of unlabelled records: `judged` without the held-out samples, `last` to all samples.

    `chosen` holds the fitted runs, and `parts` the samples of each run that were not held out.
    `best` is the chosen candidate of the compared `candidates`.
    """

    chosen: Sequence[Run]
    parts: Sequence[Mask]
    judged: Fit
    last: Fit
    candidates: Sequence[RatedFit]
    best: RatedFit


def outcome_of(
    fits: FreeRunFits, runs: Sequence[Run], rate: float, scaling: Scaling, settings: Settings
) -> FitOutcome:
    """Collect model, results of the steps, starts and warnings."""
    chosen, parts = fits.chosen, fits.parts
    stage, judged = fits.last.stage, fits.judged.stage
    model, tested = (_model(each, rate, scaling) for each in (stage, judged))
    low, high = (float(f([f(run.u) for run in chosen])) for f in (np.min, np.max))
    keys = [key_of(run) for run in runs]
    # a start is found again by its key, so runs that share a key keep no start
    own = {key_of(run): i for i, run in enumerate(chosen) if keys.count(key_of(run)) == 1}
    memories = {key: _start(stage, i, chosen[i], model) for key, i in own.items()}
    at_test = {key: _start(judged, i, chosen[i], tested) for key, i in own.items()}
    offsets = {
        key: scaling.Y * float(judged.offsets[i] - judged.offsets[-1]) for key, i in own.items()
    }
    nothing = [np.zeros(run.piece.n, dtype=bool) for run in runs]
    fitted = dict(zip(map(id, chosen), parts, strict=True))
    masks = [(fitted.get(id(run), none), none) for run, none in zip(runs, nothing, strict=True)]
    band = max(
        excited_band(run.u[run.use] - run.u[run.use].mean(), rate, depth=1e-4) for run in chosen
    )
    delay = _delay_result(fits, settings, rate, band)
    missing = _missing(fits, delay, rate, band)
    names = ', '.join(_named(run, mask) for run, mask in zip(chosen, parts, strict=True))
    reason = 'no segments labelled noise and triangle'
    warnings = [
        f'{"solver joint" if settings.solver == "joint" else reason}: delay, dynamics and '
        f'hysteresis were fitted together to {names}, as the errors say; the model was then '
        'fitted to all of it',
        *warn_of_range(chosen, parts, scaling),
        *warn_of_zeros(offsets, scaling),
        *_warn_of_creep(fits),
    ]
    return FitOutcome(
        model=within(model, low, high),
        delay=delay,
        dynamics=_dynamics_result(fits, rate, band),
        hysteresis=_hysteresis_result(fits),
        masks=masks,
        warnings=warnings,
        not_identified=tuple(missing.items()),
        memories=memories,
        offsets=offsets,
        judged=(tested, at_test),
        fit=fits.last,
    )


def _model(stage: Stage, rate: float, scaling: Scaling) -> StageModel:
    # the zero of the sensor may have moved between records; the last zero holds for new records
    seen = stage.creep > 0.0
    values = {'gain': stage.creep[seen].tolist(), 'time_constant': stage.taus[seen].tolist()}
    effects = (EffectSetting('creep', values),) if seen.any() else ()
    moved = replace(scaling, y0=scaling.y0 + float(stage.offsets[-1]) * scaling.Y)
    H = _compact(stage.hysteresis)
    return StageModel(rate, moved, H, stage.dynamics, Delay(stage.delay), effects)


def _compact(H: Hysteresis) -> Hysteresis:
    """Drop the plays of weight zero from H, and the span, which a file of plays lacks."""
    if H.curves is not None or H.bias is not None:
        return H
    used = H.weights > 0.0
    return replace(H, thresholds=H.thresholds[used], weights=H.weights[used], span=(0.0, 1.0))


def _start(stage: Stage, i: int, run: Run, model: StageModel) -> Start | Array:
    """Convert the start of a run to the elements of the model."""
    memory, seen = _memory(stage, i, run, model.hysteresis.thresholds), stage.creep > 0.0
    return Start(memory, stage.lags[i][seen]) if seen.any() else memory


def _memory(stage: Stage, i: int, run: Run, thresholds: Array) -> Array:
    """Compute the play outputs at the start of a run."""
    return memory_of(run.u[0], stage.law.thresholds[-1], stage.starts[i], thresholds)


def _hysteresis_result(fits: FreeRunFits) -> HysteresisFit:
    last, stage, law = fits.last, fits.last.stage, fits.last.stage.law
    errors: dict[str, float] = {}
    # creep is no merit of a law
    for c in (c for c in fits.candidates if c.effects <= fits.best.effects):
        name = c.fit.stage.law.name
        errors[name] = min(float(np.sqrt(c.error)), errors.get(name, np.inf))
    H = _compact(stage.hysteresis)
    # the fit varies slopes in place of the powers of v
    T = stage.unsloped(np.eye(law.size))
    std = law.deviations(T @ last.covariance()[: law.size, : law.size] @ T.T)
    used = np.isin(law.thresholds, H.thresholds)
    return HysteresisFit(
        hysteresis=H,
        offsets=stage.offsets,
        solver='least_squares',
        polished=False,
        loss=last.loss,
        swarm_loss=None,
        optimum_loss=last.loss,
        n=last.n,
        std=np.concatenate([std[:-2][used], std[-2:]]),
        swarm=None,
        coefficients=stage.coefficients,
        law=law.name,
        errors_of_laws=errors,
    )


def _delay_result(fits: FreeRunFits, settings: Settings, rate: float, band: float) -> DelayResult:
    d = fits.last.stage.delay
    if settings.delay is not None:
        return DelayResult(settings.delay, float('inf'), 'given')
    if d == 0 and fits.last.stage.dynamics.is_static:
        return DelayResult(0, float('inf'), 'none')
    # a drive that ends at f leaves an uncertainty of a twentieth of the period of f
    return DelayResult(d, max(1.0 / np.sqrt(12.0), 0.05 * rate / band), 'free run')


def _dynamics_result(fits: FreeRunFits, rate: float, band: float) -> DynamicsResult:
    stage, G = fits.last.stage, fits.last.stage.dynamics
    moved: list[tuple[Array, Array, Array]] = []
    for i, (run, mask) in enumerate(zip(fits.chosen, fits.parts, strict=True)):
        w = stage.hysteresis(run.u, _memory(stage, i, run, stage.law.thresholds))
        moved += [(run.u[a:b], w[a:b], run.x[a:b]) for a, b in true_runs(run.use & mask)]
    order, covariance = (0, 1), np.zeros((1, 1))
    if not G.is_static:
        order = G.a.size, G.b.size
        own = stage.law.size + stage.creep.size + np.arange(sum(order))
        covariance = fits.last.covariance()[np.ix_(own, own)]
    whole = float(np.std(np.concatenate([run.x[run.use] for run in fits.chosen])))
    methods = {c.name: 100.0 * float(np.sqrt(c.error)) / whole for c in fits.candidates}
    response = broadband_response(moved, rate)
    return DynamicsResult(order, None, methods, covariance, response, band=band)


def _missing(fits: FreeRunFits, delay: DelayResult, rate: float, band: float) -> dict[str, str]:
    """Collect the quantities that the data do not tell, with reasons."""
    missing = {}
    if delay.source == 'none':
        missing['delay'] = 'no delay lowers the error on held-out motion; add steps or noise'
    if fits.last.stage.dynamics.is_static:
        missing['dynamics'] = (
            'no order of G errs clearly less on held-out motion than the hysteresis and a pure '
            f'delay (the voltage moves up to {band:.3g} Hz); add steps or noise'
        )
    elif modes := fits.last.stage.dynamics.modes(rate):
        lowest = min(mode.frequency for mode in modes)
        reach = max(highest_frequency(run.u, rate) for run in fits.chosen)
        if reach < lowest:
            missing['dynamics'] = (
                f'the voltage moves up to {reach:.3g} Hz, below the lowest mode of G at '
                f'{lowest:.3g} Hz, which the data therefore do not show; add steps or noise'
            )
    if reason := only_jumps(fits.chosen):
        missing['hysteresis'] = reason
    return missing


def _warn_of_creep(fits: FreeRunFits) -> list[str]:
    """Warn if creep lowers the error clearly, but not to `selection.comparison.EFFECT`."""
    more = shown_effect(fits.candidates, fits.best)
    if more is None:
        return []
    ours, theirs = (100.0 * float(np.sqrt(c.error)) for c in (fits.best, more))
    return [
        f'the stage may creep: with creep the model predicts parts of the data from the others to '
        f'{theirs:.2g} % of stroke instead of {ours:.2g} %. Errors of H could make this small '
        'difference, too; hold a voltage for some seconds behind a step'
    ]


def _named(run: Run, fitted: Mask) -> str:
    """Describe the fitted samples of a run."""
    held = true_runs(~fitted)
    if len(held) == 1 and held[0][1] == fitted.size:
        return f'the first {held[0][0] / run.piece.sample_rate:.4g} s of {run.record}'
    share = 100.0 * float(np.mean(~fitted))
    return f'{run.record} without {len(held)} stretches, {share:.0f} % of it, that are held out'

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Records without labelled segments: a list of starts, one free-run fit, one comparison.

The search works on `MOST` samples.  What it finds is fitted to all that is not held out, and
judged by what is; in the end it is fitted to everything.  `make any-record` sets it beside
`piezo_ident.identification.unlabelled`, which it is to replace.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from piezo_ident.common.arrays import Array, Mask, true_runs
from piezo_ident.common.errors import IdentificationError
from piezo_ident.fitting.free_run import Fit, fit
from piezo_ident.fitting.stage import memory_of, PARTS, Stage
from piezo_ident.fitting.stretch import remembered, Stretch
from piezo_ident.identification.errors import key_of
from piezo_ident.identification.free_run_starts import Allowed, Search
from piezo_ident.identification.hold_out import fitted_parts, MOVES
from piezo_ident.identification.prepare import REST, Run
from piezo_ident.identification.results import (
    DelayResult,
    DynamicsResult,
    FitOutcome,
    Progress,
    Settings,
)
from piezo_ident.identification.spectra import broadband_response, excited_band, highest_frequency
from piezo_ident.identification.step3_hysteresis import (
    even_thresholds,
    factorise,
    fit_hysteresis,
    HysteresisFit,
)
from piezo_ident.identification.three_steps import within
from piezo_ident.identification.warnings import only_jumps, warn_of_range, warn_of_zeros
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.model.stream import Start
from piezo_ident.operators.dynamics import Delay
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.record.suspicions import rises_first
from piezo_ident.selection.comparison import best_of, Candidate
from piezo_ident.selection.motion_kinds import interleaved, motion_kinds

#: samples that the search simulates, and rows that the last fits count, at most
MOST, MOST_ROWS = 100_000, 400_000
#: blocks of all stretches together (taste: a fifth of them is held out in turn)
BLOCKS = 50
#: plays of H, that at r = 0 included, where the user asks for no number
PLAYS = 40
#: voltages for which H has to hold, normalised: a motion that is alike leaves the range by a
#: little (taste: a seventh), and densities end with the span
SPAN = (-0.15, 1.15)
#: part of a window, one in so many, in which what began before it may ring (taste)
RINGING = 20
#: elements of creep that are tried, over all times that a record holds (one a decade)
ELEMENTS = 5
#: shortest time constant of creep [s]: what is faster is dynamics
FASTEST = 0.05
#: steps of the fit to everything, from the fit to all that was not held out
LAST = 5


def fit_free_run(
    runs: Sequence[Run], rate: float, scaling: Scaling, settings: Settings, progress: Progress
) -> FitOutcome:
    """
    Fit delay, dynamics and hysteresis together.

    Raises
    ------
    IdentificationError
        When what is left to fit or to judge by is too short, or does not move.
    """
    chosen, parts = fitted_parts(runs, settings)
    _refuse_rest(chosen, parts)
    stretches, guesses = _stretches(chosen, parts)
    search = _search(stretches, guesses, settings, progress)
    progress('delay', 1.0)
    best, found = search.best()
    progress('dynamics', 0.7)
    found += tuple(search.wider(best, _taus(stretches)))
    best = best_of(found)
    progress('dynamics', 1.0)
    kept = _thinned(stretches)
    start = best.fit.stage
    if search.stretches is not stretches:
        start = start.on_other(stretches)
    judged = fit(start, kept)
    progress('hysteresis', 0.6)
    everything = _thinned([s.with_use(run.use) for s, run in zip(stretches, chosen, strict=True)])
    last = fit(judged.stage, everything, iterations=LAST)
    progress('hysteresis', 1.0)
    return _outcome(_Fits(chosen, parts, judged, last, found), runs, rate, scaling, settings)


@dataclass(frozen=True, eq=False)
class _Fits:
    """What was fitted: to all but what is held out, then to everything."""

    chosen: Sequence[Run]
    parts: Sequence[Mask]
    judged: Fit
    last: Fit
    found: Sequence[Candidate]


def _refuse_rest(runs: Sequence[Run], parts: Sequence[Mask]) -> None:
    used = [run.u[run.use & mask] for run, mask in zip(runs, parts, strict=True)]
    swing = max((float(np.ptp(u)) for u in used if u.size), default=0.0)
    if swing < MOVES:
        raise IdentificationError(
            f'{runs[0].record}: the voltage moves by {swing:.1%} of its range in the fitted part; '
            'let it move there, or hold out less (--hold-out)'
        )


def _stretches(runs: Sequence[Run], parts: Sequence[Mask]) -> tuple[list[Stretch], Array]:
    """Return runs as stretches, with blocks of one length, and the guess of each memory."""
    size = max(1, sum(run.u.size for run in runs) // BLOCKS)
    stretches, guesses, count = [], np.full((len(runs), PARTS), 0.5), 0
    for i, (run, mask) in enumerate(zip(runs, parts, strict=True)):
        n = max(1, round(run.u.size / size))
        block = count + np.minimum(np.arange(run.u.size) * n // run.u.size, n - 1)
        count += n
        rate = run.piece.sample_rate
        stretches.append(Stretch(run.u, run.x, run.use & mask, block, rate, i, i))
        if abs(float(run.u[0])) < REST and not rises_first(run.piece):
            guesses[i] = 0.0
    return stretches, guesses


def _search(
    stretches: Sequence[Stretch], guesses: Array, settings: Settings, progress: Progress
) -> Search:
    if sum(s.u.size for s in stretches) > MOST:
        stretches = _windows(stretches)
    swing = max(float(np.ptp(s.u[s.use])) for s in stretches if s.use.any())
    law = HysteresisLaw('plays', even_thresholds(swing, settings.thresholds or PLAYS), SPAN)
    count = 1 + max(int(s.block[-1]) for s in stretches)
    steps = 0

    def tick() -> None:
        nonlocal steps
        steps += 1
        # about a hundred steps
        progress('dynamics', 0.7 * steps / (100.0 + steps))

    allowed = Allowed(settings.delay, settings.order, settings.max_order)
    kinds = motion_kinds(stretches, count)
    return Search(stretches, interleaved(count), kinds, law, guesses, allowed, tick)


def _windows(stretches: Sequence[Stretch]) -> list[Stretch]:
    """Return a few windows: of the widest motion, the fastest, and those in between."""
    size = MOST // 3
    windows = []
    for s in stretches:
        for start in range(0, max(1, s.u.size - size // 2), size):
            part = slice(start, min(start + size, s.u.size))
            if s.use[part].sum() > size // 4:
                windows.append((s, part))
    spans = [float(np.ptp(s.u[part])) for s, part in windows]
    speeds = [float(np.mean(np.diff(s.u[part]) ** 2)) for s, part in windows]
    order = [int(np.argmax(spans)), int(np.argmax(speeds))]
    order += sorted(range(len(windows)), key=lambda i: -spans[i] * speeds[i])
    chosen = sorted(dict.fromkeys(order), key=order.index)[:3]
    found, count = [], 0
    for number, i in enumerate(sorted(chosen)):
        s, part = windows[i]
        # windows are short: of finer blocks more can be held out
        length = s.u[part].size
        block = np.arange(length) * (BLOCKS // 3) // length + count
        count += BLOCKS // 3
        use, before = s.use[part].copy(), np.empty(0)
        if part.start:
            before = remembered(s.u[: part.start + 1])
            # what rings from before is not known
            use[: length // RINGING] = False
        found.append(Stretch(s.u[part], s.x[part], use, block, s.rate, number, s.record, before))
    return found


def _thinned(stretches: Sequence[Stretch]) -> list[Stretch]:
    """Return stretches of which at most `MOST_ROWS` samples count, whole pieces of each block."""
    n = sum(int(s.use.sum()) for s in stretches)
    if n <= MOST_ROWS:
        return list(stretches)
    piece = 200
    every = -(-n // MOST_ROWS)
    return [s.with_use(s.use & (np.arange(s.u.size) // piece % every == 0)) for s in stretches]


def _taus(stretches: Sequence[Stretch]) -> Array:
    longest = max(s.u.size / s.rate for s in stretches)
    shortest = max(FASTEST, 10.0 / stretches[0].rate)
    return np.geomspace(shortest, max(longest, 10.0 * shortest), ELEMENTS)


def _outcome(
    fits: _Fits, runs: Sequence[Run], rate: float, scaling: Scaling, settings: Settings
) -> FitOutcome:
    chosen, parts, last = fits.chosen, fits.parts, fits.last
    hysteresis = _hysteresis_result(fits, settings)
    model = _model(last.stage, hysteresis.hysteresis, rate, scaling, float(hysteresis.offsets[0]))
    tested = _model(fits.judged.stage, None, rate, scaling, float(fits.judged.stage.offsets[0]))
    low, high = (float(f([f(run.u) for run in chosen])) for f in (np.min, np.max))
    keys = [key_of(run) for run in runs]
    # where two have one name nobody could tell whose start it is
    own = {key_of(run): i for i, run in enumerate(chosen) if keys.count(key_of(run)) == 1}
    stage, judged = last.stage, fits.judged.stage
    memories = {key: _start(stage, i, chosen[i], model) for key, i in own.items()}
    at_test = {key: _start(judged, i, chosen[i], tested) for key, i in own.items()}
    offsets = {
        key: scaling.Y * float(judged.offsets[i] - judged.offsets[0]) for key, i in own.items()
    }
    fitted = {id(run): mask for run, mask in zip(chosen, parts, strict=True)}
    nothing = [np.zeros(run.piece.n, dtype=bool) for run in runs]
    masks = [(fitted.get(id(run), none), none) for run, none in zip(runs, nothing, strict=True)]
    band = max(
        excited_band(run.u[run.use] - run.u[run.use].mean(), rate, depth=1e-4) for run in chosen
    )
    delay = _delay_result(fits, settings, rate, band)
    missing = _missing(fits, delay, rate, band)
    names = ', '.join(_named(run, mask) for run, mask in zip(chosen, parts, strict=True))
    warnings = [
        'no segments labelled noise and triangle: delay, dynamics and hysteresis were fitted '
        f'together to {names}, as the errors say; the model was then fitted to all of it',
        *warn_of_range(chosen, parts, scaling),
        *warn_of_zeros(offsets, scaling),
    ]
    return FitOutcome(
        model=within(model, low, high),
        delay=delay,
        dynamics=_dynamics_result(fits, rate, band),
        hysteresis=hysteresis,
        masks=masks,
        warnings=warnings,
        not_identified=tuple(missing.items()),
        memories=memories,
        offsets=offsets,
        judged=(tested, at_test),
    )


def _model(
    stage: Stage, hysteresis: Hysteresis | None, rate: float, scaling: Scaling, offset: float
) -> StageModel:
    effects: tuple[EffectSetting, ...] = ()
    seen = stage.creep > 0.0
    if seen.any():
        values = {'gain': stage.creep[seen].tolist(), 'time_constant': stage.taus[seen].tolist()}
        effects = (EffectSetting('creep', values),)
    H = _compact(stage.hysteresis) if hysteresis is None else hysteresis
    moved = replace(scaling, y0=scaling.y0 + offset * scaling.Y)
    return StageModel(rate, moved, H, stage.dynamics, Delay(stage.delay), effects)


def _compact(H: Hysteresis) -> Hysteresis:
    """Return H without plays that weigh nothing."""
    if H.curves is not None or H.bias is not None:
        return H
    used = H.weights > 0.0
    return replace(H, thresholds=H.thresholds[used], weights=H.weights[used])


def _start(stage: Stage, i: int, run: Run, model: StageModel) -> Start | Array:
    """Return the start of a run in terms of the model."""
    memory = _start_of(stage, i, run, model.hysteresis.thresholds)
    seen = stage.creep > 0.0
    if not seen.any():
        return memory
    return Start(memory, stage.lags[i][seen])


def _start_of(stage: Stage, i: int, run: Run, thresholds: Array) -> Array:
    """Return the play outputs at the start of a run."""
    widest = float(stage.law.thresholds[-1])
    return memory_of(float(run.u[0]), widest, stage.starts[i], thresholds)


def _hysteresis_result(fits: _Fits, settings: Settings) -> HysteresisFit:
    last = fits.last
    stage, law = last.stage, last.stage.law
    if settings.solver == 'swarm':
        return _swarm(stage, fits.chosen, settings)
    errors: dict[str, float] = {}
    for c in fits.found:
        name = c.fit.stage.law.name
        errors[name] = min(float(np.sqrt(c.error)), errors.get(name, np.inf))
    whole = last.covariance()[: law.size, : law.size]
    H = _compact(stage.hysteresis)
    std = law.deviations(whole)
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


def _swarm(stage: Stage, runs: Sequence[Run], settings: Settings) -> HysteresisFit:
    """Return the weights that the swarm finds with G and the starts of the free-run fit."""
    excerpts = []
    for i, run in enumerate(runs):
        excerpts.append(replace(run.excerpt(run.use), memory=partial(_start_of, stage, i, run)))
    R = factorise(excerpts, stage.law, stage.dynamics, Delay(stage.delay))
    return fit_hysteresis(
        R,
        stage.law,
        sum(int(e.use.sum()) for e in excerpts),
        solver='swarm',
        polish=settings.polish,
        rows=sum(e.rows for e in excerpts),
        rng=np.random.default_rng(settings.seed),
        swarm_size=settings.swarm_size,
        maxiter=settings.swarm_iterations,
    )


def _delay_result(fits: _Fits, settings: Settings, rate: float, band: float) -> DelayResult:
    d = fits.last.stage.delay
    if settings.delay is not None:
        return DelayResult(settings.delay, float('inf'), 'given')
    if d == 0 and fits.last.stage.dynamics.is_static:
        return DelayResult(0, float('inf'), 'none')
    # a drive that ends at f leaves a doubt of half a period of f
    return DelayResult(d, max(1.0 / np.sqrt(12.0), 0.05 * rate / band), 'free run')


def _dynamics_result(fits: _Fits, rate: float, band: float) -> DynamicsResult:
    last = fits.last
    stage, G = last.stage, last.stage.dynamics
    runs, parts = fits.chosen, fits.parts
    undone = [
        stage.hysteresis(run.u, _start_of(stage, i, run, stage.law.thresholds))
        for i, run in enumerate(runs)
    ]
    response = broadband_response(
        [
            (run.u[a:b], w[a:b], run.x[a:b])
            for run, w, mask in zip(runs, undone, parts, strict=True)
            for a, b in true_runs(run.use & mask)
        ],
        rate,
    )
    covariance = np.zeros((1, 1))
    if not G.is_static:
        at = stage.law.size + stage.creep.size
        n = G.a.size + G.b.size
        covariance = last.covariance()[at : at + n, at : at + n]
    whole = float(np.std(np.concatenate([run.x[run.use] for run in runs])))
    methods = {c.name: 100.0 * float(np.sqrt(c.error)) / whole for c in fits.found}
    return DynamicsResult(
        (0, 1) if G.is_static else (G.a.size, G.b.size),
        None,
        methods,
        covariance,
        response,
        band=band,
    )


def _missing(fits: _Fits, delay: DelayResult, rate: float, band: float) -> dict[str, str]:
    """Return what these data do not tell, and why."""
    missing = {}
    if delay.source == 'none':
        missing['delay'] = 'no delay errs less on held-out motion than none; add steps or noise'
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
                f'the voltage moves up to {reach:.3g} Hz, and the lowest mode of G lies at '
                f'{lowest:.3g} Hz, where nothing was seen of it; add steps or noise'
            )
    if reason := only_jumps(fits.chosen):
        missing['hysteresis'] = reason
    return missing


def _named(run: Run, fitted: Mask) -> str:
    """Return what is fitted of a run, in words."""
    held = true_runs(~fitted)
    rate = run.piece.sample_rate
    if len(held) == 1 and held[0][1] == fitted.size:
        return f'the first {held[0][0] / rate:.4g} s of {run.record}'
    share = 100.0 * float(np.mean(~fitted))
    return f'{run.record} without {len(held)} stretches, {share:.0f} % of it, that are held out'

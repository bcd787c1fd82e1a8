# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The three steps on labelled records: delay from steps, G from noise, H from a triangle.

Under small noise H is not a constant slope: the noise drags its plays along, and a linear fit
takes this for slow dynamics.  G is therefore found twice.  After a first G, a temporary H with
fine thresholds is fitted to the triangle.  Its output w = H[v] replaces the voltage of the noise
segment, and G is found again from w to y, free of hysteresis.  The returned H is fitted last, with
the chosen or given thresholds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
import functools

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.prepare import Excerpt, Run
from piezo_ident.identification.results import Progress, Settings
from piezo_ident.identification.solvers.output_error import output_error, simulation_error
from piezo_ident.identification.spectra import (
    band_of,
    frequency_response,
    longest_noise,
    noise_segment,
    NoiseSegment,
)
from piezo_ident.identification.step1_delay import (
    checked_delay,
    delay_from_loss,
    delay_from_steps,
    DelayResult,
    MAX_DELAY,
    no_step,
    SCAN_ORDER,
)
from piezo_ident.identification.step2_dynamics import (
    arx_factor,
    delayed,
    DynamicsResult,
    factor_of,
    fast_part,
    free_run_error,
    instrumental_variables,
    scan_orders,
    stabilised,
)
from piezo_ident.identification.step3_choice import Means
from piezo_ident.identification.step3_hysteresis import (
    factorise,
    fine_thresholds,
    fit_hysteresis,
    HysteresisFit,
)
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.dynamics import Delay, Dynamics, filter_arx
from piezo_ident.operators.hysteresis import Hysteresis
from scipy import signal

#: orders within this share of the best held-out error count as equal; the smallest is tried first
SLACK = 0.05
#: share by which instrumental variables must err less than least squares to choose the orders
BENT = 0.2
#: share by which a larger order must lower the held-out error
GAIN = 0.005
#: samples that are simulated ahead of the first sample that counts
WARM_UP = 2000
#: number of candidate orders that are refined and judged again
CANDIDATES = 5
#: most iterations that refine a candidate: with a coarse converter at a high rate, least squares
#: and instrumental variables start far from modes that ring for long
REFINING = 40
#: motion slower than this is creep, not dynamics; it is filtered out before G is refined [Hz]
SLOWEST = 5.0
#: share by which the error must fall if G is refined with another law of H
WORTH = 0.25


def first_step(runs: Sequence[Run], settings: Settings, progress: Progress) -> DelayResult:
    """
    Find the delay from the steps, or without steps from a scan of the ARX loss over the noise.

    A free run over the noise decides if steps and scan differ, or if the scan fails.  Raises
    IdentificationError if no method tells the delay.
    """
    progress('delay', 0.0)
    if settings.delay is not None:
        return DelayResult(settings.delay, float('inf'), 'given')
    pieces = [run.piece.cut(s.start, s.stop) for run in runs for s in run.piece.find('step')]
    step = delay_from_steps(pieces) if pieces else None
    # steps have power at all frequencies; noise up to f leaves an uncertainty of half a period of
    # f
    loss = _scan(runs, 'step') if pieces else None
    if loss is None:
        loss = _scan(runs, 'noise')
    scan = None if loss is None else delay_from_loss(loss)
    progress('delay', 1.0)
    has_noise = any(run.piece.find('noise') for run in runs)
    if step is not None and step.samples is not None:
        result = DelayResult(step.samples, step.std, 'steps', step, loss, scan)
        return _checked_delay(result, runs) if has_noise and not result.agree else result
    if scan is None:
        result = DelayResult(MAX_DELAY, float('inf'), 'none', step, loss)
        if loss is not None and has_noise:
            result = _checked_delay(result, runs)
        if result.source != 'none':
            return result
        what = 'too short to scan' if loss is None else f'that hides it below {MAX_DELAY} samples'
        raise IdentificationError(
            f'delay: {no_step(step)}, and a drive {what}; add larger steps, or set --delay'
        )
    run, start, stop = longest_noise(runs)
    std = 0.5 * run.piece.sample_rate / band_of(run, start, stop)
    return DelayResult(scan, std, 'scan', step, loss, scan)


def _checked_delay(result: DelayResult, runs: Sequence[Run]) -> DelayResult:
    run, start, stop = longest_noise(runs)
    noise = noise_segment(run, run.u, start, stop)
    return checked_delay(result, noise.fitted, noise.held)


def _scan(runs: Sequence[Run], kind: str) -> Array | None:
    """Compute the one-step loss for each delay, from all segments of a kind."""
    lags, parts = SCAN_ORDER + MAX_DELAY, []
    for run in runs:
        for s in run.piece.find(kind):
            if s.n >= 4 * (SCAN_ORDER + lags + 1):
                u, y = run.u[s.start : s.stop], run.x[s.start : s.stop]
                parts.append((u - u[0], y - y[:20].mean()))
    return factor_of(parts, SCAN_ORDER, lags).losses(SCAN_ORDER, MAX_DELAY) if parts else None


def triangle_excerpts(runs: Sequence[Run], held: bool = False) -> list[Excerpt]:
    """Cut out the triangles for fitting H, without (or only) their held-out blocks."""
    excerpts = []
    for run in runs:
        out = run.held_out()
        triangle = run.mask('triangle') & run.known
        # the same runs either way, so that each run keeps its offset
        if np.any(triangle & ~out):
            excerpts.append(run.excerpt(triangle & (out if held else ~out)))
    return excerpts


def small_excerpts(runs: Sequence[Run]) -> list[Excerpt]:
    """Cut out steps and noise, which judge H by small motion."""
    uses = [run.mask('step', 'settle', 'noise') & run.known & ~run.held_out() for run in runs]
    return [
        Excerpt(run.u, run.x, use, run.memory)
        for run, use in zip(runs, uses, strict=True)
        if use.any()
    ]


def motion_excerpts(runs: Sequence[Run]) -> list[Means]:
    """Cut out all motion for fitting H, without the held-out blocks."""
    return [Means(run.u, run.x, run.known & ~run.held_out(), run.memory) for run in runs]


def _orders(
    noise: NoiseSegment,
    settings: Settings,
    delay: int,
    candidates: int,
    progress: Callable[[float], None],
) -> list[tuple[DynamicsResult, Dynamics]]:
    """Search the orders and refine the best few."""
    size = max(settings.max_order, *(settings.order or (1, 1)))
    u, y = noise.fitted
    factor = arx_factor(u, y, size, size + delay)
    table = scan_orders(
        factor, delay, settings.max_order, *noise.held, lambda share: progress(0.5 * share)
    )
    refined_on = Excerpt(delayed(u, delay), y, np.arange(u.size) >= u.size // 50)

    def held_error(model: Dynamics) -> float:
        return float(100.0 * free_run_error(model, delay, *noise.held) / noise.held[1].std())

    orders = [settings.order] if settings.order else table.ranked(SLACK)
    if not settings.order:
        # noise biases least squares strongly for a mode that rings for thousands of samples
        sizes = range(2, min(table.loss.shape) + 1, 2)
        by_instruments = {
            (n, n): free_run_error(
                instrumental_variables(u, y, factor.dynamics(n, n, delay), delay),
                delay,
                *noise.held,
            )
            for n in sizes
        }
        least = min(by_instruments.values(), default=np.inf)
        if least < (1.0 - BENT) * table.held_out.min():
            orders = [o for o, error in by_instruments.items() if error <= (1.0 + SLACK) * least]
    orders = orders[:candidates]
    if not orders:
        raise IdentificationError(
            'dynamics: no order up to '
            f'({settings.max_order}, {settings.max_order}) gave a stable model; '
            'is the noise segment really noise, and is the displacement its answer?'
        )
    refined = []
    for i, (na, nb) in enumerate(orders):
        ls = factor.dynamics(na, nb, delay)
        iv = instrumental_variables(u, y, ls, delay)
        errors = {'least squares': held_error(ls), 'instrumental variables': held_error(iv)}
        start = iv if errors['instrumental variables'] < errors['least squares'] else ls
        # ticks repeat the share of the work, only so that the caller can stop within an iteration
        tick = functools.partial(progress, 0.5 + 0.5 * i / len(orders))
        fit = output_error([refined_on], stabilised(start), maxiter=REFINING, tick=tick)
        errors['output error'] = held_error(fit.dynamics)
        if np.isfinite(errors['output error']):
            result = DynamicsResult((na, nb), table, errors, fit.covariance, band=noise.band)
            refined.append((result, fit.dynamics))
        progress(0.5 + 0.5 * (i + 1) / len(orders))
    if not refined:
        raise IdentificationError('dynamics: no stable model was found; set --order')
    return refined


def second_step(
    runs: Sequence[Run], delay: Delay, settings: Settings, progress: Progress, lean: bool = False
) -> tuple[DynamicsResult, Dynamics]:
    """
    Find G without hysteresis; the returned dynamics are stable, with G(1) = 1.

    `lean` takes the pairs of `slow_part.without_pairs` out of G.  Raises IdentificationError if no
    order gives a stable model.
    """
    d = delay.samples
    run, start, stop = longest_noise(runs)

    def part(start: float, width: float) -> Callable[[float], None]:
        return lambda share: progress('dynamics', start + width * share)

    progress('dynamics', 0.0)
    # a first G that is only good enough to undo the hysteresis
    rate = run.piece.sample_rate
    raw = noise_segment(run, run.u, start, stop)
    [(_, first)] = _orders(raw, settings, d, 1, part(0.0, 0.3))
    del raw  # a gigabyte for a record of an hour
    G = fast_part(first, rate, lean)

    excerpts = triangle_excerpts(runs)
    swing = max(e.swing for e in excerpts)
    excursion = float(np.ptp(run.u[start:stop]))
    r = fine_thresholds(swing, excursion)

    def undo(G: Dynamics) -> Hysteresis:
        return fit_hysteresis(factorise(excerpts, r, G, delay), r).hysteresis

    H = undo(G)
    progress('dynamics', 0.45)
    undone = noise_segment(run, run.through(H), start, stop)
    candidates = _orders(undone, settings, d, CANDIDATES, part(0.45, 0.2))
    result, G = _best_in_free_run(candidates, runs, H, delay, progress, lean)
    H = undo(G)
    tick = functools.partial(progress, 'dynamics', 0.85)
    fit = output_error(_stretches(runs, H, delay)[0], G, maxiter=8, tick=tick)
    G = fast_part(fit.dynamics, rate, lean)
    progress('dynamics', 0.95)
    # regress the measured and the modelled displacement alike: the noise drags plays along in both
    noise = slice(max(0, start - WARM_UP), stop)
    g_u, g_w = (
        filter_arx(G.a, G.b, delay.apply(z)[noise])[start - stop :]
        for z in (run.u, run.through(H))
    )
    g_u, g_w, x = (signal.detrend(z) for z in (g_u, g_w, run.x[start:stop]))
    slope_measured, slope_model = float(g_u @ x / (g_u @ g_u)), float(g_u @ g_w / (g_u @ g_u))
    response = frequency_response(run.u[start:stop], run.x[start:stop], rate, result.band)
    progress('dynamics', 1.0)
    found_last = replace(
        result,
        covariance=fit.normalised_covariance,
        response=response,
        bias=float(run.u[start:stop].mean()),
        slope_measured=slope_measured,
        slope_model=slope_model,
    )
    return found_last, G


def _best_in_free_run(
    candidates: Sequence[tuple[DynamicsResult, Dynamics]],
    runs: Sequence[Run],
    H: Hysteresis,
    delay: Delay,
    progress: Progress,
    lean: bool,
) -> tuple[DynamicsResult, Dynamics]:
    """Refine each G by its free run, and choose the best on the held-out samples."""
    # noise alone hardly shows a slow pole with a tiny residue; steps that were not fitted show it
    stretches, held = _stretches(runs, H, delay)
    rate = runs[0].piece.sample_rate
    best, (result, G) = float('inf'), candidates[0]
    G = fast_part(G, rate, lean)
    for i, (candidate, start) in enumerate(candidates):
        tick = functools.partial(progress, 'dynamics', 0.65 + 0.2 * i / len(candidates))
        fast = fast_part(start, rate, lean)
        fit = output_error(stretches, fast, maxiter=6, tick=tick)
        score = simulation_error(held, fit.dynamics)
        # a larger model comes later, and must lower the error to win
        if score < best / (1.0 + GAIN):
            best, result = score, candidate
            G = fast_part(fit.dynamics, rate, lean)
        progress('dynamics', 0.65 + 0.2 * (i + 1) / len(candidates))
    return result, G


def beside_law(
    runs: Sequence[Run],
    H: Hysteresis,
    dynamics: DynamicsResult,
    G: Dynamics,
    delay: Delay,
    lean: bool = False,
) -> tuple[DynamicsResult, Dynamics] | None:
    """
    Refine G with an H of another law than the law with which G was found.

    None if the refined G does not lower the held-out error by `WORTH`.
    """
    stretches, held = _stretches(runs, H, delay)
    fit = output_error(stretches, G, maxiter=8)
    refined = fast_part(fit.dynamics, runs[0].piece.sample_rate, lean)
    if simulation_error(held, refined) > (1.0 - WORTH) * simulation_error(held, G):
        return None
    return replace(dynamics, covariance=fit.normalised_covariance), refined


def _stretches(
    runs: Sequence[Run], H: Hysteresis, delay: Delay
) -> tuple[list[Excerpt], list[Excerpt]]:
    """Cut out the excerpts that refine G, and the same excerpts with the held-out samples only."""
    fitted: list[Excerpt] = []
    held: list[Excerpt] = []
    for run in runs:
        out = run.held_out()
        use = run.mask('step', 'settle', 'noise') & run.use
        if use.any():
            # samples before the first used sample only have to let the transient die away
            first, last = np.flatnonzero(use)[[0, -1]]
            part = slice(max(0, int(first) - WARM_UP), int(last) + 1)
            w, y = delay.apply(run.through(H))[part], run.x[part]
            w, y = w - w[0], y - y[:20].mean()
            if run.piece.sample_rate > 2.0 * SLOWEST:
                # input and output pass the same filter, so G still leads from one to the other
                sos = signal.butter(2, SLOWEST, 'high', fs=run.piece.sample_rate, output='sos')
                w, y = signal.sosfilt(sos, w), signal.sosfilt(sos, y)
            for stretches, mask in ((fitted, use & ~out), (held, use & out)):
                if mask.any():
                    stretches.append(Excerpt(w, y, mask[part]))
    return fitted, held


def model_of(
    rate: float, scaling: Scaling, fit: HysteresisFit, G: Dynamics, delay: Delay
) -> StageModel:
    """Build the model; the offset of the fit moves its zero of displacement."""
    moved = replace(scaling, y0=scaling.y0 + float(fit.offsets[0]) * scaling.Y)
    return StageModel(rate, moved, fit.hysteresis, G, delay)


def within(model: StageModel, low: float, high: float) -> StageModel:
    """Set the identified range of a model, from two normalised voltages."""
    span = (model.scaling.v(low), model.scaling.v(high))
    return replace(model, scaling=replace(model.scaling, range=span))

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Records without labelled segments: everything that one record excites, by free-run error.

H and G are fitted in turn: H by bounded least squares with the plays seen through G, G by output
error from w = H[v].  What the record does not excite is left at its neutral value and said so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.errors import key_of
from piezo_ident.identification.prepare import Excerpt, Run
from piezo_ident.identification.results import (
    DelayResult,
    DynamicsResult,
    FitOutcome,
    Progress,
    Settings,
)
from piezo_ident.identification.solvers.output_error import output_error, OutputErrorFit
from piezo_ident.identification.spectra import excited_band
from piezo_ident.identification.step1_delay import delay_from_steps, find_jumps
from piezo_ident.identification.step2_dynamics import (
    arx_factor,
    instrumental_variables,
    stabilised,
)
from piezo_ident.identification.step3_hysteresis import (
    even_thresholds,
    factorise,
    fit_hysteresis,
)
from piezo_ident.identification.three_steps import model_of, third_step, within
from piezo_ident.identification.warnings import warn_of_range
from piezo_ident.model.initial_memory import fit_memory
from piezo_ident.model.stage_model import Scaling, StageModel
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from scipy import ndimage, signal

__all__ = ['JointFit', 'fit_unlabelled', 'joint_fit']

#: samples at the end of an unlabelled record that an error needs at least
MIN_HELD = 10

#: orders (na, nb) tried on a record with little dynamic content, from none upwards
ORDERS = ((1, 1), (1, 2), (2, 1), (2, 2), (3, 2), (3, 3), (4, 3), (4, 4), (5, 4), (5, 5), (6, 6))
#: time after a jump in which the dynamics are looked for [s]
WINDOW = 0.1
#: below this the signals are taken away before dynamics are fitted to jumps: slow errors of H and
#: of the unknown start would be larger than a ring [Hz]
HIGH_PASS = 30.0
#: rms above that frequency from which the voltage excites the dynamics throughout, normalised
FAST = 2e-3
#: samples of such a record that the search uses
MOST = 40_000
#: how often H and G are fitted in turn
TURNS = 4
#: dynamics must lower the loss in their windows by this share to be believed
GAIN = 0.2


@dataclass(frozen=True, eq=False)
class JointFit:
    """
    What one unlabelled run gave.

    `memory` gives the play outputs before the first sample for any thresholds; `hysteresis` is the
    H that went with the search for G; `not_identified` says what stayed at its neutral value, and
    why.
    """

    delay: DelayResult
    dynamics: DynamicsResult
    G: Dynamics
    memory: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None
    hysteresis: Hysteresis
    not_identified: tuple[tuple[str, str], ...]


def _memory_rule(
    thresholds: NDArray[np.float64], memory: NDArray[np.float64], u0: float
) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Carry a fitted memory over to other thresholds: it is a smooth curve over r."""

    def rule(r: NDArray[np.float64]) -> NDArray[np.float64]:
        curve = np.interp(r, np.concatenate([[0.0], thresholds]), np.concatenate([[u0], memory]))
        return np.asarray(np.clip(curve, u0 - r, u0))

    return rule


def _known(run: Run, n_fit: int) -> NDArray[np.bool_]:
    """Return the samples without the unknown start; all of a record that hardly comes back."""
    known = run.known[:n_fit]
    return known if known.sum() >= n_fit // 5 else np.ones(n_fit, dtype=bool)


def _windows(run: Run, n_fit: int) -> NDArray[np.bool_]:
    """Return the samples behind each jump of the voltage in the fitted part."""
    rate = run.piece.sample_rate
    use = np.zeros(n_fit, dtype=bool)
    before = min(50, n_fit // 10)
    for k in find_jumps(run.u[:n_fit], before, min(20, n_fit // 10)):
        use[max(0, k - before) : k + int(WINDOW * rate)] = True
    return use


def _find_delay(run: Run, n_fit: int, settings: Settings) -> tuple[DelayResult, str | None]:
    if settings.delay is not None:
        return DelayResult(settings.delay, 0.0, 'given'), None
    before = min(100, n_fit // 10)
    step = delay_from_steps([run.piece.cut(0, n_fit)], before, min(60, n_fit // 10))
    if step.samples is not None:
        return DelayResult(step.samples, step.std, 'steps', step), None
    reason = (
        'the voltage never jumps out of a rest, and a slow record cannot tell a delay from the '
        'lag of the hysteresis; add steps'
    )
    return DelayResult(0, float('inf'), 'none', step), reason


def _high_passed(x: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
    sos = signal.butter(2, HIGH_PASS, btype='highpass', fs=rate, output='sos')
    return np.asarray(signal.sosfilt(sos, x - x[0]))


def _fast_rms(u: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
    """Return the rms above `HIGH_PASS` around each sample."""
    if 4 * HIGH_PASS > rate:
        return np.zeros(u.size)
    width = max(1, int(WINDOW * rate))
    power = ndimage.uniform_filter1d(_high_passed(u, rate) ** 2, width)
    return np.asarray(np.sqrt(np.maximum(power, 0.0)))


def _busiest(fast: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which `MOST` samples in a row have the most fast power."""
    width = min(MOST, fast.size)
    total = np.cumsum(np.concatenate([[0.0], fast**2]))
    start = int(np.argmax(total[width:] - total[:-width]))
    chosen = np.zeros(fast.size, dtype=bool)
    chosen[start : start + width] = True
    return chosen


def _search_order(
    w: NDArray[np.float64],
    x: NDArray[np.float64],
    use: NDArray[np.bool_],
    settings: Settings,
    progress: Progress,
) -> tuple[tuple[int, int], OutputErrorFit] | None:
    """Return the order with the smallest BIC of free-run loss that beats G = 1 clearly."""
    stretch = Excerpt(w, x, use)
    n = int(use.sum())
    still = (x - w)[use]
    static_loss = float(np.mean((still - still.mean()) ** 2))
    part = slice(*max(stretch.stretches, key=lambda run: run[1] - run[0]))
    u, y = w[part] - w[part.start], x[part] - x[part.start]
    best: tuple[float, tuple[int, int], OutputErrorFit] | None = None
    orders = [settings.order] if settings.order else list(ORDERS)
    na_max, nb_max = max(o[0] for o in orders), max(o[1] for o in orders)
    if u.size < 4 * (na_max + nb_max + 1):
        return None
    factor = arx_factor(u, y, na_max, nb_max)
    for i, (na, nb) in enumerate(orders):
        ls = factor.dynamics(na, nb, 0)
        starts = [stabilised(ls), stabilised(instrumental_variables(u, y, ls, 0))]
        for start in starts:
            fit = output_error([stretch], start, maxiter=20)
            bic = n * np.log(max(fit.rms**2, np.finfo(float).tiny)) + np.log(n) * (na + nb)
            if best is None or bic < best[0]:
                best = (bic, (na, nb), fit)
        progress('dynamics', 0.2 + 0.6 * (i + 1) / len(orders))
    if best is None or best[2].rms ** 2 > (1.0 - GAIN) * static_loss:
        return None
    return best[1], best[2]


def joint_fit(
    run: Run, n_fit: int, scaling: Scaling, settings: Settings, progress: Progress
) -> JointFit:
    """
    Fit delay, low-order dynamics and the memory of the start on the first part of a run.

    Raises
    ------
    IdentificationError
        When its voltage hardly moves.
    """
    u, x = run.u[:n_fit], run.x[:n_fit]
    swing = float(np.ptp(u))
    if swing < 0.02:
        raise IdentificationError(
            f'{run.record}: the voltage moves by {swing:.1%} of its range in the fitted part; '
            'let it move there, or hold out less (--hold-out)'
        )
    progress('delay', 0.0)
    found, no_delay = _find_delay(run, n_fit, settings)
    missing = [('delay', no_delay)] if no_delay else []
    progress('delay', 1.0)
    delay = Delay(found.samples)
    rate = run.piece.sample_rate
    r = even_thresholds(swing, 40)
    known = _known(run, n_fit)
    G = Dynamics.unit()
    rule: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    windows = _windows(run, n_fit)
    band = excited_band(u[known] - u[known].mean(), rate, depth=1e-4)
    fast = _fast_rms(u, rate)
    quiet = known & ~windows
    broad = bool(quiet.any() and np.sqrt(np.mean(fast[quiet] ** 2)) > FAST)
    slow = known
    if broad:
        windows |= known & _busiest(fast)
        # where the stage lags behind a fast drive, H alone would take the lag for hysteresis
        calm = known & (fast < FAST)
        if calm.sum() > n_fit // 20 and np.ptp(u[calm]) > 0.8 * swing:
            slow = calm

    def view(z: NDArray[np.float64]) -> NDArray[np.float64]:
        return z if broad or 4 * HIGH_PASS > rate else _high_passed(z, rate)

    order: tuple[int, int] = (0, 1)
    fit: OutputErrorFit | None = None
    H = Hysteresis(r, np.zeros(r.size), 0.0, 1.0)
    for turn in range(TURNS):
        progress('dynamics', turn / TURNS)
        use = known if turn else slow
        R = factorise([Excerpt(u, x, use, rule)], r, G, delay)
        result = fit_hysteresis(R, r, int(use.sum()))
        H, offset = result.hysteresis, float(result.offsets[0])
        # even at its lowest voltage a stage may not have come down from the top: it relaxes
        shifted = replace(scaling, y0=scaling.y0 + offset * scaling.Y)
        trial = StageModel(rate, shifted, H, G, delay)
        memory = fit_memory(trial, run.piece.cut(0, n_fit))
        rule = _memory_rule(H.thresholds, memory, float(u[0]))
        if not windows.any():
            break
        w = delay.apply(H(u, memory))
        if fit is None:
            searched = _search_order(view(w), view(x - offset), windows, settings, progress)
            if searched is None:
                break
            order, fit = searched
        else:
            fit = output_error([Excerpt(view(w), view(x - offset), windows)], G, maxiter=20)
        G = fit.dynamics.normalised()
    if fit is None:
        missing.append(('dynamics', _why_static(windows, band)))
    du = np.abs(np.diff(u))
    if du[du > 0.02 * swing].sum() > 0.9 * du.sum():
        missing.append(
            (
                'hysteresis',
                'the voltage only jumps between levels, and what lies between them was never '
                'seen; add a slow triangle',
            )
        )
    covariance = np.zeros((1, 1)) if fit is None else fit.normalised_covariance
    progress('dynamics', 1.0)
    return JointFit(
        delay=found,
        dynamics=DynamicsResult(order, None, {}, covariance, band=band),
        G=G,
        memory=rule,
        hysteresis=H,
        not_identified=tuple(missing),
    )


def _why_static(windows: NDArray[np.bool_], band: float) -> str:
    if not windows.any():
        return (
            f'the voltage has no jump and no power above {band:.3g} Hz, where a stage follows '
            'statically; add steps or noise'
        )
    return 'no order up to (6, 6) explains more than the hysteresis alone; add noise'


def fit_unlabelled(
    runs: Sequence[Run], rate: float, scaling: Scaling, settings: Settings, progress: Progress
) -> FitOutcome:
    """
    Fit the run that covers the widest range, but for its end.

    Raises
    ------
    IdentificationError
        When what is left to fit or to judge by is too short, or does not move.
    """
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
    use = _known(run, n_fit)
    # what chooses the thresholds is a part of what is fitted in the end, never the held-out end
    late = np.zeros(n_fit, dtype=bool)
    late[n_fit - int(0.25 * use.sum()) :] = True
    fit_part = [Excerpt(u, x, use & ~late, joint.memory)]
    late_part = [Excerpt(u, x, use & late, joint.memory)]
    whole = [Excerpt(u, x, use, joint.memory)]
    hysteresis = third_step(fit_part, late_part, joint.G, delay, settings, progress, whole)
    model = model_of(rate, scaling, hysteresis, joint.G, delay)
    model = within(model, float(u.min()), float(u.max()))
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
    warnings = [
        'no segments labelled noise and triangle: delay, dynamics and hysteresis were fitted '
        f'together on the first {n_fit / rate:.4g} s of {run.record}',
        *warn_of_range(run, n_fit, scaling),
    ]
    progress('hysteresis', 1.0)
    return FitOutcome(
        model=model,
        delay=joint.delay,
        dynamics=joint.dynamics,
        hysteresis=hysteresis,
        masks=masks,
        warnings=warnings,
        not_identified=joint.not_identified,
        memories=memories,
    )

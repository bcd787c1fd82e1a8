# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Records without labelled segments: everything that they excite, by free-run error.

The memory at the start of each run, H and G are fitted in turn: starts and H by bounded least
squares on slow motion first, G from what is fast.  What the records do not excite is left at its
neutral value and said so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Mask, true_runs
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.delay_check import delay_behind
from piezo_ident.identification.errors import key_of
from piezo_ident.identification.fast_motion import FastAndCalm, FastMotion, moving
from piezo_ident.identification.hold_out import fitted_parts, held_out_place, MOVES
from piezo_ident.identification.linear_part import (
    find_linear_part,
    LinearPart,
    refined_linear_part,
)
from piezo_ident.identification.prepare import Excerpt, Run
from piezo_ident.identification.results import (
    DelayResult,
    DynamicsResult,
    FitOutcome,
    Progress,
    Settings,
    silent,
)
from piezo_ident.identification.spectra import broadband_response, excited_band
from piezo_ident.identification.starts import fit_starts, lag_of, without_harm
from piezo_ident.identification.step1_delay import delay_from_steps, StepDelay
from piezo_ident.identification.step3_choice import third_step
from piezo_ident.identification.step3_hysteresis import (
    even_thresholds,
    factorise,
    fit_again,
    fit_hysteresis,
    HysteresisFit,
)
from piezo_ident.identification.three_steps import model_of, within
from piezo_ident.identification.warnings import (
    reasons_of,
    warn_of_range,
    warn_of_starts,
    warn_of_zeros,
)
from piezo_ident.model.scaling import Scaling
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis

Vector = NDArray[np.float64]

#: how often starts, H and G are fitted in turn
TURNS = 3
#: share of the fitted samples that chooses between models
CHOOSES = 0.25
#: G goes where its squares are by this share more than those of hysteresis alone on what chooses
WORSE = 0.02


@dataclass(frozen=True, eq=False)
class JointFit:
    """
    What unlabelled runs gave.

    `excerpts` are the fitted parts of the runs with the memory at their start; `hysteresis` is
    the H that went with the search for G; `gain` is the sum of squares by which delay and G err
    less than nothing on fast motion that was not fitted; `not_identified` says what stayed at its
    neutral value, and why.
    """

    delay: DelayResult
    dynamics: DynamicsResult
    G: Dynamics
    excerpts: tuple[Excerpt, ...]
    hysteresis: Hysteresis
    gain: float
    not_identified: tuple[tuple[str, str], ...]


def joint_fit(
    runs: Sequence[Run], fitted: Sequence[Mask], settings: Settings, progress: Progress
) -> JointFit:
    """
    Fit delay, dynamics and the memory of each start on parts of runs.

    Parameters
    ----------
    runs : sequence of Run
    fitted : sequence of ndarray of bool
        Samples of each that are fitted.
    settings : Settings
    progress : callable

    Raises
    ------
    IdentificationError
        When the voltage hardly moves.
    """
    excerpts = [run.excerpt(run.use & mask) for run, mask in zip(runs, fitted, strict=True)]
    swing = max(e.swing for e in excerpts if e.use.any())
    if swing < MOVES:
        raise IdentificationError(
            f'{runs[0].record}: the voltage moves by {swing:.1%} of its range in the fitted part; '
            'let it move there, or hold out less (--hold-out)'
        )
    rate = runs[0].piece.sample_rate
    excerpts = [replace(e, use=e.use & moving(e.u, rate, swing)) for e in excerpts]
    progress('delay', 0.0)
    pieces = [
        run.piece.cut(start, stop)
        for run, mask in zip(runs, fitted, strict=True)
        for start, stop in true_runs(mask)
    ]
    least = min(piece.n for piece in pieces) // 10
    step = delay_from_steps(pieces, min(100, least), min(60, least))
    progress('delay', 1.0)
    motion = FastAndCalm.of(excerpts, rate, swing)
    delays = [] if step.samples is None else [step.samples]
    G = Dynamics.unit()
    delay = Delay(settings.delay if settings.delay is not None else sum(delays))
    r = even_thresholds(swing, 40)
    linear: LinearPart | None = None
    for turn in range(TURNS):
        progress('dynamics', turn / TURNS)
        masks = motion.calm if turn == 0 else [e.use for e in excerpts]
        slow = [replace(e, use=m) for e, m in zip(excerpts, motion.calm, strict=True)]
        rules = fit_starts(slow, [True] * len(slow), lag_of(G, delay))
        excerpts = [replace(e, memory=rule) for e, rule in zip(excerpts, rules, strict=True)]
        parts = [replace(e, use=m) for e, m in zip(excerpts, masks, strict=True)]
        result = fit_hysteresis(factorise(parts, r, G, delay), r)
        H = result.hysteresis
        if not any(m.any() for m in motion.fast) or (turn and linear is None):
            break
        signals = [
            Excerpt(H(e.u, e.start(H.thresholds)), e.x - offset, fast)
            for e, offset, fast in zip(excerpts, result.offsets, motion.fast, strict=True)
        ]
        fast_motion = FastMotion.of(signals, rate)
        if turn < TURNS - 1:

            def tick(share: float, turn: int = turn) -> None:
                progress('dynamics', (turn + share) / TURNS)

            linear = find_linear_part(
                fast_motion,
                settings.max_order,
                delays=delays,
                given=settings.delay,
                order=settings.order,
                rough=turn == 0,
                tick=tick,
            )
        elif linear is not None:
            linear = refined_linear_part(fast_motion, linear)
        if linear is not None:
            delay = linear.delay
            G = Dynamics.unit() if linear.fit is None else linear.fit.dynamics.normalised()
    band = max(
        excited_band(e.u[e.use] - e.u[e.use].mean(), rate, depth=1e-4)
        for e in excerpts
        if e.use.sum() > 1
    )
    undone = [H(e.u, e.start(H.thresholds)) for e in excerpts]
    response = broadband_response(
        [
            (e.u[a:b], w[a:b], e.x[a:b])
            for e, w, run, mask in zip(excerpts, undone, runs, fitted, strict=True)
            # a rest before a jump belongs to it
            for a, b in run.excerpt(run.use & mask).joined
        ],
        rate,
    )
    found = _delay_result(delay, step, linear, settings, rate, band)
    progress('dynamics', 1.0)
    fit = None if linear is None else linear.fit
    return JointFit(
        delay=found,
        dynamics=DynamicsResult(
            (0, 1) if fit is None else (G.a.size, G.b.size),
            None,
            {} if linear is None else linear.methods,
            np.zeros((1, 1)) if fit is None else fit.normalised_covariance,
            response,
            band=band,
        ),
        G=G,
        excerpts=tuple(excerpts),
        hysteresis=H,
        gain=0.0 if linear is None else linear.gain,
        not_identified=tuple(reasons_of(excerpts, found, linear, settings, rate).items()),
    )


def _delay_result(
    delay: Delay,
    step: StepDelay,
    linear: LinearPart | None,
    settings: Settings,
    rate: float,
    band: float,
) -> DelayResult:
    if settings.delay is not None:
        return DelayResult(settings.delay, float('inf'), 'given')
    loss, scan = (None, None) if linear is None else (linear.loss, linear.scan)
    found = linear is not None and (linear.fit is not None or delay.total > 0.0)
    if step.samples is not None and (not found or abs(delay.total - step.samples) < 1.5):
        return DelayResult(delay.samples, step.std, 'steps', step, loss, scan, delay.fraction)
    if not found:
        return DelayResult(delay.samples, float('inf'), 'none', step, loss, scan)
    # a drive that ends at f leaves a doubt of half a period of f
    std = max(1.0 / np.sqrt(12.0), 0.5 * rate / band)
    return DelayResult(delay.samples, std, 'scan', step, loss, scan, delay.fraction)


def fit_unlabelled(
    runs: Sequence[Run], rate: float, scaling: Scaling, settings: Settings, progress: Progress
) -> FitOutcome:
    """
    Fit all runs but for the end of each, and in the end H to all of them.

    Raises
    ------
    IdentificationError
        When what is left to fit or to judge by is too short, or does not move.
    """
    chosen, parts = fitted_parts(runs, settings)
    joint = joint_fit(chosen, parts, settings, progress)
    used, whole = without_harm(chosen, joint.excerpts, joint.G, joint.delay)
    divided = _divided(whole, rate)
    slow = _slow_delay(joint, *divided)
    if isinstance(slow, DelayResult):
        # the memory of the starts goes with the delay
        with_it = replace(settings, delay=slow.samples)
        again = joint_fit(chosen, parts, with_it, lambda step, share: progress('dynamics', 1.0))
        joint = replace(again, delay=slow)
        used, whole = without_harm(chosen, joint.excerpts, joint.G, joint.delay)
        divided = _divided(whole, rate)
    elif slow:
        missing = dict(joint.not_identified)
        missing['delay'] = f'{slow}; {missing["delay"]}'
        joint = replace(joint, not_identified=tuple(missing.items()))
    joint = _simplest(joint, *divided)
    delay = Delay(joint.delay.samples, joint.delay.fraction)
    # what chooses the thresholds is a part of what is fitted, never the held-out end
    judged = hysteresis = third_step(*divided, joint.G, delay, settings, progress, whole)
    if judged.solver == 'least_squares':
        # a short record has no motion to waste on its own test
        everything = [
            replace(e, use=run.use & (e.use | ~mask))
            for run, e, mask in zip(used, whole, parts, strict=True)
        ]
        hysteresis = _again(judged, everything, rate, joint.G, delay, settings)
    model, tested = (model_of(rate, scaling, h, joint.G, delay) for h in (hysteresis, judged))
    low, high = (float(f([f(run.u) for run in chosen])) for f in (np.min, np.max))
    model = within(model, low, high)
    # where two have one name nobody could tell whose start it is
    keys = [key_of(run) for run in runs]
    own = {
        key_of(run): i
        for i, run in enumerate(chosen)
        # a start that was left out is not known
        if keys.count(key_of(run)) == 1 and used[i] is run
    }
    memories, at_test = (
        {key: whole[i].start(m.hysteresis.thresholds) for key, i in own.items()}
        for m in (model, tested)
    )
    offsets = {
        key: scaling.Y * float(judged.offsets[i] - judged.offsets[0]) for key, i in own.items()
    }
    fitted = {id(run): mask for run, mask in zip(chosen, parts, strict=True)}
    nothing = [np.zeros(run.piece.n, dtype=bool) for run in runs]
    masks = [(fitted.get(id(run), none), none) for run, none in zip(runs, nothing, strict=True)]
    names = ', '.join(_named(run, mask) for run, mask in zip(chosen, parts, strict=True))
    warnings = [
        'no segments labelled noise and triangle: delay, dynamics and hysteresis were fitted '
        f'together on {names}, as the errors say; the weights of H were then fitted to all of it',
        *warn_of_starts(chosen, used),
        *warn_of_range(chosen, parts, scaling),
        *warn_of_zeros(offsets, scaling),
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
        offsets=offsets,
        judged=(tested, at_test),
    )


def _divided(excerpts: Sequence[Excerpt], rate: float) -> tuple[list[Excerpt], list[Excerpt]]:
    """Return the samples used but for a stretch of them, and that stretch, which chooses."""
    fitted, choosing = [], []
    for e in excerpts:
        used, chooses = np.flatnonzero(e.use), np.zeros(e.use.size, dtype=bool)
        n = int(CHOOSES * used.size)
        start = held_out_place(e.u[used], rate, n) if n else 0
        chooses[used[start : start + n]] = True
        fitted.append(replace(e, use=e.use & ~chooses))
        choosing.append(replace(e, use=chooses))
    return fitted, choosing


def _again(
    fit: HysteresisFit,
    excerpts: Sequence[Excerpt],
    rate: float,
    G: Dynamics,
    delay: Delay,
    settings: Settings,
) -> HysteresisFit:
    """Return the same law fitted to more data, which may carry more plays."""
    if fit.law != 'plays':
        return fit_again(fit, excerpts, G, delay)
    found = third_step(*_divided(excerpts, rate), G, delay, settings, silent, excerpts, plays=True)
    return replace(found, errors_of_laws=fit.errors_of_laws)


def _named(run: Run, fitted: Mask) -> str:
    """Return what is fitted of a run, in words."""
    [(start, stop)] = true_runs(~fitted)
    rate = run.piece.sample_rate
    if stop == fitted.size:
        return f'the first {start / rate:.4g} s of {run.record}'
    return f'{run.record} without {start / rate:.4g} to {stop / rate:.4g} s, which are held out'


def _slow_delay(
    joint: JointFit, fitted: Sequence[Excerpt], choosing: Sequence[Excerpt]
) -> DelayResult | str:
    """Return the delay that H alone shows, or why it shows none; an empty text if not asked."""
    if joint.delay.source != 'none' or not _are_all(fitted, choosing):
        return ''
    found = delay_behind(fitted, choosing, joint.hysteresis.thresholds)
    if isinstance(found, str):
        return found
    return replace(joint.delay, samples=found.samples, std=found.std, source=found.source)


def _are_all(fitted: Sequence[Excerpt], choosing: Sequence[Excerpt]) -> bool:
    """Return whether there is something to choose by, and something to fit of every run."""
    return any(e.use.any() for e in choosing) and all(e.use.any() for e in fitted)


def _simplest(joint: JointFit, fitted: Sequence[Excerpt], choosing: Sequence[Excerpt]) -> JointFit:
    """
    Return the fit, without its G or its delay too where that errs less on what chooses.

    A delay that was given stays.
    """
    is_given = joint.delay.source == 'given'
    delay = Delay(joint.delay.samples, joint.delay.fraction)
    neutral = delay if is_given else Delay(0)
    is_simple = joint.G.is_static and delay.total == neutral.total
    if is_simple or not _are_all(fitted, choosing):
        return joint
    r = joint.hysteresis.thresholds

    def error(G: Dynamics, delay: Delay) -> float:
        fit = fit_hysteresis(factorise(fitted, r, G, delay), r)
        return fit.left(factorise(choosing, r, G, delay))

    with_both, without = error(joint.G, delay), error(Dynamics.unit(), neutral)
    # what G is worth counts where it is fast, what it costs where the record goes on
    if with_both <= (1.0 + WORSE) * without + joint.gain:
        return joint
    names = [*([] if is_given else ['delay']), *([] if joint.G.is_static else ['dynamics'])]
    one, other = (
        100.0 * np.sqrt(left / sum(int(e.use.sum()) for e in choosing))
        for left in (with_both, without)
    )
    reason = (
        f'with {" and ".join(names)} the model errs by {one:.4g} % of stroke on data held out, '
        f'without by {other:.4g} %; add steps or noise'
    )
    return replace(
        joint,
        G=Dynamics.unit(),
        delay=joint.delay if is_given else joint.delay.unknown,
        dynamics=replace(joint.dynamics, order=(0, 1), methods={}, covariance=np.zeros((1, 1))),
        not_identified=tuple((dict(joint.not_identified) | dict.fromkeys(names, reason)).items()),
    )

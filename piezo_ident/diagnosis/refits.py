# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Refit H, and choose the H of the refined model.

The walk tries the given H, then plays, a retuned G, wide laws, and a wide law with a retuned G.
A step is taken if at most `TAKES` of the error of the last one taken is left, on whole kinds of
motion: blocks alone could choose a wide H with a retuned G that errs widely under other motion.
Without an effect, another gain of the given H is preferred to a step that is slightly better.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
import itertools

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import IdentificationError
from piezo_ident.diagnosis.criteria import ALIKE, PASSES, TAKES
from piezo_ident.diagnosis.decision import Candidates, change_g, FittedSet
from piezo_ident.diagnosis.equations import BaseColumns, held_out_errors, normal_equations, Pull
from piezo_ident.diagnosis.joint_fit import fit_base, fit_jointly, Fitted, polished, tried, Until
from piezo_ident.diagnosis.rows import means
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import RETUNING, State
from piezo_ident.operators.dynamics import Delay, Dynamics, filter_arx
from piezo_ident.operators.hysteresis_law import HysteresisLaw, LawName

#: a new numerator of G begins so many samples earlier, as the delay may have imitated the effect.
#: Its fewest taps: a mode needs three, and a filter behind the mode needs one (physics)
EARLIER, LEAST_TAPS = 3, 4
#: laws of H wider than plays: the loops of the first are not congruent, the second also has lags
WIDE: tuple[LawName, ...] = ('preisach', 'duhem')


def refits(simulator: Simulator, given: State) -> tuple[Fitted, Fitted]:
    """Refit H as plays, and as the better wide law; the voltage must move."""
    if max(float(np.ptp(run.u)) for run in simulator.rows.runs) == 0.0:
        raise IdentificationError('the voltage never moves; record the stage while it is driven')
    plays, *wide = (refit_of(simulator, given, name) for name in ('plays', *WIDE))
    return plays, min(wide, key=lambda fit: float(fit.errors.sum() * fit.transfer.sum()))


def base_thresholds(swing: float) -> np.ndarray:
    """Return nineteen even thresholds over the swing, and four fine thresholds near zero."""
    fine = np.array([0.005, 0.012, 0.025, 0.037])
    return swing * np.concatenate([fine, np.arange(1, 20) / 20.0])


def refit_of(simulator: Simulator, state: State, name: LawName, goal: float = np.inf) -> Fitted:
    """Refit H within a law with an unchanged G; `goal` as in `Until`."""
    low, high = simulator.rows.reach
    swing = max(float(np.ptp(run.u)) for run in simulator.rows.runs)
    law = HysteresisLaw(name, base_thresholds(swing), (min(low, 0.0), max(high, 1.0)))
    return fit_jointly(simulator, *fit_base(simulator, state, law), until=Until(goal=goal))


def with_g(simulator: Simulator, fitted: Fitted, goal: float = np.inf) -> Fitted:
    """Fit again with a retuned G; `goal` as in `Until`."""
    state = replace(fitted.state, retuning=(0.0,) * len(RETUNING))
    return fit_jointly(simulator, state, fitted.base, until=Until(goal=goal))


def walk(
    simulator: Simulator,
    given: State,
    candidates: Candidates,
    best: FittedSet | None,
    tick: Callable[[], None],
) -> FittedSet:
    """Choose the H of the refined model, beside the effects of the best candidate, or a gain."""

    def goal() -> float:
        return candidates.noise + TAKES * _left(candidates, last.fitted)

    steps = _steps(simulator, given, candidates, best, tick, goal)
    first = last = next(steps)
    if candidates.rows.passes < PASSES:
        # a branch that was passed once cannot be held out
        return first
    for step in steps:
        tick()
        if _left(candidates, step.fitted) <= TAKES * _left(candidates, last.fitted):
            last = step
    if best is not None:
        return last
    # a gain is a single number, so it may replace a refit that is only slightly better
    gain = _other_gain(simulator, first.fitted)
    known, left = (_left(candidates, x.fitted) for x in (first, last))
    is_gain = gain.gain > 0.0 and _left(candidates, gain.fitted) <= min(
        TAKES * known, ALIKE * left
    )
    return gain if is_gain else last


def _left(candidates: Candidates, fitted: Fitted) -> float:
    """Compute the mean square error of a fit on whole kinds of motion less the noise."""
    return candidates.beyond_noise(float(fitted.transfer.sum()) / candidates.rows.n)


def _steps(
    simulator: Simulator,
    given: State,
    candidates: Candidates,
    best: FittedSet | None,
    tick: Callable[[], None],
    goal: Callable[[], float],
) -> Iterator[FittedSet]:
    """Yield one H after the other; `goal` as in `Until`.  A fit that runs away ends the walk."""
    names = () if best is None else best.effects
    step = partial(FittedSet, names)
    # the best candidate of each treatment comes last, so it stays in the dictionary
    own = candidates.of(names)[::-1]
    known = {c.way: c.fitted for c in own if not c.retunes}
    retuned = {c.way: c.fitted for c in own if c.retunes}
    first = candidates.as_given.fitted
    if best is not None:
        state = first.state.with_effects_of(best.fitted.state)
        beside = known.get('given') or tried(fit_jointly, simulator, state)
        if beside is None:
            # the fit diverges beside the given H, so the H of the candidate stays
            yield best
            return
        first = beside
    yield step('given', first)
    plays = known.get('plays') or tried(refit_of, simulator, first.state, 'plays', goal())
    if plays is None:
        return
    yield step('plays', plays)
    yield from (step(way, retuned[way]) for way in ('given', 'plays') if way in retuned)
    of_law: dict[LawName, Fitted | None] = {}
    if 'wide' in known:
        of_law[law_of(known['wide'])] = known['wide']

    def wide_of(name: LawName, goal: float = np.inf) -> Fitted | None:
        if name not in of_law:
            of_law[name] = tried(refit_of, simulator, first.state, name, goal)
        return of_law[name]

    laws = WIDE
    if not simulator.rows.kinds:
        # only labels restrain lags along the path.  The given H came from other motion, so a law
        # with lags is only tried drawn to the given H
        wide = wide_of(next(law_of(c.fitted) for c in candidates.of(()) if c.way == 'wide'))
        drawn = wide and tried(toward_given, simulator, given, wide, tick)
        if drawn is None:
            return
        if drawn is not wide:
            yield step('drawn', drawn)
        laws = WIDE[:1]
    wides = [wide for name in laws if (wide := wide_of(name, goal())) is not None]
    yield from (step('wide', wide) for wide in wides)
    wide = min(wides, key=partial(_left, candidates), default=None)
    # an effect that changes G leaves nothing for a retuning of G
    if wide and simulator.is_fast and not change_g([added.name for added in wide.state.effects]):
        last = retuned.get('wide')
        if last is None or law_of(last) != law_of(wide):
            last = tried(with_g, simulator, wide)
        if last is not None:
            yield step('wide', last)


def with_numerator(simulator: Simulator, step: FittedSet) -> FittedSet:
    """
    Fit the numerator of G again, in turn with all else, beside an effect that moves a mode of G.

    An identification without the effect has distorted G.  The effect itself moves its mode, so
    this pole stays.  Other poles may have imitated the effect, so G is tried without them, too.
    The result is `step` itself if the error falls by less than `POLISH`, or if the fit fails.
    """
    model, best = simulator.model, step
    for added in step.fitted.state.effects:
        mode = added.effect.mode(added.values[0])
        if mode is None:
            continue
        for a in (model.dynamics.a, _poles_of(*mode, model.sample_rate)):

            def again(state: State, a: Array = a) -> Fitted | None:
                return tried(_with_other_numerator, simulator, a, state)

            last = replace(step, fitted=polished(again, step.fitted))
            best = min(best, last, key=lambda one: one.fitted.mean_square)
    return best


def _poles_of(frequency: float, damping: float, sample_rate: float) -> Array:
    """Return a_1 and a_2 of a mode."""
    w = 2.0 * np.pi * frequency / sample_rate
    pole = np.exp(w * complex(-damping, np.sqrt(1.0 - damping**2)))
    return np.array([-2.0 * pole.real, abs(pole) ** 2])


def _with_other_numerator(simulator: Simulator, a: Array, state: State) -> Fitted:
    """Fit the taps of G behind poles a_1, a_2, ..., and then all else."""
    rows, model = simulator.rows, simulator.model
    G, delay = model.dynamics, model.delay.samples
    first = max(0, delay - EARLIER)
    taps = range(first, max(delay + G.b.size + 1, first + LEAST_TAPS))
    ringing = [filter_arx(a, np.ones(1), x) for x in simulator.into_g(state)]
    columns = [rows.of([Delay(k).apply(x) for x in ringing]) for k in taps]
    added = simulator.added_columns(state)
    whole = np.column_stack([*columns, added])
    theta: Array = np.asarray(np.linalg.lstsq(whole, rows.x, rcond=None)[0], dtype=np.float64)
    linear = Dynamics(a, theta[: len(taps)]), Delay(first)
    state = replace(state, retuning=(), linear=linear)
    return fit_jointly(simulator, state.with_only_added(theta[len(taps) :]))


def law_of(fitted: Fitted) -> LawName:
    """Return the law of a refitted H; 'any' if H stays as it is."""
    return 'any' if fitted.state.law is None else fitted.state.law.name


def _other_gain(simulator: Simulator, fitted: Fitted) -> FittedSet:
    """Fit another gain of an otherwise unchanged H."""
    rows, state = simulator.rows, fitted.state
    x = simulator.bare(state)
    x = x - x.mean()
    columns = np.concatenate([x[None], simulator.added_columns(state).T]).T
    base = BaseColumns.of(rows, columns)
    free, none = np.ones(columns.shape[1], bool), np.zeros(columns.shape[1])
    equations = normal_equations(rows, columns, fitted.e[:, None])
    theta = np.linalg.lstsq(equations.A.sum(axis=0), equations.b.sum(axis=0)[:, 0], rcond=None)[0]
    gain = 1.0 + float(theta[0])
    e = fitted.e - columns @ theta
    moved = replace(state, hysteresis=state.hysteresis.scaled(max(gain, 0.0)))
    shifts = means(rows.x - e - simulator.run(moved), rows.of_record)
    moved = replace(moved, offsets=moved.offsets + shifts)
    own, kinds = (held_out_errors(equations, x, none)[:, 0] for x in (rows.fold, rows.group))
    step = Fitted(moved, base, e, np.empty((rows.n, 0)), free, (), none, own, kinds)
    return FittedSet((), 'gain', step, gain=gain)


#: number of samples of a sweep over the range
SWEEP = 60


def loops(low: float, high: float) -> Array:
    """Compute a motion from `low` through loops from both ends of a range, and loops between."""
    lower = [x for level in np.arange(1, 7) / 6 for x in (level, 0.0)]
    upper = [x for level in np.arange(1, 6) / 6 for x in (level, 1.0)]
    small = [x for level in (0.3, 0.6, 0.9) for x in 2 * (level, level - 0.15)]
    turns = [0.0, *lower, 1.0, *upper, 0.0, *small, 0.0]
    sweeps = [
        np.linspace(a, b, max(2, round(SWEEP * abs(b - a))), endpoint=False)
        for a, b in itertools.pairwise(turns)
    ]
    return low + (high - low) * np.concatenate(sweeps)


def toward_given(
    simulator: Simulator, given: State, fitted: Fitted, tick: Callable[[], None] = lambda: None
) -> Fitted:
    """
    Repeat a fit of rows without labelled kinds of motion, drawn to the given H.

    Only labelled rows test a refitted H under other motion.  The given H was identified on other
    motion, so it counts as data, too:

        min  |e|^2 + n mean((h - h_0 - c)^2)

    h and h_0 are the new and the given H under loops over the range of the model; n counts rows.
    Offsets compensate the mean difference c.  The given H keeps terms small that compensate each
    other on these rows alone.  If the data cover only a part of the range, the given H does not
    count, and the refined model holds in this part only.
    """
    law, rows, scaling = fitted.state.law, simulator.rows, simulator.model.scaling
    if law is None or rows.kinds or not rows.covers(scaling.range):
        return fitted
    u = loops(*map(float, scaling.u(scaling.range)))
    P = np.stack(list(law.columns(u)), axis=1)
    P -= P.mean(axis=0)
    h = given.hysteresis(u)
    h = h - h.mean()
    P, h = (x / np.sqrt(u.size) for x in (P, h))
    # with a smaller weight of the given H, these rows were fitted better and other motion worse
    weight = float(rows.n)
    A = weight * (P.T @ P)

    def pull_at(state: State, size: int) -> Pull:
        k = law.size
        whole, right = np.zeros((size, size)), np.zeros(size)
        left = h - P @ state.coefficients
        whole[:k, :k], right[:k] = A, weight * (P.T @ left)
        return Pull(whole, right, weight * float(left @ left))

    state = fitted.state
    return fit_jointly(simulator, state, tick=tick, pull_at=pull_at)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Run one round of the search: find the candidates that lower the error on held-out data.

Each candidate is tried by finite differences of the whole model, with the effect switched slightly
on.  Its score is the gain of its columns on held-out blocks, beside all other columns of the
model.  The gain is compared with the gain on circular-shift surrogates of the residual, which
chance alone produces.  The most promising candidates are then fitted together with the rest of the
model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache, partial
from threading import Event

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import Cancelled, IdentificationError, ModelError
from piezo_ident.diagnosis.equations import BaseColumns
from piezo_ident.diagnosis.joint_fit import (
    base_at,
    fit_base,
    fit_jointly,
    Fitted,
    good_enough,
    least_gain,
    POLISHING,
)
from piezo_ident.diagnosis.next_experiment import look_alikes
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import State
from piezo_ident.diagnosis.trial_scores import (
    best_trials,
    score_trials,
    Scored,
    shows,
    started,
    Tick,
    TrialColumns,
)
from piezo_ident.effects import Effect
from piezo_ident.operators.hysteresis_law import HysteresisLaw

#: number of surrogates of the residual: chance exceeds their largest gain in 1 of 17 cases
SURROGATES = 16
#: share of the error that a candidate must gain at its trial to be fitted jointly, and the largest
#: number of joint fits in a round
WORTH_FIT, JOINT_FITS = 0.05, 4
#: a fit is stopped early if it gains a smaller share of the best gain after a few iterations
WORTH_END = 0.5
#: number of trials of a candidate that start a joint fit, iterations of this fit, and number of
#: candidates of a round that are fitted to the end
STARTS, FIRST, FINAL = 2, 3, 2
#: a trial beside a sum of plays is a start up to the first multiple of the error before; another
#: start, and another candidate, is given up beyond the second and third multiple of the best error
PLAIN_START, AHEAD, FORM_RATIO = 1.6, 1.6, 4.0
#: a further candidate is fitted to the end if its error is at most this factor times the error of
#: the last of the `FINAL` candidates
LEVEL = 1.05

#: errors that end one start; the other starts continue
Failure = ModelError | IdentificationError
#: interval at which a caller may stop the search [s]
ASKED = 0.1


@dataclass(frozen=True, eq=False)
class Round:
    """
    One round of the search.

    Attributes
    ----------
    before : Fitted
        The fit to which the candidates were added.
    best : dict of str to Scored
        The best trial of every candidate that could be tried.
    contenders : tuple of Fitted
        Candidates after the joint fit, ordered by error.  Candidates that do not show in the
        places of `signature` are left out.
    chance : dict of str to float
        Largest mean square that a candidate gains on surrogates of the residual.
    visible : dict of str to float
        Share of a candidate's own columns that a refit of the rest cannot imitate.
    warnings : tuple of str
        Candidates whose joint fit failed, and why.
    """

    before: Fitted
    best: dict[str, Scored]
    contenders: tuple[Fitted, ...]
    chance: dict[str, float]
    visible: dict[str, float]
    warnings: tuple[str, ...]

    @property
    def gain(self) -> float:
        """Mean square that the best contender gains."""
        return self.before.mean_square - self.contenders[0].mean_square


def search_round(
    columns: TrialColumns,
    before: Fitted,
    effects: Sequence[type[Effect]],
    noise: float,
    rng: np.random.Generator,
    tick: Tick,
    *,
    goal: float,
) -> Round:
    """
    Score all candidates and fit the best of them jointly.

    `noise` is the mean square of the noise of a row, and `rng` draws the shifts of the surrogates.
    A fit ends early if it cannot reach the mean square `goal`.
    """
    surrogates, n = _surrogates(before.e, rng), columns.rows.n
    trials: dict[str, list[Scored]] = {}
    chance: dict[str, float] = {}
    visible: dict[str, float] = {}
    for scored in score_trials(
        columns, before, effects, surrogates, lambda share: tick(0.5 * share)
    ):
        name = scored.effect.name
        visible[name] = max(visible.get(name, 0.0), scored.visible)
        if scored.is_possible:
            chance[name] = max(chance.get(name, 0.0), scored.chance / n)
            trials.setdefault(name, []).append(scored)
    for scores in trials.values():
        scores.sort(key=lambda s: s.error)
    starts = [
        (
            scores[0].effect,
            # the law with the best small step may not be the law with the best fit
            [before.state.with_effect(started(columns.rows, s)) for s in scores[:STARTS]],
        )
        for scores in _promising(list(trials.values()), before, noise)
    ]
    _add_plain_starts(columns, before, starts)
    contenders, warnings = _contenders(columns.simulator, before, starts, noise, goal, tick)
    tick(1.0)
    return Round(
        before=before,
        best={name: scores[0] for name, scores in trials.items()},
        contenders=tuple(contenders),
        chance=chance,
        visible=visible,
        warnings=tuple(warnings),
    )


def _surrogates(e: Array, rng: np.random.Generator) -> Array:
    """Shift a residual in time so that nothing of it is left in place; shape (n, surrogates)."""
    n = e.size
    shifts = rng.integers(n // 20, n - n // 20, 4 * SURROGATES)
    shifted = [np.roll(e, int(k)) for k in shifts]
    # a residual may be periodic: a shift by one period is then no surrogate
    shifted.sort(key=lambda one: abs(float(one @ e)))
    return np.stack(shifted[:SURROGATES], axis=1)


def _promising(trials: Sequence[list[Scored]], before: Fitted, noise: float) -> list[list[Scored]]:
    """Select the effects that are fitted, from the scores of each effect, the best first."""
    total = float(before.errors.sum())
    least = WORTH_FIT * max(total - noise * before.e.size, 1e-300)
    promising = [scores for scores in trials if total - scores[0].error > least]
    promising.sort(key=lambda scores: scores[0].error)
    chosen = promising[:JOINT_FITS]
    if not chosen:
        return []
    # a small step does not separate an effect from its look-alikes, so these are fitted, too
    first = chosen[0][0].effect
    alike = (*look_alikes(first.name), *first.contains)
    return chosen + [x for x in promising[JOINT_FITS:] if x[0].effect.name in alike]


def _add_plain_starts(
    columns: TrialColumns,
    before: Fitted,
    starts: Sequence[tuple[type[Effect], list[State]]],
) -> None:
    """
    Add to each effect a start beside a sum of plays, converted to the wide law of H.

    A wide H that has absorbed an effect rarely releases it.  A start with a far larger error than
    before is left out.  An effect that is either on or off keeps its start in any case.
    """
    simulator, law = columns.simulator, before.state.law
    if not starts or law is None or law.name == 'plays':
        return
    plays = HysteresisLaw('plays', law.thresholds, law.span)
    # a start needs no exact fit
    enough = WORTH_FIT * before.mean_square
    plain = fit_jointly(simulator, *fit_base(simulator, before.state, plays), enough=enough)
    state = plain.state.with_coefficients(law, law.coefficients(plain.state.hysteresis))
    best = best_trials(columns, plain, [effect for effect, _ in starts])
    most = PLAIN_START * float(before.errors.sum())
    for effect, states in starts:
        one = best.get(effect.name)
        if one is not None and (one.error < most or not one.trial.moves):
            states.append(state.with_effect(started(simulator.rows, one)))


def _contenders(
    simulator: Simulator,
    before: Fitted,
    starts: Sequence[tuple[type[Effect], Sequence[State]]],
    noise: float,
    worth: float,
    tick: Tick,
) -> tuple[list[Fitted], list[str]]:
    """
    Fit the candidates jointly; return those that show, the best first, and warnings.

    A fit ends early if it cannot reach the mean square `worth`.
    """
    contenders, warnings = list[Fitted](), list[str]()
    beside_wide: dict[str, Fitted] = {}
    at, least, done = 0.5, before.mean_square, good_enough(simulator.rows, noise)
    is_visible = cache(lambda fitted: shows(simulator, fitted, noise))

    def alive() -> None:
        tick(at)

    for i, (effect, states) in enumerate(starts):
        at = 0.5 + 0.5 * i / len(starts)
        alive()
        # a candidate with a small share of the best gain is rarely fitted to the end.  If the best
        # error is below the noise, only candidates with a similar error are its rivals
        goal = min(worth, before.mean_square - WORTH_END * (before.mean_square - least))
        if least < done:
            goal = min(goal, FORM_RATIO * least + done)
        found = fit_starts(simulator, states, partial(_begun, before.base, goal), alive)
        fits = [one for one in found if not isinstance(one, Failure)]
        least = min([least, *(one.mean_square for one in fits)])
        # a ModelError means that a law cannot run with these parameters, which needs no warning
        failures = [one for one in found if isinstance(one, IdentificationError)]
        if fits:
            contenders.append(min(fits, key=lambda f: f.mean_square))
            beside_wide[effect.name] = min(fits[:STARTS], key=lambda f: f.mean_square)
        elif failures:
            warnings.append(f'{effect.name} was not judged: {failures[-1]}')
    contenders.sort(key=lambda c: c.mean_square)
    gains = [before.mean_square - c.mean_square for c in contenders]
    is_shown = False
    # a few iterations cannot rank two candidates with nearly equal errors
    last = max((c.mean_square for c in contenders[:FINAL]), default=0.0)
    level = [c for c in contenders if c.mean_square <= LEVEL * last]
    for i, contender in enumerate(level):
        if is_shown and gains[0] > 0.0 and gains[i] < WORTH_END * gains[0]:
            break
        # a candidate that stays further behind the first is not its rival
        goal = FORM_RATIO * contenders[0].mean_square + done if is_shown else worth
        try:
            fitted = contenders[i] = _to_the_end(simulator, contender, noise, goal, alive)
            is_shown, other = is_visible(fitted), beside_wide[contender.name]
            if other is not contender and not (is_shown and fitted.mean_square < done):
                # a few iterations cannot rank the two bases
                near = AHEAD * fitted.mean_square
                goal = min(goal, near) if is_shown else goal
                other = _to_the_end(simulator, other, noise, goal, alive)
                ahead = near < other.mean_square
                if not (ahead and is_shown) and is_visible(other):
                    contenders[i], is_shown = other, True
        except (IdentificationError, ModelError) as error:
            warnings.append(f'{contender.name} was fitted in {FIRST} iterations only: {error}')
    contenders = list(filter(is_visible, contenders))
    contenders.sort(key=lambda c: c.mean_square)
    return contenders, warnings


def fit_starts(
    simulator: Simulator,
    states: Sequence[State],
    fit: Callable[[Simulator, State, Callable[[], None]], Fitted],
    tick: Callable[[], None],
) -> list[Fitted | Failure]:
    """
    Fit each state, several at a time; return each fit, or the error of a failed fit.

    `fit` receives a simulator of its own, a state, and a function that it must call between its
    steps.  Meanwhile this thread alone calls `tick`, which may raise `Cancelled`.
    """
    copies = simulator.copies(len(states))
    stopped = Event()

    def alive() -> None:
        if stopped.is_set():
            raise Cancelled('another fit was stopped')

    def share(k: int) -> list[Fitted | Failure]:
        found = list[Fitted | Failure]()
        for state in states[k :: len(copies)]:
            try:
                found.append(fit(copies[k], state, alive))
            except (ModelError, IdentificationError) as error:
                found.append(error)
            except BaseException:
                stopped.set()
                raise
        return found

    with ThreadPoolExecutor(len(copies)) as pool:
        futures = [pool.submit(share, k) for k in range(len(copies))]
        try:
            tick()
            while wait(futures, ASKED).not_done:
                tick()
        except BaseException:
            stopped.set()
            raise
        finally:
            wait(futures)
            for copy in copies[1:]:
                copy.forget()
    # the error that stopped the other fits comes first
    errors = [future.exception() for future in futures]
    for error in sorted(filter(None, errors), key=lambda error: isinstance(error, Cancelled)):
        raise error
    shares = [future.result() for future in futures]
    return [shares[i % len(copies)][i // len(copies)] for i in range(len(states))]


def _begun(
    base: BaseColumns, goal: float, simulator: Simulator, state: State, tick: Callable[[], None]
) -> Fitted:
    """Fit for a few iterations."""
    return fit_jointly(simulator, state, base, iterations=FIRST, goal=goal, tick=tick)


def _to_the_end(
    simulator: Simulator, fitted: Fitted, noise: float, goal: float, tick: Callable[[], None]
) -> Fitted:
    """Repeat a fit with fresh columns of H until the gain is too small to matter."""
    enough, done = least_gain(simulator.rows, noise), good_enough(simulator.rows, noise)
    for _ in range(POLISHING):
        state, before = fitted.state, fitted.mean_square
        base = base_at(simulator, state)
        fitted = fit_jointly(simulator, state, base, enough=enough, goal=goal, tick=tick)
        if fitted.mean_square > (1.0 - WORTH_FIT) * before or fitted.mean_square < done:
            break
    return fitted


def gains_of(rows: Rows, this: Round) -> dict[str, float]:
    """Compute the mean square that each candidate gains, in its trial or in its joint fit."""
    total = float(this.before.errors.sum())
    gains = {name: (total - s.error) / rows.n for name, s in this.best.items()}
    for c in this.contenders:
        gain = this.before.mean_square - c.mean_square
        gains[c.name] = max(gains.get(c.name, gain), gain)
    return gains

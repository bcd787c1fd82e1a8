# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
One round of the search: which candidate lowers the error on data that were not fitted.

Every candidate is tried by finite differences of the whole model, the effect switched slightly
on.  Its columns are scored by what they gain on held-out blocks in addition to all that is in the
model already, against what chance gains on circular-shift surrogates of the residual.  The most
promising ones are fitted together with everything else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import partial
from threading import Event

import numpy as np
from piezo_ident.common.errors import Cancelled, IdentificationError, ModelError
from piezo_ident.diagnosis.fit_steps import BaseColumns
from piezo_ident.diagnosis.joint_fit import base_at, fit_base, fit_jointly, Fitted
from piezo_ident.diagnosis.next_experiment import look_alikes
from piezo_ident.diagnosis.polishing import good_enough, least_gain, POLISHING
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.signature import shows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import State
from piezo_ident.diagnosis.trial_scores import (
    best_trials,
    score_trials,
    Scored,
    started,
    Tick,
    TrialColumns,
)
from piezo_ident.effects import Effect
from piezo_ident.operators.hysteresis_law import HysteresisLaw

#: surrogates of the residual: their largest gain is exceeded by chance in 1 of 17 cases
SURROGATES = 16
#: share that a candidate must gain at its trial to be fitted jointly, and the most of a round
WORTH_FIT, JOINT_FITS = 0.05, 4
#: share of the gain of the best after a few iterations below which a fit is not brought to its end
WORTH_END = 0.5
#: trials of a candidate that a joint fit starts from, its iterations, and how many candidates of a
#: round are fitted to the end
STARTS, FIRST, FINAL = 2, 3, 2
#: ratio to what was left before up to which the trial beside a sum of plays is a start, and ratio
#: beyond which another start, or another candidate, will not come first any more
PLAIN_START, AHEAD, FORM_RATIO = 1.6, 1.6, 4.0
#: ratio to what the last of those leaves up to which another one is fitted to the end, too
LEVEL = 1.05

#: what fails one start, and leaves the others going
Failure = ModelError | IdentificationError
#: how often a caller is asked whether to go on [s]
ASKED = 0.1


@dataclass(frozen=True, eq=False)
class Round:
    """
    One round of the search.

    Attributes
    ----------
    before : Fitted
        What the candidates were added to.
    best : dict of str to Scored
        The best trial of every candidate that could be tried.
    contenders : tuple of Fitted
        Candidates that were fitted jointly with everything else, best first, and show where they
        should.
    chance : dict of str to float
        Mean square that a candidate gains on surrogates of the residual, at best.
    visible : dict of str to float
        Share of a candidate's own columns that a refit of the rest does not swallow.
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
    simulator: Simulator,
    before: Fitted,
    effects: Sequence[type[Effect]],
    columns: TrialColumns,
    noise: float,
    rng: np.random.Generator,
    tick: Tick,
    *,
    goal: float,
) -> Round:
    """
    Score all candidates and fit the best of them jointly.

    `noise` is the mean square of the noise of a row, and `rng` draws the shifts of the surrogates.
    What does not promise to reach the mean square `goal` is not fitted on.
    """
    n = simulator.rows.n
    shifts = rng.integers(n // 20, n - n // 20, 4 * SURROGATES)
    shifted = [np.roll(before.e, int(k)) for k in shifts]
    # of a residual that repeats, a shift by a period is no surrogate
    shifted.sort(key=lambda e: abs(float(e @ before.e)))
    surrogates = np.stack(shifted[:SURROGATES], axis=1)
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
    best = {name: scores[0] for name, scores in trials.items()}
    total = float(before.errors.sum())
    least = WORTH_FIT * max(total - noise * n, 1e-300)
    promising = [scores for scores in trials.values() if total - scores[0].error > least]
    promising.sort(key=lambda scores: scores[0].error)
    chosen = promising[:JOINT_FITS]
    # a small step does not tell from its like what an effect does in full
    alike = look_alikes(chosen[0][0].effect.name) if chosen else ()
    chosen += [scores for scores in promising[JOINT_FITS:] if scores[0].effect.name in alike]
    starts = [
        (
            scores[0].effect,
            # a law that looks best while it is small need not be the one that fits best
            [before.state.with_effect(started(simulator.rows, s)) for s in scores[:STARTS]],
        )
        for scores in chosen
    ]
    _add_plain_starts(simulator, before, starts, columns)
    contenders, warnings = _contenders(simulator, before, starts, noise, goal, tick)
    tick(1.0)
    return Round(
        before=before,
        best=best,
        contenders=tuple(contenders),
        chance=chance,
        visible=visible,
        warnings=tuple(warnings),
    )


def _add_plain_starts(
    simulator: Simulator,
    before: Fitted,
    starts: Sequence[tuple[type[Effect], list[State]]],
    columns: TrialColumns,
) -> None:
    """
    Add the best start of each effect beside a sum of plays, as an H of the wide law.

    A wide H that has made up for an effect hardly lets go of it.  A start that leaves far more
    than there was before is none, but of an effect that is either on or off.
    """
    law = before.state.law
    if not starts or law is None or law.name == 'plays':
        return
    plays = HysteresisLaw('plays', law.thresholds, law.span)
    # it need be no better than a start
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
    Return the candidates that show, fitted jointly, best first, and the fits that failed.

    What will not reach the mean square `worth` is not fitted on.
    """
    contenders, warnings = list[Fitted](), list[str]()
    beside_wide: dict[str, Fitted] = {}
    at, least, done = 0.5, before.mean_square, good_enough(simulator.rows, noise)

    def alive() -> None:
        tick(at)

    for i, (effect, states) in enumerate(starts):
        at = 0.5 + 0.5 * i / len(starts)
        alive()
        # what will not gain a share of the best is hardly one of those fitted to the end, and
        # nothing else is a rival of one that leaves nothing
        goal = min(worth, before.mean_square - WORTH_END * (before.mean_square - least))
        if least < done:
            goal = min(goal, FORM_RATIO * least + done)
        found = fit_starts(simulator, states, partial(_begun, before.base, goal), alive)
        fits = [one for one in found if not isinstance(one, Failure)]
        least = min([least, *(one.mean_square for one in fits)])
        # a law that cannot run with these parameters is a ModelError, and no warning
        failures = [one for one in found if isinstance(one, IdentificationError)]
        if fits:
            contenders.append(min(fits, key=lambda f: f.mean_square))
            beside_wide[effect.name] = min(fits[:STARTS], key=lambda f: f.mean_square)
        elif failures:
            warnings.append(f'{effect.name} was not judged: {failures[-1]}')
    contenders.sort(key=lambda c: c.mean_square)
    gains = [before.mean_square - c.mean_square for c in contenders]
    is_shown = False
    # a few iterations do not tell which of two that are level gets further
    last = max((c.mean_square for c in contenders[:FINAL]), default=0.0)
    level = [c for c in contenders if c.mean_square <= LEVEL * last]
    for i, contender in enumerate(level):
        if is_shown and gains[0] > 0.0 and gains[i] < WORTH_END * gains[0]:
            break
        # one that stays further behind the first is no rival of it
        goal = FORM_RATIO * contenders[0].mean_square + done if is_shown else worth
        try:
            fitted = contenders[i] = _to_the_end(simulator, contender, noise, goal, alive)
            is_shown, other = shows(simulator, fitted, noise), beside_wide[contender.name]
            if other is not contender and not (is_shown and fitted.mean_square < done):
                # a few iterations do not tell which base leads further
                near = AHEAD * fitted.mean_square
                goal = min(goal, near) if is_shown else goal
                other = _to_the_end(simulator, other, noise, goal, alive)
                ahead = near < other.mean_square
                if shows(simulator, other, noise) and not (ahead and is_shown):
                    contenders[i], is_shown = other, True
        except IdentificationError as error:
            warnings.append(f'{contender.name} was fitted in {FIRST} iterations only: {error}')
    contenders = [c for c in contenders if shows(simulator, c, noise)]
    contenders.sort(key=lambda c: c.mean_square)
    return contenders, warnings


def fit_starts(
    simulator: Simulator,
    states: Sequence[State],
    fit: Callable[[Simulator, State, Callable[[], None]], Fitted],
    tick: Callable[[], None],
) -> list[Fitted | Failure]:
    """
    Return what a fit makes of each state, side by side, or why it failed.

    The fit is given a simulator that no other fit uses, a state, and what it has to call between
    its steps.  `tick` is called meanwhile, by this thread alone, and may raise `Cancelled`.
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
    # the one that stopped the others says why
    errors = [future.exception() for future in futures]
    for error in sorted(filter(None, errors), key=lambda error: isinstance(error, Cancelled)):
        raise error
    shares = [future.result() for future in futures]
    return [shares[i % len(copies)][i // len(copies)] for i in range(len(states))]


def _begun(
    base: BaseColumns, goal: float, simulator: Simulator, state: State, tick: Callable[[], None]
) -> Fitted:
    """Return a fit after a few steps."""
    return fit_jointly(simulator, state, base, iterations=FIRST, goal=goal, tick=tick)


def _to_the_end(
    simulator: Simulator, fitted: Fitted, noise: float, goal: float, tick: Callable[[], None]
) -> Fitted:
    """Return a fit with fresh columns of H, as long as that makes a difference that shows."""
    enough, done = least_gain(simulator.rows, noise), good_enough(simulator.rows, noise)
    for _ in range(POLISHING):
        state, before = fitted.state, fitted.mean_square
        base = base_at(simulator, state)
        fitted = fit_jointly(simulator, state, base, enough=enough, goal=goal, tick=tick)
        if fitted.mean_square > (1.0 - WORTH_FIT) * before or fitted.mean_square < done:
            break
    return fitted


def gains_of(rows: Rows, this: Round) -> dict[str, float]:
    """Return the mean square that each candidate of a round gains, tried or fitted jointly."""
    total = float(this.before.errors.sum())
    gains = {name: (total - s.error) / rows.n for name, s in this.best.items()}
    for c in this.contenders:
        gain = this.before.mean_square - c.mean_square
        gains[c.name] = max(gains.get(c.name, gain), gain)
    return gains

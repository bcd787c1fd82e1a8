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
from dataclasses import dataclass
from functools import partial

import numpy as np
from piezo_ident.common.errors import IdentificationError
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.fit_steps import BaseColumns
from piezo_ident.diagnosis.joint_fit import base_at, fit_base, fit_jointly, Fitted
from piezo_ident.diagnosis.next_experiment import look_alikes
from piezo_ident.diagnosis.polishing import good_enough, least_gain
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.signature import follows_motion, has_place, shows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.starts import Failure, fit_starts
from piezo_ident.diagnosis.state import State
from piezo_ident.diagnosis.trial_scores import best_trials, score_trials, Scored, started, Tick
from piezo_ident.effects import Effect, find_effect
from piezo_ident.operators.hysteresis_law import HysteresisLaw


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


@dataclass(frozen=True, eq=False)
class Selected:
    """
    Result of a forward selection.

    Attributes
    ----------
    rounds, taken : tuple of Round
        All, and those whose best contender was added.
    fitted : Fitted
        The fit at the end.
    bent : Round or None
        What an effect that bent G would leave, where a linear change was preferred.
    left_out : frozenset of str
        Effects that were not tried.
    imitated : Round or None
        Effects that follow the path of the command alone, beside plays.
    linear : tuple of str
        What goes with the speed, best first, and does half of what a retuned G does, where that
        does the larger part and no effect fits its law.
    """

    rounds: tuple[Round, ...]
    taken: tuple[Round, ...]
    fitted: Fitted
    bent: Round | None
    left_out: frozenset[str]
    imitated: Round | None = None
    linear: tuple[str, ...] = ()


def search_round(
    simulator: Simulator,
    before: Fitted,
    effects: Sequence[type[Effect]],
    lines: Sequence[float],
    noise: float,
    rng: np.random.Generator,
    tick: Tick,
    *,
    promise: float,
    worth: float,
) -> Round:
    """
    Score all candidates and fit the best of them jointly.

    `lines` are those in the residual [Hz], `noise` is the mean square of the noise of a row, and
    `rng` draws the shifts of the surrogates.  `promise` and `worth` are shares of what is left
    that a candidate must gain at its trial, and has to reach to be fitted on.
    """
    n = simulator.rows.n
    shifts = rng.integers(n // 20, n - n // 20, 4 * criteria.SURROGATES)
    shifted = [np.roll(before.e, int(k)) for k in shifts]
    # of a residual that repeats, a shift by a period is no surrogate
    shifted.sort(key=lambda e: abs(float(e @ before.e)))
    surrogates = np.stack(shifted[: criteria.SURROGATES], axis=1)
    trials: dict[str, list[Scored]] = {}
    chance: dict[str, float] = {}
    visible: dict[str, float] = {}
    for scored in score_trials(
        simulator, before, effects, lines, surrogates, lambda share: tick(0.5 * share)
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
    least = promise * max(total - noise * n, 1e-300)
    promising = [scores for scores in trials.values() if total - scores[0].error > least]
    promising.sort(key=lambda scores: scores[0].error)
    chosen = promising[: criteria.JOINT_FITS]
    # a small step does not tell from its like what an effect does in full
    alike = look_alikes(chosen[0][0].effect.name) if chosen else ()
    chosen += [
        scores for scores in promising[criteria.JOINT_FITS :] if scores[0].effect.name in alike
    ]
    starts = [
        (
            scores[0].effect,
            # a law that looks best while it is small need not be the one that fits best
            [
                before.state.with_effect(started(simulator.rows, s))
                for s in scores[: criteria.STARTS]
            ],
        )
        for scores in chosen
    ]
    _add_plain_starts(simulator, before, starts, lines)
    goal = before.mean_square - worth * max(before.mean_square - noise, 0.0)
    contenders, warnings = _contenders(simulator, before, starts, noise, goal, tick)
    tick(1.0)
    return Round(
        before=before,
        best=best,
        contenders=tuple(_simplest_first(contenders, noise)),
        chance=chance,
        visible=visible,
        warnings=tuple(warnings),
    )


def _add_plain_starts(
    simulator: Simulator,
    before: Fitted,
    starts: Sequence[tuple[type[Effect], list[State]]],
    lines: Sequence[float],
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
    enough = criteria.WORTH_FIT * before.mean_square
    plain = fit_jointly(simulator, *fit_base(simulator, before.state, plays), enough=enough)
    state = plain.state.with_coefficients(law, law.coefficients(plain.state.hysteresis))
    best = best_trials(simulator, plain, [effect for effect, _ in starts], lines)
    most = criteria.PLAIN_START * float(before.errors.sum())
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
        goal = min(worth, before.mean_square - criteria.WORTH_END * (before.mean_square - least))
        if least < done:
            goal = min(goal, criteria.FORM_RATIO * least + done)
        found = fit_starts(simulator, states, partial(_begun, before.base, goal), alive)
        fits = [one for one in found if not isinstance(one, Failure)]
        least = min([least, *(one.mean_square for one in fits)])
        # a law that cannot run with these parameters is a ModelError, and no warning
        failures = [one for one in found if isinstance(one, IdentificationError)]
        if fits:
            contenders.append(min(fits, key=lambda f: f.mean_square))
            beside_wide[effect.name] = min(fits[: criteria.STARTS], key=lambda f: f.mean_square)
        elif failures:
            warnings.append(f'{effect.name} was not judged: {failures[-1]}')
    contenders.sort(key=lambda c: c.mean_square)
    gains = [before.mean_square - c.mean_square for c in contenders]
    is_shown = False
    # a few iterations do not tell which of two that are level gets further
    last = max((c.mean_square for c in contenders[: criteria.FINAL]), default=0.0)
    level = [c for c in contenders if c.mean_square <= criteria.LEVEL * last]
    for i, contender in enumerate(level):
        if is_shown and gains[0] > 0.0 and gains[i] < criteria.WORTH_END * gains[0]:
            break
        # one that stays further behind the first is no rival of it
        goal = criteria.FORM_RATIO * contenders[0].mean_square + done if is_shown else worth
        try:
            fitted = contenders[i] = _to_the_end(simulator, contender, noise, goal, alive)
            is_shown, other = shows(simulator, fitted, noise), beside_wide[contender.name]
            if other is not contender and not (is_shown and fitted.mean_square < done):
                # a few iterations do not tell which base leads further
                near = criteria.AHEAD * fitted.mean_square
                goal = min(goal, near) if is_shown else goal
                other = _to_the_end(simulator, other, noise, goal, alive)
                ahead = near < other.mean_square
                if shows(simulator, other, noise) and not (ahead and is_shown):
                    contenders[i], is_shown = other, True
        except IdentificationError as error:
            warnings.append(
                f'{contender.name} was fitted in {criteria.FIRST} iterations only: {error}'
            )
    contenders = [c for c in contenders if shows(simulator, c, noise)]
    contenders.sort(key=lambda c: c.mean_square)
    return contenders, warnings


def _begun(
    base: BaseColumns, goal: float, simulator: Simulator, state: State, tick: Callable[[], None]
) -> Fitted:
    """Return a fit after a few steps."""
    return fit_jointly(simulator, state, base, iterations=criteria.FIRST, goal=goal, tick=tick)


def _to_the_end(
    simulator: Simulator, fitted: Fitted, noise: float, goal: float, tick: Callable[[], None]
) -> Fitted:
    """Return a fit with fresh columns of H, as long as that makes a difference that shows."""
    enough, done = least_gain(simulator.rows, noise), good_enough(simulator.rows, noise)
    for _ in range(criteria.POLISHING):
        state, before = fitted.state, fitted.mean_square
        base = base_at(simulator, state)
        fitted = fit_jointly(simulator, state, base, enough=enough, goal=goal, tick=tick)
        if fitted.mean_square > (1.0 - criteria.WORTH_FIT) * before or fitted.mean_square < done:
            break
    return fitted


def _simplest_first(contenders: list[Fitted], noise: float) -> list[Fitted]:
    """Move the effect with the fewest parameters to the front of those that fit as well."""
    if not contenders:
        return contenders
    limit = criteria.SIMPLER * max(contenders[0].mean_square - noise, 0.0) + noise
    good = [c for c in contenders if c.mean_square <= limit]
    simplest = min(good, key=lambda c: len(c.parameters))
    return [simplest, *(c for c in contenders if c is not simplest)]


# -- is it an effect? ----------------------------------------------------------------------------


def takes(
    rows: Rows,
    this: Round,
    before: float,
    noise: float,
    explainable: float,
    smallest: float,
    *,
    first: bool,
) -> bool:
    """
    Return whether the best contender of a round is an effect, the `first` one or a further one.

    `before` is the mean square that is left without it and `noise` that of the noise of a row,
    `explainable` what there was to be explained before anything was added, `smallest` the least
    size [% of stroke].
    """
    best = this.contenders[0]
    # nothing is gained below the noise
    gain, left = before - max(best.mean_square, noise), max(before - noise, 1e-300)
    if rows.percent(gain) < smallest or gain < criteria.LEAST_GAIN * explainable:
        return False
    if _may_be_unseen(rows, this):
        return False
    # what follows time alone fits a shifted residual as well; its lines and trends have tests
    # of their own
    chance = 0.0 if find_effect(best.name).time_driven else this.chance.get(best.name, 0.0)
    if gain < criteria.BEYOND_CHANCE * chance:
        return False
    if gain < (criteria.ADDED if first else criteria.FURTHER) * left:
        return False
    # what shows where it alone acts has no need of a proof by all kinds of excitation
    return has_place(best.name) or not _harms(rows, this.before, best)


def _may_be_unseen(rows: Rows, this: Round) -> bool:
    """
    Return whether the best contender is a gain that wanders where creep or drift gains more.

    These were dropped, since they do not show at rest.  A record that hardly rests shows nothing
    of them there, and a gain of many values follows what they do to the motion.
    """
    if not follows_motion(this.contenders[0].name):
        return False
    known = {c.name for c in this.contenders}
    unseen = [
        g for name, g in gains_of(rows, this).items() if has_place(name) and name not in known
    ]
    return max(unseen, default=0.0) > this.gain


def stands_out(rows: Rows, this: Round) -> bool:
    """
    Return whether the best contender of a round gains far more than any other candidate.

    A hysteresis that does not fit leaves something of which many effects explain a part, and none
    much more than the next.  What follows the path of the command, is a law of H itself, or was
    tried beside a G that was not retuned, stands out too easily.
    """
    before, best = this.before, find_effect(this.contenders[0].name)
    if not before.state.retuning or best.rate_independent or best.slot == 'hysteresis':
        return False
    others = [gain for name, gain in gains_of(rows, this).items() if name != best.name]
    most = max(others, default=0.0)
    return this.gain >= criteria.STANDS_OUT * most


def gains_of(rows: Rows, this: Round) -> dict[str, float]:
    """Return the mean square that each candidate of a round gains, tried or fitted jointly."""
    total = float(this.before.errors.sum())
    gains = {name: (total - s.error) / rows.n for name, s in this.best.items()}
    for c in this.contenders:
        gain = this.before.mean_square - c.mean_square
        gains[c.name] = max(gains.get(c.name, gain), gain)
    return gains


def _harms(rows: Rows, before: Fitted, after: Fitted) -> bool:
    """Return whether what an effect costs some kinds of excitation is much of what it gains."""
    change = np.bincount(rows.group, after.errors - before.errors)
    return bool(change[change > 0.0].sum() > -criteria.HARM * change.sum())

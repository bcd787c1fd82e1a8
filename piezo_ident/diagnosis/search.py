# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Run one round of the search: add each candidate effect in turn to one fit.

Linear trials (`trial_scores`) score the effects on held-out blocks.  The best `JOINT_FITS` effects
and look-alikes of the best are fitted jointly with H, for `FIRST` iterations.  The best go on.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cache, partial
from operator import attrgetter
from threading import Event

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import Cancelled
from piezo_ident.diagnosis.criteria import SMALLEST_EFFECT
from piezo_ident.diagnosis.joint_fit import fit_base, fit_jointly, Fitted, POLISHING, tried, Until
from piezo_ident.diagnosis.next_experiment import look_alikes
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import State
from piezo_ident.diagnosis.trial_scores import (
    score_trials,
    Scored,
    shows,
    started,
    Tick,
    TrialColumns,
)
from piezo_ident.effects import Effect
from piezo_ident.operators.hysteresis_law import HysteresisLaw

#: number of surrogates (shifted residuals): chance exceeds all their gains in about 1 of 17 cases
SURROGATES = 16
#: share of the error that a trial must gain for a joint fit, and most joint fits in a round
WORTH_FIT, JOINT_FITS = 0.05, 4
#: a fit is stopped early if it gains a smaller share of the best gain after a few iterations
WORTH_END = 0.5
#: trials of a candidate that start a joint fit, iterations of this fit, and candidates of a round
#: that are fitted to the end
STARTS, FIRST, FINAL = 2, 3, 2
#: largest errors that are followed, over another error: of a start beside plays, over the error
#: before; of another start, over the best start; of a candidate, over the best candidate
PLAIN_START, AHEAD, FORM_RATIO = 1.6, 1.6, 4.0
#: a further candidate is fitted to the end up to this multiple of the error of the last one
LEVEL = 1.05
#: a fit ends after a step that gains less than this share of the smaller of two mean squares: of
#: the noise, and of the smallest effect
OF_LEAST = 0.01
#: meaningless difference, rms in % of stroke: weights of H describe no stage more exactly
INDISTINCT = 0.01
#: interval at which a caller may stop the search [s]
ASKED = 0.1
#: a candidate after a few iterations: its best fit, and its best fit from a wide H
_ShortFits = tuple[Fitted, Fitted]
_error, _by_error = attrgetter('mean_square'), attrgetter('error')


@dataclass(frozen=True, eq=False)
class Round:
    """
    One round of the search.

    Attributes
    ----------
    before : Fitted
        The fit to which the candidates were added.
    gains : dict of str to float
        Mean square that each possible candidate gains, in its best trial or in its joint fit.
    contenders : tuple of Fitted
        Candidates after the joint fit that pass `trial_scores.shows`, ordered by error.
    chance : dict of str to float
        Largest mean square that a candidate gains on surrogates of the residual.
    visible : dict of str to float
        Share of the columns of a candidate that a refit of the rest cannot imitate.
    warnings : tuple of str
        Candidates whose joint fit failed.
    """

    before: Fitted
    gains: dict[str, float]
    contenders: tuple[Fitted, ...]
    chance: dict[str, float]
    visible: dict[str, float]
    warnings: tuple[str, ...]


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
    whole, half = float(before.errors.sum()), lambda share: tick(0.5 * share)
    every: dict[str, list[Scored]] = {}
    for scored in score_trials(columns, before, effects, surrogates, half):
        every.setdefault(scored.effect.name, []).append(scored)
    possible = {name: [s for s in own if s.error < np.inf] for name, own in every.items()}
    trials = {name: sorted(own, key=_by_error) for name, own in possible.items() if own}
    # the trial with the best small step may not be the trial with the best fit
    starts = {
        scores[0].effect: [
            before.state.with_effect(started(columns.rows, s)) for s in scores[:STARTS]
        ]
        for scores in _promising(list(trials.values()), whole, noise * n)
    }
    _add_plain_starts(columns, before, starts)
    fits = _JointFits(columns.simulator, before, noise, goal, tick)
    contenders = fits.full(fits.short(starts))
    tick(1.0)
    gains = {name: (whole - scores[0].error) / n for name, scores in trials.items()}
    for c in contenders:
        gain = before.mean_square - c.mean_square
        gains[c.name] = max(gains.get(c.name, gain), gain)
    return Round(
        before=before,
        gains=gains,
        contenders=tuple(contenders),
        chance={name: max(s.chance for s in own) / n for name, own in trials.items()},
        visible={name: max(s.visible for s in own) for name, own in every.items()},
        warnings=tuple(fits.warnings),
    )


def _surrogates(e: Array, rng: np.random.Generator) -> Array:
    """Shift a residual circularly, by a twentieth of its length or more; shape (n, surrogates)."""
    n = e.size
    shifts = rng.integers(n // 20, n - n // 20, 4 * SURROGATES)
    shifted = [np.roll(e, int(k)) for k in shifts]
    # a residual may be periodic: a shift by one period is then no surrogate
    shifted.sort(key=lambda one: abs(float(one @ e)))
    return np.stack(shifted[:SURROGATES], axis=1)


def _promising(trials: Sequence[list[Scored]], whole: float, noise: float) -> list[list[Scored]]:
    """Select the effects that are fitted, from the scores of each effect, the best first."""
    least = WORTH_FIT * max(whole - noise, 1e-300)
    promising = [scores for scores in trials if whole - scores[0].error > least]
    promising.sort(key=lambda scores: scores[0].error)
    chosen = promising[:JOINT_FITS]
    if not chosen:
        return []
    # a small step does not separate an effect from its look-alikes, so these are fitted, too
    first = chosen[0][0].effect
    alike = (*look_alikes(first.name), *first.contains)
    return chosen + [x for x in promising[JOINT_FITS:] if x[0].effect.name in alike]


def _add_plain_starts(
    columns: TrialColumns, before: Fitted, starts: Mapping[type[Effect], list[State]]
) -> None:
    """
    Add to each effect a start beside a sum of plays, converted to the wide law of H.

    A wide H that has absorbed an effect rarely releases it.  A start with a far larger error is
    left out, unless the effect is either on or off.
    """
    simulator, law = columns.simulator, before.state.law
    if not starts or law is None or law.name == 'plays':
        return
    plays = HysteresisLaw('plays', law.thresholds, law.span)
    # a start needs no exact fit
    until = Until(enough=WORTH_FIT * before.mean_square)
    plain = fit_jointly(simulator, *fit_base(simulator, before.state, plays), until=until)
    state = plain.state.with_coefficients(law, law.coefficients(plain.state.hysteresis))
    scores = score_trials(columns, plain, list(starts), np.zeros((columns.rows.n, 0)))
    possible = sorted((s for s in scores if s.error < np.inf), key=_by_error)
    most = PLAIN_START * float(before.errors.sum())
    for effect, states in starts.items():
        one = next((s for s in possible if s.effect is effect), None)
        if one is not None and (one.error < most or not one.trial.moves):
            states.append(state.with_effect(started(simulator.rows, one)))


class _JointFits:
    """
    Joint fits of the candidates of a round: short fits of all, then full fits of the best.

    A fit ends early if it cannot reach the mean square `worth`.
    """

    def __init__(
        self, simulator: Simulator, before: Fitted, noise: float, worth: float, tick: Tick
    ) -> None:
        self._simulator, self._before, self._worth, self._tick = simulator, before, worth, tick
        self._enough = OF_LEAST * min(noise, simulator.rows.square(SMALLEST_EFFECT))
        #: mean square below which a residual cannot be separated from the noise
        self._done = noise + simulator.rows.square(INDISTINCT)
        self._shows = cache(lambda fitted: shows(simulator, fitted, noise))
        self._share = 0.5
        #: candidates whose fits failed
        self.warnings: list[str] = []

    def _alive(self) -> None:
        self._tick(self._share)

    def short(self, starts: Mapping[type[Effect], Sequence[State]]) -> list[_ShortFits]:
        """Fit all starts of each effect for a few iterations; the best effect comes first."""
        whole = least = self._before.mean_square
        found = list[_ShortFits]()
        for i, (effect, states) in enumerate(starts.items()):
            self._share = 0.5 + 0.5 * i / len(starts)
            self._alive()
            # a candidate with a small share of the best gain is rarely fitted to the end.  If the
            # best error is below the noise, only candidates with a similar error are its rivals
            goal = min(self._worth, whole - WORTH_END * (whole - least))
            if least < self._done:
                goal = min(goal, FORM_RATIO * least + self._done)
            begin = partial(self._begin, Until(FIRST, goal=goal))
            fits = [one for one in fit_states(self._simulator, states, begin, self._alive) if one]
            least = min([least, *map(_error, fits)])
            if fits:
                found.append((min(fits, key=_error), min(fits[:STARTS], key=_error)))
            else:
                self.warnings.append(f'{effect.name} was not judged: its fits fail on these data')
        return sorted(found, key=lambda one: _error(one[0]))

    def _begin(
        self, until: Until, own: Simulator, state: State, tick: Callable[[], None]
    ) -> Fitted:
        return fit_jointly(own, state, self._before.base, until=until, tick=tick)

    def full(self, short: Sequence[_ShortFits]) -> list[Fitted]:
        """Fit the best candidates to the end; return the candidates that show, the best first."""
        found = [fitted for fitted, _ in short]
        gains = [self._before.mean_square - _error(one) for one in found]
        # a few iterations cannot rank two candidates with nearly equal errors
        level = LEVEL * max(map(_error, found[:FINAL]), default=0.0)
        is_shown = False
        for i, (short_fit, other) in enumerate(short):
            is_far = is_shown and 0.0 < gains[0] and gains[i] < WORTH_END * gains[0]
            if is_far or _error(short_fit) > level:
                break
            # a candidate that stays further behind the first is not its rival
            goal = FORM_RATIO * _error(found[0]) + self._done if is_shown else self._worth
            fitted = tried(self._polished, short_fit, goal)
            if fitted is None:
                self.warnings.append(
                    f'{short_fit.name} was fitted in {FIRST} iterations only: the fit fails then'
                )
                continue
            found[i], is_shown = fitted, self._shows(fitted)
            if other is short_fit or (is_shown and _error(fitted) < self._done):
                continue
            # a few iterations cannot rank the two bases
            near = AHEAD * _error(fitted)
            wide = tried(self._polished, other, min(goal, near) if is_shown else goal)
            is_behind = wide is None or (is_shown and near < _error(wide))
            if wide is not None and not is_behind and self._shows(wide):
                found[i], is_shown = wide, True
        return sorted(filter(self._shows, found), key=_error)

    def _polished(self, fitted: Fitted, goal: float) -> Fitted:
        """Repeat a fit with fresh columns of H until the gain is too small to matter."""
        until = Until(enough=self._enough, goal=goal)
        for _ in range(POLISHING):
            before = fitted.mean_square
            fitted = fit_jointly(self._simulator, fitted.state, until=until, tick=self._alive)
            if _error(fitted) > (1.0 - WORTH_FIT) * before or _error(fitted) < self._done:
                break
        return fitted


def fit_states(
    simulator: Simulator,
    states: Sequence[State],
    fit: Callable[[Simulator, State, Callable[[], None]], Fitted],
    tick: Callable[[], None],
) -> list[Fitted | None]:
    """
    Fit each state, several at a time; return each fit, or None if it fails.

    `fit` receives a simulator of its own, a state, and a function that it must call between its
    steps.  This thread alone calls `tick`, which may raise `Cancelled`.
    """
    copies = simulator.copies(len(states))
    stopped = Event()

    def alive() -> None:
        if stopped.is_set():
            raise Cancelled('another fit was stopped')

    def share(k: int) -> list[Fitted | None]:
        try:
            return [tried(fit, copies[k], state, alive) for state in states[k :: len(copies)]]
        except BaseException:
            stopped.set()
            raise

    with ThreadPoolExecutor(len(copies)) as pool:
        futures = [pool.submit(share, k) for k in range(len(copies))]
        try:
            tick()
            while wait(futures, ASKED).not_done:
                tick()
        finally:
            stopped.set()
            wait(futures)
            for copy in copies[1:]:
                copy.forget()
    # the error that stopped the other fits comes first
    errors = [future.exception() for future in futures]
    for error in sorted(filter(None, errors), key=lambda error: isinstance(error, Cancelled)):
        raise error
    shares = [future.result() for future in futures]
    return [shares[i % len(copies)][i // len(copies)] for i in range(len(states))]

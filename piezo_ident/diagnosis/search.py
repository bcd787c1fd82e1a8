# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
One round of the search: which candidate lowers the error on data that were not fitted.

A round scores every candidate on the residual and fits the most promising ones together with
everything else.  What candidates gain on circular-shift surrogates of the residual is what chance
gains.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.common.errors import IdentificationError, ModelError
from piezo_ident.diagnosis.candidates import score_trials, Scored, started, Tick
from piezo_ident.diagnosis.criteria import JOINT_FITS, SIMPLER, SURROGATES, WORTH_FIT
from piezo_ident.diagnosis.joint_fit import base_at, fit_jointly, Fitted
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.effects import Effect

__all__ = ['Contender', 'Round', 'drop_needless', 'polished', 'search_round']

#: iterations of the first joint fit of a candidate, and how many are fitted to the end
FIRST, FINAL = 3, 2
#: trials of a candidate that a fit starts from
STARTS = 2
#: passes with fresh columns at the end, at most, and the gain that makes another worth it
POLISHING, POLISH = 6, 0.02


@dataclass(frozen=True, eq=False)
class Contender:
    """
    A candidate that was fitted together with everything else.

    Attributes
    ----------
    effect : type of Effect
    fitted : Fitted
    """

    effect: type[Effect]
    fitted: Fitted

    @property
    def name(self) -> str:
        """The effect's name."""
        return self.effect.name


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
    contenders : tuple of Contender
        Those that were fitted jointly, best first.
    chance : dict of str to float
        Mean square that a candidate gains on surrogates of the residual, at best.
    visible : dict of str to float
        Share of a candidate's own columns that a refit of the rest does not swallow.
    warnings : tuple of str
        Candidates whose joint fit failed, and why.
    """

    before: Fitted
    best: dict[str, Scored]
    contenders: tuple[Contender, ...]
    chance: dict[str, float]
    visible: dict[str, float]
    warnings: tuple[str, ...] = ()


def search_round(
    simulator: Simulator,
    before: Fitted,
    effects: Sequence[type[Effect]],
    lines: Sequence[float],
    noise: float,
    rng: np.random.Generator,
    tick: Tick,
) -> Round:
    """
    Score all candidates and fit the best of them jointly.

    Parameters
    ----------
    effects : sequence of type of Effect
        Candidates.
    lines : sequence of float
        Lines in the residual [Hz].
    noise : float
        Mean square of the noise of a row.
    rng : numpy.random.Generator
        Draws the shifts of the surrogates.
    """
    n = simulator.rows.n
    shifts = rng.integers(n // 20, n - n // 20, SURROGATES)
    surrogates = np.stack([np.roll(before.e, int(k)) for k in shifts], axis=1)
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
        scores.sort(key=_error)
    best = {name: scores[0] for name, scores in trials.items()}
    total = float(before.errors.sum())
    least = WORTH_FIT * max(total - noise * n, 1e-300)
    promising = [s for s in sorted(best.values(), key=_error) if total - s.errors.sum() > least]
    contenders, warnings = _contenders(simulator, before, promising[:JOINT_FITS], trials, tick)
    tick(1.0)
    return Round(
        before=before,
        best=best,
        contenders=tuple(_simplest_first(contenders, noise)),
        chance=chance,
        visible=visible,
        warnings=tuple(warnings),
    )


def _error(scored: Scored) -> float:
    return float(scored.errors.sum())


def _contenders(
    simulator: Simulator,
    before: Fitted,
    promising: Sequence[Scored],
    trials: dict[str, list[Scored]],
    tick: Tick,
) -> tuple[list[Contender], list[str]]:
    """Return the promising candidates fitted jointly, best first, and the fits that failed."""
    contenders, warnings = [], []
    at = 0.5

    def alive() -> None:
        tick(at)

    for i, scored in enumerate(promising):
        at = 0.5 + 0.5 * i / len(promising)
        alive()
        fits, failure = [], ''
        # a law that looks best while it is small need not be the one that fits best
        for start in trials[scored.effect.name][:STARTS]:
            state = before.state.with_effect(started(simulator.rows, start))
            try:
                fits.append(
                    fit_jointly(simulator, state, before.base, iterations=FIRST, tick=alive)
                )
            except ModelError:
                # the law cannot run with these parameters
                continue
            except IdentificationError as error:
                failure = f'{scored.effect.name} was not judged: {error}'
        if fits:
            fitted = min(fits, key=lambda f: f.mean_square)
            contenders.append(Contender(scored.effect, fitted))
        elif failure:
            warnings.append(failure)
    contenders.sort(key=lambda c: c.fitted.mean_square)
    for i, contender in enumerate(contenders[:FINAL]):
        state = contender.fitted.state
        try:
            better = fit_jointly(simulator, state, base_at(simulator, state), tick=alive)
        except IdentificationError as error:
            warnings.append(f'{contender.name} was fitted in {FIRST} iterations only: {error}')
        else:
            contenders[i] = replace(contender, fitted=better)
    contenders.sort(key=lambda c: c.fitted.mean_square)
    return contenders, warnings


def _simplest_first(contenders: list[Contender], noise: float) -> list[Contender]:
    """Move the effect with the fewest parameters to the front of those that fit as well."""
    if not contenders:
        return contenders
    limit = SIMPLER * max(contenders[0].fitted.mean_square - noise, 0.0) + noise
    good = [c for c in contenders if c.fitted.mean_square <= limit]
    simplest = min(good, key=lambda c: len(c.fitted.parameters))
    return [simplest, *(c for c in contenders if c is not simplest)]


def drop_needless(
    simulator: Simulator, fitted: Fitted, least: float
) -> tuple[Fitted, tuple[int, ...]]:
    """
    Take out effects that the last one has made needless.

    Parameters
    ----------
    fitted : Fitted
        Whose last effect stays.
    least : float
        Mean square that an effect must be worth.

    Returns
    -------
    dropped : tuple of int
        Places of the effects that went, falling.
    """
    dropped: list[int] = []
    for i in range(len(fitted.state.effects) - 2, -1, -1):
        rest = tuple(added for k, added in enumerate(fitted.state.effects) if k != i)
        without = fit_jointly(simulator, replace(fitted.state, effects=rest), fitted.base)
        if without.mean_square - fitted.mean_square < least:
            fitted = without
            dropped.append(i)
    return fitted, tuple(dropped)


def polished(
    simulator: Simulator, fitted: Fitted, lines: Sequence[float], tick: Callable[[], None]
) -> Fitted:
    """
    Fit several effects again, each from fresh starts now that the others are known.

    An effect that was found beside others not yet in the model took a law that made up for them.
    """
    for i in range(len(fitted.state.effects)):
        for fresh in _afresh(simulator, fitted, i, lines, tick):
            if fresh.mean_square < fitted.mean_square:
                fitted = fresh
    for _ in range(POLISHING):
        state = fitted.state
        fresh = fit_jointly(simulator, state, base_at(simulator, state), tick=tick)
        if fresh.mean_square > (1.0 - POLISH) * fitted.mean_square:
            break
        fitted = fresh
    return fitted


def _afresh(
    simulator: Simulator,
    fitted: Fitted,
    i: int,
    lines: Sequence[float],
    tick: Callable[[], None],
) -> Iterator[Fitted]:
    """Yield fits in which effect i starts anew, from its best trials beside the others."""
    rows, own = simulator.rows, fitted.state.effects[i]
    others = tuple(added for k, added in enumerate(fitted.state.effects) if k != i)
    state = replace(fitted.state, effects=others)
    rest = fit_jointly(simulator, state, base_at(simulator, state), iterations=2, tick=tick)
    scored = score_trials(simulator, rest, [own.effect], lines, np.zeros((rows.n, 0)))
    trials = sorted((s for s in scored if s.is_possible), key=_error)
    for start in trials[:STARTS]:
        effects = (*others[:i], started(rows, start), *others[i:])
        state = replace(rest.state, effects=effects)
        try:
            yield fit_jointly(simulator, state, fitted.base, tick=tick)
        except (ModelError, IdentificationError):
            # the fit that is there already stays
            continue

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The search: which effects, added one after another, lower the error on data that were not fitted.

A round scores every candidate on the residual, fits the most promising ones together with
everything else, takes the best, and tries whether an earlier one can go.  What random residuals
of the same colour would gain sets the bar.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
import contextlib
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.common.errors import ModelError
from piezo_ident.diagnosis.candidates import score_trials, Scored, started, view_of
from piezo_ident.diagnosis.fit import base_at, fit_jointly, Fitted, ITERATIONS
from piezo_ident.diagnosis.gain import gram_of
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.effects import Effect

__all__ = ['Contender', 'Round', 'Tick', 'afresh', 'drop_needless', 'polished', 'search_round']

#: called with the share of the round that is done; may raise `Cancelled`
Tick = Callable[[float], None]

#: candidates of a round that are fitted jointly, at most, and the share that makes them worth it
JOINT, WORTH = 4, 0.05
#: iterations of their first fit, and how many are fitted to the end
FIRST, FINAL = 3, 2
#: trials of a candidate that a fit starts from
STARTS = 2
#: passes with fresh columns at the end, at most, and the gain that makes another worth it
PASSES, POLISH = 6, 0.02
#: a simpler effect goes first when it leaves no more than this times what the best one leaves
SIMPLER = 1.3
#: turned residuals that say what chance gains
TURNS = 16


@dataclass(frozen=True, eq=False)
class Contender:
    """
    A candidate that was fitted together with everything else.

    Attributes
    ----------
    effect : type of Effect
    scored : Scored
        Its best trial, before the joint fit.
    fitted : Fitted
    """

    effect: type[Effect]
    scored: Scored
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
        Mean square that a candidate gains on residuals that have nothing to do with it, at best.
    visible : dict of str to float
        Share of a candidate's own columns that a refit of the rest does not swallow.
    """

    before: Fitted
    best: dict[str, Scored]
    contenders: tuple[Contender, ...]
    chance: dict[str, float]
    visible: dict[str, float]


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
    simulator : Simulator
    before : Fitted
    effects : sequence of type of Effect
        Candidates.
    lines : sequence of float
        Lines in the residual [Hz].
    noise : float
        Mean square of the noise of a row.
    rng : numpy.random.Generator
        Turns the residuals.
    tick : callable
    """
    rows = simulator.rows
    now = simulator.remember(before.state)
    M = before.J[:, before.free]
    prior = before.prior[before.free]
    turns = rng.integers(rows.n // 20, rows.n - rows.n // 20, TURNS)
    turned = np.stack([np.roll(before.e, int(k)) for k in turns], axis=1)
    base = (M, gram_of(rows, M, before.e), prior)
    trials: dict[str, list[Scored]] = {}
    chance: dict[str, float] = {}
    visible: dict[str, float] = {}
    for scored in score_trials(
        simulator,
        effects,
        view_of(simulator, lines),
        base,
        before.e,
        now,
        turned,
        lambda share: tick(0.5 * share),
    ):
        name = scored.effect.name
        visible[name] = max(visible.get(name, 0.0), scored.visible)
        if not scored.is_possible:
            continue
        chance[name] = max(chance.get(name, 0.0), float(scored.chance.max()) / rows.n)
        trials.setdefault(name, []).append(scored)
    for scores in trials.values():
        scores.sort(key=lambda s: float(s.errors.sum()))
    best = {name: scores[0] for name, scores in trials.items()}
    explainable = max(float(before.errors.sum()) - noise * rows.n, 1e-300)
    ranked = sorted(best.values(), key=lambda s: float(s.errors.sum()))
    promising = [s for s in ranked if before.errors.sum() - s.errors.sum() > WORTH * explainable][
        :JOINT
    ]
    contenders = []

    def alive() -> None:
        tick(at)

    for i, scored in enumerate(promising):
        at = 0.5 + 0.5 * i / len(promising)
        tick(at)
        fits = []
        # a law that looks best while it is small need not be the one that fits best
        for start in trials[scored.effect.name][:STARTS]:
            state = before.state.with_effect(started(rows, start))
            with contextlib.suppress(ModelError):
                fits.append(
                    fit_jointly(simulator, state, before.base, iterations=FIRST, tick=alive)
                )
        if fits:
            fitted = min(fits, key=lambda f: f.mean_square)
            contenders.append(Contender(scored.effect, scored, fitted))
    contenders.sort(key=lambda c: c.fitted.mean_square)
    for i, contender in enumerate(contenders[:FINAL]):
        state = contender.fitted.state
        better = fit_jointly(simulator, state, base_at(simulator, state), tick=alive)
        contenders[i] = replace(contender, fitted=better)
    contenders.sort(key=lambda c: c.fitted.mean_square)
    contenders = _simplest_first(contenders, noise)
    tick(1.0)
    return Round(
        before=before,
        best=best,
        contenders=tuple(contenders),
        chance=chance,
        visible=visible,
    )


def _simplest_first(contenders: list[Contender], noise: float) -> list[Contender]:
    """Move the effect with the fewest parameters to the front of those that fit as well."""
    if not contenders:
        return contenders
    limit = SIMPLER * max(contenders[0].fitted.mean_square - noise, 0.0) + noise
    good = [c for c in contenders if c.fitted.mean_square <= limit]
    simplest = min(good, key=lambda c: len(c.fitted.handles))
    return [simplest, *(c for c in contenders if c is not simplest)]


def drop_needless(
    simulator: Simulator, fitted: Fitted, least: float
) -> tuple[Fitted, tuple[int, ...]]:
    """
    Take out effects that later ones have made needless.

    Parameters
    ----------
    simulator : Simulator
    fitted : Fitted
        Whose last effect stays.
    least : float
        Mean square that an effect must be worth.

    Returns
    -------
    fitted : Fitted
    dropped : tuple of int
        Places of the effects that went.
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

    Parameters
    ----------
    simulator : Simulator
    fitted : Fitted
    lines : sequence of float
        Lines in the residual [Hz].
    tick : callable
    """
    for i in range(len(fitted.state.effects)):
        for fresh in afresh(simulator, fitted, i, lines, tick):
            if fresh.mean_square < fitted.mean_square:
                fitted = fresh
    for _ in range(PASSES):
        state = fitted.state
        fresh = fit_jointly(simulator, state, base_at(simulator, state), tick=tick)
        if fresh.mean_square > (1.0 - POLISH) * fitted.mean_square:
            break
        fitted = fresh
    return fitted


def afresh(
    simulator: Simulator,
    fitted: Fitted,
    i: int,
    lines: Sequence[float],
    tick: Callable[[], None],
    iterations: int = ITERATIONS,
) -> Iterator[Fitted]:
    """
    Yield fits in which one effect starts anew, from its best trials beside the others.

    Parameters
    ----------
    simulator : Simulator
    fitted : Fitted
    i : int
        Place of the effect.
    lines : sequence of float
        Lines in the residual [Hz].
    tick : callable
    iterations : int, optional
        Of each fit.
    """
    rows, own = simulator.rows, fitted.state.effects[i]
    others = tuple(added for k, added in enumerate(fitted.state.effects) if k != i)
    state = replace(fitted.state, effects=others)
    rest = fit_jointly(simulator, state, base_at(simulator, state), iterations=2, tick=tick)
    now = simulator.remember(rest.state)
    M, prior = rest.J[:, rest.free], rest.prior[rest.free]
    base = (M, gram_of(rows, M, rest.e), prior)
    view, nothing = view_of(simulator, lines), np.zeros((rows.n, 0))
    scored = score_trials(simulator, [own.effect], view, base, rest.e, now, nothing)
    trials = [trial for trial in scored if trial.is_possible]
    trials.sort(key=lambda s: float(s.errors.sum()))
    for start in trials[:STARTS]:
        effects = [*others[:i], started(rows, start), *others[i:]]
        state = replace(rest.state, effects=tuple(effects))
        with contextlib.suppress(ModelError):
            yield fit_jointly(simulator, state, fitted.base, iterations=iterations, tick=tick)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Effects that others made needless, and a fresh fit of those that stay."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.joint_fit import base_at, fit_jointly, Fitted
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.starts import Failure, fit_starts
from piezo_ident.diagnosis.state import State
from piezo_ident.diagnosis.trial_scores import score_trials, started


def least_gain(rows: Rows, noise: float) -> float:
    """Return the gain that a step of a fit has to bring, beside a noise; both mean squares."""
    return criteria.OF_LEAST * min(noise, rows.square(criteria.SMALLEST_EFFECT))


def good_enough(rows: Rows, noise: float) -> float:
    """Return below which mean square nothing is left to tell from a noise."""
    return noise + rows.square(criteria.INDISTINCT)


def without_needless(
    simulator: Simulator, fitted: Fitted, least: float, stay: int, last: int = 1
) -> tuple[Fitted, tuple[int, ...]]:
    """
    Take out effects that others have made needless; the first `stay` and the `last` ones stay.

    Each must be worth a mean square of `least`.  Places of those that went come along, falling.
    """
    dropped: list[int] = []
    for i in range(len(fitted.state.effects) - 1 - last, stay - 1, -1):
        state, base = fitted.state.without(i), fitted.base
        if state.only_adds.size < fitted.state.only_adds.size:
            base = base_at(simulator, state)
        # whether it is needed shows before the end
        without = fit_jointly(
            simulator,
            state,
            base,
            enough=criteria.OF_LEAST * least,
            goal=fitted.mean_square + least,
        )
        if without.reached - fitted.mean_square >= least:
            continue
        without = fit_jointly(simulator, without.state, base)
        if without.reached - fitted.mean_square >= least:
            continue
        # what the others make up for by values that cannot be, they do not explain
        if all(a.effect.is_plausible(v) for a in without.state.effects for v in a.values):
            fitted = without
            dropped.append(i)
    return fitted, tuple(dropped)


def polished(
    simulator: Simulator,
    fitted: Fitted,
    lines: Sequence[float],
    noise: float,
    tick: Callable[[], None],
) -> Fitted:
    """
    Fit several effects again, each from fresh starts now that the others are known.

    An effect that was found before others were in the model took a law that made up for them.
    `noise` is the mean square of the noise of a row.
    """
    done = good_enough(simulator.rows, noise)
    least = least_gain(simulator.rows, noise)
    for i in range(len(fitted.state.effects)):
        if fitted.mean_square < done:
            break
        for fresh in _afresh(simulator, fitted, i, lines, least, tick):
            if fresh.mean_square < fitted.mean_square:
                fitted = fresh
    if fitted.mean_square < done:
        return fitted
    return with_fresh_columns(simulator, fitted, tick, enough=least)


def with_fresh_columns(
    simulator: Simulator, fitted: Fitted, tick: Callable[[], None], *, enough: float = 0.0
) -> Fitted:
    """Fit again with the columns of H in the state reached, as long as that gains."""
    for _ in range(criteria.POLISHING):
        state = fitted.state
        fresh = fit_jointly(simulator, state, base_at(simulator, state), enough=enough, tick=tick)
        if fresh.mean_square > (1.0 - criteria.POLISH) * fitted.mean_square:
            break
        fitted = fresh
    return fitted


def _afresh(
    simulator: Simulator,
    fitted: Fitted,
    i: int,
    lines: Sequence[float],
    least: float,
    tick: Callable[[], None],
) -> list[Fitted]:
    """Return fits in which effect i starts again from its best trials."""
    rows, own = simulator.rows, fitted.state.effects[i]
    others = tuple(added for k, added in enumerate(fitted.state.effects) if k != i)
    state = replace(fitted.state, effects=others)
    rest = fit_jointly(simulator, state, base_at(simulator, state), iterations=2, tick=tick)
    scored = score_trials(simulator, rest, [own.effect], lines, np.zeros((rows.n, 0)))
    trials = sorted((s for s in scored if s.is_possible), key=lambda s: s.error)
    starts = [
        replace(rest.state, effects=(*others[:i], started(rows, start), *others[i:]))
        for start in trials[: criteria.STARTS]
    ]

    def fit(alone: Simulator, start: State, alive: Callable[[], None]) -> Fitted:
        goal = fitted.mean_square
        return fit_jointly(alone, start, fitted.base, enough=least, goal=goal, tick=alive)

    # where one fails the fit that is there already stays
    fits = fit_starts(simulator, starts, fit, tick)
    return [one for one in fits if not isinstance(one, Failure)]

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Forward selection: effects are added one after another as long as held-out data gain.

An effect that was there when G was identified has bent G a little.  Unless a linear change is the
larger part of the residual, G is therefore retuned along with the candidates, by a factor
``1 + c_1 (1 - z^-1) + c_2 (1 - z^-1)^2`` and two slow relaxations.  No candidate is chosen for
what that explains.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.common.errors import IdentificationError, ModelError
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.joint_fit import base_at, fit_jointly, Fitted
from piezo_ident.diagnosis.results import DiagnosisSettings
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.search import Round, score_trials, search_round, started
from piezo_ident.diagnosis.simulator import RETUNING, Simulator
from piezo_ident.effects import catalogue, find_effect
from piezo_ident.identification.results import Progress

__all__ = ['ForwardSelection', 'Selected', 'smallest_detectable', 'takes']


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
    """

    rounds: tuple[Round, ...]
    taken: tuple[Round, ...]
    fitted: Fitted
    bent: Round | None
    left_out: frozenset[str]


class ForwardSelection:
    """Effects are added one after another as long as held-out data gain."""

    def __init__(
        self,
        simulator: Simulator,
        lines: Sequence[float],
        noise: float,
        settings: DiagnosisSettings,
        progress: Progress,
    ) -> None:
        self._simulator = simulator
        self._lines = lines
        self._noise = noise
        self._most = settings.most_effects
        self._progress = progress
        self._rng = np.random.default_rng(settings.seed)
        names = settings.effects or tuple(catalogue())
        self._candidates = [find_effect(name) for name in names if name not in settings.without]
        self._have = {setting.name for setting in simulator.model.effects}
        self._count = 0

    def run(self, base: Fitted) -> Selected:
        """Select, from the base model refitted; where nothing is taken the base is the fit."""
        self._base = base
        state = replace(base.state, retuning=(0.0,) * len(RETUNING))
        retuned = fit_jointly(self._simulator, state, base.base)
        explainable = max(base.mean_square - self._noise, 1e-300)
        if base.mean_square - retuned.mean_square < criteria.LINEAR * explainable:
            return self._from(retuned, self._round(retuned))
        # a linear change is the larger part: is it the whole of it?
        linear, bent = self._round(base), None
        if self._left(linear) > self._least:
            bent = self._round(retuned)
        if bent is not None and self._takes(bent, self._beyond_noise(bent.before), first=True):
            if self._left(bent) < criteria.BENT * self._left(linear):
                return self._from(retuned, bent)
            return self._from(base, linear, bent)
        return self._from(base, linear)

    def _takes(self, this: Round, explainable: float, *, first: bool) -> bool:
        rows = self._simulator.rows
        return rows.passes >= criteria.PASSES and takes(
            rows, this, self._noise, explainable, first=first
        )

    @property
    def _least(self) -> float:
        """Mean square of the smallest effect."""
        return (criteria.SMALLEST_EFFECT * self._simulator.rows.stroke / 100.0) ** 2

    def _beyond_noise(self, fitted: Fitted) -> float:
        return max(fitted.mean_square - self._noise, 0.0)

    def _left(self, this: Round) -> float:
        return self._beyond_noise(this.contenders[0] if this.contenders else this.before)

    def _round(self, fitted: Fitted) -> Round:
        have = self._have | {added.name for added in fitted.state.effects}
        candidates = [effect for effect in self._candidates if effect.name not in have]
        done = self._count
        self._count += 1

        def tick(share: float) -> None:
            # most searches end after two or three rounds: the bar nears its end ever slower
            self._progress('candidates', 1.0 - 0.4 ** (done + share))

        return search_round(
            self._simulator, fitted, candidates, self._lines, self._noise, self._rng, tick
        )

    def _from(self, start: Fitted, first: Round, bent: Round | None = None) -> Selected:
        fitted, this = start, first
        rounds, taken = [first], list[Round]()
        explainable = self._beyond_noise(start)
        while self._takes(this, explainable, first=not taken):
            taken.append(this)
            fitted, dropped = _without_needless(self._simulator, this.contenders[0], self._least)
            for i in dropped:
                del taken[i]
            if len(taken) == self._most or fitted.mean_square - self._noise < self._least:
                break
            this = self._round(fitted)
            rounds.append(this)
        if len(fitted.state.effects) > 1:
            fitted = _polished(
                self._simulator, fitted, self._lines, lambda: self._progress('candidates', 0.95)
            )
        self._progress('candidates', 1.0)
        tried = self._have | {effect.name for effect in self._candidates}
        left_out = frozenset(catalogue()) - tried
        if not taken:
            fitted = self._base
        return Selected(tuple(rounds), tuple(taken), fitted, bent, left_out)


# -- is it an effect? ----------------------------------------------------------------------------


def takes(rows: Rows, this: Round, noise: float, explainable: float, *, first: bool) -> bool:
    """
    Return whether the best contender of a round is an effect, the `first` one or a further one.

    `noise` is the mean square of the noise of a row, `explainable` what there was to be explained
    before anything was added.
    """
    if not this.contenders:
        return False
    best = this.contenders[0]
    before, after = this.before.mean_square, best.mean_square
    gain, left = before - after, max(before - noise, 1e-300)
    if rows.percent(gain) < criteria.SMALLEST_EFFECT or gain < criteria.LEAST_GAIN * explainable:
        return False
    # what follows time alone fits a shifted residual as well; its lines and trends have tests
    # of their own
    chance = 0.0 if find_effect(best.name).time_driven else this.chance.get(best.name, 0.0)
    if gain < criteria.BEYOND_CHANCE * chance:
        return False
    if gain < (criteria.ADDED if first else criteria.FURTHER) * left:
        return False
    return not _harms(rows, this.before, best, noise)


def _harms(rows: Rows, before: Fitted, after: Fitted, noise: float) -> bool:
    """Return whether the error of a kind of excitation grows, where it was no trifle."""
    kinds = np.unique(rows.group)
    counts = np.bincount(rows.group[rows.block], minlength=kinds.size)
    one = np.bincount(rows.group, before.errors) / counts
    other = np.bincount(rows.group, after.errors) / counts
    trifle = noise + (criteria.SMALLEST_EFFECT * rows.stroke / 100.0) ** 2
    return bool(np.any(other > criteria.HARM**2 * one + trifle))


def smallest_detectable(
    rows: Rows, base: Fitted, selected: Selected, noise: float
) -> float | None:
    """
    Return the size that a further effect must have to be taken, rms in % of stroke.

    None where the range was passed so rarely that none is taken.
    """
    if rows.passes < criteria.PASSES:
        return None
    # what follows time alone fits any slow residual
    last = selected.rounds[-1].chance
    chance = max((x for n, x in last.items() if not find_effect(n).time_driven), default=0.0)
    share = criteria.FURTHER if selected.taken else criteria.ADDED
    least = max(
        criteria.BEYOND_CHANCE * chance,
        criteria.LEAST_GAIN * (base.mean_square - noise),
        share * (selected.fitted.mean_square - noise),
    )
    return max(criteria.SMALLEST_EFFECT, rows.percent(least))


# -- effects that are there already --------------------------------------------------------------


def _without_needless(
    simulator: Simulator, fitted: Fitted, least: float
) -> tuple[Fitted, tuple[int, ...]]:
    """
    Take out effects that the last one, which stays, has made needless.

    Each must be worth a mean square of `least`.  Places of those that went come along, falling.
    """
    dropped: list[int] = []
    for i in range(len(fitted.state.effects) - 2, -1, -1):
        rest = tuple(added for k, added in enumerate(fitted.state.effects) if k != i)
        without = fit_jointly(simulator, replace(fitted.state, effects=rest), fitted.base)
        if without.mean_square - fitted.mean_square < least:
            fitted = without
            dropped.append(i)
    return fitted, tuple(dropped)


def _polished(
    simulator: Simulator, fitted: Fitted, lines: Sequence[float], tick: Callable[[], None]
) -> Fitted:
    """
    Fit several effects again, each from fresh starts now that the others are known.

    An effect that was found before others were in the model took a law that made up for them.
    """
    for i in range(len(fitted.state.effects)):
        for fresh in _afresh(simulator, fitted, i, lines, tick):
            if fresh.mean_square < fitted.mean_square:
                fitted = fresh
    for _ in range(criteria.POLISHING):
        state = fitted.state
        fresh = fit_jointly(simulator, state, base_at(simulator, state), tick=tick)
        if fresh.mean_square > (1.0 - criteria.POLISH) * fitted.mean_square:
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
    """Yield fits in which effect i starts again from its best trials."""
    rows, own = simulator.rows, fitted.state.effects[i]
    others = tuple(added for k, added in enumerate(fitted.state.effects) if k != i)
    state = replace(fitted.state, effects=others)
    rest = fit_jointly(simulator, state, base_at(simulator, state), iterations=2, tick=tick)
    scored = score_trials(simulator, rest, [own.effect], lines, np.zeros((rows.n, 0)))
    trials = sorted((s for s in scored if s.is_possible), key=lambda s: s.error)
    for start in trials[: criteria.STARTS]:
        effects = (*others[:i], started(rows, start), *others[i:])
        state = replace(rest.state, effects=effects)
        try:
            yield fit_jointly(simulator, state, fitted.base, tick=tick)
        except (ModelError, IdentificationError):
            # the fit that is there already stays
            continue

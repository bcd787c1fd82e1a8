# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The list of candidates: H and G in each way, with each effect, then with one more.

The hysteresis of a piezo is never a sum of plays, and an effect that was there at the
identification has bent H and G.  So effects are tried beside the H that fits best, and with G
retuned, too, where that alone leaves clearly less.  What follows the path of the voltage is in any
H wide enough, so it is tried beside the H as it was given, too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.diagnosis.criteria import ALIKE, LITTLE, RIVALS, SMALLEST_EFFECT, TAKES
from piezo_ident.diagnosis.decision import Candidate, Candidates, change_g
from piezo_ident.diagnosis.earlier_motion import with_earlier_motion
from piezo_ident.diagnosis.joint_fit import base_at, fit_jointly, Fitted
from piezo_ident.diagnosis.refits import law_of, refit_of, with_g
from piezo_ident.diagnosis.search import Round, search_round
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import State
from piezo_ident.diagnosis.trial_scores import TrialColumns
from piezo_ident.effects import Effect, find_effect

#: share of what the best smaller set leaves that a candidate must promise to be fitted on
PROMISING = 0.9
#: sets to which one more effect is added: of one effect, and of more
EXTENDED = 2, 1
#: sets of each size that are tried in all ways of H and G
IN_ALL_WAYS = 3

Tick = Callable[[float], None]


class CandidateSearch:
    """
    Fits the candidates of some data.

    `lines` are those in the residual [Hz], `noise` is the mean square of the noise of a row,
    `missed` what G may miss (`Candidates.missed`), `effects` are the names that may be added.
    """

    def __init__(
        self,
        simulator: Simulator,
        given: State,
        lines: Sequence[float],
        noise: float,
        missed: float,
        effects: Sequence[str],
        rng: np.random.Generator,
        tick: Tick,
    ) -> None:
        self._simulator, self._given, self._rng, self._tick = simulator, given, rng, tick
        self._noise, self._missed = noise, missed
        self._lines = lines
        have = [find_effect(setting.name) for setting in simulator.model.effects]
        knows_path = any(effect.rate_independent for effect in have)
        # a known effect of the path that has changed since would look like another one
        self._effects = [
            effect
            for effect in map(find_effect, effects)
            if not (knows_path and effect.rate_independent)
        ]
        self._count = 0
        #: all searches that were made
        self.rounds: list[Round] = []

    def shown(self, fitted: Fitted, names: Sequence[str]) -> tuple[Fitted, tuple[str, ...]]:
        """
        Return a fit with the effects that tests of their own have shown, and their names.

        They must be as large as any effect, and no side effect of one another's form.
        """
        least = self._simulator.rows.square(SMALLEST_EFFECT)
        found = list[str]()
        for name in names:
            this = self._round(fitted, [find_effect(name)], np.inf)
            if this.contenders and fitted.mean_square - this.contenders[0].mean_square >= least:
                fitted = this.contenders[0]
                found.append(name)
        return fitted, tuple(found)

    def of(self, plays: Fitted, wide: Fitted, most: int) -> Candidates:
        """Return all candidates with up to `most` effects beside those of two refits."""
        candidates = self._ways(plays, wide)
        least = min(map(candidates.left, candidates.all))
        path = [effect for effect in self._effects if effect.rate_independent]
        best = _best_h(candidates)
        for base in _worth_searching(candidates):
            some, goal = self._effects, PROMISING * least
            if base is not best and not base.retunes:
                # it need do most of what a refit does
                some, goal = path, least + TAKES * max(candidates.left(base) - least, 0.0)
            candidates = candidates.and_these(self._with_each(base, some, goal))
        candidates = self._in_all_ways(candidates, 1)
        for size in range(1, most):
            bases = self._worth_extending(candidates, size)
            if not bases:
                break
            for base in bases:
                goal = PROMISING * candidates.left(base)
                more = self._with_each(base, self._effects, goal)
                candidates = candidates.and_these(more)
            candidates = self._in_all_ways(candidates, size + 1)
        return candidates

    def _in_all_ways(self, candidates: Candidates, size: int) -> Candidates:
        """
        Return the candidates with the best sets of a size in all ways of H and G.

        What a wide H made up for an effect is in its way under other motion, and what effects and
        plays leave together need not be the like of another effect.
        """
        sets = [s for s in candidates.sets if len(s) == size]
        laws = {c.way: law_of(c.fitted) for c in candidates.of(()) if c.way != 'given'}
        for effects in sets[:IN_ALL_WAYS]:
            best = candidates.of(effects)[0]
            have = {c.way for c in candidates.of(effects)}
            state = candidates.as_given.fitted.state.with_effects_of(best.fitted.state)
            # a way that leaves more than the best one does not count
            goal = np.inf if effects == sets[0] else self._noise + candidates.left(best)
            more = []
            if 'given' not in have:
                fitted = fit_jointly(self._simulator, state, base_at(self._simulator, state))
                fitted = with_earlier_motion(self._simulator, fitted)
                state = fitted.state
                more.append(replace(best, way='given', fitted=fitted))
            for way, law in laws.items():
                if way not in have:
                    fitted = refit_of(self._simulator, state, law, goal)
                    more.append(replace(best, way=way, fitted=fitted))
            if self._simulator.is_fast and not change_g(effects):
                last = min(more, key=candidates.left, default=best)
                if not last.retunes:
                    more.append(replace(last, fitted=with_g(self._simulator, last.fitted, goal)))
            candidates = candidates.and_these(more)
        return candidates

    def _ways(self, plays: Fitted, wide: Fitted) -> Candidates:
        """Return the candidates without an effect, but for those of the refits."""
        simulator = self._simulator
        state = replace(self._given, effects=wide.state.effects)
        given = fit_jointly(simulator, state, base_at(simulator, state))
        if plays.state.effects != wide.state.effects:
            plays = refit_of(simulator, state, 'plays')
        named = {'given': given, 'plays': plays, 'wide': wide}
        found = [Candidate((), way, fitted) for way, fitted in named.items()]
        if simulator.is_fast:
            found += [replace(found[i], fitted=with_g(simulator, found[i].fitted)) for i in (0, 2)]
        return Candidates(simulator.rows, self._noise, self._missed, tuple(found))

    def _with_each(
        self, base: Candidate, some: Sequence[type[Effect]], goal: float
    ) -> list[Candidate]:
        """Return candidates with one more effect, of which each promises to leave so much."""
        effects = [
            effect
            for effect in some
            if effect.name not in base.effects and not (effect.in_dynamics and base.retunes)
        ]
        this = self._round(base.fitted, effects, goal)
        self.rounds.append(this)
        return [
            Candidate(tuple(sorted((*base.effects, fitted.name))), base.way, fitted, this)
            # only beside the effect that was missing does what creeps on from before show
            for fitted in (with_earlier_motion(self._simulator, one) for one in this.contenders)
        ]

    def _worth_extending(self, candidates: Candidates, size: int) -> list[Candidate]:
        """Return the bests of a size to which one more effect is added."""
        sets = [s for s in candidates.sets if len(s) == size]
        bests = [c for c in map(candidates.best, sets) if c is not None]
        if not bests:
            return []
        least = candidates.left(bests[0])
        # no law of a candidate is quite that of a stage: what is little beside the first effect
        # may be the rest of it
        whole = candidates.left(candidates.without(bests[0].effects))
        enough = candidates.least_share + self._simulator.rows.square(SMALLEST_EFFECT)
        if least < max(enough, LITTLE * whole):
            return []
        if any(map(candidates.is_admissible, sets)):
            bests = [c for c in bests if candidates.left(c) <= RIVALS * least]
        elif size > 1:
            return []
        return bests[: EXTENDED[min(size, len(EXTENDED)) - 1]]

    def _round(self, fitted: Fitted, effects: Sequence[type[Effect]], goal: float) -> Round:
        done, self._count = self._count, self._count + 1

        def tick(share: float) -> None:
            # most searches end after three or four rounds: the bar nears its end ever slower
            self._tick(1.0 - 0.6 ** (done + share))

        return search_round(
            self._simulator,
            fitted,
            effects,
            TrialColumns(self._simulator, fitted.state, self._lines),
            self._noise,
            self._rng,
            tick,
            goal=self._noise + goal,
        )


def _best_h(candidates: Candidates) -> Candidate:
    """Return the H that leaves least with the G as it is."""
    return min((c for c in candidates.all if not c.retunes), key=candidates.left)


def _worth_searching(candidates: Candidates) -> list[Candidate]:
    """
    Return the ways beside which effects are sought: the H as given, and the one that fits best.

    That with a retuned G, too, where it leaves clearly less.
    """
    best = _best_h(candidates)
    retuned = sorted((c for c in candidates.all if c.retunes), key=candidates.left)
    more = [c for c in retuned if ALIKE * candidates.left(c) <= candidates.left(best)]
    return [*dict.fromkeys((candidates.as_given, best)), *more[:1]]

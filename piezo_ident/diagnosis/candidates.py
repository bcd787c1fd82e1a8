# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
List the candidates: sets of effects, each beside treatments of H (given, plays, wide) and G.

The hysteresis of a piezo is never exactly a sum of plays, and an effect during the identification
has distorted H and G.  Each effect is therefore tried beside the best H, and beside a retuned G
(G times a factor near one) if retuning alone clearly lowers the error.  Effects of the path of the
voltage, the same at any speed, are tried beside the given H, too.  The best sets get all
treatments.  One more effect is added if more than `LITTLE` is left.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.diagnosis.base_residual import BaseResidual
from piezo_ident.diagnosis.criteria import ALIKE, LITTLE, RIVALS, SMALLEST_EFFECT, TAKES
from piezo_ident.diagnosis.decision import Candidates, change_g, FittedSet
from piezo_ident.diagnosis.earlier_motion import with_earlier_motion
from piezo_ident.diagnosis.joint_fit import fit_jointly, Fitted, tried
from piezo_ident.diagnosis.refits import law_of, refit_of, with_g
from piezo_ident.diagnosis.search import Round, search_round
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.trial_scores import Tick, TrialColumns
from piezo_ident.effects import Effect, find_effect

#: a fit goes on only while it may reach this share of the error of the best smaller set
PROMISING = 0.9
#: number of sets to which one more effect is added: of sets with one effect, and of larger sets
EXTENDED = 2, 1
#: number of sets of each size that are tried with all treatments of H and G
IN_ALL_WAYS = 3


class CandidateSearch:
    """Search that fits the candidates of some data: sets of some effects."""

    def __init__(
        self,
        simulator: Simulator,
        residual: BaseResidual,
        effects: Sequence[str],
        rng: np.random.Generator,
        tick: Tick,
    ) -> None:
        self._simulator, self._residual, self._rng, self._tick = simulator, residual, rng, tick
        have = [find_effect(setting.name) for setting in simulator.model.effects]
        knows_path = any(effect.rate_independent for effect in have)
        # a change of a known effect of the path would look like another effect of the path
        self._effects = [
            effect
            for effect in map(find_effect, effects)
            if not (knows_path and effect.rate_independent)
        ]
        self._count = 0
        #: all searches so far
        self.rounds: list[Round] = []

    def shown(self, names: Sequence[str]) -> tuple[Fitted, tuple[str, ...]]:
        """
        Add effects whose own tests are significant; return the fit and the added names.

        Each must lower the mean square by at least `SMALLEST_EFFECT`, beside the earlier effects.
        """
        fitted = self._residual.wide
        least = self._simulator.rows.square(SMALLEST_EFFECT)
        found = list[str]()
        for name in names:
            this = self._round(fitted, [find_effect(name)], np.inf)
            if this.contenders and fitted.mean_square - this.contenders[0].mean_square >= least:
                fitted = this.contenders[0]
                found.append(name)
        return fitted, tuple(found)

    def of(self, wide: Fitted, most: int) -> Candidates:
        """Fit all candidates with up to `most` effects beside the effects of a wide refit."""
        candidates = self._without_effect(wide)
        least = min(map(candidates.left, candidates.all))
        path = [effect for effect in self._effects if effect.rate_independent]
        best = min((c for c in candidates.all if not c.retunes), key=candidates.left)
        retuned = min((c for c in candidates.all if c.retunes), key=candidates.left, default=None)
        bases = list(dict.fromkeys((candidates.as_given, best)))
        # a retuned G must err clearly less than the best H with an unchanged G
        if retuned and ALIKE * candidates.left(retuned) <= candidates.left(best):
            bases.append(retuned)
        for base in bases:
            some, goal = self._effects, PROMISING * least
            if base is not best and not base.retunes:
                # the effect must lower the error nearly as much as a refit of H
                some, goal = path, least + TAKES * max(candidates.left(base) - least, 0.0)
            candidates = candidates.and_these(self._with_each(base, some, goal))
        candidates = self._with_all_treatments(candidates, 1)
        for size in range(1, most):
            bases = self._worth_extending(candidates, size)
            if not bases:
                break
            for base in bases:
                goal = PROMISING * candidates.left(base)
                more = self._with_each(base, self._effects, goal)
                candidates = candidates.and_these(more)
            candidates = self._with_all_treatments(candidates, size + 1)
        return candidates

    def _with_all_treatments(self, candidates: Candidates, size: int) -> Candidates:
        """Fit the best sets of a size with all treatments of H and G."""
        # a wide H may have absorbed an effect in part, and errs under other motion.  A sum of
        # plays may leave an error that another effect fits by accident
        bests = [c for c in candidates.bests if len(c.effects) == size][:IN_ALL_WAYS]
        for best in bests:
            # a treatment with a larger error than the best treatment does not count
            goal = np.inf if best is bests[0] else self._residual.noise + candidates.left(best)
            candidates = candidates.and_these(self._other_treatments(candidates, best, goal))
        return candidates

    def _other_treatments(
        self, candidates: Candidates, best: FittedSet, goal: float
    ) -> list[FittedSet]:
        """Fit the set of a candidate with all other treatments of H, and then with a retuned G."""
        simulator, have = self._simulator, {c.way for c in candidates.of(best.effects)}
        state = candidates.as_given.fitted.state.with_effects_of(best.fitted.state)
        found = dict[str, Fitted | None]()
        if 'given' not in have:
            given = tried(fit_jointly, simulator, state)
            if given is not None:
                given = with_earlier_motion(simulator, given)
                state = given.state
            found['given'] = given
        for c in candidates.of(()):
            if c.way not in {'given', *have, *found}:
                found[c.way] = tried(refit_of, simulator, state, law_of(c.fitted), goal)
        # the fit of an effect may diverge beside one H and converge beside another H
        more = [replace(best, way=way, fitted=one) for way, one in found.items() if one]
        last = min(more, key=candidates.left, default=best)
        if simulator.is_fast and not (change_g(best.effects) or last.retunes):
            retuned = tried(with_g, simulator, last.fitted, goal)
            more += [replace(last, fitted=retuned)] if retuned else []
        return more

    def _without_effect(self, wide: Fitted) -> Candidates:
        """Fit each treatment without an effect, except for the effects of the wide refit."""
        simulator, plays = self._simulator, self._residual.plays
        state = replace(self._residual.given, effects=wide.state.effects)
        given = fit_jointly(simulator, state)
        if plays.state.effects != wide.state.effects:
            plays = refit_of(simulator, state, 'plays')
        named = {'given': given, 'plays': plays, 'wide': wide}
        found = [FittedSet((), way, fitted) for way, fitted in named.items()]
        if simulator.is_fast:
            found += [replace(found[i], fitted=with_g(simulator, found[i].fitted)) for i in (0, 2)]
        return Candidates(
            simulator.rows, self._residual.noise, self._residual.missed, tuple(found)
        )

    def _with_each(
        self, base: FittedSet, some: Sequence[type[Effect]], goal: float
    ) -> list[FittedSet]:
        """Fit candidates with one more effect; a fit ends early if it cannot reach `goal`."""
        effects = [
            effect
            for effect in some
            if effect.name not in base.effects and not (effect.in_dynamics and base.retunes)
        ]
        this = self._round(base.fitted, effects, goal)
        self.rounds.append(this)
        return [
            FittedSet(tuple(sorted((*base.effects, fitted.name))), base.way, fitted, this)
            # creep from earlier motion shows only once the missing effect is in the model
            for fitted in (with_earlier_motion(self._simulator, one) for one in this.contenders)
        ]

    def _worth_extending(self, candidates: Candidates, size: int) -> list[FittedSet]:
        """Return the best sets of a size to which one more effect is added."""
        bests = [c for c in candidates.bests if len(c.effects) == size]
        if not bests:
            return []
        least = candidates.left(bests[0])
        # no law of a candidate fits a stage exactly: a small error beside the first effect may
        # belong to that effect
        whole = candidates.left(candidates.without(bests[0].effects))
        enough = candidates.least_share + self._simulator.rows.square(SMALLEST_EFFECT)
        if least < max(enough, LITTLE * whole):
            return []
        if any(candidates.is_admissible(c.effects) for c in bests):
            bests = [c for c in bests if candidates.left(c) <= RIVALS * least]
        elif size > 1:
            return []
        return bests[: EXTENDED[min(size, len(EXTENDED)) - 1]]

    def _round(self, fitted: Fitted, effects: Sequence[type[Effect]], goal: float) -> Round:
        done, self._count = self._count, self._count + 1

        def tick(share: float) -> None:
            # most searches end after three or four rounds, so the bar slows down towards its end
            self._tick(1.0 - 0.6 ** (done + share))

        lines = [line.frequency for line in self._residual.lines.lines]
        return search_round(
            TrialColumns(self._simulator, fitted.state, lines),
            fitted,
            effects,
            self._residual.noise,
            self._rng,
            tick,
            goal=self._residual.noise + goal,
        )

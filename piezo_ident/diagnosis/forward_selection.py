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

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.earlier_motion import with_earlier_motion
from piezo_ident.diagnosis.joint_fit import fit_jointly, Fitted
from piezo_ident.diagnosis.polishing import polished, without_needless
from piezo_ident.diagnosis.results import DiagnosisSettings
from piezo_ident.diagnosis.retuning import RETUNING
from piezo_ident.diagnosis.search import Round, search_round, Selected, stands_out, takes
from piezo_ident.diagnosis.signature import has_place
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.trial_scores import best_trials
from piezo_ident.effects import catalogue, Effect, find_effect
from piezo_ident.identification.results import Progress

#: effects that have a test of their own, by lines and by coherence with a further channel
TESTED = ('periodic_disturbance', 'cross_coupling')
#: weights that change with the bias are but another wide law of H
WIDE_LAW = 'noncongruent_minor_loops'


class ForwardSelection:
    """
    Effects are added one after another as long as held-out data gain.

    `certain` are effects that a test of their own has shown, whatever they explain of the rest;
    `smallest` is the rms of the smallest other effect that is taken, `missed` what the model
    missed of fast motion when it was identified, and `misses` what it may miss of these data, % of
    stroke: no change of the dynamics since is smaller; and `misfit` what a wider H takes, % of
    stroke.
    `given` is the mean square that the model leaves as it was given: where a refit of H leaves
    more, an effect has to gain against that.
    """

    def __init__(
        self,
        simulator: Simulator,
        lines: Sequence[float],
        noise: float,
        settings: DiagnosisSettings,
        progress: Progress,
        *,
        certain: Sequence[str],
        smallest: float,
        missed: float,
        misses: float,
        misfit: float,
        given: float,
    ) -> None:
        self._simulator = simulator
        self._lines, self._noise, self._certain, self._given = lines, noise, certain, given
        self._smallest, self._missed, self._misfit = smallest, missed, misfit
        self._misses = misses
        #: rms of the least change of G that is a finding though no law fits [% of stroke]
        clear = max(criteria.CHANGE_FINDING, criteria.CLEAR_CHANGE * missed)
        self._change = min(criteria.REFIT_FINDING, clear)
        #: fits, and the same with G retuned
        self._retunings: list[tuple[Fitted, Fitted]] = []
        self._most, self._progress = settings.most_effects, progress
        self._rng = np.random.default_rng(settings.seed)
        names = settings.effects or tuple(catalogue())
        self._candidates = [find_effect(name) for name in names if name not in settings.without]
        self._have = {setting.name for setting in simulator.model.effects}
        self._count = 0
        #: mean square that each effect must be worth to stay
        self._worth = self._least

    def run(self, base: Fitted) -> Selected:
        """
        Select what no H imitates, from the widest base; without any, the base is the fit.

        What can only follow the path of the command is left to `beside`.
        """
        size = self._simulator.rows.percent(self._explainable(base))
        has_dynamics = self._simulator.model.dynamics.a.size > 0
        self._allowed = [
            effect
            for effect in self._candidates
            # behind a G nothing follows the path of the command alone: no H bends or holds a ring
            if (not effect.rate_independent or (effect.slot == 'output' and has_dynamics))
            and effect.name not in TESTED
            and not (effect.in_dynamics and size < self._misses)
        ]
        self._base, self._is_new = base, size >= criteria.NEWS * self._missed
        shown, retuned = self._of_tests(self.retuned(base))
        if shown:
            state = replace(retuned.state, retuning=())
            base = fit_jointly(self._simulator, state, base.base)
        explainable = max(base.mean_square - self._noise, 1e-300)
        if shown and self._beyond_noise(retuned) < self._least:
            # they were there at the identification, too: it takes no more for G to be off
            return self._from(retuned, self._round(retuned), shown)
        # a limit of the speed acts on fast motion, too, and a retuned G takes much of it
        news = [e for e in self._allowed if e.in_dynamics or e.name == 'slew_limit']
        gain = base.mean_square - retuned.mean_square
        if gain < criteria.LINEAR * explainable:
            return self._from(retuned, self._round(retuned), shown)
        linear = self._round(base, news) if news else None
        found = self._beside_a_linear_change(base, retuned, linear, shown)
        size = self._simulator.rows.percent(gain)
        if len(found.taken) > len(shown) or size < max(self._smallest, self._change):
            return found
        found = replace(found, linear=self._instead(base, retuned, linear))
        if linear is None or not self._is_change(linear, retuned, found):
            return found
        k, rounds = len(shown), found.rounds
        if not any(one is linear for one in rounds):
            rounds = (*rounds[:k], linear, *rounds[k:])
        return replace(
            found, rounds=rounds, taken=(*found.taken, linear), fitted=linear.contenders[0]
        )

    def _is_change(self, linear: Round, retuned: Fitted, found: Selected) -> bool:
        """
        Return whether a G that has changed is the finding, though none of its laws fits.

        What exceeds all that was missed, and all that H misses, is no side effect on G, unless
        something else takes much of what a retuned G leaves: it may have bent G.
        """
        other = next((one for one in found.rounds if one.before is retuned), None)
        if (
            other is not None
            and self._takes(other, self._explainable(retuned), first=True)
            and not find_effect(other.contenders[0].name).in_dynamics
        ):
            return False
        explainable = self._explainable(linear.before)
        gain = explainable - self._beyond_noise(retuned)
        return (
            self._simulator.rows.percent(gain) >= max(self._change, self._missed, self._misfit)
            and gain >= criteria.TOGETHER * explainable
            and len(found.taken) < self._most
            and self._takes(linear, explainable, first=True)
            and linear.contenders[0].name in found.linear
            # one law does nearly all that another G does
            and explainable - self._left(linear) >= criteria.NAMED * gain
        )

    def _of_tests(self, fitted: Fitted) -> tuple[list[Round], Fitted]:
        """Return what tests of their own have shown, and the fit with that."""
        shown = list[Round]()
        for name in self._certain:
            this = self._round(fitted, [e for e in self._candidates if e.name == name], worth=0.0)
            # what one leaves by its form is no line of its own
            form = (1.0 - criteria.LAW_FITS) * max((one.gain for one in shown), default=0.0)
            if this.contenders and (not shown or this.gain > max(form, self._indistinct)):
                shown.append(this)
                fitted = this.contenders[0]
        return shown, fitted

    def _beside_a_linear_change(
        self,
        base: Fitted,
        retuned: Fitted,
        linear: Round | None,
        shown: Sequence[Round],
    ) -> Selected:
        if linear is None:
            return self._from(retuned, self._round(retuned), shown)
        # a linear change is the larger part: is it the whole of it?
        is_linear = self._takes(linear, self._explainable(base), first=True)
        if is_linear and self._left(linear) <= self._least:
            return self._from(base, linear, shown)
        bent = self._round(retuned)
        is_bent = self._takes(bent, self._explainable(bent.before), first=True)
        if not is_linear or (is_bent and self._left(bent) < criteria.BENT * self._left(linear)):
            return self._from(retuned, bent, shown)
        return self._from(base, linear, shown, bent if is_bent else None)

    def _instead(self, base: Fitted, retuned: Fitted, linear: Round | None) -> tuple[str, ...]:
        """Return what goes with the speed, best first, and does half of what a retuned G does."""
        best = {} if linear is None else dict(linear.best)
        effects = [
            effect
            for effect in self._candidates
            if effect.name not in {*self._have, *best, *TESTED}
            and not (effect.rate_independent or effect.time_driven or has_place(effect.name))
        ]
        best |= best_trials(self._simulator, base, effects, self._lines)
        left = {name: scored.error for name, scored in best.items()}
        most = 0.5 * float(base.errors.sum() + retuned.errors.sum())
        return tuple(sorted((name for name in left if left[name] < most), key=left.__getitem__))

    def beside(self, plays: Fitted, wide: Fitted, as_given: Fitted, found: Selected) -> Selected:
        """
        Select one effect that follows the path of the command alone, beside what was found.

        A wide H imitates it.  So it has to be nearly all that is left beside a sum of plays, and
        to leave as little as the wide H does without it (`wide`): clearly less, where no kinds of
        motion are held out.  What the H of the model does
        not leave beside what was found and a retuned G (`as_given`) needs no effect.
        """
        self._given = min(self._given, as_given.mean_square)
        self._allowed = [effect for effect in self._candidates if effect.rate_independent]
        # G was identified with the effect, and may be bent by it
        plays, wide = (self.retuned(fitted) for fitted in (plays, wide))
        if self._beyond_noise(plays) < self._least or len(found.taken) == self._most:
            return found
        this = self._round(plays)
        found = replace(found, rounds=(*found.rounds, this), imitated=this)
        left = self._explainable(plays)
        if not self._takes(this, left, first=True):
            return found
        least = self._beyond_noise(wide) + self._indistinct
        if not self._simulator.rows.kinds:
            # no other kind of motion speaks against the wide H
            least = self._beyond_noise(wide) / criteria.AHEAD - self._indistinct
        if this.contenders[0].name == WIDE_LAW:
            least /= criteria.AHEAD
        if self._left(this) > min(least, (1.0 - criteria.NAMED) * left):
            return found
        # what beside the wide H was explained by another effect
        stay = sum(one.contenders[0].name in TESTED for one in found.taken)
        fitted, dropped = without_needless(self._simulator, this.contenders[0], self._worth, stay)
        taken = [one for i, one in enumerate(found.taken) if i not in dropped]
        return replace(found, taken=(*taken, this), fitted=fitted)

    def of_path(self, fitted: Fitted) -> Round:
        """Return the round of what follows the path of the command, or may look like that."""
        like = ('creep', 'gain_drift')
        some = [e for e in self._candidates if e.rate_independent or e.name in like]
        return self._round(fitted, some)

    def retuned(self, fitted: Fitted) -> Fitted:
        """Return a fit with G retuned, too, where the data could show it."""
        if fitted.state.retuning or not self._simulator.is_fast:
            return fitted
        for one, again in self._retunings:
            if one is fitted:
                return again
        state = replace(fitted.state, retuning=(0.0,) * len(RETUNING))
        self._retunings.append((fitted, fit_jointly(self._simulator, state, fitted.base)))
        return self._retunings[-1][1]

    def _takes(self, this: Round, explainable: float, *, first: bool) -> bool:
        rows = self._simulator.rows
        if rows.passes < criteria.PASSES or not this.contenders:
            return False
        # what shows where it alone acts is no misfit of H
        own = has_place(this.contenders[0].name)
        if not first:
            left = self._beyond_noise(this.before)
            if self._left(this) <= (1.0 - criteria.TOGETHER) * left:
                # nor is what explains most of the rest, however little that is
                own, explainable = True, min(explainable, left)
            elif self._makes_up(this):
                return False
        smallest = criteria.SMALLEST_EFFECT if own else self._smallest
        known = min(this.before.mean_square, self._given)
        return takes(rows, this, known, self._noise, explainable, smallest, first=first)

    def _makes_up(self, this: Round) -> bool:
        """
        Return whether a further effect may only make up for the form of the laws before it.

        No real effect has quite the form of its law.  Where those that are there leave no more
        than a name may leave, more parameters than theirs fit the rest, whatever it is.
        """
        before, best = this.before, this.contenders[0]
        may_stay = (1.0 - criteria.NAMED) * self._explainable(self._base)
        own = len(best.parameters) - len(before.parameters)
        others = len(before.parameters) - len(before.state.retuning)
        return self._beyond_noise(before) <= may_stay and own > others and not has_place(best.name)

    @property
    def _least(self) -> float:
        """Mean square of the smallest effect."""
        return self._simulator.rows.square(self._smallest)

    @property
    def _indistinct(self) -> float:
        """Mean square of a difference that means nothing."""
        return self._simulator.rows.square(criteria.INDISTINCT)

    def _beyond_noise(self, fitted: Fitted) -> float:
        return max(fitted.mean_square - self._noise, 0.0)

    def _explainable(self, fitted: Fitted) -> float:
        return max(min(fitted.mean_square, self._given) - self._noise, 0.0)

    def _left(self, this: Round) -> float:
        return self._beyond_noise(this.contenders[0] if this.contenders else this.before)

    def _round(
        self,
        fitted: Fitted,
        effects: Sequence[type[Effect]] | None = None,
        *,
        promise: float = criteria.WORTH_FIT,
        worth: float = criteria.LEAST_GAIN,
    ) -> Round:
        """Return a round over some effects, or all that are allowed; see `search_round`."""
        have = self._have | {added.name for added in fitted.state.effects}
        chosen = self._allowed if effects is None else effects
        candidates = [effect for effect in chosen if effect.name not in have]
        done, self._count = self._count, self._count + 1

        def tick(share: float) -> None:
            # most searches end after two or three rounds: the bar nears its end ever slower
            self._progress('candidates', 1.0 - 0.4 ** (done + share))

        return search_round(
            self._simulator,
            fitted,
            candidates,
            self._lines,
            self._noise,
            self._rng,
            tick,
            promise=promise,
            worth=worth,
        )

    def _from(
        self, start: Fitted, first: Round, shown: Sequence[Round], bent: Round | None = None
    ) -> Selected:
        fitted, this = start, first
        rounds, taken = [*shown, first], [*shown]
        explainable = self._explainable(start)
        smallest = self._simulator.rows.square(criteria.SMALLEST_EFFECT)
        while self._takes(this, explainable, first=len(taken) == len(shown)):
            taken.append(this)
            # it stays worth most of what it was taken for, where that is little
            self._worth = min(self._worth, criteria.TOGETHER * this.gain)
            fitted, dropped = without_needless(
                self._simulator, this.contenders[0], self._worth, len(shown)
            )
            for i in dropped:
                del taken[i]
            fitted = with_earlier_motion(self._simulator, fitted, self._alive)
            if len(fitted.state.effects) > 1:
                # effects that were not fitted to the end leave something for another to explain
                fitted = polished(self._simulator, fitted, self._lines, self._noise, self._alive)
            if len(taken) == self._most or self._beyond_noise(fitted) < smallest:
                break
            is_further = len(taken) > len(shown)
            promise = criteria.LEAST_GAIN if is_further else criteria.WORTH_FIT
            this = self._round(fitted, promise=promise)
            rounds.append(this)
        if len(fitted.state.effects) > 1:
            # of the others the rounds have asked whether they are needed, of the last one not yet
            newest = len(fitted.state.effects) - 1
            fitted, dropped = without_needless(
                self._simulator, fitted, self._worth, max(newest, len(shown)), last=0
            )
            for i in dropped:
                del taken[i]
        new = taken[len(shown) :]
        wanted = self._wanted([find_effect(this.contenders[0].name) for this in new])
        if len(new) == 1 and stands_out(self._simulator.rows, new[0]):
            wanted = min(wanted, criteria.ADDED)
        if self._beyond_noise(fitted) > (1.0 - wanted) * explainable:
            taken = [*shown]
        self._progress('candidates', 1.0)
        left_out = frozenset(catalogue()) - self._have - {e.name for e in self._candidates}
        if len(taken) == len(shown):
            fitted = shown[-1].contenders[0] if shown else self._base
        return Selected(tuple(rounds), tuple(taken), fitted, bent, left_out)

    def _alive(self) -> None:
        self._progress('candidates', 0.95)

    def _wanted(self, effects: Sequence[type[Effect]]) -> float:
        """Return the share that effects must explain together."""
        if all(has_place(effect.name) for effect in effects):
            return 0.0
        if not any(effect.in_dynamics for effect in effects):
            return criteria.TOGETHER
        # any G that is a little off looks partly like a change of the dynamics
        return criteria.NAMED if self._is_new else criteria.LAW_FITS

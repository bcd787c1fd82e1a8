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
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.free_parameters import RETUNING
from piezo_ident.diagnosis.joint_fit import fit_jointly, Fitted
from piezo_ident.diagnosis.results import DiagnosisSettings
from piezo_ident.diagnosis.search import drop_needless, polished, Round, search_round
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.verdict import takes
from piezo_ident.effects import catalogue, find_effect
from piezo_ident.identification.results import Progress

__all__ = ['ForwardSelection', 'Selected']


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
        Effects that nobody can find, since they are not tried.
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
        """Select, from the base model refitted."""
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
        return self._beyond_noise(this.contenders[0].fitted if this.contenders else this.before)

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
            fitted, dropped = drop_needless(
                self._simulator, this.contenders[0].fitted, self._least
            )
            for i in dropped:
                del taken[i]
            if len(taken) == self._most or fitted.mean_square - self._noise < self._least:
                break
            this = self._round(fitted)
            rounds.append(this)
        if len(fitted.state.effects) > 1:
            fitted = polished(
                self._simulator, fitted, self._lines, lambda: self._progress('candidates', 0.95)
            )
        self._progress('candidates', 1.0)
        tried = self._have | {effect.name for effect in self._candidates}
        left_out = frozenset(catalogue()) - tried
        return Selected(tuple(rounds), tuple(taken), fitted, bent, left_out)

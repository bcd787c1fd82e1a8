# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""List the numbers of a state that a fit may move, besides H and the offsets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.diagnosis.retuning import RETUNING
from piezo_ident.diagnosis.state import State
from piezo_ident.effects.trials import number_of

#: step of a finite difference in the logarithm of a parameter
LOG_STEP = 1e-2


@dataclass(frozen=True)
class FreeParameter:
    """
    One number that the fit may move, in one record or (None) in all records.

    `effect` is the place of its effect in the state, or None for the retuning of G.
    """

    effect: int | None
    record: int | None
    name: str
    index: int | None
    logarithmic: bool
    step: float
    lower: float
    upper: float
    spread: float = float('inf')

    def get(self, state: State) -> float:
        """Return the value of the number."""
        if self.effect is None:
            return state.retuning[self.index or 0]
        return number_of(
            state.effects[self.effect].values[self.record or 0], self.name, self.index
        )

    def small(self, state: State) -> float:
        """Choose a step for a finite difference within the bounds."""
        value = self.get(state)
        if self.logarithmic:
            is_free = self.upper / value >= np.exp(self.step)
        else:
            is_free = self.upper - value >= self.step
        return self.step if is_free else -self.step

    def moved(self, state: State, delta: float) -> State:
        """Return the state after a step within the bounds; relative if logarithmic."""
        value = self.get(state)
        if self.logarithmic:
            value *= float(np.exp(np.clip(delta, -1.0, 1.0)))
        else:
            value += delta
        value = float(np.clip(value, self.lower, self.upper))
        if self.effect is None:
            retuning = list(state.retuning)
            retuning[self.index or 0] = value
            return replace(state, retuning=tuple(retuning))
        effects = list(state.effects)
        effects[self.effect] = effects[self.effect].changed(
            self.record, self.name, self.index, value
        )
        return replace(state, effects=tuple(effects))

    def room(self, state: State) -> tuple[float, float]:
        """Return the largest steps down and up."""
        value = self.get(state)
        if self.logarithmic:
            down = max(-1.0, np.log(max(self.lower, 1e-300) / value))
            return min(down, 0.0), max(min(1.0, np.log(self.upper / value)), 0.0)
        return min(self.lower - value, 0.0), max(self.upper - value, 0.0)


def free_parameters(
    state: State, records: int, longest: int | None = None
) -> tuple[FreeParameter, ...]:
    """
    List every number of the retuning of G and of the effects that the fit may move.

    H can imitate the first number of some effects (`first_stays`).  If H is free, this number
    stays fixed in the record `longest`, so other records count relative to it.  If H is fixed,
    `longest` is None and the number is free in all records.
    """
    found = [
        FreeParameter(None, None, 'retuning', i, False, 1e-3 * size, -size, size)
        for i, size in enumerate(RETUNING[: len(state.retuning)])
    ]
    for i, added in enumerate(state.effects):
        effect = added.effect
        for p in effect.parameters:
            value = added.values[0][p.name]
            if p.scale == 'fixed' or p.kind == 'text':
                continue
            is_log = p.scale == 'log'
            step = LOG_STEP if is_log else (p.step or 1e-3)
            # an effect driven by time has another amplitude in each record
            per_record = effect.time_driven and p.step > 0.0
            for k in range(records) if per_record else (None,):
                held = 1 if p.first_stays and k == longest else 0
                for index in range(held, np.size(value)) if p.vector else (None,):
                    number = number_of(added.values[0], p.name, index)
                    if np.isfinite(number) and not (is_log and number <= 0.0):
                        found.append(
                            FreeParameter(
                                i, k, p.name, index, is_log, step, p.lower, p.upper, p.spread
                            )
                        )
    return tuple(found)

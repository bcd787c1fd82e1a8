# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The numbers that a joint fit may move: of each effect, and of the retuning of G."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.diagnosis.simulator import State

__all__ = ['RETUNING', 'Handle', 'handles_of']

#: how far G may be retuned: about samples of delay, their squares, and two relaxations
RETUNING = (20.0, 800.0, 1.0, 1.0)
#: relative size of a finite difference in the logarithm of a parameter
LOG_STEP = 1e-2


@dataclass(frozen=True)
class Handle:
    """
    One number that the fit may move.

    Of an effect, in one record or (None) in all; or of the retuning of G, when `effect` is None.
    """

    effect: int | None
    record: int | None
    name: str
    index: int | None
    logarithmic: bool
    step: float
    lower: float
    upper: float
    is_amplitude: bool

    def get(self, state: State) -> float:
        """Return its value."""
        if self.effect is None:
            return state.retuning[self.index or 0]
        value = state.effects[self.effect].values[self.record or 0][self.name]
        return float(value if self.index is None else value[self.index])

    def set(self, state: State, value: float) -> State:
        """Return the state with another value, kept within its bounds."""
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

    def moved(self, state: State, delta: float) -> State:
        """Return the state after a step; for a logarithmic handle the step is relative."""
        value = self.get(state)
        if self.logarithmic:
            return self.set(state, value * float(np.exp(np.clip(delta, -1.0, 1.0))))
        return self.set(state, value + delta)


def handles_of(state: State, records: int) -> tuple[Handle, ...]:
    """Return every number of G's retuning and of the effects that the fit may move."""
    handles = [
        Handle(
            None, None, 'retuning', i, False, 1e-3 * RETUNING[i], -RETUNING[i], RETUNING[i], True
        )
        for i in range(len(state.retuning))
    ]
    for i, added in enumerate(state.effects):
        effect = added.effect
        for p in effect.parameters:
            value = added.values[0][p.name]
            if p.scale == 'fixed' or p.kind == 'text':
                continue
            is_amplitude = p.step > 0.0
            per_record = effect.time_driven and is_amplitude
            for k in range(records) if per_record else (None,):
                for index in range(np.size(value)) if p.vector else (None,):
                    number = float(value if index is None else value[index])
                    if not np.isfinite(number) or (p.scale == 'log' and number <= 0.0):
                        continue
                    handles.append(
                        Handle(
                            effect=i,
                            record=k,
                            name=p.name,
                            index=index,
                            logarithmic=p.scale == 'log',
                            step=LOG_STEP if p.scale == 'log' else (p.step or 1e-3),
                            lower=p.lower,
                            upper=p.upper,
                            is_amplitude=is_amplitude,
                        )
                    )
    return tuple(handles)

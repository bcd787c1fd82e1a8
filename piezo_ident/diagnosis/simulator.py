# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The whole model over the rows, run again and again with little changed.

Candidates, finite differences and the joint fit all need the prediction with other weights or
other effects.  What lies before the change in the chain is kept from the run before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.effects import Effect, find_effect
from piezo_ident.effects.trials import with_number
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.operators.chain import Block, Operator
from piezo_ident.operators.dynamics import DelayOperator, Dynamics, DynamicsOperator, filter_arx
from piezo_ident.operators.hysteresis import Hysteresis, HysteresisOperator
from piezo_ident.operators.play import play_columns

__all__ = ['Added', 'Simulator', 'State', 'retuned']

Array = NDArray[np.float64]

#: corner frequencies of the relaxations that a retuned G may show [Hz]
RELAXATIONS = (15.0, 100.0)


@dataclass(frozen=True, eq=False)
class Added:
    """
    An effect in the model under study, with its parameters in each record.

    They are the same in all, unless the effect is driven by time.
    """

    name: str
    values: tuple[Mapping[str, Any], ...]

    def __post_init__(self) -> None:
        frozen = tuple(MappingProxyType(dict(v)) for v in self.values)
        object.__setattr__(self, 'values', frozen)

    @property
    def effect(self) -> type[Effect]:
        """Its class."""
        return find_effect(self.name)

    def changed(self, record: int | None, name: str, index: int | None, value: float) -> Added:
        """Return the effect with one number changed, in one record or in all."""
        return Added(
            self.name,
            tuple(
                with_number(old, name, index, value) if record in (None, k) else old
                for k, old in enumerate(self.values)
            ),
        )


@dataclass(frozen=True, eq=False)
class State:
    """
    What is fitted: H, the offset of each record, and the effects added.

    Attributes
    ----------
    hysteresis : Hysteresis
    offsets : ndarray, shape (records,)
        Added to the displacement, normalised.
    effects : tuple of Added
    retuning : tuple of float
        Coefficients of `retuned`, empty where G stays as it is.
    """

    hysteresis: Hysteresis
    offsets: Array
    effects: tuple[Added, ...] = ()
    retuning: tuple[float, ...] = ()

    def with_effect(self, added: Added) -> State:
        """Return the state with one more effect."""
        return replace(self, effects=(*self.effects, added))


class Simulator:
    """Runs of a model over rows; its G, delay, scaling and effects stay as they are."""

    def __init__(self, model: StageModel, rows: Rows) -> None:
        self.model = model
        self.rows = rows
        self._state: State | None = None
        #: for each run the block before every link of the chain, and the one behind the last
        self._kept: list[list[Block]] = []

    def model_of(self, state: State, record: int = 0) -> StageModel:
        """Return the model of a state, with the effects as in one record."""
        settings = [EffectSetting(a.name, a.values[record]) for a in state.effects]
        return replace(
            self.model,
            hysteresis=state.hysteresis,
            dynamics=retuned(self.model.dynamics, state.retuning, self.model.sample_rate),
            effects=(*self.model.effects, *settings),
        )

    def base_columns(self, thresholds: Array) -> Array:
        """
        Return ``[G F_r | G v^3 | G v]`` as rows; shape (n, m + 2).

        Effects are left out of these columns: they change them by a few percent, and only the
        path to the optimum depends on that.
        """
        G, delay = self.model.dynamics, self.model.delay
        columns = []
        for j in range(thresholds.size + 2):
            signals = []
            for run, memory in zip(self.rows.runs, self.rows.memories, strict=True):
                if j < thresholds.size:
                    r = thresholds[j : j + 1]
                    raw = play_columns(run.u, r, memory(r))[0]
                else:
                    raw = run.u ** (3 if j == thresholds.size else 1)
                signals.append(filter_arx(G.a, G.b, delay.apply(raw)))
            columns.append(self.rows.of(signals))
        return np.stack(columns, axis=1)

    def run(self, state: State) -> Array:
        """Return the predicted rows; shape (n,)."""
        outputs = [self._blocks(state, i)[-1].x for i in range(len(self.rows.runs))]
        return self.rows.of(outputs) + state.offsets[self.rows.of_record]

    def full(self, state: State) -> list[Array]:
        """Return the prediction of each run at the full rate, normalised."""
        return [
            self._blocks(state, i)[-1].x + state.offsets[k] for i, k in enumerate(self.rows.record)
        ]

    def remember(self, state: State) -> Array:
        """Return the predicted rows, and keep what runs between the links for `added`."""
        self._state = state
        self._kept = [self._blocks(state, i, keep=True) for i in range(len(self.rows.runs))]
        outputs = [blocks[-1].x for blocks in self._kept]
        return self.rows.of(outputs) + state.offsets[self.rows.of_record]

    def added(self, effect: Added) -> Array:
        """Return the predicted rows of the remembered state with one more effect in its slot."""
        if self._state is None:
            raise ValueError('remember a state first')
        return self.varied(self._state.with_effect(effect), effect.effect)

    def varied(self, state: State, effect: type[Effect] | None) -> Array:
        """
        Return the predicted rows of a state that differs from the remembered one in one place.

        That is an effect, or (None) G; the chain is only run from there.
        """
        signals = []
        for i, k in enumerate(self.rows.record):
            operators = self._operators(state, i)
            start = _place(effect, operators)
            block = self._kept[i][start]
            for operator in operators[start:]:
                block = operator.process(block)
            signals.append(block.x + state.offsets[k])
        return self.rows.of(signals)

    def _operators(self, state: State, run_index: int) -> tuple[Operator, ...]:
        """Return the links of the chain of a run, reset to rest at its first command."""
        model = self.model_of(state, int(self.rows.record[run_index]))
        memory = self.rows.memories[run_index](state.hysteresis.thresholds)
        operators = model.chain(memory).operators
        x0 = u0 = float(self.rows.runs[run_index].u[0])
        for operator in operators:
            x0 = operator.reset(u0, x0)
        return operators

    def _blocks(self, state: State, run_index: int, *, keep: bool = False) -> list[Block]:
        """Return the block behind the chain of a run, or all between its links."""
        run = self.rows.runs[run_index]
        t = self.rows.time(run_index)
        blocks = [Block(t=t, v=run.u, x=run.u, channels=run.piece.channels)]
        for operator in self._operators(state, run_index):
            block = operator.process(blocks[-1])
            blocks = [*blocks, block] if keep else [block]
        return blocks


def retuned(dynamics: Dynamics, retuning: Sequence[float], sample_rate: float) -> Dynamics:
    """
    Return G multiplied by a factor near one.

    ``1 + c_1 D + c_2 D^2 + sum_j c_j D / (1 - p_j z^-1)`` with ``D = 1 - z^-1`` and p_j the poles
    of `RELAXATIONS`: a delay, a roll-off, and relaxations.  G(1) stays 1, and c_1 acts like minus
    a delay in samples at low frequencies.
    """
    if not any(retuning):
        return dynamics
    c1, c2, c3, c4 = retuning
    # polynomials in z^-1
    D = np.array([1.0, -1.0])
    P, Q = (np.array([1.0, -np.exp(-2.0 * np.pi * f / sample_rate)]) for f in RELAXATIONS)
    common = np.convolve(P, Q)
    terms = (
        common,
        c1 * np.convolve(common, D),
        c2 * np.convolve(common, np.convolve(D, D)),
        c3 * np.convolve(Q, D),
        c4 * np.convolve(P, D),
    )
    factor = np.sum([np.pad(term, (0, 5 - term.size)) for term in terms], axis=0)
    a = np.convolve([1.0, *dynamics.a], common)[1:]
    return Dynamics(a=a, b=np.convolve(dynamics.b, factor))


def _place(effect: type[Effect] | None, operators: Sequence[Operator]) -> int:
    """Return the first link whose output depends on an effect, or on G."""
    if effect is None:
        return next(i for i, op in enumerate(operators) if isinstance(op, DynamicsOperator))
    if effect.slot == 'hysteresis':
        return next(i for i, operator in enumerate(operators) if _is_core(operator))
    for i in range(len(operators) - 1, -1, -1):
        if type(operators[i]) is effect:
            return i
    # no link of its own: it is part of the delay
    return next(i for i, operator in enumerate(operators) if isinstance(operator, DelayOperator))


def _is_core(operator: Operator) -> bool:
    inner = operator
    while isinstance(inner, Effect):
        if inner.slot != 'hysteresis':
            return False
        inner = inner.inner
    return isinstance(inner, HysteresisOperator)

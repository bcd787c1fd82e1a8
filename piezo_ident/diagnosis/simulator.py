# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The whole model over the rows, run again and again with little changed.

Candidates, finite differences and the joint fit all need the prediction with other weights or
other effects.  What lies before the change in the chain is kept from the run before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.effects import Effect, find_effect
from piezo_ident.effects.trials import number_of, with_number
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.operators.chain import Block, Operator
from piezo_ident.operators.dynamics import DelayOperator, Dynamics, DynamicsOperator, filter_arx
from piezo_ident.operators.hysteresis import Hysteresis, HysteresisOperator
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.residual.stretches import block_means

__all__ = [
    'RETUNING',
    'Added',
    'FreeParameter',
    'Simulator',
    'State',
    'free_parameters',
    'retuned',
]

Array = NDArray[np.float64]

#: corner frequencies of the relaxations that a retuned G may show [Hz]
RELAXATIONS = (15.0, 100.0)
#: how far G may be retuned: about samples of delay, their squares, and two relaxations
RETUNING = (20.0, 800.0, 1.0, 1.0)
#: a retuned G follows its law up to so many times the highest frequency that is driven
BEYOND = 4.0
#: what the product of G and its factor may lose by rounding
ROUNDING = 1e-4
#: finite difference of the logarithm of a parameter
LOG_STEP = 1e-2


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
    law : HysteresisLaw or None
        The family of H; None for an H that is taken as it is.
    coefficients : ndarray, shape (size,)
        Those of the law.
    """

    hysteresis: Hysteresis
    offsets: Array
    effects: tuple[Added, ...] = ()
    retuning: tuple[float, ...] = ()
    law: HysteresisLaw | None = None
    coefficients: Array = field(default_factory=lambda: np.empty(0))

    def with_coefficients(self, law: HysteresisLaw, coefficients: Array) -> State:
        """Return the state with another H of a family."""
        theta = np.maximum(coefficients, law.lower)
        return replace(self, hysteresis=law.hysteresis(theta), law=law, coefficients=theta)

    def with_effect(self, added: Added) -> State:
        """Return the state with one more effect."""
        return replace(self, effects=(*self.effects, added))


@dataclass(frozen=True)
class FreeParameter:
    """
    One number that the fit may move, in one record or (None) in all.

    It belongs to an effect, by its place in the state, or (None) to the retuning of G.
    """

    effect: int | None
    record: int | None
    name: str
    index: int | None
    logarithmic: bool
    step: float
    lower: float
    upper: float

    def get(self, state: State) -> float:
        """Return its value."""
        if self.effect is None:
            return state.retuning[self.index or 0]
        return number_of(
            state.effects[self.effect].values[self.record or 0], self.name, self.index
        )

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


def free_parameters(state: State, records: int) -> tuple[FreeParameter, ...]:
    """Return every number of G's retuning and of the effects that the fit may move."""
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
            # the amplitude of what follows time is another one in each record
            per_record = effect.time_driven and p.step > 0.0
            for k in range(records) if per_record else (None,):
                for index in range(np.size(value)) if p.vector else (None,):
                    number = number_of(added.values[0], p.name, index)
                    if np.isfinite(number) and not (is_log and number <= 0.0):
                        found.append(
                            FreeParameter(i, k, p.name, index, is_log, step, p.lower, p.upper)
                        )
    return tuple(found)


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
            dynamics=retuned(
                self.model.dynamics, state.retuning, self.model.sample_rate, self._band
            ),
            effects=(*self.model.effects, *settings),
        )

    @property
    def _band(self) -> float:
        """What a retuned G does not grow beyond [Hz]."""
        return BEYOND * self.rows.highest_frequency

    def holds_retuning(self, state: State) -> bool:
        """Return whether one filter can stand for G and its factor."""
        G, rate = self.model.dynamics, self.model.sample_rate
        return not any(state.retuning) or retuned(G, state.retuning, rate, self._band) is not G

    def base_columns(self, law: HysteresisLaw) -> Array:
        """
        Return what G makes of the columns of a law, as rows; shape (n, size).

        Effects are left out of these columns: they change them by a few percent, and only the
        path to the optimum depends on that.
        """
        G, delay = self.model.dynamics, self.model.delay
        out = np.empty((self.rows.n, law.size))
        start = 0
        for run, memory, keep in zip(
            self.rows.runs, self.rows.memories, self.rows.keep, strict=True
        ):
            stop = start + int(keep.sum())
            for j, raw in enumerate(law.columns(run.u, memory(law.thresholds))):
                passed = filter_arx(G.a, G.b, delay.apply(raw))
                out[start:stop, j] = block_means(passed, self.rows.m)[keep]
            start = stop
        return out

    def bare(self, state: State) -> Array:
        """Return the rows of H, G and the delay alone; shape (n,)."""
        G, delay, h = self.model.dynamics, self.model.delay, state.hysteresis
        signals = [
            filter_arx(G.a, G.b, delay.apply(h(run.u, memory(h.thresholds))))
            for run, memory in zip(self.rows.runs, self.rows.memories, strict=True)
        ]
        return self.rows.of(signals)

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
        alone = replace(state, retuning=())
        model = self.model_of(alone, int(self.rows.record[run_index]))
        memory = self.rows.memories[run_index](state.hysteresis.thresholds)
        operators = model.chain(memory).operators
        if state.retuning:
            # a link of its own: one filter of so high an order would lose its digits
            factor = retuning_factor(state.retuning, model.sample_rate, self._band)
            after = 1 + _place(None, operators)
            operators = (*operators[:after], DynamicsOperator(factor), *operators[after:])
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


def retuning_factor(
    retuning: Sequence[float], sample_rate: float, band: float = np.inf
) -> Dynamics:
    """
    Return a factor of G near one.

    ``1 + c_1 D + c_2 D^2 + sum_j c_j (1 - z^-1) / (1 - p_j z^-1)`` with p_j the poles of
    `RELAXATIONS`: a delay, a roll-off, and relaxations.  D is ``1 - z^-1`` up to the band [Hz]
    that the data drive, and does not grow beyond it, where they say nothing.  It is 1 at rest, and
    c_1 acts like minus a delay in samples at low frequencies.
    """
    c1, c2, c3, c4 = retuning
    # polynomials in z^-1
    D = np.array([1.0, -1.0])
    p = float(np.exp(-2.0 * np.pi * band / sample_rate))
    limited, B = (1.0 - p) * D, np.array([1.0, -p])
    P, Q = (np.array([1.0, -np.exp(-2.0 * np.pi * f / sample_rate)]) for f in RELAXATIONS)
    BB, PQ = np.convolve(B, B), np.convolve(P, Q)
    terms = (
        np.convolve(BB, PQ),
        c1 * np.convolve(np.convolve(limited, B), PQ),
        c2 * np.convolve(np.convolve(limited, limited), PQ),
        c3 * np.convolve(np.convolve(Q, D), BB),
        c4 * np.convolve(np.convolve(P, D), BB),
    )
    factor = np.sum([np.pad(term, (0, 5 - term.size)) for term in terms], axis=0)
    return Dynamics(a=np.convolve(BB, PQ)[1:], b=factor)


def retuned(
    dynamics: Dynamics, retuning: Sequence[float], sample_rate: float, band: float = np.inf
) -> Dynamics:
    """
    Return G times its factor; G alone where the product of both would lose its digits.

    A high order at a high sampling rate leaves few digits for four more poles near 1.
    """
    if not any(retuning):
        return dynamics
    factor = retuning_factor(retuning, sample_rate, band)
    a = np.convolve([1.0, *dynamics.a], [1.0, *factor.a])[1:]
    product = Dynamics(a=a, b=np.convolve(dynamics.b, factor.b))
    f = np.geomspace(1e-5, 0.4, 60) * sample_rate
    exact = dynamics.response(f, sample_rate) * factor.response(f, sample_rate)
    lost = np.abs(product.response(f, sample_rate) - exact).max() / np.abs(exact).max()
    return product if lost < ROUNDING and product.is_stable else dynamics


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

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The whole model over the rows, run again and again with little changed.

Candidates, finite differences and the joint fit all need the prediction with other weights or
other effects.  What lies before the change in the chain is kept from the run before.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.diagnosis.changes import Behind
from piezo_ident.diagnosis.retuning import (
    BEYOND,
    retuned,
    RETUNING,
    retuning_factor,
    retuning_terms,
)
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.run_chain import (
    asked_once,
    columns_of,
    effects_around,
    place_of,
    place_of_core,
    RunChain,
)
from piezo_ident.effects import Effect, find_effect
from piezo_ident.effects.trials import number_of, with_number
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.operators.chain import Block
from piezo_ident.operators.dynamics import DelayOperator, DynamicsOperator, filter_arx
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import HysteresisLaw

__all__ = [
    'Added',
    'FreeParameter',
    'Simulator',
    'State',
    'free_parameters',
]

Array = NDArray[np.float64]

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
        self._sources = [
            Block(t=rows.time(i), v=run.u, x=run.u, channels=run.piece.channels)
            for i, run in enumerate(rows.runs)
        ]
        #: for each run what H made last, and of what
        self._answers: list[list[Any]] = [[] for _ in rows.runs]
        self._kept: _Kept | None = None

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
        Return what G makes of the columns of a law, as rows; shape (size, n).

        Effects are left out of these columns: they change them by a few percent, and only the
        path to the optimum depends on that.
        """
        links = (DynamicsOperator(self.model.dynamics), DelayOperator(self.model.delay))
        parts = []
        for source, memory in zip(self._sources, self.rows.memories, strict=True):
            behind = Behind(links, (float(source.x[0]),), (source,), self.rows.m)
            raw = law.columns(source.x, memory(law.thresholds))
            parts.append(np.stack([behind.rows(x, float(x[0])) for x in raw]))
        return self._joined(parts)

    def columns(self, state: State, law: HysteresisLaw, step: float) -> Array:
        """
        Return what the whole chain makes of a step of each coefficient of H; shape (size, n).

        Of a state that is remembered, divided by the step.
        """
        parts = []
        for i, chain in enumerate(self._known(state).chains):
            core = place_of_core(chain.operators)
            behind, before = chain.behind(core + 1, self.rows.m), chain.blocks[core]
            memory = self.rows.memories[i](law.thresholds)
            kinds = {effect.of_hysteresis for effect in effects_around(chain.operators[core])}
            changes: Iterator[Array]
            if kinds <= {'not', 'linear'}:
                changes = (step * raw for raw in columns_of(chain, core, law, memory))
            else:
                moved = (
                    state.with_coefficients(law, state.coefficients + delta)
                    for delta in step * np.eye(law.size)
                )
                cores = (self._chain(s, i).operators[core] for s in moved)
                changes = (op.process(before).x - chain.blocks[core + 1].x for op in cores)
            parts.append(np.stack([behind.rows(x, float(x[0])) for x in changes]) / step)
        return self._joined(parts)

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
        if self._kept is not None and self._kept.state is state:
            return self._kept.prediction
        return self._predicted(state, [chain.output() for chain in self._chains(state)])

    def full(self, state: State) -> list[Array]:
        """Return the prediction of each run at the full rate, normalised."""
        chains = zip(self._chains(state), self.rows.record, strict=True)
        return [chain.output() + state.offsets[k] for chain, k in chains]

    def remember(self, state: State) -> Array:
        """Return the predicted rows, and keep what runs between the links."""
        if self._kept is None or self._kept.state is not state:
            # gives the room back first
            self._kept = None
            chains = list(self._chains(state))
            outputs = [chain.output(keep=True) for chain in chains]
            self._kept = _Kept(state, tuple(chains), self._predicted(state, outputs))
        return self._kept.prediction

    def added(self, effect: Added) -> Array:
        """Return by how much rows of the remembered state change with one more effect."""
        return self.varied(self._known().state.with_effect(effect), effect.effect)

    def varied(self, state: State, effect: type[Effect] | None) -> Array:
        """
        Return by how much the rows of a state differ from those of the remembered one.

        The states differ in one place, an effect or (None) the factor of G; the chain is only run
        from there.
        """
        changes = [
            after.difference(before, place_of(effect, after.operators), self.rows.m)
            for before, after in zip(self._known().chains, self._chains(state), strict=True)
        ]
        return self._joined(changes)

    def filtered(self, parameters: Sequence[FreeParameter]) -> dict[int, Array]:
        """
        Return derivatives of the rows by those parameters that scale a filter of a signal.

        Of the remembered state, by the place of the parameter.
        """
        kept, rate = self._known(), self.model.sample_rate
        terms = retuning_terms(rate, self._band)
        found: dict[int | None, dict[int, Array]] = {}
        for j, parameter in enumerate(parameters):
            i, k = parameter.effect, parameter.index or 0
            section: Array | None
            if i is None:
                section = terms[k]
            else:
                added = kept.state.effects[i]
                section = added.effect.section(rate, added.values[0], parameter.name, k)
            if section is not None:
                found.setdefault(i, {})[j] = section
        columns: dict[int, Array] = {}
        for i, sections in found.items():
            effect = None if i is None else kept.state.effects[i].effect
            stacked = np.stack(list(sections.values()))
            parts = [
                chain.filtered(place_of(effect, chain.operators), stacked, self.rows.m)
                for chain in kept.chains
            ]
            whole = [part for part in parts if part is not None]
            if len(whole) == len(parts):
                columns |= dict(zip(sections, self._joined(whole), strict=True))
        return columns

    def _known(self, state: State | None = None) -> _Kept:
        if self._kept is None or state not in (None, self._kept.state):
            raise ValueError('remember the state first')
        return self._kept

    def _predicted(self, state: State, outputs: Sequence[Array]) -> Array:
        return self.rows.of(outputs) + state.offsets[self.rows.of_record]

    def _joined(self, parts: Sequence[Array]) -> Array:
        """Return the rows that count of all rows of each run, shape (n // m,) or (k, n // m)."""
        kept = [
            part if keep.all() else part[..., keep]
            for part, keep in zip(parts, self.rows.keep, strict=True)
        ]
        return kept[0] if len(kept) == 1 else np.concatenate(kept, axis=-1)

    def _chains(self, state: State) -> Iterator[RunChain]:
        """Give the chain of each run."""
        return (self._chain(state, i) for i in range(len(self._sources)))

    def _chain(self, state: State, i: int) -> RunChain:
        alone = replace(state, retuning=())
        model = self.model_of(alone, int(self.rows.record[i]))
        memory = self.rows.memories[i](state.hysteresis.thresholds)
        operators = [
            asked_once(operator, self._answers[i]) for operator in model.chain(memory).operators
        ]
        if state.retuning:
            # a link of its own: one filter of so high an order would lose its digits
            factor = retuning_factor(state.retuning, model.sample_rate, self._band)
            after = 1 + place_of(None, operators)
            operators.insert(after, DynamicsOperator(factor))
        return RunChain(operators, self._sources[i])


@dataclass(frozen=True, eq=False)
class _Kept:
    """A state that was run, its chains and rows."""

    state: State
    chains: tuple[RunChain, ...]
    prediction: Array

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Run the whole model over the rows, many times with small changes.

Candidates, finite differences and the joint fit need the prediction for other weights or other
effects.  The signals before the changed link are kept from the previous run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
import functools
from functools import partial
import itertools
import os
from typing import Any, TypeVar

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.diagnosis.criteria import SMALLEST_EFFECT
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.run_chain import (
    asked_once,
    Behind,
    columns_of,
    moving_effects,
    place_of,
    place_of_core,
    run_abreast,
    RunChain,
)
from piezo_ident.diagnosis.state import BEYOND, retuned, retuning_factor, State
from piezo_ident.effects import Effect
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.operators.chain import Block
from piezo_ident.operators.dynamics import DelayOperator, DynamicsOperator, filter_arx
from piezo_ident.operators.hysteresis_law import HysteresisLaw, LAWS

T = TypeVar('T')
#: state with a change of an effect, or of the factor of G, in a record or in all; and a run
Task = tuple[State, type[Effect] | None, int | None, int]

#: largest number of runs that are computed side by side
MOST_THREADS = 8


class Simulator:
    """Simulation of a model over rows; its own G, delay, scaling and effects stay fixed."""

    def __init__(self, model: StageModel, rows: Rows) -> None:
        self.model = model
        self.rows = rows
        self._sources = [
            Block(t=rows.time(i), v=run.u, x=run.u, channels=run.piece.channels)
            for i, run in enumerate(rows.runs)
        ]
        #: for each run the last output of H, and its input
        self._answers: list[list[Any]] = [[] for _ in rows.runs]
        self._kept: _Kept | None = None
        #: columns of the last law, filtered through G
        self._of_law: tuple[Any, Array] | None = None
        #: columns that only add to the displacement, and their time constants
        self._added: tuple[tuple[float, ...], Array] | None = None
        #: compiled loops release the interpreter, so runs and states are computed side by side;
        #: each needs memory for some signals as long as a run
        self._threads = min(MOST_THREADS, os.cpu_count() or 1)
        self._pool = ThreadPoolExecutor(self._threads)
        self._copies: list[Simulator] = []

    def copies(self, count: int) -> list[Simulator]:
        """Return simulators of the same rows, this one first; at most one for each processor."""
        while len(self._copies) < min(count - 1, self._threads - 1):
            self._copies.append(Simulator(self.model, self.rows))
        return [self, *self._copies[: count - 1]]

    def forget(self) -> None:
        """Free the memory of the signals that were kept from the previous run."""
        self._kept = None
        for answer in self._answers:
            answer.clear()

    def model_of(self, state: State, record: int = 0) -> StageModel:
        """Return the model of a state, with the parameters of the effects in one record."""
        settings = [EffectSetting(a.name, a.values[record]) for a in state.effects]
        G, delay = state.linear or (self.model.dynamics, self.model.delay)
        return replace(
            self.model,
            hysteresis=state.hysteresis,
            dynamics=retuned(G, state.retuning, self.model.sample_rate, self._band),
            delay=delay,
            effects=(*self.model.effects, *settings),
        )

    @property
    def _band(self) -> float:
        """Frequency above which the retuning of G does not grow [Hz]."""
        return BEYOND * self.rows.highest_frequency

    @functools.cached_property
    def is_fast(self) -> bool:
        """Whether G and the delay change the signal by as much as an effect."""
        G, delay = self.model.dynamics, self.model.total_delay
        lags = [filter_arx(G.a, G.b, delay.apply(r.u)) / G.gain - r.u for r in self.rows.runs]
        return self.rows.percent(float(np.mean(self.rows.of(lags) ** 2))) >= SMALLEST_EFFECT

    def base_columns(self, law: HysteresisLaw, more: Array) -> Array:
        """
        Filter the columns of a law through G, and append the rows `more`; shape (size + k, n).

        The columns omit effects, which change them by a few percent: the optimum stays.
        """
        # the widest law contains the terms of all narrower laws except the bias
        wide = law if law.name == 'bias' else replace(law, name=LAWS[-1])
        key = (wide.name, wide.span, tuple(wide.thresholds))
        if self._of_law is None or self._of_law[0] != key:
            self._of_law = None
            self._of_law = key, self._of_columns(wide.size, partial(self._behind_G, wide))
        whole = self._of_law[1]
        places = range(law.size) if law.name == wide.name else law.within(wide)
        return np.stack([*(whole[place] for place in places), *more])

    def _behind_G(self, law: HysteresisLaw, i: int, places: range) -> Iterator[Array]:
        """Yield the rows of some columns of a law in a run."""
        links = (DynamicsOperator(self.model.dynamics), DelayOperator(self.model.delay))
        source = self._sources[i]
        behind = Behind(links, (float(source.x[0]),), (source,), self.rows.m)
        raw = law.columns(source.x, self.rows.memories[i](law.thresholds), places)
        return (behind.rows(x, float(x[0])) for x in raw)

    def columns(self, state: State, law: HysteresisLaw, step: float, more: Array) -> Array:
        """
        Compute the change of the rows, per step, for a step of each coefficient of H.

        The state must be remembered.  The rows `more`, shape (k, n), are appended; the result has
        the shape (size + k, n).
        """
        chains = self._known(state).chains

        def of_run(i: int, places: range) -> Iterator[Array]:
            # each call builds its own links, as another thread may run the same chain
            chain = self._chain(state, i)
            chain.blocks = chains[i].blocks
            core = place_of_core(chain.operators)
            behind, before = chain.behind_core(self.rows.m), chain.blocks[core]
            memory = self.rows.memories[i](law.thresholds)
            kinds = [effect.of_hysteresis for effect in moving_effects(chain.operators[core])]
            changes: Iterator[Array]
            if kinds in ([], ['linear']):
                changes = (step * raw for raw in columns_of(chain, core, law, memory, places))
            else:
                moved = (
                    state.with_coefficients(law, state.coefficients + delta)
                    for delta in step * np.eye(law.size)[places]
                )
                cores = (self._chain(s, i).operators[core] for s in moved)
                changes = (op.process(before).x - chain.blocks[core + 1].x for op in cores)
            return (behind.rows(x, float(x[0])) / step for x in changes)

        found = self._of_columns(law.size, of_run, len(more))
        found[law.size :] = more
        return found

    def added_columns(self, state: State) -> Array:
        """Return a column for each number of `State.only_adds`; shape (n, records (1 + times))."""
        times = state.fading
        if self._added is None or self._added[0] != times:
            rows = self.rows
            of = (rows.of_record[:, None] == np.arange(len(rows.names))).astype(np.float64)
            fading = [rows.fading(i, times) for i in range(len(rows.runs))]
            decays = [rows.of([x[k] for x in fading]) for k in range(len(times))]
            parts = [record * decay for record in of.T for decay in decays]
            self._added = times, np.array([*of.T, *parts]).T
        return self._added[1]

    def crept(self, state: State) -> Array:
        """Compute creep from motion before the records in each row; shape (n,)."""
        return self.added_columns(state)[:, state.offsets.size :] @ state.earlier.ravel()

    def bare(self, state: State) -> Array:
        """Compute the rows of H, G and the delay alone; shape (n,)."""
        G, delay, h = self.model.dynamics, self.model.delay, state.hysteresis
        signals = [
            filter_arx(G.a, G.b, delay.apply(h(run.u, memory(h.thresholds))))
            for run, memory in zip(self.rows.runs, self.rows.memories, strict=True)
        ]
        return self.rows.of(signals)

    def run(self, state: State) -> Array:
        """Predict the rows; shape (n,)."""
        if self._kept is not None and self._kept.state is state:
            return self._kept.prediction
        return self._predicted(state, self._of_runs(lambda i: self._chain(state, i).output()))

    def into_g(self, state: State) -> list[Array]:
        """Compute the signal in front of G in each run, normalised."""
        state = replace(state, retuning=())
        chains = self._of_runs(lambda i: self._chain(state, i))
        self._of_runs(lambda i: chains[i].output(keep=True))
        return [chain.blocks[place_of(None, chain.operators)].x for chain in chains]

    def full(self, state: State) -> list[Array]:
        """Predict each run at the full rate, normalised."""
        outputs = self._of_runs(lambda i: self._chain(state, i).output())
        found = [x + state.offsets[k] for x, k in zip(outputs, self.rows.record, strict=True)]
        if state.fading:
            for i, k in enumerate(self.rows.record):
                found[i] += state.earlier[k] @ self.rows.fading(i, state.fading)
        return found

    def remember(self, state: State) -> Array:
        """Predict the rows, and keep the signals between the links."""
        if self._kept is None or self._kept.state is not state:
            # free the memory of the earlier signals first
            self._kept = None
            chains = self._of_runs(lambda i: self._chain(state, i))
            outputs = self._of_runs(lambda i: chains[i].output(keep=True))
            self._kept = _Kept(state, tuple(chains), self._predicted(state, outputs))
        return self._kept.prediction

    def varied(
        self, changes: Sequence[tuple[State, type[Effect] | None, int | None]]
    ) -> list[Array | None]:
        """
        Compute the difference of the rows of each state from the rows of the remembered state.

        Each state differs in one place: an effect, or the factor of G (None).  It differs in one
        record, or in all (None).  The chain runs from this place on.  A state that cannot run has
        None.
        """
        before, runs = self._known().chains, range(len(self._sources))
        tasks = [(*change, i) for change in changes for i in runs]
        changed = list(self._pool.map(self._changed, tasks))
        for effect in dict.fromkeys(effect for _, effect, _ in changes if effect is not None):
            for i in runs:
                of_effect = ((task[1] is effect and task[3] == i) for task in tasks)
                run_abreast(effect, list(itertools.compress(changed, of_effect)), before[i])

        def of_run(task: Task, one: tuple[RunChain, int] | None) -> Array | None:
            *_, record, i = task
            if record is not None and record != self.rows.record[i]:
                return np.zeros(self.rows.keep[i].size)
            try:
                return None if one is None else one[0].difference(before[i], one[1], self.rows.m)
            except ModelError:
                return None

        # a run alone leaves the other processors to the other states
        parts = list(self._pool.map(of_run, tasks, changed))
        found: list[Array | None] = []
        for k in range(0, len(parts), len(runs)):
            kept = [
                part[keep]
                for part, keep in zip(parts[k : k + len(runs)], self.rows.keep, strict=True)
                if part is not None
            ]
            found.append(np.concatenate(kept) if len(kept) == len(runs) else None)
        return found

    def _changed(self, task: Task) -> tuple[RunChain, int] | None:
        """Return the chain of a state with the place of its change; None if it cannot run."""
        state, effect, record, i = task
        if record is not None and record != self.rows.record[i]:
            return None
        try:
            chain = self._chain(state, i)
        except ModelError:
            return None
        return chain, place_of(effect, chain.operators)

    def sloped(self, wanted: Sequence[tuple[int | None, str]]) -> dict[int, Array]:
        """
        Compute the derivatives that effects of the remembered state know themselves.

        An entry of `wanted` holds the place of an effect, or None, and the name of a parameter.
        The keys of the result are places in `wanted`.
        """
        kept = self._known()
        columns: dict[int, Array] = {}
        for i in sorted({i for i, _ in wanted if i is not None}):
            effect = kept.state.effects[i].effect
            if effect.slot != 'hysteresis':
                continue
            slopes = self._of_runs(partial(self._slopes, effect))
            known = [j for j, (own, name) in enumerate(wanted) if own == i and name in slopes[0]]
            names = [wanted[j][1] for j in known]
            whole = self._of_columns(len(names), partial(self._behind_core, slopes, names))
            columns |= dict(zip(known, whole, strict=True))
        return columns

    def _slopes(self, effect: type[Effect], i: int) -> Mapping[str, Array]:
        kept = self._known()
        return self._chain(kept.state, i).slopes(effect, kept.chains[i].blocks)

    def _behind_core(
        self, slopes: Sequence[Mapping[str, Array]], names: Sequence[str], i: int, places: range
    ) -> list[Array]:
        kept, own = self._known(), [slopes[i][names[k]] for k in places]
        chain = self._chain(kept.state, i)
        return chain.of_slopes(own, kept.chains[i].blocks, self.rows.m)

    def _of_runs(self, function: Callable[[int], T]) -> list[T]:
        """Apply a function to the place of each run."""
        return list(self._pool.map(function, range(len(self._sources))))

    def _of_columns(
        self, size: int, function: Callable[[int, range], Iterable[Array]], more: int = 0
    ) -> Array:
        """Collect columns from a function of a run and of places, and leave room for more."""
        keep = self.rows.keep
        ends = np.cumsum([0, *(int(k.sum()) for k in keep)])
        # a single run is shared by all processors; contiguous columns may run side by side
        share = -(-self._threads // len(keep))
        cuts = [size * k // share for k in range(share + 1)]
        tasks = [(i, range(*cut)) for i in range(len(keep)) for cut in itertools.pairwise(cuts)]
        whole = np.empty((size + more, self.rows.n))

        def fill(task: tuple[int, range]) -> None:
            i, places = task
            is_whole = bool(keep[i].all())
            for place, column in zip(places, function(i, places) if places else (), strict=True):
                whole[place, ends[i] : ends[i + 1]] = column if is_whole else column[keep[i]]

        for _ in self._pool.map(fill, tasks):
            pass
        return whole

    def _known(self, state: State | None = None) -> _Kept:
        if self._kept is None or state not in (None, self._kept.state):
            raise ValueError('remember the state first')
        return self._kept

    def _predicted(self, state: State, outputs: Sequence[Array]) -> Array:
        return self.rows.of(outputs) + self.added_columns(state) @ state.only_adds

    def _chain(self, state: State, i: int) -> RunChain:
        alone = replace(state, retuning=())
        model = self.model_of(alone, int(self.rows.record[i]))
        memory = self.rows.memories[i](state.hysteresis.thresholds)
        operators = [
            asked_once(operator, self._answers[i]) for operator in model.chain(memory).operators
        ]
        if state.retuning:
            # the factor is a link of its own: one filter of the total order would lose digits
            factor = retuning_factor(state.retuning, model.sample_rate, self._band)
            after = 1 + place_of(None, operators)
            operators.insert(after, DynamicsOperator(factor))
        return RunChain(operators, self._sources[i])


@dataclass(frozen=True, eq=False)
class _Kept:
    """State that was run, with its chains and rows."""

    state: State
    chains: tuple[RunChain, ...]
    prediction: Array

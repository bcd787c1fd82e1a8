# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Simulate a run link by link, and pass small changes of a signal through the links behind H.

A run is a piece of a record, and a link is one operator of the model.  Most links are linear or
only add to the signal, so a change passes them without the signal, and without the whole chain.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, cast

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.effects import Effect
from piezo_ident.operators.chain import Block, Operator
from piezo_ident.operators.dynamics import DelayOperator, DynamicsOperator
from piezo_ident.operators.hysteresis import HysteresisOperator
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.residual.stretches import block_means

#: size of a scaled derivative that passes a nonlinear link, small enough to act as a small change
SMALL = 1e-6
#: approximate number of samples that pass all links together, so that they stay in the cache
STRETCH = 1 << 14


class Behind:
    """
    Links of a run behind a place in its chain, with the unchanged signal at each link.

    Parameters
    ----------
    operators : sequence of Operator
    rests : sequence of float
        The signal at rest before each link, and behind the last.
    blocks : sequence of Block
        The signal of the whole run at the same places.  The first block is enough if all links are
        linear.
    m : int
        Samples in a row.
    new : bool, optional
        Whether the first link has changed since the blocks were kept.
    """

    def __init__(
        self,
        operators: Sequence[Operator],
        rests: Sequence[float],
        blocks: Sequence[Block],
        m: int,
        *,
        new: bool = False,
    ) -> None:
        self._rests, self._blocks, self._m = rests, blocks, m
        kinds = [getattr(operator, 'change', 'bent') for operator in operators]
        if new:
            kinds[0] = 'bent'
        links = enumerate(zip(operators, kinds, strict=True))
        self._links = [(k, one, kind == 'linear') for k, (one, kind) in links if kind != 'passed']

    @property
    def bends(self) -> bool:
        """Whether the response to a change is not proportional to the change."""
        return not all(is_linear for *_, is_linear in self._links)

    def rows(self, change: Array | None = None, rest: float = 0.0) -> Array:
        """
        Compute the change of the rows from a change of the incoming signal; shape (n // m,).

        The change, shape (n,), is None if only the first link has changed.  `rest` is the change
        at rest, before the first sample.
        """
        v0 = float(self._blocks[0].v[0])
        for k, operator, is_linear in self._links:
            if is_linear:
                rest = operator.reset(0.0, rest)
            else:
                rest = operator.reset(v0, self._rests[k] + rest) - self._rests[k + 1]
        m, n = self._m, self._blocks[0].x.size
        step = max(1, STRETCH // m) * m
        cuts = [slice(a, min(a + step, n // m * m)) for a in range(0, n // m * m, step)]
        means = [
            block_means(self._passed(cut, None if change is None else change[cut]), m)
            for cut in cuts
        ]
        return np.concatenate(means) if means else np.empty(0)

    def _passed(self, cut: slice, change: Array | None) -> Array:
        """Pass a change through the links over a stretch; stretches must come in order."""
        whole = self._blocks[0]
        channels = {name: x[cut] for name, x in whole.channels.items()}
        block = Block(t=whole.t[cut], v=whole.v[cut], x=whole.x[cut], channels=channels)
        if change is not None:
            block = block.with_signal(change)
        for k, operator, is_linear in self._links:
            if is_linear:
                block = operator.process(block)
                continue
            x = self._blocks[k].x[cut]
            after = operator.process(block.with_signal(x if change is None else x + block.x))
            change = after.x - self._blocks[k + 1].x[cut]
            block = after.with_signal(change)
        return block.x


class RunChain:
    """
    Links of the model for one run, at rest under the first command of the run.

    `rests` holds the signals at rest before each link and behind the last.  `blocks` holds the
    signals of the run at these places, if they are kept.
    """

    def __init__(self, operators: Sequence[Operator], source: Block) -> None:
        self.operators = tuple(operators)
        self.blocks = [source]
        self._u0 = float(source.v[0])
        self.rests = [self._u0]
        for operator in self.operators:
            self.rests.append(operator.reset(self._u0, self.rests[-1]))

    def output(self, *, keep: bool = False) -> Array:
        """Compute the signal behind the last link; optionally keep the signals before it."""
        block = self.blocks[0]
        for operator in self.operators:
            block = operator.process(block)
            if keep:
                self.blocks.append(block)
        return block.x

    def behind_core(self, m: int) -> Behind:
        """Return the links behind H; all blocks must be kept."""
        start = place_of_core(self.operators) + 1
        return Behind(self.operators[start:], self.rests[start:], self.blocks[start:], m)

    def slopes(self, effect: type[Effect], blocks: Sequence[Block]) -> Mapping[str, Array]:
        """Compute the derivatives that an effect around H knows itself, on kept blocks."""
        core = place_of_core(self.operators)
        # all effects around H add to H of the same input, so no slope passes another effect
        around = [one for one in effects_around(self.operators[core]) if type(one) is effect]
        return around[0].slopes(blocks[core]) if around else {}

    def of_slopes(self, slopes: Sequence[Array], blocks: Sequence[Block], m: int) -> list[Array]:
        """Convert derivatives of the output of H to derivatives of all rows."""
        self.blocks = list(blocks)
        behind = self.behind_core(m)
        if not behind.bends:
            return [behind.rows(slope) for slope in slopes]
        sizes = [max(float(np.abs(x).max(initial=0.0)), SMALL**2) / SMALL for x in slopes]
        return [size * behind.rows(x / size) for x, size in zip(slopes, sizes, strict=True)]

    def difference(self, before: RunChain, place: int, m: int) -> Array:
        """Compute the change of all rows from a kept chain that differs in the link at `place`."""
        rests, blocks = before.rests[place:], before.blocks[place:]
        if len(self.operators) > len(before.operators):
            # an effect that was absent before had passed the signal
            rests, blocks = [rests[0], *rests], [blocks[0], *blocks]
        core, block = place_of_core(self.operators), blocks[0]
        if place > core:
            return Behind(self.operators[place:], rests, blocks, m, new=True).rows()
        # links in front of H, and H itself, run until the change is behind H
        for operator in self.operators[place : core + 1]:
            block = operator.process(block)
        k = core + 1 - place
        behind = Behind(self.operators[core + 1 :], rests[k:], blocks[k:], m)
        return behind.rows(block.x - blocks[k].x, self.rests[core + 1] - rests[k])


class _Known:
    """Link whose output for the whole run is known."""

    def __init__(self, output: Array, rest: float) -> None:
        self._output, self._rest, self._at = output, rest, 0

    def reset(self, v0: float, x0: float) -> float:
        """Return the output at rest, and go back to the start of the run."""
        self._at = 0
        return self._rest

    def process(self, block: Block) -> Block:
        """Return the next samples of the output."""
        start, self._at = self._at, self._at + block.x.size
        return block.with_signal(self._output[start : self._at])


def run_abreast(
    effect: type[Effect], changed: Sequence[tuple[RunChain, int] | None], before: RunChain
) -> None:
    """
    Run the links of an effect behind H together, if they then run faster, and keep their outputs.

    The chains differ from the kept chain `before` in this effect alone, at the given places.
    """
    own = [one for one in changed if one and type(one[0].operators[one[1]]) is effect]
    if not own or own[0][1] <= place_of_core(before.operators):
        return
    links = [cast(Effect, chain.operators[place]) for chain, place in own]
    outputs = effect.abreast(links, before.blocks[own[0][1]])
    for (chain, place), output in zip(own, outputs or (), strict=False):
        known = _Known(output, chain.rests[place + 1])
        chain.operators = (*chain.operators[:place], known, *chain.operators[place + 1 :])


class _Once(HysteresisOperator):
    """H that keeps its last output, as the effects around it ask for it repeatedly."""

    def __init__(self, operator: HysteresisOperator, answer: list[Any]) -> None:
        self.__dict__.update(operator.__dict__)
        self._answer = answer

    def process(self, block: Block) -> Block:
        """Return the block with H applied to its signal."""
        # read once, as another thread may replace the answer
        known = self._answer[0] if self._answer else None
        if known is None or known[0] is not self.hysteresis or known[1] is not block.x:
            known = self.hysteresis, block.x, super().process(block).x
            self._answer[:] = [known]
        return block.with_signal(known[2])


def asked_once(operator: Operator, answer: list[Any]) -> Operator:
    """Return a link whose H, if any, keeps its last output in a list."""
    around = effects_around(operator)
    core = around[-1].inner if around else operator
    if not isinstance(core, HysteresisOperator):
        return operator
    once = _Once(core, answer)
    if not around:
        return once
    around[-1].inner = once
    return operator


def columns_of(
    chain: RunChain, core: int, law: HysteresisLaw, memory: Array, places: Sequence[int]
) -> Iterator[Array]:
    """
    Yield the response of H, with the effects around it, to each of some coefficients.

    The blocks of the chain must be kept, with H at the place `core`; `memory` and `places` as in
    `HysteresisLaw.columns`.
    """
    before, rest = chain.blocks[core], chain.rests[core]
    moving = moving_effects(chain.operators[core])
    if not moving:
        yield from law.columns(before.x, memory, places)
        return
    parts = ((part, memory[own]) for part, own in law.parts(places))
    yield from moving[0].of_parts(before, rest, parts)


def place_of(effect: type[Effect] | None, operators: Sequence[Operator]) -> int:
    """Find the first link whose output depends on an effect, or on the factor of G."""
    if effect is None:
        return max(i for i, op in enumerate(operators) if isinstance(op, DynamicsOperator))
    if effect.slot == 'hysteresis':
        return place_of_core(operators)
    for i in range(len(operators) - 1, -1, -1):
        if type(operators[i]) is effect:
            return i
    # the effect has no link of its own, as it is part of the delay
    return next(i for i, operator in enumerate(operators) if isinstance(operator, DelayOperator))


def place_of_core(operators: Sequence[Operator]) -> int:
    """Find the link with H and the effects around H."""
    cores = (isinstance(op, HysteresisOperator) or effects_around(op) for op in operators)
    return next(i for i, is_core in enumerate(cores) if is_core)


def effects_around(operator: Operator) -> list[Effect]:
    """List the effects around H, the outermost first."""
    found = []
    while isinstance(operator, Effect) and operator.slot == 'hysteresis':
        found.append(operator)
        operator = operator.inner
    return found


def moving_effects(operator: Operator) -> list[Effect]:
    """List the effects around H whose contribution depends on the coefficients of H."""
    return [effect for effect in effects_around(operator) if effect.of_hysteresis != 'not']

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What tests play and compare: a short program, its blocks, the stage's answer, models as numbers.

Blocks are large, so that a whole record fits into the queues of its readers, whatever else the
machine does.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
import itertools

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.config import find_config
from piezo_ident.common.files import parse_yaml
from piezo_ident.excitation.program import parse_program
from piezo_ident.model.files import model_from_dict
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.blocks import cut_blocks, Samples
from piezo_ident.record.record import Record
from programs import identification_program
import yaml

FS = 20_000.0
#: three seconds with all that the three steps stand on
PROGRAM = identification_program(steps=8, cycles=8, frequency=20, noise=1, slope=40)
#: a second of this and that
SHORT = """
limits: [0, 10]
slew: 50
segments:
  - {signal: idle, duration: 0.05}
  - {signal: step, bias: 5, size: 1, hold: 0.0501, count: 3}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 3000, duration: 0.3}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 50, duration: 0.4}
"""
#: near the upper limit for long enough to be stopped there
HIGH = """
limits: [0, 10]
slew: 200
segments:
  - {signal: hold, level: 9, duration: 120}
"""
#: parameters of an identifier that is quick
SETTINGS = {'max_order': 6, 'swarm_iterations': 20_000, 'thresholds': 10, 'solver': 'swarm'}
#: the same for one that may take what it can get of the machine
QUICK = {**SETTINGS, 'nice': 0}
SIZE = 1000


def paper(**changes: object) -> str:
    """Return the YAML of the paper's stage as a model."""
    data = yaml.safe_load(find_config('paper', 'stage').read_text())
    data.pop('sensor')
    data.pop('seed')
    return yaml.safe_dump({**data, **changes})


def model_of(text: str) -> StageModel:
    """Return the model in a text."""
    return model_from_dict(parse_yaml(text, 'test'))


def numbers(model: StageModel) -> NDArray[np.float64]:
    """Return all parameters of a model."""
    h, g, s = model.hysteresis, model.dynamics, model.scaling
    single = [h.p1, h.p2, s.v0, s.V, s.y0, s.Y, model.delay.total]
    return np.concatenate([h.thresholds, h.weights, single, g.a, g.b])


def block(
    tick: int, values: ArrayLike, segment: str = 'hold', quantity: str = 'voltage'
) -> Samples:
    """Return a block from a tick on."""
    x = np.asarray(values, dtype=np.float64)
    return Samples(np.arange(tick, tick + x.size) / FS, x, segment, quantity)


def level(value: float, blocks: int, tick: int = 0, segment: str = 'hold') -> list[Samples]:
    """Return blocks of 100 samples of a constant voltage."""
    return [block(tick + 100 * k, np.full(100, value), segment) for k in range(blocks)]


def column(blocks: Iterable[Samples]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return t and values of blocks in one piece."""
    several = list(blocks)
    return np.concatenate([b.t for b in several]), np.concatenate([b.values for b in several])


def cut(samples: Samples, *at: int) -> list[Samples]:
    """Return a block cut into smaller ones."""
    edges = [0, *at, samples.t.size]
    return [
        replace(samples, t=samples.t[a:b], values=samples.values[a:b])
        for a, b in itertools.pairwise(edges)
    ]


def voltage_of(program: str, size: int = SIZE) -> list[Samples]:
    """Return the blocks of a program."""
    sequence = parse_program(program).build(FS)
    return [
        block(a, sequence.v[a:b], label)
        for a, b, label in cut_blocks(sequence.n, sequence.segments, size)
    ]


def simulated(program: str = PROGRAM, seed: int = 1) -> Record:
    """Return what the paper's stage answers."""
    stage = SimulatedStage.load('paper')
    return stage.play(parse_program(program).build(), np.random.default_rng(seed))


def pairs_of(record: Record, size: int = SIZE) -> list[tuple[Samples, Samples]]:
    """Return (voltage, displacement) of each block of a record of one piece."""
    (piece,) = record
    return [
        (
            Samples(piece.t[a:b], piece.v[a:b], label, 'voltage'),
            Samples(piece.t[a:b], piece.y[a:b], label, 'displacement'),
        )
        for a, b, label in cut_blocks(piece.n, piece.segments, size)
    ]


def first_of(blocks: Sequence[Samples], segment: str) -> int:
    """Return which block begins a segment."""
    return next(i for i, b in enumerate(blocks) if b.segment == segment)

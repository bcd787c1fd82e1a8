# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Draws of the noise of a record: whether the quantities of its models scatter as they state.

A stage on the model's grid is a sum of plays with known quantities.  Off the grid, the quantities
of the fit without noise are the reference, and what this fit itself misses is no scatter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import functools
import itertools

import numpy as np
import piezo_ident as pi
from piezo_ident.excitation.program import parse_program
from piezo_ident.record.record import Piece, Segment
from piezo_ident.uncertainty.parameters import quantities_of, SAME_MODE
from truths import Case, make_family_stage
from truths.linear import pink

#: steps, noise and a triangle from rest, in volts of a stage from 0 to 10 V
PROGRAM = """
limits: [0, 10]
rest: 0
slew: 200
segments:
  - {signal: idle, duration: 0.1}
  - {signal: step, bias: 5, size: 1, hold: 0.03, count: 6}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 3000, duration: 1}
  - {signal: triangle, slope: 60}
  - {signal: idle, duration: 0.1}
"""
#: rms of the noise over the stroke: a capacitive sensor in a laboratory
NOISE = 1e-4
#: grids, noises and records; and the number of the draw without noise, which is the reference
GRIDS, NOISES, RECORDS = ('on', 'off'), ('white', '1/f'), ('labelled', 'unlabelled')
REFERENCE = -1
#: name, value and deviation of quantities
Rows = tuple[tuple[str, float, float], ...]
#: a 95 % interval in deviations
TWO = 2.0


@dataclass(frozen=True)
class DrawTodo:
    """A draw of the noise of one record; `seed` is that of its stage and of its noise."""

    grid: str
    noise: str
    record: str
    number: int
    seed: int
    core: str

    @property
    def variant(self) -> str:
        """Grid, noise and record."""
        return f'{self.grid} {self.noise} {self.record}'

    @property
    def key(self) -> str:
        """Name in the file."""
        noise = 'none' if self.number == REFERENCE else self.noise
        return f'{self.grid} {noise} {self.record} {self.number}'


@dataclass(frozen=True)
class Draw:
    """Quantities with their value and deviation; NaN if none is stated."""

    key: str
    rows: Rows = ()
    error: str = ''


def todo_draws(count: int, seed: int, case: Case) -> list[DrawTodo]:
    """List the draws, each variant with its reference first."""
    variants = itertools.product(range(REFERENCE, count), GRIDS, NOISES, RECORDS)
    todo = [DrawTodo(grid, x, y, k, seed, case.core) for k, grid, x, y in variants]
    return list({one.key: one for one in todo}.values())


@functools.cache
def _clean(grid: str, seed: int, core: str) -> tuple[Piece, pi.StageModel]:
    """Return a record without noise, in metres, and the model of the stage on the grid."""
    stage = pi.SimulatedStage.load('paper')
    if grid == 'on':
        (piece,) = stage.ideal.play(parse_program(PROGRAM)).pieces
        return piece, stage.model
    family = replace(make_family_stage(core, seed), rate=stage.model.sample_rate)
    sequence = parse_program(PROGRAM).build(sample_rate=family.rate)
    low, high = family.limits
    v = low + 0.1 * (high - low) * sequence.v
    y = family.offset + family.stroke * family.respond(v, 'identification', clean=True)
    segments = tuple(Segment(s.label, s.start, s.stop) for s in sequence.segments)
    return Piece(v, y, family.rate, segments=segments), stage.model


def drawn(todo: DrawTodo) -> Draw:
    """Identify one draw."""
    try:
        piece, model = _clean(todo.grid, todo.seed, todo.core)
        rng = np.random.default_rng([todo.seed, 1 + todo.number])
        white = rng.standard_normal(piece.n)
        noise = pink(white) if todo.noise == '1/f' else white
        size = 0.0 if todo.number == REFERENCE else NOISE * float(np.ptp(piece.y))
        segments = piece.segments if todo.record == 'labelled' else ()
        y = piece.y + size * noise / noise.std()
        record = pi.Record((Piece(piece.v, y, piece.sample_rate, segments=segments),), todo.key)
        result = pi.identify(record)
        rows = result.model.quantities
        if todo.number == REFERENCE and todo.grid == 'on':
            rows = tuple(quantities_of(model, result))
    # one failed draw must not end the study
    except Exception as error:  # noqa: BLE001
        return Draw(todo.key, error=f'{type(error).__name__}: {error}')
    return Draw(
        todo.key,
        tuple((f'{p.part} {p.name}', float(p.value), float(p.std or np.nan)) for p in rows),
    )


@dataclass(frozen=True)
class Quantity:
    """
    How a quantity scattered over the draws of a variant.

    `held` is the share of intervals that hold the reference, and `beside` the same without bias;
    `ratio` is scatter over deviation, and `bias` that over scatter.
    """

    variant: str
    kind: str
    draws: int
    held: float
    beside: float
    ratio: float
    bias: float


def _as_named(rows: Rows, truth: Mapping[str, float]) -> Rows:
    """Name each mode as the nearest mode of the reference; drop what is said to be unknown."""
    known = {name[2:]: f for name, f in truth.items() if name.startswith('G mode')}
    same = {}
    for name, f, _ in rows:
        if name.startswith('G mode'):
            off = {mode: abs(x / f - 1.0) for mode, x in known.items()}
            nearest = min(off, key=off.__getitem__, default='')
            if nearest and off[nearest] < SAME_MODE:
                same[name[2:]] = nearest
    found = []
    for name, value, std in rows:
        what, mode, number = name.partition('mode ')
        if np.isfinite(std) and (not mode or mode + number in same):
            found.append((what + same.get(mode + number, ''), value, std))
    return tuple(found)


def table(draws: Mapping[str, Draw], todo: Sequence[DrawTodo]) -> list[Quantity]:
    """Judge each quantity of each variant that has two draws or more, and deviations."""
    found: dict[tuple[str, str], list[tuple[float, float]]] = {}
    truths = {}
    for grid, record in itertools.product(GRIDS, RECORDS):
        reference = draws.get(f'{grid} none {record} {REFERENCE}', Draw(''))
        truths[grid, record] = {name: value for name, value, _ in reference.rows}
    for one in todo:
        if one.number != REFERENCE and one.key in draws:
            truth = truths[one.grid, one.record]
            for name, value, std in _as_named(draws[one.key].rows, truth):
                found.setdefault((one.variant, name), []).append((value, std))
    rows = []
    for (variant, name), values in found.items():
        grid, _, record = variant.split()
        truth = truths[grid, record]
        value, std = np.array(values).T
        if name not in truth or value.size < 2:
            continue
        off, scatter = value - truth[name], max(float(value.std(ddof=1)), 1e-300)
        held, beside = (float(np.mean(np.abs(x) <= TWO * std)) for x in (off, off - off.mean()))
        kind = 'modes' if 'mode' in name else name.partition(' ')[2].partition(' at ')[0]
        ratio, bias = scatter / float(np.median(std)), float(off.mean()) / scatter
        rows.append(Quantity(variant, kind, value.size, held, beside, ratio, bias))
    return rows

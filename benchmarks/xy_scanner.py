# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
How well a model of two axes predicts and tracks the raster of a scanner.

    python benchmarks/xy_scanner.py docs/xy_study.md --picture docs/images/xy_study.png

The scanner has laws that are not the model's.  The first axis is a Preisach operator with an
uneven density; the second obeys the law of Bouc and Wen, and creeps.  Either axis shakes the
other.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
import functools
from pathlib import Path
import time

from matplotlib.figure import Figure
import numpy as np
import piezo_ident as pi
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.excitation.program import parse_program
from piezo_ident.model.metrics import FORMULA
from piezo_ident.record.record import Piece, Record, Segment
from piezo_ident.report.figures import style
from side_by_side import markdown
from truths.differential import bouc_wen_of
from truths.families import Core, core_of
from truths.linear import Cascade, delayed, relaxation
from truths.linear import RATE as FINE
from truths.preisach import uneven

#: sampling [Hz], stroke [m] and voltages [V] of either axis
RATE, STROKE, LIMITS = 10_000.0, 50e-6, (0.0, 10.0)
#: rms of the sensor noise, step of the converter, and delay [spans, spans, s]
NOISE, STEP, DELAY = 2e-4, 1.2 / 2**16, 0.23e-3
#: what either axis moves of the other; creep of the second axis for each factor e of time
CROSS, CREEP = 0.015, 0.0065
#: modes of the axes, and of the guide through which they shake each other
AXES = (
    Cascade(((190.0, 0.02, 0.93), (610.0, 0.02, 0.07)), (2000.0,)),
    Cascade(((240.0, 0.025, 0.95), (820.0, 0.02, 0.05)), (2500.0,)),
)
GUIDE = Cascade(((310.0, 0.03, 1.0),))
NAMES = {'y': 'Preisach', 'y_b': 'Bouc-Wen, creeps'}
#: raster: lines and frames [Hz], part of the range, length [s], part of a line that counts
LINES, FRAMES, PART, LENGTH, MIDDLE = 10.0, 0.2, 0.9, 10.0, 0.8
#: what was asked for [% of stroke]
WANTED = {'y': 0.3, 'y_b': 0.4}

#: one axis after the other; triangles as fast as lines, so that creep has no time
LEARNING = """
limits: [0, 10]
segments:
  - {signal: idle, duration: 0.3}
  - {signal: step, bias: 5, size: 1, hold: 0.06, count: 16}
  - {signal: settle, bias: 5, amplitude: 0.48, cycles: 24, frequency: 20}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 2000, duration: 4}
  - {signal: triangle, peaks: [2, 4, 6, 8, 10, 7, 5, 3], slope: 80}
  - {signal: decaying_triangle, bias: 5, amplitude: 5, cycles: 10, slope: 80}
  - {signal: idle, duration: 0.3}
"""
#: both axes, the second so much later [s]
LATER = 5.0
MOVING = """
limits: [0, 10]
slew: 40
segments:
  - {signal: idle, duration: 1}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 1, periods: 2}
  - {signal: staircase, levels: [2.5, 7.5, 10, 5, 0], hold: [0.3, 2, 5, 2, 3]}
  - {signal: minor_loops, biases: [2.5, 5, 7.5], amplitude: 1.5, cycles: 2, slope: 24}
  - {signal: decaying_triangle, bias: 5, amplitude: 5, cycles: 8, slope: 120}
  - {signal: multisine, bias: 5, amplitude: 4, lowest: 1, highest: 120, period: 1, periods: 2}
  - {signal: idle, duration: 0.5}
"""

TEXT = """\
# A raster of a simulated scanner

This page shows how well the raster of a simulated scanner is predicted and tracked
(`make study-xy`). The model lacks the laws of the scanner. The first axis is a Preisach
operator with an uneven density and a mode at 190 Hz. The second axis obeys the law of Bouc and
Wen, has a mode at 240 Hz and creeps by {creep:.1f} % a decade. Either axis moves the other by
{cross:g} %, through its own mode and one of the guide at 310 Hz. The rate is {rate:g} kHz; the
sensors have {noise:g} % of noise.

One record of {seconds:.0f} s taught the model. Each axis played its three steps while the other
one rested ({learn:.0f} s, `pi.identify`); then both moved ({move:.0f} s, `pi.diagnose`). The
raster took no part. It has lines of {lines:g} Hz and frames of {frames:g} Hz over {part:g} % of
the range, for {length:g} s.

| axis | found | on held-out data before, after [%] |
|---|---|---|
{found}

![Errors along the raster](images/xy_study.png)

*Errors of the refined model along the raster: prediction (top) and tracking (below).*

The error is {formula}, the zero of the sensor included. *Predicted* is the free run from the
voltages. *Tracked* is open loop: the scanner under the voltages of `pi.invert`, against the
wanted motion, on the middle {middle:g} % of each line.

{table}

`pi.invert` took {invert:.1f} s for {length:g} s of raster.
"""


@functools.cache
def cores() -> tuple[Core, Core]:
    """Return the hysteresis of the axes."""
    rng = np.random.default_rng(190)
    first = second = None
    while first is None:
        first = core_of('preisach', uneven(rng), rng.uniform(0.12, 0.16))
    while second is None:
        beta = rng.uniform(0.55, 1.0)
        law = bouc_wen_of(rng.uniform(1.0, 6.0), beta, 1.0 - beta, 1.0)
        second = core_of('bouc_wen', law, rng.uniform(0.12, 0.16))
    return first, second


def respond(v: Array, rng: np.random.Generator) -> Array:
    """Return the displacements [m] under voltages [V], shape (n, 2), from rest at the first."""
    fine = np.repeat(v / LIMITS[1], round(FINE / RATE), axis=0)
    # it has been driven before, so its loops are steady
    way = np.linspace(0.0, 1.0, 2000)
    h = []
    for i, core in enumerate(cores()):
        before = np.concatenate([*[way, way[::-1]] * 3, np.linspace(0.0, fine[0, i], 500)])
        h.append(core(np.concatenate([before, fine[:, i]]))[before.size :])
    h[1] = relaxation(h[1], 'log', CREEP)
    rests = [x[0] for x in h]
    h = [x - rest for x, rest in zip(h, rests, strict=True)]
    own = [G(x) for G, x in zip(AXES, h, strict=True)]
    y = []
    for i, j in ((0, 1), (1, 0)):
        shaken = CROSS * (0.7 * AXES[i](own[j]) + 0.3 * GUIDE(h[j]) + rests[j])
        y.append(delayed(own[i] + rests[i] + shaken, DELAY, FINE)[:: round(FINE / RATE)])
    read = np.stack(y, axis=1) + NOISE * rng.standard_normal(v.shape)
    return np.asarray(STROKE * STEP * np.round(read / STEP))


def measured(
    v: Array, rng: np.random.Generator, segments: tuple[Segment, ...] = (), name: str = 'raster'
) -> Record:
    """Return the record of what the scanner does under two voltages, shape (n, 2)."""
    y = respond(v, rng)
    channels = {'v_b': v[:, 1], 'y_b': y[:, 1]}
    return Record((Piece(v[:, 0], y[:, 0], RATE, 0.0, segments, channels),), name)


def learning() -> tuple[Array, tuple[Segment, ...], int]:
    """Return the voltages of the record that teaches, its labels, and where both axes move."""
    alone = parse_program(LEARNING).build(RATE)
    both = parse_program(MOVING).build(RATE)
    rest, later = np.zeros(alone.n), np.zeros(round(LATER * RATE))
    parts = [
        np.stack([alone.v, rest], axis=1),
        np.stack([rest, alone.v], axis=1),
        np.stack([np.append(both.v, later), np.append(later, both.v)], axis=1),
        *(_there_and_back(raster(axis, 7.0, 0.3, 3.0)) for axis in (0, 1)),
    ]
    labels = [
        Segment(s.label, s.start + shift, s.stop + shift)
        for shift in (0, alone.n)
        for s in alone.segments
    ]
    # what rests at the end of the one rests at the beginning of the other
    labels = [s for s in labels if s.kind != 'idle']
    return np.concatenate(parts), tuple(labels), 2 * alone.n


def _there_and_back(v: Array) -> Array:
    """Return voltages with a soft way to zero at the end."""
    way = 0.5 * (1.0 + np.cos(np.pi * np.linspace(0.0, 1.0, round(0.5 * RATE))))
    return np.concatenate([v, v[-1] * way[:, None]])


def triangle(frequency: float, length: float) -> Array:
    """Return a triangle of 0 .. 1 from 0."""
    t = np.arange(round(length * RATE)) / RATE
    return np.asarray(1.0 - np.abs(1.0 - 2.0 * ((frequency * t) % 1.0)))


def raster(
    fast: int, lines: float = LINES, frames: float = FRAMES, length: float = LENGTH
) -> Array:
    """Return a raster in parts of the range, shape (n, 2), times 10, from 0 by a soft ramp."""
    low = 0.5 * (1.0 - PART)
    ramp = low * 0.5 * (1.0 - np.cos(np.pi * np.linspace(0.0, 1.0, round(0.5 * RATE))))
    columns = [low + PART * triangle(f, length) for f in (lines, frames)]
    columns = [np.concatenate([ramp, x]) for x in columns]
    return 10.0 * np.stack(columns if fast == 0 else columns[::-1], axis=1)


def middle_of_lines() -> Mask:
    """Return which samples of a raster count: the middle of each line, none of the ramp."""
    place = triangle(LINES, LENGTH)
    counts = np.abs(place - 0.5) <= 0.5 * MIDDLE
    return np.concatenate([np.zeros(round(0.5 * RATE), dtype=bool), counts])


@dataclass(frozen=True, eq=False)
class Row:
    """Errors of an axis on a raster, in time [% of stroke]: predicted, and tracked."""

    axis: str
    is_fast: bool
    predicted: Array
    tracked: Array

    def cells(self) -> list[str]:
        """Return the row of the table."""
        errors = [f'{np.sqrt(np.mean(x**2)):.2f}' for x in (self.predicted, self.tracked)]
        role = 'fast' if self.is_fast else 'slow'
        return [NAMES[self.axis], role, *errors, f'{WANTED[self.axis]:g}']


def wanted_raster(model: pi.MultiAxisModel, fast: int) -> dict[str, Array]:
    """Return the raster as a motion of each axis [m], over the range that its voltages reach."""
    place = raster(fast) / 10.0
    goals = {}
    for i, axis in enumerate(model.axes):
        up = np.linspace(*LIMITS, round(RATE))
        y = model.own(axis).simulate(np.concatenate([up, up[::-1]]))
        low, high = float(y[-1]), float(y[up.size - 1])
        goals[axis] = low + (high - low) * place[:, i]
        # it begins where it rests
        goals[axis][0] = goals[axis][1]
    return goals


def judged(model: pi.MultiAxisModel, fast: int) -> tuple[list[Row], float]:
    """Return the errors of both axes on a raster, and the time that inverting it takes [s]."""
    counts = middle_of_lines()
    record = measured(raster(fast), np.random.default_rng([10, fast]))
    runs = pi.free_run(model, record)
    goals = wanted_raster(model, fast)
    begun = time.perf_counter()
    drive = pi.invert(model, goals, limits=LIMITS, clip=True)
    took = time.perf_counter() - begun
    v = np.stack([drive.voltages['v'], drive.voltages['v_b']], axis=1)
    # down to rest before, so that it comes from below
    reached = measured(v, np.random.default_rng([20, fast])).pieces[0]
    rows = []
    after_ramp = round(0.5 * RATE)
    for i, axis in enumerate(model.axes):
        y = reached.y if axis == 'y' else reached.channels[axis]
        stroke = np.ptp(goals[axis])
        missed = runs[axis].measured - runs[axis].predicted
        predicted = 100.0 * missed[after_ramp:] / np.ptp(runs[axis].measured)
        tracked = 100.0 * (y[drive.lead :] - goals[axis])[counts] / stroke
        rows.append(Row(axis, i == fast, predicted, tracked))
    return rows, took


def picture(rows: list[Row]) -> Figure:
    """Draw what the model errs by, each axis as the fast one."""
    fig = style.figure(4.6)
    top, below = fig.subplots(2, 1)
    fast = [row for row in rows if row.is_fast]
    for row, colour in zip(fast, (style.BLUE, style.VERMILION), strict=True):
        t = np.arange(row.predicted.size) / RATE
        top.plot(t, row.predicted, color=colour, linewidth=0.4, label=NAMES[row.axis])
        below.plot(
            np.arange(row.tracked.size) / RATE / MIDDLE, row.tracked, color=colour, linewidth=0.4
        )
    style.tidy(top, '', 'predicted, error [%]')
    style.tidy(below, 'time [s]', 'tracked, error [%]')
    style.legend_above(top)
    return fig


@dataclass(frozen=True, eq=False)
class Taught:
    """What one record taught: the model, a row of the table for each axis, and lengths [s]."""

    model: pi.MultiAxisModel
    found: list[str]
    length: float
    alone: float


def teach() -> Taught:
    """Identify and diagnose the scanner."""
    v, labels, start = learning()
    piece = measured(v, np.random.default_rng(0), labels, 'scanner').pieces[0]
    identified = pi.identify(Record((piece.cut(0, start),), 'one by one'))
    diagnosis = pi.diagnose(identified.model, Record((piece.cut(start, piece.n),), 'both'))
    print(identified, diagnosis, sep='\n\n')
    found = [
        f'| {NAMES[axis]} | {x.verdict}: {", ".join(e.name for e in x.effects) or "nothing"} | '
        f'{x.before.overall:.2f}, {x.after.overall:.2f} |'
        for axis, x in diagnosis.items()
    ]
    return Taught(diagnosis.model, found, piece.duration, start / RATE)


def write(taught: Taught, out: Path, drawn: Path | None) -> None:
    """Judge a model, and write the page and its picture."""
    results = [judged(taught.model, fast) for fast in (0, 1)]
    drawings = [row for some, _ in results for row in some]
    rows = [row.cells() for row in drawings]
    told = TEXT.format(
        creep=100 * CREEP * np.log(10.0),
        cross=100 * CROSS,
        rate=RATE / 1e3,
        noise=100 * NOISE,
        seconds=taught.length,
        learn=taught.alone,
        move=taught.length - taught.alone,
        **{'lines': LINES, 'frames': FRAMES, 'length': LENGTH, 'formula': FORMULA},
        part=100 * PART,
        middle=100 * MIDDLE,
        found='\n'.join(taught.found),
        table=markdown(('axis', 'it is', 'predicted', 'tracked', 'asked'), rows),
        invert=results[0][1],
    )
    out.write_text(told)
    if drawn is not None:
        picture(drawings).savefig(drawn, dpi=style.DPI)


def main() -> None:
    """Write the page and its picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('out', type=Path)
    parser.add_argument('--picture', type=Path)
    args = parser.parse_args()
    write(teach(), args.out, args.picture)


if __name__ == '__main__':
    main()

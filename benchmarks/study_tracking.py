# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
How near a stage comes to a wanted motion, by what is known of it.

    python benchmarks/study_tracking.py docs/tracking.md --picture docs/images/tracking.png

Each stage is identified from one record, diagnosed on another, and then told to follow sines, a
triangle and a raster: by its voltage scaled to the motion, through the inverse of the identified
model, of the refined one, and after three repetitions.  Its laws are none of the model's.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure
import numpy as np
import piezo_ident as pi
from piezo_ident.common.arrays import Array
from piezo_ident.model.metrics import FORMULA, percent_of_stroke
from piezo_ident.report import length
from piezo_ident.report.figures import style
from study_records import case_records, measured
from study_rows import dots_and_ranges, section, write_cases
from tqdm import tqdm
from truths import draw, make_stage
from truths.linear import RATE

#: plays a voltage [V] and returns the displacement [m]
Play = Callable[[Array], Array]

#: stages: an effect of `truths`, its size and seed; or the number of one of another family
STAGES: tuple[tuple[str, float, int] | int, ...] = (
    ('creep', 1.0, 0),
    ('rate_dependent_hysteresis', 1.0, 1),
    ('sensor_nonlinearity', 0.3, 1),
    15,
    41,
    47,
    55,
)
#: sines [Hz], triangle [Hz], and what a motion may take of the slow range
SINES, TRIANGLE, PART = (1.0, 10.0, 50.0, 90.0, 120.0), 10.0, 0.85
#: lines of the raster [Hz]
LINES = 20.0
REPETITIONS = 3
#: at rest before each motion [s]
REST = 0.05
HEADS = ('scaled voltage', 'identified', 'refined', f'after {REPETITIONS} repetitions')

TEXT = """\
# How near a stage comes to a wanted motion

This page gives the tracking errors of a stage without a controller, under the inverse of a model
(`make track`). Each simulated stage follows laws that the model lacks. Its sensor
has the steps of its converter, up to 0.04 % here. The stage was identified from one record and
diagnosed on another, with an undeclared effect. Then it had to follow {motions} motions.

![Tracking errors of each stage, four ways](images/tracking.png)

*Dots: medians of the motions; lines: from the smallest to the largest.*

- **scaled voltage**: the voltage in proportion to the wanted motion, as without a model;
- **identified**: `pi.invert` of the model from `pi.identify`;
- **refined**: `pi.invert` of the model from `pi.diagnose`, with the effect that was found;
- **after {repetitions} repetitions**: the best of the run above and {repetitions} more, each
  corrected by `pi.Learning`.

The error is {formula}. Here y is the wanted
motion, and y_hat the measured motion, from rest. The column "error of the model" is the error of
the refined model on data held out. The motions are sines, a triangle, and a raster of {lines:g} Hz
whose lines rise. Each begins at rest, with a ramp, and spans {part:g} % of the slow range.

{table}

{cases}

Measured stages in open loop, for comparison, err by 0.60, 0.64, 0.73, 1.73 and 1.67 % at 5, 30,
50, 90 and 150 Hz (PMC1356882, Table 2). Another has a linearity of 0.81 to 1.23 % from 2 to 100 Hz
(Acta Optica Sinica 38(8) 0814002).
"""


@dataclass(frozen=True)
class Stage:
    """A stage that can be told to move, with what was learned of it."""

    name: str
    play: Play
    rate: float
    limits: tuple[float, float]
    identified: pi.StageModel
    diagnosis: pi.Diagnosis


def plain(names: str) -> str:
    """Return names of effects as words."""
    return names.replace('_', ' ')


def stage_of(what: tuple[str, float, int] | int) -> Stage:
    """Identify and diagnose one of `STAGES`."""
    if isinstance(what, int):
        case = draw('tuning', what)
        records = case_records(case, forms=False)
        truth = records.stage
        model = pi.identify(records.identification).model
        result = pi.diagnose(model, records.diagnosis)
        name = f'{case.core}, {plain(", ".join(case.effects)) or "nothing hidden"}'
        return Stage(
            name, lambda v: truth.respond(v, 'unseen'), truth.rate, truth.limits, model, result
        )
    effect, size, seed = what
    known = make_stage(effect, size, seed)
    model, record, _ = measured((effect,), size, seed, 'white')
    return Stage(
        f'sum of plays, {plain(effect)}',
        lambda v: known.respond(np.arange(v.size) / RATE, v),
        RATE,
        (0.0, 10.0),
        model,
        pi.diagnose(model, record),
    )


def wanted_motions(stage: Stage) -> Iterator[tuple[str, Array]]:
    """Yield the motions, from zero at rest by a ramp, within the part of the slow range."""
    rate = stage.rate
    volts = np.linspace(*stage.limits, round(rate))
    slow = stage.identified.simulate(np.concatenate([volts, volts[::-1]]))
    # after a sweep the lowest voltage does not bring a stage back to where it rested
    end, low = slow[round(rate) - 1] - slow[0], slow[-1] - slow[0]
    middle, half = 0.5 * (low + end), 0.5 * PART * (end - low)

    def ramped(x: Array) -> Array:
        """Put a rise from rest to the first of x, -1 .. 1, before it."""
        rise = 0.5 * (1.0 - np.cos(np.pi * np.linspace(0.0, 1.0, round(0.25 * rate))))
        hold = np.zeros(round(REST * rate))
        first = middle + half * x[0]
        return np.concatenate([hold, first * rise, first + hold, middle + half * x])

    for frequency in SINES:
        t = np.arange(round(max(2.0 / frequency, 0.2) * rate)) / rate
        yield f'{frequency:g} Hz', ramped(-np.cos(2 * np.pi * frequency * t))
    t = np.arange(round(0.4 * rate)) / rate
    yield (
        f'triangle {TRIANGLE:g} Hz',
        ramped(1.0 - 2.0 * np.abs(1.0 - 2.0 * ((TRIANGLE * t) % 1.0))),
    )
    # lines of growing height: minor loops everywhere
    lines = np.sin(2 * np.pi * LINES * t) ** 3
    yield 'raster', ramped(-0.6 + t / t[-1] + 0.3 * lines)


def errors_of(stage: Stage, wanted: Array) -> tuple[float, ...]:
    """
    Return the tracking error of the four ways, % of the stroke of the motion.

    Every displacement is counted from where the stage rests, as if its sensor were set to zero
    there before each run.
    """
    volts = np.array(stage.limits)
    rest = round(0.8 * REST * stage.rate)

    def played(drive: Array, lead: int = 0) -> Array:
        y = stage.play(drive)
        return np.asarray(y - y[lead : lead + rest].mean())

    ends = stage.identified.simulate(np.linspace(*volts, round(stage.rate)))[[0, -1]]
    scaled = volts[0] + wanted * (volts[1] - volts[0]) / (ends[1] - ends[0])
    found = [percent_of_stroke(wanted, played(np.clip(scaled, *volts)))]
    for model in (stage.identified, stage.diagnosis.model):
        zero = float(model.simulate(volts[:1])[0])
        drive = pi.invert(model, zero + wanted, limits=stage.limits, clip=True)
        found.append(percent_of_stroke(wanted, played(drive.v, drive.lead)[drive.lead :]))
    learning = pi.Learning(model, zero + wanted, limits=stage.limits, clip=True)
    for _ in range(REPETITIONS + 1):
        learning.take(zero + played(learning.drive.v, learning.drive.lead))
    return (*found, learning.best.error)


@dataclass(frozen=True)
class Row:
    """A motion of a stage: its stroke [m], and the four errors, % of it."""

    stage: str
    found: str
    unseen: float
    motion: str
    stroke: float
    errors: tuple[float, ...]

    def cells(self) -> list[str]:
        """Return the row of the table."""
        size = 0.01 * self.stroke
        shown = [f'{e:.2g} ({length(size * e)})' for e in self.errors]
        return [self.stage, self.found, f'{self.unseen:.2g}', self.motion, *shown]


def medians(rows: Sequence[Row]) -> str:
    """Return the table of the stages: the median error of its motions, for each way."""
    stages: dict[str, list[Row]] = {}
    for row in rows:
        stages.setdefault(row.stage, []).append(row)
    lines = (
        [
            *own[0].cells()[:3],
            *(f'{np.median([row.errors[j] for row in own]):.2g}' for j in range(len(HEADS))),
        ]
        for own in stages.values()
    )
    heads = f'stage, found, error of the model, {", ".join(HEADS)}'
    return section('Median errors', heads, lines)


def picture(rows: list[Row]) -> Figure:
    """Draw the errors of each stage: the median of its motions, and the range."""
    errors: dict[str, list[Sequence[float]]] = {}
    for row in rows:
        errors.setdefault(row.stage, []).append(row.errors)
    return dots_and_ranges(errors, HEADS, 'tracking error rms / % of the stroke of the motion')


def main() -> None:
    """Write the table and its picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('out', type=Path)
    parser.add_argument('--picture', type=Path)
    parser.add_argument('--only', type=int, help='the stage with this place in the list')
    args = parser.parse_args()
    rows: list[Row] = []
    stages = STAGES if args.only is None else STAGES[args.only : args.only + 1]
    for what in tqdm(stages, unit='stage'):
        stage = stage_of(what)
        names = ', '.join(e.name for e in stage.diagnosis.effects)
        found = plain(names or stage.diagnosis.verdict)
        unseen = stage.diagnosis.after.overall
        for motion, wanted in wanted_motions(stage):
            stroke = float(np.ptp(wanted))
            row = Row(stage.name, found, unseen, motion, stroke, errors_of(stage, wanted))
            rows.append(row)
            tqdm.write(' | '.join(row.cells()))
    heads = f'stage, found, error of the model, motion, {", ".join(HEADS)}'
    page = {
        'formula': FORMULA,
        'repetitions': REPETITIONS,
        'part': 100 * PART,
        'lines': LINES,
        'motions': len(SINES) + 2,
        'table': medians(rows),
        'cases': write_cases(args.out, heads, (row.cells() for row in rows)),
    }
    args.out.write_text(TEXT.format(**page), encoding='utf-8')
    if args.picture is not None:
        picture(rows).savefig(args.picture, dpi=style.DPI)


if __name__ == '__main__':
    main()

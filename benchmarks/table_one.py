# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Table I of Gu, Li, Zhu and Su (2016), with a third row: the model that a diagnosis has refined.

    python benchmarks/table_one.py docs/table_one.md

A stage with rate dependence and creep that no record declares (`truths.table_one`, its parameters
fixed in table_one.yaml) is identified by the three steps, diagnosed on another record, and
judged on sines, amplitudes, a minor loop and a hold that neither saw.
doi:10.1109/TMECH.2015.2465868
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from itertools import starmap
from pathlib import Path
import sys

import alone  # noqa: F401 - one thread of BLAS
import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.diagnosis import diagnose
from piezo_ident.excitation.program import parse_program, Program
from piezo_ident.identification.identify import identify
from piezo_ident.identification.settings import Settings
from piezo_ident.model.metrics import percent_of_stroke
from piezo_ident.model.sines import sine_errors
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Piece, Record, Segment
from side_by_side import markdown
from truths import table_one_sines
from truths.table_one import PUBLISHED, table_one_stage

RATE = 20_000.0
DIAGNOSIS = """
limits: [0, 10]
sample_rate: 20000
seed: 3
slew: 40
segments:
  - {signal: idle, duration: 0.5}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 2, periods: 4}
  - {signal: sine, bias: 5, amplitude: 4, frequency: 25, periods: 25}
  - {signal: sine, name: 140Hz-large, bias: 5, amplitude: 4.7, frequency: 140, periods: 120}
  - {signal: sine, name: 140Hz-small, bias: 5, amplitude: 1.5, frequency: 140, periods: 100}
  - {signal: staircase, levels: [0, 5, 10, 5, 0], hold: [0.5, 1.5, 2.5, 1.5, 1]}
  - {signal: minor_loops, biases: [2.5, 5, 7.5], amplitude: 1.5, cycles: 2, slope: 24}
  - {signal: multisine, bias: 5, amplitude: 4.5, lowest: 1, highest: 200, period: 1, periods: 2}
  - {signal: idle, duration: 0.5}
"""
OTHER = """
limits: [0, 10]
sample_rate: 20000
slew: 40
segments:
  - {signal: idle, duration: 0.3}
  - {signal: sine, name: half, bias: 4, amplitude: 2.5, frequency: 30, periods: 60}
  - {signal: sine, name: wide, bias: 5, amplitude: 3.5, frequency: 65, periods: 100}
  - {signal: minor_loops, biases: [3, 6.5], amplitude: 1, cycles: 3, slope: 15}
  - {signal: hold, level: 7, duration: 5}
  - {signal: hold, level: 2, duration: 5}
  - {signal: idle, duration: 0.3}
"""


TEXT = """\
# Table I, with a third row

This page adds the gain of a diagnosis to Table I of the paper (`make table-one`). Errors are
free-run errors, rms(y - y_hat) / (max y - min y) in %, of v = 5 + 5 sin(2 pi f t) in steady state.
The simulated stage has rate dependence and creep, by other laws than the candidates
(`benchmarks/truths/table_one.py`).

{sines}

> {sentence}

Segments that neither step saw, in % of the stroke of their record:

{others}
"""


def record_of(v: Array, segments: Iterable[Segment], name: str, seed: int) -> Record:
    """Return what the stage answers, as a record."""
    y = table_one_stage(seed).respond(np.arange(v.size) / RATE, v)
    return Record((Piece(v, y, RATE, segments=tuple(segments)),), name)


def by_segment(model: StageModel, record: Record) -> dict[str, float]:
    """Return the free-run error of each segment, % of the stroke of the record."""
    piece = record.pieces[0]
    # it begins at rest
    y_hat = model.predict_piece(piece)
    return {
        s.label: percent_of_stroke(
            piece.y[s.start : s.stop], y_hat[s.start : s.stop], record.stroke
        )
        for s in piece.segments
        if s.kind not in ('idle', 'ramp')
    }


def main() -> None:
    """Identify, diagnose, judge and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('out', type=Path)
    out = parser.parse_args().out
    sequence = Program.load('program_identification').build(sample_rate=RATE)
    record = record_of(sequence.v, sequence.segments, 'identification', 1)
    model = identify(record, Settings(thresholds=10)).model
    drive = parse_program(DIAGNOSIS).build(sample_rate=RATE)
    result = diagnose(model, record_of(drive.v, drive.segments, 'diagnosis', 2))
    _, v, labels = table_one_sines()
    sines = record_of(v, starmap(Segment, labels), 'sines', 3)
    before, after = (
        {round(row.frequency): row.percent for row in sine_errors(m, sines)}
        for m in (model, result.model)
    )
    other = parse_program(OTHER).build(sample_rate=RATE)
    held = record_of(other.v, other.segments, 'other', 4)
    others = [by_segment(m, held) for m in (model, result.model)]
    lines = {
        'Table I, measured stage': PUBLISHED,
        'this stage, three steps': before,
        'after the diagnosis': after,
    }
    rows = [[name, *(f'{errors[f]:.2f}' for f in PUBLISHED)] for name, errors in lines.items()]
    segments = [[k, *(f'{errors[k]:.3f}' for errors in others)] for k in others[0]]
    text = TEXT.format(
        sines=markdown(['', *(f'{f} Hz' for f in PUBLISHED)], rows),
        sentence=result.sentence,
        others=markdown(['segment', 'three steps', 'after the diagnosis'], segments),
    )
    out.write_text(text, encoding='utf-8')
    sys.stdout.write(text)


if __name__ == '__main__':
    main()

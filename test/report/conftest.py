# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""One identification for all tests of reports: the paper's stage, and a record with a fault."""

from dataclasses import replace

from diagnosis_examples import HOSTILE
import numpy as np
import piezo_ident as pi
from piezo_ident.excitation.program import parse_program
from piezo_ident.record.record import Fault
from programs import identification_program
import pytest

IDENTIFICATION = identification_program(
    slew=100, steps=6, cycles=8, frequency=20, noise=1, slope=30
)

VALIDATION = """
limits: [0, 10]
slew: 100
segments:
  - {signal: idle, duration: 0.05}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 20, duration: 1.2}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 100, duration: 1.2}
  - {signal: idle, duration: 0.05}
"""


def measured(text: str, name: str) -> pi.Record:
    program = parse_program(text, name).build(20_000.0)
    return pi.SimulatedStage.load('paper').play(program, np.random.default_rng(5), name)


@pytest.fixture(scope='session')
def identified():
    """Return an identification with a record for validation whose texts try to do harm."""
    further = measured(VALIDATION, HOSTILE)
    (piece,) = further.pieces
    segments = [replace(s, label=HOSTILE) if s.kind == 'idle' else s for s in piece.segments]
    fault = Fault('repeats', f'in {HOSTILE}', 3, 'dropped')
    pieces = (replace(piece, segments=tuple(segments)),)
    further = replace(further, pieces=pieces, faults=(fault,))
    settings = pi.Settings(max_order=4, thresholds=10, solver='swarm', swarm_iterations=300)
    return pi.identify(measured(IDENTIFICATION, 'record'), settings, validation=further)


@pytest.fixture(scope='session')
def unlabelled():
    """Return an identification of a record without segments."""
    record = measured(VALIDATION, 'bare')
    (piece,) = record.pieces
    record = replace(record, pieces=(replace(piece.cut(0, 24_000), segments=()),))
    return pi.identify(record, pi.Settings(thresholds=10, delay=3, order=(1, 1)))


@pytest.fixture
def coarse(monkeypatch):
    """Have pictures drawn with few pixels, where nobody looks at them."""
    monkeypatch.setattr('piezo_ident.report.figures.style.DPI', 30)

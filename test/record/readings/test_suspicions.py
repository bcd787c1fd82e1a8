# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage that comes to its lowest voltage from below is not taken for one that came down."""

from dataclasses import replace

import numpy as np
import piezo_ident as pi
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.prepare import runs_of
from piezo_ident.model.free_run import free_run
from piezo_ident.record.readings.suspicions import rises_first, suspicions
from piezo_ident.record.record import Piece, Record
from programs import SLOW, slow_model, SLOW_PROGRAM
import pytest

V = parse_program(SLOW_PROGRAM).build(SLOW).v


def record(model, came_up: bool, drift: float = 0.0) -> Record:
    start = -model.hysteresis.thresholds if came_up else None
    y = model.stream(start).process(V) + drift * abs(model.scaling.Y) * np.linspace(0, 1, V.size)
    y += 1e-10 * np.random.default_rng(0).standard_normal(y.size)
    return Record((Piece(V, y, SLOW),), 'line')


@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_the_memory_of_a_first_rise_is_estimated(sign):
    model = replace(slow_model(), scaling=replace(slow_model().scaling, Y=sign * 75e-6))
    first = record(model, came_up=True)
    from_rest = model.simulate(V)
    y = first.pieces[0].y
    assert 100 * np.std(y - from_rest) / np.ptp(y) > 1.0
    run = free_run(model, first)
    assert run.errors.percent < 0.05
    assert any('had not come down to it' in warning for warning in run.warnings)


def test_one_hears_of_a_first_rise_and_identification_takes_its_memory_for_unknown():
    (said,) = suspicions(record(slow_model(), came_up=True))
    assert 'was not driven before' in said
    model = slow_model()
    [run] = runs_of([record(model, came_up=True)], SLOW, model.scaling)
    assert not run.known[:100].any() and run.known[-1]
    [run] = runs_of([record(model, came_up=False)], SLOW, model.scaling)
    assert run.known.all()


def test_creep_drift_and_a_record_that_never_comes_back_are_no_first_rise():
    assert suspicions(record(slow_model(), came_up=False, drift=0.02)) == []
    for name in ('paper', 'effects'):
        played = pi.SimulatedStage.load(name).play(pi.Program.load('holds'))
        assert not any(rises_first(piece) for piece in played)
    v = np.concatenate([np.zeros(500), np.linspace(0, 10, 1500)])
    assert not rises_first(Piece(v, 1e-6 * v, 1000.0))
    assert not rises_first(Piece(v[::-1].copy(), 1e-6 * v, 1000.0))
    assert not rises_first(Piece(np.zeros(500), np.zeros(500), 1000.0))

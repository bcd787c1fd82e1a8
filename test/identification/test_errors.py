# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What G and the delay leave of fast motion."""

from dataclasses import replace

import numpy as np
from paper_stage import PAPER as MODEL
from paper_stage import STAGE
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.errors import (
    fast_error,
    fitted_memories,
    noise_floor_of,
    predictions_of,
)
from piezo_ident.identification.prepare import runs_of
from piezo_ident.operators.dynamics import Delay
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.record import Piece, Record
from programs import identification_program
import pytest


@pytest.fixture(scope='module')
def record():
    sequence = parse_program(identification_program(steps=12, noise=1, slope=30)).build()
    return STAGE.play(sequence, np.random.default_rng(0))


def missed(model, record, law='plays'):
    left, _ = fast_error(model, law, runs_of([record], MODEL.sample_rate, MODEL.scaling))
    return left


def test_a_coarse_h_is_not_held_against_g(record):
    coarse = replace(MODEL, hysteresis=Hysteresis([0.5], [0.3], 0.0, 1.0))
    right = missed(MODEL, record)
    assert missed(coarse, record) == pytest.approx(right, rel=1e-6)
    # any other law is as fine as it gets
    assert missed(coarse, record, law='preisach') > 10 * right


def test_slow_errors_do_not_count_and_a_wrong_delay_does(record):
    (piece,) = record.pieces
    t = np.arange(piece.n) / piece.sample_rate
    stroke = np.ptp(piece.y)
    creeping = replace(record, pieces=(replace(piece, y=piece.y + stroke * 0.01 * np.sqrt(t)),))
    # a drift of 2 % of stroke moves the weights of H a little
    assert missed(MODEL, creeping) < 0.05
    late = replace(MODEL, delay=Delay(MODEL.delay.samples + 1))
    assert missed(late, record) > 10 * missed(MODEL, record)


def test_all_fast_motion_is_that_of_the_displacement(record):
    _, fast = fast_error(MODEL, 'preisach', runs_of([record], MODEL.sample_rate, MODEL.scaling))
    (piece,) = record.pieces
    spectrum = np.abs(np.fft.rfft(piece.y - piece.y.mean())) ** 2
    above = np.fft.rfftfreq(piece.n, 1.0 / piece.sample_rate) > 30.0
    rms = np.sqrt(2.0 * spectrum[above].sum()) / piece.n
    # the filter is no brick wall
    assert fast == pytest.approx(100.0 * rms / np.ptp(piece.y), rel=0.1)


def test_a_start_that_the_steps_fitted_is_estimated_again():
    v = 5.0 + 5.0 * np.sin(2.0 * np.pi * np.arange(6000) / 2000.0)
    r = MODEL.hysteresis.thresholds
    piece = Piece(v, v, MODEL.sample_rate)
    y = MODEL.predict_piece(piece, 0.5 - 0.5 * r)
    record = Record((replace(piece, y=y),), 'record')
    (run,) = runs_of([record], MODEL.sample_rate, MODEL.scaling)
    run = replace(run, memory=lambda thresholds: 0.5 - thresholds)
    [again] = fitted_memories([run], MODEL).values()
    of_steps = run.start(r)
    off = [np.abs(MODEL.predict_piece(piece, start) - y).max() for start in (again, of_steps)]
    assert off[0] < 0.1 * off[1]
    # runs that share a name and a time have no memory of their own
    assert not fitted_memories([run, run], MODEL)


@pytest.mark.parametrize(('bits', 'rms'), [(8, 0.0), (16, 2e-3)])
def test_noise_holds_the_rounding_of_a_coarse_converter(record, bits, rms):
    (piece,) = record.pieces
    stroke = float(np.ptp(piece.y))
    step = stroke / 2**bits
    noise = rms * stroke * np.random.default_rng(1).standard_normal(piece.n)
    y = step * np.rint((MODEL.predict_piece(piece) + noise) / step)
    coarse = replace(record, pieces=(replace(piece, y=y),))
    predictions = predictions_of(MODEL, runs_of([coarse], MODEL.sample_rate, MODEL.scaling))
    floor = noise_floor_of(predictions)
    assert floor.rms == pytest.approx(max(step / np.sqrt(12.0), rms * stroke), rel=0.1)
    assert ('rounding' in floor.source) == (bits == 8)

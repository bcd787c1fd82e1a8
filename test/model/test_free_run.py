# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Free runs over records, and the steady-state error of sines against sums done by hand."""

from dataclasses import replace
import re

import numpy as np
from numpy.testing import assert_array_equal
from piezo_ident.common.errors import ModelError
from piezo_ident.model.free_run import free_run, piece_runs
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.sines import sine_errors, sine_frequency
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.record import Piece, Record, Segment
import pytest

RATE = 1000.0


def linear_stage(delay: int = 0, weights: tuple[float, ...] = ()) -> StageModel:
    """7.5 um/V over 0..10 V, without dynamics."""
    thresholds = np.linspace(0.2, 0.6, len(weights))
    return StageModel(
        RATE,
        Scaling(0.0, 10.0, 0.0, 75e-6, (0.0, 10.0)),
        Hysteresis(thresholds, weights, 0.0, 1.0),
        Dynamics.unit(),
        Delay(delay),
    )


def sine(frequency: float, seconds: float) -> np.ndarray:
    return 5 + 5 * np.sin(2 * np.pi * frequency * np.arange(round(seconds * RATE)) / RATE)


def record(v: np.ndarray, y: np.ndarray, *labels: tuple[str, int, int]) -> Record:
    return Record((Piece(v, y, RATE, 0.0, tuple(Segment(*s) for s in labels)),), 'r')


def test_sine_error_is_that_of_a_hand_calculation():
    v = sine(4.0, 3.0)
    t = np.arange(v.size) / RATE
    e = 1e-7 * np.cos(2 * np.pi * 4.0 * t)
    # whatever happens in the first second must not count
    e[: round(RATE)] += 3e-6
    (row,) = sine_errors(linear_stage(), record(v, 7.5e-6 * v + e, ('sine:4Hz', 0, v.size)))
    # amplitude of 7.5e-6 * 5 sin + 1e-7 cos, and rms of a cosine
    stroke = 2 * np.hypot(37.5e-6, 1e-7)
    assert row.frequency == 4.0
    assert row.n == 2000
    assert row.percent == pytest.approx(100 * 1e-7 / np.sqrt(2) / stroke, rel=1e-4)
    assert row.static_percent == row.percent


def test_hysteresis_alone_lacks_the_delay():
    v = sine(5.0, 2.0)
    y = 7.5e-6 * np.concatenate([np.full(3, v[0]), v[:-3]])
    (row,) = sine_errors(linear_stage(delay=3), record(v, y, ('sine:5Hz', 0, v.size)))
    # sin(x) - sin(x - c) = 2 sin(c/2) cos(x - c/2)
    amplitude = 2 * np.sin(np.pi * 5.0 * 3 / RATE)
    assert row.percent == pytest.approx(0.0, abs=1e-9)
    assert row.static_percent == pytest.approx(100 * amplitude / np.sqrt(2) / 2, rel=1e-3)


def test_at_least_one_period_is_dropped_and_one_is_left():
    v = np.concatenate([sine(0.5, 6.0), sine(2.0, 1.2), sine(10.0, 1.5)])
    labels = [('sine:0.5Hz', 0, 6000), ('sine:2Hz', 6000, 7200), ('sine:10Hz', 7200, 8700)]
    rows = sine_errors(linear_stage(), record(v, 7.5e-6 * v, *labels))
    # 2 s of the slow one are a period; of 2 Hz, 0.2 s are left, less than a period
    assert [(row.frequency, row.n) for row in rows] == [(0.5, 4000), (10.0, 500)]
    assert all(row.percent < 1e-12 for row in rows)


@pytest.mark.parametrize(
    ('label', 'frequency'),
    [
        *(('sine:50Hz', 50.0), ('sine:0.5Hz', 0.5), ('sine:50Hz-2', 50.0), ('sine:1e2Hz', 100.0)),
        *((label, None) for label in ('sine', 'sine:0Hz', 'sine:50Hzz', 'multisine:50Hz')),
    ],
)
def test_frequency_of_a_label(label, frequency):
    assert sine_frequency(label) == frequency


def test_another_rate_is_refused_for_sines_and_left_out_of_piece_runs():
    v = sine(5.0, 2.0)
    other = Record((Piece(v, v, 500.0, 0.0, (Segment('sine:5Hz', 0, v.size),)),), 'r')
    model = linear_stage(delay=1)
    with pytest.raises(ModelError, match='500 Hz'):
        sine_errors(model, other)
    assert piece_runs(model, other) == []


def test_free_run_of_a_piece_from_an_unknown_start():
    model = linear_stage(weights=(0.2, 0.2))
    v = sine(1.0, 3.0)
    y = model.predict_piece(Piece(v, v, RATE), start=np.array([0.4, 0.1]))
    (run,) = piece_runs(model, Record((Piece(v, y, RATE),), 'r'))
    assert np.abs(run.y_hat - y).max() < 1e-8


EFFECTS = {
    'saturation': {'low': 0.1, 'high': 0.8},
    'slew_limit': {'limit': 40.0},
    'amplifier_lag': {'time_constant': 2e-3},
    'rate_dependent_hysteresis': {'gain': 0.002, 'exponent': 1.0, 'cutoff': 400.0},
    'creep': {'gain': [0.05], 'time_constant': [0.5]},
    'thermal_drift': {'rate': 0.01},
}


@pytest.mark.parametrize('name', EFFECTS)
def test_every_state_of_a_model_passes_a_short_gap(name):
    model = replace(
        linear_stage(delay=2, weights=(0.3, 0.3, 0.2)),
        effects=(EffectSetting(name, EFFECTS[name]),),
    )
    t = np.arange(4000) / RATE
    v = 4.5 * (1 - np.cos(2 * np.pi * t)) * np.exp(-t / 6)
    y = model.simulate(v)
    # three samples are missing at the top and two on the way down
    parts = [(0, 500), (503, 1300), (1302, 4000)]
    pieces = tuple(Piece(v[a:b], y[a:b], RATE, a / RATE) for a, b in parts)
    run = free_run(model, Record(pieces))
    assert run.errors.percent < 0.02
    assert run.estimated == (False, False, False)
    (first, *_) = piece_runs(model, Record(pieces))
    assert_array_equal(first.y_hat, run.pieces[0])


def test_a_prediction_that_overflows_is_none():
    v = sine(1.0, 1.0)
    model = replace(linear_stage(), hysteresis=Hysteresis([], [], 0.0, 1e10))
    huge = replace(model, scaling=replace(model.scaling, Y=1e308))
    with np.errstate(over='ignore'), pytest.raises(ModelError, match='diverges'):
        free_run(huge, record(v, 7.5e-6 * v))


def test_a_free_run_shows_itself():
    model, v = linear_stage(), sine(1.0, 1.0)
    run = free_run(model, record(v, 7.5e-6 * v + 1e-8))
    assert_array_equal(run.measured, 7.5e-6 * v + 1e-8)
    assert run.errors.offset == pytest.approx(1e-8)
    assert '% of stroke' in run._repr_html_()


@pytest.mark.parametrize(('factor', 'is_odd'), [(1000.0, True), (1e-3, True), (3.0, False)])
def test_a_displacement_in_another_unit_is_doubted(factor, is_odd):
    v = sine(1.0, 3.0)
    model = linear_stage(weights=(0.2, 0.2))
    run = free_run(model, record(v, factor * model.simulate(v)))
    told = [float(x) for w in run.warnings for x in re.findall(r'moves (\S+) times .* unit', w)]
    assert bool(told) == is_odd
    # the start is estimated, too, and takes a part of it
    assert told == pytest.approx([factor] * is_odd, rel=0.05)


def test_a_record_at_rest_has_no_unit_that_could_be_doubted():
    v = np.full(3000, 5.0)
    y = 1e-9 * np.random.default_rng(0).standard_normal(v.size)
    run = free_run(linear_stage(weights=(0.2, 0.2)), record(v, y))
    assert not [w for w in run.warnings if 'unit' in w]

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The simulated stage: the paper's numbers, the converters, and streaming."""

from dataclasses import replace
from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import CONFIG, FS
from paper_stage import STAGE as PAPER
from piezo_ident.common.errors import ConfigError, ModelError, PiezoIdentError
from piezo_ident.common.files import load_yaml
from piezo_ident.excitation.program import parse_program, Program
from piezo_ident.model.simulated_stage import Converter, Sensor, SimulatedStage, stage_from_dict
import pytest

VALIDATION = Program.load(CONFIG / 'program_validation.yaml').build()


def sequence(text: str, sample_rate: float = FS):
    return parse_program(f'limits: [-20, 20]\nsegments: [{text}]').build(sample_rate)


def percent_of_stroke(y, y_hat):
    return 100 * np.sqrt(np.mean((y - y_hat) ** 2)) / (y.max() - y.min())


# Steady state of the paper's model against its hysteresis alone, from the coefficients of Gu, Li,
# Zhu and Su (2016), Table I's frequencies; the numbers are those worked out for the design.
ALONE = {1: 0.09, 10: 0.85, 50: 4.3, 80: 6.8, 100: 8.5, 120: 10.2}


@pytest.fixture(scope='module')
def truth_and_alone():
    alone = SimulatedStage(PAPER.model.without_dynamics())
    return PAPER.ideal.play(VALIDATION), alone.ideal.play(VALIDATION)


@pytest.mark.parametrize('f', ALONE)
def test_hysteresis_alone_misses_as_the_papers_coefficients_say(truth_and_alone, f):
    truth, alone = (r.find(f'sine:{f}Hz')[0] for r in truth_and_alone)
    # the first second, and with it at least one period, belongs to the ramp's aftermath
    start = int(FS)
    assert truth.n - start >= FS / f
    error = percent_of_stroke(truth.y[start:], alone.y[start:])
    assert error == pytest.approx(ALONE[f], rel=0.02, abs=0.005)


def test_full_stroke_is_that_of_the_paper():
    y = PAPER.ideal.play(VALIDATION).find('sine:1Hz')[0].y
    # 0.6411 x 1.483 of 75 um
    assert y.max() == pytest.approx(71.3e-6, rel=1e-3)
    assert PAPER.model.dynamics.gain == pytest.approx(0.6411, abs=1e-4)


def test_dense_stage_has_the_same_full_stroke_and_no_threshold_on_the_papers_grid():
    dense = SimulatedStage.load(CONFIG / 'stage_dense.yaml')
    h, p = dense.model.hysteresis, PAPER.model.hysteresis
    assert h.thresholds.size == 40
    assert np.abs(h.thresholds[:, None] - p.thresholds[None, :]).min() > 0.01
    up = np.linspace(0, 1, 500)
    assert h(up)[-1] == pytest.approx(p(up)[-1], rel=1e-5)
    assert_array_equal(dense.model.dynamics.a, PAPER.model.dynamics.a)
    assert dense.model.delay == PAPER.model.delay


def test_stage_with_effects_differs_from_the_papers_in_nothing_else():
    stage = SimulatedStage.load(CONFIG / 'stage_effects.yaml')
    assert [e.name for e in stage.model.effects] == ['creep', 'rate_dependent_hysteresis']
    bare = SimulatedStage(replace(stage.model, effects=()), stage.sensor, stage.seed)
    s = sequence('{signal: sine, bias: 5, amplitude: 4, frequency: 20, periods: 4}')
    assert_array_equal(bare.ideal.play(s).pieces[0].y, PAPER.ideal.play(s).pieces[0].y)
    assert bare.sensor == PAPER.sensor


@settings(deadline=None, max_examples=40)
@given(
    cuts=st.lists(st.integers(0, 3000), max_size=8),
    which=st.sampled_from(['stage_paper', 'stage_effects']),
)
def test_result_does_not_depend_on_the_cutting(cuts, which):
    stage = SimulatedStage.load(CONFIG / f'{which}.yaml')
    s = sequence('{signal: sine, bias: 5, amplitude: 5, frequency: 100, periods: 5}', 2e4)
    v = s.v[-3000:]
    whole = stage.run(np.random.default_rng(7)).process(v)
    run = stage.run(np.random.default_rng(7))
    edges = [0, *sorted(cuts), v.size]
    parts = [run.process(v[a:b]) for a, b in pairwise(edges)]
    assert_array_equal(np.concatenate(parts), whole)


def test_simulate_is_the_stream():
    s = sequence('{signal: noise, bias: 5, amplitude: 1, cutoff: 2000, duration: 1.3}')
    record = PAPER.play(s, np.random.default_rng(3))
    run = PAPER.run(np.random.default_rng(3))
    parts = [run.process(s.v[k : k + 100]) for k in range(0, s.n, 100)]
    assert_array_equal(record.pieces[0].y, np.concatenate(parts))


def test_record_holds_the_command_the_clock_and_the_segments():
    s = sequence('{signal: hold, level: 3.14159265, duration: 0.1}')
    record = PAPER.play(s, np.random.default_rng(0), name='mine')
    (piece,) = record.pieces
    assert record.name == 'mine'
    assert_array_equal(piece.v, s.v)
    assert piece.segments == s.segments
    assert piece.start_time == 0.0
    assert record.faults == ()
    # the amplifier got something else: the nearest code of the DAC
    applied = PAPER.run(np.random.default_rng(0)).applied(s.v)
    step = 20 / 2**16
    assert 0 < np.abs(applied - s.v).max() <= step / 2 * (1 + 1e-9)
    assert_allclose(applied / step, np.rint(applied / step), atol=1e-9)


def test_stage_moves_by_what_the_dac_gives_it():
    coarse = SimulatedStage(PAPER.model, Sensor(dac=Converter(5, -10.0, 10.0)))
    v = sequence('{signal: triangle, peaks: [9], base: 0, slope: 100}').v
    y = coarse.run(np.random.default_rng(0)).process(v)
    steps = 0.625 * np.rint(v / 0.625)
    assert_allclose(y, PAPER.model.stream().process(steps), atol=1e-15)


def test_noise_level_is_the_configured_one():
    s = sequence('{signal: idle, duration: 4}')
    bare = replace(PAPER, sensor=replace(PAPER.sensor, adc=None))
    y = bare.play(s, np.random.default_rng(1)).pieces[0].y
    # 80000 samples: the rms is known to 0.25 %
    assert y.std() == pytest.approx(1.5e-9, rel=0.01)
    spread = np.corrcoef(y[:-1], y[1:])[0, 1]
    assert abs(spread) < 4 / np.sqrt(y.size)
    # the converter adds its step^2 / 12
    read = PAPER.play(s, np.random.default_rng(1)).pieces[0].y
    step = 150e-6 / 2**16
    assert read.std() == pytest.approx(np.hypot(1.5e-9, step / np.sqrt(12)), rel=0.02)
    assert_allclose(read / step, np.rint(read / step), atol=1e-6)


def test_truth_has_neither_noise_nor_steps():
    s = sequence('{signal: hold, level: 2, duration: 0.1}')
    y = PAPER.ideal.play(s).pieces[0].y
    assert y[0] == 0.0
    assert np.unique(y).size > 0.9 * np.flatnonzero(np.diff(y)).size
    assert_array_equal(y, PAPER.model.predict_piece(PAPER.ideal.play(s).pieces[0]))


def test_clipping_is_reported_and_counted():
    small = replace(PAPER, sensor=replace(PAPER.sensor, adc=Converter(16, -30e-6, 30e-6)))
    s = sequence('{signal: triangle, peaks: [10], base: 0, slope: 100}')
    record = small.play(s, np.random.default_rng(1))
    truth = small.ideal.play(s).pieces[0].y
    (fault,) = record.faults
    assert (fault.name, fault.where) == ('clipping', 'displacement')
    assert fault.count == pytest.approx(np.sum(truth > 30e-6), abs=3)
    assert record.pieces[0].y.max() == 30e-6 - 60e-6 / 2**16

    s = sequence('{signal: hold, level: 12, duration: 0.1}')
    faults = {f.where: f.count for f in PAPER.play(s, np.random.default_rng(1)).faults}
    assert faults == {'voltage': np.sum(s.v > 10)} | (
        {'displacement': faults['displacement']} if 'displacement' in faults else {}
    )


def test_full_range_is_not_clipping():
    assert PAPER.play(VALIDATION, np.random.default_rng(1)).faults == ()


@settings(deadline=None)
@given(
    bits=st.integers(1, 24),
    low=st.floats(-10, 0),
    span=st.floats(0.1, 20),
    x=st.lists(st.floats(-1, 2), min_size=1, max_size=20),
)
def test_converter_takes_the_nearest_code(bits, low, span, x):
    c = Converter(bits, low, low + span)
    value = low + span * np.array(x)
    q = c.quantise(value)
    inside = (value >= low) & (value <= c.high - c.step)
    assert np.all(np.abs(q - value)[inside] <= c.step * (0.5 + 1e-6))
    assert q.min() >= low
    assert q.max() <= c.high - 0.5 * c.step
    # a code is its own nearest code
    assert_array_equal(c.quantise(q), q)
    assert c.outside(value) == np.sum((value < low) | (value > c.high))


def test_a_wrong_rate_and_a_missing_file_are_refused():
    with pytest.raises(ModelError, match='sampled at 1000 Hz'):
        PAPER.play(sequence('{signal: idle, duration: 1}', 1000), np.random.default_rng(0))
    with pytest.raises(ConfigError, match=r'nowhere\.yaml: no such stage'):
        SimulatedStage.load('nowhere.yaml')


def test_plain_model_file_is_an_ideal_stage():
    data = load_yaml(CONFIG / 'stage_paper.yaml')
    del data['sensor'], data['seed']
    assert stage_from_dict(data).sensor == Sensor()


@pytest.mark.parametrize(
    ('change', 'says'),
    [
        ({'sensor': 3}, ': sensor .*stage_paper.yaml'),
        ({'sensor': {'noise': 1}}, 'keys noise in sensor'),
        ({'sensor': {'noise_rms': -1e-9}}, 'noise_rms .*negative'),
        ({'sensor': {'noise_rms': 'much'}}, "noise_rms .*'much'"),
        ({'sensor': {'noise_rms': True}}, 'noise_rms .*True'),
        ({'sensor': {'adc_bits': 16}}, 'both adc_bits and adc_range'),
        ({'sensor': {'dac_range': [0, 1]}}, 'both dac_bits and dac_range'),
        ({'sensor': {'dac_bits': 0, 'dac_range': [0, 1]}}, '1 .. 32 bits'),
        ({'sensor': {'dac_bits': 8.5, 'dac_range': [0, 1]}}, 'dac_bits = 8.5'),
        ({'sensor': {'dac_bits': 8, 'dac_range': [1, 0]}}, r'\[1, 0\]'),
        ({'sensor': {'dac_bits': 8, 'dac_range': [1, None]}}, 'dac_range .*list'),
        ({'seed': -1}, 'seed .*-1'),
        ({'seed': 'x'}, "seed .*'x'"),
        ({'sensors': {}}, 'keys sensors'),
    ],
)
def test_a_wrong_configuration_is_refused(change, says):
    data = {**load_yaml(CONFIG / 'stage_paper.yaml'), **change}
    with pytest.raises(PiezoIdentError, match=says) as caught:
        stage_from_dict(data, 'lab.yaml')
    assert str(caught.value).startswith('lab.yaml')
    assert '\n' not in str(caught.value)

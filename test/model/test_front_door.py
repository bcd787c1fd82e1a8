# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a model says of itself: error, parameters, frequency response, transfer function, text."""

from dataclasses import replace
import sys

import numpy as np
from numpy.testing import assert_allclose
from paper_stage import FS, PAPER
import piezo_ident as pi
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.dynamics import Delay, filter_arx
import pytest

CREEP = EffectSetting('creep', {'gain': [0.01, 0.02], 'time_constant': [0.1, 10.0]})


def on_circle(degrees):
    return np.exp(1j * np.radians(degrees))


@pytest.fixture(scope='module')
def record():
    return pi.SimulatedStage.load('paper').play(pi.Program.load('minor_loops'))


def test_a_model_predicts_and_scores_as_a_free_run(record):
    run = pi.free_run(PAPER, record)
    assert_allclose(PAPER.predict(record).predicted, run.predicted, rtol=0, atol=0)
    assert PAPER.score(record) == (run.errors_after_start or run.errors)


def test_parameters_are_those_of_the_chain_and_of_effects():
    model = replace(PAPER, effects=(CREEP,), delay=Delay(3, 0.5))
    values = {(p.part, p.name): p for p in model.parameters}
    h = PAPER.hysteresis
    for i in range(h.weights.size):
        r = values['H', f'r_{i + 1}']
        assert r.value == pytest.approx(PAPER.scaling.V * h.thresholds[i]) and r.unit == 'V'
        assert values['H', f'q_{i + 1}'].value == h.weights[i]
    assert values['G', 'a_1'].value == PAPER.dynamics.a[0]
    assert values['delay', 'd'].value == 3.5
    assert values['creep', 'time_constant_2'].value == 10.0
    assert values['creep', 'time_constant_2'].unit == 's'
    assert len(values) == len(model.parameters)


def test_deviations_are_those_of_the_identification_and_none_of_another_length():
    n = PAPER.hysteresis.weights.size
    known = {'weights': [1e-3] * n, 'p1': 2e-3, 'p2': float('nan'), 'a': [1.0], 'delay': 0.1}
    model = replace(PAPER, identification={'uncertainties': known})
    std = {(p.part, p.name): p.std for p in model.parameters}
    assert std['H', f'q_{n}'] == 1e-3 and std['H', 'p1'] == 2e-3 and std['delay', 'd'] == 0.1
    assert std['H', 'p2'] is None and std['G', 'a_1'] is None


def test_parameters_are_printed_as_one_table():
    known = {'p1': 2e-3}
    model = replace(PAPER, effects=(CREEP,), identification={'uncertainties': known})
    head, *lines = repr(model.parameters).splitlines()
    assert head.split() == ['part', 'name', 'value', 'deviation', 'unit']
    rows = {tuple(line.split()[:2]): line.split()[2:] for line in lines}
    assert list(rows) == [(p.part, p.name) for p in model.parameters]
    assert rows['H', 'p1'] == [f'{PAPER.hysteresis.p1:.4f}', '0.0020']
    assert rows['creep', 'time_constant_2'] == ['10.00', '–', 's']


def test_the_result_of_an_identification_lists_the_same_parameters():
    v = 5.0 - 5.0 * np.cos(2.0 * np.pi * np.arange(4000) / 1000.0)
    result = pi.identify(
        pi.Record.from_arrays(v, 1e-6 * v, sample_rate=1000.0), pi.Settings(thresholds=4)
    )
    assert result.parameters == result.model.parameters
    assert any(p.std is not None for p in result.parameters)


def test_the_response_is_that_of_small_motion_with_the_gain_of_the_stroke():
    model = replace(PAPER, delay=Delay(2, 0.25))
    f = np.array([1.0, 150.0, 700.0])
    bode = model.bode(f)
    s, (low, high) = model.scaling, model.scaling.range
    rest = [float(model.chain().reset(*[float(s.u(v))] * 2)) for v in (low, high)]
    assert bode.gain[0] == pytest.approx(s.Y * (rest[1] - rest[0]) / (high - low), rel=1e-3)
    # the shape is the Fourier transform of the impulse response of G and the delay
    impulse = np.zeros(1 << 15)
    impulse[1] = 1.0
    y = model.delay.apply(filter_arx(model.dynamics.a, model.dynamics.b, impulse))
    wanted = np.array([y @ np.exp(-2j * np.pi * x * (np.arange(y.size) - 1) / FS) for x in f])
    assert_allclose(bode.gain / bode.gain[0], np.abs(wanted / wanted[0]), rtol=1e-6)
    assert_allclose(on_circle(bode.phase), wanted / np.abs(wanted), rtol=1e-6)


@pytest.mark.parametrize('frequency', [[-1.0], [1e9], [float('nan')], [[1.0]]])
def test_frequencies_out_of_range_are_refused_with_the_range(frequency):
    with pytest.raises(pi.DataError, match='10000 Hz'):
        PAPER.bode(frequency)


def test_the_transfer_function_of_python_control_is_the_same_response():
    pytest.importorskip('control')
    model = replace(PAPER, delay=Delay(2, 0.25))
    tf, f = model.to_tf(), np.array([1.0, 150.0, 700.0, 5000.0])
    response = tf(np.exp(2j * np.pi * f / FS))
    bode = model.bode(f)
    assert tf.dt == 1.0 / FS
    assert_allclose(np.abs(response), bode.gain, rtol=1e-8)
    assert_allclose(response / np.abs(response), on_circle(bode.phase), rtol=1e-6)


def test_without_python_control_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, 'control', None)
    with pytest.raises(pi.ConfigError, match=r'piezo_ident\[control\]'):
        PAPER.to_tf()


def test_a_summary_names_range_modes_delay_and_effects():
    text = replace(PAPER, effects=(CREEP,)).summary()
    for word in ('0 .. 10 V', 'mode', '3 samples', 'creep', 'time_constant_2 10 s', 'unknown'):
        assert word in text


def test_every_result_becomes_json(record):
    run = pi.free_run(PAPER, record)
    drive = pi.invert(PAPER, 20e-6 * (1.5 - np.cos(np.arange(2000) / 100)))
    assert run.to_json()['whole']['percent_of_stroke'] == run.errors.percent
    assert drive.to_json()['percent_of_stroke'] == drive.error
    assert record.to_json()['samples'] == record.n

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Faults of the data: each is named where it is, and none where it is not."""

import re

import numpy as np
from piezo_ident.excitation.program import parse_program, Program
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.record.readings.faults import quantum_of
from piezo_ident.record.record import Piece
from piezo_ident.residual.faults import find_faults
from piezo_ident.residual.stretches import ResidualPart
import pytest
from scipy.signal import lfilter

RATE = 20_000.0
PROGRAM = """
limits: [0, 10]
sample_rate: 20000
segments:
  - {signal: idle, duration: 0.5}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 1, periods: 2}
  - {signal: sine, bias: 5, amplitude: 4.5, frequency: 80, duration: 1}
  - {signal: staircase, levels: [0, 5, 10, 3], hold: [0.3, 0.3, 0.3, 0.3]}
  - {signal: triangle, slope: 20}
"""


@pytest.fixture(scope='module')
def stage():
    return SimulatedStage.load('paper')


@pytest.fixture(scope='module')
def truth(stage):
    """Voltage, displacement without and with the stage's noise and 16-bit converters."""
    sequence = parse_program(PROGRAM).build()
    ideal = stage.ideal.play(sequence).pieces[0]
    read = stage.play(sequence, np.random.default_rng(1)).pieces[0]
    return ideal.v, ideal.y, read.y


def faults(v, y, y_hat):
    found = find_faults([ResidualPart('r', Piece(v, y, RATE), y - y_hat)])
    return {fault.name: fault for fault in found.faults}, found


def test_clean_readings_of_16_bits_have_no_fault(truth):
    v, y, read = truth
    assert faults(v, read, y)[0] == {}
    # nor with a model that is wrong, late or slow
    for y_hat in (
        0.99 * y,
        np.roll(y, 2),
        0.7 * y + 0.3 * lfilter([0.02], [1, -0.98], y),
        7e-6 * v,
    ):
        assert faults(v, read, y_hat)[0] == {}


def test_readings_without_any_noise_have_no_fault(truth):
    v, y, _ = truth
    assert faults(v, y, y)[0] == {}
    assert faults(v, y, 1.01 * y + 40 * y**2)[0] == {}


@pytest.mark.parametrize('name', ['identification', 'validation', 'minor_loops'])
def test_shipped_programs_have_no_fault(stage, name):
    sequence = Program.load(name).build()
    read = stage.play(sequence, np.random.default_rng(2)).pieces[0]
    y = stage.ideal.play(sequence).pieces[0].y
    assert faults(read.v, read.y, y)[0] == {}
    assert faults(read.v, read.y, 0.7 * y + 0.3 * lfilter([0.02], [1, -0.98], y))[0] == {}


def test_steps_in_coarse_readings_with_a_sensor_that_hangs_are_still_known():
    code = np.repeat(np.arange(200), 50)
    code[3000:7000] = code[3000]
    assert quantum_of(7e-8 * code) == pytest.approx(7e-8)


def test_a_wrong_mode_is_no_jitter(truth):
    v, y, _ = truth
    rng = np.random.default_rng(4)
    # what rings is as strong as the motion is fast: its variance grows as that of jitter does
    t, speed = np.arange(y.size) / RATE, np.abs(np.gradient(y))
    ringing = 1e-6 * speed / speed.max() * np.sin(2 * np.pi * 2300 * t)
    assert faults(v, y + ringing + 1.5e-9 * rng.standard_normal(y.size), y)[0] == {}


@pytest.mark.parametrize(('jitter', 'step'), [(1e-7, 0.0), (1e-6, 0.0), (1e-6, 9e-9), (5e-6, 0.0)])
def test_timing_jitter(truth, jitter, step):
    v, y, read = truth
    rng = np.random.default_rng(4)
    speed = np.gradient(y) * RATE
    z = read + speed * jitter * rng.standard_normal(y.size)
    z = step * np.rint(z / step) if step else z
    named, _ = faults(v, z, y)
    assert set(named) == {'timing_jitter', *(['quantisation'] if step else [])}
    said = re.search(r'by (\S+) us rms.* grows (\S+) times', named['timing_jitter'].action)
    assert float(said[1]) == pytest.approx(1e6 * jitter, rel=0.1)
    # without jitter: 1.5 nm of noise, and the step of the readings
    noise2 = 1.5e-9**2 + max(step, 2.289e-9) ** 2 / 12.0
    if jitter < 2e-6:
        speed2 = np.mean(speed[: y.size // 64 * 64].reshape(-1, 64) ** 2, axis=1)
        grown = 1.0 + jitter**2 * np.quantile(speed2, 0.98) / noise2
        assert float(said[2]) == pytest.approx(grown, rel=0.2)


@pytest.mark.parametrize('bits', [8, 10, 12])
def test_quantisation(truth, bits):
    v, y, _ = truth
    noise = 1.5e-9 * np.random.default_rng(5).standard_normal(y.size)
    step = 150e-6 / 2**bits
    named, found = faults(v, step * np.rint((y + noise) / step), y)
    assert set(named) == {'quantisation'}
    assert found.quantum == pytest.approx(step, rel=1e-3)


def test_outliers(truth):
    v, y, read = truth
    rng = np.random.default_rng(6)
    places = rng.choice(y.size - 40, 25, replace=False) + 20
    z = read.copy()
    z[places] += rng.choice([-1, 1], 25) * rng.uniform(5e-8, 1e-6, 25)
    named, found = faults(v, z, y)
    assert set(named) == {'outliers'}
    assert named['outliers'].count >= 23
    assert set(np.flatnonzero(found.bad[0])) <= set(places)


def test_a_model_that_jumps_is_no_outlier_of_the_readings(truth):
    v, y, read = truth
    y_hat = y.copy()
    y_hat[20_000:120_000:1500] += 1e-7
    assert faults(v, read, y_hat)[0] == {}


def test_ringing_and_steps_are_no_outliers():
    t = np.arange(20_000) / RATE
    rng = np.random.default_rng(7)
    ringing = 1e-7 * np.exp(-(t % 0.1) / 2e-3) * np.sin(2 * np.pi * 4000 * t)
    e = ringing + 5e-8 * (t > 0.5) + 1e-9 * rng.standard_normal(t.size)
    v = np.floor(t / 0.1) % 2
    assert faults(v, 1e-5 * v + e, 1e-5 * v)[0] == {}


def test_clipping(truth):
    v, y, read = truth
    end = read.max() - 2e-6
    named, found = faults(v, np.minimum(read, end), y)
    assert set(named) == {'clipping'}
    assert found.bad[0].sum() > 0.5 * np.sum(read > end)


@pytest.mark.parametrize('decimals', [3, 4, 6])
def test_quantum_of_numbers_that_were_rounded_again(decimals):
    """A 12-bit converter over 70 um, written in um: its codes are 17.09 nm apart."""
    step = 70e-6 / 4096
    t = np.arange(20_000) / 5000
    y = 30e-6 * np.sin(2 * np.pi * t) + 6e-9 * np.random.default_rng(1).standard_normal(t.size)
    read = 1e-6 * np.round(1e6 * step * np.round(y / step), decimals)
    assert quantum_of(read) == pytest.approx(step, rel=1e-2)


def test_wild_readings_between_the_codes_hide_no_step():
    rng = np.random.default_rng(5)
    read = 2e-8 * np.rint(400.0 * np.sin(np.arange(20_000) / 500.0))
    wild = rng.choice(read.size, 60, replace=False)
    read[wild] += 1e-6 * rng.uniform(-1.0, 1.0, wild.size)
    assert quantum_of(read) == pytest.approx(2e-8)


def test_quantum_of_plain_numbers_and_of_nothing():
    rng = np.random.default_rng(8)
    assert quantum_of(rng.standard_normal(10_000)) == 0.0
    assert quantum_of(np.zeros(100)) == 0.0
    assert quantum_of(0.25 * rng.integers(0, 9, 1000)) == pytest.approx(0.25)

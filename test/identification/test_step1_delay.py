# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Step 1: known delays, both signs, both directions, noise, and nothing to find."""

import numpy as np
from numpy.testing import assert_array_equal
from paper_stage import A, B
from piezo_ident.identification.prepare import prepare
from piezo_ident.identification.settings import Settings, silent
from piezo_ident.identification.step1_delay import (
    checked_delay,
    delay_from_loss,
    delay_from_steps,
    DelayResult,
    find_jumps,
    first_step,
    step_responses,
)
from piezo_ident.operators.dynamics import Delay, Dynamics, filter_arx
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.record import Piece, Record
import pytest
from scipy import signal

FS = 20_000.0
# its first coefficient is 2 % of the final value
G = Dynamics(A, B)


def steps(d, noise=0.0, gain=75e-7, seed=0, count=16, hold=1200, size=1.0):
    """Return a piece of steps up and down, 75 um at 10 V and noise as a share of that."""
    v = np.concatenate([np.full(hold, 5.0 + size * (k % 2)) for k in range(count)])
    y = gain * Delay(d).apply(filter_arx(G.a, G.b, v))
    return Piece(v, y + noise * 75e-6 * np.random.default_rng(seed).standard_normal(v.size), FS)


@pytest.mark.parametrize('d', range(11))
def test_known_delays_without_noise(d):
    found = delay_from_steps([steps(d)])
    assert found.samples == d
    assert found.repeats == 15
    assert found.std == pytest.approx(12**-0.5)


@pytest.mark.filterwarnings('error')
def test_two_samples_ahead_of_a_step_tell_no_noise():
    assert delay_from_steps([steps(2)], before=2).samples is None


@pytest.mark.parametrize('noise', [1e-5, 1e-4, 5e-4])
@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('gain', [75e-7, -75e-7])
def test_known_delays_in_noise(noise, seed, gain):
    found = delay_from_steps([steps(3, noise, gain, seed)])
    # at 5e-4 of stroke the first sample, 2e-4 of it after averaging, is not above the noise
    assert found.samples == 3 or (noise == 5e-4 and 3 <= found.samples <= 4)
    assert found.noise == pytest.approx(noise * 75e-6 / np.sqrt(15), rel=0.35)


def test_one_direction_and_one_step_will_do():
    for down in (False, True):
        v = np.concatenate([np.full(500, 6.0 if down else 5.0), np.full(500, 5.5)])
        y = 75e-7 * Delay(4).apply(filter_arx(G.a, G.b, v))
        found = delay_from_steps([Piece(v, y, FS)])
        assert found.samples == 4
        assert found.repeats == 1


def test_response_is_that_of_the_stage_in_metres_a_volt():
    found = delay_from_steps([steps(3)])
    expected = 75e-7 * Delay(3).apply(filter_arx(G.a, G.b, (np.arange(-100, 60) >= 0) * 1.0))
    assert_array_equal(found.lag, np.arange(-100, 60))
    assert np.abs(found.response - expected).max() < 1e-3 * expected.max()
    responses, heights = step_responses([steps(3)])
    assert responses.shape == (15, 160)
    assert_array_equal(heights, np.ones(15))


def test_settling_stage_is_no_early_rise():
    piece = steps(3, 1e-5)
    drift = 75e-6 * 0.002 * np.log1p(np.arange(piece.n) % 1200)
    assert delay_from_steps([Piece(piece.v, piece.y + drift, FS)]).samples in (2, 3)


def test_no_step_and_none_above_the_noise():
    rng = np.random.default_rng(0)
    for v in (np.full(3000, 5.0), np.linspace(0, 10, 3000), np.array([5.0])):
        found = delay_from_steps([Piece(v, 1e-9 * rng.standard_normal(v.size), FS)])
        assert found.samples is None
        assert found.std == float('inf')
        assert found.repeats == 0
    assert delay_from_steps([]).samples is None
    deaf = [steps(3, noise=1.0, gain=0.0, seed=s) for s in range(20)]
    assert sum(delay_from_steps([p]).samples is not None for p in deaf) <= 1


@pytest.mark.filterwarnings('error')
def test_displacement_that_never_moves_is_no_delay():
    piece = steps(3)
    for still in (0.0, 1e-3):
        found = delay_from_steps([Piece(piece.v, np.full(piece.n, still), FS)])
        assert found.samples is None


def test_jackknife_sees_repeats_that_disagree():
    # without the one early step the rest say 9
    found = delay_from_steps([steps(3, count=2), steps(9, count=8)])
    assert found.samples == 3
    assert found.std == pytest.approx(np.sqrt(7 / 8 * (6.0**2 * 7 / 8)))
    assert delay_from_steps([steps(3, 1e-5)]).std == pytest.approx(12**-0.5)


def test_jumps_are_the_first_samples_after_a_rest():
    v = np.concatenate([np.zeros(200), np.ones(150), np.full(30, 0.5), np.zeros(200)])
    # the third jump has too short a rest before it
    assert_array_equal(find_jumps(v, 100, 60), [200, 350])
    assert_array_equal(find_jumps(v, 100, 290), [200])
    assert find_jumps(np.zeros(50), 10, 10).size == 0
    assert find_jumps(np.zeros(1), 10, 10).size == 0
    measured = v + 1e-4 * np.random.default_rng(0).standard_normal(v.size)
    assert_array_equal(find_jumps(measured, 100, 60), [200, 350])


def test_delay_from_loss_is_the_largest_that_costs_nothing():
    assert delay_from_loss(np.array([1.0, 1.0, 1.01, 1.3, 5.0])) == 2
    assert delay_from_loss(np.array([1.3, 1.0, 1.5])) == 1
    # a loss that never rises tells nothing
    assert delay_from_loss(np.zeros(3)) is None
    assert delay_from_loss(np.array([1.0, 1.01, 1.0])) is None


#: a mode of 335 Hz at 50 kHz that rings for thousands of samples
POLE = np.exp(2j * np.pi * 335.0 / 50_000.0 - 2e-4)
RINGING = Dynamics(np.array([-2.0 * POLE.real, abs(POLE) ** 2]), np.array([1e-3, 1e-3]))


def noise(d, rms=1e-3):
    rng = np.random.default_rng(0)
    u = rng.standard_normal(40_000)
    late = np.concatenate([np.zeros(d), u[: u.size - d]])
    y = filter_arx(RINGING.a, RINGING.b, late)
    y += rms * y.std() * rng.standard_normal(u.size)
    return split(u, y)


def split(u, y):
    k = 3 * u.size // 4
    return (u[:k], y[:k]), (u[k:], y[k:])


@pytest.mark.parametrize(
    ('steps', 'scan', 'samples', 'source'),
    [(5, 12, 5, 'steps'), (12, 4, 4, 'scan'), (6, 4, 4, 'scan'), (6, 5, 5, 'scan')],
)
def test_the_smaller_delay_that_holds_is_kept(steps, scan, samples, source):
    found = checked_delay(DelayResult(steps, 0.3, 'steps', scan=scan), *noise(6))
    assert (found.samples, found.source) == (samples, source)


def test_noise_tells_a_delay_where_no_free_run_allows_another_or_nothing_else_tells_one():
    for given in (DelayResult(40, 9.0, 'steps'), DelayResult(30, np.inf, 'none')):
        found = checked_delay(given, *noise(6))
        assert found.source == 'free run' and 1 <= found.samples <= 6
        assert given.source == 'none' or found.std > 1.0
    # where the delay is that long, nothing is claimed
    assert checked_delay(given, *noise(33)).source == 'none'


def test_a_delay_that_makes_no_difference_does_not_end_the_identification():
    # neither drive nor stage is so fast that a delay of 30 samples shows
    u = signal.sosfilt(signal.butter(2, 100.0, fs=50_000.0, output='sos'), noise(0)[0][0])
    y, some = filter_arx(np.array([-0.99]), np.array([0.01]), u), np.random.default_rng(1)
    y += 0.2 * y.std() * some.standard_normal(u.size)
    nothing = DelayResult(30, np.inf, 'none')
    found = checked_delay(nothing, *split(u, y))
    assert found.source == 'free run'
    assert found.std > 5.0
    # where nothing follows the drive, nothing is claimed
    y += 5.0 * y.std() * some.standard_normal(u.size)
    found = checked_delay(nothing, *split(u, y))
    assert found.source == 'none'


@pytest.mark.parametrize('hold', [20, 25])
def test_a_delay_from_periodic_steps_is_not_longer_by_the_time_between_them(hold):
    rng = np.random.default_rng(1)
    sos = signal.butter(4, 0.6, output='sos')
    drive = 5.0 + 0.15 * signal.sosfilt(sos, rng.standard_normal(2500))
    v = np.concatenate([np.repeat([5.0, 6.0] * 6, hold), drive])
    w = Hysteresis(np.arange(1, 10) / 10, np.full(9, 0.04), 0.0, 0.64)(v / 10.0)
    y = 80e-6 * Delay(2).apply(filter_arx(np.array([-0.6]), np.array([0.4]), w))
    y += 5e-9 * rng.standard_normal(v.size)
    labels = ['step', 'noise'], [0, 12 * hold]
    record = Record.from_arrays(v, y, sample_rate=100.0, segments=labels)
    assert first_step(prepare([record]).runs, Settings(), silent).samples <= 2

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A delay that steps or the loss tell, and what a free run over noise says of it."""

import numpy as np
from piezo_ident.identification.delay_check import delay_behind, upheld
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.results import DelayResult
from piezo_ident.operators.dynamics import Delay, Dynamics, filter_arx
from piezo_ident.operators.hysteresis import Hysteresis
import pytest
from scipy import signal

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
    found = upheld(DelayResult(steps, 0.3, 'steps', scan=scan), *noise(6))
    assert (found.samples, found.source) == (samples, source)


def test_a_delay_that_no_free_run_allows_is_replaced_by_a_smaller_one():
    found = upheld(DelayResult(40, 9.0, 'steps'), *noise(6))
    assert found.source == 'free run'
    assert 1 <= found.samples <= 6
    assert found.std > 1.0


def test_noise_tells_a_delay_where_neither_steps_nor_the_loss_do():
    found = upheld(DelayResult(30, np.inf, 'none'), *noise(6))
    assert found.source == 'free run'
    assert 1 <= found.samples <= 6
    # where the delay is that long, nothing is claimed
    assert upheld(DelayResult(30, np.inf, 'none'), *noise(33)).source == 'none'


def test_a_delay_that_makes_no_difference_does_not_end_the_identification():
    # neither drive nor stage is so fast that a delay of 30 samples shows
    u = signal.sosfilt(signal.butter(2, 100.0, fs=50_000.0, output='sos'), noise(0)[0][0])
    y, some = filter_arx(np.array([-0.99]), np.array([0.01]), u), np.random.default_rng(1)
    y += 0.2 * y.std() * some.standard_normal(u.size)
    nothing = DelayResult(30, np.inf, 'none')
    found = upheld(nothing, *split(u, y))
    assert found.source == 'free run'
    assert found.std > 5.0
    # where nothing follows the drive, nothing is claimed
    y += 5.0 * y.std() * some.standard_normal(u.size)
    found = upheld(nothing, *split(u, y))
    assert found.source == 'none'


def slow_motion(delay):
    """Return a sine of varying size through plays and a delay, to fit and to judge by."""
    t = np.arange(800) / 200.0
    u = 0.5 - 0.5 * np.cos(2 * np.pi * t) * (0.55 + 0.45 * np.cos(2 * np.pi * t / 4))
    x = Delay(delay).apply(Hysteresis([0.1, 0.3], [0.2, 0.2], 0.0, 1.0)(u))
    x = x + 1e-3 * np.random.default_rng(0).standard_normal(t.size)
    judged = np.arange(t.size) > 600
    return Excerpt(u, x, ~judged), Excerpt(u, x, judged)


def test_slow_motion_tells_a_delay_or_its_errors():
    r = np.arange(1, 10) / 10.0
    fitted, judged = slow_motion(3)
    found = delay_behind([fitted], [judged], r)
    assert (found.samples, found.source) == (3, 'free run')
    assert found.std < 1.0
    none = delay_behind([slow_motion(0)[0]], [slow_motion(0)[1]], r)
    assert (none.samples, none.source) == (0, 'free run')
    long = delay_behind([slow_motion(60)[0]], [slow_motion(60)[1]], r)
    assert 'the largest delay that is tried, 30 samples' in long


def test_a_voltage_that_hardly_moves_in_thirty_samples_tells_no_delay():
    u = 0.5 - 0.5 * np.cos(np.linspace(0.0, 9.0, 40_000))
    x = u + 1e-2 * np.random.default_rng(0).standard_normal(u.size)
    judged = np.arange(u.size) > 30_000
    said = delay_behind([Excerpt(u, x, ~judged)], [Excerpt(u, x, judged)], np.array([0.3, 0.6]))
    assert said.startswith('delays of 0 to 30 samples')


@pytest.mark.parametrize('delay', [0, 4])
def test_fast_motion_tells_a_delay_between_those_that_err_alike(delay):
    rng = np.random.default_rng(0)
    u = 0.5 + 0.1 * rng.standard_normal(800)
    x = Delay(delay).apply(u) + 1e-3 * rng.standard_normal(u.size)
    judged = np.arange(u.size) > 600
    found = delay_behind([Excerpt(u, x, ~judged)], [Excerpt(u, x, judged)], np.array([0.3]))
    assert (found.samples, found.source) == (delay, 'free run')
    # a delay that noise hides is told by its errors
    hidden = u + 2.0 * np.diff(u, prepend=u[0]) + rng.standard_normal(u.size)
    said = delay_behind(
        [Excerpt(u, hidden, ~judged)], [Excerpt(u, hidden, judged)], np.array([0.3])
    )
    assert '% of stroke' in said

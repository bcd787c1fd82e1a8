# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A delay that steps or the loss tell, and what a free run over noise says of it."""

import numpy as np
from piezo_ident.identification.delay_check import checked_delay
from piezo_ident.identification.results import DelayResult
from piezo_ident.operators.dynamics import Dynamics, filter_arx
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
    found = checked_delay(DelayResult(steps, 0.3, 'steps', scan=scan), *noise(6))
    assert (found.samples, found.source) == (samples, source)


def test_a_delay_that_no_free_run_allows_is_replaced_by_a_smaller_one():
    found = checked_delay(DelayResult(40, 9.0, 'steps'), *noise(6))
    assert found.source == 'free run'
    assert 1 <= found.samples <= 6
    assert found.std > 1.0


def test_noise_tells_a_delay_where_neither_steps_nor_the_loss_do():
    found = checked_delay(DelayResult(30, np.inf, 'none'), *noise(6))
    assert found.source == 'free run'
    assert 1 <= found.samples <= 6
    # where the delay is that long, nothing is claimed
    assert checked_delay(DelayResult(30, np.inf, 'none'), *noise(33)).source == 'none'


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

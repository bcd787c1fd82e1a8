# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Thresholds chosen by the error on data that were not fitted."""

import numpy as np
from piezo_ident.excitation.signals import triangle
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.step3_hysteresis import (
    choose_thresholds,
    even_thresholds,
    factorise,
    fit_hysteresis,
)
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
import pytest

UNIT, NONE = Dynamics.unit(), Delay(0)


def split(h, noise=0.0):
    u = np.concatenate([np.zeros(50), triangle((0.4, 0.7, 1.0), 0, 3.0, 10_000)])
    x = h(u) + noise * np.random.default_rng(0).standard_normal(u.size)
    out = (np.arange(u.size) // 100) % 5 == 2
    return Excerpt(u, x, ~out), Excerpt(u, x, out)


def error_of(r, fit, held):
    h = fit_hysteresis(factorise([fit], r, UNIT, NONE), r, int(fit.use.sum())).hysteresis
    e = (held.x - h(held.u))[held.use]
    return float(np.std(e))


def test_smooth_truth_gets_more_thresholds_and_less_error():
    r = (np.arange(40) + 0.37) / 40
    smooth = Hysteresis(r, np.exp(-r / 0.3) / np.exp(-r / 0.3).sum(), -0.28, 1.1)
    fit, held = split(smooth, 1e-6)
    chosen = choose_thresholds([fit], [held], 1.0, UNIT, NONE)
    assert chosen.size > 10
    assert np.all(np.diff(chosen) > 0)
    assert chosen[0] > 0
    assert error_of(chosen, fit, held) < 0.2 * error_of(even_thresholds(1.0, 10), fit, held)


def test_few_thresholds_off_the_grid_are_found():
    fit, held = split(Hysteresis([0.137, 0.42, 0.71], [0.4, 0.3, 0.2], -0.3, 1.0), 1e-5)
    chosen = choose_thresholds([fit], [held], 1.0, UNIT, NONE)
    assert error_of(chosen, fit, held) < 3e-5
    for r in (0.137, 0.42, 0.71):
        assert np.abs(chosen - r).min() < 0.01


def test_noise_alone_buys_no_threshold():
    fit, held = split(Hysteresis(even_thresholds(1.0, 10), np.full(9, 0.1), -0.3, 1.0), 0.01)
    assert choose_thresholds([fit], [held], 1.0, UNIT, NONE).size <= 9


@pytest.mark.filterwarnings('error')
def test_swing_limits_the_thresholds():
    fit, held = split(Hysteresis([0.2], [0.5], 0.0, 1.0), 1e-4)
    assert choose_thresholds([fit], [held], 0.6, UNIT, NONE).max() < 0.6

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The inverse of H: for every law, however a stream is cut, within its limits."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import PAPER
from piezo_ident.common.errors import ModelError
from piezo_ident.control.hysteresis_inverse import HysteresisInverse
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import LAWS
import pytest
from random_models import falling_hysteresis, random_hysteresis, random_path


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), law=st.sampled_from(LAWS))
def test_h_of_its_inverse_is_the_identity(seed, law):
    rng = np.random.default_rng(seed)
    h, u = random_hysteresis(rng, law), random_path(rng, 400)
    w = h(u)
    inverse = HysteresisInverse(h, (0.0, 1.0))
    assert inverse.reset(u[0]) == w[0]
    found, reached = inverse.process(w)
    assert_allclose(h(found), w, atol=1e-12)
    assert_allclose(reached, w, atol=1e-12)
    # where H rises, the voltage is the only one
    assert_allclose(found, u, atol=1e-9)
    cut = int(rng.integers(1, u.size))
    inverse.reset(u[0])
    parts = [inverse.process(part)[0] for part in (w[:cut], w[cut:])]
    assert_array_equal(np.concatenate(parts), found)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_limits_of_voltage_and_speed_are_kept_and_the_goal_is_met_again(seed):
    rng = np.random.default_rng(seed)
    h = random_hysteresis(rng, 'plays')
    w = h(np.concatenate([[0.4], random_path(rng, 400), np.full(40, 0.5)]))
    inverse = HysteresisInverse(h, (0.2, 0.8), 0.05)
    inverse.reset(0.4)
    u, reached = inverse.process(w)
    assert u.min() >= 0.2 and u.max() <= 0.8
    assert np.abs(np.diff(np.append(0.4, u))).max() <= 0.05 + 1e-15
    assert_allclose(h(np.append(0.4, u))[1:], reached, atol=1e-11)
    free = (u > 0.2) & (u < 0.8) & (np.abs(np.diff(np.append(0.4, u))) < 0.05 - 1e-12)
    assert_allclose(reached[free], w[free], atol=1e-11)


def test_an_h_that_falls_is_refused():
    with pytest.raises(ModelError, match=r'inverse: .*slope .* -0\.4'):
        HysteresisInverse(Hysteresis([0.1], [0.1], -0.8, 2.0))
    # no line stands for a wide play
    with pytest.raises(ModelError, match=r'falls to -0\.05 at 0 V'):
        HysteresisInverse(Hysteresis([0.1, 0.4], [0.5, 0.2], 0.0, -0.05))


def test_it_starts_anywhere():
    h = PAPER.hysteresis
    inverse = HysteresisInverse(h)
    assert inverse.reset(0.7) == h([0.7])[0]
    assert_allclose(inverse.process(h([0.7, 0.2]))[0], [0.7, 0.2], atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), law=st.sampled_from(LAWS))
def test_an_h_that_falls_within_narrow_plays_is_inverted_without_jumps(seed, law):
    rng = np.random.default_rng(seed)
    h = falling_hysteresis(rng, law)
    inverse = HysteresisInverse(h, (0.0, 1.0))
    w0 = inverse.reset(0.5)
    # a motion, and a ripple at rest, which the inverse of `h` itself answers by jumps at each turn
    goal = w0 + 0.02 * np.sin(np.arange(400) / 40.0)
    ripple = goal[-1] + 1e-9 * rng.standard_normal(200)
    u, reached = inverse.process(np.append(goal, ripple))
    assert_allclose(reached, np.append(goal, ripple), atol=1e-12)
    rise = inverse.hysteresis.lowest_slope()
    assert np.abs(np.diff(u[400:])).max() < 1.1e-8 / rise + 1e-8
    # beside the plays that are lines, by no more than their weights times their thresholds
    error = h(np.append(0.5, u))[1:] - np.append(goal, ripple)
    lines = inverse.hysteresis.thresholds != h.thresholds
    assert np.ptp(error) < 1.5 * float(h.weights[lines] @ h.thresholds[lines])

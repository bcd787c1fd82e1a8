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
from random_models import random_hysteresis, random_path


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
    with pytest.raises(ModelError, match=r'no inverse: its slope falls to -0\.4'):
        HysteresisInverse(Hysteresis([0.1], [0.1], -0.8, 2.0))


def test_it_starts_anywhere():
    h = PAPER.hysteresis
    inverse = HysteresisInverse(h)
    assert inverse.reset(0.7) == h([0.7])[0]
    assert_allclose(inverse.process(h([0.7, 0.2]))[0], [0.7, 0.2], atol=1e-12)


def test_h_may_fall_within_its_narrowest_play_alone():
    # behind each reversal H falls by 0.0005 before the first play moves
    h = Hysteresis([0.01, 0.4], [0.5, 0.2], 0.0, -0.05)
    inverse = HysteresisInverse(h)
    inverse.reset(0.0)
    w = 0.3 * (1.0 - np.cos(np.arange(2000) / 100))
    u, reached = inverse.process(w)
    assert_allclose(reached, w, atol=1e-9)
    assert_allclose(h(np.append(0.0, u))[1:], w, atol=1e-9)
    with pytest.raises(ModelError, match='has no inverse'):
        HysteresisInverse(Hysteresis([0.1, 0.4], [0.5, 0.2], 0.0, -0.05))

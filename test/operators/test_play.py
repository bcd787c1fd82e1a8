# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Play operators: analytic cases, properties of Prandtl and Ishlinskii, and a plain reference."""

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.play import initial_memory, play_columns
import pytest

signals = st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=60).map(np.array)
widths = st.lists(st.floats(0.0, 2.0), min_size=1, max_size=12, unique=True).map(
    lambda r: np.array(sorted(r))
)


def plainly(v, r, memory=None):
    """Return eq. (1) of the paper, as it is printed."""
    rows = []
    for i, width in enumerate(r):
        f = max(v[0] - width, min(v[0], 0.0)) if memory is None else memory[i]
        row = []
        for x in v:
            f = max(x - width, min(x, f))
            row.append(f)
        rows.append(row)
    return np.array(rows)


@settings(deadline=None)
@given(signals, widths)
def test_equals_the_printed_equation(v, r):
    assert_array_equal(play_columns(v, r), plainly(v, r))


@settings(deadline=None)
@given(signals, widths, st.floats(-3, 3))
def test_any_memory_ends_between_its_bounds(v, r, start):
    memory = np.full(r.size, start)
    F = play_columns(v, r, memory)
    assert_array_equal(F, plainly(v, r, memory))
    assert np.all(v - r[:, None] <= F)
    assert np.all(v >= F)
    assert_array_equal(memory, np.full(r.size, start))


def test_ramp_up_is_dead_for_one_threshold_and_ramp_down_too():
    up = np.linspace(0, 1, 101)
    assert_allclose(play_columns(up, [0.25])[0], np.maximum(0, up - 0.25), atol=1e-15)
    (back,) = play_columns(np.concatenate([up, up[::-1]]), [0.25])[:, 101:]
    assert_allclose(back, np.minimum(0.75, up[::-1]), atol=1e-15)


R = np.array([0.05, 0.1, 0.3, 0.55])
Q = np.array([0.4, 0.3, 0.2, 0.1])


def test_initial_memory_is_the_virgin_state_in_one_stroke():
    v0 = 0.62
    assert_allclose(initial_memory(v0, R), plainly(np.linspace(0, v0, 200), R)[:, -1], atol=1e-15)
    assert_array_equal(initial_memory(0.0, R), np.zeros(4))
    assert_array_equal(initial_memory(-0.2, R), np.full(4, -0.2))


@settings(deadline=None)
@given(signals, st.lists(st.integers(0, 60), max_size=4))
def test_weighted_sum_is_eq_6_however_it_is_cut(v, cuts):
    p1, p2 = -0.2774, 0.6232  # the paper's
    h, start = Hysteresis(R, Q, p1, p2), initial_memory(v[0], R)
    whole, end = h.follow(v, start)
    assert_allclose(whole, Q @ plainly(v, R) + p1 * v**3 + p2 * v, atol=1e-14)
    memory, parts = start, []
    for a, b in pairwise([0, *sorted(min(c, v.size) for c in cuts), v.size]):
        w, memory = h.follow(v[a:b], memory)
        parts.append(w)
    assert_array_equal(np.concatenate(parts), whole)
    assert_array_equal(memory, end)


def test_nothing_given_is_changed():
    v, r, memory = np.linspace(0, 1, 9), R.copy(), np.zeros(4)
    for x in (v, r, memory):
        x.setflags(write=False)
    play_columns(v, r, memory)
    Hysteresis(r, Q, 0.0, 1.0).follow(v, memory)


def test_one_bad_sample_does_not_stay_in_the_memory():
    v = np.array([0.0, 0.5, np.nan, 0.5, 0.2])
    w, memory = Hysteresis(R, Q, 0.0, 1.0).follow(v, np.zeros(4))
    assert np.isnan(w[2])
    assert np.all(np.isfinite(np.delete(w, 2)))
    assert np.all(np.isfinite(memory))


@pytest.mark.parametrize('v', [[0, 1, 0], (0.0, 1.0, 0.0), np.array([0, 1, 0], dtype=np.int32)])
def test_any_sequence_of_numbers_will_do(v):
    assert_allclose(play_columns(v, [0.25]), [[0.0, 0.75, 0.0]])
    assert_allclose(play_columns(np.arange(10.0)[::-1][::3], [0.5]), [[8.5, 6.0, 3.0, 0.0]])

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What stands near the turns of the voltage."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from piezo_ident.residual.reversals import EDGES, turns_of, ways
import pytest

RATE = 1000.0
T = np.arange(5000) / RATE
#: 1 Hz triangle of 0 .. 10 V: every way behind a turn is 0 .. 1 of the range
V = 10.0 * np.abs((T + 0.5) % 1.0 - 0.5) * 2.0


def test_turns_of_a_triangle_and_not_of_its_noise():
    assert_array_equal(turns_of(V, 0.1), np.arange(500, 5000, 500))
    noisy = V + 0.02 * np.random.default_rng(0).standard_normal(V.size)
    assert_allclose(turns_of(noisy, 0.2), np.arange(500, 5000, 500), atol=5)
    assert turns_of(np.zeros(10), 0.1).size == 0
    assert turns_of(np.arange(10.0), 0.1).size == 0


def test_rms_by_way_finds_what_was_put_there():
    # of a triangle the way is linear in time
    way = np.where(T < 0.5, np.nan, (T * 2.0) % 1.0)
    near = np.where(way < 0.05, 3.0, 1.0)
    sound = np.ones(V.size, dtype=bool)
    found = ways([(V, sound, RATE)], [(near, 2.0 * near)])
    assert [w.start for w in found] == list(EDGES[:-1])
    assert_allclose([w.rms[0] for w in found], [3, 3, 1, 1, 1, 1], atol=0.2)
    assert_allclose([w.rms[1] / w.rms[0] for w in found], 2.0)
    # what does not count is left out
    assert ways([(V, ~sound, RATE)], [(near,)]) == ()
    assert ways([(np.zeros(9), np.ones(9, bool), RATE)], [(np.ones(9),)]) == ()


@pytest.mark.parametrize('least', [0.05, 1.0, 9.0])
def test_turns_alternate(least):
    v = np.cumsum(np.random.default_rng(1).standard_normal(3000))
    turns = turns_of(v, least)
    assert np.all(np.diff(turns) > 0)
    assert np.all(np.diff(np.sign(np.diff(v[turns]))) != 0.0)
    assert np.all(np.abs(np.diff(v[turns])) > least)

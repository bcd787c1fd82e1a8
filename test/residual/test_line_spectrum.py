# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The turns of a voltage are found beside its noise."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from piezo_ident.residual.line_spectrum import turns_of
import pytest

RATE = 1000.0
T = np.arange(5000) / RATE
#: 1 Hz triangle of 0 .. 10 V
V = 10.0 * np.abs((T + 0.5) % 1.0 - 0.5) * 2.0


def test_turns_of_a_triangle_and_not_of_its_noise():
    assert_array_equal(turns_of(V, 0.1), np.arange(500, 5000, 500))
    noisy = V + 0.02 * np.random.default_rng(0).standard_normal(V.size)
    assert_allclose(turns_of(noisy, 0.2), np.arange(500, 5000, 500), atol=5)
    assert turns_of(np.zeros(10), 0.1).size == 0
    assert turns_of(np.arange(10.0), 0.1).size == 0


@pytest.mark.parametrize('least', [0.05, 1.0, 9.0])
def test_turns_alternate(least):
    v = np.cumsum(np.random.default_rng(1).standard_normal(3000))
    turns = turns_of(v, least)
    assert np.all(np.diff(turns) > 0)
    assert np.all(np.diff(np.sign(np.diff(v[turns]))) != 0.0)
    assert np.all(np.abs(np.diff(v[turns])) > least)

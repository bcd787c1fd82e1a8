# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Turns of a voltage beside its noise, and the stretches of a search."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from piezo_ident.record.record import Piece
from piezo_ident.residual.line_spectrum import Series, series_of, turns_of
from piezo_ident.residual.stretches import all_stretches, block_means, ResidualPart
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


def test_a_rest_counts_from_a_tenth_of_a_second_after_its_step():
    v = np.repeat([0.0, 5.0], 1000)
    e = np.random.default_rng(0).standard_normal(v.size)
    parts = [ResidualPart('r', Piece(v, v + e, RATE), e)]
    series, rate, high = series_of(parts, all_stretches(parts))
    assert (rate, high) == (RATE, 0.4 * RATE)
    # no step leads into the first rest
    assert [(s.t, s.x.size) for s in series] == [(0.0, 1000), (1.1, 900)]


def test_power_that_the_drive_caused_has_no_unit_of_the_drive():
    rng = np.random.default_rng(0)
    v, e = np.cumsum(rng.standard_normal((2, 1000)), axis=1)
    driven = []
    for scale in (1.0, 100.0):
        parts = [ResidualPart('r', Piece(scale * v, e, RATE), e)]
        driven.append(series_of(parts, all_stretches(parts))[0][0].driven)
    assert_allclose(driven[0], driven[1], rtol=1e-6)


@pytest.mark.parametrize('block', [1, 4])
def test_the_comb_of_differences_is_that_of_noise(block):
    rng, n, lag = np.random.default_rng(0), 200, 40
    window, powers = np.hanning(n), []
    s = Series('r', 0.0, np.zeros(n), window, lag / RATE, 0, block, RATE / block)
    for e in rng.standard_normal((2000, n * block + lag)):
        x = block_means(e[lag:] - e[:-lag], block)
        powers.append(np.abs(np.fft.rfft(window * x)) ** 2)
    found = np.mean(powers, axis=0) / s.comb(np.fft.rfftfreq(n, 1.0 / s.rate))
    # the means of noise have equal power at all frequencies
    assert_allclose(found[2:-2], found[2:-2].mean(), rtol=0.15)

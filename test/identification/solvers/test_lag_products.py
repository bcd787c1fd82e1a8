# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""Sums of products of lags against the matrix of lags itself."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from piezo_ident.identification.solvers.lag_products import (
    lag_products,
    lag_sums,
    STRETCH,
    stretches_of,
)
import pytest


def matrix(x, at, n, lags):
    return np.stack([x[at - i : at - i + n] for i in range(lags)])


@settings(deadline=None, max_examples=40)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 40),
    st.integers(1, 9),
    st.integers(1, 9),
    st.integers(9, 15),
    st.integers(9, 15),
)
def test_products_are_those_of_the_matrix_of_lags(seed, n, n_x, n_z, x_at, z_at):
    rng = np.random.default_rng(seed)
    x, z = rng.standard_normal(x_at + n), rng.standard_normal(z_at + n)
    expected = matrix(x, x_at, n, n_x) @ matrix(z, z_at, n, n_z).T
    got = lag_products(x, z, x_at, z_at, n, n_x, n_z)
    assert_allclose(got, expected, atol=1e-12)


def test_products_over_many_stretches_of_the_cache():
    rng = np.random.default_rng(0)
    n = 3 * STRETCH + 17
    x = rng.standard_normal(n + 12)
    expected = matrix(x, 12, n, 12) @ matrix(x, 12, n, 12).T
    got = lag_products(x, x, 12, 12, n, 12, 12)
    assert_allclose(got, expected, atol=1e-11)
    assert_allclose(got, got.T, atol=1e-11)


@pytest.mark.parametrize(
    ('use', 'found'),
    [
        ([], []),
        ([0], []),
        ([1], [(0, 1)]),
        ([1, 1, 0, 0, 1], [(0, 2), (4, 5)]),
        ([0, 1, 0, 1, 1, 0], [(1, 2), (3, 5)]),
    ],
)
def test_stretches(use, found):
    assert stretches_of(np.array(use, dtype=bool)) == found


def test_a_signal_with_itself_is_that_with_its_copy():
    x = np.random.default_rng(1).standard_normal(300)
    for lags in (1, 3, 4, 7, 8, 11):
        same = lag_products(x, x, 20, 20, 250, lags, lags)
        assert_array_equal(same, lag_products(x, x.copy(), 20, 20, 250, lags, lags))
        # not the same lags of it
        other = lag_products(x, x, 20, 21, 250, lags, lags)
        assert_array_equal(other, lag_products(x, x.copy(), 20, 21, 250, lags, lags))


@pytest.mark.parametrize(('n', 'lags'), [(1, 1), (5, 3), (400, 12)])
def test_sums_are_those_of_the_matrix_of_lags(n, lags):
    x = np.random.default_rng(2).standard_normal(13 + n)
    assert_allclose(lag_sums(x, 13, n, lags), matrix(x, 13, n, lags).sum(axis=1), atol=1e-12)

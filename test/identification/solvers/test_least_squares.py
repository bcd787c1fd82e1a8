# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Least squares on a factor against the samples themselves."""

import numpy as np
from numpy.testing import assert_allclose
from piezo_ident.identification.solvers.least_squares import (
    bounded_least_squares,
    ROWS,
    triangular_factor,
)
import pytest
from scipy.optimize import lsq_linear


def data(n, p, seed=0):
    return np.random.default_rng(seed).standard_normal((n, p)) * np.logspace(0, -3, p)


@pytest.mark.parametrize('n', [3, 8, 100, ROWS, 2 * ROWS + 17])
def test_factor_has_the_gram_matrix_of_the_rows(n):
    A = data(n, 6)
    R = triangular_factor([A], 6)
    assert R.shape == (6, 6)
    assert_allclose(R, np.triu(R))
    assert_allclose(R.T @ R, A.T @ A, atol=1e-10 * n)


def test_factor_does_not_depend_on_the_blocks():
    A = data(1000, 4)
    one = triangular_factor([A], 4)
    many = triangular_factor(iter([A[:3], A[3:500], A[500:500], A[500:]]), 4)
    assert_allclose(many.T @ many, one.T @ one, atol=1e-10)
    assert_allclose(triangular_factor([], 4), np.zeros((4, 4)))


@pytest.mark.parametrize('seed', range(5))
def test_bounded_is_that_of_scipy_on_the_samples(seed):
    A = data(300, 5, seed)
    y = A @ np.array([1.0, -1, 20, -30, 100]) + 0.01 * data(300, 1, seed + 50)[:, 0]
    low, high = np.array([0, 0, -np.inf, -10, 0.0]), np.array([0.5, np.inf, np.inf, np.inf, 50])
    x, loss = bounded_least_squares(triangular_factor([np.column_stack([A, y])], 6), low, high)
    expected = lsq_linear(A, y, (low, high), method='bvls', tol=1e-14)
    assert loss == pytest.approx(2 * expected.cost, rel=1e-8)
    assert_allclose(x, expected.x, atol=1e-6)
    assert np.all((x >= low) & (x <= high))


def test_column_of_zeros_is_no_obstacle():
    A = data(100, 3)
    A[:, 1] = 0
    y = A @ [1, 5, 1]
    x, loss = bounded_least_squares(
        triangular_factor([np.column_stack([A, y])], 4), np.zeros(3), np.full(3, np.inf)
    )
    assert_allclose(x[[0, 2]], [1, 1], atol=1e-9)
    assert loss < 1e-18
    assert np.all(np.isfinite(x))

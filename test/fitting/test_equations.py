# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A step within bounds and linear inequalities is the best one there."""

import numpy as np
from piezo_ident.fitting.equations import bounded_step
import pytest


@pytest.mark.parametrize('seed', range(10))
def test_a_step_that_undercuts_no_row_is_the_best_of_its_kind(seed):
    rng = np.random.default_rng(seed)
    M = rng.standard_normal((30, 8)) * np.exp(rng.uniform(-4.0, 4.0, 8))
    A, b = M.T @ M, M.T @ rng.standard_normal(30)
    lower = np.where(rng.random(8) < 0.4, -0.1, -np.inf)
    upper = np.where(rng.random(8) < 0.3, 0.2, np.inf)
    rows, least = rng.standard_normal((100, 8)), np.full(100, -0.02)
    x = bounded_step(A, b, lower, upper, rising=(rows, least))
    assert (rows @ x - least).min() > -1e-6
    assert np.all(lower <= x) and np.all(x <= upper)
    free = bounded_step(A, b, lower, upper)
    assert (rows @ free - least).min() < -1e-3
    # the set is convex: the way to any other point of it leads up
    others = [0.0 * x, *(x * t for t in (0.5, 0.9)), *rng.uniform(-1e-3, 1e-3, (50, 8))]
    inside = [p for p in others if (rows @ p >= least).all() and (p >= lower).all()]
    assert len(inside) > 10
    assert min((A @ x - b) @ (p - x) for p in inside) > -1e-6 * abs(b @ x)


def test_where_no_step_meets_all_rows_the_bounds_hold():
    rows, least = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([0.5, 0.5])
    bounds = np.full(2, -1.0), np.full(2, 1.0)
    x = bounded_step(np.eye(2), np.array([0.3, 3.0]), *bounds, rising=(rows, least))
    assert np.all(np.abs(x) <= 1.0)

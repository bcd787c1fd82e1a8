# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The swarm: its manners, and how near it comes to the optimum it can be judged by."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import PAPER
from piezo_ident.excitation.signals import triangle
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.solvers.particle_swarm import particle_swarm, Quadratic
from piezo_ident.identification.step3_hysteresis import even_thresholds, factorise, fit_hysteresis
import pytest
from scipy.optimize import lsq_linear


def rng(seed=0):
    return np.random.default_rng(seed)


def problem(n=5, seed=3):
    A = rng(seed).standard_normal((50, n))
    y = A @ np.linspace(-0.5, 0.8, n) + 0.01 * rng(seed + 1).standard_normal(50)
    return A, y, Quadratic(A.T @ A, A.T @ y, float(y @ y))


def test_quadratic_is_the_sum_of_squares():
    A, y, fun = problem()
    X = rng(9).standard_normal((7, 5))
    assert_allclose(fun(X), [np.sum((A @ x - y) ** 2) for x in X], rtol=1e-10)
    assert fun(X[0]) == pytest.approx(float(np.sum((A @ X[0] - y) ** 2)))


def fly(seed=0, low=-1.0, high=1.0, **how):
    *_, fun = problem()
    return particle_swarm(fun, np.full(5, low), np.full(5, high), rng=rng(seed), **how)


def test_finds_what_bounded_least_squares_finds():
    A, y, fun = problem()
    low, high = np.array([-0.2, -1, 0.25, -1, -1.0]), np.array([1, 1, 0.25, 1, 0.3])
    free = np.array([0, 1, 3, 4])
    best = lsq_linear(A[:, free], y - 0.25 * A[:, 2], (low[free], high[free])).x
    result = particle_swarm(fun, low, high, rng=rng(), maxiter=2000)
    assert_allclose(result.x[free], best, atol=1e-5)
    # bounds that touch fix a parameter
    assert np.all((result.x >= low) & (result.x <= high))
    assert result.fun == pytest.approx(float(np.sum((A @ result.x - y) ** 2)), rel=1e-6)


def test_same_state_same_result_and_another_state_another():
    one, same, other = (fly(seed, maxiter=130, swarm_size=11) for seed in (1, 1, 2))
    assert_array_equal(one.x, same.x)
    assert np.any(one.x != other.x)
    assert (one.nit, one.nfev, one.swarm_size) == (130, 131 * 11, 11)


def test_tolerance_stops_early():
    result = fly(tol=1e-3)
    assert result.nit < 5000


def test_callback_sees_every_hundredth_iteration_and_stops():
    seen = []

    def callback(state):
        seen.append((state.nit, state.fun))
        return len(seen) == 3

    result = fly(callback=callback)
    assert [nit for nit, _ in seen] == [100, 200, 300]
    assert (result.nit, result.fun) == seen[-1]
    assert np.all(np.diff([f for _, f in seen]) <= 0)


@pytest.fixture(scope='module')
def paper():
    """Return the factor of the paper's stage under a triangle, sensor noise 2e-5 of its span."""
    v = np.concatenate([np.zeros(100), triangle([10 / 3, 20 / 3, 10], 0, 6, 20_000)])
    y = PAPER.stream().process(v) / 75e-6 + 2e-5 * rng(1).standard_normal(v.size)
    use = np.ones(v.size, dtype=bool)
    r = even_thresholds(1.0, 10)
    R = factorise([Excerpt(v / 10, y, use)], r, PAPER.dynamics.normalised(), PAPER.delay)
    return R, r, v.size


def test_nine_of_ten_seeds_come_within_one_per_cent_of_the_optimum(paper):
    R, r, n = paper
    excess, spent = [], []
    for seed in range(10):
        fit = fit_hysteresis(R, r, n, solver='swarm', rng=rng(seed))
        excess.append(fit.swarm_loss / fit.optimum_loss - 1)
        spent.append((fit.swarm.swarm_size, fit.swarm.nit, fit.swarm.nfev))
    said = f'loss over the optimum {np.round(excess, 5)}; particles, iterations, calls {spent}'
    assert min(excess) >= -1e-9, said
    assert sum(e < 0.01 for e in excess) >= 9, said
    # 40 particles, 9,000 to 15,000 iterations, 360,000 to 590,000 evaluations
    assert max(nit for _, nit, _ in spent) < 20_000, said

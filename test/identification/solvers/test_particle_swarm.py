# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The swarm: SciPy's manners, and how near it comes to the optimum it can be judged by."""

from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from piezo_ident.common.errors import ConfigError
from piezo_ident.excitation.signals import triangle
from piezo_ident.identification.solvers import particle_swarm as swarm
from piezo_ident.identification.solvers.particle_swarm import particle_swarm, Quadratic
from piezo_ident.identification.step3_hysteresis import (
    even_thresholds,
    Excerpt,
    factorise,
    fit_hysteresis,
)
from piezo_ident.model.simulated_stage import SimulatedStage
import pytest
from scipy.optimize import Bounds, lsq_linear

ROOT = Path(__file__).resolve().parents[3]


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


def test_finds_what_bounded_least_squares_finds():
    A, y, fun = problem()
    low, high = np.array([-0.2, -1, -1, -1, -1.0]), np.array([1, 1, 1, 1, 0.3])
    best = lsq_linear(A, y, (low, high)).x
    result = particle_swarm(fun, Bounds(low, high), rng=rng(), maxiter=2000)
    assert_allclose(result.x, best, atol=1e-5)
    assert np.all((result.x >= low) & (result.x <= high))
    assert result.fun == pytest.approx(float(np.sum((A @ result.x - y) ** 2)), rel=1e-6)


def test_compiled_and_callable_objectives_find_the_same():
    A, y, fun = problem()
    bounds = [(-1, 1)] * 5
    plain = particle_swarm(
        lambda X: ((X @ A.T - y) ** 2).sum(axis=1), bounds, rng=rng(), maxiter=2000
    )
    compiled = particle_swarm(fun, bounds, rng=rng(), maxiter=2000)
    assert_allclose(plain.x, compiled.x, atol=1e-5)


def test_bounds_object_and_list_are_the_same():
    *_, fun = problem()
    one = particle_swarm(fun, [(-1, 1)] * 5, rng=rng(4), maxiter=300)
    two = particle_swarm(fun, Bounds([-1] * 5, [1] * 5), rng=rng(4), maxiter=300)
    assert_array_equal(one.x, two.x)


def test_same_state_same_result_and_another_state_another():
    *_, fun = problem()
    results = [particle_swarm(fun, [(-1, 1)] * 5, rng=rng(s), maxiter=50) for s in (1, 1, 2)]
    assert_array_equal(results[0].x, results[1].x)
    assert np.any(results[0].x != results[2].x)


def test_result_tells_what_was_done():
    calls = []

    def fun(X):
        calls.append(X.shape)
        return (X**2).sum(axis=1)

    result = particle_swarm(fun, [(-1, 1)] * 2, rng=rng(), swarm_size=11, maxiter=130)
    assert (result.nit, result.nfev, result.swarm_size) == (130, 131 * 11, 11)
    assert calls == [(11, 2)] * 131
    assert result.success
    assert result.status == 1
    assert 'iterations' in result.message


def test_tolerance_stops_early():
    *_, fun = problem()
    result = particle_swarm(fun, [(-1, 1)] * 5, rng=rng(), tol=1e-3, maxiter=20_000)
    assert result.nit < 5000
    assert result.status == 0
    assert result.success


def test_a_large_swarm_is_asked_more_often_and_finds_the_same(monkeypatch):
    *_, fun = problem()

    def run(**kwargs):
        seen = []
        result = particle_swarm(
            fun, [(-1, 1)] * 5, rng=rng(), callback=lambda state: seen.append(state.nit), **kwargs
        )
        return result, seen

    few, _ = run(maxiter=2030, tol=1e-9)
    monkeypatch.setattr(swarm, 'WORK', 7 * 40 * 5 * 5)
    many, seen = run(maxiter=2030, tol=1e-9)
    assert_array_equal(few.x, many.x)
    assert (few.nit, few.status) == (many.nit, many.status)
    assert np.max(np.diff(seen)) == 7 and 1000 in seen
    # as it comes: at most ten million products between two looks, whatever the size
    monkeypatch.undo()
    _, seen = run(maxiter=200, swarm_size=20_000)
    assert np.max(np.diff(seen)) * 20_000 * 5 * 5 <= 1e7


@pytest.mark.parametrize('how', ['true', 'raise'])
def test_callback_stops(how):
    seen = []

    def callback(state):
        seen.append((state.nit, state.fun))
        if len(seen) < 3:
            return False
        if how == 'raise':
            raise StopIteration
        return True

    *_, fun = problem()
    result = particle_swarm(fun, [(-1, 1)] * 5, rng=rng(), callback=callback)
    assert [nit for nit, _ in seen] == [100, 200, 300]
    assert result.nit == 300
    assert not result.success
    assert result.fun == seen[-1][1]
    assert np.all(np.diff([f for _, f in seen]) <= 0)


def test_an_exception_of_the_callback_comes_through():
    def callback(_):
        raise KeyError('mine')

    *_, fun = problem()
    with pytest.raises(KeyError, match='mine'):
        particle_swarm(fun, [(-1, 1)] * 5, rng=rng(), callback=callback)


def test_objective_may_spoil_its_argument_and_answer_nan():
    def fun(X):
        value = np.where(X[:, 0] < 0, np.nan, (X - 0.3) ** 2 @ np.ones(2))
        X[:] = 7
        return value

    result = particle_swarm(fun, [(-1, 1)] * 2, rng=rng(), maxiter=300)
    assert_allclose(result.x, 0.3, atol=1e-6)


def test_bounds_that_touch_fix_a_parameter():
    *_, fun = problem()
    result = particle_swarm(fun, [(0.25, 0.25), *[(-1, 1)] * 4], rng=rng(), maxiter=200)
    assert result.x[0] == 0.25


@pytest.mark.parametrize('bounds', [[], [(0, np.inf)], [(np.nan, 1)], [(1, 0)], Bounds(0, np.inf)])
def test_bounds_that_are_none_are_refused(bounds):
    with pytest.raises(ConfigError, match='bound'):
        particle_swarm(lambda X: X[:, 0], bounds, rng=rng())


@pytest.mark.parametrize('size', [{'swarm_size': 1}, {'maxiter': 0}])
def test_no_swarm_is_refused(size):
    with pytest.raises(ConfigError, match='at least'):
        particle_swarm(lambda X: X[:, 0], [(0, 1)], rng=rng(), **size)


@pytest.fixture(scope='module')
def paper():
    """Return the factor of the paper's stage under a triangle, sensor noise 2e-5 of its span."""
    stage = SimulatedStage.load(ROOT / 'config/stage_paper.yaml').model
    v = np.concatenate([np.zeros(100), triangle([10 / 3, 20 / 3, 10], 0, 6, 20_000)])
    y = stage.stream().process(v) / 75e-6 + 2e-5 * rng(1).standard_normal(v.size)
    use = np.ones(v.size, dtype=bool)
    r = even_thresholds(1.0, 10)
    R = factorise([Excerpt(v / 10, y, use)], r, stage.dynamics.normalised(), stage.delay)
    return R, r, v.size


def test_twenty_seeds_come_within_one_per_cent_of_the_optimum(paper):
    R, r, n = paper
    excess, spent = [], []
    for seed in range(20):
        fit = fit_hysteresis(R, r, n, solver='swarm', rng=rng(seed))
        excess.append(fit.swarm_loss / fit.optimum_loss - 1)
        spent.append((fit.swarm.swarm_size, fit.swarm.nit, fit.swarm.nfev))
    said = f'loss over the optimum {np.round(excess, 5)}; particles, iterations, calls {spent}'
    assert min(excess) >= -1e-9, said
    assert sum(e < 0.01 for e in excess) >= 19, said
    # 40 particles, 9,000 to 15,000 iterations, 360,000 to 590,000 evaluations
    assert max(nit for _, nit, _ in spent) < 20_000, said

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Refinement by output error: its gradient, its result, its covariance."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.solvers.output_error import (
    _Problem,
    lag_products,
    output_error,
    RADIUS,
    simulation_error,
)
from piezo_ident.operators.dynamics import Dynamics, filter_arx
import pytest

G = Dynamics([-1.5, 0.8], [0.1, 0.25])


def stretch(seed=0, n=3000, noise=0.0, offset=0.0, G=G, start=0.0):
    rng = np.random.default_rng(seed)
    w = start + rng.standard_normal(n)
    y = filter_arx(G.a, G.b, w) + offset + noise * rng.standard_normal(n)
    return Excerpt(w, y, np.ones(n, dtype=bool))


@pytest.mark.parametrize(('na', 'nb'), [(2, 2), (1, 3), (3, 1)])
def test_gradient_against_finite_differences(na, nb):
    rng = np.random.default_rng(1)
    model = Dynamics(np.array([-0.9, 0.3, 0.1])[:na], rng.standard_normal(nb))
    some = stretch(2, 400, noise=0.1, offset=3.0, start=0.7)
    use = np.ones(400, dtype=bool)
    use[:37] = use[200:230] = False
    problem = _Problem([Excerpt(some.u, some.x, use), stretch(3, 200)], na, nb)
    _, g = problem.normal(model, problem.errors(model))
    theta = np.concatenate([model.a, model.b])
    numerical = []
    for i in range(na + nb):
        h = 1e-6
        plus, minus = theta.copy(), theta.copy()
        plus[i] += h
        minus[i] -= h
        up, down = (problem.loss(problem.errors(Dynamics(t[:na], t[na:]))) for t in (plus, minus))
        numerical.append((up - down) / (2 * h) * problem.n)
    # the loss is the mean of squares, g half of minus its gradient times n
    assert_allclose(-2 * g, numerical, rtol=1e-5, atol=1e-4)


def test_recovers_the_truth_from_a_poor_start():
    stretches = [stretch(offset=2.5)]
    fit = output_error(stretches, Dynamics([-0.8, 0.2], [0.3, 0.3]), maxiter=100)
    assert_allclose(fit.dynamics.a, G.a, atol=1e-6)
    assert_allclose(fit.dynamics.b, G.b, atol=1e-6)
    assert simulation_error(stretches, fit.dynamics) < 1e-6


def test_several_stretches_have_their_own_offsets_and_holes():
    one, two = stretch(0, offset=1.0), stretch(1, offset=-2.0, start=0.5)
    use = np.ones(3000, dtype=bool)
    use[1000:2000] = False
    y = two.x.copy()
    y[1000:2000] = 1e6
    stretches = [one, Excerpt(two.u, y, use)]
    fit = output_error(stretches, Dynamics([-1.4, 0.7], [0.1, 0.3]))
    assert_allclose(fit.dynamics.a, G.a, atol=1e-6)
    assert simulation_error(stretches, fit.dynamics) < 1e-5


@pytest.mark.parametrize('seed', range(6))
def test_never_unstable_and_never_worse(seed):
    # output that has nothing to do with the input, and one of an unstable kind
    rng = np.random.default_rng(seed)
    w = rng.standard_normal(800)
    wild = np.cumsum(np.cumsum(rng.standard_normal(800)))
    start = Dynamics([-1.9, 0.95], [0.1, 0.1])
    some = Excerpt(w, wild, np.ones(800, dtype=bool))
    fit = output_error([some], start)
    assert fit.dynamics.radius < RADIUS
    before, after = (simulation_error([some], model) for model in (start, fit.dynamics))
    assert after <= before * (1 + 1e-12)
    assert np.all(np.isfinite(fit.covariance))


def test_exact_start_is_left_alone():
    fit = output_error([stretch()], G)
    assert simulation_error([stretch()], fit.dynamics) < 1e-12
    assert_allclose(fit.dynamics.a, G.a, atol=1e-9)


def test_covariance_is_what_repeats_scatter_by():
    n_runs = 60
    theta, predicted = [], []
    for seed in range(n_runs):
        fit = output_error([stretch(seed, 1500, noise=0.1)], G, maxiter=20)
        theta.append(np.concatenate([fit.dynamics.a, fit.dynamics.b]))
        predicted.append(np.sqrt(np.diag(fit.covariance)))
    scatter, claimed = np.std(theta, axis=0, ddof=1), np.mean(predicted, axis=0)
    # sixty runs know a standard deviation to 9 %
    assert_allclose(scatter / claimed, 1.0, atol=0.35)
    # unbiased within three standard errors
    bias = np.mean(theta, axis=0) - np.concatenate([G.a, G.b])
    assert np.all(np.abs(bias) < 3.5 * claimed / np.sqrt(n_runs))


def test_covariance_of_a_normalised_g_against_finite_differences():
    fit = output_error([stretch(1, 1500, noise=0.1)], G, maxiter=20)
    na, theta = G.a.size, np.concatenate([fit.dynamics.a, fit.dynamics.b])

    def normalised(x):
        found = Dynamics(x[:na], x[na:]).normalised()
        return np.concatenate([found.a, found.b])

    steps = 1e-6 * np.eye(theta.size)
    J = np.stack([(normalised(theta + h) - normalised(theta - h)) / 2e-6 for h in steps], axis=1)
    assert_allclose(fit.normalised_covariance, J @ fit.covariance @ J.T, rtol=1e-6, atol=1e-18)


def test_tick_may_stop_the_work():
    class Stop(Exception):
        """Asked to stop."""

    def tick():
        raise Stop

    with pytest.raises(Stop):
        output_error([stretch()], Dynamics([-1.4, 0.7], [0.1, 0.3]), tick=tick)


def test_a_model_without_poles_is_fitted_too():
    fit = output_error([stretch(G=Dynamics([], [0.6, 0.3]))], Dynamics([], [0.2, 0.1]))
    assert fit.dynamics.a.size == 0
    assert_allclose(fit.dynamics.b, [0.6, 0.3], atol=1e-9)


def lags_of(x, at, n, lags):
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
    expected = lags_of(x, x_at, n, n_x) @ lags_of(z, z_at, n, n_z).T
    got = lag_products(x, z, x_at, z_at, n, n_x, n_z)
    assert_allclose(got, expected, atol=1e-12)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""ARX: every order from one factor, mirrored poles, instruments against output noise."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import A, B
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.solvers.arx import (
    arx_factor,
    instrumental_variables,
    scan_orders,
    stabilised,
)
from piezo_ident.operators.dynamics import Dynamics, filter_arx
import pytest

FS = 20_000.0
PAPER = Dynamics(A, B)
SMALL = Dynamics([-1.5, 0.8], [0.1, 0.25])


def data(G, d, n=6000, noise=0.0, seed=0):
    rng = np.random.default_rng(seed)
    u = rng.standard_normal(n)
    delayed = np.concatenate([np.zeros(d), u[: n - d]])
    y = filter_arx(G.a, G.b, delayed, at_rest=False)
    return u, y + noise * y.std() * rng.standard_normal(n)


@pytest.mark.parametrize(
    ('na', 'nb', 'd'), [(1, 1, 0), (2, 3, 0), (4, 2, 3), (6, 8, 2), (6, 1, 9)]
)
def test_orders_from_one_factor_are_lstsq_on_the_plain_matrix(na, nb, d):
    u, y = data(PAPER, 3, 900, noise=0.1)
    na_max, n_lags = 6, 10
    theta, loss = arx_factor(u, y, na_max, n_lags).fit(na, nb, d)
    k = np.arange(max(na_max, n_lags - 1), y.size)
    phi = np.column_stack(
        [*(-y[k - i] for i in range(1, na + 1)), *(u[k - d - j] for j in range(nb))]
    )
    expected, (rest,), *_ = np.linalg.lstsq(phi, y[k], rcond=None)
    assert_allclose(theta, expected, rtol=1e-8, atol=1e-10)
    assert loss == pytest.approx(rest / k.size, rel=1e-8)


@pytest.mark.parametrize(('na', 'd'), [(1, 0), (3, 2), (6, 3)])
def test_all_numerators_at_once_are_each_alone(na, d):
    u, y = data(PAPER, 3, 900, noise=0.1)
    factor = arx_factor(u, y, 6, 10)
    for nb, (theta, loss) in enumerate(factor.fits(na, 6, d), 1):
        expected, least = factor.fit(na, nb, d)
        assert_allclose(theta, expected, rtol=1e-8, atol=1e-10)
        assert loss == pytest.approx(least, rel=1e-8)


def test_columns_that_cannot_be_told_apart_share_what_they_explain():
    # a square wave of long holds: each lag of it is the one before but for a few samples of none
    u = np.repeat([1.0, -1.0], 450)
    factor = arx_factor(np.zeros(900), u, 3, 4)
    for nb, (theta, loss) in enumerate(factor.fits(2, 4, 0), 1):
        expected, least = factor.fit(2, nb, 0)
        assert_array_equal(theta, expected)
        assert loss == least


@pytest.mark.parametrize('d', [0, 3, 7])
def test_noise_free_data_give_the_truth_back(d):
    u, y = data(PAPER, d)
    theta, loss = arx_factor(u, y, 10, 10 + d).fit(10, 10, d)
    # ten lags of a smooth output are nearly dependent: six digits are left
    assert_allclose(theta, np.concatenate([A, B]), atol=1e-6)
    assert loss < 1e-20


def test_too_few_samples_are_refused():
    with pytest.raises(IdentificationError, match=r'30 .* 5 \+ 8'):
        arx_factor(np.zeros(30), np.zeros(30), 5, 8)


@pytest.mark.filterwarnings('error')
def test_silence_gives_zeros():
    theta, loss = arx_factor(np.zeros(500), np.zeros(500), 3, 3).fit(3, 3, 0)
    assert_allclose(theta, 0)
    assert loss == 0


def table_of(G, d, noise=0.02, nb_max=5):
    u, y = data(G, d, 20_000, noise)
    factor = arx_factor(u[:15_000], y[:15_000], 5, nb_max + d)
    return scan_orders(factor, d, nb_max, u[15_000:], y[15_000:])


def test_order_table_finds_a_known_order():
    table = table_of(SMALL, 2, noise=0.0)
    # the true order and all that contain it simulate exactly, the smaller ones do not
    assert table.held_out[1, 1] < 1e-6
    assert table.held_out[0].min() > 0.1
    assert table.held_out[1, 0] > 0.01


def test_criteria_are_their_formulas():
    table = table_of(SMALL, 0)
    u, y = data(SMALL, 0, 20_000, 0.02)
    factor = arx_factor(u[:15_000], y[:15_000], 5, 5)
    _, loss = factor.fit(3, 2, 0)
    n, p = factor.n, 5
    assert table.loss[2, 1] == pytest.approx(loss)
    assert table.aic[2, 1] == pytest.approx(n * np.log(loss) + 2 * p)
    assert table.bic[2, 1] == pytest.approx(n * np.log(loss) + np.log(n) * p)
    # one more parameter never raises the loss
    assert np.all(np.diff(table.loss, axis=0) <= 1e-12)
    assert np.all(np.diff(table.loss, axis=1) <= 1e-12)


def test_ranking_prefers_the_smaller_of_equals_and_skips_the_unstable():
    table = table_of(SMALL, 2, noise=0.0)
    assert table.ranked(1e30)[0] == (1, 1)
    ranked = table.ranked()
    held = [table.held_out[i - 1, j - 1] for i, j in ranked]
    assert held == sorted(held)
    assert ranked[0] == table.best('held_out')
    assert len(ranked) == np.isfinite(table.held_out).sum()


def test_stabilised_mirrors_poles_and_keeps_the_gain():
    poles = np.array([1.25, 0.9 + 0.7j, 0.9 - 0.7j, 0.3])
    G = Dynamics(np.real(np.poly(poles))[1:], [0.2, 0.1])
    assert not G.is_stable
    mirrored = stabilised(G)
    assert mirrored.is_stable
    expected = [1 / 1.25, 1 / (0.9 - 0.7j), 1 / (0.9 + 0.7j), 0.3]
    assert_allclose(np.sort_complex(mirrored.poles), np.sort_complex(expected), atol=1e-10)
    assert mirrored.gain == pytest.approx(G.gain)
    # the magnitude of the response keeps its shape
    f = np.array([100.0, 3000, 9000])
    ratio = np.abs(mirrored.response(f, FS) / G.response(f, FS))
    assert_allclose(ratio, ratio[0], rtol=1e-9)


@pytest.mark.filterwarnings('error')
def test_stabilised_leaves_the_stable_alone_and_pulls_in_an_integrator():
    assert stabilised(PAPER) is PAPER
    assert stabilised(Dynamics.unit()).gain == 1.0
    pulled = stabilised(Dynamics([-1.0], [0.5]))
    assert pulled.radius == pytest.approx(0.9995)


def test_instruments_are_less_biased_by_output_noise():
    # second order with 20 % output noise: least squares takes the noise for damping
    bias_ls, bias_iv = [], []
    for seed in range(8):
        u, y = data(SMALL, 1, 8000, noise=0.2, seed=seed)
        theta, _ = arx_factor(u, y, 2, 3).fit(2, 2, 1)
        start = Dynamics(theta[:2], theta[2:])
        fit = instrumental_variables(u, y, start, 1)
        bias_ls.append(theta[:2] - SMALL.a)
        bias_iv.append(fit.a - SMALL.a)
    ls, iv = (np.linalg.norm(np.mean(b, axis=0)) for b in (bias_ls, bias_iv))
    assert ls > 0.05
    assert iv < 0.1 * ls


def test_instruments_keep_an_exact_model():
    u, y = data(SMALL, 1)
    fit = instrumental_variables(u, y, SMALL, 1)
    assert_allclose(fit.a, SMALL.a, atol=1e-9)
    assert_allclose(fit.b, SMALL.b, atol=1e-9)

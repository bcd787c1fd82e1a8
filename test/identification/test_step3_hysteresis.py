# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Step 3: weights of H recovered, with offsets, holes, noise, and what is not excited."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import A, B
from piezo_ident.common.errors import IdentificationError
from piezo_ident.excitation.signals import triangle
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.step3_choice import choose_thresholds, merged
from piezo_ident.identification.step3_hysteresis import (
    even_thresholds,
    factorise,
    fine_thresholds,
    fit_hysteresis,
)
from piezo_ident.operators.dynamics import Delay, Dynamics, filter_arx
from piezo_ident.operators.hysteresis import Hysteresis
import pytest

G = Dynamics(A, B).normalised()
Q = [0.4777, 0.4473, 0.1113, 0.0671, 0.1411, 0.0104, 0.0001, 0.0354, 0.0961, 0.0084]
H = Hysteresis(np.arange(10) / 10, Q, -0.2774, 0.6232)
D = Delay(3)
TEN = even_thresholds(1.0, 10)


def excerpt(peaks=(1 / 3, 2 / 3, 1.0), slope=3.0, noise=0.0, seed=0, offset=0.0, rate=20_000):
    u = np.concatenate([np.zeros(50), triangle(peaks, 0, slope, rate)])
    x = offset + filter_arx(G.a, G.b, D.apply(H(u)))
    x = x + noise * np.random.default_rng(seed).standard_normal(u.size)
    return Excerpt(u, x, np.ones(u.size, dtype=bool))


def fitted(*excerpts, r=TEN, **options):
    n = sum(int(e.use.sum()) for e in excerpts)
    rows = sum(e.rows for e in excerpts)
    return fit_hysteresis(factorise(excerpts, r, G, D), r, n, rows=rows, **options)


def test_noise_free_triangles_give_the_weights_and_an_offset_each_back():
    fit = fitted(excerpt(offset=0.25))
    assert_allclose(fit.hysteresis.weights, Q[1:], atol=1e-7)
    assert fit.hysteresis.p1 == pytest.approx(-0.2774, abs=1e-7)
    assert fit.hysteresis.p2 == pytest.approx(0.6232 + 0.4777, abs=1e-7)
    assert_allclose(fit.offsets, [0.25], atol=1e-7)
    assert fit.rms < 1e-7
    fit = fitted(excerpt(offset=0.25), excerpt(peaks=(1.0,), offset=-7.0), excerpt(offset=100.0))
    assert_allclose(fit.offsets, [0.25, -7.0, 100.0], atol=1e-6)
    assert_allclose(fit.hysteresis.weights, Q[1:], atol=1e-6)


def test_what_the_mask_leaves_out_is_not_looked_at():
    e = excerpt()
    use, x = np.ones(e.u.size, dtype=bool), e.x.copy()
    for start in range(500, e.u.size - 600, 2000):
        use[start : start + 501] = False
        x[start : start + 501] = 1e3
    # the filter has no memory of what was left out: it sees the voltage, not the displacement
    fit = fitted(Excerpt(e.u, x, use))
    assert_allclose(fit.hysteresis.weights, Q[1:], atol=1e-6)


def test_swarm_returns_what_it_found_and_both_losses_are_kept():
    e = excerpt(noise=1e-3)
    plain = fitted(e)
    assert plain.swarm is None
    for polish in (False, True):
        rng = np.random.default_rng(0)
        fit = fitted(e, solver='swarm', polish=polish, rng=rng, maxiter=3000)
        h, better = fit.hysteresis, plain.hysteresis
        weights = better.weights if polish else fit.swarm.x[: h.weights.size]
        assert_array_equal(h.weights, weights)
        assert fit.loss == (fit.optimum_loss if polish else fit.swarm_loss)
        assert fit.swarm_loss > fit.optimum_loss == plain.loss
        assert fit.polished == polish


@pytest.mark.parametrize('rate', [2000, 20_000])
def test_std_is_what_repeats_scatter_by(rate):
    # a well-conditioned choice of thresholds, so that no weight sits on its bound
    r = np.array([0.1, 0.2, 0.4])
    truth = Hysteresis(r, [0.45, 0.2, 0.3], -0.28, 1.1)
    u = np.concatenate([np.zeros(20), triangle((0.4, 1.0), 0, 1.4, rate)])
    x = filter_arx(G.a, G.b, D.apply(truth(u)))
    use = np.ones(u.size, dtype=bool)
    found, claimed, rms = [], [], []
    for seed in range(60):
        noisy = x + 1e-3 * np.random.default_rng(seed).standard_normal(u.size)
        fit = fitted(Excerpt(u, noisy, use), r=r)
        h = fit.hysteresis
        found.append([*h.weights, h.p1, h.p2])
        claimed.append(fit.std)
        rms.append(fit.rms)
    ratio = np.std(found, axis=0, ddof=1) / np.mean(claimed, axis=0)
    assert_allclose(ratio, 1.0, atol=0.35)
    # the residual is seen after averaging over the rows of the fit
    row = Excerpt(u, x, use).row
    assert np.mean(rms) == pytest.approx(1e-3 / np.sqrt(row), rel=0.05)


def test_rows_average_many_samples_of_a_slow_triangle():
    slow = excerpt(slope=0.3)
    assert slow.row > 1
    assert slow.u.size // slow.row >= 9_000
    assert_allclose(fitted(slow).hysteresis.weights, Q[1:], atol=1e-5)
    assert excerpt(slope=300.0).row == 1


def test_papers_triangle_to_nine_volts_does_not_go_wild_at_ten():
    # eq. (7): peaks 3, 6, 9 V of 10; the play with r = 0.9 never moves there
    for noise in (0.0, 2e-5, 1e-3):
        e = excerpt(peaks=(0.3, 0.6, 0.9), noise=noise)
        fit = fitted(e, r=even_thresholds(0.9, 10))
        u = np.concatenate([np.linspace(0, 1, 500), np.linspace(1, 0, 500)])
        error = np.abs(fit.hysteresis(u) - H(u)).max()
        assert error < 0.02 * np.ptp(H(u))
        assert np.all(fit.hysteresis.weights <= 1.0)


def test_threshold_that_never_moves_gets_no_weight():
    e = excerpt(peaks=(0.3, 0.6), noise=1e-4)
    fit = fitted(e, r=np.array([0.1, 0.3, 0.6, 0.9]))
    assert_allclose(fit.hysteresis.weights[2:], 0.0, atol=1e-12)
    assert_allclose(fit.std[2:4], 0.0, atol=1e-12)


@pytest.mark.parametrize('seed', range(4))
def test_threshold_that_stands_still_where_it_is_fitted_gets_no_weight(seed):
    # plays wider than the second swing moved before, and are a constant now: rounding times
    # anything would fit
    u = np.concatenate(
        [np.linspace(0, 1, 5000), np.linspace(1, 0.6, 2000), np.linspace(0.6, 1, 2000)]
    )
    x = filter_arx(G.a, G.b, D.apply(H(u))) + 1e-4 * np.random.default_rng(seed).standard_normal(
        9000
    )
    use = np.arange(9000) >= 5500
    fit = fitted(Excerpt(u, x, use), r=np.array([0.1, 0.3, 0.5, 0.8]))
    assert_array_equal(fit.hysteresis.weights[2:], [0.0, 0.0])
    assert_array_equal(fit.std[2:4], [0.0, 0.0])
    assert abs(fit.offsets[0]) < 1.0


@pytest.mark.parametrize('noise', [0.0, 1e-12, 1e-3])
def test_voltage_of_two_levels_does_not_explode(noise):
    # every play and the cubic are then multiples of v: weights of 1e13 fit as well as any
    u = np.repeat(np.tile([0.25, 0.75], 8), 500)
    x = filter_arx(G.a, G.b, D.apply(H(u))) + noise * np.random.default_rng(0).standard_normal(
        u.size
    )
    fit = fitted(Excerpt(u, x, np.ones(u.size, dtype=bool)))
    h = fit.hysteresis
    assert h.p1 == 0.0
    assert np.abs([*h.weights, h.p2]).max() < 3.0
    assert fit.rms < 2 * noise + 1e-6


def test_known_memory_at_the_start_is_used():
    e = excerpt()
    n = 13_000
    memory = fit_memory_of(e.u[:n])
    late = Excerpt(e.u[n:], e.x[n:], e.use[n:], lambda r: memory(r))
    still = Excerpt(e.u[n:], e.x[n:], np.arange(e.u.size - n) > 200, lambda r: memory(r))
    assert fitted(late).rms < 1e-2
    assert fitted(still).rms < 1e-6
    assert fitted(Excerpt(still.u, still.x, still.use)).rms > 1e-4


def fit_memory_of(u):
    def memory(r):
        f = np.zeros(r.size)
        for x in u:
            f = np.maximum(x - r, np.minimum(x, f))
        return f

    return memory


def test_displacement_that_does_not_move_is_refused():
    e = excerpt()
    with pytest.raises(IdentificationError, match=r'hysteresis: .* sensor'):
        fitted(Excerpt(e.u, np.zeros(e.u.size), e.use))


def test_grids():
    assert_allclose(even_thresholds(0.9, 3), [0.3, 0.6])
    fine = fine_thresholds(1.0, 0.1)
    assert np.all(np.diff(fine) > 0)
    assert fine[0] == pytest.approx(0.1 / 12)
    assert fine[-1] < 1.0
    # noise as wide as the triangle adds nothing beyond it
    assert fine_thresholds(0.2, 0.9).max() < 0.2


def test_merged_finds_thresholds_between_the_grid():
    truth = Hysteresis([0.137, 0.42, 0.71], [0.4, 0.3, 0.2], -0.3, 1.0)
    u = np.concatenate([np.zeros(50), triangle((0.5, 1.0), 0, 3.0, 20_000)])
    e = Excerpt(u, filter_arx(G.a, G.b, D.apply(truth(u))), np.ones(u.size, dtype=bool))
    fine = fitted(e, r=even_thresholds(1.0, 56)).hysteresis
    places = merged(fine)
    assert places.size <= 6
    for r in truth.thresholds:
        assert np.abs(places - r).min() < 2e-3
    assert_allclose(merged(Hysteresis([0.1, 0.5], [0.0, 0.0], 0, 1)), [])
    assert_allclose(merged(Hysteresis([0.1, 0.2, 0.5], [0.3, 0.1, 0.2], 0, 1)), [0.125, 0.5])


UNIT, NONE = Dynamics.unit(), Delay(0)


def split(h, noise=0.0):
    u = np.concatenate([np.zeros(50), triangle((0.4, 0.7, 1.0), 0, 3.0, 10_000)])
    x = h(u) + noise * np.random.default_rng(0).standard_normal(u.size)
    out = (np.arange(u.size) // 100) % 5 == 2
    return Excerpt(u, x, ~out), Excerpt(u, x, out)


def error_of(r, fit, held):
    h = fit_hysteresis(factorise([fit], r, UNIT, NONE), r).hysteresis
    e = (held.x - h(held.u))[held.use]
    return float(np.std(e))


def test_smooth_truth_gets_more_thresholds_and_less_error():
    r = (np.arange(40) + 0.37) / 40
    smooth = Hysteresis(r, np.exp(-r / 0.3) / np.exp(-r / 0.3).sum(), -0.28, 1.1)
    fit, held = split(smooth, 1e-6)
    chosen = choose_thresholds([fit], [held], 1.0, UNIT, NONE)
    assert chosen.size > 10
    assert np.all(np.diff(chosen) > 0)
    assert chosen[0] > 0
    assert error_of(chosen, fit, held) < 0.2 * error_of(even_thresholds(1.0, 10), fit, held)


def test_few_thresholds_off_the_grid_are_found_and_noise_alone_buys_none():
    fit, held = split(Hysteresis([0.137, 0.42, 0.71], [0.4, 0.3, 0.2], -0.3, 1.0), 1e-5)
    chosen = choose_thresholds([fit], [held], 1.0, UNIT, NONE)
    assert error_of(chosen, fit, held) < 3e-5
    for r in (0.137, 0.42, 0.71):
        assert np.abs(chosen - r).min() < 0.01
    fit, held = split(Hysteresis(even_thresholds(1.0, 10), np.full(9, 0.1), -0.3, 1.0), 0.01)
    assert choose_thresholds([fit], [held], 1.0, UNIT, NONE).size <= 9


@pytest.mark.filterwarnings('error')
def test_swing_limits_the_thresholds():
    fit, held = split(Hysteresis([0.2], [0.5], 0.0, 1.0), 1e-4)
    assert choose_thresholds([fit], [held], 0.6, UNIT, NONE).max() < 0.6

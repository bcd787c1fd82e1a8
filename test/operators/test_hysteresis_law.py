# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Wide laws of H: Preisach switches as truth, streaming, monotony, and what they refuse."""

from dataclasses import replace
from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import paper_stage
from piezo_ident.common.errors import ModelError
from piezo_ident.operators.hysteresis import Hysteresis, LINE
from piezo_ident.operators.hysteresis_law import HysteresisLaw, LAWS
from piezo_ident.operators.kernels import curve, curve_slope
import pytest

R = np.arange(1, 20) / 20


def path(seed=0, n=3000):
    rng = np.random.default_rng(seed)
    u = np.abs(np.cumsum(0.03 * rng.standard_normal(n))) % 2
    return np.minimum(u, 2 - u)


def law_and_h(name, seed=0, span=(0.0, 1.0)):
    law = HysteresisLaw(name, R * (span[1] - span[0]), span)
    rng = np.random.default_rng(seed)
    theta = rng.uniform(0, 1, law.size) * (rng.random(law.size) < 0.7)
    return law, theta, law.hysteresis(theta)


@pytest.mark.parametrize('span', [(0.0, 1.0), (-0.5, 2.5)])
@pytest.mark.parametrize('name', LAWS)
def test_h_is_the_sum_of_its_columns_and_streams(name, span):
    law, theta, h = law_and_h(name, span=span)
    u = span[0] + (span[1] - span[0]) * path()
    start = u[0] - R / 3
    w = h(u, start)
    assert_allclose(theta @ np.array(list(law.columns(u, start))), w, atol=1e-10)
    parts, memory = [], start
    for cut in np.split(u, [1, 2, 700, 2222]):
        part, memory = h.follow(cut, memory)
        parts.append(part)
    assert_array_equal(np.concatenate(parts), w)
    again = law.coefficients(h)
    assert_allclose(law.hysteresis(again)(u, start), w, atol=1e-9)


@pytest.mark.parametrize('name', LAWS)
def test_every_law_holds_the_plays(name):
    plain = Hysteresis(R, np.linspace(0, 0.1, 19), -0.2, 0.9)
    law = HysteresisLaw(name, R)
    u = path(1)
    assert_allclose(law.hysteresis(law.coefficients(plain))(u), plain(u), atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.sampled_from(['square', 'preisach', 'bias']))
def test_densities_never_fall_and_the_slope_is_what_is_promised(seed, name):
    law, theta, _ = law_and_h(name, seed)
    rng = np.random.default_rng(seed)
    theta[-3:] = [rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.0), 1.5]
    h = law.hysteresis(theta)
    u = path(seed)
    w = h(u)
    dw, du = np.diff(w), np.diff(u)
    # a chord, against the least slope of the branch
    assert np.all(dw[du > 1e-6] / du[du > 1e-6] >= h.lowest_slope() - 1e-6)
    assert np.all(dw[du < -1e-6] / du[du < -1e-6] >= h.lowest_slope() - 1e-6)


def test_lowest_slope_of_polynomial_lines_and_lags():
    h = Hysteresis([0.5], [2.0], -0.1, 1.0, p0=-0.2)
    # the derivative of -0.1 v^3 - 0.2 v^2 + v; the play stands after a turn
    assert_allclose(h.slope_at_turns(np.array([0.0, 0.5, 1.0])), [1.0, 0.725, 0.3])
    assert h.flattest == pytest.approx((0.3, 1.0))
    # z stands after a turn, and phi = 0.1 v + 0.2 v^2 + 0.1 v^3 leaves
    lagging = replace(h, relaxations=[[3.0, 0.1, 0.2, 0.1]])
    assert_allclose(lagging.slope_at_turns(np.array([0.0, 0.5])), [0.9, 0.725 - 0.375])
    # a line moves at once, with 2 (1 - 0.5) of its play
    assert_allclose(h.with_lines(1).slope_at_turns(np.array([0.0, 1.0])), [2.0, 1.3])


def test_a_lag_is_flattest_behind_a_long_sweep():
    h = Hysteresis([], [], 0.0, 1.0, relaxations=[[8.0, 0.9, 0.0, 0.0]])
    # after a turn z stands 0.9 / 8 behind phi: w follows 1 - 0.9, less the 8 times 0.9 / 8 of z
    assert h.lowest_slope() == pytest.approx(1.0 - 0.9 - 0.9, abs=0.05)
    assert_allclose(h.slopes(sweeps=False)[1], 1.0 - 0.9)


@pytest.mark.parametrize('name', ['plays', 'square', 'preisach', 'duhem'])
def test_slopes_of_a_law_add_up_to_those_of_h(name):
    law, theta, h = law_and_h(name)
    assert_allclose(law.slopes @ theta, h.slopes(sweeps=True)[1], atol=1e-9)


@pytest.mark.parametrize('count', [0, 1, 2, 3])
def test_lines_have_the_strokes_of_their_plays(count):
    curves, bias = [[0.3], [0.2], [0.1]], [0.1, 0.2, 0.3]
    h = Hysteresis([0.1, 0.2, 0.4], [0.3, 0.2, 0.5], 0.0, 1.0, curves=curves, bias=bias)
    lines = h.with_lines(count)
    assert np.all(lines.thresholds[:count] < LINE)
    assert_array_equal(lines.thresholds[count:], h.thresholds[count:])
    for one in (h, replace(h, curves=None), replace(h, bias=None), replace(h, span=(-0.5, 1.5))):
        sweep = np.linspace(*one.span, 50)
        at_low = np.full(3, one.span[0])
        strokes = [np.ptp(x(sweep, at_low)) for x in (one, one.with_lines(count))]
        assert strokes[1] == pytest.approx(strokes[0], rel=1e-9)


def test_the_slope_of_a_curve_is_that_of_its_values():
    c = np.array([[0.3], [-0.2], [0.1], [0.0], [0.8]])
    for t in (0.1, 0.5, 0.7):
        rise = (curve(c, 0, t + 1e-5) - curve(c, 0, t - 1e-5)) / 2e-5
        assert curve_slope(c, 0, t) == pytest.approx(rise, rel=1e-8)
    assert curve_slope(c, 0, -0.1) == curve_slope(c, 0, 0.9) == 0.0


def test_roughness_is_of_sizes_over_gaps_and_of_neighbours():
    law = HysteresisLaw('preisach', [0.1, 0.3])
    even = np.ones(law.size)
    rows = law.roughness(0.5, 4.0) @ even
    # q over density and gap, the other densities over their change, and no differences
    assert_allclose(rows[:2], [1 / 0.5 / 0.1, 1 / 0.5 / 0.2])
    assert_allclose(rows[2 : law.densities], 1 / 4.0)
    assert_array_equal(rows[law.densities :], 0.0)
    # a polynomial of degree three has three neighbours, each of five hats its own
    slope = law.roughness(0.5, 4.0) @ np.arange(law.size)
    assert_allclose(slope[law.densities :], np.full(15, 1 / 4.0))


@pytest.mark.parametrize('name', LAWS[1:])
def test_model_streams_in_one_loop_as_it_does_link_by_link(name):
    _, _, h = law_and_h(name)
    model = replace(paper_stage.PAPER, hysteresis=h)
    v = 10 * path(2)
    y = model.simulate(v)
    stream, chain = model.stream(), model.stream()
    chain._cascade = None
    parts = [stream.process(x) for x in np.split(v, [1, 500, 501])]
    assert_array_equal(np.concatenate(parts), y)
    assert_allclose(chain.process(v), y, atol=1e-12 * np.ptp(y))


def test_beyond_its_span_a_curve_is_flat():
    h = Hysteresis([0.5], [0.2], 0.0, 1.0, curves=[[0.4, 0.1]])
    one, two = h([0.0, 1.0, 1.5])[1:]
    assert two - one == pytest.approx(0.5 * 1.2)
    assert_allclose(h.rise([-0.1], 0.0), [0.2])
    assert_allclose(h.rise([0.25], 0.0), [0.2 + 0.8 * 0.25 + 0.3 * 0.25**2])


@pytest.mark.parametrize(
    ('more', 'says'),
    [
        ({'curves': [[0.1]]}, 'for 2 thresholds'),
        ({'curves': np.zeros((2, 4))}, r'curves of shape \(2, 4\)'),
        ({'curves': [0.1, 0.2]}, r'curves of shape \(2,\)'),
        ({'bias': [0.1]}, r'bias of shape \(1,\)'),
        ({'bias': [[0.1], [0.2]]}, r'bias of shape \(2, 1\)'),
        ({'bias': [0.1, np.nan]}, 'bias .*finite'),
        ({'curves': [[-0.6], [0.0]]}, 'negative'),
        ({'bias': [-0.6, 0.0]}, 'negative'),
        ({'p0': np.inf}, 'p0 = inf'),
        ({'curves': [[0.1], [0.1]], 'span': (1.0, 1.0)}, 'span'),
    ],
)
def test_what_is_no_wide_hysteresis_is_refused(more, says):
    with pytest.raises(ModelError, match=says):
        Hysteresis([0.1, 0.2], [0.5, 0.5], 0.0, 1.0, **more)


def test_law_refuses_other_names_and_foreign_h():
    with pytest.raises(ModelError, match=r"'relays'.* plays, square, bias, preisach, duhem"):
        HysteresisLaw('relays', R)
    _, _, h = law_and_h('preisach')
    with pytest.raises(ModelError, match="'bias'"):
        HysteresisLaw('bias', R).coefficients(h)
    with pytest.raises(ModelError, match=r'19 thresholds .* 18 '):
        HysteresisLaw('preisach', R[1:]).coefficients(h)


@pytest.mark.parametrize('wider', ['duhem', 'any'])
@pytest.mark.parametrize('name', [*LAWS, 'any'])
def test_columns_of_a_law_are_among_those_of_a_wider_one(name, wider):
    if wider == 'duhem' and name in ('bias', 'any'):
        return
    law, whole, u = HysteresisLaw(name, R[::3]), HysteresisLaw(wider, R[::3]), path()[:400]
    columns = np.array(list(whole.columns(u)))
    assert_array_equal(columns[law.within(whole)], np.array(list(law.columns(u))))


def test_idle_plays_are_left_out_without_a_change():
    for name in LAWS:
        law, theta, _ = law_and_h(name)
        theta[:10] = 0.0
        theta[19:-3] = 0.0
        h = law.hysteresis(theta)
        slim = h.without_idle()
        assert slim.thresholds.size < h.thresholds.size
        assert_allclose(slim(path()), h(path()), atol=1e-14)
    # a curve moves without a weight, too
    bent = Hysteresis([0.2, 0.4], [0.0, 0.0], 0.0, 1.0, curves=[[0.0], [0.3]])
    assert_array_equal(bent.without_idle().thresholds, [0.4])


def test_a_density_below_zero_by_rounding_is_no_fault():
    rounded = Hysteresis([0.5], [0.0], 0.0, 1.0, curves=[[-1e-11]])
    assert rounded.rise([0.5])[0] < 0.0
    with pytest.raises(ModelError, match='negative'):
        replace(rounded, curves=[[-1e-8]])


def test_lags_along_the_path_know_no_time_and_no_sampling():
    h = Hysteresis([], [], 0.0, 1.0, relaxations=[[3.0, 0.5, 0.3, -0.2], [9.0, 0.1, 0.0, 0.4]])
    turns = [0.0, 0.7, 0.2, 0.2, 1.0, 0.0]
    fine = np.concatenate([np.linspace(a, b, 801)[1:] for a, b in pairwise(turns)])
    assert_allclose(h(turns)[1:], h(np.append(0.0, fine))[800::800], atol=1e-12)


def bouc_wen(u, steps=2e-4):
    z, last, out = 0.0, u[0], np.empty(u.size)
    for k, x in enumerate(u):
        count = max(1, int(abs(x - last) / steps))
        for _ in range(count):
            d = (x - last) / count
            z += d * (0.45 - abs(z) ** 1.3 * (0.6 + 3.5 * np.sign(d * z)))
        last, out[k] = x, z
    return 0.7 * u + out


def test_lags_along_the_path_follow_a_bouc_wen_loop_that_plays_cannot():
    fitted, unseen = (
        np.concatenate([np.linspace(a, b, 60)[1:] for a, b in pairwise([0.0, *turns])])
        for turns in (
            np.clip(np.random.default_rng(5).uniform(-0.2, 1.2, 90), 0, 1),
            [1, 0, 0.7, 0.3, 0.7, 0.3, 0.9, 0.1, 0.9, 0.5, 0.6, 0.5, 0.6, 0],
        )
    )
    errors = {}
    for name in ('preisach', 'duhem'):
        law = HysteresisLaw(name, R)
        A, B = (np.array([*law.columns(u), np.ones(u.size)]).T for u in (fitted, unseen))
        # a stage that was swept, and came down
        before = [0.0, 1.0, 0.0, 1.0, 0.0]
        truth, w = (bouc_wen(np.append(before, u))[5:] for u in (fitted, unseen))
        theta = np.linalg.lstsq(A, truth, rcond=1e-7)[0]
        errors[name] = 100 * np.std(B @ theta - w) / np.ptp(w)
    assert errors['duhem'] < 0.3 < 1.0 < errors['preisach']

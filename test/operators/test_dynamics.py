# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""G and the delay: against SciPy, at rest, at any order, however the stream is cut."""

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import A, B
from piezo_ident.common.errors import ModelError
from piezo_ident.common.kernel import STILL
from piezo_ident.operators.chain import Block
from piezo_ident.operators.dynamics import (
    Delay,
    DelayOperator,
    Dynamics,
    DynamicsOperator,
    filter_arx,
)
from piezo_ident.operators.sections import rounding_of
import pytest
from scipy import signal

PAPER = Dynamics(A, B)


@st.composite
def stable(draw, na_max=6, nb_max=8):
    """Draw stable dynamics of any orders, numerator longer or shorter than the denominator."""
    poles = []
    while len(poles) < draw(st.integers(0, na_max)):
        radius = draw(st.floats(0.0, 0.97))
        if draw(st.booleans()):
            angle = draw(st.floats(0.05, 3.1))
            pole = radius * np.exp(1j * angle)
            poles += [pole, np.conj(pole)]
        else:
            poles.append(draw(st.sampled_from([-1.0, 1.0])) * radius)
    b = draw(st.lists(st.floats(-1, 1), min_size=1, max_size=nb_max))
    return Dynamics(np.real(np.poly(poles))[1:] if poles else [], b)


@settings(deadline=None)
@given(stable(), st.integers(0, 2**32 - 1))
def test_filter_is_that_of_scipy(G, seed):
    x = np.random.default_rng(seed).standard_normal(80)
    expected = signal.lfilter(G.b, np.concatenate([[1.0], G.a]), x)
    got = filter_arx(G.a, G.b, x, at_rest=False)
    assert_allclose(got, expected, atol=1e-9 * max(1.0, np.abs(expected).max()))


@settings(deadline=None)
@given(stable(), st.floats(-2, 2))
def test_equilibrium_stays_at_rest(G, level):
    rest = level * G.gain
    out = filter_arx(G.a, G.b, np.full(200, level))
    assert_allclose(out, rest, atol=1e-8 * max(1.0, abs(rest)))
    operator = DynamicsOperator(G)
    assert operator.reset(0.0, level) == pytest.approx(rest)
    x = operator.process(Block(np.zeros(50), np.zeros(50), np.full(50, level))).x
    assert_allclose(x, rest, atol=1e-8 * max(1.0, abs(rest)))


@settings(deadline=None)
@given(
    stable(),
    st.integers(0, 7),
    st.sampled_from([0.0, 0.25, 0.9]),
    st.lists(st.integers(0, 100), max_size=6),
)
def test_streams_are_the_batch(G, d, fraction, cuts):
    x = np.random.default_rng(d).standard_normal(100)
    delay = Delay(d, fraction)
    batch = delay.apply(filter_arx(G.a, G.b, x))
    g, z = DynamicsOperator(G), DelayOperator(delay)
    z.reset(0.0, g.reset(0.0, x[0]))
    parts = []
    for start, stop in pairwise([0, *sorted(cuts), 100]):
        part = x[start:stop]
        parts.append(z.process(g.process(Block(part, part, part))).x)
    # sections round otherwise than eq. (5)
    lost = 1e3 * rounding_of(G.a) * float(np.abs(batch).max())
    assert_allclose(np.concatenate(parts), batch, atol=1e-9 + lost)


def test_delay_shifts_whole_samples_and_parts_of_them():
    x = np.arange(1.0, 8.0) ** 2
    assert_array_equal(Delay(0).apply(x), x)
    assert_array_equal(Delay(2).apply(x), [1, 1, 1, 4, 9, 16, 25])
    assert_allclose(Delay(1, 0.25).apply(x), 0.75 * Delay(1).apply(x) + 0.25 * Delay(2).apply(x))
    # a straight line is delayed by the exact amount
    line = np.arange(10.0)
    assert_allclose(Delay(1, 0.4).apply(line)[3:], line[3:] - 1.4)
    assert Delay(3, 0.4).total == 3.4
    assert_array_equal(Delay(9).apply(x), np.ones(7))


@settings(deadline=None)
@given(stable())
def test_response_is_freqz(G):
    f = np.linspace(1, 9999, 40)
    _, expected = signal.freqz(G.b, np.concatenate([[1.0], G.a]), worN=f, fs=20_000)
    scale = max(1.0, np.abs(expected).max())
    assert_allclose(G.response(f, 20_000), expected, atol=1e-9 * scale)


def test_modes_of_a_known_resonance():
    f0, zeta, fs = 972.0, 0.021, 5000.0
    pole = np.exp(2 * np.pi * f0 / fs * (-zeta + 1j * np.sqrt(1 - zeta**2)))
    a = np.real(np.poly([pole, np.conj(pole), 0.4, -0.3]))[1:]
    (mode,) = Dynamics(a, [1.0]).modes(fs)
    assert mode.frequency == pytest.approx(f0, rel=1e-9)
    assert mode.damping == pytest.approx(zeta, rel=1e-9)
    assert np.isnan([mode.frequency_std, mode.damping_std]).all()
    assert Dynamics([0.1], [1.0]).modes(fs) == []


def test_uncertainty_of_the_modes_against_a_sample_of_models():
    fs, rng = 5000.0, np.random.default_rng(2)
    pole = 0.95 * np.exp(2j * np.pi * np.array([0.1, 0.25]))
    a = np.real(np.poly([*pole, *np.conj(pole), 0.4]))[1:]
    root = 1e-5 * rng.standard_normal((5, 5))
    covariance = np.pad(root @ root.T, (0, 1))
    modes = Dynamics(a, [1.0]).modes(fs, covariance)
    draws = [Dynamics(a + root @ rng.standard_normal(5), [1.0]).modes(fs) for _ in range(2000)]
    for name in ('frequency', 'damping'):
        drawn = np.std([[getattr(mode, name) for mode in draw] for draw in draws], axis=0)
        assert [getattr(mode, f'{name}_std') for mode in modes] == pytest.approx(drawn, rel=0.1)


def test_paper_stage():
    # sum b / (1 + sum a) of the printed coefficients; the largest pole has radius 0.944
    assert PAPER.gain == pytest.approx(0.6411, abs=5e-5)
    assert PAPER.radius == pytest.approx(0.944, abs=5e-4)
    assert PAPER.is_stable
    one = PAPER.normalised()
    assert one.gain == pytest.approx(1.0, abs=1e-13)
    assert_array_equal(one.a, PAPER.a)
    assert_allclose(one.response([10.0, 900.0], 2e4) * PAPER.gain, PAPER.response([10, 900], 2e4))


@pytest.mark.parametrize(
    ('a', 'stable'),
    [
        *((a, True) for a in ([], [-0.999])),
        *((a, False) for a in ([-1.0], [-2.0], [0.0, 1.0], [-2.0, 1.0], [0.5, -1.5])),
    ],
)
def test_a_pole_on_the_circle_or_beyond_is_not_stable(a, stable):
    assert Dynamics(a, [1.0]).is_stable == stable


@pytest.mark.parametrize('seed', range(40))
def test_stability_is_that_of_the_poles(seed):
    rng = np.random.default_rng(seed)
    for n in range(1, 16):
        angle, pairs = rng.uniform(0, np.pi, n // 2), rng.uniform(0.6, 1.01, n // 2)
        poles = np.concatenate([pairs * np.exp(1j * angle), pairs * np.exp(-1j * angle)])
        poles = np.concatenate([poles, rng.uniform(-1, 1, n % 2)])
        G = Dynamics(np.real(np.poly(poles))[1:], [1.0])
        assert G.is_stable == (G.radius < 1.0)
        assert G.is_within(0.9) == (G.radius < 0.9)
        assert_array_equal(G.a, np.real(np.poly(poles))[1:])


@pytest.mark.parametrize('cut', [1, 2, 3, 500, 20_001])
def test_what_has_died_away_is_zero_wherever_the_stream_is_cut(cut):
    x = np.zeros(40_000)
    x[:50] = np.random.default_rng(0).standard_normal(50)
    x[30_000] = 1.0
    whole = filter_arx(PAPER.a, PAPER.b, x, at_rest=False)
    size = np.abs(whole[whole != 0.0])
    assert size.min() >= STILL
    assert np.count_nonzero(whole[20_000:30_000]) == 0
    operator = DynamicsOperator(PAPER)
    parts = [Block(np.zeros(part.size), part, part) for part in np.split(x, [cut, 29_999])]
    assert_array_equal(np.concatenate([operator.process(part).x for part in parts]), whole)


def test_no_number_stays_no_number():
    y = filter_arx(PAPER.a, PAPER.b, np.array([1.0, np.nan, *np.zeros(20)]), at_rest=False)
    assert np.isnan(y[1:]).all()


@pytest.mark.parametrize(('a', 'b'), [([0.1], [0.0]), ([0.1], [1.0, -1.0]), ([-1.0], [1.0])])
def test_no_static_gain_cannot_be_normalised(a, b):
    with pytest.raises(ModelError, match=r'static gain (0\.0|inf)'):
        Dynamics(a, b).normalised()


@pytest.mark.parametrize(
    ('kind', 'numbers'),
    [
        *((Dynamics, x) for x in (([np.nan], [1]), ([0.1], [np.inf]), ([0.1], []))),
        *((Dynamics, x) for x in (([[0.1]], [1.0]), (0.1, [1.0]))),
        *((Delay, x) for x in ((-1, 0), (1.5, 0), (np.nan, 0), (np.inf, 0), (1, 1.0), (1, -0.1))),
    ],
)
def test_what_is_neither_filter_nor_delay_is_refused(kind, numbers):
    with pytest.raises(ModelError):
        kind(*numbers)

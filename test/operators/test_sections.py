# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""G of high order as sections: the same filter, without its rounding."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import A, B
from piezo_ident.operators.chain import Block
from piezo_ident.operators.dynamics import Dynamics, DynamicsOperator, filter_arx
from piezo_ident.operators.sections import LOST, rounding_of
import pytest
from scipy.signal import lfilter


def ringing(n, seed=0, zeros=()):
    """Return a G of n modes with a damping of 0.01 beside each other."""
    w = np.random.default_rng(seed).uniform(0.2, 0.8, n)
    poles = np.exp(w * (-0.01 + 1j))
    a = np.real(np.poly([*poles, *poles.conj()]))[1:]
    return Dynamics(a, np.atleast_1d(np.poly(zeros))).normalised()


def through(G, x, *cuts):
    operator = DynamicsOperator(G)
    rest = operator.reset(0.0, x[0])
    blocks = np.split(x, cuts)
    return rest, np.concatenate([operator.process(Block(z, z, z)).x for z in blocks])


def walk(n=5000):
    return np.cumsum(np.random.default_rng(3).standard_normal(n)) / 50.0


def test_the_rounding_that_is_told_is_what_is_lost():
    for n in (2, 4, 5):
        G, x = ringing(n), walk()
        exact = lfilter(*(np.longdouble(z) for z in (G.b, np.append(1.0, G.a), x)))
        lost = np.std(filter_arx(G.a, G.b, x, at_rest=False) - exact) / np.std(exact)
        assert 0.03 < lost / rounding_of(G.a) < 30.0
    assert rounding_of(np.array([-1.0])) == np.inf


def test_a_g_that_loses_nothing_is_left_as_it_is():
    assert Dynamics(A, B).sections is None and Dynamics.unit().sections is None
    # a delay is no section
    G = ringing(5)
    for nothing in (0.0, 2e-309):
        assert Dynamics(G.a, np.append(nothing, G.b)).sections is None
    # one zero is far out, and those beside it are lost
    assert Dynamics(G.a, np.array([2e-16, 1.0, 0.0, 0.0, 0.5])).sections is None
    # twelve zeros in one place are found elsewhere
    assert ringing(5, zeros=(0.9,) * 12).sections is None


@pytest.mark.parametrize('zeros', [(), (0.5, -2.0, 1.4)])
def test_sections_are_the_same_filter(zeros):
    G, x = ringing(5, zeros=zeros), walk()
    assert rounding_of(G.a) > LOST and G.sections is not None
    rest, y = through(G, x)
    assert_allclose(rest, x[0] * G.gain, rtol=1e-13)
    lost = 30.0 * rounding_of(G.a) * np.ptp(y)
    assert_allclose(y, filter_arx(G.a, G.b, x), rtol=0.0, atol=lost)
    # the last digit of what goes in stays the last digit
    other = through(G, x * (1.0 + 2e-16))[1]
    assert np.abs(other - y).max() < 1e-13 * np.ptp(y)


def test_rest_stays_rest_and_cuts_change_nothing():
    G, x = ringing(6), walk(900)
    rest, y = through(G, np.full(500, 0.7))
    assert_allclose(y, rest, rtol=1e-12)
    assert_array_equal(through(G, x, 1, 17, 400)[1], through(G, x)[1])
    # what dies away never comes to where a processor is slow
    y = np.abs(through(G, np.append(1.0, np.zeros(500_000)))[1])
    assert y[-1] < 1e-270 and not np.any((y > 0.0) & (y < 1e-300))

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""H: eqs. (3) and (6), and what it refuses."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from piezo_ident.common.errors import ModelError
from piezo_ident.operators.chain import Block
from piezo_ident.operators.hysteresis import Hysteresis, HysteresisOperator
import pytest

# Gu, Li, Zhu and Su (2016), Table of the identified parameters
R = np.arange(10) / 10
Q = [0.4777, 0.4473, 0.1113, 0.0671, 0.1411, 0.0104, 0.0001, 0.0354, 0.0961, 0.0084]
P1, P2 = -0.2774, 0.6232
PAPER = Hysteresis(R, Q, P1, P2)


def test_weight_at_zero_is_folded_into_the_linear_term_and_the_stroke_is_the_papers():
    assert PAPER.thresholds[0] == 0.1
    assert PAPER.thresholds.size == PAPER.weights.size == 9
    assert PAPER.p2 == pytest.approx(P2 + 0.4777)
    apart = Hysteresis(R[1:], Q[1:], P1, P2 + 0.4777)
    v = np.random.default_rng(1).uniform(0, 1, 300)
    assert_allclose(PAPER(v), apart(v), atol=1e-15)
    # p1 + p2 + sum q (1 - r) = 1.483 at v = 1: 71 um of 75 um behind G(1) = 0.641
    full = P1 + P2 + np.dot(Q, 1 - R)
    assert full == pytest.approx(1.483, abs=5e-4)
    assert PAPER(np.linspace(0, 1, 100))[-1] == pytest.approx(full)


@pytest.mark.parametrize(
    ('r', 'q', 'p1', 'p2', 'says'),
    [
        ([0.1, 0.2], [0.5], 0, 1, r'thresholds .*\(2,\), weights .*\(1,\)'),
        ([0.1], [-0.5], 0, 1, r': weights\[0\] '),
        ([-0.1], [0.5], 0, 1, r': thresholds\[0\] = -0\.1 '),
        ([0.2, 0.1], [0.5, 0.5], 0, 1, r': thresholds\[1\] = 0\.1 '),
        ([0.1, 0.1], [0.5, 0.5], 0, 1, r': thresholds\[1\] = 0\.1 '),
        ([0.1], [np.nan], 0, 1, r': weights\[0\] '),
        ([np.inf], [0.1], 0, 1, r': thresholds\[0\] '),
        ([0.1], [0.1], np.nan, 1, 'p1 = nan'),
        ([0.1], [0.1], 0, np.inf, 'p2 = inf'),
        ([[0.1]], [[0.1]], 0, 1, r'thresholds .*\(1, 1\), weights .*\(1, 1\)'),
        (0.1, 0.1, 0, 1, r'thresholds .*\(\), weights .*\(\)'),
    ],
)
def test_what_is_no_hysteresis_is_refused(r, q, p1, p2, says):
    with pytest.raises(ModelError, match=says):
        Hysteresis(r, q, p1, p2)


def test_parameters_cannot_be_changed_from_outside():
    r, q = np.array([0.1, 0.2]), np.array([0.5, 0.5])
    H = Hysteresis(r, q, 0, 1)
    r[0], q[0] = 9, 9
    assert_array_equal(H.thresholds, [0.1, 0.2])
    assert_array_equal(H.weights, [0.5, 0.5])
    with pytest.raises(ValueError, match='read-only'):
        H.weights[0] = 1


def through(operator, u, x0):
    operator.reset(x0, x0)
    return operator.process(Block(t=np.arange(u.size), v=u, x=u)).x


def test_operator_is_the_function_and_reset_forgets():
    u = np.random.default_rng(2).uniform(0, 1, 200)
    operator = HysteresisOperator(PAPER)
    assert_array_equal(through(operator, u, u[0]), PAPER(u))
    assert_array_equal(through(operator, u, u[0]), PAPER(u))


def test_operator_starts_from_the_memory_given_every_time():
    u = np.random.default_rng(3).uniform(0.3, 0.6, 50)
    memory = u[0] - PAPER.thresholds / 3
    operator = HysteresisOperator(PAPER, memory)
    memory_before = memory.copy()
    for _ in range(2):
        assert_array_equal(through(operator, u, u[0]), PAPER(u, memory_before))
    assert_array_equal(memory, memory_before)

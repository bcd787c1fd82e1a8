# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Filtered and averaged plays against each of the three by itself."""

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import A, B
from piezo_ident.identification.filtered_plays import filtered_plays, STRETCH
from piezo_ident.identification.step3_hysteresis import even_thresholds, Excerpt, factorise
from piezo_ident.operators.dynamics import Delay, Dynamics, filter_arx
from piezo_ident.operators.play import initial_memory, play_columns
import pytest

PAPER = Dynamics(A, B)


def voltage(n, seed=0):
    steps = np.random.default_rng(seed).standard_normal(n).cumsum()
    return (steps - steps.min()) / np.ptp(steps)


def one_by_one(v, r, memory, G, stretches, row):
    found = []
    for column in play_columns(v, r, memory):
        y = filter_arx(G.a, G.b, column)
        rows = [
            y[start : start + (stop - start) // row * row].reshape(-1, row).sum(axis=1)
            for start, stop in stretches
        ]
        found.append(np.concatenate(rows) / np.sqrt(row))
    return np.array(found)


@pytest.mark.parametrize('m', [1, 3, 4, 9])
@pytest.mark.parametrize('G', [PAPER, Dynamics([], [0.7]), Dynamics([-0.9], [0.1, 0.2, 0.3])])
def test_every_sample_is_that_of_play_and_filter(m, G):
    v = voltage(3 * STRETCH + 41)
    r, whole = np.linspace(0.01, 0.6, m), np.array([[0, v.size]])
    memory = initial_memory(0.4, r)
    got = filtered_plays(v, r, memory, G, whole, 1)
    assert_array_equal(got, one_by_one(v, r, memory, G, whole, 1))


@pytest.mark.parametrize('row', [1, 2, 7, 300])
def test_rows_are_means_that_do_not_reach_over_holes(row):
    v, r = voltage(2000, 1), np.array([0.0, 0.05, 0.3])
    stretches = np.array([[3, 4], [10, 509], [509, 515], [800, 2000]])
    memory = initial_memory(v[0], r)
    got = filtered_plays(v, r, memory, PAPER, stretches, row)
    assert_allclose(got, one_by_one(v, r, memory, PAPER, stretches, row), atol=1e-13)


def test_nothing_that_counts_is_no_row():
    r = np.array([0.1])
    assert filtered_plays(voltage(50), r, r, PAPER, np.empty((0, 2), int), 1).shape == (1, 0)


def test_what_dies_away_is_what_the_filter_makes_of_it():
    v = np.zeros(30_000)
    v[:300] = voltage(300)
    r, whole = np.array([0.1, 0.2, 0.9]), np.array([[0, v.size]])
    memory = initial_memory(v[0], r)
    got = filtered_plays(v, r, memory, PAPER, whole, 1)
    assert_array_equal(got, one_by_one(v, r, memory, PAPER, whole, 1))
    assert not got[:, -5000:].any()


def test_part_of_a_sample_of_delay_comes_behind_the_plays():
    u, r, delay = voltage(600, 2), even_thresholds(1.0, 5), Delay(3, 0.3)
    excerpt = Excerpt(u, voltage(600, 3), np.ones(600, dtype=bool))
    R = factorise([excerpt], r, PAPER, delay)
    columns = [*play_columns(u, r, excerpt.start(r)), u**3, u]
    seen = [filter_arx(PAPER.a, PAPER.b, delay.apply(column)) for column in columns]
    A = np.column_stack([np.ones(600), *seen, excerpt.x])
    assert_allclose(R.T @ R, A.T @ A, rtol=1e-10)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The unknown memory at the start of a record."""

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from paper_stage import FS, PAPER
from piezo_ident.model import initial_memory as memory_module
from piezo_ident.model.free_run import free_run
from piezo_ident.model.initial_memory import (
    fit_memory,
    forgetting,
    forgotten,
    is_at_rest,
    start_memory,
)
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.play import play_columns
from piezo_ident.record.record import Piece, Record
import pytest

V = 5 + 5 * np.sin(2 * np.pi * 10 * np.arange(4000) / FS)


def admissible(u0, r, rng):
    """Return a random memory that some past could have left: falling, and no steeper than -1."""
    steps = np.diff(np.concatenate([[0.0], r]))
    return u0 - np.cumsum(steps * rng.uniform(0, 1, r.size))


def started_from(memory, model=PAPER, noise=0.0, seed=0):
    y = model.stream(memory).process(V)
    span = abs(model.scaling.Y)
    return Piece(V, y + noise * span * np.random.default_rng(seed).standard_normal(V.size), FS)


@pytest.mark.parametrize('seed', range(6))
@pytest.mark.parametrize('sign', [1.0, -1.0])
def test_random_admissible_memory_is_recovered(seed, sign):
    model = replace(PAPER, scaling=replace(PAPER.scaling, Y=sign * 75e-6, y0=3e-6))
    truth = admissible(0.5, model.hysteresis.thresholds, np.random.default_rng(seed))
    piece = started_from(truth, model, noise=2e-5, seed=seed)
    found = fit_memory(model, piece)
    # what matters is the prediction: 0.006 to 0.022 % of the span are left of 0.3 to 1 %
    error = (model.stream(found).process(V) - model.stream(truth).process(V)) / 75e-6
    virgin = (model.stream().process(V) - model.stream(truth).process(V)) / 75e-6
    assert np.std(error) < 3e-4
    assert np.std(error) < 0.06 * np.std(virgin)


def test_memory_of_a_wide_hysteresis_is_recovered():
    r = PAPER.hysteresis.thresholds
    h = replace(PAPER.hysteresis, curves=np.full((r.size, 2), 0.2), p0=0.1)
    model = replace(PAPER, hysteresis=h)
    truth = admissible(0.5, r, np.random.default_rng(0))
    found = fit_memory(model, started_from(truth, model, noise=2e-5))
    error = (model.stream(found).process(V) - model.stream(truth).process(V)) / 75e-6
    assert np.std(error) < 3e-4


def test_memory_is_one_that_can_be():
    piece = started_from(None, noise=0.05)
    found = fit_memory(PAPER, piece)
    u0, r = 0.5, PAPER.hysteresis.thresholds
    assert np.all(found <= u0 + 1e-12)
    assert np.all(found >= u0 - r - 1e-12)


def test_without_plays_there_is_no_memory():
    for h in (Hysteresis([], [], 0, 1), Hysteresis([0.2], [0.0], 0, 1)):
        model = replace(PAPER, hysteresis=h)
        assert fit_memory(model, started_from(None, model)).shape == h.thresholds.shape


def test_a_few_samples_and_no_movement_will_do():
    for piece in (Piece(V[:5], V[:5] * 7.5e-6, FS), Piece(np.full(50, 5.0), np.zeros(50), FS)):
        found = fit_memory(PAPER, piece)
        assert np.all(np.isfinite(found))
        assert found.shape == (9,)


def test_forgotten_is_the_first_sweep_over_the_range():
    assert forgotten(np.array([5.0, 6, 10, 0, 7, 10])) == 3
    assert forgotten(np.array([0.0, 10, 0, 10])) == 1
    assert forgotten(np.full(9, 3.0)) == 0
    assert forgotten(np.arange(101.0)) == 98
    assert forgotten(np.arange(101.0), share=0.5) == 50
    assert forgotten(np.array([2.0])) == 0


@pytest.mark.parametrize('window', [1, 7, 1000])
def test_windows_do_not_move_where_the_start_is_forgotten(monkeypatch, window):
    monkeypatch.setattr(memory_module, 'WINDOW', window)
    u = np.cumsum(np.random.default_rng(3).standard_normal(500))
    swept = np.maximum.accumulate(u) - np.minimum.accumulate(u)
    assert forgotten(u, 0.9) == np.argmax(swept >= 0.9 * np.ptp(u))


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_after_it_the_start_no_longer_matters(seed):
    rng = np.random.default_rng(seed)
    u = np.cumsum(rng.standard_normal(300))
    u = (u - u.min()) / np.ptp(u)
    k = forgotten(u, share=1.0)
    r = np.linspace(0.05, 0.999, 8)
    one = play_columns(u, r, admissible(u[0], r, rng))
    two = play_columns(u, r, admissible(u[0], r, rng))
    assert_allclose(one[:, k:], two[:, k:], atol=1e-12)


def test_rest_is_at_the_lowest_voltage():
    zero = np.zeros(5)
    assert is_at_rest(PAPER, Piece(zero, zero, FS))
    assert is_at_rest(PAPER, Piece(zero + 0.05, zero, FS))
    assert not is_at_rest(PAPER, Piece(zero + 5, zero, FS))
    assert not is_at_rest(PAPER, Piece(zero - 5, zero, FS))


def test_only_an_unknown_start_is_estimated():
    zero = np.zeros(50)
    assert start_memory(PAPER, Piece(zero, zero, FS)) is None
    piece = started_from(None)
    assert_array_equal(start_memory(PAPER, piece), fit_memory(PAPER, piece))


def test_a_gap_does_not_make_an_unknown_start_known():
    piece = started_from(None)
    # a sample is lost long before the range is swept
    record = Record((piece.cut(0, 500), piece.cut(501, piece.n)))
    found = free_run(PAPER, record)
    assert found.estimated == (True, False)
    assert found.errors_after_start.n == piece.n - forgotten(V)
    still = Record((replace(piece, v=np.full(piece.n, 5.0)),))
    assert free_run(PAPER, still).errors_after_start is None


def with_lags(gap=0.2):
    """Return the paper's stage with three lags along the path behind its plays."""
    lags = [[2.0, gap, 0.1, 0.0], [4.0, -0.1, 0.3, -0.2], [8.0, 0.1, 0.0, 0.1]]
    return replace(PAPER, hysteresis=replace(PAPER.hysteresis, relaxations=lags))


@pytest.mark.parametrize('v0', [2.0, 5.0, 8.0])
def test_lags_of_a_record_that_starts_in_its_middle_are_found(v0):
    model = with_lags()
    k = np.arange(9000)
    before = np.interp(k, [0, 2000, 4000, 6000, 7000, 9000], [0, 9, 1, 10, v0, v0])
    after = v0 + np.minimum(k / 4000, 1) * min(v0, 10 - v0) * np.sin(2 * np.pi * 4 * k / FS)
    v = np.concatenate([before, after, np.interp(k, [0, 3000, 6000, 9000], [v0, 10, 0, 10])])
    noise = 75e-6 * 2e-5 * np.random.default_rng(1).standard_normal(v.size)
    piece = Piece(v, model.simulate(v) + noise, FS).cut(k.size, v.size)
    found = fit_memory(model, piece)
    assert found.size == 9 + 3
    error = np.std(piece.y - model.predict_piece(piece, found)) / 75e-6
    # 2 to 5 % with the memory of a stage at rest
    assert error < 1e-4
    run = free_run(model, Record((piece,)))
    # all three forget within 1.5 spans
    path = np.cumsum(np.abs(np.diff(piece.v, prepend=piece.v[0])))
    start = np.argmax(path >= forgetting(model))
    assert forgetting(model) == pytest.approx(10 * np.log(20) / 2)
    assert run.errors_after_start.n <= piece.n - start


def test_lags_that_are_long_forgotten_keep_their_default():
    model = with_lags()
    piece = Piece(V, model.simulate(V), FS)
    rest = model.hysteresis.settled(0.5)[:-1]
    assert_allclose(fit_memory(model, piece)[9:], rest, atol=1e-9)

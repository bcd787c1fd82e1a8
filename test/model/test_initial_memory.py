# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The unknown memory at the start of a record."""

from dataclasses import replace
import re

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
from paper_stage import FS, PAPER
from piezo_ident.common.errors import ModelError
from piezo_ident.model import initial_memory as memory_module
from piezo_ident.model.free_run import free_run
from piezo_ident.model.initial_memory import (
    begins_at_rest,
    fit_start,
    forgetting,
    forgotten,
    is_at_rest,
)
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.model.stream import Start
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.play import play_columns
from piezo_ident.record.record import Piece, Record
from programs import SLOW, slow_model
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
    found = fit_start(model, piece).memory
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
    found = fit_start(model, started_from(truth, model, noise=2e-5)).memory
    error = (model.stream(found).process(V) - model.stream(truth).process(V)) / 75e-6
    assert np.std(error) < 3e-4


def test_memory_is_one_that_can_be():
    piece = started_from(None, noise=0.05)
    found = fit_start(PAPER, piece).memory
    u0, r = 0.5, PAPER.hysteresis.thresholds
    assert np.all(found <= u0 + 1e-12)
    assert np.all(found >= u0 - r - 1e-12)


def test_no_plays_a_few_samples_and_no_movement_will_do():
    for h in (Hysteresis([], [], 0, 1), Hysteresis([0.2], [0.0], 0, 1)):
        model = replace(PAPER, hysteresis=h)
        assert fit_start(model, started_from(None, model)).memory.shape == h.thresholds.shape
    for piece in (Piece(V[:5], V[:5] * 7.5e-6, FS), Piece(np.full(50, 5.0), np.zeros(50), FS)):
        found = fit_start(PAPER, piece).memory
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


def test_rest_is_at_the_lowest_voltage_and_only_an_unknown_start_is_estimated():
    zero = np.zeros(5)
    assert is_at_rest(PAPER, Piece(zero, zero, FS))
    assert is_at_rest(PAPER, Piece(zero + 0.05, zero, FS))
    assert not is_at_rest(PAPER, Piece(zero + 5, zero, FS))
    assert not is_at_rest(PAPER, Piece(zero - 5, zero, FS))
    zero = np.zeros(50)
    assert fit_start(PAPER, Piece(zero, zero, FS)) is None
    assert fit_start(PAPER, started_from(None)).memory.shape == PAPER.hysteresis.thresholds.shape


def test_a_gap_does_not_make_an_unknown_start_known():
    piece = started_from(None)
    # a sample is lost long before the range is swept
    record = Record((piece.cut(0, 500), piece.cut(501, piece.n)))
    found = free_run(PAPER, record)
    assert found.estimated == (True, False)
    # four fifths of the range of the model are enough
    assert found.errors_after_start.n == piece.n - forgotten(V, enough=8.0)
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
    found = fit_start(model, piece).memory
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
    assert_allclose(fit_start(model, piece).memory[9:], rest, atol=1e-9)


#: shares and time constants [s] of a creep of 1.2 % a decade
GAIN, TIME = np.full(4, 0.012), np.array([0.1, 1.0, 10.0, 100.0])
CREEPING = replace(PAPER, effects=(EffectSetting('creep', {'gain': GAIN, 'time_constant': TIME}),))


def after_motion(v0, zero=0.0, noise=2e-4):
    """Return five seconds of triangles that begin at a voltage after other motion."""
    k = np.arange(int(2.5 * FS))
    before = np.interp(k / FS, [0, 0.2, 1.6, 1.8, 2.0, 2.5], [0, 10, 10, 2, v0, v0])
    t = np.arange(5 * int(FS)) / FS
    after = np.interp(t, [0, 0.5, 1, 2, 3, 4, 4.5, 5], [v0, v0, 10, 0, 6, 2, 9, 0])
    v = np.concatenate([before, after])
    y = CREEPING.simulate(v)
    span = np.ptp(y)
    y = y + span * (zero + noise * np.random.default_rng(1).standard_normal(v.size))
    return Piece(v, y, FS).cut(k.size, v.size)


@pytest.mark.parametrize('v0', [0.0, 4.0, 7.0])
def test_creep_of_earlier_motion_is_estimated(v0):
    run = free_run(CREEPING, Record((after_motion(v0),)))
    still = free_run(replace(CREEPING, effects=()), Record((after_motion(v0),)))
    assert run.estimated == (True,)
    # noise of 0.02 %; without the estimate 0.4 to 1 %, and 0.06 to 0.1 % without the mean
    assert run.errors_after_start.percent < 0.04
    assert run.errors_after_start.percent_without_offset < 0.025
    assert any(re.search('creep .* %', text) for text in run.warnings)
    # a model without creep has none that could go on
    assert not any('creep' in text for text in still.warnings)


def test_a_zero_that_moved_is_not_taken_for_creep():
    run = free_run(CREEPING, Record((after_motion(4.0, zero=0.1),)))
    assert run.errors_after_start.percent > 9.0
    assert run.errors_after_start.percent_without_offset < 0.04


def test_a_stage_that_rested_does_not_creep():
    v = after_motion(0.0).v
    rng = np.random.default_rng(2)
    y = CREEPING.simulate(v)
    y = y + 2e-4 * np.ptp(y) * rng.standard_normal(v.size)
    run = free_run(CREEPING, Record((Piece(v, y, FS),)))
    assert run.estimated == (False,)
    assert run.errors.n == v.size
    assert not run.warnings


def test_a_run_goes_on_where_another_ended():
    rng = np.random.default_rng(3)
    v = 5 + 5 * np.sin(np.cumsum(0.02 * rng.standard_normal(20000)))
    whole = CREEPING.simulate(v)
    stream = CREEPING.stream()
    stream.process(v[:12000])
    H, creep, *_ = stream._chain.operators
    u = CREEPING.scaling.u(v[12000:12001])
    rest = float(CREEPING.hysteresis(u, H.memory)[0])
    left = Start(H.memory, creep._state - rest)
    again = CREEPING.simulate(v[12000:], start=left)
    # G starts at rest; 100 samples later it has forgotten that
    assert_allclose(again[400:], whole[12400:], atol=1e-5 * 75e-6)


def test_a_start_of_another_model_is_refused():
    with pytest.raises(ModelError, match='start of 3 elements for 4'):
        CREEPING.simulate(V, start=Start(None, np.ones(3)))


@pytest.mark.parametrize('hole', [50, 400, 5000, 40_000])
def test_a_short_gap_does_not_cost_the_creep_of_earlier_motion(hole):
    piece = after_motion(4.0)
    record = Record((piece.cut(0, hole), piece.cut(hole + 20, piece.n)))
    run = free_run(CREEPING, record)
    assert run.estimated == (True, False)
    assert run.errors_after_start.percent < 0.04


def test_a_record_may_begin_on_the_way_down():
    t = np.arange(8 * int(FS)) / FS
    v = np.interp(t, [0, 0.5, 2.0, 2.2, 3.0, 4.0, 5.0, 6.0, 8.0], [0, 10, 10, 5, 4, 0, 9, 3, 0])
    y = CREEPING.simulate(v)
    y = y + 2e-4 * np.ptp(y) * np.random.default_rng(4).standard_normal(v.size)
    piece = Piece(v, y, FS).cut(int(2.2 * FS), v.size)
    assert free_run(CREEPING, Record((piece,))).errors_after_start.percent < 0.05


@pytest.mark.parametrize('seed', range(3))
def test_what_a_model_lacks_is_no_creep_of_earlier_motion(seed):
    rng = np.random.default_rng(seed)
    h = CREEPING.hysteresis
    other = replace(h, weights=h.weights * (1 + 0.15 * rng.standard_normal(h.weights.size)))
    stage = replace(CREEPING, hysteresis=other)
    v = after_motion(0.0).v
    y = stage.simulate(v)
    run = free_run(CREEPING, Record((Piece(v, y, FS),)))
    still = 100 * np.sqrt(np.mean((y - CREEPING.simulate(v)) ** 2)) / np.ptp(y)
    assert run.errors.percent < 1.05 * still


def test_a_first_rise_shows_also_where_the_voltage_never_rests():
    rng, model = np.random.default_rng(3), slow_model()
    knots = np.concatenate([[0.0], rng.uniform(0.0, 10.0, 40)])
    v = np.interp(np.arange(8000) / 200.0, np.arange(41.0), knots)
    noise = 2e-8 * rng.standard_normal(v.size)
    fresh = Piece(v, model.stream(-model.hysteresis.thresholds).process(v) + noise, SLOW)
    rested = Piece(v, model.simulate(v) + noise, SLOW)
    assert begins_at_rest(model, rested) and not begins_at_rest(model, fresh)
    # nor is a model that errs throughout a first rise, or a sensor with another zero
    assert begins_at_rest(model, replace(rested, y=1.02 * rested.y + 1e-6))
    run = free_run(model, Record((fresh,)))
    assert run.errors.percent < 0.05 and run.late[0] > 0

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

import axes_stage as stage
import numpy as np
from piezo_ident.common.errors import ModelError
from piezo_ident.fitting.modes.loop_fit import FreeNumbers, loop_fit, output_sensitivities
from piezo_ident.model.modes.kernels import KINDS
from piezo_ident.model.modes.shared_modes import SharedModes
import pytest


def test_sensitivities_agree_with_finite_differences():
    model = replace(stage.loop_stage(), creep=np.full((2, 1), 0.1), taus=np.array([80.0]))
    u = stage.multisine(np.random.default_rng(1), 1.2)[:400]
    parameters = FreeNumbers.of(model)
    inner = output_sensitivities(model, parameters, model.run(u))
    outer = 2 * (model.linear.order + 2 + model.signals)
    step = 1e-6
    for kind in KINDS:
        for k in np.flatnonzero(parameters.kinds == KINDS.index(kind))[::3]:
            move = np.zeros(len(parameters) + outer)
            move[k] = step
            ahead, back = (parameters.moved(model, s * move) for s in (1, -1))
            slope = (ahead.run(u).y - back.run(u).y) / (2 * step)
            assert inner[:, :, k] == pytest.approx(slope, abs=2e-4 * np.abs(slope).max()), kind


def test_sensitivities_of_real_poles():
    linear = stage.linear_stage()
    blocks = linear.blocks.copy()
    blocks[0] = [[0.9, 0.0], [0.0, 0.3]]
    model = SharedModes.of(replace(linear, blocks=blocks))
    u = stage.multisine(np.random.default_rng(1), 1.0)[:200]
    parameters = FreeNumbers.of(model, hold=('b', 'e', 'f', 'g', 'mu'))
    inner = output_sensitivities(model, parameters, model.run(u))
    for k in range(4):
        move = np.zeros(4 + 2 * 6)
        move[k] = 1e-6
        ahead, back = (parameters.moved(model, s * move) for s in (1, -1))
        slope = (ahead.run(u).y - back.run(u).y) / 2e-6
        assert inner[:, :, k] == pytest.approx(slope, abs=2e-4 * np.abs(slope).max())


def test_modes_fall_and_loops_open_with_the_amplitude():
    model = stage.loop_stage()
    low, high = (stage.modes(model.a_at(s))[0] for s in (0.5, 1.5))
    assert (low > high).all()
    assert (model.a_at(9.0) == model.a_at(model.range[1])).all()
    rng = np.random.default_rng(3)
    plain = SharedModes.of(stage.linear_stage())
    assert stage.percent(plain, [stage.record(model, rng, 1.0)]) > 3


def test_a_model_without_signals_is_its_linear_part():
    rng = np.random.default_rng(4)
    record = stage.record(stage.linear_stage(), rng, 1.0)
    assert stage.percent(SharedModes.of(stage.linear_stage()), [record]) < 1e-6


def test_the_fit_recovers_a_stage_to_the_noise():
    rng = np.random.default_rng(5)
    truth = stage.loop_stage()
    taught = stage.records(truth, rng, count=2, noise=0.002)
    held_out = stage.records(truth, rng, count=1)
    start = replace(
        truth,
        linear=replace(truth.linear, b=1.02 * truth.linear.b),
        e=0.5 * truth.e,
        h=0 * truth.h,
        mu=truth.mu * [[0.5, 1.5]],
    )
    before = stage.percent(start, held_out)
    fitted = loop_fit(start, taught, iterations=15)
    assert before > 3
    # of a noise of 0.2 % in each of 6 records little is left in 100 parameters
    assert stage.percent(fitted, held_out) < 0.1
    assert fitted.radius < 1


def test_what_is_held_stays():
    rng = np.random.default_rng(6)
    truth = stage.loop_stage()
    start = replace(truth, e=0.8 * truth.e)
    taught = stage.records(truth, rng, (1.0,), count=1)
    fitted = loop_fit(start, taught, hold=('mu',), still=(2, 3))
    assert (fitted.mu == start.mu).all()
    assert (fitted.f[2:] == start.f[2:]).all() and (fitted.g[2:] == start.g[2:]).all()
    assert (fitted.f[:2] != start.f[:2]).any()


def test_a_model_that_runs_away_says_so_and_a_fit_leaves_it_as_it_is():
    truth = stage.loop_stage()
    taught = [stage.record(truth, np.random.default_rng(5), 1.0)]
    wild = replace(truth, e=-60 * truth.e)
    found = loop_fit(wild, taught, iterations=2)
    assert (found.e == wild.e).all()
    other = stage.multisine(np.random.default_rng(7), 1.5)
    with pytest.raises(ModelError, match=r'at sample \d+ of \d+'):
        wild.steady(other)

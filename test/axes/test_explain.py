# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

import axes_stage as stage
import numpy as np
from piezo_ident.axes.explain import explain, scores
from piezo_ident.axes.loop_model import LoopModel
from piezo_ident.axes.signals import with_loop_plays, with_softening
from piezo_ident.common.errors import DataError, ModelError
import pytest


def explained(truth, *, seed=1):
    rng = np.random.default_rng(seed)
    taught = stage.records(truth, rng, count=3, noise=0.002)
    held_out = stage.records(truth, rng, count=1, noise=0.002)
    return explain(stage.linear_stage(), taught, held_out, iterations=6, warm_up=512, memory=100.0)


def test_hysteresis_inside_the_loop_is_named():
    found = explained(stage.loop_stage())
    assert found.name == 'hysteretic_stiffness'
    best, rival = found['hysteretic_stiffness'], found['changed_dynamics']
    # noise is 0.2 %
    assert best.error < 0.5 and rival.error > 2 * best.error
    assert found['input_hysteresis'].error > 4 * best.error
    assert found.model.radius < 1
    assert list(best.scores) == ['0.5', '1', '1.5']


def test_hysteresis_of_the_inputs_is_named():
    truth = stage.loop_stage(softening=0.0, plays=0.1)
    truth = replace(truth, f=0 * truth.f, g=np.vstack([np.eye(2)] * 2))  # of voltages
    found = explained(truth)
    assert found.name == 'input_hysteresis'
    assert found['input_hysteresis'].error < 0.5


def test_a_linear_stage_stays_linear():
    found = explained(LoopModel.of(stage.linear_stage()))
    assert found.name == 'linear'
    assert found['linear'].error == pytest.approx(0.2, rel=0.2)


def test_a_linear_stage_stays_linear_in_few_steps():
    # as much is done for the linear model as for those that may only go on from it
    rng = np.random.default_rng(6)
    truth = stage.linear_stage()
    start = replace(truth, blocks=0.997 * truth.blocks, b=1.05 * truth.b)
    parts = [stage.records(truth, rng, count=many, noise=0.002) for many in (3, 1)]
    found = explain(start, *parts, iterations=2, warm_up=512, memory=100.0)
    assert found.name == 'linear'
    assert found['linear'].error == pytest.approx(0.2, rel=0.2)


def test_both_ways_of_counting():
    rng = np.random.default_rng(2)
    truth = LoopModel.of(stage.linear_stage())
    record = stage.record(truth, rng, 1.0)
    y = record.y.copy()
    y[-1, :, 0] += 0.1 * np.linalg.norm(y[-1]) / np.linalg.norm(y[-1, :, 0]) * y[-1, :, 0]
    found = scores({'1': truth}, [replace(record, y=y)])['1']
    first, both = (np.linalg.norm(part) for part in (y[-1, :, 0], y[-1]))
    error = 0.1 * np.linalg.norm(record.y[-1])
    assert found.pooled == pytest.approx(100 * error / both)
    assert found.mean == pytest.approx(50 * error / first)


def test_a_group_that_was_not_taught_is_refused():
    rng = np.random.default_rng(3)
    truth = stage.linear_stage()
    with pytest.raises(DataError, match='none was taught'):
        explain(truth, [stage.record(truth, rng, 1.0)], [stage.record(truth, rng, 2.0)])


def test_softening_comes_first():
    rng = np.random.default_rng(5)
    records = [stage.record(stage.linear_stage(), rng, 1.0)]
    plain = LoopModel.of(stage.linear_stage())
    played = with_loop_plays(with_softening(plain, records), records)
    assert played.levels == 2 and played.signals == 4
    assert played.run(np.vstack([records[0].mean_u] * 2)).z[stage.SAMPLES :].std(
        axis=0
    ) == pytest.approx(1, rel=0.05)
    with pytest.raises(ModelError, match='before the plays'):
        with_softening(played, records)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

from dataclasses import replace

import axes_stage as stage
import numpy as np
from piezo_ident.axes.explain import explain, scores
from piezo_ident.axes.loop_model import LoopModel
from piezo_ident.axes.periodic import PeriodicRecord
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
    assert found.modes_move
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


def yielded(u, size=2.5, part=0.5):
    """Return voltages less what they yield, by the law of Bouc and Wen."""
    z, last, out = np.zeros(2), u[0], np.empty_like(u)
    for k, now in enumerate(np.vstack([u, u])):
        side, step = np.sign(now - last), np.abs(now - last)
        # back to zero without yielding, and what is left of the way beyond
        back = np.minimum(step, np.maximum(0, -side * z))
        z, step, last = z + side * back, step - back, now
        z = side * size - (side * size - z) * np.exp(-step / size)
        out[k % len(u)] = now - part * z
    return out


def test_hysteresis_before_the_mechanics_is_none_inside_whatever_fits_better():
    # no play: what has more signals comes nearer, but the modes stay where they are
    rng = np.random.default_rng(8)
    truth = stage.linear_stage()

    def record(amplitude):
        u = stage.multisine(rng, amplitude)
        y = np.array([stage.answer(truth, yielded(u))] * 2)
        y += 0.002 * y.std() * rng.standard_normal(y.shape)
        return PeriodicRecord('record', f'{amplitude:g}', stage.RATE, np.array([u] * 2), y)

    taught, held_out = ([record(x) for x in (0.2, 0.8, 2.0) for _ in range(n)] for n in (3, 1))
    found = explain(truth, taught, held_out, iterations=6, warm_up=512, memory=100.0)
    assert found.name == 'input_hysteresis' and not found.modes_move
    assert found['input_hysteresis'].error < 0.4 * found['linear'].error
    assert found['hysteretic_stiffness'].error < 0.95 * found['input_hysteresis'].error
    one = [[r for r in part if r.group == '2'] for part in (taught, held_out)]
    assert explain(truth, *one, iterations=1, warm_up=512).modes_move is None


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

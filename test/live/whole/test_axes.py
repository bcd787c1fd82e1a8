# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage of two axes, live: joined, predicted, driven and learnt, by chains and shared modes."""

from dataclasses import replace

from axes_scanner import AXES, RATE, scanner, sweeps
from live_axes import blocks, chains, KINDS, predicted, repeated, simulated, tracked
import numpy as np
import piezo_ident as pi
from piezo_ident.live.join import Join
from piezo_ident.live.live_learning import LiveLearning
from piezo_ident.live.predictor import Predictor
from piezo_ident.record.blocks import Samples
import pytest


@pytest.fixture(params=KINDS)
def kind(request):
    return KINDS[request.param]()


def voltages(n=3000, seed=0):
    """Return voltages of both axes, a row each, from 0 V."""
    rng = np.random.default_rng(seed)
    return np.stack([sweeps(n, rng), sweeps(n, rng)])


def test_the_live_prediction_of_all_axes_is_the_offline_one():
    predictor, v = Predictor(AXES), voltages()
    predictor.set_model(scanner())
    made = predicted(predictor, v, RATE)
    np.testing.assert_allclose(made, simulated(scanner(), v), rtol=0.0, atol=1e-12 * 50e-6)
    assert predictor.memory_known


def test_a_model_that_comes_late_has_the_state_of_one_that_came_first(monkeypatch):
    # most of the voltage is kept as turning points alone
    monkeypatch.setattr('piezo_ident.live.history.RECENT', 1.0)
    v, predictor = voltages(4000), Predictor(AXES)
    for block in blocks(v[:, :3000], RATE):
        assert predictor.process(block) is None
    predictor.set_model(scanner())
    late = predicted(predictor, v[:, 3000:], RATE, start=3000)
    expected = simulated(scanner(), v)[:, 3000:]
    np.testing.assert_allclose(late, expected, rtol=0.0, atol=1e-9 * 50e-6)


def test_a_gap_is_bridged_on_every_axis():
    v, predictor = voltages(), Predictor(AXES)
    predictor.set_model(scanner())
    v[:, 1001:1050] = v[:, [1000]] + np.arange(1, 50) / 50 * (v[:, [1050]] - v[:, [1000]])
    made = [predicted(predictor, v[:, a:b], RATE, a) for a, b in ((0, 1001), (1050, 3000))]
    assert predictor.clock.lost == 49
    whole = np.delete(simulated(scanner(), v), np.s_[1001:1050], axis=1)
    np.testing.assert_allclose(np.hstack(made), whole, rtol=0.0, atol=1e-9 * 50e-6)


@pytest.mark.parametrize('axes', [('y',), ('y', 'y_c'), ('y', 'y_b', 'y_c')])
def test_a_model_of_other_axes_is_refused(kind, axes):
    with pytest.raises(pi.ModelError, match="'axes'") as refusal:
        Predictor(axes).set_model(kind.model)
    assert axes[-1] in str(refusal.value) and 'y_b' in str(refusal.value)


def test_voltages_are_joined_on_their_time():
    join, v = Join(['_b']), voltages(280)
    first, second = ([Samples(b.t, b.values[k]) for b in blocks(v, RATE)] for k in (0, 1))
    said = []

    def take(is_over=False, silent=()):
        for block, note, _ in join.complete(lambda since: is_over, silent):
            rows, missing = join.rows(block)
            said.append((note, rows.values[1].tolist(), missing))

    join.add('', first[0], 0.0, 'a')
    take()
    assert said == []
    join.add('_b', second[0], 0.0)
    take()
    assert said.pop() == ('a', second[0].values.tolist(), {})
    # one that never comes: the last voltage stays in force, and its samples are counted
    join.add('', first[1], 0.0, 'b')
    take()
    assert said == []
    take(is_over=True)
    assert said.pop() == ('b', [second[0].values[-1]] * 70, {'_b': 70})
    # who was heard lately has not gone, whatever is known of publishers
    join.add('', first[2], 0.5, 'c')
    take(silent=['_b'])
    assert said == []
    join.add('_b', second[2], 0.6)
    take(silent=['_b'])
    assert said.pop() == ('c', second[2].values.tolist(), {})
    # an axis that nobody drives is not waited for
    join.add('', first[3], 2.0, 'd')
    take(silent=['_b'])
    assert said.pop()[2] == {'_b': 70}


def test_all_axes_follow_their_references_with_the_paths_made_up_for():
    kind = chains()
    tracker, wanted = kind.tracker(model=scanner()), kind.wanted(4000)
    wanted *= np.minimum(np.arange(4000) / 500.0, 1.0)
    drives = [tracker.process(wanted[:, k : k + 50], k == 0) for k in range(0, 4000, 50)]
    drives.append(tracker.finish())
    v, now = (np.hstack([getattr(d, x) for d in drives]) for x in ('v', 'wanted'))
    assert sum(d.clipped for d in drives) == 0 and v.min() >= 0.0 and v.max() <= 10.0
    np.testing.assert_allclose(now[:, 60 + 1000 :], wanted[:, 1000:], rtol=0.0, atol=1e-15)
    missed = simulated(scanner(), v) - now
    assert (np.abs(missed[:, 1000:]).max(axis=1) < 1e-4 * np.ptp(wanted, axis=1)).all()
    # without the paths it would miss by them
    alone = simulated(pi.MultiAxisModel({a: scanner().own(a) for a in AXES}), v) - now
    assert np.ptp(alone[1, 1000:]) > 5e-3 * np.ptp(wanted[1])
    for _ in range(20):
        tracker.idle(100)
    assert tracker.is_at_rest and tracker.idle(10)[1].tolist() == [[0.0] * 10] * 2


def test_an_axis_that_nobody_moves_is_not_out_of_reach():
    kind = chains()
    tracker, wanted = kind.tracker(model=scanner()), kind.wanted(3000)
    # what the first axis moves of it would take a voltage below the lowest
    wanted[1] = tracker.rest[1]
    drives = [tracker.process(wanted[:, k : k + 50], k == 0) for k in range(0, 3000, 50)]
    assert sum(d.clipped for d in drives) == 0
    assert np.ptp(simulated(scanner(), np.hstack([d.v for d in drives]))[1]) > 1e-7


def test_limits_and_slew_hold_on_every_axis(kind):
    rate = kind.limits.sample_rate
    limits = replace(kind.limits, low=0.0, high=6.0, slew=0.05 * rate, ramp_slew=0.01 * rate)
    tracker, wanted = kind.tracker(limits=limits), kind.wanted(4000)
    wanted[:, 2000] = np.nan
    wanted[:, 3000:] += 1e-4
    drives = [tracker.process(wanted[:, k : k + 50], k == 0) for k in range(0, 4000, 50)]
    assert sum(d.clipped for d in drives) > 0
    assert kind.within_limits(np.hstack([d.v for d in drives]), limits)


@pytest.mark.parametrize('follow', ['off', 'gain'])
def test_how_the_streams_are_cut_does_not_matter(kind, follow):
    one, other = (tracked(kind, kind.wanted(2000), follow, size) for size in (10, 37))
    np.testing.assert_allclose(one[1], other[1], rtol=0, atol=1e-9)


def test_motions_are_learnt_within_the_limits(kind):
    learning, sent, errors = repeated(kind, kind.wanted(4000))
    assert errors[0, 1] > 0.5 and (errors.min(axis=0) < 0.1).all()
    known = [r.error for r in learning.each['y_b'].repetitions]
    np.testing.assert_allclose(known, errors[:, 1], atol=0.02)
    assert all(kind.within_limits(v) for v in sent)
    # each drive may move the other axis, too: both have a part in the next drives
    drives = [one.drive for one in learning.each.values()]
    assert drives[0].lead == drives[1].lead and drives[0].v.size == drives[1].v.size


def test_paths_are_made_up_for_at_once():
    kind = replace(chains(), model=scanner())
    learning, _, _ = repeated(kind, kind.wanted(2000), scanner(), most=1)
    assert learning.errors[0] < 0.02


def test_an_axis_that_stands_still_is_no_obstacle_to_learning(kind):
    wanted = kind.wanted(3000)
    # chains have it at their lowest voltage, where it cannot make up for the other axis
    wanted[0] = kind.tracker().rest[0] if kind.model.modes is None else kind.model.modes.y0[0]
    _, _, errors = repeated(kind, wanted)
    assert errors[0, 1] > 0.5 and errors[:, 1].min() < 0.05
    said = 'of y_b are out of reach' if kind.model.modes else 'out of reach'
    with pytest.raises(pi.DataError, match=said):
        LiveLearning(kind.model, np.add(wanted, [[0.0], [3e-5]]), kind.limits, AXES)


def test_a_sensor_at_fault_ends_learning_with_the_name_of_its_axis(kind):
    learning = LiveLearning(kind.model, kind.wanted(2000), kind.limits, AXES)
    for broken in (True, False):
        t = np.arange(learning.voltage.shape[1]) / kind.limits.sample_rate
        for k, row in enumerate(simulated(kind.model, learning.voltage)):
            learning.measured(Samples(t, np.zeros(t.size) if broken and k else row), 0, k)
        assert learning.is_complete
        if broken:
            with pytest.raises(pi.DataError, match='y_b: learning: the displacement stands'):
                learning.take()
        else:
            # it goes on with what was sound
            learning.take()
            assert learning.errors[0] < 0.5
        assert not learning.is_complete

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage of several axes, live: joined, predicted and driven block by block."""

from axes_scanner import RATE, scanner, sweeps
import numpy as np
import piezo_ident as pi
from piezo_ident.live.guard import GuardSettings
from piezo_ident.live.join import Join
from piezo_ident.live.predictor import Predictor
from piezo_ident.live.tracker import Tracker
from piezo_ident.record.blocks import Samples
import pytest

AXES = ('y', 'y_b')
LIMITS = GuardSettings(0.0, 10.0, 40e3, 200.0, 0.0, RATE)


def voltages(n=3000, seed=0):
    """Return voltages of both axes, a row each, from 0 V."""
    rng = np.random.default_rng(seed)
    return np.stack([sweeps(n, rng), sweeps(n, rng)])


def blocks(v, size=70, start=0):
    """Cut voltages into blocks."""
    t = (start + np.arange(v.shape[1])) / RATE
    ends = range(0, t.size, size)
    return [Samples(t[k : k + size], np.ascontiguousarray(v[:, k : k + size])) for k in ends]


def simulated(v, stage=None):
    """Return the offline prediction, a row for each axis."""
    y = (stage or scanner()).simulate({'v': v[0], 'v_b': v[1]})
    return np.stack([y[axis] for axis in AXES])


def predicted(predictor, v, start=0):
    return np.hstack([predictor.process(block).values for block in blocks(v, start=start)])


def test_the_live_prediction_of_all_axes_is_the_offline_one():
    predictor, v = Predictor(AXES), voltages()
    predictor.set_model(scanner())
    np.testing.assert_allclose(predicted(predictor, v), simulated(v), rtol=0.0, atol=1e-12 * 50e-6)
    assert predictor.memory_known


def test_a_model_that_comes_late_has_the_state_of_one_that_came_first(monkeypatch):
    # most of the voltage is kept as turning points alone
    monkeypatch.setattr('piezo_ident.live.history.RECENT', 1.0)
    v, predictor = voltages(4000), Predictor(AXES)
    for block in blocks(v[:, :3000]):
        assert predictor.process(block) is None
    predictor.set_model(scanner())
    late = predicted(predictor, v[:, 3000:], start=3000)
    np.testing.assert_allclose(late, simulated(v)[:, 3000:], rtol=0.0, atol=1e-9 * 50e-6)


def test_a_gap_is_bridged_on_every_axis():
    v, predictor = voltages(), Predictor(AXES)
    predictor.set_model(scanner())
    v[:, 1001:1050] = v[:, [1000]] + np.arange(1, 50) / 50 * (v[:, [1050]] - v[:, [1000]])
    made = [predicted(predictor, v[:, :1001]), predicted(predictor, v[:, 1050:], start=1050)]
    assert predictor.lost == 49
    whole = np.delete(simulated(v), np.s_[1001:1050], axis=1)
    np.testing.assert_allclose(np.hstack(made), whole, rtol=0.0, atol=1e-9 * 50e-6)


@pytest.mark.parametrize('axes', [('y',), ('y', 'y_c'), ('y', 'y_b', 'y_c')])
def test_a_model_of_other_axes_is_refused(axes):
    with pytest.raises(pi.ModelError, match="'axes'") as refusal:
        Predictor(axes).set_model(scanner())
    assert axes[-1] in str(refusal.value) and 'y_b' in str(refusal.value)


def test_voltages_are_joined_on_their_time():
    join, v = Join(['_b']), voltages(280)
    first, second = ([Samples(b.t, b.values[k]) for b in blocks(v)] for k in (0, 1))
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


def motions(n=4000):
    """Return what the axes are to do [m], from their rest."""
    t = np.arange(n) / RATE
    soft = np.minimum(t / 0.5, 1.0)
    return np.stack(
        [
            soft * 20e-6 * (1.0 - 0.8 * np.cos(2 * np.pi * 3 * t)),
            soft * 15e-6 * (1.0 - 0.8 * np.cos(2 * np.pi * 0.7 * t)),
        ]
    )


def test_all_axes_follow_their_references_with_the_paths_made_up_for():
    tracker, wanted = Tracker(scanner(), LIMITS, 60, axes=AXES), motions()
    drives = [tracker.process(wanted[:, k : k + 50], k == 0) for k in range(0, 4000, 50)]
    drives.append(tracker.finish())
    v, now = (np.hstack([getattr(d, x) for d in drives]) for x in ('v', 'wanted'))
    assert sum(d.clipped for d in drives) == 0 and v.min() >= 0.0 and v.max() <= 10.0
    np.testing.assert_allclose(now[:, 60 + 1000 :], wanted[:, 1000:], rtol=0.0, atol=1e-15)
    missed = simulated(v) - now
    for k in (0, 1):
        assert np.abs(missed[k, 1000:]).max() < 1e-4 * np.ptp(wanted[k])
    # without the paths it would miss by them
    alone = simulated(v, pi.MultiAxisModel({a: scanner().own(a) for a in AXES})) - now
    assert np.ptp(alone[1, 1000:]) > 5e-3 * np.ptp(wanted[1])
    for _ in range(20):
        tracker.idle(100)
    assert tracker.is_at_rest and tracker.idle(10)[1].tolist() == [[0.0] * 10] * 2


def test_an_axis_that_nobody_moves_is_not_out_of_reach():
    tracker, wanted = Tracker(scanner(), LIMITS, 60, axes=AXES), motions()
    # what the first axis moves of it would take a voltage below the lowest
    wanted[1] = tracker.rest[1]
    drives = [tracker.process(wanted[:, k : k + 50], k == 0) for k in range(0, 3000, 50)]
    assert sum(d.clipped for d in drives) == 0
    assert np.ptp(simulated(np.hstack([d.v for d in drives]))[1]) > 1e-7


def test_limits_and_slew_hold_on_every_axis():
    settings = GuardSettings(0.0, 6.0, 100.0, 20.0, 0.0, RATE)
    tracker, wanted = Tracker(scanner(), settings, 60, axes=AXES), 3.0 * motions()
    drives = [tracker.process(wanted[:, k : k + 50], k == 0) for k in range(0, 3000, 50)]
    v = np.hstack([d.v for d in drives])
    assert sum(d.clipped for d in drives) > 0
    assert v.min() >= 0.0 and v.max() <= 6.0
    assert np.abs(np.diff(v, axis=1)).max() * RATE <= 100.0 * (1.0 + 1e-9)

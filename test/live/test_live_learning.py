# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A motion that is repeated: what is sent, what came back, what was learned."""

from dataclasses import replace
import threading

from effect_table import VISIBLE
import numpy as np
from paper_stage import FS, PAPER
from piezo_ident.common.errors import ConfigError
from piezo_ident.live import live_learning
from piezo_ident.live.guard import Guard, GuardSettings
from piezo_ident.live.live_learning import Learner, LiveLearning
from piezo_ident.live.tracker import Tracker
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.record.blocks import Samples
import pytest

SETTINGS = GuardSettings(0.0, 10.0, 40e3, 200.0, 0.0, FS)


def test_it_learns_from_blocks_of_any_clock_and_knows_when_they_are_complete():
    stage = replace(PAPER, effects=(EffectSetting('creep', VISIBLE['creep']),))
    reference = 35e-6 - 15e-6 * np.cos(np.arange(2000) / 100.0)
    learning = LiveLearning(PAPER, reference[np.newaxis], SETTINGS)
    for tick in (0, 777, 5000):
        # the guard makes the way from rest
        (voltage,), (wanted,) = learning.voltage, learning.wanted
        v = Guard(SETTINGS).process(voltage).voltage
        assert v[0] == 0.0 and v.size == wanted.size
        moving = np.isfinite(wanted)
        np.testing.assert_array_equal(wanted[moving][-2000:], reference)
        np.testing.assert_array_equal(v[moving], voltage[moving])
        y = stage.simulate(v)
        t = (tick + np.arange(v.size)) / FS
        # the last block comes first
        for part in (slice(2500, None), slice(0, 2400)):
            learning.measured(Samples(t[part], y[part]), tick)
        assert not learning.is_complete
        learning.measured(Samples(t[2390:2510], y[2390:2510]), tick)
        assert learning.is_complete
        learning.take()
        assert not learning.is_complete
    assert len(learning.errors) == 3
    assert learning.errors[2] < 0.1 * learning.errors[0]


@pytest.mark.parametrize(('late', 'comes'), [(3.5, True), (5.5, False)])
def test_a_lost_block_is_waited_for_until_it_is_sent_again(monkeypatch, late, comes):
    clock, sent = [100.0], []
    monkeypatch.setattr(live_learning.time, 'monotonic', lambda: clock[0])
    learning = LiveLearning(PAPER, np.full((1, 200), 20e-6), SETTINGS)
    learner = Learner(lambda: learning, 1, lambda voltage, _: sent.append(voltage))
    learner._thread.join()
    tracker = Tracker(PAPER, SETTINGS)
    while not learner.is_played:
        learner.step(tracker)
        clock[0] += 0.1
    tracker.idle(round(FS))
    *answers, last = [Samples(b.t, np.zeros(b.t.size), b.segment) for b in sent]
    for answer in answers:
        learner.measured(answer)
    clock[0] += late
    if comes:
        learner.step(tracker)
        learner.measured(last)
        learner.step(tracker)
        assert learner.progress == 100.0
    else:
        with pytest.raises(ConfigError, match='of repetition 1 did not come in full'):
            learner.step(tracker)


def test_a_repetition_begins_anew_when_the_plan_of_a_former_one_is_done():
    learning = LiveLearning(PAPER, np.full((1, 200), 30e-6), SETTINGS)
    begun, may_end, order = threading.Event(), threading.Event(), []

    def slow(measured):
        begun.set()
        may_end.wait()
        order.append('learnt')

    learning._learning.take = slow
    former = threading.Thread(target=learning.take)
    former.start()
    begun.wait()
    learning.measured(Samples(np.arange(9000) / FS, np.zeros(9000)), 0)
    anew = threading.Thread(target=lambda: order.append(learning.again()))
    anew.start()
    may_end.set()
    former.join()
    anew.join()
    # what came of the former one is no part of the next
    assert order == ['learnt', learning] and np.isnan(learning._measured).all()

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Which topics are replayed, and when each message is due."""

from pathlib import Path

from bag_data import blocks, write
import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.live.replay import chosen_topics, ReplayClock
from piezo_ident.record.bags.read import opened_bag
from piezo_ident.record.bags.recover import Bag
import pytest

A, B = '/a', '/b'


def here(namespace: str = ''):
    return lambda name: name if name.startswith('/') else f'{namespace}/{name}'


def bag(path: Path, *topics: str) -> Bag:
    messages = []
    for v, y in blocks():
        messages += [(t, v if t.endswith(('voltage', 'drive')) else y) for t in topics]
    with opened_bag(write(path / 'bag', messages)) as opened:
        # the connections of a closed reader are gone
        return Bag(path / 'bag', list(opened.connections), opened.messages, 0, 0)


@pytest.mark.parametrize(
    ('there', 'wanted', 'namespace', 'want'),
    [
        (['/voltage'], ['voltage'], '', {'/voltage': '/voltage'}),
        (['/a/voltage'], ['voltage'], B, {'/a/voltage': '/b/voltage'}),
        (['/a/voltage', '/b/voltage'], ['voltage'], B, {'/b/voltage': '/b/voltage'}),
        (['/a/x/voltage'], ['x/voltage'], B, {'/a/x/voltage': '/b/x/voltage'}),
        (['/a/voltage'], ['/a/voltage'], B, {'/a/voltage': '/a/voltage'}),
    ],
)
def test_choice(tmp_path, there, wanted, namespace, want):
    assert chosen_topics(bag(tmp_path, *there), wanted, here(namespace)) == want


def test_remapped_topics_are_found_by_what_they_carry(tmp_path):
    messages = [m for v, y in blocks() for m in (('/lab/drive', v), ('/lab/gauge', y))]
    with opened_bag(write(tmp_path / 'bag', messages)) as opened:
        chosen = chosen_topics(opened, ['voltage', 'displacement'], here(A))
        assert chosen == {'/lab/drive': '/a/voltage', '/lab/gauge': '/a/displacement'}
        # by a remap of the player, under its own name
        remap = {'voltage': '/lab/drive'}
        assert chosen_topics(opened, ['voltage'], remap.__getitem__) == {
            '/lab/drive': '/lab/drive'
        }


def test_a_prediction_is_not_replayed_as_displacement(tmp_path):
    messages = [m for v, y in blocks() for m in (('/voltage', v), ('/prediction', y))]
    with opened_bag(write(tmp_path / 'bag', messages)) as opened:
        assert chosen_topics(opened, ['prediction'], here(A)) == {'/prediction': '/a/prediction'}
        with pytest.raises(DataError, match='no topic displacement in it'):
            chosen_topics(opened, ['displacement'], here(A))


def test_refusals(tmp_path):
    there = bag(tmp_path, '/a/voltage', '/c/voltage')
    closed = Bag(there.path, there.connections, lambda _: iter(()), 0, 0)
    for wanted, reason in (
        (['displacement_'], r'no topic displacement_ in it; set topics to some of: /a/voltage'),
        (['/b/voltage'], 'no topic /b/voltage'),
        (['voltage'], 'several topics could be voltage: /a/voltage, /c/voltage'),
    ):
        with pytest.raises(DataError, match=reason):
            chosen_topics(closed, wanted, here(B))


def test_schedule_does_not_drift():
    clock = ReplayClock(2.0, 10**18, now=50.0)
    for k in range(100_000):
        stamp = 10**18 + k * 5_000_000
        assert clock.due(stamp) == pytest.approx(50.0 + k * 0.0025, abs=1e-9)
        # however late each is sent, when there is time before the next one nothing moves
        clock.note(stamp, clock.due(stamp) - 0.0001)
    assert clock.slipped == 0


def test_no_burst_after_a_delay():
    clock = ReplayClock(1.0, 0, now=0.0)
    now, sent = 0.0, []
    for k in range(200):
        stamp = k * 5_000_000
        clock.note(stamp, now)
        now = max(now, clock.due(stamp))
        if k == 50:
            now += 0.5
        sent.append(now)
    at_once = sum(gap < 0.001 for gap in np.diff(sent))
    assert at_once <= ReplayClock.BURST
    # the rest of the delay moved the schedule
    assert clock.slipped == pytest.approx(0.5 - ReplayClock.BURST * 0.005)
    assert sent[-1] - sent[100] == pytest.approx(99 * 0.005)


def test_change_of_rate():
    clock = ReplayClock(1.0, 0, now=0.0)
    clock.change_rate(10.0, 10**9, now=1.0)
    assert clock.due(2 * 10**9) == pytest.approx(1.1)

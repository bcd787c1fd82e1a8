# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The player on a running graph: what comes out is what was recorded, when it was recorded."""

from pathlib import Path
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from graph import Graph, in_time
from piezo_ident.nodes.ending import ENDING
from piezo_ident.nodes.player import PlayerNode, Replay
from piezo_ident.nodes.wire import to_message
from piezo_ident.record.bags.read import MESSAGE_TYPE, typestore
from piezo_ident.record.bags.write import BagWriter, SAMPLE_QOS
from piezo_ident.record.blocks import Samples
from rclpy.serialization import serialize_message
from rosbags.interfaces import QosDurability

RATE = 20000.0
BLOCK = 100
LATCHED_QOS = SAMPLE_QOS._replace(depth=1, durability=QosDurability.TRANSIENT_LOCAL)


def pair(k: int) -> tuple[Samples, Samples]:
    rng = np.random.default_rng(k)
    t = np.arange(BLOCK * k, BLOCK * (k + 1)) / RATE
    return (
        Samples(t, rng.normal(size=BLOCK), 'noise', 'voltage'),
        Samples(t, 1e-6 * rng.normal(size=BLOCK), 'noise', 'displacement'),
    )


def bag(path: Path, n: int = 200, namespace: str = '', pause: float = 0.2) -> list[int]:
    """Write a bag of n pairs of blocks, 5 ms apart but for a pause in the middle [s]."""
    store = typestore()
    writer = BagWriter(path)
    for quantity in ('voltage', 'displacement'):
        writer.add_topic(f'{namespace}/{quantity}', MESSAGE_TYPE)
    writer.add_topic(f'{namespace}/model', 'std_msgs/msg/String', [LATCHED_QOS])
    text = store.types['std_msgs/msg/String']('a model of long ago')
    writer.write(
        f'{namespace}/model', 10**18, bytes(store.serialize_cdr(text, 'std_msgs/msg/String'))
    )
    stamps = []
    for k in range(n):
        stamp = 10**18 + k * 5_000_000 + (round(1e9 * pause) if k >= n // 2 else 0)
        stamps.append(stamp)
        for quantity, samples in zip(('voltage', 'displacement'), pair(k), strict=True):
            raw = serialize_message(to_message(samples))
            writer.write(f'{namespace}/{quantity}', stamp, raw)
    writer.close()
    return stamps


def test_the_end_waits_for_a_replay_that_is_slow_to_stop(monkeypatch):
    # on a machine that stood still a replay took 1.1 s to stop, and nobody heard of it
    monkeypatch.setattr(ENDING, 'patience', 2.0)
    replay = Replay('', ())
    slow = threading.Thread(target=lambda: replay.stop.wait() and time.sleep(1.1))
    slow.start()
    PlayerNode.close(SimpleNamespace(_replay=replay, _thread=slow))
    assert not slow.is_alive()


def same(got: list[Samples], want: list[Samples]) -> bool:
    return len(got) == len(want) and all(
        np.array_equal(a.t, b.t)
        and np.array_equal(a.values, b.values)
        and (a.segment, a.quantity) == (b.segment, b.quantity)
        for a, b in zip(got, want, strict=True)
    )


@pytest.mark.parametrize('is_there', [True, False])
def test_a_replay_may_be_started_again_from_its_last_status_on(tmp_path, is_there):
    if is_there:
        bag(tmp_path / 'bag')
    states = []

    class Player(PlayerNode):
        """A player without ROS, whose replay is stopped before its first message."""

        def __init__(self):
            self._replay = Replay(str(tmp_path / 'bag'), ('voltage',))
            self._replay.stop.set()
            self.resolve_topic_name = '/{}'.format

        def reason(self, error):
            return str(error)

        def report_status(self, state, *_, **__):
            states.append((state, self._is_replaying()))

    node = Player()
    assert node._is_replaying()
    node._work(node._replay)
    assert states == [('stopped' if is_there else 'refused', False)]


@pytest.fixture(scope='module')
def lab():
    """Return a graph with players in namespaces of their own."""
    with Graph() as g:
        g.start_all(('player', {}, 'b'), ('player', {'wait_limit': 0.3}, 'c'), ('player', {}, 'e'))
        yield g


@pytest.mark.timed
def test_replay(lab, tmp_path):
    stamps = bag(tmp_path / 'bag', namespace='/a')
    # recorded in /a, replayed in /b
    voltage, displacement = lab.collect('/b/voltage'), lab.collect('/b/displacement')
    models = lab.texts('/b/model')
    assert lab.set('b/player', 'bag', str(tmp_path / 'bag')) == (True, '')
    assert lab.call('b/player/stop') == (False, 'not replaying; call start first')
    want = (np.array(stamps) - stamps[0]) * 1e-9

    def all_of_it(messages: str) -> tuple[np.ndarray, float]:
        """Replay it, and return when each block of voltage came, and what the clock slipped."""
        first = len(voltage)
        status = lab.finish('b/player/start')
        assert (status['messages'], status['progress']) == (messages, '100')
        for blocks in (voltage, displacement):
            lab.wait(lambda b=blocks: len(b) >= first + 200, 'all blocks')
        assert same(voltage[first:], [pair(k)[0] for k in range(200)])
        assert same(displacement[first:], [pair(k)[1] for k in range(200)])
        return np.array(lab.arrivals('/b/voltage')[first:]), float(status['slipped'])

    # the original spacing, with the pause, from the first to the last
    arrivals, slipped = all_of_it('400')
    late = arrivals - arrivals[0] - want
    in_time(abs(np.median(late)) - slipped, 0.1, 'the blocks behind their time')
    in_time(abs(late[-1] - slipped), 0.3, 'the last block behind its time')
    assert arrivals[100] - arrivals[99] > 0.1, 'the pause came together with what followed'
    # what was measured alone
    assert models == []
    progress = {int(s['progress']) for s in lab.statuses('b/player') if s['state'] == 'playing'}
    assert len(progress) > 2

    # from the beginning again, faster, with the model
    assert lab.set('b/player', 'rate', 4.0)[0]
    assert lab.set('b/player', 'topics', ['voltage', 'displacement', 'model'])[0]

    arrivals, slipped = all_of_it('401')
    in_time(arrivals[-1] - arrivals[0] - slipped, 0.8 * want[-1], 'four times as fast')
    lab.wait(lambda: models, 'the recorded model')
    assert set(models) == {'a model of long ago'}

    # stopped in the middle; started while it plays
    assert lab.set('b/player', 'rate', 0.1)[0]
    before = len(voltage)
    assert lab.call('b/player/start')[0]
    lab.wait(lambda: len(voltage) > before + 5, 'the third replay')
    ok, reason = lab.call('b/player/start')
    assert not ok and 'replaying already' in reason
    assert 'stopped after' in lab.finish('b/player/stop')['text']


def test_refusals_and_waiting(lab, tmp_path):
    bag(tmp_path / 'bag', 20)
    (tmp_path / 'garbage.mcap').write_bytes(b'no bag at all' * 100)
    assert lab.call('c/player/start') == (False, 'no bag is named; set the parameter bag')
    assert lab.set('c/player', 'bag', str(tmp_path / 'nowhere'))[0]
    ok, message = lab.call('c/player/start')
    assert not ok and 'does not exist' in message
    assert lab.set('c/player', 'topics', ['voltage', 'temperature'])[0]
    for name, reason in (
        ('garbage.mcap', 'damaged or unfinished bag'),
        ('bag', 'no topic temperature in it; set topics to some of: /displacement'),
    ):
        assert lab.set('c/player', 'bag', str(tmp_path / name))[0]
        assert lab.call('c/player/start')[0]
        lab.wait(lambda r=reason: r in lab.status('c/player')['text'], reason)
        assert lab.status('c/player')['state'] == 'refused'
    ok, reason = lab.set('c/player', 'topics', ['a b'])
    assert not ok
    assert 'no name of a topic' in reason
    assert not lab.set('c/player', 'rate', 0.05)[0]
    assert lab.set('c/player', 'topics', ['voltage', 'displacement'])[0]
    # nobody listens
    assert lab.call('c/player/start')[0]
    assert '/c/voltage (0 of 1)' in lab.until('c/player', 'failed')['text']
    # somebody comes while it waits
    assert lab.set('c/player', 'wait_limit', 60.0)[0]
    since = len(lab.statuses('c/player'))
    assert lab.call('c/player/start')[0]
    lab.until('c/player', 'waiting', since=since)
    voltage, displacement = lab.collect('/c/voltage'), lab.collect('/c/displacement')
    lab.until('c/player', 'done', since=since)
    lab.wait(lambda: len(voltage) >= 20 and len(displacement) >= 20, 'all blocks')
    assert len(voltage) == len(displacement) == 20


def test_a_log_clock_that_was_set_back_does_not_mix_the_blocks(lab, tmp_path):
    # as by NTP: the second half lies within the first, by the times of the log
    bag(tmp_path / 'bag', 60, pause=-0.2)
    voltage, displacement = lab.collect('/e/voltage'), lab.collect('/e/displacement')
    assert lab.set('e/player', 'bag', str(tmp_path / 'bag'))[0]
    status = lab.finish('e/player/start')
    assert (status['state'], status['messages'], status['progress']) == ('done', '120', '100')
    # by 0.2 s, less the time between two blocks
    assert 'log_time_step (1) by 0.195 s' in status['text']
    for i, blocks in enumerate((voltage, displacement)):
        lab.wait(lambda b=blocks: len(b) >= 60, 'all blocks')
        assert same(blocks, [pair(k)[i] for k in range(60)])

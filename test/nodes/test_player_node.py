# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The player on a running graph: what comes out is what was recorded, when it was recorded."""

from pathlib import Path
import signal

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from graph import Graph
from piezo_ident.bag_io import MESSAGE_TYPE, SAMPLE_QOS, typestore
from piezo_ident.bag_writer import BagWriter
from piezo_ident.nodes.wire import to_message
from piezo_ident.wire_format import Samples
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


def bag(path: Path, n: int = 200, namespace: str = '', *, close: bool = True) -> list[int]:
    """Write a bag of n pairs of blocks, 5 ms apart but for a pause in the middle."""
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
        stamp = 10**18 + k * 5_000_000 + (200_000_000 if k >= n // 2 else 0)
        stamps.append(stamp)
        for quantity, samples in zip(('voltage', 'displacement'), pair(k), strict=True):
            raw = serialize_message(to_message(samples))
            writer.write(f'{namespace}/{quantity}', stamp, raw)
    writer.flush()
    if close:
        writer.close()
    else:
        writer._inside.bio.close()
    return stamps


def same(got: list[Samples], want: list[Samples]) -> bool:
    return len(got) == len(want) and all(
        np.array_equal(a.t, b.t)
        and np.array_equal(a.values, b.values)
        and (a.segment, a.quantity) == (b.segment, b.quantity)
        for a, b in zip(got, want, strict=True)
    )


def wait_for(graph: Graph, state: str, name: str = 'player') -> dict[str, str]:
    graph.wait(lambda: graph.status(name)['state'] == state, timeout=20, what=state)
    return graph.status(name)


def test_replay(tmp_path):
    stamps = bag(tmp_path / 'bag', namespace='/a')
    with Graph() as g:
        # recorded in /a, replayed in /b
        voltage, displacement = g.collect('/b/voltage'), g.collect('/b/displacement')
        models = g.texts('/b/model')
        g.start('player', {'bag': str(tmp_path / 'bag')}, 'b')
        assert g.call('b/player/stop') == (False, 'not replaying; call start first')
        ok, message = g.call('b/player/start')
        assert ok
        assert '/b/voltage, /b/displacement' in message
        assert '400 messages' in message
        status = wait_for(g, 'done', 'b/player')
        assert status['messages'] == '400'
        assert status['progress'] == '100'
        g.wait(lambda: len(displacement) >= 200, what='all blocks')
        assert same(voltage, [pair(k)[0] for k in range(200)])
        assert same(displacement, [pair(k)[1] for k in range(200)])
        # the original spacing, with the pause, from the first to the last; the machine is busy
        arrivals = np.array(g.arrivals('/b/voltage'))
        want = (np.array(stamps) - stamps[0]) * 1e-9
        late = arrivals - arrivals[0] - want
        assert abs(np.median(late)) < 0.02
        assert abs(arrivals[-1] - arrivals[0] - want[-1]) < 0.2
        assert arrivals[100] - arrivals[99] > 0.15
        # what was measured alone
        assert models == []
        progress = {int(s['progress']) for s in g.statuses('b/player') if s['state'] == 'playing'}
        assert len(progress) > 2

        # from the beginning again, faster, with the model
        assert g.set('b/player', 'rate', 5.0)[0]
        assert g.set('b/player', 'topics', ['voltage', 'displacement', 'model'])[0]
        assert g.call('b/player/start')[0]
        g.wait(lambda: len(displacement) >= 400, what='second replay')
        status = wait_for(g, 'done', 'b/player')
        assert status['messages'] == '401'
        assert same(voltage[200:], voltage[:200])
        arrivals = np.array(g.arrivals('/b/voltage'))[200:]
        assert arrivals[-1] - arrivals[0] < 0.9
        g.wait(lambda: models == ['a model of long ago'], what='recorded model')

        # stopped in the middle, and started while it plays
        assert g.set('b/player', 'rate', 0.5)[0]
        before = len(voltage)
        assert g.call('b/player/start')[0]
        g.wait(lambda: len(voltage) > before + 5, what='third replay')
        assert g.call('b/player/start')[0]
        g.wait(lambda: voltage[-1].t[0] == 0.0, what='the beginning')
        g.wait(lambda: voltage[-1].t[0] > 0.0, what='more')
        assert g.call('b/player/stop') == (True, 'stopping')
        assert 'stopped after' in wait_for(g, 'stopped', 'b/player')['message']
        g.wait(lambda: 'rate' in g.diagnostics('b/player'), what='diagnostics')


def test_refusals_and_waiting(tmp_path):
    bag(tmp_path / 'bag', 20)
    (tmp_path / 'garbage.mcap').write_bytes(b'no bag at all' * 100)
    with Graph() as g:
        player = g.start('player', {'wait_limit': 0.3})
        assert g.call('player/start') == (False, 'no bag is named; set the parameter bag')
        for name, reason in (
            ('nowhere', 'does not exist'),
            ('garbage.mcap', 'damaged or unfinished bag'),
        ):
            assert g.set('player', 'bag', str(tmp_path / name))[0]
            ok, message = g.call('player/start')
            assert not ok
            assert reason in message
            assert reason in wait_for(g, 'refused')['message']
        assert g.set('player', 'bag', str(tmp_path / 'bag'))[0]
        assert g.set('player', 'topics', ['voltage', 'temperature'])[0]
        ok, message = g.call('player/start')
        assert not ok
        assert 'no topic temperature in it; set topics to some of: /displacement' in message
        ok, reason = g.set('player', 'topics', ['a b'])
        assert not ok
        assert 'no name of a topic' in reason
        assert not g.set('player', 'rate', 0.0)[0]
        assert g.set('player', 'topics', ['voltage', 'displacement'])[0]
        # nobody listens
        assert g.call('player/start')[0]
        assert '/voltage (0 of 1)' in wait_for(g, 'failed')['message']
        # somebody comes while it waits
        assert g.set('player', 'wait_limit', 20.0)[0]
        assert g.call('player/start')[0]
        wait_for(g, 'waiting')
        voltage, displacement = g.collect('/voltage'), g.collect('/displacement')
        wait_for(g, 'done')
        g.wait(lambda: len(voltage) == len(displacement) == 20, what='all blocks')
        assert player.stop(signal.SIGINT) == 0


def test_a_bag_that_ends_early(tmp_path):
    bag(tmp_path / 'bag', 20, close=False)
    with Graph() as g:
        voltage = g.collect('/voltage')
        g.collect('/displacement')
        player = g.start('player', {'bag': str(tmp_path / 'bag'), 'autostart': True})
        status = wait_for(g, 'done')
        assert 'the bag ends early: truncated_bag' in status['message']
        assert status['level'] == '1'
        g.wait(lambda: len(voltage) == 20, what='all blocks')
        # ended while it plays
        assert g.set('player', 'rate', 0.01)[0]
        assert g.call('player/start')[0]
        g.wait(lambda: len(voltage) > 21, what='second replay')
        assert player.stop(signal.SIGTERM, timeout=2.0) == 0


def test_record_and_replay(tmp_path):
    bag(tmp_path / 'bag', 100)
    with Graph() as g:
        first = g.collect('/voltage')
        g.start('player', {'bag': str(tmp_path / 'bag'), 'subscribers': 1})
        g.start('recorder', {'output': str(tmp_path / 'again'), 'autostart': True})
        wait_for(g, 'recording', 'recorder')
        assert g.call('player/start')[0]
        wait_for(g, 'done')
        g.wait(lambda: g.status('recorder')['messages'] == '200', what='all in the bag')
        assert g.call('recorder/stop')[0]
        wait_for(g, 'done', 'recorder')
        assert g.set('player', 'bag', str(tmp_path / 'again'))[0]
        second = g.collect('/displacement')
        g.matched('/displacement')
        assert g.call('player/start')[0]
        g.wait(lambda: len(second) == 100 and len(first) == 200, what='all blocks', timeout=20)
        assert same(second, [pair(k)[1] for k in range(100)])
        assert same(first[100:], first[:100])

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The recorder on a running graph: what passes is in the bag, whatever ends the recorder."""

import json
from pathlib import Path
import shutil
import threading
import time

from bag_data import metadata
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from graph import Graph, in_time
from piezo_ident.cli import main
from piezo_ident.nodes.wire import LATCHED, STREAM, to_message
from piezo_ident.record.bags.read import opened_bag, read_bag
from piezo_ident.record.bags.recover import is_unfinished
from piezo_ident.record.blocks import Samples
from rclpy.duration import Duration
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String

RATE = 20000.0
BLOCK = 100


def pair(k: int) -> tuple[Samples, Samples]:
    t = np.arange(BLOCK * k, BLOCK * (k + 1)) / RATE
    return (
        Samples(t, 5 + np.sin(7 * t), 'noise', 'voltage'),
        Samples(t, 1e-5 + 1e-6 * np.sin(7 * t), 'noise', 'displacement'),
    )


#: without /diagnostics, which come all the time
COUNTED = ['voltage', 'displacement', 'residual', 'model']


class Source:
    """Sends pairs of blocks at real time, 200 a second each, from a thread."""

    def __init__(self, graph: Graph, namespace: str = '', *, is_heard: bool = True) -> None:
        self.publishers = [
            graph.node.create_publisher(Float64MultiArray, f'{namespace}/{name}', STREAM)
            for name in ('voltage', 'displacement')
        ]
        self.sent: list[float] = []
        self.messages: list[list[Float64MultiArray]] = []
        self._graph, self._is_heard = graph, is_heard
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)

    def __enter__(self) -> 'Source':
        for publisher in self.publishers if self._is_heard else ():
            self._graph.wait(publisher.get_subscription_count, publisher.topic_name)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def has_arrived(self) -> None:
        """Wait until all that was sent is with who listens."""
        for publisher in self.publishers:
            assert publisher.wait_for_all_acked(Duration(seconds=60.0))

    def _send(self) -> None:
        start = time.monotonic()
        k = 0
        # a thread that was held up must not send at once more than a publisher keeps
        while not self._end.wait(max(0.004, start + k * BLOCK / RATE - time.monotonic())):
            messages = [to_message(s) for s in pair(k)]
            for publisher, message in zip(self.publishers, messages, strict=True):
                publisher.publish(message)
            self.messages.append(messages)
            self.sent.append(time.monotonic())
            k += 1


def start(graph: Graph, name: str = 'recorder') -> str:
    """Start a recording, and return its path."""
    return graph.finish(f'{name}/start', 'recording')['path']


def contents(path: Path | str) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    with opened_bag(path) as bag:
        for connection, _, raw in bag.messages(bag.connections):
            found.setdefault(connection.topic, []).append(bytes(raw))
    return found


def arrays(found: list[bytes]) -> list[Float64MultiArray]:
    return [deserialize_message(raw, Float64MultiArray) for raw in found]


def test_record_stop_and_refusals(tmp_path):
    with Graph() as g:
        source = Source(g, '/a')
        model = g.node.create_publisher(String, '/a/model', LATCHED)
        model.publish(String(data='the first'))
        settings = {'output': str(tmp_path / 'bag'), 'sample_rate': RATE, 'topics': COUNTED}
        g.start('recorder', settings, 'a')
        assert g.call('a/recorder/stop') == (False, 'not recording; call start first')
        path = start(g, 'a/recorder')
        assert path == str(tmp_path / 'bag')
        ok, message = g.call('a/recorder/start')
        assert not ok and 'recording already' in message
        assert 'read-only' in g.set('a/recorder', 'storage', 'sqlite3')[1]
        assert not g.set('a/recorder', 'output', '')[0]
        assert not g.set('a/recorder', 'flush', 5.0)[0]
        with source:
            g.wait(lambda: len(source.sent) > 100, 'blocks')
            # a topic that appears late
            late = g.node.create_publisher(Float64MultiArray, '/a/residual', STREAM)
            g.wait(lambda: late.get_subscription_count() == 1, 'recorder hears of it')
            late.publish(to_message(pair(0)[1]))
            g.wait(lambda: int(g.status('a/recorder')['messages']) > 300, 'messages')
        source.has_arrived()
        seen = int(g.status('a/recorder')['messages'])
        ok, message = g.call('a/recorder/stop')
        assert ok and f'closing {path}' in message
        g.wait(lambda: g.status('a/recorder')['state'] == 'done', 'closed bag')
        status = g.status('a/recorder')
        assert status['lost'] == '0'
        assert int(status['messages']) == 2 * len(source.sent) + 2 >= seen
        assert int(status['bytes']) == (tmp_path / 'bag' / 'bag.mcap').stat().st_size
        # a second one beside it
        assert start(g, 'a/recorder') == str(tmp_path / 'bag_1')
        assert g.finish('a/recorder/stop')['state'] == 'done'
        # a place that cannot be
        (tmp_path / 'file').write_text('')
        for place in (tmp_path / 'file' / 'bag', tmp_path / ('x' * 300)):
            assert g.set('a/recorder', 'output', str(place))[0]
            assert g.call('a/recorder/start')[0]
            g.wait(
                lambda p=place: (
                    (s := g.status('a/recorder'))['state'] == 'failed' and p.name in s['text']
                ),
                'the refusal',
            )
            assert 'cannot be written' in g.status('a/recorder')['text']
        g.wait(lambda: 'rate' in g.diagnostics('a/recorder'), 'diagnostics')
    got = contents(tmp_path / 'bag')
    assert arrays(got['/a/voltage']) == [v for v, _ in source.messages]
    assert arrays(got['/a/displacement']) == [y for _, y in source.messages]
    assert [deserialize_message(m, String).data for m in got['/a/model']] == ['the first']
    assert arrays(got['/a/residual']) == [to_message(pair(0)[1])]
    record = read_bag(tmp_path / 'bag')
    n = BLOCK * len(source.sent)
    np.testing.assert_array_equal(record.pieces[0].v, 5 + np.sin(7 * (np.arange(n) / RATE)))
    assert (record.n, record.faults) == (n, ())
    assert record.pieces[0].sample_rate == RATE
    info = metadata(tmp_path / 'bag')
    assert info['custom_data']['sample_rate'] == repr(RATE)
    assert info['custom_data']['namespace'] == '/a'
    offered = {
        t['topic_metadata']['name']: t['topic_metadata']['offered_qos_profiles']
        for t in info['topics_with_message_count']
    }
    for topic, depth, durability in (
        ('/a/voltage', 1000, 'volatile'),
        ('/a/model', 1, 'transient_local'),
    ):
        (qos,) = offered[topic]
        assert (qos['history'], qos['depth'], qos['reliability'], qos['durability']) == (
            'keep_last',
            depth,
            'reliable',
            durability,
        )
    # log times are when a message came, on the clock of the day, in order
    with opened_bag(tmp_path / 'bag') as bag:
        stamps = np.array([m.stamp for m in bag.messages(bag.connections)])
        assert (np.diff(stamps) >= 0).all()
        assert abs(stamps[-1] * 1e-9 - time.time()) < 60


def test_a_long_recording_is_cut_into_parts_and_loses_nothing(tmp_path):
    with Graph() as g:
        source = Source(g)
        settings = {'output': str(tmp_path / 'bag'), 'max_bag_size': 500_000, 'topics': COUNTED}
        g.start('recorder', settings)
        assert start(g) == str(tmp_path / 'bag')
        with source:
            g.wait(lambda: (tmp_path / 'bag_3').exists(), 'the fourth part')
        source.has_arrived()
        assert g.finish('recorder/stop')['state'] == 'done'
        status = g.status('recorder')
    parts = sorted(tmp_path.glob('bag*'), key=lambda p: (len(p.name), p.name))
    assert int(status['messages']) == 2 * len(source.sent) and status['lost'] == '0'
    assert f'and {len(parts) - 1} before it' in status['text']
    sizes = [next(p.glob('*.mcap')).stat().st_size for p in parts]
    assert int(status['bytes']) == sum(sizes) and min(sizes[:-1]) >= 500_000
    found = [contents(p) for p in parts]
    for k, topic in enumerate(('/voltage', '/displacement')):
        got = [m for part in found for m in arrays(part.get(topic, []))]
        assert got == [pair[k] for pair in source.messages]


@pytest.mark.timed
def test_flush_is_how_long_a_message_waits_and_a_lost_folder_is_said(tmp_path):
    with Graph() as g:
        source = Source(g, is_heard=False)
        g.start('recorder', {'output': str(tmp_path / 'bag')})
        flushes = {}
        with source:
            for flush in (0.5, 0.05):
                assert g.set('recorder', 'flush', flush) == (True, '')
                start(g)
                seen, sent, begin = len(g.statuses('recorder')), len(source.sent), time.monotonic()
                g.wait(lambda sent=sent: len(source.sent) > sent + 200, '1 s of blocks')
                sizes = {s['bytes'] for s in g.statuses('recorder')[seen:]}
                # a second, however long it was looked at
                flushes[flush] = len(sizes) / (time.monotonic() - begin)
                assert g.finish('recorder/stop')['state'] == 'done'
            path = start(g)
            shutil.rmtree(path)
            assert g.call('recorder/stop')[0]
        assert flushes[0.5] <= 4.0 < flushes[0.05], flushes
        g.wait(lambda: g.status('recorder')['state'] == 'failed', 'the failure')
        status = g.status('recorder')
        assert status['level'] == '2' and path in status['text'], status
        g.wait(lambda: g.diagnostics('recorder')['level'] == '2', 'the same in diagnostics')


@pytest.mark.timed
@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_sigkill_loses_less_than_a_second(tmp_path, storage, capsys):
    killed(tmp_path, storage, capsys)


def killed(tmp_path, storage, capsys):
    """Kill a recorder, and see what is in its bag."""
    with Graph() as g:
        source = Source(g)
        recorder = g.start('recorder', {'output': str(tmp_path / 'bag'), 'storage': storage})
        start(g)
        with source:
            g.wait(lambda: len(source.sent) > 300, '1.5 s of blocks')
            before = len(source.sent)
            recorder.kill()
            after = len(source.sent)
    assert is_unfinished(tmp_path / 'bag')
    assert main(['convert', '--json', str(tmp_path / 'bag'), str(tmp_path / 'out')]) == 0
    story = json.loads(capsys.readouterr().out)
    (fault,) = (f for f in story['faults'] if f['name'] == 'truncated_bag')
    assert 'the recorder did not close the bag' in fault['action']
    record = read_bag(tmp_path / 'out')
    assert len(record.pieces) == 1
    kept = record.pieces[0].n / RATE
    # the last one may have been sent, and not noted
    assert kept <= (after + 1) / 200
    in_time(before / 200 - kept, 1.0, 'what was lost')
    np.testing.assert_array_equal(record.pieces[0].v, 5 + np.sin(7 * record.pieces[0].t))


def test_nothing_is_lost_where_several_publish_or_a_status_is_replaced(tmp_path):
    with Graph() as g:
        topics = [g.node.create_publisher(DiagnosticArray, '/diagnostics', 10) for _ in '123']
        for _ in range(40):
            topics[0].publish(DiagnosticArray())
        status = g.node.create_publisher(DiagnosticStatus, '/stage/status', LATCHED)
        pose = g.node.create_publisher(JointState, '/preview', 10)
        g.start('recorder', {'output': str(tmp_path / 'bag')})
        start(g)
        for publisher in (status, pose, *topics):
            g.wait(publisher.get_subscription_count, publisher.topic_name)
        # the first of them has published for long
        for k in range(1, 100):
            status.publish(DiagnosticStatus(message=str(k)))
            topics[k % 3].publish(DiagnosticArray())
        for _ in range(5):
            pose.publish(JointState())
            assert pose.wait_for_all_acked(Duration(seconds=60.0))
        end = g.finish('recorder/stop')
        assert end['state'] == 'done' and end['lost'] == '0'
    assert {'/stage/status', '/preview', '/diagnostics'} <= set(contents(tmp_path / 'bag'))


def test_other_topics_types_and_qos(tmp_path):
    params = {'output': str(tmp_path / 'bag'), 'topics': ['voltage', 'drive', '/else/pose', 'odd']}
    with Graph() as g:
        # a driver that sends best effort, on a topic that is expected to be reliable
        effort = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
        voltage = g.node.create_publisher(Float64MultiArray, '/voltage', effort)
        g.start('recorder', params, remaps={'drive': '/lab/drive'})
        start(g)
        drive = g.node.create_publisher(Float64MultiArray, '/lab/drive', STREAM)
        pose = g.node.create_publisher(JointState, '/else/pose', 10)
        for publisher in (voltage, drive, pose):
            g.wait(lambda p=publisher: p.get_subscription_count() == 1, publisher.topic_name)
        drive.publish(to_message(pair(0)[0]))
        pose.publish(JointState(name=['x'], position=[1.0]))

        def both() -> bool:
            voltage.publish(to_message(pair(0)[0]))
            return int(g.status('recorder')['messages'] or 0) > 5

        g.wait(both, 'messages')
        for publisher in (drive, pose):
            assert publisher.wait_for_all_acked(Duration(seconds=60.0))
        assert g.finish('recorder/stop')['state'] == 'done'
    got = contents(tmp_path / 'bag')
    assert set(got) == {'/voltage', '/lab/drive', '/else/pose'}
    assert len(got['/lab/drive']) == len(got['/else/pose']) == 1
    with opened_bag(tmp_path / 'bag') as bag:
        types = {c.topic: c.msgtype for c in bag.connections}
        assert types['/else/pose'] == 'sensor_msgs/msg/JointState'
        (qos,) = next(c for c in bag.connections if c.topic == '/voltage').ext.offered_qos_profiles
        assert qos.reliability.name == 'BEST_EFFORT'

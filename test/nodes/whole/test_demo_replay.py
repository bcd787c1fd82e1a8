# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The bag of the demo is what was on the wire, and a model predicts the same from it anywhere."""

import math
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from layouts import messages_of
import piezo_ident as pi
from piezo_ident.model.estimate import observe
from processes import take_domain

ROOT = Path(__file__).resolve().parents[3]
MOTIONS = """
limits: [0, 10]
sample_rate: 20000
slew: 200
segments:
  - {signal: sine, bias: 5, amplitude: 5, frequency: 20, duration: 0.3}
"""


class Said:
    """Keeps what the demo says."""

    def __init__(self):
        self.lines = []

    def show(self, step, share):
        assert 0.0 <= share <= 1.0

    def say(self, text):
        self.lines.append(text)


@pytest.fixture(scope='module')
def demo(tmp_path_factory):
    """Return the demo's lab after a short recording and its replay, and what both returned."""
    out = tmp_path_factory.mktemp('demo')
    model, motions = out / 'model.yaml', out / 'motions.yaml'
    motions.write_text(MOTIONS)
    domain, lock = take_domain()
    with lock, pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_DOMAIN_ID', str(domain))
        patch.setenv('ROS_LOG_DIR', str(out / 'log'))
        patch.syspath_prepend(str(ROOT / 'examples'))
        import demo_graph
        from lab_graph import Client, Nodes

        pi.SimulatedStage.load(demo_graph.STAGE).model.save(model)
        with Nodes(out / 'log') as nodes, Client('demo') as client:
            lab = demo_graph.Lab(nodes, client, out, Said())
            lab.start_nodes(
                {
                    'stage': {'stage': demo_graph.STAGE, 'silence': 30.0},
                    'model': {'model': str(model)},
                    'recorder': {},
                    'excitation': {'subscribers': 2, 'wait_limit': demo_graph.PATIENT},
                }
            )
            lab.start_replay()
            recording = lab.without_loss(lambda: lab.play('motions', 'after', motions))
            recorded = lab.replay(recording, model)
            codes = nodes.stop()
        yield lab, recording, recorded, codes


def test_the_bag_is_the_wire_and_the_free_run_is_the_same_live_replayed_and_offline(demo):
    lab, recording, recorded, codes = demo
    assert set(codes.values()) == {0}
    n = pi.read(recorded.bag).n
    assert n >= 0.3 * 20_000
    assert recording.motion.t.size == n
    assert list(recorded.blocks) == ['/voltage', '/displacement', '/applied_voltage']
    assert {row[1:] for row in recorded.blocks.values()} == {(n, True)}
    assert sorted(recorded.differences) == ['live and offline', 'live and replayed']
    assert max(recorded.differences.values()) <= 1e-12
    assert recorded.problems == []
    # the stage is its own model: noise is left, and creep where the machine was too busy at first
    assert np.std(recording.motion.residual) < 1e-6
    assert np.mean(np.isfinite(recording.motion.estimate)) > 0.9
    assert np.nanstd(recording.motion.left) < 1e-6
    # and so is the estimate
    (piece,) = pi.read(recorded.bag)
    offline = observe(pi.load(recorded.model), piece).estimate
    assert np.nanmax(np.abs(recording.motion.estimate - offline)) <= 1e-12 * recorded.stroke
    assert recorded.verdict in lab.progress.lines[-1]
    assert 'of stroke' in recorded.verdict
    # by default the recorder keeps what the model says
    kept = {topic for topic, _ in messages_of(recorded.bag)}
    assert {'/prediction', '/residual', '/estimate', '/corrections'} <= kept
    # what was asked can be asked again
    assert 'ros2 service call /recorder/start std_srvs/srv/Trigger' in recorded.commands


def test_a_block_that_differs_and_a_run_that_differs_are_told(demo):
    lab, recording, recorded, _ = demo
    import demo_graph

    live = demo_graph.rows_of(recording.blocks['/prediction'])
    other = np.column_stack((live[:, 0], live[:, 1] + 2e-12 * recorded.stroke))
    differences = lab._differences(recording, other, recorded.model)
    assert differences['live and replayed'] == pytest.approx(2e-12, rel=0.01)
    assert lab._differences(recording, live[:-1], recorded.model)['live and replayed'] == math.inf
    lab.wire.blocks['/displacement'][3] = lab.wire.blocks['/displacement'][4]
    again = lab._recording(recorded.bag, pi.read(recorded.bag).n)
    assert again.lost == ''
    assert again.equal == {'/voltage': True, '/displacement': False, '/applied_voltage': True}


def test_what_is_heard_is_taken_while_anything_is_waited_for(demo):
    lab, *_ = demo

    class Heard:
        taken = 0

        def take(self):
            self.taken += 1

    # of the recording and of its replay: a subscription keeps five seconds of blocks
    assert len(lab.wires) == 2
    heard, looks = Heard(), iter(range(3))
    lab.wires[:] = [heard, heard]
    lab.wait(lambda: next(looks) == 2, 'the third look')
    assert heard.taken == 4


def test_a_graph_that_hangs_ends_with_a_sentence(demo, monkeypatch):
    import lab_graph

    lab, *_ = demo
    monkeypatch.setattr(lab_graph, 'STILL', 0.2)
    with pytest.raises(pi.PiezoIdentError, match=r'ages: nothing has changed for 0\.2 s: .*stage'):
        lab.wait(lambda: False, 'ages')

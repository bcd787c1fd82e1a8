# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage of two axes that changed, on the graph: one axis creeps, one moves 3 % more."""

import itertools
import re

from axes_scanner import answer, AXES, creeping, grown, moving, RATE
from graph import Graph
import numpy as np
import piezo_ident as pi
from piezo_ident.model.axes_file import text_of
from piezo_ident.record.blocks import Samples
from processes import WORK
import pytest

SIZE, N = 200, 12_000
T = np.arange(N) / RATE


@pytest.fixture
def lab():
    with Graph() as g:
        yield g


def test_the_model_node_learns_each_axis_and_saves_one_model(lab, tmp_path):
    model, path = creeping(), tmp_path / 'learnt.yaml'
    v = np.stack([5.0 - 5.0 * np.cos(2 * np.pi * f * T) for f in (5.0, 0.7)])
    y = answer(grown(model, 'y_b'), v, earlier=10.0)
    estimates = {tail: lab.collect(f'estimate{tail}') for tail in ('', '_b')}
    options = {'axes': ['b'], 'adapt': 'gain', 'output': str(path), 'window': 3.0}
    lab.start('model', options)
    for tail in estimates:
        lab.matched(f'estimate{tail}')
    lab.publish_text('model', text_of(model))
    lab.wait(lambda: lab.status('model')['state'] == 'predicting', 'the model')
    for k in range(0, N, SIZE):
        cut = slice(k, k + SIZE)
        # the block of the first axis waits for nobody whom the node has not met
        for i, tail in reversed([*enumerate(estimates)]):
            for topic, x in ((f'voltage{tail}', v), (f'displacement{tail}', y)):
                lab.publish(topic, Samples(T[cut], x[i, cut], 'scan', topic))
        # without a sensor for half a second the estimate goes on alone
        for heard in estimates.values():
            lab.wait(lambda heard=heard, t=T[cut][-1]: heard and heard[-1].t[-1] == t, 'estimates')
    for i, heard in enumerate(estimates.values()):
        left = np.concatenate([b.values for b in heard[-5:]]) - y[i, -5 * SIZE :]
        assert np.sqrt(np.mean(left**2)) < 5e-4 * model.axes[AXES[i]].scaling.Y
    lab.wait(lambda: 'learnt/gain_b' in lab.diagnostics('model'), 'what was learnt')
    told = lab.diagnostics('model')
    assert float(told['learnt/gain_b']) == pytest.approx(0.03, abs=2e-3)
    assert abs(float(told['learnt/gain'])) < 2e-3

    ok, said = lab.call('model/save')
    assert ok, said
    learnt = pi.load(path)
    for axis, gain in zip(AXES, (1.0, 1.03), strict=True):
        before, after = (m.axes[axis].hysteresis.p2 for m in (model, learnt))
        assert after == pytest.approx(gain * before, rel=2e-3)
    ok, said = lab.call('model/restore')
    assert ok and 'y: ' in said and 'y_b: ' in said, said


class Answering:
    """Plays a stage of two axes that answers each block of its voltages."""

    def __init__(self, lab):
        self.lab, self.run = lab, moving(grown(creeping(), 'y_b'), earlier=10.0)
        self.sent = {tail: lab.collect(f'voltage{tail}') for tail in ('', '_b')}
        self.v, self.y, self.next = np.empty((2, 0)), np.empty((2, 0)), 0

    def __call__(self):
        """Answer what has come on both axes."""
        while all(len(blocks) > self.next for blocks in self.sent.values()):
            blocks = [blocks[self.next] for blocks in self.sent.values()]
            self.next += 1
            t, v = blocks[0].t, np.stack([block.values for block in blocks])
            assert (t == blocks[1].t).all()
            y = self.run.process(v, t)
            self.v, self.y = np.hstack([self.v, v]), np.hstack([self.y, y])
            for tail, row in zip(self.sent, y, strict=True):
                topic = f'displacement{tail}'
                self.lab.publish(topic, Samples(t, row, blocks[0].segment, topic))


def driving(lab, tmp_path, **options):
    """Start a feedforward node with the model of both axes; return the stage."""
    stage, path = Answering(lab), tmp_path / 'model.yaml'
    creeping().save(path)
    options = {'axes': ['b'], 'sample_rate': RATE, 'model': str(path), **options}
    lab.start('feedforward', {'preview': 0.06, 'ramp_slew': 200.0, 'silence': 2.0, **options})
    lab.wait(lambda: lab.status('feedforward').get('models') == '1', 'the model')
    return stage


def scan(lab, stage, wanted, size=50):
    """Have the node follow a motion of both axes [m], a row each."""
    assert lab.call('feedforward/start')[0]
    lab.until('feedforward', 'ready')
    for k in range(0, wanted.shape[1], size):
        t = np.arange(k, k + size) / RATE
        for tail, row in reversed([*zip(stage.sent, wanted, strict=True)]):
            topic = f'reference{tail}'
            lab.publish(topic, Samples(t, row[k : k + size], 'scan', topic))
        lab.wait(lambda n=k + size: stage.y.shape[1] >= n, 'the voltages', meanwhile=stage)


def test_the_feedforward_node_follows_each_axis(lab, tmp_path):
    # the test ends it
    stage = driving(lab, tmp_path, follow='gain', silence=600.0)
    t = np.arange(6000) / RATE
    waves = np.stack([np.cos(2 * np.pi * f * t) for f in (3.0, 1.5)])
    wanted = np.array([[20e-6], [15e-6]]) * (1.0 - 0.8 * waves)
    scan(lab, stage, wanted)
    error = stage.y[:, 4000:6000] - wanted[:, 3940:5940]
    assert (np.sqrt(np.mean(error**2, axis=1)) < 1e-3 * np.ptp(wanted, axis=1)).all()
    told = len(lab.diagnoses('feedforward'))
    # of two, the later one is of the whole scan
    lab.wait(lambda: len(lab.diagnoses('feedforward')) > told + 1, 'the gain')
    assert float(lab.diagnostics('feedforward')['gain/value_b']) == pytest.approx(0.03, abs=2e-3)
    assert lab.call('feedforward/stop')[0]
    lab.wait(lambda: not stage.v.size or (stage.v[:, -1] == 0.0).all(), 'rest', meanwhile=stage)
    lab.until('feedforward', 'stopped')


def test_a_motion_of_both_axes_is_repeated_and_learnt(lab, tmp_path):
    stage = driving(lab, tmp_path, repetitions=3)
    t = np.arange(1000) / RATE
    waves = np.stack([np.cos(2 * np.pi * f * t) for f in (3.0, 2.0)])
    scan(lab, stage, np.array([[20e-6], [15e-6]]) * (1.0 - 0.8 * waves))

    def done(state, since=0):
        """Return the ends told behind a state; those of a state before may come late."""
        told = lab.statuses('feedforward')[since:]
        behind = itertools.dropwhile(lambda s: s['state'] != state, told)
        return [s for s in behind if s['state'] in ('done', 'failed')]

    lab.wait(lambda: done('tracking'), 'the end of the reference', meanwhile=stage)
    since, sent = len(lab.statuses('feedforward')), stage.v.shape[1]
    ok, said = lab.call('feedforward/learn')
    assert ok and '1 s, is repeated' in said, said
    lab.wait(lambda: done('learning', since), 'the end of learning', WORK, meanwhile=stage)
    told = done('learning', since)[0]['text']
    best, first = (float(x) for x in re.findall(r'([0-9.e-]+) %? ?(?:of|in)', told))
    assert first > 1.0 and best < 0.1 * first, told
    v = stage.v[:, sent:]
    assert (np.ptp(v, axis=1) > 2.0).all() and v.min() >= 0.0 and v.max() <= 10.0
    assert (v[:, -1] == 0.0).all()
    assert np.abs(np.diff(v, axis=1)).max() * RATE <= 40e3 * (1 + 1e-9)

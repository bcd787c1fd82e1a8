# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage of two axes that changed, on the graph: one axis creeps, one moves 3 % more."""

from axes_scanner import answer, AXES, creeping, grown, RATE
from graph import Graph
import numpy as np
import piezo_ident as pi
from piezo_ident.model.axes_file import text_of
from piezo_ident.record.blocks import Samples
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

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage of two axes on the graph: driven, recorded, identified by a service call."""

import json

from graph import Graph
import numpy as np
import piezo_ident as pi
from piezo_ident.axes.model_text import axes_model_from_text
from piezo_ident.common.errors import ModelError
from piezo_ident.common.files import parse_yaml
from piezo_ident.model.files import model_from_dict
import pytest

PROGRAM = """
limits: [0, 10]
slew: 400
segments:
  - signal: multisine
    name: small
    bias: 5
    amplitude: 1.5
    lowest: 1
    highest: 800
    lines: all
    period: 0.512
    periods: 2
    realisations: 3
  - signal: multisine
    name: large
    bias: 5
    amplitude: 4
    lowest: 1
    highest: 800
    lines: all
    period: 0.512
    periods: 2
    realisations: 3
"""
TOPICS = ['voltage_b', 'displacement_b']
RATE = 2000.0


@pytest.fixture(scope='module')
def lab():
    with Graph() as g:
        g.texts('model')
        g.texts('report')
        g.start_all(
            ('stage', {'stage': 'two_axes', 'seed': 3, 'silence': 2.0}),
            ('identifier', {'channels': TOPICS, 'program': PROGRAM}),
            (
                'excitation',
                {
                    'axes': ['b'],
                    'program': PROGRAM,
                    'sample_rate': RATE,
                    'rate_factor': 4.0,
                    'subscribers': 2,
                },
            ),
            ('recorder', {'topics': ['voltage', 'displacement', *TOPICS], 'sample_rate': RATE}),
        )
        yield g


def test_a_service_call_identifies_both_axes(lab, tmp_path):
    assert lab.set('recorder', 'output', str(tmp_path / 'bag'))[0]
    assert lab.call('recorder/start')[0]
    lab.until('recorder', 'recording')
    end = lab.finish('identifier/run_axes')
    assert end['state'] == 'done', end['text']
    assert end['effect'] in ('loop_hysteresis', 'hysteretic_stiffness'), end['text']
    # in free run on the realisations held out
    assert float(end['error_percent']) < 0.5 * float(end['linear_percent'])
    assert f'{end["error_percent"]} %' in end['text']
    lab.wait(lambda: lab.texts('model'), 'the model')
    held = axes_model_from_text(lab.texts('model')[-1])
    assert (held.inputs, held.outputs) == (('v', 'v_b'), ('y', 'y_b'))
    assert held.model.radius < 1 and held.error_percent == pytest.approx(
        float(end['error_percent']), rel=5e-3
    )
    report = json.loads(lab.texts('report')[-1])['several_axes']
    assert {c['name'] for c in report['candidates']} >= {'linear', held.effect}
    # the stage did not lose or alter anything
    stage = lab.diagnostics('stage')
    assert (stage['lost'], stage['missing'], stage['altered_too_fast']) == ('0', '0', '0')
    # a node that takes one axis says so
    with pytest.raises(ModelError, match='a model of several axes'):
        model_from_dict(parse_yaml(lab.texts('model')[-1], 'model'))

    lab.finish('recorder/stop')
    axes = pi.Axes.of(pi.read(tmp_path / 'bag').pieces[0])
    assert axes.outputs.shape[1] == 2 and axes.sample_rate == RATE
    again = pi.TwoAxisStage.load('two_axes').run(np.random.default_rng(3)).process(axes.inputs)
    np.testing.assert_array_equal(axes.outputs, again)

    assert lab.set('identifier', 'output', str(tmp_path / 'out'))[0]
    assert lab.finish('identifier/save')['state'] == 'done'
    assert (tmp_path / 'out' / 'axes_model.yaml').read_text() == lab.texts('model')[-1]


def test_an_axis_that_nobody_drives_rests_and_a_stop_ramps_both(lab):
    applied = [lab.collect(topic) for topic in ('applied_voltage', 'applied_voltage_b')]
    seen = len(lab.statuses('excitation'))
    assert lab.call('excitation/start')[0]
    lab.wait(
        lambda: any(s['state'] == 'running' for s in lab.statuses('excitation')[seen:]), 'a start'
    )
    lab.wait(lambda: len(applied[1]) > 10, 'voltages')
    assert lab.call('excitation/stop')[0]
    lab.until('excitation', 'stopped', since=seen)
    for blocks in applied:
        lab.wait(lambda blocks=blocks: blocks and blocks[-1].values[-1] == 0.0, 'rest')

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage of two axes on the graph: driven, recorded, identified by a service call."""

import json

from graph import Graph
import numpy as np
import piezo_ident as pi
from piezo_ident.common.errors import ModelError
from piezo_ident.common.files import parse_yaml
from piezo_ident.model.files import model_from_dict
from piezo_ident.record.blocks import Samples
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
    text = lab.texts('model')[-1]
    (tmp_path / 'axes_model.yaml').write_text(text)
    held = pi.AxesModel.load(tmp_path / 'axes_model.yaml')
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
        model_from_dict(parse_yaml(text, 'model'))

    lab.finish('recorder/stop')
    axes = pi.Axes.of(pi.read(tmp_path / 'bag').pieces[0])
    assert axes.outputs.shape[1] == 2 and axes.sample_rate == RATE
    again = pi.TwoAxisStage.load('two_axes').run(np.random.default_rng(3)).process(axes.inputs)
    np.testing.assert_array_equal(axes.outputs, again)

    assert lab.set('identifier', 'output', str(tmp_path / 'out'))[0]
    assert lab.finish('identifier/save')['state'] == 'done'
    assert (tmp_path / 'out' / 'axes_model.yaml').read_text() == lab.texts('model')[-1]


def test_a_stop_ramps_both_axes(lab):
    applied = [lab.collect(topic) for topic in ('applied_voltage', 'applied_voltage_b')]
    seen = len(lab.statuses('excitation'))
    assert lab.call('excitation/start')[0]
    lab.until('excitation', 'running', since=seen)
    lab.wait(lambda: len(applied[1]) > 10, 'voltages')
    assert lab.call('excitation/stop')[0]
    lab.until('excitation', 'stopped', since=seen)
    for blocks in applied:
        assert max(block.values.max() for block in blocks) > 1.0
        lab.wait(lambda blocks=blocks: blocks[-1].values[-1] == 0.0, 'rest')


def test_an_axis_that_nobody_drives_rests(lab):
    lab.wait(lambda: lab.status('stage')['state'] == 'idle', 'a stage at rest')
    moved = [lab.collect(topic) for topic in ('displacement', 'displacement_b')]
    applied = lab.collect('applied_voltage_b')
    seen = len(moved[0]), len(applied)
    t = np.arange(200) / RATE
    lab.publish('voltage', Samples(t, 900 * t**2, 'alone', 'voltage'))
    lab.wait(lambda: len(moved[0]) > seen[0], 'the first axis')
    assert moved[0][-1].segment == 'alone' and np.ptp(moved[0][-1].values) > 1e-6
    lab.wait(lambda: len(applied) > seen[1], 'the second axis')
    assert not applied[seen[1]].values.any()
    # the first one pulls at it all the same
    lab.wait(lambda: moved[1][-1].segment == 'alone', 'the second axis')
    assert np.ptp(moved[1][-1].values) > 1e-7
    assert lab.diagnostics('stage')['missing'] == '0'

    # the block of the second axis comes first, and then none
    ahead, later = t + t.size / RATE, t + 2 * t.size / RATE
    lab.publish('voltage_b', Samples(ahead, 1000 * t**2, 'both', 'voltage_b'))
    for times in (ahead, later):
        lab.publish('voltage', Samples(times, np.full(t.size, 8.9), 'both', 'voltage'))
    lab.wait(lambda: moved[0][-1].t[-1] == later[-1], 'all blocks')
    lab.wait(lambda: lab.diagnostics('stage')['missing'] == '200', 'what is missing')
    held = [block for block in applied if block.segment == 'both']
    assert held[0].values[-1] > 9.8 and (held[-1].values == held[0].values[-1]).all()


def test_a_unit_is_no_name_of_an_axis():
    with Graph() as g:
        handle = g.start('excitation', {'axes': ['um']}, wait=False)
        assert handle.process.wait(60) == 2
        assert "axes: 'um' cannot be the name of an axis" in handle.log

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage of two axes on the graph: driven, recorded, identified by a service call."""

from dataclasses import replace
from functools import partial
import json

from course import column
from graph import Graph
import numpy as np
import piezo_ident as pi
from piezo_ident.excitation.program import parse_program
from piezo_ident.model.modes.modal import Modal
from piezo_ident.model.modes.shared_modes import SharedModes
from piezo_ident.nodes.wire import STREAM
from piezo_ident.record.blocks import cut_blocks, Samples
from programs import identification_program
import pytest
from random_models import brittle_modes, random_shared_modes
from std_msgs.msg import Float64MultiArray

RATE = 2000.0
#: what every axis plays alone
PROGRAM = identification_program(
    rate=RATE, slew=400, steps=8, cycles=8, frequency=20, cutoff=800, noise=1, slope=40
)
#: what all axes play at once, each its own
BOTH = """
limits: [0, 10]
slew: 400
segments:
  - {signal: multisine, bias: 5, amplitude: 4, lowest: 1, highest: 100, period: 0.5, periods: 2}
"""
TOPICS = ['voltage_b', 'displacement_b']
AXES = {'axes': ['b']}
#: a pause that a busy machine does not reach [s]
PATIENT = {'silence': 2.0}
#: as little work as shows two axes
QUICK = {'thresholds': 4, 'max_order': 2, 'nice': 0}


@pytest.fixture(scope='module')
def lab():
    with Graph() as g:
        g.texts('model')
        g.texts('report')
        g.start_all(
            ('stage', {'stage': 'two_axes', 'seed': 3, 'silence': 2.0}),
            ('identifier', {**AXES, **QUICK, 'program': PROGRAM}),
            ('model', AXES),
            (
                'excitation',
                {
                    **AXES,
                    'program': BOTH,
                    'sample_rate': RATE,
                    'rate_factor': 4.0,
                    'subscribers': 3,
                },
            ),
            ('recorder', {'topics': ['voltage', 'displacement', *TOPICS], 'sample_rate': RATE}),
        )
        yield g


@pytest.fixture(scope='module')
def sent_at(lab):
    """Return when each block of both voltages was sent last [ns], by its first time."""
    sent = {'voltage': {}, 'voltage_b': {}}

    def keep(topic, message, info):
        sent[topic][message.data[0]] = info['source_timestamp']

    for topic in sent:
        lab.node.create_subscription(Float64MultiArray, topic, partial(keep, topic), STREAM)
        lab.matched(topic)
    return sent


@pytest.fixture(scope='module')
def identified(lab, tmp_path_factory):
    """Return the end of a run in which the axes move one after the other, and its folder."""
    folder = tmp_path_factory.mktemp('run')
    assert lab.set('recorder', 'output', str(folder / 'bag'))[0]
    assert lab.call('recorder/start')[0]
    lab.until('recorder', 'recording')
    assert lab.set('excitation', 'in_turn', True)[0]
    # two axes are as much work as two runs
    end = lab.finish('identifier/run')
    assert end['state'] == 'done', end['text']
    assert lab.set('excitation', 'in_turn', False)[0]
    lab.finish('recorder/stop')
    lab.wait(lambda: lab.texts('model'), 'the model')
    (folder / 'model.yaml').write_text(lab.texts('model')[-1])
    return end, folder


def test_a_run_identifies_both_axes(lab, identified):
    end, folder = identified
    model = pi.load(folder / 'model.yaml')
    assert list(model.axes) == ['y', 'y_b'] and model.sample_rate == RATE
    report = json.loads(lab.texts('report')[-1])['axes']
    assert list(report) == ['y', 'y_b']
    # the loop of this stage is not in front of its mechanics, so the chains fit roughly
    for tail in ('', '_b'):
        assert float(end[f'error_percent{tail}']) < 15.0, end['text']
    # the stage did not lose or alter anything
    stage = lab.diagnostics('stage')
    assert (stage['lost'], stage['missing'], stage['altered_too_fast']) == ('0', '0', '0')
    inputs = pi.Axes.of(pi.read(folder / 'bag').pieces[0]).inputs
    # one after the other
    assert not (np.ptp(inputs, axis=0) == 0.0).any() and (inputs.min(axis=1) == 0.0).all()

    ok, reason = lab.call('identifier/identify_delay')
    assert not ok and 'one axis' in reason


@pytest.mark.parametrize('shares_modes', [False, True])
def test_the_live_prediction_is_the_free_run(lab, identified, shares_modes):
    path = identified[1] / 'model.yaml'
    model = pi.load(path)
    if shares_modes:
        modes = random_shared_modes(np.random.default_rng(1))
        model, path = pi.MultiAxisModel(model.axes, modes), identified[1] / 'modes.yaml'
        model.save(path)
    # the tests of this file may come in any order
    assert lab.set('model', 'model', str(path))[0]
    lab.wait(lambda: path.name in lab.status('model')['text'], 'the model')
    if shares_modes:
        ok, reason = lab.set('model', 'adapt', 'hysteresis')
        assert not ok and 'adapt: the hysteresis of modes' in reason
        assert lab.set('model', 'adapt', 'gain')[0]
    lab.wait(lambda: lab.status('model')['state'] == 'predicting', 'a model')
    lab.wait(lambda: lab.status('stage')['state'] == 'idle', 'a stage at rest')
    # of the paths there are none yet; the last figures of a path are of the test of `AxesRun`
    topics = [f'{what}{tail}' for tail in ('', '_b') for what in ('voltage', 'prediction')]
    heard = {topic: lab.collect(topic) for topic in (*topics, 'residual_b', 'estimate_b')}
    begin = {topic: len(blocks) for topic, blocks in heard.items()}
    assert lab.finish('excitation/start')['state'] == 'done'

    def stream(topic):
        """Return the last stream in one piece; the end of the one before may come late."""
        t, values = column(heard[topic][begin[topic] :])
        first = np.flatnonzero(np.diff(t, prepend=np.inf) < 0.0)[-1]
        return t[first:], values[first:]

    n = parse_program(BOTH).build(RATE).n
    for topic in topics:
        lab.wait(
            lambda topic=topic: (
                heard[topic][begin[topic] :]
                and stream(topic)[0].size >= n
                and np.array_equal(stream(topic)[0], stream('voltage')[0])
            ),
            topic,
        )
    whole = {topic: stream(topic)[1] for topic in topics}
    y = model.simulate({'v': whole['voltage'], 'v_b': whole['voltage_b']})
    for axis, tail in (('y', ''), ('y_b', '_b')):
        miss = np.abs(whole[f'prediction{tail}'] - y[axis]).max()
        assert miss <= (0.0 if shares_modes else 1e-12) * np.ptp(y[axis])
    assert not np.array_equal(whole['voltage'], whole['voltage_b'])
    lab.wait(lambda: heard['residual_b'] and heard['estimate_b'], 'residual and estimate')
    lab.wait(lambda: 'residual_percent_b' in lab.diagnostics('model'), 'the error of the axis')
    if shares_modes:
        learnt = identified[1] / 'learnt.yaml'
        assert lab.set('model', 'output', str(learnt))[0]
        assert lab.call('model/save')[0]
        assert pi.load(learnt).modes is not None
        assert lab.set('model', 'adapt', 'off')[0]


def test_the_block_of_the_first_axis_is_sent_last(lab, sent_at):
    for times in sent_at.values():
        times.clear()
    lab.wait(lambda: lab.status('stage')['state'] == 'idle', 'a stage at rest')
    assert lab.finish('excitation/start')['state'] == 'done'
    played = parse_program(BOTH).build(RATE)
    blocks = len([*cut_blocks(played.n, played.segments, 100)])
    lab.wait(lambda: all(len(times) == blocks for times in sent_at.values()), 'all blocks')
    assert is_sent_last(sent_at)


def is_sent_last(sent_at):
    """Return whether a sender that is stopped between two blocks of one time lets nobody wait."""
    first, second = sent_at.values()
    both = first.keys() & second.keys()
    return bool(both) and all(second[t] < first[t] for t in both)


def test_a_model_of_other_axes_is_refused(lab, identified):
    alone = identified[1] / 'alone.yaml'
    pi.load(identified[1] / 'model.yaml').axes['y'].save(alone)
    assert lab.set('model', 'model', str(alone))[0]
    lab.wait(lambda: 'y, y_b' in lab.status('model')['text'], 'the refusal')
    assert 'the old model is kept' in lab.status('model')['text']


def lagging(model):
    """Return a model of the same span with shared modes, which lag by two samples."""
    spans = [x.scaling for x in model.axes.values()]
    gains = np.diag([s.Y / s.V for s in spans])
    linear = Modal(np.array([np.diag([0.5, 0.5])]), 0.5 * np.eye(2), gains, np.zeros((2, 2)))
    modes = replace(
        SharedModes.of(linear),
        v0=np.array([s.v0 for s in spans]),
        y0=np.array([s.y0 for s in spans]),
    )
    return pi.MultiAxisModel(model.axes, modes)


@pytest.mark.parametrize('shares_modes', [False, True])
def test_both_axes_follow_their_references(lab, identified, sent_at, shares_modes):
    path = identified[1] / 'model.yaml'
    spans = {axis: x.scaling for axis, x in pi.load(path).axes.items()}
    if shares_modes:
        model, path = lagging(pi.load(path)), identified[1] / 'lagging.yaml'
        model.save(path)
    params = {**AXES, **PATIENT, 'sample_rate': RATE, 'model': str(path), 'slew': 1000.0}
    lab.start('feedforward', params)
    sent = [lab.collect(topic) for topic in ('voltage', 'voltage_b')]
    errors, begin = lab.collect('tracking_error_b'), [len(blocks) for blocks in sent]
    # until then the stage follows the excitation
    lab.wait(lambda: lab.status('stage')['state'] == 'idle', 'a stage at rest')
    for times in sent_at.values():
        times.clear()
    seen = len(lab.statuses('feedforward'))
    assert lab.call('feedforward/start')[0]
    lab.until('feedforward', 'ready', since=seen)
    t = np.arange(2400) / RATE
    soft = 0.5 - 0.5 * np.cos(np.pi * np.minimum(t / 0.3, 1.0))
    for k in range(0, t.size, 100):
        cut = slice(k, k + 100)
        # a block of the first axis waits for the other for 0.2 s alone
        for tail, f in (('_b', 2.0), ('', 5.0)):
            s = spans[f'y{tail}']
            x = s.y0 + s.Y * soft[cut] * (0.4 - 0.2 * np.cos(2 * np.pi * f * t[cut]))
            lab.publish(f'reference{tail}', Samples(t[cut], x, 'scan', f'reference{tail}'))
    lab.until('feedforward', 'done', since=seen)
    told = lab.status('feedforward')['text']
    assert 'refused' not in told and 'missing' not in told, told
    lab.wait(lambda: all(blocks[-1].values[-1] == 0.0 for blocks in sent), 'rest')
    assert is_sent_last(sent_at)
    first, second = (
        np.concatenate([block.values for block in blocks[start:]])
        for blocks, start in zip(sent, begin, strict=True)
    )
    for v in (first, second):
        assert 2.0 < np.ptp(v) and v.min() >= 0.0 and v.max() <= 10.0
        assert np.abs(np.diff(v)).max() * RATE <= 1000.0 * (1 + 1e-9)
    lab.wait(lambda: errors, 'the tracking error')
    # as roughly as the chains fit this stage
    error = lambda: float(lab.status('feedforward').get('tracking_percent_b', 'inf'))  # noqa: E731
    lab.wait(lambda: error() < 25.0, 'its figure')
    # the model of the topic, which came while it drove or before, is not lost
    assert lab.status('feedforward')['models'] in ('1', '2')
    assert lab.call('feedforward/start')[0]
    lab.wait(lambda: lab.status('feedforward')['models'] == '2', 'the model of the topic')
    lab.handle('feedforward').stop()
    for topic in ('reference', 'reference_b'):
        lab.unpublish(topic)


def test_modes_that_run_away_end_the_drive_at_rest(lab, identified):
    path, sent = identified[1] / 'brittle.yaml', lab.collect('voltage')
    brittle_modes(pi.load(identified[1] / 'model.yaml')).save(path)
    limits = {'voltage_high': 11.0, 'slew': 1000.0, 'ramp_slew': 200.0}
    # the model of the identifier would replace that of the file
    own = {'model': 'no_model'}
    params = {**AXES, **PATIENT, 'sample_rate': RATE, 'model': str(path), **limits}
    lab.start('feedforward', params, remaps=own)
    lab.wait(lambda: lab.status('stage')['state'] == 'idle', 'a stage at rest')
    seen = len(lab.statuses('feedforward'))
    assert lab.call('feedforward/start')[0]
    lab.until('feedforward', 'ready', since=seen)
    t = np.arange(2000) / RATE
    for k in range(0, t.size, 100):
        cut = slice(k, k + 100)
        for tail in ('_b', ''):
            x = 1e-5 + 2e-5 * t[cut]
            lab.publish(f'reference{tail}', Samples(t[cut], x, 'scan', f'reference{tail}'))
    assert 'run away' in lab.until('feedforward', 'failed', since=seen)['text']
    lab.wait(lambda: sent[-1].values[-1] == 0.0, 'rest')
    lab.handle('feedforward').stop()
    for topic in ('reference', 'reference_b'):
        lab.unpublish(topic)


def test_a_stop_ramps_both_axes(lab):
    applied = [lab.collect(topic) for topic in ('applied_voltage', 'applied_voltage_b')]
    assert lab.set('excitation', 'program', BOTH.replace('periods: 2', 'periods: 200'))[0]
    # a busy machine does not keep up with a long program that is faster
    assert lab.set('excitation', 'rate_factor', 1.0)[0]
    seen = len(lab.statuses('excitation'))
    assert lab.call('excitation/start')[0]
    lab.until('excitation', 'running', since=seen)
    lab.wait(lambda: len(applied[1]) > 10, 'voltages')
    ok, said = lab.call('excitation/stop')
    assert ok, said
    lab.until('excitation', 'stopped', since=seen)
    for blocks in applied:
        assert max(block.values.max() for block in blocks) > 1.0
        lab.wait(lambda blocks=blocks: blocks[-1].values[-1] == 0.0, 'rest')


def test_an_axis_that_nobody_drives_rests(lab):
    lab.wait(lambda: lab.status('stage')['state'] == 'idle', 'a stage at rest')
    # all blocks are of one stream, however long the test takes between them
    assert lab.set('stage', 'silence', 600.0)[0]
    try:
        drive_alone(lab)
    finally:
        assert lab.set('stage', 'silence', 2.0)[0]


def drive_alone(lab):
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

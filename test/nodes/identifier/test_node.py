# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The identifier as a process: what it captures, refuses, identifies, cancels and writes."""

from collections import deque
import json
import os
from pathlib import Path
import threading
import time
from types import SimpleNamespace

from course import first_of, model_of, numbers, pairs_of, QUICK, SETTINGS, simulated
from graph import Graph, in_time
import numpy as np
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.nodes.identifier.node import IdentifierNode
from piezo_ident.nodes.wire import LATCHED, to_message
from piezo_ident.record.blocks import Samples
import pytest
from std_msgs.msg import String


@pytest.fixture(scope='module')
def record():
    return simulated()


@pytest.fixture(scope='module')
def blocks(record):
    """(voltage, displacement) of each block."""
    return pairs_of(record)


def test_the_status_tells_the_end_of_work_after_any_fault(monkeypatch):
    def fails(*_):
        raise ValueError('unforeseen')

    node, told = IdentifierNode.__new__(IdentifierNode), []
    node.fail, node.reason = told.append, str
    node._worker, node._outcomes = SimpleNamespace(join=lambda _: True), deque([fails])
    node._take_outcomes()
    monkeypatch.setattr(IdentifierNode, '_identify', fails)
    node._run_ended(None)
    assert told == ['unforeseen'] * 2 and not node._outcomes


@pytest.fixture(scope='module')
def lab():
    with Graph() as g:
        g.texts('model')
        g.texts('report')
        g.start('identifier', {**QUICK, 'channels': ['temperature']})
        yield g


def state(g):
    return g.status('identifier')['state']


def captured(g, **seconds):
    """Wait until the identifier says that it has this much of each topic."""
    text = ', '.join(f'{s:.3f} s of {key}' for key, s in seconds.items()) + ' captured'
    g.wait(lambda: g.status('identifier')['text'].split(';')[0] == text, text)


def feed(g, pairs):
    """Send blocks to an identifier that is idle, and wait until it has them."""
    n = {'voltage': 0, 'displacement': 0}
    for pair in pairs:
        for topic, block in zip(n, pair, strict=True):
            if block is None:
                continue
            g.publish(topic, block)
            if isinstance(block, Samples) and block.quantity == topic:
                n[topic] += block.t.size
        # all at once would not fit into the middleware's shared memory
        time.sleep(0.002)
    captured(g, **{topic: x / 20_000 for topic, x in n.items()})


@pytest.fixture
def empty(lab):
    """Return the graph with an identifier that is at rest and has captured nothing."""
    lab.call('identifier/cancel')
    lab.wait(lambda: state(lab) not in ('identifying', 'saving', 'exciting'), 'rest')
    assert lab.call('identifier/clear')[0]
    for name, value in {**SETTINGS, 'seed': 0, 'capture_limit': 600.0}.items():
        assert lab.set('identifier', name, value) == (True, '')
    return lab


@pytest.fixture
def fed(empty, blocks):
    feed(empty, blocks)
    return empty


def made(g, service='identifier/identify'):
    """Have a model made, wait until it has come with its report, and return the status."""
    models, reports = len(g.texts('model')), len(g.texts('report'))
    end = g.finish(service)
    assert end['state'] == 'done', end
    g.wait(
        lambda: len(g.texts('model')) > models and len(g.texts('report')) > reports,
        'model and report',
    )
    return end


def test_what_cannot_be_done_is_refused_with_the_reason(empty):
    for step in ('identify', 'identify_delay', 'identify_dynamics', 'identify_hysteresis'):
        ok, reason = empty.call(f'identifier/{step}')
        assert not ok and '~/run' in reason and 'bag' in reason
    assert empty.call('identifier/cancel') == (False, 'there is no work to cancel')
    ok, reason = empty.call('identifier/save')
    assert not ok and ('~/identify' in reason or "'output'" in reason)


@pytest.mark.parametrize(
    ('name', 'value', 'reason'),
    [
        ('thresholds', 'many', 'type'),
        ('thresholds', 1, '2'),
        ('thresholds', 401, 'range'),
        ('program', ' ', 'must not be empty'),
        ('sweeps_program', ' ', 'must not be empty'),
        ('output', ' ', 'blank'),
        ('output', '~nobody_at_all/x', 'no such home folder'),
        ('model', '/nowhere.yaml', 'no such file'),
        ('model', __file__, 'YAML'),
    ],
)
def test_bad_parameters_are_refused(lab, name, value, reason):
    before = lab.get('identifier', name)
    ok, said = lab.set('identifier', name, value)
    assert not ok and reason in said
    assert lab.get('identifier', name) == before


def test_what_comes_late_still_hears_the_model(fed):
    assert made(fed)['progress'] == '100'
    report = json.loads(fed.texts('report')[-1])
    assert report['delay']['samples'] == 3 and report['data_faults'] == []
    weights = model_of(fed.texts('model')[-1]).hysteresis.weights
    assert report['hysteresis']['weights'] == weights.tolist()
    late = fed.start('model')
    fed.wait(lambda: late.status()['state'] == 'predicting', 'the latched model')
    assert late.status()['text'] == 'with topic model'
    assert late.stop() == 0
    # and so does anybody else
    heard = {'model': [], 'report': []}
    for topic, texts in heard.items():
        fed.node.create_subscription(
            String, topic, lambda m, texts=texts: texts.append(m.data), LATCHED
        )
    fed.wait(lambda: all(heard.values()), 'what is latched')
    assert heard == {topic: [fed.texts(topic)[-1]] for topic in heard}


def test_each_step_reports_what_it_found(fed):
    made(fed)
    models, reports = len(fed.texts('model')), len(fed.texts('report'))
    in_one = numbers(model_of(fed.texts('model')[-1]))
    end = fed.finish('identifier/identify_delay')
    assert end['state'] == 'done' and end['text'] == 'delay: 3 samples (steps)'
    fed.wait(lambda: len(fed.texts('report')) > reports, 'report')
    assert json.loads(fed.texts('report')[-1])['delay']['samples'] == 3
    end = fed.finish('identifier/identify_dynamics')
    assert end['state'] == 'done' and end['text'].startswith('dynamics: na = ')
    fed.wait(lambda: len(fed.texts('report')) > reports + 1, 'report')
    assert 'order' in json.loads(fed.texts('report')[-1])['dynamics']
    # single steps before the last make no model
    assert len(fed.texts('model')) == models
    assert fed.finish('identifier/identify_hysteresis')['state'] == 'done'
    fed.wait(lambda: len(fed.texts('model')) > models, 'model')
    in_steps = numbers(model_of(fed.texts('model')[-1]))
    np.testing.assert_allclose(in_steps, in_one, rtol=1e-12, atol=0)


def test_save_writes_model_report_and_pictures(fed, tmp_path):
    assert fed.finish('identifier/identify')['state'] == 'done'
    ok, reason = fed.call('identifier/save')
    assert not ok and "'output'" in reason
    (tmp_path / 'file').write_text('')
    assert fed.set('identifier', 'output', str(tmp_path / 'file'))[0]
    ok, reason = fed.call('identifier/save')
    assert not ok and str(tmp_path / 'file') in reason
    assert fed.set('identifier', 'output', str(tmp_path / 'out'))[0]
    end = fed.finish('identifier/save')
    assert end['state'] == 'done' and end['text'].startswith('written: '), end
    assert fed.set('identifier', 'output', '')[0]
    names = {p.name for p in (tmp_path / 'out').iterdir()}
    assert {'model.yaml', 'report.html', 'identification.json', 'loops.png'} <= names


def cancelled_at(g, step, during):
    """Identify, cancel in a step, and return how long the answer and the end took [s]."""
    begun = len(g.statuses('identifier'))
    assert g.call('identifier/identify')[0]
    g.wait(lambda: any(s['text'] == step for s in g.statuses('identifier')[begun:]), step)
    during()
    seen = len(g.statuses('identifier'))
    begin = time.monotonic()
    ok, message = g.call('identifier/cancel')
    answered = time.monotonic() - begin
    assert ok, message
    g.until('identifier', 'cancelled', since=seen)
    return answered, time.monotonic() - begin


@pytest.mark.timed
@pytest.mark.parametrize(
    ('step', 'setting'), [('hysteresis', ('thresholds', 100)), ('dynamics', ('max_order', 50))]
)
def test_cancel_answers_at_once_and_no_sample_is_lost(fed, blocks, step, setting):
    # with a hundred weights the swarm is at it for minutes
    assert fed.set('identifier', 'swarm_iterations', 10_000_000)[0]
    assert fed.set('identifier', *setting)[0]
    models = len(fed.texts('model'))
    length, sent = blocks[-1][0].t[-1] + 0.00005, []
    stop = threading.Event()

    def stream():
        # the next run of the clock, in real time, while the work goes on
        for k in range(10**6):
            if stop.is_set():
                return
            t = length + np.arange(100 * k, 100 * k + 100) / 20_000
            for topic in ('voltage', 'displacement'):
                fed.publish(topic, Samples(t, np.zeros(100), 'idle', topic))
            sent.append(k)
            time.sleep(0.005)

    thread = threading.Thread(target=stream)

    def during():
        for what in ('identify', 'clear', 'save', 'run'):
            ok, reason = fed.call(f'identifier/{what}')
            assert not ok and 'busy: identification' in reason
        begin = time.monotonic()
        assert fed.get('identifier', setting[0]) == setting[1]
        assert fed.set('identifier', 'seed', 1) == (True, '')
        in_time(time.monotonic() - begin, 0.5, f'parameters during {step}')
        assert fed.set('identifier', 'seed', 0) == (True, '')
        fed.wait(lambda: len(sent) > 100, 'blocks during the work')

    thread.start()
    try:
        fed.call('identifier/cancel')
        fed.wait(lambda: state(fed) not in ('identifying', 'exciting'), 'rest')
        answered, ended = cancelled_at(fed, step, during)
        in_time(answered, 0.5, f'answer to a cancel during {step}')
        in_time(ended, 2.0, f'end after a cancel during {step}')
    finally:
        stop.set()
        thread.join()
    assert len(fed.texts('model')) == models
    n = sum(v.t.size for v, _ in blocks) + 100 * len(sent)
    both = f'{n / 20_000:.3f} s of voltage, {n / 20_000:.3f} s of displacement'
    fed.wait(lambda: fed.diagnostics('identifier')['topics'] == both, both)
    assert fed.diagnostics('identifier')['lost'] == '0'


def nan(block):
    values = block.values.copy()
    values[300:400] = np.nan
    return Samples(block.t, values, block.segment, block.quantity)


def malformed(block):
    message = to_message(block)
    message.layout.dim[0].size += 1
    return message


def other_quantity(block):
    return Samples(block.t, block.values, block.segment, 'voltage')


@pytest.mark.parametrize(
    ('fault', 'reason'),
    [
        ('swapped', 'time is unsorted'),
        ('nan', 'NaN or infinite'),
        ('malformed', 'of the noise segments are missing'),
        ('other quantity', 'of the noise segments are missing'),
        ('silent stage', 'no displacement has been captured'),
    ],
)
def test_a_fault_that_spoils_the_data_is_a_failure_with_its_reason(empty, blocks, fault, reason):
    k = first_of([v for v, _ in blocks], 'noise') + 5
    pairs = list(blocks)
    if fault == 'swapped':
        pairs[k], pairs[k + 1] = pairs[k + 1], pairs[k]
    elif fault == 'nan':
        for i in range(k, k + 10):
            pairs[i] = (pairs[i][0], nan(pairs[i][1]))
    elif fault in ('malformed', 'other quantity'):
        change = malformed if fault == 'malformed' else other_quantity
        for i in range(k, k + 3):
            pairs[i] = (pairs[i][0], change(pairs[i][1]))
    else:
        pairs = [(v, None) for v, _ in pairs]
    feed(empty, pairs)
    models = len(empty.texts('model'))
    end = empty.finish('identifier/identify')
    assert end['state'] == 'failed' and reason in end['text'], end
    assert '\n' not in end['text']
    assert len(empty.texts('model')) == models
    if fault == 'malformed':
        said = '3 messages on displacement are no blocks'
        empty.wait(lambda: said in empty.diagnostics('identifier')['message'], said)


def test_settings_reach_the_work(fed):
    for name, value in (
        *(('solver', 'least_squares'), ('seed', 5), ('max_order', 3)),
        ('delay', 4),
    ):
        assert fed.set('identifier', name, value) == (True, '')
    made(fed)
    first = fed.texts('model')[-1]
    model = model_of(first)
    assert (model.identification['solver'], model.identification['seed']) == ('least_squares', 5)
    assert model.dynamics.a.size <= 3 and model.hysteresis.weights.size == 9
    assert (model.delay.samples, model.identification['delay_source']) == (4, 'given')
    assert fed.set('identifier', 'delay', -1) == (True, '')
    for name, value in (
        ('solver', 'swarm'),
        ('thresholds', 6),
        ('swarm_size', 3),
        ('swarm_iterations', 10),
    ):
        assert fed.set('identifier', name, value) == (True, '')
    try:
        end = fed.finish('identifier/identify_hysteresis')
    finally:
        assert fed.set('identifier', 'swarm_size', 40)[0]
    # three particles come nowhere in ten steps, and that is said
    assert (end['state'], end['level']) == ('done', '1'), end
    fed.wait(lambda: fed.texts('model')[-1] != first, 'another model')
    model = model_of(fed.texts('model')[-1])
    assert model.identification['solver'] == 'swarm' and model.hysteresis.weights.size == 5
    losses = model.identification['losses']
    assert losses['model'] == losses['swarm'] > losses['optimum']


@pytest.mark.skipif(not Path('/proc/self/stat').exists(), reason='no /proc here')
def test_the_work_gives_way():
    # a node of its own: the work of the others would wait for whatever the machine does beside
    with Graph() as g:
        node = g.start('identifier', {'nice': 7})

        def nices():
            places = [Path(f'/proc/{pid}/stat') for pid in node.children()]
            return [int(place.read_text().rpartition(')')[2].split()[16]) for place in places]

        # the other child only watches over the resources of multiprocessing
        g.wait(lambda: 7 + os.nice(0) in nices(), 'the work to give way')


def test_a_further_channel_is_captured(empty, blocks):
    warm = Samples(blocks[0][0].t, 20 + blocks[0][0].t, '', 'x_temperature')
    strange = Samples(warm.t, warm.values, '', 'temperature')
    for topic, block in (
        ('voltage', blocks[0][0]),
        ('displacement', blocks[0][1]),
        ('temperature', warm),
        ('temperature', strange),
    ):
        empty.publish(topic, block)
    captured(empty, voltage=0.05, displacement=0.05, x_temperature=0.05)
    said = (
        "1 messages on temperature are no blocks (layout says 't,temperature', not 't,x_<name>')"
    )
    empty.wait(lambda: said in empty.status('identifier')['text'], said)
    assert empty.status('identifier')['level'] == '1'


def test_no_more_is_kept_than_the_limit(empty, blocks):
    assert empty.set('identifier', 'capture_limit', 1.0)[0]
    for v, y in blocks:
        empty.publish('voltage', v)
        empty.publish('displacement', y)
        time.sleep(0.002)
    # the oldest tenth goes when there is no room; the last that came is there
    empty.wait(
        lambda: 'triangle' in empty.diagnostics('identifier').get('segments', '').split(),
        'the last segment',
    )
    empty.wait(lambda: 0.9 <= float(empty.diagnostics('identifier')['captured']) <= 1.0, '1 s')
    assert float(empty.diagnostics('identifier')['room']) <= 0.1
    end = empty.finish('identifier/identify_delay')
    assert end['level'] != '0', end


class Ended(IdentifierNode):
    """A node without ROS whose job has ended, and whose outcome was not taken yet."""

    def __init__(self):
        self._excitation, self._worker = SimpleNamespace(running=False), SimpleNamespace()
        self._worker.is_busy, self._outcomes, self._task = False, [print], 'identification'


def test_work_ends_when_its_outcome_is_taken():
    with pytest.raises(PiezoIdentError, match=r'busy: identification; .*~/cancel'):
        Ended()._clear()

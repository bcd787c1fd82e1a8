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


"""The identifier as a process: what it captures, refuses, identifies, cancels and writes."""

import json
import signal
import threading
import time

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from graph import Graph
from piezo_ident.bag_io import read_bag, write_bag
from piezo_ident.identification import identify
from piezo_ident.model_io import model_from_dict, parse_yaml
from piezo_ident.nodes.wire import to_message
from piezo_ident.program import parse_program
from piezo_ident.results import Settings
from piezo_ident.shipped import find_config
from piezo_ident.simulation import load_stage, simulate
from piezo_ident.wire_format import cut_blocks, Samples

PROGRAM = """
limits: [0, 10]
sample_rate: 20000
seed: 1
rest: 0
slew: 40
segments:
  - {signal: idle, duration: 0.1}
  - {signal: step, bias: 5, size: 1, hold: 0.03, count: 8}
  - {signal: settle, bias: 5, amplitude: 0.48, cycles: 8, frequency: 20}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 3000, duration: 1}
  - {signal: triangle, slope: 40}
  - {signal: idle, duration: 0.1}
"""
SETTINGS = {'max_order': 6, 'swarm_iterations': 20_000, 'thresholds': '10'}
#: large blocks: a whole record fits into the queues, whatever else the machine does
SIZE = 1000


@pytest.fixture(scope='module')
def record():
    stage = load_stage(find_config('paper', 'stage'))
    return simulate(stage, parse_program(PROGRAM).build(), np.random.default_rng(1))


@pytest.fixture(scope='module')
def blocks(record):
    """(voltage, displacement) of each block."""
    (piece,) = record
    t = piece.t
    return [
        (
            Samples(t[a:b], piece.v[a:b], label, 'voltage'),
            Samples(t[a:b], piece.y[a:b], label, 'displacement'),
        )
        for a, b, label in cut_blocks(piece.n, piece.segments, SIZE)
    ]


@pytest.fixture(scope='module')
def lab():
    with Graph() as g:
        g.start('identifier', params=SETTINGS)
        g.texts('model')
        g.texts('report')
        yield g


def state(g):
    return g.status('identifier')['state']


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
    seconds = [x / 20_000 for x in n.values()]
    text = '{:.3f} s of voltage, {:.3f} s of displacement captured'.format(*seconds)
    g.wait(lambda: g.status('identifier')['message'] == text, 10, text)


@pytest.fixture
def empty(lab):
    """Return the graph with an identifier that is at rest and has captured nothing."""
    lab.call('identifier/cancel')
    lab.wait(lambda: state(lab) not in ('identifying', 'saving', 'exciting'), 10, 'rest')
    assert lab.call('identifier/clear')[0]
    for name, value in SETTINGS.items():
        assert lab.set('identifier', name, value) == (True, '')
    return lab


@pytest.fixture
def fed(empty, blocks):
    feed(empty, blocks)
    return empty


def finish(g, service='identifier/identify', timeout=60):
    """Call a service and return the status at the end of its work."""
    seen = len(g.statuses('identifier'))
    ok, message = g.call(service)
    assert ok, message

    def ended():
        return any(
            s['state'] in ('done', 'failed', 'cancelled') for s in g.statuses('identifier')[seen:]
        )

    g.wait(ended, timeout, f'end of {service}')
    return g.status('identifier')


def numbers(model):
    h, G, s = model.hysteresis, model.dynamics, model.scaling
    return np.concatenate(
        [h.thresholds, h.weights, [h.p1, h.p2, s.v0, s.V, s.y0, s.Y, model.delay.total], G.a, G.b]
    )


def test_what_cannot_be_done_is_refused_with_the_reason(empty):
    for step in ('identify', 'identify_delay', 'identify_dynamics', 'identify_hysteresis'):
        ok, reason = empty.call(f'identifier/{step}')
        assert not ok and 'nothing has been captured' in reason
    assert empty.call('identifier/cancel') == (False, 'nothing is at work')
    ok, reason = empty.call('identifier/save')
    assert not ok and ('no model to save' in reason or "'output' is empty" in reason)


@pytest.mark.parametrize(
    ('name', 'value', 'reason'),
    [
        ('thresholds', 'many', "'refined'"),
        ('thresholds', '1', '2 to 400'),
        ('solver', 'magic', 'swarm or least_squares'),
        ('max_order', 51, 'max_order'),
        ('program', ' ', 'must not be empty'),
        ('capture_limit', -1.0, 'capture_limit'),
        ('capture_limit', float('nan'), 'capture_limit'),
        ('nice', 3, 'read'),
        ('seed', 1.5, 'type'),
    ],
)
def test_bad_parameters_are_refused(lab, name, value, reason):
    before = lab.get('identifier', name)
    ok, said = lab.set('identifier', name, value)
    assert not ok and reason in said
    assert lab.get('identifier', name) == before


def test_live_is_offline_and_what_comes_late_still_hears_the_model(fed, record, tmp_path):
    end = finish(fed)
    assert end['state'] == 'done' and end['progress'] == '100', end
    fed.wait(lambda: fed.texts('model') and fed.texts('report'), 5, 'model and report')
    live = model_from_dict(parse_yaml(fed.texts('model')[-1], 'live'))
    write_bag(record, tmp_path / 'bag')
    offline = identify(read_bag(tmp_path / 'bag'), Settings(max_order=6)).model
    np.testing.assert_allclose(numbers(live), numbers(offline), rtol=1e-12, atol=0)
    report = json.loads(fed.texts('report')[-1])
    assert report['delay']['samples'] == 3 and report['data_faults'] == []
    assert report['hysteresis']['weights'] == live.hysteresis.weights.tolist()
    late = fed.start('model')
    fed.wait(lambda: late.status()['state'] == 'predicting', 10, 'latched model')
    assert late.status()['message'] == 'with topic model'
    assert late.stop() == 0


def test_each_step_reports_what_it_found(fed):
    whole = finish(fed)
    assert whole['state'] == 'done'
    fed.wait(lambda: fed.texts('model'), 5, 'model')
    models, reports = len(fed.texts('model')), len(fed.texts('report'))
    in_one = numbers(model_from_dict(parse_yaml(fed.texts('model')[-1], 'live')))
    end = finish(fed, 'identifier/identify_delay')
    assert end['state'] == 'done' and end['message'] == 'delay: 3 samples (steps)'
    fed.wait(lambda: len(fed.texts('report')) > reports, 5, 'report')
    assert json.loads(fed.texts('report')[-1])['delay']['samples'] == 3
    end = finish(fed, 'identifier/identify_dynamics')
    assert end['state'] == 'done' and end['message'].startswith('dynamics: na = ')
    fed.wait(lambda: len(fed.texts('report')) > reports + 1, 5, 'report')
    assert 'order' in json.loads(fed.texts('report')[-1])['dynamics']
    # single steps before the last make no model
    assert len(fed.texts('model')) == models
    assert finish(fed, 'identifier/identify_hysteresis')['state'] == 'done'
    fed.wait(lambda: len(fed.texts('model')) > models, 5, 'model')
    in_steps = numbers(model_from_dict(parse_yaml(fed.texts('model')[-1], 'steps')))
    np.testing.assert_allclose(in_steps, in_one, rtol=1e-12, atol=0)


def test_save_writes_model_report_and_pictures(fed, tmp_path):
    assert finish(fed)['state'] == 'done'
    ok, reason = fed.call('identifier/save')
    assert not ok and "parameter 'output' is empty" in reason
    (tmp_path / 'file').write_text('')
    assert fed.set('identifier', 'output', str(tmp_path / 'file'))[0]
    ok, reason = fed.call('identifier/save')
    assert not ok and 'is a file' in reason
    assert fed.set('identifier', 'output', str(tmp_path / 'out'))[0]
    end = finish(fed, 'identifier/save')
    assert end['state'] == 'done' and end['message'].startswith('written: '), end
    assert fed.set('identifier', 'output', '')[0]
    names = {p.name for p in (tmp_path / 'out').iterdir()}
    assert {'model.yaml', 'report.html', 'identification.json', 'loops.png'} <= names


def cancelled_at(g, step, during):
    """Identify, cancel in a step, and return how long the answer and the end took [s]."""
    assert g.call('identifier/identify')[0]
    g.wait(lambda: g.status('identifier')['message'] == step, 30, step)
    during()
    seen = len(g.statuses('identifier'))
    begin = time.monotonic()
    ok, message = g.call('identifier/cancel')
    answered = time.monotonic() - begin
    assert ok, message
    g.wait(
        lambda: any(s['state'] == 'cancelled' for s in g.statuses('identifier')[seen:]),
        10,
        'cancelled',
    )
    return answered, time.monotonic() - begin


@pytest.mark.parametrize(
    ('step', 'setting'),
    [('hysteresis', ('thresholds', '100')), ('dynamics', ('max_order', 50))],
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
        assert time.monotonic() - begin < 0.5
        assert fed.set('identifier', 'seed', 0) == (True, '')
        fed.wait(lambda: len(sent) > 100, 10, 'blocks during the work')

    thread.start()
    try:
        answered, ended = cancelled_at(fed, step, during)
    finally:
        stop.set()
        thread.join()
    print(f'cancel during {step}: answered in {answered:.3f} s, ended in {ended:.3f} s')
    assert answered < 0.5 and ended < 2.0
    assert len(fed.texts('model')) == models
    n = sum(v.t.size for v, _ in blocks) + 100 * len(sent)
    all_of_it = f'{n / 20_000:.3f}'
    fed.wait(lambda: fed.diagnostics('identifier')['captured'] == all_of_it, 5, all_of_it)
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


def test_small_faults_are_said_in_model_and_report(empty, blocks):
    k = next(i for i, (v, _) in enumerate(blocks) if v.segment == 'noise') + 10
    (v0, y0), (v1, y1) = blocks[k : k + 2]
    short = Samples(y1.t[:970], y1.values[:970], y1.segment, y1.quantity)
    again = blocks[k + 2]
    feed(empty, [*blocks[:k], (v0, nan(y0)), (v1, short), again, again, *blocks[k + 3 :]])
    reports = len(empty.texts('report'))
    end = finish(empty)
    assert (
        end['state'] == 'done'
        and end['level'] == '1'
        and 'warnings in the report' in end['message']
    )
    empty.wait(lambda: len(empty.texts('report')) > reports, 5, 'report')
    report = json.loads(empty.texts('report')[-1])
    assert {'not_finite', 'gap', 'unmatched', 'repeated_rows'} <= {
        f['name'] for f in report['data_faults']
    }
    model = model_from_dict(parse_yaml(empty.texts('model')[-1], 'live'))
    assert any('not_finite' in w for w in model.identification['warnings'])


@pytest.mark.parametrize(
    ('fault', 'reason'),
    [
        ('dropped', 'of the noise segments are missing'),
        ('swapped', 'time is unsorted'),
        ('nan', 'NaN or infinite'),
        ('malformed', 'of the noise segments are missing'),
        ('other quantity', 'of the noise segments are missing'),
        ('silent stage', 'no displacement has been captured'),
    ],
)
def test_a_fault_that_spoils_the_data_is_a_failure_with_its_reason(empty, blocks, fault, reason):
    k = next(i for i, (v, _) in enumerate(blocks) if v.segment == 'noise') + 5
    pairs = list(blocks)
    if fault == 'dropped':
        for i in range(3):
            pairs[k + i] = (pairs[k + i][0], None)
    elif fault == 'swapped':
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
    end = finish(empty)
    assert end['state'] == 'failed' and reason in end['message'], end
    assert '\n' not in end['message']
    assert len(empty.texts('model')) == models
    if fault == 'malformed':
        said = '3 messages on displacement are no blocks'
        empty.wait(lambda: said in empty.diagnostics('identifier')['message'], 5, said)


@pytest.fixture(scope='module')
def course():
    """Return a graph to drive a stage in; stage and excitation come when they are needed."""
    with Graph() as g:
        g.start('identifier', params={**SETTINGS, 'program': PROGRAM, 'excitation_limit': 1.0})
        yield g


def test_run_without_an_excitation_fails_with_the_reason(course):
    end = finish(course, 'identifier/run', 5)
    assert end['state'] == 'failed'
    assert "no excitation offers 'excitation/start' within 1 s" in end['message']


def test_run_without_a_stage_fails_with_the_reason(course):
    course.start('excitation', params={'rate_factor': 4.0, 'subscribers': 2})
    end = finish(course, 'identifier/run', 5)
    assert end['state'] == 'failed'
    assert 'nobody publishes displacement within 1 s' in end['message']


def test_run_drives_the_excitation_and_identifies(course):
    course.start('stage', params={'seed': 3})
    assert course.set('identifier', 'excitation_limit', 5.0)[0]
    assert course.set('identifier', 'program', 'nonsense')[0]
    end = finish(course, 'identifier/run', 10)
    assert end['state'] == 'failed' and 'the excitation refuses the programme' in end['message']
    assert course.set('identifier', 'program', PROGRAM)[0]
    end = finish(course, 'identifier/run')
    assert end['state'] == 'done', end
    states = [s['state'] for s in course.statuses('identifier')]
    assert states.index('exciting') < states.index('identifying') < states.index('done')
    course.wait(lambda: course.texts('model'), 5, 'model')
    assert course.diagnostics('identifier')['lost'] == '0'


def test_cancel_during_the_excitation_ramps_to_rest(course):
    voltage = course.collect('voltage')
    assert course.call('identifier/run')[0]
    course.wait(lambda: course.status('excitation').get('segment') == 'noise', 20, 'noise')
    ok, reason = course.call('identifier/identify')
    assert not ok and 'busy: excitation' in reason
    assert course.call('identifier/cancel')[0]
    course.wait(lambda: state(course) == 'cancelled', 2, 'cancelled')
    course.wait(lambda: course.status('excitation')['state'] == 'stopped', 5, 'stopped')
    course.wait(lambda: voltage[-1].values[-1] == 0.0, 2, 'rest')


def test_a_stage_that_stops_answering_is_a_failure_with_its_reason(course):
    stage = next(h for h in course.handles if h.name == 'stage')
    assert course.set('identifier', 'excitation_limit', 1.0)[0]
    assert course.set('excitation', 'rate_factor', 1.0)[0]
    assert course.call('identifier/run')[0]
    course.wait(lambda: course.status('excitation').get('segment') == 'noise', 20, 'noise')
    stage.kill()
    begin = time.monotonic()
    course.wait(lambda: state(course) == 'failed', 5, 'failed')
    assert time.monotonic() - begin < 3.0
    assert 'no displacement for 1 s' in course.status('identifier')['message']
    course.wait(lambda: course.status('excitation')['state'] == 'stopped', 5, 'stopped')


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_during_the_work(blocks, number):
    with Graph() as g:
        identifier = g.start(
            'identifier', params={**SETTINGS, 'swarm_iterations': 10_000_000, 'thresholds': '100'}
        )
        feed(g, blocks)
        assert g.call('identifier/identify')[0]
        g.wait(lambda: g.status('identifier')['message'] == 'hysteresis', 30, 'hysteresis')
        begin = time.monotonic()
        assert identifier.stop(number) == 0, identifier.log
        assert time.monotonic() - begin < 2.0
        assert 'Traceback' not in identifier.log

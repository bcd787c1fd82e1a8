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


"""The excitation node as a process, with a stage beside it where it needs one."""

import signal
import time

from graph import Graph
import numpy as np
from piezo_ident.program import parse_program
from piezo_ident.shipped import find_config
from piezo_ident.simulation import load_stage, simulate
from piezo_ident.wire_format import cut_blocks
import pytest
from std_msgs.msg import Float64MultiArray
import yaml

FS = 20000.0
SHORT = """
limits: [0, 10]
slew: 50
segments:
  - {signal: idle, duration: 0.05}
  - {signal: step, bias: 5, size: 1, hold: 0.0501, count: 3}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 3000, duration: 0.3}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 50, duration: 0.4}
"""
# near the upper limit for long enough to be stopped there
HIGH = """
limits: [0, 10]
slew: 200
segments:
  - {signal: hold, level: 9, duration: 60}
"""
SLOW = 'limits: [0, 10]\nsegments:\n  - {signal: idle, duration: 60}\n'


def column(blocks):
    """Return t and values of blocks in one piece."""
    return np.concatenate([b.t for b in blocks]), np.concatenate([b.values for b in blocks])


def state(g, name='excitation'):
    return g.status(name)['state']


def ended(g, name='excitation'):
    return state(g, name) in ('done', 'stopped', 'failed')


def play(g, name='excitation', timeout=30.0):
    """Start, wait for the end of this programme, and return the status then."""
    seen = len(g.statuses(name))
    ok, message = g.call(f'{name}/start')
    assert ok, message
    g.wait(lambda: len(g.statuses(name)) > seen and ended(g, name), timeout, 'end of programme')
    return g.status(name)


@pytest.fixture(scope='module')
def lab():
    with Graph() as g:
        for topic in ('voltage', 'displacement', 'applied_voltage'):
            g.collect(topic)
        g.start('stage', {'seed': 3})
        g.start('excitation', {'program': SHORT, 'subscribers': 2})
        yield g


def test_a_programme_in_real_time(lab):
    sequence = parse_program(SHORT).build(FS)
    voltage = lab.collect('voltage')
    assert not voltage, 'silent until it is started'
    status = play(lab)
    assert status['state'] == 'done'
    lab.wait(lambda: len(lab.collect('displacement')) == len(voltage), what='all answers')
    lab.wait(lambda: len(lab.collect('applied_voltage')) == len(voltage), what='all applied')

    # labels, t and values exactly; no block across two segments
    expected = list(cut_blocks(sequence.n, sequence.segments, 100))
    assert [(round(b.t[0] * FS), b.segment, b.t.size) for b in voltage] == [
        (start, label, stop - start) for start, stop, label in expected
    ]
    t, v = column(voltage)
    assert t.tobytes() == (np.arange(sequence.n) / FS).tobytes()
    assert v.tobytes() == sequence.v.tobytes()
    assert v.min() >= 0
    assert v.max() <= 10
    layout = lab.messages('voltage')[0].layout
    assert [(d.label, d.size, d.stride) for d in layout.dim] == [
        ('sample:idle', 100, 200),
        ('t,voltage', 2, 2),
    ]

    # what comes back is the simulation of the same sequence and seed, bit for bit
    record = simulate(
        load_stage(find_config('paper', 'stage')), sequence, np.random.default_rng(3)
    )
    back = lab.collect('displacement')
    ty, y = column(back)
    assert ty.tobytes() == t.tobytes()
    assert y.tobytes() == record.pieces[0].y.tobytes()
    assert [b.segment for b in back] == [b.segment for b in voltage]
    assert back[0].quantity == 'displacement'
    assert column(lab.collect('applied_voltage'))[1].tobytes() == v.tobytes()

    # the least delay at the end is that at the beginning: the clock does not drift
    delay = np.array(lab.arrivals('voltage')) - np.array([b.t[0] for b in voltage])
    quarter = delay.size // 4
    assert abs(delay[-quarter:].min() - delay[:quarter].min()) < 0.005

    states = [s['state'] for s in lab.statuses('excitation')]
    assert list(dict.fromkeys(states)) == ['idle', 'waiting', 'running', 'done']
    progress = [float(s['progress']) for s in lab.statuses('excitation')]
    assert progress == sorted(progress)
    running = [s['segment'] for s in lab.statuses('excitation') if s['state'] == 'running']
    assert list(dict.fromkeys(running)) == list(dict.fromkeys(s.label for s in sequence.segments))


def test_faster_than_real_time_loses_nothing():
    sequence = parse_program(SHORT).build(FS)
    count = len(list(cut_blocks(sequence.n, sequence.segments, 100)))
    with Graph() as g:
        # one topic alone: the flow control knows of the stage, not of an observer that is slower
        back = g.collect('displacement')
        g.start('stage')
        g.start('excitation', {'program': SHORT, 'rate_factor': 0.0})
        for factor in (0.0, 3.0):
            assert g.set('excitation', 'rate_factor', factor) == (True, '')
            answered = len(back)
            assert play(g)['state'] == 'done'
            g.wait(lambda answered=answered: len(back) == answered + count, what='all answers')
            # every run starts the sample clock
            t, _ = column(back[answered:])
            assert t.tobytes() == (np.arange(sequence.n) / FS).tobytes()
        g.wait(lambda: g.diagnostics('stage').get('samples') == str(2 * sequence.n), what='count')
        # the guard saw nothing to alter
        assert {v for k, v in g.diagnostics('stage').items() if k[:7] == 'altered'} == {'0'}


def test_stop_ramps_to_rest_and_goes_on_with_t(lab):
    assert lab.set('excitation', 'program', HIGH) == (True, '')
    voltage = lab.collect('voltage')
    sent = len(voltage)
    assert lab.call('excitation/start')[0]
    lab.wait(lambda: len(voltage) > sent and voltage[-1].values[-1] == 9.0, what='9 V')
    refused = lab.call('excitation/start')
    assert refused[0] is False
    assert 'already' in refused[1]
    assert lab.set('excitation', 'voltage_high', 9.5)[0] is False
    ok, message = lab.call('excitation/stop')
    assert (ok, message) == (True, 'ramping to 0 V')
    lab.wait(lambda: state(lab) == 'stopped', what='stopped')
    lab.wait(lambda: voltage[-1].values[-1] == 0.0, what='rest')
    t, _ = column(voltage[sent:])
    assert t.tobytes() == (np.arange(t.size) / FS).tobytes()
    ramp = [b for b in voltage[sent:] if b.segment == 'ramp:stop']
    assert voltage[-1] is ramp[-1]
    down = column(ramp)[1]
    assert down[0] == pytest.approx(9.0, abs=1e-3)
    assert np.all(np.diff(down) <= 0)
    # 20 V/s at its steepest
    assert -np.diff(down).min() * FS == pytest.approx(20.0, rel=1e-3)
    assert 'stopping' in [s['state'] for s in lab.statuses('excitation')]
    assert lab.call('excitation/stop') == (False, 'nothing is being played')


@pytest.mark.parametrize(
    ('name', 'value', 'reason'),
    [
        ('program', 'identificaton', 'did you mean identification'),
        ('program', 'segments: [{signal: idle}]', 'limits is missing'),
        ('program', SHORT.replace('bias: 5, amplitude: 5', 'bias: 6, amplitude: 5'), 'outside'),
        ('program', SHORT.replace('cutoff: 3000', 'cutoff: 30000'), 'half the sampling rate'),
        ('program', '{segments: [', 'program'),
        ('program', '/etc', 'no such program'),
        ('voltage_high', 8.0, 'outside the limits'),
        ('voltage_high', float('nan'), 'nan'),
        ('voltage_low', 20.0, 'crossed'),
        ('rest', -1.0, 'outside the voltage limits'),
        ('ramp_slew', 0.0, ''),
        ('block_size', 0, ''),
        ('in_flight', 100, ''),
        ('sample_rate', 1000.0, ''),
        ('block_size', 'many', ''),
    ],
)
def test_bad_parameters_are_refused_with_the_reason(lab, name, value, reason):
    assert lab.set('excitation', 'program', SHORT)[0]
    before = lab.get('excitation', name)
    taken, why = lab.set('excitation', name, value)
    assert not taken
    assert why
    assert reason in why
    assert lab.get('excitation', name) == before


def test_parameters_have_descriptions(lab):
    found = lab.parameters('excitation')
    assert found['sample_rate'].read_only
    assert '[V/s]' in found['ramp_slew'].description
    assert found['in_flight'].integer_range[0].to_value == 90


def test_diagnostics(lab):
    assert lab.set('excitation', 'program', SHORT)[0]
    play(lab)
    lab.wait(
        lambda: float(lab.diagnostics('excitation').get('rate', 0)) > 0, what='rate in diagnostics'
    )
    seen = lab.diagnostics('excitation')
    assert {'rate', 'samples', 'blocks', 'late', 'worst_delay', 'slipped', 'head_room'} <= set(
        seen
    )
    assert 0.3 < float(seen['head_room']) <= 1.0
    lab.wait(lambda: float(lab.diagnostics('stage').get('rate', 0)) > 0, what='rate of the stage')
    assert lab.diagnostics('stage')['lost'] == '0'


def test_every_key_of_the_yaml_is_declared(lab):
    for node in ('excitation', 'stage'):
        text = find_config(f'{node}.yaml', 'config').read_text(encoding='utf-8')
        given = yaml.safe_load(text)['/**']['ros__parameters']
        declared = {k for k, d in lab.parameters(node).items() if d.description}
        assert set(given) == declared - {'use_sim_time'} - {
            k for k in declared if k.startswith(('qos_overrides', 'start_type_description'))
        }


def test_nobody_listens_somebody_else_talks_and_what_comes_too_late():
    with Graph() as g:
        node = g.start('excitation', {'program': SLOW, 'wait_limit': 0.3})
        status = play(g)
        assert status['state'] == 'failed'
        assert '0 of 1 subscribers on /voltage after 0.3 s' in status['message']
        # stop while waiting
        assert g.set('excitation', 'wait_limit', 60.0)[0]
        assert g.call('excitation/start')[0]
        g.wait(lambda: state(g) == 'waiting', what='waiting')
        assert g.call('excitation/stop')[0]
        g.wait(lambda: state(g) == 'stopped', what='stopped')
        # an answer is needed where answers set the pace
        assert g.set('excitation', 'wait_limit', 0.3)[0]
        assert g.set('excitation', 'rate_factor', 0.0)[0]
        voltage = g.collect('voltage')
        status = play(g)
        assert 'nobody publishes displacement' in status['message']
        # a stage that is there and stops answering
        other = g.node.create_publisher(Float64MultiArray, 'displacement', 10)
        status = play(g)
        assert status['state'] == 'failed'
        assert 'no displacement for 0.3 s' in status['message']
        g.node.destroy_publisher(other)
        g.wait(lambda: voltage and len(voltage) == 40, what='the blocks in flight')
        # a second publisher
        assert g.set('excitation', 'rate_factor', 1.0)[0]
        second = g.node.create_publisher(Float64MultiArray, 'voltage', 10)
        g.wait(lambda: g.node.count_publishers('voltage') == 2, what='second publisher')
        g.wait(lambda: not g.call('excitation/start')[0] or g.call('excitation/stop'), what='no')
        ok, message = g.call('excitation/start')
        assert not ok
        assert '/observer publishes on /voltage too' in message
        g.node.destroy_publisher(second)
        # one that comes while a programme is played is reported
        g.wait(lambda: g.call('excitation/start')[0], what='start')
        g.wait(lambda: state(g) == 'running', what='running')
        second = g.node.create_publisher(Float64MultiArray, 'voltage', 10)
        g.wait(lambda: 'second publisher' in g.status('excitation')['message'], what='warning')
        assert g.status('excitation')['level'] == '1'
        # the end while it is playing
        begin = time.monotonic()
        assert node.stop(signal.SIGINT) == 0
        assert time.monotonic() - begin < 2.0


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ramps_to_rest_first(number):
    with Graph() as g:
        nodes = {}
        # a slow ramp gives way to the two seconds that a node has for its end
        for where, ramp_slew in (('usual', 20.0), ('slow', 0.5)):
            g.collect(f'{where}/voltage')
            program = {'program': HIGH, 'ramp_slew': ramp_slew}
            nodes[where] = g.start('excitation', program, namespace=where)
        for where in nodes:
            voltage = g.collect(f'{where}/voltage')
            assert g.call(f'{where}/excitation/start')[0]
            g.wait(lambda v=voltage: v and v[-1].values[-1] == 9.0, what='9 V')
        slow = g.collect('slow/voltage')
        assert g.call('slow/excitation/stop')[0]
        g.wait(lambda: slow[-1].segment == 'ramp:stop', what='slow ramp')
        begin = time.monotonic()
        for node in nodes.values():
            node.send(number)
        for where, node in nodes.items():
            assert node.process.wait(5) == 0
            assert time.monotonic() - begin < 2.0
            voltage = g.collect(f'{where}/voltage')
            g.wait(lambda v=voltage: v[-1].values[-1] == 0.0, what='rest')
            t, v = column(voltage)
            assert t.tobytes() == (np.arange(t.size) / FS).tobytes()
            assert np.abs(np.diff(v)).max() * FS < 201.0
            assert node.log == ''


def test_bad_parameters_at_the_start_end_it_with_the_reason():
    with Graph() as g:
        nodes = [
            (g.start('excitation', {'program': 'nonsense'}, wait=False), 'no such program'),
            (g.start('excitation', {'voltage_high': 5.0}, wait=False), 'outside the limits'),
            (g.start('stage', {'stage': 'nonsense'}, wait=False), 'no such stage'),
            (g.start('stage', {'rest': 11.0}, wait=False), 'rest = 11 V lies outside'),
        ]
        for node, reason in nodes:
            assert node.process.wait(30) == 2
            assert reason in node.log


def test_two_stages_side_by_side_in_namespaces_and_under_other_topic_names():
    renamed = {'voltage': 'command', 'displacement': 'position', 'applied_voltage': 'amplifier'}
    topics = ('a/voltage', 'b/voltage', 'command', 'voltage')
    answers = ('a/displacement', 'b/displacement', 'position', 'displacement')
    with Graph() as g:
        for topic in (*topics, *answers):
            g.collect(topic)
        for where in ('a', 'b'):
            g.start('stage', namespace=where)
            g.start('excitation', {'program': SHORT, 'subscribers': 2}, namespace=where)
        g.start('stage', remaps={**renamed, '__node': 'table'})
        g.start('excitation', {'program': SHORT, 'subscribers': 2}, remaps=renamed)
        count = len(list(cut_blocks(*_size(SHORT), 100)))
        heard = dict.fromkeys((*topics, *answers), 0)
        for which, name in enumerate(('a/excitation', 'b/excitation', 'excitation')):
            assert play(g, name)['state'] == 'done'
            heard[topics[which]] = heard[answers[which]] = count
            g.wait(lambda which=which: len(g.collect(answers[which])) == count, what='answers')
            # nobody else said anything
            assert {topic: len(g.collect(topic)) for topic in heard} == heard
        g.wait(lambda: g.diagnostics('a/stage'), what='diagnostics')
        assert state(g, 'table') in ('running', 'idle')


def _size(program):
    sequence = parse_program(program).build(FS)
    return sequence.n, sequence.segments


def test_killed_at_nine_volts():
    with Graph() as g:
        voltage, applied = g.collect('voltage'), g.collect('applied_voltage')
        stage = g.start('stage', {'silence': 0.2})
        first = g.start('excitation', {'program': HIGH, 'subscribers': 2})
        assert g.call('excitation/start')[0]
        g.wait(lambda: applied and applied[-1].values[-1] == 9.0, what='9 V')

        # a namesake is told by its blocks, and keeps silent
        g.follow('twin')
        own = {'~/start': '/twin/start', '~/status': '/twin/status'}
        g.start('excitation', {'program': HIGH}, remaps=own, wait=False)
        assert g.call('twin/start', timeout=30)[0]
        g.wait(lambda: state(g, 'twin') == 'failed', what='refusal')
        assert 'another /excitation is playing on /voltage' in g.status('twin')['message']

        first.kill()
        g.wait(lambda: applied[-1].segment == 'ramp:silence', what='ramp')
        assert g.status('stage')['level'] == '1'
        assert 'no voltage for' in g.status('stage')['message']
        # the dead one is still seen, but it is silent; the stage is on its way
        sent = len(voltage)
        assert g.call('twin/start')[0]
        g.wait(lambda: applied[-1].values[-1] == 9.0, what='9 V again')
        assert voltage[sent].t[0] == 0.0
        _, v = column(applied)
        assert np.abs(np.diff(v)).max() * FS <= 221.0
        down = [b for b in applied if b.segment == 'ramp:silence']
        assert np.abs(np.diff(column(down)[1])).max() * FS <= 20.1
        assert stage.stop() == 0
        g.wait(lambda: applied[-1].values[-1] == 0.0, what='rest')

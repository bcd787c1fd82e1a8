# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The excitation node as a process, with a stage beside it where it needs one."""

import re
import signal
import time

from course import column, FS, HIGH, SHORT
from graph import Graph, in_time
import numpy as np
from piezo_ident.common.errors import ConfigError
from piezo_ident.excitation.program import parse_program
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.nodes.excitation import ExcitationNode
from piezo_ident.record.blocks import cut_blocks
import pytest
from std_msgs.msg import Float64MultiArray

QUIET = 'limits: [0, 10]\nsegments:\n  - {signal: idle, duration: 1.5}\n'
SLOW = 'limits: [0, 10]\nsegments:\n  - {signal: idle, duration: 60}\n'


def state(g, name='excitation'):
    return g.status(name)['state']


def start(g, *more):
    """Start a stage and an excitation, and more nodes."""
    topics = ('voltage', 'displacement', 'applied_voltage')
    for topic in topics:
        g.collect(topic)
    stage = ('stage', {'seed': 3, 'silence': 10.0})
    g.start_all(stage, ('excitation', {'program': SHORT, 'subscribers': 2}), *more)
    for topic in topics:
        g.matched(topic)


@pytest.fixture(scope='module')
def lab():
    with Graph() as g:
        params = {'program': SHORT, 'sample_rate': 10_000.0, 'block_size': 250}
        start(g, ('excitation', params, 'half'))
        yield g


def test_a_program_whose_file_cannot_be_read_again_is_not_played(monkeypatch):
    # without a graph: the start fails before it needs one
    node = ExcitationNode.__new__(ExcitationNode)
    node._thread = node._playing = None
    node.values = {'program': 'gone', 'block_size': 100, 'rate_factor': 1.0}
    monkeypatch.setattr(ExcitationNode, '_build', lambda *_: (parse_program(SHORT).build(FS),))
    monkeypatch.setattr(ExcitationNode, '_unused', lambda *_: '')
    with pytest.raises(ConfigError, match='gone'):
        node._start()
    assert node._thread is None and node._playing is None


def test_a_program_in_real_time():
    # the simulation holds for a stage that has not moved before
    with Graph() as g:
        start(g)
        as_simulated(g)


def as_simulated(lab):
    """Play a program, and compare all that is published with its simulation."""
    sequence = parse_program(SHORT).build(FS)
    voltage = lab.collect('voltage')
    assert not voltage, 'silent until it is started'
    status = lab.finish('excitation/start')
    assert status['state'] == 'done'
    expected = list(cut_blocks(sequence.n, sequence.segments, 100))
    for topic in ('voltage', 'displacement', 'applied_voltage'):
        lab.wait(lambda t=topic: len(lab.collect(t)) >= len(expected), f'all of {topic}')

    # labels, t and values exactly; no block across two segments
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
    record = SimulatedStage.load('paper').play(sequence, np.random.default_rng(3))
    back = lab.collect('displacement')
    ty, y = column(back)
    assert ty.tobytes() == t.tobytes()
    assert y.tobytes() == record.pieces[0].y.tobytes()
    assert [b.segment for b in back] == [b.segment for b in voltage]
    assert back[0].quantity == 'displacement'
    assert column(lab.collect('applied_voltage'))[1].tobytes() == v.tobytes()

    states = [s['state'] for s in lab.statuses('excitation')]
    assert list(dict.fromkeys(states)) == ['idle', 'waiting', 'running', 'done']
    progress = [float(s['progress']) for s in lab.statuses('excitation')]
    assert progress == sorted(progress)
    running = [s['segment'] for s in lab.statuses('excitation') if s['state'] == 'running']
    assert list(dict.fromkeys(running)) == list(dict.fromkeys(s.label for s in sequence.segments))


@pytest.mark.timed
def test_it_keeps_time(lab):
    sequence = parse_program(SHORT).build(FS)
    count = len(list(cut_blocks(sequence.n, sequence.segments, 100)))
    voltage = lab.collect('voltage')

    since = len(voltage)
    assert lab.finish('excitation/start')['state'] == 'done'
    lab.wait(lambda: len(voltage) >= since + count, 'all blocks')
    told = len(lab.diagnoses('excitation'))
    lab.wait(lambda: len(lab.diagnoses('excitation')) > told, 'numbers')
    assert lab.diagnostics('excitation')['samples'] == str(sequence.n)
    slipped = float(lab.diagnostics('excitation')['slipped'])
    # the least delay at the end is that at the beginning, but for what the clock reports
    delay = np.array(lab.arrivals('voltage')[since:]) - [b.t[0] for b in voltage[since:]]
    quarter = delay.size // 4
    drift = abs(delay[-quarter:].min() - delay[:quarter].min() - slipped)
    in_time(drift, 0.1, f'drift in {sequence.duration:.2f} s')
    lab.wait(lambda: len(lab.collect('displacement')) >= len(voltage), 'all answers')


@pytest.mark.parametrize('factor', [0.5, 4.0])
def test_slower_and_faster_than_real_time(lab, factor):
    sequence = parse_program(SHORT).build(FS)
    assert lab.set('excitation', 'program', SHORT)[0]
    assert lab.set('excitation', 'block_size', 1000)[0]
    count = len(list(cut_blocks(sequence.n, sequence.segments, 1000)))
    back, altered = lab.collect('displacement'), counts(lab, 'altered')
    seen = len(back)
    try:
        assert lab.set('excitation', 'rate_factor', factor) == (True, '')
        begin = time.monotonic()
        assert lab.finish('excitation/start')['state'] == 'done'
        # the last block has its time, whenever the test hears of the blocks
        assert time.monotonic() - begin > 0.99 * (sequence.duration - 1000 / FS) / factor
        lab.wait(lambda: len(back) >= seen + count, 'all of displacement')
        # every run starts the sample clock
        t, _ = column(back[seen:])
        assert t.tobytes() == (np.arange(sequence.n) / FS).tobytes()
    finally:
        assert lab.set('excitation', 'rate_factor', 1.0)[0]
        assert lab.set('excitation', 'block_size', 100)[0]
    # the guard saw nothing to alter
    assert counts(lab, 'altered') == altered


def counts(g, start):
    """Return counts of the stage once it has told of all that it has answered."""
    answers = g.collect('displacement')
    g.wait(
        lambda: g.diagnostics('stage').get('samples') == str(sum(b.t.size for b in answers)),
        'the count of samples',
    )
    return {k: v for k, v in g.diagnostics('stage').items() if k.startswith(start)}


def test_another_sample_rate_and_block_size(lab):
    voltage = lab.collect('half/voltage')
    assert lab.finish('half/excitation/start')['state'] == 'done'
    sequence = parse_program(SHORT).build(10_000.0)
    lab.wait(lambda: sum(b.t.size for b in voltage) >= sequence.n, 'all blocks')
    t, v = column(voltage)
    assert t.tobytes() == (np.arange(sequence.n) / 10_000.0).tobytes()
    assert v.tobytes() == sequence.v.tobytes()
    assert [b.t.size for b in voltage] == [
        stop - start for start, stop, _ in cut_blocks(sequence.n, sequence.segments, 250)
    ]


def stopped(g, rest):
    """Play up to 9 V, stop, and return the blocks of this run."""
    voltage = g.collect('voltage')
    sent = len(voltage)
    assert g.call('excitation/start')[0]
    g.wait(lambda: len(voltage) > sent and voltage[-1].values[-1] == 9.0, '9 V')
    refused, reason = g.call('excitation/start')
    assert not refused and 'already' in reason
    taken, reason = g.set('excitation', 'voltage_high', 9.5)
    assert not taken and 'cannot be changed while a program is played' in reason
    assert g.call('excitation/stop') == (True, f'ramping to {rest:g} V')
    g.wait(lambda: state(g) == 'stopped', 'stopped')
    g.wait(lambda: voltage[-1].values[-1] == rest, 'rest')
    assert g.call('excitation/stop') == (False, 'nothing is being played')
    t, _ = column(voltage[sent:])
    assert t.tobytes() == (np.arange(t.size) / FS).tobytes()
    assert 'stopping' in [s['state'] for s in g.statuses('excitation')]
    return voltage[sent:]


def test_stop_ramps_to_rest_and_goes_on_with_t(lab):
    assert lab.set('excitation', 'program', HIGH) == (True, '')
    # the test is not what keeps a busy machine from answering
    assert lab.set('excitation', 'block_size', 1000)[0]
    # the stage ends where other programs begin
    for rest, slew in ((1.0, 40.0), (0.0, 20.0)):
        assert lab.set('excitation', 'rest', rest) == (True, '')
        assert lab.set('excitation', 'ramp_slew', slew) == (True, '')
        blocks = stopped(lab, rest)
        ramp = [b for b in blocks if b.segment == 'ramp:stop']
        assert blocks[-1] is ramp[-1]
        down = column(ramp)[1]
        assert down[0] == pytest.approx(9.0, abs=1e-3)
        assert np.all(np.diff(down) <= 0)
        assert -np.diff(down).min() * FS == pytest.approx(slew, rel=1e-3)
    assert lab.set('excitation', 'rest', 0.0)[0]
    assert lab.set('excitation', 'ramp_slew', 20.0)[0]
    assert lab.set('excitation', 'block_size', 100)[0]


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
        ('voltage_low', 20.0, 'crossed'),
        ('rest', -1.0, 'outside the voltage limits'),
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


def test_diagnostics(lab):
    assert lab.set('excitation', 'program', SHORT)[0]
    told = {node: len(lab.diagnoses(node)) for node in ('excitation', 'stage')}
    lab.finish('excitation/start')
    for node, since in told.items():
        lab.wait(
            lambda n=node, s=since: any(float(d.get('rate', 0)) > 0 for d in lab.diagnoses(n)[s:]),
            f'the rate of the {node}',
        )
    seen = lab.diagnostics('excitation')
    assert {'rate', 'samples', 'blocks', 'late', 'worst_delay', 'slipped', 'head_room'} <= set(
        seen
    )
    assert 0.0 <= float(seen['head_room']) <= 1.0
    assert lab.diagnostics('stage')['lost'] == '0'


def test_nobody_listens_somebody_else_talks_and_what_comes_too_late():
    with Graph() as g:
        g.start('excitation', {'program': SLOW, 'wait_limit': 0.3})
        status = g.finish('excitation/start')
        assert status['state'] == 'failed'
        assert '0 of 1 subscribers on /voltage after 0.3 s' in status['text']
        # stop while waiting
        assert g.set('excitation', 'wait_limit', 60.0)[0]
        assert g.call('excitation/start')[0]
        g.wait(lambda: state(g) == 'waiting', 'waiting')
        assert g.call('excitation/stop')[0]
        g.wait(lambda: state(g) == 'stopped', 'stopped')
        assert g.set('excitation', 'wait_limit', 0.3)[0]
        g.collect('voltage')
        g.matched('voltage')
        # a second publisher
        second = g.node.create_publisher(Float64MultiArray, 'voltage', 10)
        g.wait(lambda: g.node.count_publishers('voltage') == 2, 'the second publisher')

        def is_refused():
            ok, message = g.call('excitation/start')
            if ok:
                g.call('excitation/stop')
            return not ok and '/observer publishes on /voltage too' in message

        g.wait(is_refused, 'the refusal')
        g.wait(lambda: state(g) not in ('waiting', 'running', 'stopping'), 'rest')
        g.forget(second)
        # one that comes while a program is played is reported
        g.wait(lambda: g.call('excitation/start')[0], 'the start')
        g.wait(lambda: state(g) == 'running', 'running')
        second = g.node.create_publisher(Float64MultiArray, 'voltage', 10)
        g.wait(
            lambda: any(
                'second publisher' in s['text'] and s['level'] == '1'
                for s in g.statuses('excitation')
            ),
            'the warning',
        )


def test_of_two_of_one_name_that_start_at_once_one_drives_at_most():
    with Graph() as g:
        applied = g.collect('applied_voltage')
        _, *twins = g.start_all(
            ('stage', {'seed': 3}),
            ('excitation', {'program': SHORT}),
            ('excitation', {'program': HIGH}),
        )
        g.matched('applied_voltage')

        asked = []

        def both_hear():
            # a slow twin must not hear the second of two calls after the start
            if not asked or time.monotonic() > asked[-1] + 2.0:
                assert not g.call('excitation/stop')[0]
                asked.append(time.monotonic())
            return all('nothing is being played' in twin.log for twin in twins)

        g.wait(both_hear, 'a call to reach both')
        twin = 'another node is called /excitation too'
        g.wait(lambda: twin in g.diagnostics('excitation').get('message', ''), 'the namesake')
        assert g.diagnostics('excitation')['level'] == '1'
        assert g.call('excitation/start')[0]

        def given_way():
            return [t for t in twins if 'another /excitation drives /voltage now' in t.log]

        # one of them where it has heard the other before its own first block, else both
        g.wait(given_way, 'one to give way')

        def failed():
            return [s for s in g.statuses('excitation') if s['state'] == 'failed']

        g.wait(failed, 'its status')
        assert all('end it first' in s['text'] for s in failed())
        if applied:
            assert np.abs(np.diff(column(applied)[1])).max() * FS <= 40_000.0 * (1 + 1e-9)


def test_a_program_of_another_rate_is_said(lab):
    assert lab.set('excitation', 'program', f'sample_rate: 10000\n{QUIET}') == (True, '')
    ok, said = lab.call('excitation/start')
    assert ok and 'at the 20000 Hz of this node, not at the 10000 Hz of the program' in said, said
    lab.wait(lambda: state(lab) == 'done', 'the end')


def test_it_says_what_it_drives_and_by_how_much_blocks_were_late(lab):
    # it still plays when the node is stopped, however late that is
    longer = QUIET.replace('1.5', '6')
    assert lab.set('excitation', 'program', longer) == (True, '')
    since = len(lab.collect('voltage'))
    ok, said = lab.call('excitation/start')
    assert ok and said.endswith('samples; it drives 0 .. 0 V of 0 .. 10 V'), said
    lab.wait(lambda: len(lab.collect('voltage')) > since, 'the first block')
    node = lab.handle('excitation')
    node.send(signal.SIGSTOP)
    time.sleep(0.1)
    node.send(signal.SIGCONT)
    lab.wait(lambda: state(lab) == 'done', 'the end')
    late = re.search(r'(\d+) blocks late, by up to (\d+) ms', lab.status('excitation')['text'])
    # a longer pause moves the schedule, and all behind it are in time
    assert late and int(late[1]) >= 1 and int(late[2]) >= 80


class Failing(ExcitationNode):
    """A node without ROS whose middleware fails during a program; `ramps` has its ramps."""

    def __init__(self):
        self.ramps = []

    def _await_graph(self, playing):
        raise RuntimeError('no more memory for messages')

    def _ramp(self, playing, *said):
        self.ramps.append(said)

    def reason(self, error):
        """Return the text of an error."""
        return str(error)


def test_any_failure_while_playing_ramps_to_rest_and_is_reported():
    node = Failing()
    node._run(None)
    assert node.ramps == [('failed', 'no more memory for messages')]

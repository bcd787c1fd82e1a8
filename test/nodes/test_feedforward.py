# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The feedforward node as a process, with a simulated stage; the reference is the test's."""

from dataclasses import replace
import re
import time
from types import SimpleNamespace

from course import block, column, FS, model_of, paper
from graph import Graph, in_time
import numpy as np
from piezo_ident.common.config import find_config
from piezo_ident.common.errors import ModelError
from piezo_ident.live.axis_drive import Successor
from piezo_ident.model.files import model_to_yaml
from piezo_ident.nodes import feedforward
from piezo_ident.nodes.feedforward import FeedforwardNode
from piezo_ident.nodes.wire import to_message
import pytest
from std_msgs.msg import Float64MultiArray
import yaml

SIZE = 200
#: a pause that ends a reference, and one that a busy machine does not reach [s]
SHORT, PATIENT = 0.05, 600.0
#: H of a model that has no inverse
FALLS = {'thresholds': [0.1], 'weights': [0.1], 'p1': -0.8, 'p2': 1.5}
CREEP = {'name': 'creep', 'parameters': {'gain': [0.02], 'time_constant': [0.1]}}


def reference(seconds=1.0, frequency=20.0):
    """Return a sine around the middle of the stroke [m]."""
    t = np.arange(round(seconds * FS)) / FS
    return 35e-6 + 20e-6 * np.sin(2 * np.pi * frequency * t)


def state(g):
    return g.status('feedforward')['state']


def is_in(g, wanted):
    g.wait(lambda: state(g) == wanted, wanted)


def sent(g, x, tick=0):
    """Send a reference in real time; return when the node has answered all of it."""
    voltage = g.collect('voltage')
    before, begin = samples(voltage), time.monotonic()
    for k in range(0, x.size, SIZE):
        time.sleep(max(0.0, begin + k / FS - time.monotonic()))
        g.publish('reference', block(tick + k, x[k : k + SIZE], 'scan', 'reference'))
    g.wait(lambda: samples(voltage) >= before + x.size, 'the answers')


def samples(blocks):
    """Return the number of samples of blocks."""
    return sum(b.t.size for b in blocks)


def over(g):
    """End the reference, which may have paused."""
    assert g.set('feedforward', 'silence', SHORT)[0]
    is_in(g, 'done')
    assert g.set('feedforward', 'silence', PATIENT)[0]


def rested(g):
    """End the stream of the stage: the next one is of another publisher."""
    voltage, answers = g.collect('voltage'), g.collect('displacement')
    g.wait(
        lambda: not voltage or (answers and answers[-1].t[-1] == voltage[-1].t[-1]),
        'the last answer',
    )
    assert g.set('stage', 'silence', SHORT)[0]
    g.wait(lambda: g.status('stage')['state'] == 'idle', 'the stage at rest')
    assert g.set('stage', 'silence', PATIENT)[0]


@pytest.fixture(scope='module')
def lab():
    with Graph() as g:
        for topic in ('voltage', 'displacement', 'tracking_error', 'applied_voltage'):
            g.collect(topic)
        g.start_all(
            ('stage', {'seed': 3, 'silence': PATIENT}),
            ('feedforward', {'silence': PATIENT, 'ramp_slew': 100.0, 'window': 0.3}),
        )
        g.matched('displacement')
        g.matched('tracking_error')
        yield g


def given(g, text):
    """Publish a model, and wait until the node has it."""
    g.wait(lambda: 'models' in g.status('feedforward'), 'the status')
    seen = int(g.status('feedforward')['models'])
    g.publish_text('model', text)
    g.wait(lambda: int(g.status('feedforward')['models']) > seen, 'the model')


def armed(g):
    """Start with the stage's own model, and wait until a reference may come."""
    rested(g)
    started(g)


def started(g):
    """Start where there may be no stage."""
    given(g, paper())
    ok, said = g.call('feedforward/start')
    assert ok and 'follows the reference 0.02 s later' in said, said
    is_in(g, 'ready')


def test_without_a_model_it_does_not_start():
    with Graph() as g:
        g.start('feedforward')
        ok, said = g.call('feedforward/start')
        assert not ok and 'there is no model' in said
        g.publish_text('model', paper(hysteresis=FALLS))
        g.wait(lambda: 'slope falls to' in g.status('feedforward')['text'], 'the refusal')
        said = g.status('feedforward')['text']
        assert re.search(r'topic model: .* slope falls to -0\.9 at 10 V', said), said
        assert g.call('feedforward/stop') == (False, 'the node does not drive')


def test_the_stage_goes_where_it_is_told(lab):
    topics = ('voltage', 'tracking_error', 'displacement')
    voltage, errors, answers = (lab.collect(topic) for topic in topics)
    rested(lab)
    first, since, begin = (len(blocks) for blocks in (voltage, errors, answers))
    started(lab)
    assert len(voltage) == first
    x = reference()
    sent(lab, x)
    over(lab)
    t, v = column(voltage[first:])
    assert t.tobytes() == (np.arange(t.size) / FS).tobytes()
    assert v[0] == 0.0 == v[-1]
    assert list(dict.fromkeys(b.segment for b in voltage[first:])) == ['scan', 'ramp:stop']
    # what the stage measured, where the node said
    lab.wait(lambda: samples(errors[since:]) >= x.size + 400, 'the errors')
    told = len(lab.diagnoses('feedforward'))
    t, e = column(errors[since:])
    ty, y = column(answers[begin:])
    assert t.tobytes() == ty[: t.size].tobytes()
    np.testing.assert_allclose((e + y[: t.size])[-x.size // 2 :], x[-x.size // 2 :], atol=1e-12)
    # converters of 16 bit, noise of 1.5 nm
    assert 100.0 * np.sqrt(np.mean(e**2)) / np.ptp(x) < 0.02
    lab.wait(lambda: len(lab.diagnoses('feedforward')) > told + 1, 'the last figure')
    assert float(lab.status('feedforward')['tracking_percent']) < 0.02


def test_a_pause_needs_no_answer_and_a_stage_that_answers_no_more_is_told():
    with Graph() as g:
        voltage, errors = g.collect('voltage'), g.collect('tracking_error')
        g.start('feedforward', {'silence': PATIENT})
        started(g)
        x = reference(0.5)
        # each with its answer: a machine that pauses between them is no stage that is silent
        for k in range(0, x.size, SIZE):
            g.publish('reference', block(k, x[k : k + SIZE], 'scan', 'reference'))
            g.publish('displacement', block(k, np.zeros(SIZE), 'scan', 'displacement'))
        g.wait(lambda: samples(errors) >= x.size, 'the tracking errors')
        seen = len(g.diagnoses('feedforward'))
        g.wait(lambda: len(g.diagnoses('feedforward')) > seen + 3, 'seconds of silence')
        assert voltage and state(g) == 'tracking'
        assert not [d for d in g.diagnoses('feedforward') if 'no displacement' in d['message']]
        assert 'tracking_percent' in g.status('feedforward')
        # the reference goes on, and there is no stage any more
        ticks, said = iter(range(x.size, 10**9, SIZE)), 'no displacement comes'

        def more():
            time.sleep(SIZE / FS)
            g.publish('reference', block(next(ticks), x[:SIZE], 'scan', 'reference'))

        g.wait(lambda: said in g.status('feedforward')['text'], said, meanwhile=more)
        assert 'tracking_percent' not in g.status('feedforward')


def test_another_model_takes_over_while_the_stage_moves(lab):
    armed(lab)
    voltage, x = lab.collect('voltage'), reference(1.2)
    since = len(voltage)
    sent(lab, x[: x.size // 2])
    given(lab, paper(effects=[CREEP]))
    sent(lab, x[x.size // 2 :], x.size // 2)
    assert state(lab) == 'tracking'
    refused, why = lab.set('feedforward', 'voltage_high', 9.0)
    assert not refused and 'while the node drives' in why
    ok, said = lab.call('feedforward/start')
    assert not ok and 'drives already' in said
    assert lab.call('feedforward/stop') == (True, 'ramping to 0 V')
    is_in(lab, 'stopped')
    # the sine moves by 20 mV a sample
    _, v = column([b for b in voltage[since:] if b.segment == 'scan'])
    assert np.abs(np.diff(v)).max() < 0.03
    _, down = column([b for b in voltage[since:] if b.segment == 'ramp:stop'])
    assert down[-1] == 0.0 and np.all(np.diff(down) <= 0)
    assert -np.diff(down).min() * FS <= 100.0 * (1 + 1e-9)


def test_what_is_wrong_with_a_reference_is_told_and_the_limits_hold(lab):
    armed(lab)
    voltage, since = lab.collect('voltage'), len(lab.statuses('feedforward'))
    first = len(voltage)
    bad = np.full(SIZE, 35e-6)
    bad[5:9] = np.nan, np.inf, 1.0, -1.0
    sent(lab, bad)
    # 400 samples are missing, one block comes twice, one is no reference
    sent(lab, np.full(SIZE, 35e-6), SIZE + 400)
    for b in (
        block(SIZE, bad, 'scan', 'reference'),
        block(5 * SIZE, bad, 'scan', 'voltage'),
        block(4 * SIZE, np.full(SIZE, 35.0), 'scan', 'reference'),
        block(4 * SIZE, np.full(SIZE, 90e-6), 'scan', 'reference'),
    ):
        lab.publish('reference', b)
    # the last of them is the only one that is answered
    lab.wait(lambda: samples(voltage[first:]) >= 5 * SIZE, 'the last answer')
    over(lab)
    said = {s['text'] for s in lab.statuses('feedforward')[since:] if s['level'] == '1'}
    told = (
        '400 samples are missing',
        'came',
        'expected is reference',
        'in metres?',
        'out of reach',
        '2 samples of the reference are no numbers',
    )
    for what in told:
        assert any(what in text for text in said), (what, said)
    # the result keeps them, also when they are no news any more
    end = lab.status('feedforward')
    assert end['level'] == '1'
    for what in ('400 samples are missing', 'in metres?', 'out of reach for'):
        assert what in end['text'], end['text']
    # a reference without a start is not dropped without a word
    since = len(lab.statuses('feedforward'))
    lab.publish('reference', block(0, bad, 'scan', 'reference'))
    lab.wait(
        lambda: any('~/start' in s['text'] for s in lab.statuses('feedforward')[since:]), 'a word'
    )
    t, v = column(voltage[first:])
    assert t.tobytes() == (np.arange(t.size) / FS).tobytes()
    assert v.min() >= 0.0 and v.max() <= 10.0
    assert np.abs(np.diff(v)).max() * FS <= 40_000.0 * (1 + 1e-9)


def test_one_drives_at_a_time(lab):
    armed(lab)
    assert lab.call('feedforward/stop')[0]
    is_in(lab, 'stopped')
    # somebody else drives
    tick = iter(range(0, 10**9, SIZE))
    drive = lambda: lab.publish('voltage', block(next(tick), np.zeros(SIZE)))  # noqa: E731
    drive()
    assert lab.call('feedforward/start')[0]
    lab.wait(lambda: state(lab) == 'failed', 'the refusal', meanwhile=drive)
    assert 'observer drives /voltage now' in lab.status('feedforward')['text']
    # who is silent is no hindrance, who comes later is told
    assert lab.call('feedforward/start')[0]
    is_in(lab, 'ready')
    second = lab.node.create_publisher(Float64MultiArray, 'voltage', 10)
    lab.forget(second)
    assert lab.call('feedforward/stop')[0]
    is_in(lab, 'stopped')
    lab.unpublish('voltage')
    # and nobody listens
    assert lab.set('feedforward', 'subscribers', 5)[0]
    assert lab.set('feedforward', 'wait_limit', 0.1)[0]
    status = lab.finish('feedforward/start')
    assert status['state'] == 'failed' and 'of 5 subscribers on /voltage' in status['text']
    assert lab.set('feedforward', 'subscribers', 1)[0]
    assert lab.set('feedforward', 'wait_limit', 10.0)[0]


def test_programs_in_micrometres_are_a_reference(lab):
    program = 'limits: [0, 70]\nrest: 5\nslew: 500\nsegments:\n  - {signal: idle, duration: 0.1}\n'
    program += '  - {signal: sine, bias: 35, amplitude: 25, frequency: 50, periods: 10}\n'
    program += '  - {signal: hold, level: 30, duration: 0.05}\n'
    limits = {'voltage_high': 100.0, 'ramp_slew': 500.0}
    # one reference at a time, too
    lab.unpublish('reference')
    lab.start('excitation', {'quantity': 'reference', 'program': program, **limits})
    taken, why = lab.set(
        'excitation', 'program', program.replace('amplitude: 25', 'amplitude: 36')
    )
    assert not taken and '-1 .. 71 um' in why and ' V' not in why
    voltage, errors = lab.collect('voltage'), lab.collect('tracking_error')
    first, since = len(voltage), len(errors)
    armed(lab)
    n = int(lab.finish('excitation/start')['samples'])
    lab.wait(lambda: samples(voltage[first:]) >= n, 'the answers')
    over(lab)
    lab.wait(lambda: samples(errors[since:]) >= n + 400, 'the errors')
    blocks = errors[since:]
    assert {b.segment for b in blocks if b.segment.startswith('hold')} == {'hold:30um'}
    _, e = column([b for b in blocks if 'sine' in b.segment])
    assert e.size > 3000 and 100.0 * np.sqrt(np.mean(e**2)) / 50e-6 < 0.02
    assert lab.handle('excitation').stop() == 0


def test_a_reference_that_is_repeated_is_learned():
    with Graph() as g:
        for topic in ('voltage', 'displacement'):
            g.collect(topic)
        stage = yaml.safe_load(find_config('effects', 'stage').read_text())
        # a pause between two repetitions takes as long as the machine wants: it is forgotten
        stage['effects'][0]['parameters'] = {'gain': [0.03], 'time_constant': [0.01]}
        file = g.folder / 'creeps.yaml'
        file.write_text(yaml.safe_dump(stage))
        g.start_all(
            ('stage', {'stage': str(file), 'seed': 3, 'silence': PATIENT}),
            ('feedforward', {'silence': PATIENT, 'ramp_slew': 200.0}),
        )
        g.matched('displacement')
        ok, said = g.call('feedforward/learn')
        assert not ok and 'no reference to repeat' in said
        # the model of the stage without its effects
        armed(g)
        sent(g, reference(0.25))
        over(g)
        rested(g)
        since = len(g.collect('voltage'))
        end = g.finish('feedforward/learn')
        assert end['state'] == 'done', end['text']
        told = g.status('feedforward')['text']
        best, first = (float(x) for x in re.findall(r'([0-9.e-]+) %? ?(?:of|in)', told))
        assert first > 1.0 and best < 0.01 * first, told
        blocks = g.collect('voltage')[since:]
        t, v = column(blocks)
        assert t.tobytes() == (np.arange(t.size) / FS).tobytes()
        assert v[0] == 0.0 == v[-1] and v.min() >= 0.0 and v.max() <= 10.0
        assert np.abs(np.diff(v)).max() * FS <= 40_000.0 * (1 + 1e-9)
        assert {b.segment for b in blocks} >= {'learn:1', 'learn:2', 'learn:3', 'ramp:stop'}
        # once more, from the best
        rested(g)
        assert g.finish('feedforward/learn')['state'] == 'done'
        again = g.status('feedforward')['text']
        assert float(again.split()[0]) <= best * 1.001


def test_a_gain_that_changed_is_made_up_for_on_request(lab):
    # of a model whose stage has a gain of 3 % more
    model = model_of(paper(identification={'errors': {'held_out': 0.01}}))
    scaling = replace(model.scaling, Y=model.scaling.Y / 1.03)
    text = model_to_yaml(replace(model, scaling=scaling))
    errors = lab.collect('tracking_error')
    given(lab, text)
    for follow, least, most in (('off', 2.0, 3.0), ('gain', 0.0, 0.1)):
        before = lab.status('feedforward')['models']
        assert lab.set('feedforward', 'follow', follow) == (True, '')
        lab.wait(lambda n=before: lab.status('feedforward')['models'] != n, 'the parameter')
        rested(lab)
        assert lab.call('feedforward/start')[0]
        is_in(lab, 'ready')
        x, since = reference(1.5), len(errors)
        sent(lab, x)
        lab.wait(lambda n=x.size, s=since: samples(errors[s:]) >= n, 'the errors')
        e = column(errors[since:])[1][int(FS) :]
        assert least <= 100.0 * np.sqrt(np.mean(e**2)) / np.ptp(x) <= most
        # the corrections end with the drive
        heard = len(lab.diagnoses('feedforward'))
        lab.wait(lambda n=heard: len(lab.diagnoses('feedforward')) > n + 1, 'the gain')
        told = lab.diagnostics('feedforward')
        over(lab)
        assert ('gain/value' in told) == (follow == 'gain')
    assert float(told['gain/value']) == pytest.approx(0.03, abs=2e-3)
    assert lab.set('feedforward', 'follow', 'off') == (True, '')


@pytest.mark.timed
def test_a_signal_ramps_to_rest(lab):

    handle = lab.handle('feedforward')
    if handle.process.poll() is not None:
        lab.restart(handle)
        lab.matched('tracking_error')
    armed(lab)
    voltage, since = lab.collect('voltage'), len(lab.collect('voltage'))
    sent(lab, reference(0.6))
    begin = time.monotonic()
    assert lab.handle('feedforward').stop() == 0
    took = time.monotonic() - begin
    lab.wait(lambda: voltage[-1].values[-1] == 0.0, 'rest')
    _, v = column(voltage[since:])
    assert np.abs(np.diff(v)).max() < 0.1
    in_time(took, 2.0, 'the end of the node')


class Idle(FeedforwardNode):
    """An idle node without ROS; `wishes` has the sources of the models that it asks for."""

    def __init__(self):
        limits = {'voltage_low': 0.0, 'voltage_high': 10.0, 'rest': 0.0}
        self.values = {**limits, 'slew': 4e4, 'ramp_slew': 20.0, 'follow': 'off'}
        self._rate_of_clock, self._tails, self._state = FS, [''], 'idle'
        self._model, self._source, self._refusal, self._models = 'old', 'old.yaml', '', 0
        self._later = None
        self._errors, self.wishes = SimpleNamespace(clear=lambda: None), []
        self._loader = SimpleNamespace(
            load=lambda source, read: self.wishes.append((source, read())),
            load_file=lambda path: self.wishes.append((path, 'file')),
        )
        self._tracker = self.tracker()

    def tracker(self):
        """Return a tracker for the present limits."""
        return SimpleNamespace(settings=self._settings(), follow=self.values['follow'])

    def set(self, **changed):
        """Set parameters."""
        self.values |= changed
        self.apply(changed)


def test_a_stop_during_the_ramp_after_a_fault_keeps_its_reason():
    node = Idle()
    node._state, node._end = 'stopping', ('failed', 'somebody drives')
    assert node._stop() == 'ramping to 0 V'
    assert node._end == ('failed', 'somebody drives')


@pytest.mark.parametrize('error', [ModelError('runs away'), ValueError('unforeseen')])
def test_any_fault_of_a_block_or_of_the_timer_ends_in_a_ramp(monkeypatch, error):
    def fails(*_):
        raise error

    monkeypatch.setattr(Idle, 'work', fails)
    monkeypatch.setattr(Idle, '_take_complete', fails)
    node, ends = Idle(), []
    node._halt, node.reason = lambda *end: ends.append(end), str
    node._state, node._outputs, node._model, node._busy = 'tracking', [], None, 0.0
    node._on_timer()
    node._wanted = SimpleNamespace(join=SimpleNamespace(add=lambda *_: None))
    node.report_state = lambda: None
    message = to_message(block(0, reference(0.01), 'scan', 'reference'))
    node._on_reference('', message, {'publication_sequence_number': 1})
    assert ends == [('failed', str(error))] * 2


def test_a_model_of_several_axes_that_waits_does_not_replace_a_newer_one():
    node = Idle()
    node._tails, node._later, node._state = ['', '_b'], None, 'tracking'
    node._take_model(('older', node.tracker()), 'older.yaml')
    assert node._later is not None and node._model == 'old'
    node._state = 'done'
    node._take_model(('newer', node.tracker()), 'newer.yaml')
    assert node._later is None and (node._model, node._source) == ('newer', 'newer.yaml')


def test_another_silence_counts_in_the_present_stream():
    node = Idle()
    node._sample_clock = SimpleNamespace(longest_gap=SHORT)
    node.set(silence=PATIENT)
    assert node._sample_clock.longest_gap == PATIENT and node.wishes == []


def test_a_model_that_is_set_together_with_limits_is_the_last_one_to_be_loaded():
    node = Idle()
    node.set(model='new.yaml', voltage_high=5.0)
    assert node.wishes[-1] == ('new.yaml', 'file')


def test_a_model_that_was_prepared_for_earlier_limits_is_prepared_again():
    node = Idle()
    late = 'new', node.tracker()
    node.set(voltage_high=5.0)
    node.wishes.clear()
    node._take_model(late, 'topic model')
    assert node.wishes == [('topic model', 'new')] and node._tracker is None
    node._take_model(('new', node.tracker()), 'topic model')
    assert node._tracker.settings.high == 5.0 and node._model == 'new'


@pytest.mark.parametrize(('count', 'wishes'), [(99, [('topic model', 'new')]), (100, [])])
def test_a_model_that_was_prepared_before_the_kept_voltage_is_prepared_again(count, wishes):
    node, taken = Idle(), []
    node._tracker.remembers = lambda new: new.count >= 100
    node._tracker.take_over = taken.append
    node._take_model(('new', Successor(None, count, None)), 'topic model')
    assert node.wishes == wishes and len(taken) == (not wishes)


def test_learning_goes_on_within_the_same_limits_alone(monkeypatch):
    monkeypatch.setattr(feedforward, 'Learner', lambda make, *_: make())
    monkeypatch.setattr(feedforward, 'LiveLearning', lambda *_: 'planned anew')
    node, kept = Idle(), np.zeros((1, 10))
    node.values |= {'longest': 1.0, 'repetitions': 1}
    node._wanted, node._begin = SimpleNamespace(kept=kept, length=10), lambda: None
    before = SimpleNamespace(model='old', reference=kept, settings=node._settings())
    before.again = lambda: before
    node._learned = before
    node._learn()
    assert node._learner is before
    node.values['voltage_high'] = 5.0
    node._learn()
    assert node._learner == 'planned anew'

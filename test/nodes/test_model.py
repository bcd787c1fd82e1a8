# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The model node as a process: what it predicts, refuses, shows, and when it warns."""

from dataclasses import replace
import time

from course import column, FS, model_of, paper
from graph import Graph
import numpy as np
from piezo_ident.model.estimate import observe
from piezo_ident.model.files import load, model_to_yaml
from piezo_ident.nodes.wire import to_message
from piezo_ident.record.blocks import Samples
from piezo_ident.record.record import Piece
from piezo_ident.uncertainty.band import BandStream, KEY, PredictionBand
import pytest
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

#: blocks under way at once: half of what the model keeps
AHEAD = 50

OTHER_AXIS = {
    'name': 'cross_coupling',
    'parameters': {'channel': 'x', 'gain': 0.01, 'rate_gain': 0.0, 'frequency': 300.0},
}
OTHER = paper(hysteresis={'thresholds': [0.2, 0.5], 'weights': [0.3, 0.2], 'p1': -0.1, 'p2': 0.9})


def sine(n, first=0, frequency=5.0):
    """Return voltage that starts at 0 V."""
    t = np.arange(first, first + n) / FS
    return t, 5.0 - 5.0 * np.cos(2 * np.pi * frequency * t)


def blocks(n, first=0, size=100):
    t, v = sine(n, first)
    return [Samples(t[i : i + size], v[i : i + size], 'sine:5Hz') for i in range(0, n, size)]


def send(g, several):
    """Send blocks of voltage, many of them no faster than they are answered."""
    prediction = g.collect('prediction')
    before = len(prediction)
    for k, block in enumerate(several):
        g.publish('voltage', block)
        if k >= AHEAD:
            g.wait(lambda k=k: len(prediction) > before + k - AHEAD, 'predictions')


@pytest.fixture
def lab():
    with Graph() as g:
        yield g


@pytest.fixture(scope='module')
def fast():
    """Return a graph with a model node that outlives many tests; each begins with a restart."""
    with Graph() as g:
        g.start('model', {'window': 0.2})
        for topic in ('prediction', 'residual'):
            g.matched(topic)
        g.publish_text('model', paper())
        g.wait(lambda: g.status('model').get('models') == '1', 'the model')
        yield g


def heard(g, topic, since, count):
    """Wait for blocks of a topic and return their rows in one piece."""
    g.wait(lambda: len(g.collect(topic)) >= since + count, f'{count} of {topic}')
    return column(g.collect(topic)[since : since + count])


def reset(g, text=None):
    """Set the model, and return how many blocks were heard."""
    taken = int(g.status('model')['models'])
    g.publish_text('model', text or paper())
    g.wait(lambda: int(g.status('model')['models']) > taken, 'model')
    return {topic: len(g.collect(topic)) for topic in ('prediction', 'residual')}


def test_without_a_model_it_waits_and_says_so(lab):
    node = lab.start('model')
    assert node.status()['state'] == 'waiting' or node.status()['state'] == 'idle'
    lab.wait(lambda: node.status()['state'] == 'waiting', 'waiting')
    ok, reason = lab.set('model', 'model', '/nowhere/model.yaml')
    assert not ok and 'no such file' in reason
    # refused texts leave it waiting
    lab.publish_text('model', 'a: [')
    lab.wait(lambda: 'there is no model' in node.status()['text'], 'refusal')
    assert node.status()['level'] == '1' and 'not valid YAML' in node.status()['text']
    lab.publish_text('model', paper(dynamics={'a': [-1.5], 'b': [1.0]}))
    lab.wait(lambda: 'unstable' in node.status()['text'], 'refusal')
    # no voltage brings the further channel of this one
    lab.publish_text('model', paper(effects=[OTHER_AXIS]))
    lab.wait(lambda: "needs the further channel 'x'" in node.status()['text'], 'refusal')
    # voltage that came before the model counts
    prediction = lab.collect('prediction')
    send(lab, [*blocks(2000), Float64MultiArray()])
    # the last of them is no block, and is counted
    lab.wait(lambda: lab.diagnostics('model').get('unreadable') == '1', 'all of it to have come')
    assert any(float(d['rate']) for d in lab.diagnoses('model'))
    assert lab.diagnostics('model')['message'] == 'no model yet'
    lab.publish_text('model', paper())
    lab.wait(lambda: node.status()['state'] == 'predicting', 'model')
    send(lab, blocks(500, 2000))
    lab.wait(lambda: len(prediction) >= 5, 'prediction')
    _, v = sine(2500)
    expected = model_of(paper()).stream().process(v, np.arange(2500) / FS)[2000:]
    np.testing.assert_array_equal(np.concatenate([b.values for b in prediction]), expected)
    assert node.stop() == 0 and 'Traceback' not in node.log


def test_a_model_with_a_band_publishes_its_half_width_beside_the_prediction(fast):
    band = PredictionBand(np.array([1e-3, 2e-3, 1e-5]), np.ones(5), 1e3)
    text = paper(identification={KEY: band.to_dict()})
    halves = fast.collect('prediction_band')
    fast.matched('prediction_band')
    since, before = reset(fast, text), len(halves)
    send(fast, blocks(2000))
    t, y = heard(fast, 'prediction', since['prediction'], 20)
    at, half = heard(fast, 'prediction_band', before, 20)
    np.testing.assert_array_equal(at, t)
    v = sine(2000)[1]
    np.testing.assert_array_equal(half, BandStream(model_of(text), 0.9).follow(v, y))
    assert halves[-1].quantity == 'displacement'


def test_prediction_is_the_model_bit_for_bit_and_a_new_one_takes_over_without_a_glitch(fast):
    since = reset(fast)
    send(fast, blocks(6000))
    t, y = heard(fast, 'prediction', since['prediction'], 60)
    expected_t, v = sine(6000)
    np.testing.assert_array_equal(t, expected_t)
    np.testing.assert_array_equal(y, model_of(paper()).stream().process(v, t))
    last = fast.collect('prediction')[-1]
    assert (last.segment, last.quantity) == ('sine:5Hz', 'displacement')
    taken = int(fast.status('model')['models'])
    fast.publish_text('model', OTHER)
    new, (_, v) = model_of(OTHER), sine(12_000)
    whole = new.stream().process(v, np.arange(12_000) / FS)
    # the swap happens while blocks come: each of them is of one model or the other
    send(fast, blocks(3000, 6000))
    fast.wait(lambda: int(fast.status('model')['models']) > taken, 'the new model')
    send(fast, blocks(3000, 9000))
    t, y = heard(fast, 'prediction', since['prediction'], 120)
    old = model_of(paper()).stream().process(v, t)
    of_new = np.isclose(y, whole, rtol=0, atol=1e-12 * 75e-6)
    of_old = np.isclose(y, old, rtol=0, atol=1e-12 * 75e-6)
    assert np.all(of_new | of_old)
    assert of_new[-3000:].all()


@pytest.mark.parametrize('first', ['voltage', 'displacement'])
def test_residual_joins_whichever_comes_first(fast, first):
    since = reset(fast)
    t, v = sine(2000)
    expected = model_of(paper()).stream().process(v, t)
    y = [
        Samples(b.t, e + 1e-7, b.segment, 'displacement')
        for b, e in zip(blocks(2000), np.split(expected, 20), strict=True)
    ]
    for voltage, displacement in zip(blocks(2000), y, strict=True):
        pair = [('voltage', voltage), ('displacement', displacement)]
        for topic, block in pair if first == 'voltage' else pair[::-1]:
            fast.publish(topic, block)
        time.sleep(0.001)
    got_t, e = heard(fast, 'residual', since['residual'], 20)
    np.testing.assert_array_equal(np.sort(got_t), t)
    np.testing.assert_allclose(e, 1e-7, atol=1e-16)


def rows_of(shown):
    """Return the previews that hold all quantities, by name."""
    rows = [dict(zip(m.name, m.position, strict=True)) for m in shown]
    return [r for r in rows if np.isfinite(list(r.values())).all()]


def watch(g, several, topic='preview'):
    """Subscribe to the preview, send blocks and their predictions as measured, and return both."""
    shown = []
    subscription = g.node.create_subscription(
        JointState, topic, shown.append, QoSProfile(depth=1000)
    )

    def both(block, y):
        g.publish('voltage', block)
        g.publish('displacement', Samples(block.t, y + 2e-9, '', 'displacement'))
        time.sleep(0.00125)

    ticks, last = iter(range(0, 10**9, 100)), []

    def more():
        last[:] = blocks(100, next(ticks))
        both(last[0], np.zeros(100))

    reset(g)
    # nothing else tells when this reader has been met; one block alone is no run of the clock
    g.wait(lambda: len(shown) > 2 and last[0].t[0] > 0.0, 'previews', meanwhile=more)
    # of these nothing may be under way when it begins
    residual = g.collect('residual')
    g.wait(lambda: residual and residual[-1].t[-1] == last[0].t[-1], 'the last residual')
    since = reset(g)
    y = model_of(paper()).stream().process(sine(4000)[1], np.arange(4000) / FS)
    shown.clear()
    for block, part in zip(several, np.split(y, len(several)), strict=True):
        both(block, part)
    heard(g, 'residual', since['residual'], len(several))
    return shown, y, subscription


def test_preview_holds_mean_least_and_largest_of_each_20_ms(fast):
    shown, y, subscription = watch(fast, blocks(4000))
    names = [
        f'{quantity}/{what}'
        for quantity in ('voltage', 'displacement', 'prediction', 'residual', 'estimate')
        for what in ('mean', 'min', 'max')
    ]
    # the last bin is complete when the next begins; one of before may have come late
    mean = pytest.approx(np.split(y, 10)[8].mean(), rel=1e-9)
    fast.wait(lambda: [r['prediction/mean'] == mean for r in rows_of(shown)][-1:] == [True], 'all')
    assert len(rows_of(shown)) >= 9
    assert list(shown[-1].name) == names and shown[-1].header.stamp.sec > 0
    rows = rows_of(shown)[-9:]
    command = np.split(sine(4000)[1], 10)[:9]
    for row, part, v in zip(rows, np.split(y, 10)[:9], command, strict=True):
        assert row['voltage/max'] == v.max()
        for what, value in (('mean', part.mean()), ('min', part.min()), ('max', part.max())):
            assert row[f'prediction/{what}'] == pytest.approx(value, rel=1e-9)
            assert row[f'displacement/{what}'] == pytest.approx(value + 2e-9, rel=1e-9)
            assert row[f'residual/{what}'] == pytest.approx(2e-9, rel=1e-6)
    fast.forget(subscription)


def test_faults_of_the_stream_are_said_and_survived(fast):
    since = reset(fast)
    b = blocks(6000)
    nan = Samples(b[10].t, np.where(np.arange(100) == 3, np.nan, b[10].values), b[10].segment)
    malformed = to_message(b[0])
    malformed.layout.dim[1].label = 'voltage'
    steps = [
        ([*b[:10], nan, *b[11:20]], 19, '100 samples of voltage are missing'),
        ([b[19]], 0, 'came again or out of turn'),
        ([b[21], b[20]], 1, 'came again or out of turn'),
        ([malformed], 0, 'a message on voltage is no block'),
        (b[22:], 38, ''),
    ]
    count = 0
    for several, answers, said in steps:
        begin = len(fast.statuses('model'))
        send(fast, several)
        count += answers

        def told(said=said, begin=begin):
            return any(said in s['text'] for s in fast.statuses('model')[begin - 1 :])

        fast.wait(told, said)
    t, y = heard(fast, 'prediction', since['prediction'], count)
    assert np.isfinite(y).all() and t[-1] == b[-1].t[-1]
    least = {'lost': 200, 'unreadable': 1, 'not_finite': 1, 'late': 200}

    def counted():
        d = fast.diagnostics('model')
        return all(int(d.get(name, 0)) >= n for name, n in least.items())

    fast.wait(counted, 'the counts')
    assert fast.status('model')['state'] == 'predicting'


def test_it_says_when_to_identify_again(fast):
    story = {'errors': {'unit': '% of stroke', 'held_out': 0.1}}
    since = reset(fast, paper(identification=story))
    send(fast, blocks(8000))
    _, y = heard(fast, 'prediction', since['prediction'], 80)
    again = (
        'identify again, or diagnose on this motion: the live error is 0.5 % of stroke, 5.0 times'
    )
    for error, verdict in ((0.2, 'predicting'), (0.5, again)):
        level = error / 100 * 75e-6
        first = 0 if error == 0.2 else 8000
        if first:
            send(fast, blocks(8000, 8000))
            _, y = heard(fast, 'prediction', since['prediction'] + 80, 80)
        for k, (block, part) in enumerate(zip(blocks(8000, first), np.split(y, 80), strict=True)):
            y = part + level * (-1) ** k
            fast.publish('displacement', Samples(block.t, y, block.segment, 'displacement'))
            time.sleep(0.0005)
        fast.wait(
            lambda level=level, verdict=verdict: (
                fast.diagnostics('model').get('residual_rms') == f'{level:.6g}'
                and fast.diagnostics('model')['message'].startswith(verdict)
            ),
            verdict,
        )
    d = fast.diagnostics('model')
    assert d['level'] == '1'
    assert {'rate', 'load', 'lost', 'memory_known'} <= set(d)
    assert fast.set('model', 'warn_ratio', 10.0) == (True, '')
    fast.wait(lambda: fast.diagnostics('model')['message'] == 'predicting', 'taken back')
    assert fast.set('model', 'warn_ratio', 3.0) == (True, '')


def test_a_constant_error_is_said_and_wild_readings_are_left_out(fast):
    reset(fast, paper(identification={'errors': {'unit': '% of stroke', 'held_out': 0.1}}))
    _, v = sine(8000)
    y = model_of(paper()).stream().process(v, np.arange(8000) / FS) + 0.5e-2 * 75e-6
    # lost words, also on both sides of the end of a block
    y[4950::500] = 1.0
    y[5099:5101] = 0.0
    judged(fast, blocks(8000), y)
    said = 'wild readings of displacement are left out of the live error'
    # the first of them are told before the last blocks have come
    fast.wait(lambda: fast.diagnostics('model')['outliers'] == '9', 'all wild readings')
    fast.wait(lambda: f'9 {said}' in fast.status('model')['text'], 'the wild readings')
    d = fast.diagnostics('model')
    assert said in d['message']
    # a zero that moved is corrected and said, and no reason to identify again
    fast.wait(lambda: 'corrected: offset' in fast.diagnostics('model')['message'], 'the offset')
    d = fast.diagnostics('model')
    assert 'identify again' not in d['message'] and 'corrected: offset +0.3' in d['message']
    assert float(d['estimate_percent']) < 0.1
    assert float(d['residual_rms']) == pytest.approx(0.5e-2 * 75e-6, rel=1e-3)
    assert float(d['residual_mean']) == pytest.approx(0.5e-2 * 75e-6, rel=1e-3)


def test_a_gain_that_changed_is_told_by_size_and_corrected_on_request(fast):
    text = paper(identification={'errors': {'unit': '% of stroke', 'held_out': 0.01}})
    y = 1.03 * model_of(paper()).stream().process(sine(16_000)[1], np.arange(16_000) / FS)
    for observed in (False, True):
        assert fast.set('model', 'observe_gain', observed) == (True, '')
        reset(fast, text)
        corrections = []
        subscription = fast.node.create_subscription(
            JointState, 'corrections', corrections.append, QoSProfile(depth=1000)
        )
        # the node knows of the reader of the corrections, too
        fast.matched('residual')
        judged(fast, blocks(16_000), y)

        def told(observed=observed):
            said = fast.diagnostics('model')['message']
            return 'gain +3.0' in said and said.startswith('identify again') != observed

        fast.wait(told, 'the gain')
        if observed:
            d = fast.diagnostics('model')
            assert float(d['gain/value']) == pytest.approx(0.03, abs=1e-3)
            assert 'gain/std' in corrections[-1].name
            assert float(d['estimate_percent']) < 0.01
        fast.forget(subscription)
    assert fast.set('model', 'observe_gain', False) == (True, '')


def test_what_is_learnt_is_written_on_request_and_forgotten_on_another(fast, tmp_path):
    assert fast.set('model', 'adapt', 'hysteresis') == (True, '')
    text = paper(identification={'errors': {'unit': '% of stroke', 'held_out': 0.01}})
    reset(fast, text)
    given = model_of(text)
    v, t = sine(40_000)[1], np.arange(40_000) / FS
    prediction, y = given.stream().process(v, t), 1.03 * given.stream().process(v, t)
    # predictions of an earlier test may still come
    predictions = fast.collect('prediction')
    judged(fast, [replace(b, segment='learn') for b in blocks(40_000)], y)
    own = []

    def all_came():
        own[:] = [b for b in predictions if b.segment == 'learn']
        return len(own) == 400

    fast.wait(all_came, 'the predictions')
    fast.wait(lambda: float(fast.diagnostics('model').get('learnt/gain', 0)) > 0.029, 'the gain')
    ok, said = fast.call('model/save')
    assert not ok and "'output' is empty" in said
    path = tmp_path / 'learnt.yaml'
    assert fast.set('model', 'output', str(path)) == (True, '')
    assert fast.call('model/save')[0]
    learnt = load(path)
    assert np.abs(learnt.simulate(v) - y).max() < 2e-8
    assert learnt.identification['adaptation'][0]['gain']['value'] == pytest.approx(0.03, abs=1e-3)
    # the prediction is of the model as given
    assert np.array_equal(column(own)[1], prediction)
    ok, said = fast.call('model/restore')
    assert ok and 'as it was given' in said
    assert fast.set('model', 'adapt', 'off') == (True, '')
    ok, said = fast.call('model/save')
    assert not ok and 'adapt is off' in said
    assert fast.set('model', 'output', '') == (True, '')


def test_a_step_of_the_sensor_is_accepted_at_once(fast):
    reset(fast, paper(identification={'errors': {'unit': '% of stroke', 'held_out': 0.01}}))
    y = model_of(paper()).stream().process(sine(24_000)[1], np.arange(24_000) / FS)
    y[8000:] += 1e-6
    # estimates of an earlier test may still come
    several = [replace(b, segment='accept') for b in blocks(24_000)]
    estimate = fast.collect('estimate')

    def until(begin, end):
        paired(fast, several[begin:end], y[100 * begin : 100 * end])
        last = ('accept', several[end - 1].t[-1])
        fast.wait(lambda: estimate and (estimate[-1].segment, estimate[-1].t[-1]) == last, 'all')
        return fast.call('model/accept')

    ok, said = until(0, 80)
    assert not ok and 'no step to accept' in said
    ok, said = until(80, 120)
    assert ok and '+1 um' in said, said
    fast.wait(lambda: 'reading or zero' in fast.status('model')['text'], 'the step')
    until(120, 240)
    assert np.abs(estimate[-1].values - y[-100:]).max() < 2e-8


@pytest.mark.parametrize(
    ('fault', 'says'),
    [
        (lambda y: 60e-6 - y, 'it moves against the stage'),
        (lambda y: np.full(y.size, y[0]), 'it stays the same while the stage should move'),
    ],
    ids=['other sign', 'stuck'],
)
def test_a_sensor_of_the_other_sign_and_one_that_is_stuck_are_told(fast, fault, says):
    reset(fast, paper(identification={'errors': {'unit': '% of stroke', 'held_out': 0.01}}))
    y = model_of(paper()).stream().process(sine(12_000)[1], np.arange(12_000) / FS)
    y[6000:] = fault(y[6000:])
    since, said = len(fast.statuses('model')), f'reading or zero of the displacement: {says}'
    compared(fast, blocks(12_000), y)
    fast.wait(
        lambda: any(
            said in s['text'] and s['level'] == '1' for s in fast.statuses('model')[since:]
        ),
        said,
    )


def test_displacement_is_as_old_as_the_horizon_where_it_is_used(fast):
    assert fast.set('model', 'horizon', 250) == (True, '')
    text = paper(identification={'errors': {'unit': '% of stroke', 'held_out': 0.01}})
    reset(fast, text)
    v = sine(8000)[1]
    y = model_of(text).stream().process(v, np.arange(8000) / FS) + 3e-7
    several = [replace(b, segment='horizon') for b in blocks(8000)]
    estimate, prediction = fast.collect('estimate'), fast.collect('prediction')

    def came(topic):
        return [b for b in topic if b.segment == 'horizon']

    paired(fast, several[:40], y[:4000])
    send(fast, several[40:])
    fast.wait(lambda: len(came(prediction)) == 80, 'the predictions')
    # two blocks and a half after the last displacement
    fast.wait(lambda: len(came(estimate)) >= 42, 'the estimates')
    assert len(came(estimate)) == 42
    for b, part in zip(several[40:], np.split(y[4000:], 40), strict=True):
        fast.publish('displacement', Samples(b.t, part, b.segment, 'displacement'))
    fast.wait(lambda: len(came(estimate)) == 80, 'all estimates')
    seen = observe(model_of(text), Piece(v, y, FS), horizon=250)
    np.testing.assert_allclose(
        column(came(estimate))[1], seen.estimate, rtol=0, atol=1e-12 * 75e-6
    )
    assert fast.set('model', 'horizon', 100) == (True, '')


def test_the_estimate_goes_on_behind_a_gap_and_a_restart(fast):
    reset(fast, paper(identification={'errors': {'unit': '% of stroke', 'held_out': 0.01}}))
    # a zero that moved is in each estimate
    y = model_of(paper()).stream().process(sine(8000)[1], np.arange(8000) / FS) + 3e-7
    estimate = fast.collect('estimate')
    for segment, cuts in (('gap', ((0, 30), (32, 80))), ('restart', ((0, 80),))):
        several = [replace(b, segment=segment) for b in blocks(8000)]
        for begin, end in cuts:
            paired(fast, several[begin:end], y[100 * begin : 100 * end])
        last = (segment, several[-1].t[-1])
        fast.wait(
            lambda last=last: estimate and (estimate[-1].segment, estimate[-1].t[-1]) == last,
            'all estimates',
        )
        assert np.abs(estimate[-1].values - y[-100:]).max() < 5e-8


def paired(g, several, y):
    """Send blocks of voltage, each with the displacement of the same time."""
    for block, part in zip(several, np.split(y, len(several)), strict=True):
        g.publish('voltage', block)
        g.publish('displacement', Samples(block.t, part, block.segment, 'displacement'))


def compared(g, several, y):
    """Send pairs of blocks no faster than they are compared, and wait for the last residual."""
    residual = g.collect('residual')
    before = len(residual)
    for k, (block, part) in enumerate(zip(several, np.split(y, len(several)), strict=True)):
        paired(g, [block], part)
        g.wait(lambda k=k: len(residual) > before + k - AHEAD, 'residuals')
    count, last = before + len(several), several[-1].t[-1]
    g.wait(lambda: len(residual) >= count and residual[-1].t[-1] == last, 'the last residual')


def judged(g, several, y):
    """Send pairs of blocks, and wait until the live error is of all of them."""
    compared(g, several, y)
    told = len(g.diagnoses('model'))
    g.wait(lambda: len(g.diagnoses('model')) > told, 'diagnostics')
    g.wait(lambda: g.diagnostics('model').get('residual_rms', 'nan') != 'nan', 'an error')


def test_two_stages_at_once_are_said(lab):
    # a node of its own: the streams of two stages look like restarts to it
    lab.start('model', {'window': 0.2})
    lab.publish_text('model', paper())
    lab.wait(lambda: lab.status('model').get('models') == '1', 'the model')
    # as where a launch file is started twice; in silence a stage at 0 V is at rest
    stages = lab.start_all(('stage', {'seed': 1}), ('stage', {'seed': 2}))
    told = {node: len(lab.diagnoses(node)) for node in ('model', 'stage')}
    ticks = iter(range(0, 10**9, 100))

    def said(node, text):
        return any(text in d['message'] for d in lab.diagnoses(node)[told[node] :])

    def more():
        (b,) = blocks(100, next(ticks))
        lab.publish('voltage', replace(b, values=np.zeros(100)))

    again = 'samples of displacement came again or out of turn: do two nodes publish it?'
    for node, text in (
        ('model', again),
        ('model', '/stage and /stage do'),
        ('stage', 'another node is called /stage too'),
    ):
        lab.wait(lambda n=node, x=text: said(n, x), f'{node} to say {text!r}', meanwhile=more)
    assert [stage.stop() for stage in stages] == [0, 0]


def test_an_error_of_the_past_is_not_shown_when_nothing_can_be_judged(fast):
    reset(fast)
    judged(fast, blocks(4000), np.zeros(4000))
    # behind a gap, and not at the lowest voltage, the error is not known
    paired(fast, blocks(1000, 5000), sine(1000, 5000)[0])
    said = 'the memory is unknown until the voltage has been at its lowest'
    fast.wait(lambda: fast.diagnostics('model')['message'] == said, said)
    d = fast.diagnostics('model')
    assert d['residual_rms'] == 'nan' and d['memory_known'] == 'False' and d['level'] == '1'


def test_it_says_that_no_displacement_comes_or_none_of_the_same_time(fast):
    reset(fast)
    judged(fast, blocks(4000), np.zeros(4000))
    first, d, prediction = 4000, {}, fast.collect('prediction')
    for shift, said in ((None, 'no displacement comes'), (1e-5, '0 % of the voltage is met by')):

        def sent(shift=shift, said=said):
            nonlocal first, d
            (block,) = blocks(100, first)
            first += 100
            fast.publish('voltage', block)
            if shift is not None:
                moved = Samples(block.t + shift, block.values, block.segment, 'displacement')
                fast.publish('displacement', moved)
            # of a second in which nothing is sent nothing is said
            d = fast.diagnostics('model')
            return d['message'].startswith(said)

        fast.wait(sent, said)
        assert d['level'] == '1' and d['residual_rms'] == 'nan'
    # nothing is under way when another test begins
    last = blocks(100, first - 100)[0].t[-1]
    fast.wait(lambda: prediction[-1].t[-1] == last, 'the last prediction')


def test_a_model_that_comes_later_finds_no_fault_with_what_came_before(lab):
    lab.start('model')
    lab.wait(lambda: lab.diagnoses('model'), 'diagnostics')
    seconds, first = lab.diagnoses('model'), 0

    def more(count):
        nonlocal first
        paired(lab, blocks(100 * count, first), np.zeros(100 * count))
        first += 100 * count

    # a second without a model, and most of the next one
    seen = len(seconds)
    lab.wait(lambda: len(seconds) > seen + 1, 'a second', meanwhile=lambda: more(1))
    seen = len(seconds)
    more(40)
    lab.publish_text('model', paper())
    lab.wait(lambda: lab.status('model').get('models') == '1', 'the model')
    more(10)
    lab.wait(lambda: len(seconds) > seen + 1, 'diagnostics')
    assert {d['message'] for d in seconds[seen:]} <= {'no model yet', 'predicting'}


def test_where_nothing_is_predicted_displacement_is_not_to_blame(lab):
    lab.start('model')
    lab.publish_text('model', paper())
    lab.wait(lambda: lab.status('model').get('models') == '1', 'the model')
    lab.wait(lambda: lab.diagnoses('model'), 'diagnostics')
    seconds, first = lab.diagnoses('model'), 0

    def more():
        nonlocal first
        (b,) = blocks(100, first)
        paired(lab, [Samples(2.0 * b.t, b.values, b.segment)], np.zeros(100))
        first += 100

    lab.wait(lambda: [d for d in seconds if 'sampled at' in d['message']], 'why', meanwhile=more)
    seen = len(seconds)

    def later():
        # of a second in which nothing came nothing is said
        return [d for d in seconds[seen:] if float(d['rate']) > 0.0]

    lab.wait(lambda: len(later()) > 2, 'more', meanwhile=more)
    for d in later():
        assert d['level'] == '1' and d['message'].startswith('the stream is sampled at 10000 Hz')


def test_a_model_of_another_rate_is_refused_and_the_old_one_kept(fast):
    since = reset(fast)
    send(fast, blocks(1000))
    heard(fast, 'prediction', since['prediction'], 10)
    fast.publish_text('model', paper(sample_rate=5000.0))
    said = 'the old model is kept: topic model: the stream is sampled at 20000 Hz'
    fast.wait(lambda: said in fast.status('model')['text'], said)
    send(fast, blocks(500, 1000))
    _, y = heard(fast, 'prediction', since['prediction'] + 10, 5)
    _, v = sine(1500)
    whole = model_of(paper()).stream().process(v, np.arange(1500) / FS)
    np.testing.assert_array_equal(y, whole[1000:])


def test_a_model_file_is_taken_at_start_and_later(lab, tmp_path):
    file, other = tmp_path / 'one.yaml', tmp_path / 'other.yaml'
    file.write_text(paper())
    other.write_text(model_to_yaml(model_of(OTHER)))
    node = lab.start('model', {'model': str(file), 'preview_rate': 100.0})
    lab.wait(lambda: node.status()['state'] == 'predicting', 'the file')
    assert node.status()['text'] == f'with {file}'
    assert lab.set('model', 'model', str(other)) == (True, '')
    lab.wait(lambda: node.status()['text'] == f'with {other}', 'the other file')
    lab.wait(lambda: 'model 2 is taken over' in node.log, 'a line of it')
    prediction = lab.collect('prediction')
    lab.matched('prediction')
    send(lab, blocks(1000))
    lab.wait(lambda: len(prediction) >= 10, 'predictions')
    _, v = sine(1000)
    expected = load(other).stream().process(v, np.arange(1000) / FS)
    np.testing.assert_array_equal(np.concatenate([b.values for b in prediction]), expected)
    # every 10 ms rather than 20
    shown, y, _ = watch(lab, blocks(4000))
    mean = pytest.approx(np.split(y, 20)[18].mean(), rel=1e-9)
    lab.wait(lambda: [r['prediction/mean'] == mean for r in rows_of(shown)][-1:] == [True], 'all')
    means = [row['prediction/mean'] for row in rows_of(shown)[-19:]]
    np.testing.assert_allclose(means, [p.mean() for p in np.split(y, 20)[:19]], rtol=1e-9)


CREEP = [{'name': 'creep', 'parameters': {'gain': [0.02] * 3, 'time_constant': [0.1, 1.0, 10.0]}}]


def as_it_creeps(n):
    """Return the text of a model, and voltage and displacement after a second at the top."""
    text = paper(effects=CREEP, identification={'errors': {'held_out': 0.01}})
    up = np.linspace(0.0, 10.0, 2000)
    before = np.concatenate([up, np.full(20_000, 10.0), up[::-1]])
    v = np.concatenate([before, sine(n)[1]])
    y = model_of(text).stream().process(v, np.arange(v.size) / FS)
    return text, y[before.size :]


def test_the_estimate_knows_of_creep_from_before_the_stream(lab):
    n = 12_000
    text, truth = as_it_creeps(n)
    lab.start('model')
    estimate = lab.collect('estimate')
    for topic in ('prediction', 'estimate'):
        lab.collect(topic)
        lab.matched(topic)
    lab.publish_text('model', text)
    lab.wait(lambda: lab.status('model').get('models') == '1', 'the model')
    corrections = []
    subscription = lab.node.create_subscription(
        JointState, 'corrections', corrections.append, QoSProfile(depth=1000)
    )
    # the node knows of the reader of the corrections, too
    lab.matched('prediction')
    before, several = len(estimate), blocks(n)
    measured = truth + 1.5e-9 * np.random.default_rng(1).standard_normal(n)
    # the sensor dies at 0.5 s
    send_both = several[:100]
    for k, (block, part) in enumerate(zip(several, np.split(measured, len(several)), strict=True)):
        if k < len(send_both):
            lab.publish('displacement', Samples(block.t, part, block.segment, 'displacement'))
        send(lab, [block])
    t, y = heard(lab, 'prediction', 0, len(several))
    # the horizon is a block: the one after the last reading has its estimate, the others wait
    told = len(send_both) + 1
    lab.wait(lambda: len(estimate) >= before + told, 'estimates')
    found = column(estimate[before : before + told])
    assert np.array_equal(found[0], t[: found[0].size])
    assert estimate[before].segment == several[0].segment
    late = slice(2000, found[0].size)
    off, free = (np.sqrt(np.mean((x[late] - truth[late]) ** 2)) for x in (found[1], y))
    assert free > 0.005 * 75e-6 and off < 0.02 * free
    # another half a second, and it goes on without
    more = blocks(8000, n)
    send(lab, more)
    lab.wait(lambda: len(estimate) >= before + 200, 'estimates without a sensor')
    _, y = column(estimate[before : before + 120])
    late = slice(10_100, n)
    assert np.sqrt(np.mean((y[late] - truth[late]) ** 2)) < 0.1 * free
    lab.wait(lambda: len(corrections) >= 45, 'corrections')
    names = ['offset/value', 'offset/std', 'creep/value', 'creep/std']
    assert list(corrections[-1].name)[:4] == names
    lab.forget(subscription)

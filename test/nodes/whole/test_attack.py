# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The graph under attack: nodes stay up, say what they refuse, and the voltage is safe."""

from pathlib import Path
import re

from attack import contradiction, odd_messages, start
from course import FS, level, paper
from graph import Graph
import numpy as np
from piezo_ident.nodes.wire import SERVICE, to_message
from piezo_ident.record.blocks import Samples, time_problem
import pytest
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

pytestmark = pytest.mark.loads


@pytest.fixture(scope='module')
def attack():
    with Graph() as g:
        # on the topic, the model node would hear it, too
        model = g.folder / 'model.yaml'
        model.write_text(paper())
        yield start(
            g,
            {
                'stage': {'seed': 3},
                'excitation': {'rest': 1.0},
                'identifier': {},
                'model': {},
                'recorder': {'output': str(g.folder / 'bag')},
                'player': {},
                'feedforward': {'model': str(model), 'silence': 600.0},
            },
        )


def refused_messages(topic='voltage'):
    """Yield messages that are no blocks, and what is said of each: a status has the last one."""
    refused = (
        ('an offset', 'layout announces 100 x 2 numbers'),
        ('10,000 dimensions', '10000 dimensions are not'),
        ('a label of 1 MB', 'a label of more than 200 characters'),
        ('300,000 doubles', '300000 numbers in one message'),
    )
    messages = dict(odd_messages(150_000))
    for what, said in refused:
        (message,) = (m for name, m in messages.items() if name.startswith(what))
        yield message, said
    ticks = np.arange(100) / FS
    for t in (np.full(100, 1e300), ticks[::-1], np.delete(ticks, 50), ticks[:0]):
        yield to_message(Samples(t, np.zeros(t.size), 'strange', topic)), time_problem(t)


def at_rest(g):
    g.wait(lambda: g.status('stage')['state'] == 'idle', 'the stage at rest')


def refused_by(g):
    """Return how many blocks of voltage, and of all topics, the nodes say that they refused."""
    told = ' '.join(('', g.diagnostics('identifier').get('message', '')))
    found = re.findall(r' (\d+) messages on (\w+) are no blocks', told)
    captured = {topic: int(count) for count, topic in found}
    return (
        int(g.diagnostics('stage')['refused_malformed']),
        captured.get('voltage', 0),
        sum(captured.values()),
        int(g.diagnostics('model')['unreadable']),
    )


def test_messages_that_are_no_blocks_are_refused_by_everybody(attack):
    g = attack.g
    # one that is followed, so that what comes is beside it
    attack.send('voltage', level(0.0, 1)[0])
    seen = {node: len(g.statuses(node)) for node in ('model', 'identifier')}
    attack.messages(1000)
    for node in seen:
        g.wait(
            lambda node=node: any(s['level'] == '1' for s in g.statuses(node)[seen[node] :]),
            f'{node} to warn',
        )
    for message, problem in refused_messages():
        attack.send('voltage', message)
        for node in ('stage', 'model', 'identifier'):
            g.wait(
                lambda node=node, said=problem: any(said in s['text'] for s in g.statuses(node)),
                f'{node} to say {problem!r}',
            )
    # no number of 300 digits, and nothing that was sent is said again at its length
    assert max(len(s['text']) for s in g.statuses('identifier')) < 2000
    assert 'Warning' not in g.handle('model').log + g.handle('identifier').log
    assert max(len(s['text']) for s in g.statuses('stage')) < 2000
    assert max(len(s['text']) for s in g.statuses('model')) < 4000

    def counted():
        by_stage, by_identifier, on_all, by_model = refused_by(g)
        return 15 <= by_stage == by_identifier and on_all == by_model

    # what one of them refuses is refused, and counted, by all
    g.wait(counted, 'equal counts of refused blocks')


def test_a_reference_that_is_no_block_is_refused_as_a_voltage_is(attack):
    g = attack.g
    at_rest(g)
    g.wait(lambda: g.status('feedforward').get('models') == '1', 'the model of the file')
    assert g.call('feedforward/start')[0]
    g.wait(lambda: g.status('feedforward')['state'] == 'ready', 'the right to drive')
    count = 0
    # displacement is of use while a reference is followed
    for topic, about in (
        ('reference', 'a block is refused'),
        ('displacement', 'a block of displacement is refused'),
    ):
        for message, problem in refused_messages(topic):
            g.publish(topic, message)
            count += 1
            g.wait(
                lambda said=f'{about}: {problem}': any(
                    said in s['text'] and s['level'] == '1' for s in g.statuses('feedforward')
                ),
                f'feedforward to say {about}: {problem}',
            )
        said = str(count)
        g.wait(lambda said=said: g.diagnostics('feedforward')['refused'] == said, 'the count')
        if topic == 'reference':
            g.publish(topic, Samples(np.arange(100) / FS, np.zeros(100), 'rest', topic))
            g.wait(lambda: g.status('feedforward')['state'] == 'tracking', 'the reference')
    # the result keeps it
    assert g.finish('feedforward/stop', 'stopped')['level'] == '1'
    attack.survived('references that are no blocks')


@pytest.mark.parametrize('seed', range(3))
def test_any_number_at_any_time_keeps_limits_and_slew(attack, seed):
    before = attack.samples
    attack.blocks(seed, 200)
    attack.g.wait(lambda: attack.samples > before, 'what is applied')
    at_rest(attack.g)
    attack.is_safe('silence')
    attack.g.wait(lambda: attack.applied[-1][-1] == 0.0, 'rest')


@pytest.mark.parametrize('node', ['stage', 'excitation', 'identifier', 'model', 'player'])
def test_parameters_of_wrong_types_are_refused(attack, node):
    attack.parameters(node)
    # a type that does not exist is said on the log
    handle = attack.g.handle(node)
    attack.g.wait(lambda: '99 is not a valid' in handle.log, 'the log')
    assert 'the node goes on' in handle.log


@pytest.mark.parametrize('node', ['stage', 'excitation'])
def test_two_that_contradict_each_other_are_refused_together(attack, node):
    answer = attack.set_raw(node, contradiction(), at_once=True)
    assert not answer.result.successful
    assert 'outside the voltage limits 0 .. 4 V' in answer.result.reason
    attack.survived('a contradiction')


def test_a_topic_full_of_foreign_models_is_refused(attack):
    trace = Path('/tmp/piezo_ident_was_here')
    trace.unlink(missing_ok=True)
    said = attack.models(paper())
    assert not trace.exists()
    assert all('there is no model' in s and len(s) < 1000 for s in said)
    attack.model.publish(attack._text(data=paper()))
    g = attack.g
    g.wait(lambda: g.status('model')['state'] == 'predicting', 'a model that is one')


def test_four_clients_that_call_as_fast_as_they_can(attack):
    rate = attack.services(2.0)
    print(f'{rate:.0f} calls a second')
    assert rate > 0
    g = attack.g
    g.call('excitation/stop')
    at_rest(g)


def test_an_answer_waits_for_who_is_slow_to_take_it(attack):
    g = attack.g
    node = Node('slow', context=g.context, start_parameter_services=False, enable_rosout=False)
    executor = SingleThreadedExecutor(context=g.context)
    executor.add_node(node)
    try:
        client = node.create_client(Trigger, '/recorder/stop', qos_profile=SERVICE)
        g.wait(client.service_is_ready, 'the service')
        # made after the client: when this one is known, so is that
        g.client(Trigger, 'recorder/stop')
        g.known_to('recorder')
        answer = client.call_async(Trigger.Request())
        # everybody's answers come to all who ask
        for _ in range(50):
            assert not g.call('recorder/stop')[0]
        executor.spin_until_future_complete(answer, 60.0)
        assert answer.done() and 'not recording' in answer.result().message
    finally:
        executor.shutdown()
        node.destroy_node()


def test_the_stage_ramps_to_rest_whatever_the_clock_of_ros_does(attack):
    g = attack.g
    at_rest(g)
    assert g.set('stage', 'use_sim_time', True)[0]
    silence = g.get('stage', 'silence')
    # the stream is as slow as the machine is busy
    assert g.set('stage', 'silence', 60.0)[0]
    before = attack.samples
    # whoever publishes on /clock holds the time of everybody who listens to it
    for b in level(5.0, 160):
        attack.send('voltage', b)
        if round(b.t[0] * 200) % 40 == 39:
            g.wait(lambda b=b: attack.samples >= before + round(b.t[-1] * 20_000), 'the stage')
    assert max(v.max() for v in attack.applied) > 4.9
    assert g.set('stage', 'silence', silence)[0]
    at_rest(g)
    g.wait(lambda: attack.applied[-1][-1] == 0.0, 'rest')
    attack.survived('a clock that stands still')


def test_limits_that_are_moved_in_silence_are_kept(attack):
    g = attack.g
    at_rest(g)
    try:
        assert g.set('stage', 'rest', 2.0)[0]
        g.wait(lambda: attack.applied[-1][-1] == 2.0, 'the new rest')
        assert g.set('stage', 'voltage_low', 1.5)[0]
        assert not g.set('stage', 'rest', 1.0)[0]
    finally:
        assert g.set('stage', 'voltage_low', 0.0)[0]
        assert g.set('stage', 'rest', 0.0)[0]
    g.wait(lambda: attack.applied[-1][-1] == 0.0, 'rest')

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""Faster than real time on a running graph: whoever answers is never overrun."""

from collections.abc import Mapping
from pathlib import Path
import signal

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from graph import Graph
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.nodes.wire import to_message
from piezo_ident.record.bags.read import MESSAGE_TYPE
from piezo_ident.record.bags.write import BagWriter
from piezo_ident.record.blocks import Samples
from rclpy.serialization import serialize_message

FS = 20_000.0
N = 1000
PROGRAM = """
limits: [0, 10]
segments:
  - {signal: sine, bias: 5, amplitude: 4, frequency: 5, duration: 5}
"""


def bag(
    path: Path,
    n: int = N,
    order: tuple[str, ...] = ('voltage', 'displacement'),
    ends: Mapping[str, int] = {},
) -> Path:
    """Write a bag of n blocks of each that came at once; some end before."""
    writer = BagWriter(path)
    for quantity in order:
        writer.add_topic(f'/{quantity}', MESSAGE_TYPE)
    for k in range(n):
        t = np.arange(100 * k, 100 * (k + 1)) / FS
        for quantity in order:
            if k >= ends.get(quantity, n):
                continue
            block = Samples(t, 1e-6 * np.sin(t), 'noise', quantity)
            writer.write(f'/{quantity}', 10**18 + 50_000 * k, serialize_message(to_message(block)))
    writer.close()
    return path


def captured(g: Graph) -> int:
    """Return how many samples of both streams the identifier says it has."""
    blocks = g.collect('captured')
    return int(blocks[-1].values[-1]) if blocks else 0


def play(g: Graph, node: str) -> tuple[str, dict[str, str]]:
    """Start a node and return its answer, and its status at the end."""
    before = len(g.statuses(node))
    ok, message = g.call(f'{node}/start')
    assert ok, message

    def ends() -> list[dict[str, str]]:
        return [s for s in g.statuses(node)[before:] if s['state'] in ('done', 'failed')]

    g.wait(ends, f'end of {node}')
    return message, ends()[0]


def test_a_replay_waits_for_the_identifier_and_ends_when_it_has_all(tmp_path):
    with Graph() as g:
        g.collect('captured')
        identifier = g.start('identifier')
        g.start('player', {'bag': str(bag(tmp_path / 'bag')), 'rate': 100.0, 'wait_limit': 30.0})
        g.matched('captured')
        for round_ in (1, 2):
            _, status = play(g, 'player')
            assert (status['state'], status['messages']) == ('done', str(2 * N))
            # without the flow control it loses most of them: they are due within 50 ms in all
            g.wait(lambda r=round_: captured(g) == 100 * N * r, 'all samples')
        last = g.collect('captured')[-1]
        assert last.quantity == 'captured' and last.segment == 'noise'
        assert last.t[-1] == (100 * N - 1) / FS
        # one that says no more is waited for, but not for ever
        assert g.set('player', 'wait_limit', 1.0)[0]
        identifier.send(signal.SIGSTOP)
        _, status = play(g, 'player')
        assert status['state'] == 'failed' and 'no captured for 1 s' in status['message']
        assert 0 < int(status['messages']) < 2 * 90
        identifier.send(signal.SIGCONT)
        # one that has gone is not waited for
        assert identifier.stop() == 0
        assert g.set('player', 'wait_limit', 30.0)[0]
        assert g.set('player', 'subscribers', 0)[0]
        assert play(g, 'player')[1]['state'] == 'done'
        for value, reason in (
            ('a b a', 'each topic once'),
            ('a b!', "answers: 'b!' is no name of a topic"),
        ):
            ok, why = g.set('player', 'answers', value)
            assert not ok and reason in why


@pytest.mark.parametrize(
    ('listener', 'order', 'answer'),
    [
        ('identifier', ('displacement', 'voltage'), 'captured'),
        # the model goes by the voltage, whichever is named first
        ('model', ('voltage', 'displacement'), 'prediction'),
    ],
)
def test_a_stream_that_is_a_block_ahead(tmp_path, listener, order, answer):
    # what a listener has at last may then be later than any block that it has not answered
    path = bag(tmp_path / 'bag', 50, order)
    SimulatedStage.load('paper').model.save(tmp_path / 'model.yaml')
    with Graph() as g:
        blocks = g.collect(answer)
        g.start(listener, {'model': str(tmp_path / 'model.yaml')})
        parameters = {'bag': str(path), 'rate': 100.0, 'wait_limit': 5.0, 'in_flight': 1}
        g.start('player', {**parameters, 'topics': ['displacement', 'voltage']})
        g.matched(answer)
        _, status = play(g, 'player')
        assert (status['state'], status['messages']) == ('done', '100'), status['message']
        assert 'not answered' not in status['message']
        g.wait(lambda: blocks and blocks[-1].t[-1] == (100 * 50 - 1) / FS, 'the last answer')


def test_a_replay_does_not_wait_for_what_it_sends_itself(tmp_path):
    # predictions that end early, as where a model node was ended
    path = bag(
        tmp_path / 'bag', 100, ('voltage', 'displacement', 'prediction'), {'prediction': 20}
    )
    with Graph() as g:
        g.collect('captured')
        g.collect('prediction')
        g.start('identifier')
        parameters = {'bag': str(path), 'rate': 100.0, 'wait_limit': 5.0, 'in_flight': 5}
        g.start('player', {**parameters, 'topics': ['voltage', 'displacement', 'prediction']})
        g.matched('captured')
        _, status = play(g, 'player')
        assert (status['state'], status['messages']) == ('done', '220'), status['message']
        assert 'not answered' not in status['message']
        g.wait(lambda: captured(g) == 100 * 100, 'all samples')
        # to what nobody measures nobody answers
        assert g.set('player', 'topics', ['prediction'])[0]
        _, status = play(g, 'player')
        assert (status['state'], status['messages']) == ('done', '20'), status['message']


def test_the_whole_graph_as_fast_as_all_answer(tmp_path):
    SimulatedStage.load('paper').model.save(tmp_path / 'model.yaml')
    with Graph() as g:
        prediction = g.collect('prediction')
        g.collect('captured')
        g.start('stage')
        g.start('identifier')
        g.start('model', {'model': str(tmp_path / 'model.yaml')})
        g.start('excitation', {'program': PROGRAM, 'rate_factor': 0.0, 'subscribers': 3})
        g.matched('captured')
        message, status = play(g, 'excitation')
        samples = int(message.split()[-2])
        assert status['state'] == 'done'
        g.wait(lambda: captured(g) == samples, 'all samples captured')
        g.wait(lambda: g.diagnostics('stage').get('samples') == str(samples), 'all answered')
        assert g.diagnostics('stage')['lost'] == '0'
        g.wait(lambda: sum(b.t.size for b in prediction) == samples, 'all predicted')
        for value, reason in (
            ('', 'at least one topic'),
            ('a a', 'each topic once'),
            ('~~', 'no name of a topic'),
        ):
            ok, why = g.set('excitation', 'answers', value)
            assert not ok and reason in why

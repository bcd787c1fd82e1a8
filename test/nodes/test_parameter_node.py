# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a node is given when it starts and cannot take: an end with one line, or a warning."""

import signal

from graph import Graph, Handle
from piezo_ident.nodes.parameter_node import ParameterNode
from rclpy.node import Node
from rclpy.parameter import Parameter


def test_a_request_is_answered_after_any_failure(monkeypatch):
    def fails(node, parameters):
        raise OSError('gone')

    monkeypatch.setattr(Node, 'set_parameters_atomically', fails)
    node = ParameterNode.__new__(ParameterNode)
    node._declared, node.has_parameter = {}, lambda name: True
    result = node._set([Parameter('model', value='m.yaml')])
    assert (result.successful, result.reason) == (False, "failed: OSError('gone')")


def test_what_cannot_be_taken_costs_one_line():
    with Graph() as g:
        first = g.start('recorder', {'flash': 0.2, 'use_sim_time': False})
        command = first.command
        lost = Handle(
            g, 'lost', [*command[:3], '--ros-args', '--params-file', 'no.yaml'], g.folder / 'lost'
        )
        twin = Handle(
            g, 'recorder', [*command[:3], 'flush:=0.2', '--rate', '3'], g.folder / 'twin'
        )
        g.handles += [lost, twin]
        lost.is_ended = True
        assert lost.process.wait(60) == 2
        assert 'params file' in lost.log and 'Traceback' not in lost.log
        g.wait(lambda: 'did you mean flush?' in first.log, 'the misspelt parameter')
        g.wait(lambda: '--rate 3 is passed over' in twin.log, 'the arguments')
        for handle in (first, twin):
            g.wait(lambda h=handle: 'another node is called /recorder' in h.log, 'the namesake')
            assert handle.log.count('is no parameter of this node') == (handle is first)
        for handle in (first, twin):
            handle.send(signal.SIGINT)
            assert handle.process.wait(60) == 0


def test_bad_parameters_at_the_start_end_a_node_with_the_reason(tmp_path):
    (tmp_path / 'bad.yaml').write_text('sample_rate: 20000\n')
    with Graph() as g:
        for node, name, value, reason in (
            ('excitation', 'program', 'nonsense', 'no such program'),
            ('excitation', 'voltage_high', 5.0, 'outside the limits'),
            ('excitation', 'axes', ['um'], "axes: 'um' cannot be the name of an axis"),
            ('model', 'axes', ['b', 'c', 'b'], "axes: 'b' cannot be the name of an axis, or is"),
            ('stage', 'stage', 'nonsense', 'no such stage'),
            ('stage', 'rest', 11.0, 'rest = 11 V lies outside'),
            ('identifier', 'channels', ['bad name'], "channels: 'bad name'"),
            ('model', 'model', str(tmp_path / 'bad.yaml'), 'piezo_ident: error: model:'),
            ('recorder', 'topics', ['volt age'], 'is no name of a topic'),
        ):
            log = g.refused(node, {name: value})
            assert reason in log and 'Traceback' not in log, log

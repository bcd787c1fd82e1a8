# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The right to drive where two ask for it: one that is late, and two at the same moment."""

import time

import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

import numpy as np
from piezo_ident.common.errors import ConfigError
from piezo_ident.nodes import exclusive_publisher
from piezo_ident.nodes.exclusive_publisher import ExclusivePublisher
from piezo_ident.nodes.wire import UNNAMED
from piezo_ident.record.blocks import Samples
from processes import LIMIT, take_domain
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

BLOCK = Samples(np.arange(100) / 20e3, np.zeros(100))


@pytest.fixture
def made(monkeypatch):
    """Return a function that makes publishers that were there long ago, by name of their node."""
    monkeypatch.setattr(exclusive_publisher, 'YOUTH', 0.0)
    monkeypatch.setattr(exclusive_publisher, 'LISTEN', 0.2)
    # a busy machine may stop the test for longer
    monkeypatch.setattr(exclusive_publisher, 'TOGETHER', LIMIT)
    domain, lock = take_domain()
    contexts, nodes = [], []

    def make(*names, stays):
        for name in names:
            # a context each: a participant each, as in processes of their own
            contexts.append(Context())
            rclpy.init(
                context=contexts[-1],
                domain_id=domain,
                signal_handler_options=SignalHandlerOptions.NO,
            )
            nodes.append(Node(name, context=contexts[-1]))
        made = [ExclusivePublisher(node, 'voltage', stays=stays) for node in nodes]
        topics = [node.count_publishers for node in nodes]
        until(lambda: not stays or all(count('voltage') == len(nodes) for count in topics))
        return made

    yield make
    for node, context in zip(nodes, contexts, strict=True):
        node.destroy_node()
        rclpy.shutdown(context=context)
    lock.close()


def until(condition):
    give_up = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < give_up
        time.sleep(0.005)


def right(output):
    """Wait for the right to drive."""
    until(lambda: output.poll(0, 10.0))


def gives_way(output):
    def is_refused():
        try:
            output.refuse_foreign_blocks()
        except ConfigError as error:
            return 'drives /voltage now' in str(error)
        return False

    until(is_refused)


@pytest.mark.parametrize(
    ('names', 'stays'), [(('one', 'one'), True), (('one', 'one'), False), (('one', 'two'), False)]
)
def test_two_that_start_at_the_same_moment_hear_each_other(made, monkeypatch, names, stays):
    outputs = made(*names, stays=stays)
    for output in outputs:
        output.open()
    until(lambda: all({output: output.poll(0, 10.0) for output in outputs}.values()))
    # a reference may come long after the right to drive
    with monkeypatch.context() as patch:
        patch.setattr(exclusive_publisher, 'TOGETHER', 0.0)
        for output in outputs:
            output.refuse_foreign_blocks()
    # the same blocks, as of one program that is played twice
    for output in outputs:
        output.send(BLOCK)
    for output in outputs:
        gives_way(output)
    # what follows is the way to rest, of both
    for output in outputs:
        output.send(BLOCK)
        output.refuse_foreign_blocks()


def test_one_whose_name_is_not_told_yet_is_refused_once_it_has_another(made, monkeypatch):
    (output,) = made('one', stays=True)
    told = {b'?': UNNAMED}
    monkeypatch.setattr(exclusive_publisher, 'publishers', lambda *_: told)
    monkeypatch.setattr(exclusive_publisher, 'MEET', LIMIT)
    output.open()
    for _ in range(2):
        assert not output.poll(0, 10.0)
        time.sleep(exclusive_publisher.LISTEN)
    assert output.second() == ''
    told[b'?'] = '/two'
    with pytest.raises(ConfigError, match='/two publishes on /voltage too'):
        until(lambda: output.poll(0, 10.0))
    with pytest.raises(ConfigError, match='/two'):
        output.open()
    # one that stays without a name is no namesake that was killed
    told[b'?'] = '/one'
    output.open()
    told[b'?'] = UNNAMED
    monkeypatch.setattr(exclusive_publisher, 'MEET', 0.2)
    with pytest.raises(ConfigError, match=UNNAMED):
        until(lambda: output.poll(0, 10.0))


def test_one_that_comes_later_under_the_same_name_is_refused_and_known(made):
    first, late = made('one', 'one', stays=False)
    first.open()
    right(first)
    assert not first.second()
    late.open()
    until(lambda: first.second() == '/one')

    def is_refused():
        first.send(BLOCK)
        try:
            assert not late.poll(0, 10.0)
        except ConfigError as error:
            return 'another /one drives /voltage now' in str(error)
        return False

    until(is_refused)
    # its own blocks alone are no reason to stop
    first.refuse_foreign_blocks()


def test_it_drives_again_at_once_after_a_stop(made):
    (output,) = made('one', stays=True)
    for _ in range(2):
        output.open()
        right(output)
        for _ in range(50):
            output.send(BLOCK)
            output.refuse_foreign_blocks()

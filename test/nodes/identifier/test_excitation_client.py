# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The client of the excitation where the middleware loses a request."""

import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from piezo_ident.nodes.identifier import excitation_client
from piezo_ident.nodes.identifier.excitation_client import ExcitationClient, Streams
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_srvs.srv import Trigger

BEFORE = Parameter('program', value='mine').get_parameter_value()
ANSWERS = {
    GetParameters: GetParameters.Response(values=[BEFORE]),
    SetParameters: SetParameters.Response(results=[SetParametersResult(successful=True)]),
    Trigger: Trigger.Response(success=True),
}


class Client:
    """A client whose first calls are never answered."""

    srv_name = 'a service'

    def __init__(self, kind, dropped):
        self.kind, self.dropped = kind, dropped
        self.calls, self.waited_for, self.requests = 0, set(), []
        self.answer = ANSWERS[kind]

    def service_is_ready(self):
        return True

    def call_async(self, request):
        self.calls += 1
        self.requests.append(request)
        future = Future()
        self.waited_for.add(future)
        if self.calls > self.dropped:
            future.set_result(self.answer)
        return future

    def remove_pending_request(self, future):
        self.waited_for.remove(future)


class Node:
    """A node that hears nothing."""

    def __init__(self, dropped):
        self.clients = []
        self.dropped = dropped

    def create_client(self, kind, name, qos_profile):
        lost = self.dropped if kind is SetParameters else 0
        self.clients.append(Client(kind, lost))
        return self.clients[-1]

    def create_subscription(self, *_):
        pass


@pytest.mark.parametrize(
    ('dropped', 'reason'), [(2, None), (10**6, 'did not respond within 0.3 s')]
)
def test_a_program_that_is_not_acknowledged_is_set_again(monkeypatch, dropped, reason):
    monkeypatch.setattr(excitation_client, '_AGAIN', 0.01)
    clock = [100.0]
    monkeypatch.setattr(excitation_client.time, 'monotonic', lambda: clock[0])
    node, ends, begun = Node(dropped), [], []
    nan = float('nan')
    client = ExcitationClient(node, lambda: Streams(0, nan, nan), lambda: '')
    client.start('a program', 0.3, ends.append, lambda: begun.append(True))
    while client.running and not begun and clock[0] < 110.0:
        clock[0] += 0.001
        client.poll()
    setter, _, starter, _ = node.clients
    if reason is None:
        # started once, when the program is set
        assert begun == [True] and ends == []
        assert (setter.calls, starter.calls) == (4, 1)
    else:
        assert begun == [] and reason in ends[0]
        assert setter.calls > 2 and starter.calls == 0
    # requests that were given up are forgotten; one of those left gives the program back
    assert len(setter.waited_for) == 2
    assert programs(setter)[-2:] == ['a program', 'mine']


def programs(setter):
    """Return the programs that were set, in order."""
    return [r.parameters[0].value.string_value for r in setter.requests]


@pytest.mark.parametrize('how', ['started', 'refused', 'cancelled'])
def test_the_excitation_gets_its_program_back(how):
    node, ends, nan = Node(0), [], float('nan')
    client = ExcitationClient(node, lambda: Streams(0, nan, nan), lambda: '')
    setter, _, starter, _ = node.clients
    starter.answer = Trigger.Response(success=how != 'refused', message='somebody drives')
    starter.dropped = 1 if how == 'cancelled' else 0
    client.start('a program', 20.0, ends.append)
    for _ in range(4):
        client.poll()
    if how == 'cancelled':
        # not before the start was answered: it would begin with the other program
        assert client.is_starting and client.stop()
        assert programs(setter) == ['a program']
        (asked,) = starter.waited_for
        asked.set_result(starter.answer)
    assert programs(setter) == ['a program', 'mine']
    assert ends == (['the excitation does not start: somebody drives'] if how == 'refused' else [])
    assert client.running == (how == 'started')


def starting():
    """Return a client whose start is not answered yet, with its node."""
    node, nan = Node(0), float('nan')
    client = ExcitationClient(node, lambda: Streams(0, nan, nan), lambda: '')
    node.clients[2].dropped = 1
    client.start('a program', 20.0, lambda reason: None)
    for _ in range(4):
        client.poll()
    assert client.is_starting
    return client, node


def started_again(client, starter):
    """Start another program, whose start is not answered either, and return its future."""
    before = set(starter.waited_for)
    starter.dropped = 2
    client.start('another program', 20.0, lambda reason: None)
    for _ in range(4):
        client.poll()
    assert client.is_starting
    (new,) = starter.waited_for - before
    return new


def hear(client, state):
    client._hear(DiagnosticStatus(values=[KeyValue(key='state', value=state)]))


@pytest.mark.parametrize('accepted', [True, False])
def test_a_cancel_before_the_answer_to_the_start_stops_no_program_of_others(accepted):
    client, node = starting()
    setter, _, starter, stopper = node.clients
    # of this run or of somebody else: the answer tells
    hear(client, 'running')
    assert client.stop() == 'the excitation ramps to rest if it has accepted the start'
    client.poll()
    assert stopper.calls == 0 and not client.running
    (asked,) = starter.waited_for
    asked.set_result(Trigger.Response(success=accepted, message='somebody drives'))
    assert stopper.calls == accepted
    assert programs(setter) == ['a program', 'mine']
    assert client.left is None and client.stop() == 'the excitation was not started'


def poll_for(client, clock, seconds):
    """Let time pass on the clock, with a poll every 50 ms."""
    for _ in range(round(seconds / 0.05)):
        clock[0] += 0.05
        client.poll()


def test_a_cancelled_start_whose_answer_is_lost_is_stopped_once(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(excitation_client.time, 'monotonic', lambda: clock[0])
    client, node = starting()
    setter, _, starter, stopper = node.clients
    client.stop()
    for state, stops in (('idle', 0), ('running', 1), ('running', 1)):
        hear(client, state)
        poll_for(client, clock, 2.5)
        assert stopper.calls == stops
    assert programs(setter) == ['a program', 'mine']
    # a late answer stops nothing that somebody has started since
    (asked,) = starter.waited_for
    asked.set_result(Trigger.Response(success=True))
    assert stopper.calls == 1


def test_a_program_long_after_a_lost_start_is_of_somebody_else(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(excitation_client.time, 'monotonic', lambda: clock[0])
    client, node = starting()
    _, _, starter, stopper = node.clients
    client.stop()
    for state in ('idle', 'running'):
        hear(client, state)
        poll_for(client, clock, 25.0)
        assert stopper.calls == 0
    # the answer would still tell
    (asked,) = starter.waited_for
    asked.set_result(Trigger.Response(success=True))
    assert stopper.calls == 1


@pytest.mark.parametrize('is_new_accepted', [True, False])
@pytest.mark.parametrize('answer', ['before', 'after', 'never'])
def test_a_late_answer_to_an_earlier_start_stops_no_newer_run(is_new_accepted, answer):
    client, node = starting()
    setter, _, starter, stopper = node.clients
    client.stop()
    (earlier,) = starter.waited_for
    new = started_again(client, starter)
    if answer == 'before':
        earlier.set_result(Trigger.Response(success=True))
        # the answer to the newer start is not known yet
        assert stopper.calls == 0
    new.set_result(Trigger.Response(success=is_new_accepted))
    client.poll()
    if answer == 'after':
        earlier.set_result(Trigger.Response(success=True))
    # a refused newer start means that the earlier program plays
    assert stopper.calls == (not is_new_accepted and answer != 'never')
    assert client.running == is_new_accepted
    assert (client.left is None) == (is_new_accepted or answer != 'never')
    if client.left is None:
        assert programs(setter) == ['a program', 'another program', 'mine']


def test_two_starts_that_were_cancelled_before_their_answers():
    client, node = starting()
    _, _, starter, stopper = node.clients
    client.stop()
    (earlier,) = starter.waited_for
    newer = started_again(client, starter)
    client.stop()
    # the excitation plays the first program, and so refuses the second
    earlier.set_result(Trigger.Response(success=True))
    newer.set_result(Trigger.Response(success=False, message='a program plays'))
    assert stopper.calls == 1
    assert client.left is None and not client.running


def test_a_program_that_is_over_is_not_stopped():
    client, node = starting()
    _, _, starter, stopper = node.clients
    (asked,) = starter.waited_for
    asked.set_result(Trigger.Response(success=True))
    client.poll()
    hear(client, 'running')
    hear(client, 'done')
    assert client.running and client.stop() == 'the excitation is at rest'
    assert stopper.calls == 0


def test_a_start_whose_answer_is_lost_counts_once_the_excitation_plays(monkeypatch):
    monkeypatch.setattr(excitation_client, '_AGAIN', 0.01)
    clock = [100.0]
    monkeypatch.setattr(excitation_client.time, 'monotonic', lambda: clock[0])
    node, ends, begun, nan = Node(0), [], [], float('nan')
    client = ExcitationClient(node, lambda: Streams(0, nan, nan), lambda: '')
    setter, _, starter, _ = node.clients
    starter.dropped = 1
    client.start('a program', 20.0, ends.append, lambda: begun.append(True))

    def go_on():
        for _ in range(50):
            clock[0] += 0.001
            client.poll()

    go_on()
    assert client.is_starting and not begun
    client._hear(DiagnosticStatus(values=[KeyValue(key='state', value='running')]))
    go_on()
    assert begun == [True] and not client.is_starting and client.running and ends == []
    assert programs(setter) == ['a program', 'mine'] and not starter.waited_for


@pytest.mark.parametrize('is_late', [True, False])
def test_the_last_answers_of_a_late_driver_are_waited_for(monkeypatch, is_late):
    clock, nan = [100.0], float('nan')
    monkeypatch.setattr(excitation_client.time, 'monotonic', lambda: clock[0])
    sent, answered, ends = [nan], [nan], []
    client = ExcitationClient(
        Node(0), lambda: Streams(int(sent[0] > 0.0), sent[0], answered[0]), lambda: ''
    )
    client.start('a program', 20.0, ends.append)
    for k in range(200):
        clock[0] += 0.05
        client.poll()
        if k < 5:
            continue
        # three seconds of voltage, and all that is older than two, every 1.5 s
        sent[0] = min(0.05 * (k - 4), 3.0)
        if not is_late:
            answered[0] = min(sent[0], 2.5)
        elif k % 30 == 0:
            answered[0] = min(0.05 * (k - 4) - 2.0, 3.0)
        if sent[0] == 3.0:
            values = [KeyValue(key='state', value='done')]
            client._hear(DiagnosticStatus(values=values))
        if ends:
            break
    assert ends == [None]
    if is_late:
        assert answered[0] == 3.0
    else:
        # the middleware sends a block again within 3 s, and gives a lost one up
        assert 3.0 + 3.0 < 0.05 * (k - 4) < 3.0 + 4.2


def test_a_done_that_overtakes_the_last_voltage_does_not_end_the_run(monkeypatch):
    clock, nan = [100.0], float('nan')
    monkeypatch.setattr(excitation_client.time, 'monotonic', lambda: clock[0])
    heard, ends = [0], []

    def streams():
        t = heard[0] / 1000.0 or nan
        return Streams(heard[0], t, t)

    client = ExcitationClient(Node(0), streams, lambda: '')
    client.start('a program', 20.0, ends.append)
    for _ in range(5):
        client.poll()
    done = [KeyValue(key='state', value='done'), KeyValue(key='samples', value='3000')]
    for k, n in enumerate((1000, 2000, 2000, 2000, 3000)):
        heard[0], clock[0] = n, clock[0] + 0.05
        if k == 2:
            client._hear(DiagnosticStatus(values=done))
        client.poll()
        assert ends == ([None] if n == 3000 else [])

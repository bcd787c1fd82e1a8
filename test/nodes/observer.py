# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A node in the process of a test that looks at a graph, and acts on it."""

from __future__ import annotations

from collections.abc import Callable
from itertools import dropwhile
import threading
import time
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from graph_page import STATES
from piezo_ident.nodes.subscriptions import between_turns
from piezo_ident.nodes.wire import from_message, LATCHED, SERVICE, STREAM, to_message
from piezo_ident.record.blocks import Samples
from processes import Handle, LIMIT, WORK
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.subscription import Subscription
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger

#: a question that may have been lost with a dead node is asked again after this time [s]
AGAIN = 5.0
#: states in which a node has ended what it was asked for
ENDS = ('done', 'failed', 'cancelled', 'stopped')
#: most messages of a topic that the observer takes at once
TURN = 50
#: the observer shares its interpreter with the test, and must not lose what waits for it
OBSERVED = QoSProfile(depth=20_000)
#: nor a status that the next one follows at once
HEARD = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Observer:
    """
    What a graph tells, and what it is told.

    Attributes
    ----------
    node : rclpy.node.Node
        The observer's, spun by a thread.
    handles : list of Handle
        Processes that must not end by themselves.
    """

    node: Node

    def __init__(self) -> None:
        self.handles: list[Handle] = []
        self._clients: dict[str, Any] = {}
        self._statuses: dict[str, list[dict[str, str]]] = {}
        self._diagnostics: dict[str, list[dict[str, str]]] = {}
        self._messages: dict[str, list[Float64MultiArray]] = {}
        self._samples: dict[str, list[Samples]] = {}
        self._arrivals: dict[str, list[float]] = {}
        self._lines: list[tuple[str, int, str]] = []
        self._texts: dict[str, list[str]] = {}
        self._publishers: dict[str, Any] = {}
        self._unknown: set[tuple[str, str]] = set()
        self._unfit: set[tuple[str, str]] = set()
        self._broken: Exception | None = None
        self._end = threading.Event()

    def known_to(self, name: str, meanwhile: Callable[[], None] = lambda: None) -> None:
        """
        Wait until a node knows of all readers and writers of the observer.

        It hears of them in the order in which they were made: once its status comes to a new
        reader, it knows of those before.
        """
        came = threading.Event()
        last = self.node.create_subscription(
            DiagnosticStatus, f'/{name}/status', lambda _: came.set(), HEARD
        )
        self.wait(came.is_set, f'{name} to know of its readers', meanwhile=meanwhile)
        self.forget(last)

    # looking

    def follow(self, name: str, executable: str = '') -> None:
        """Follow the status of a node; `start` does it by itself."""
        if name in self._statuses:
            return
        heard = self._statuses[name] = []
        known = {state for node, state in STATES if node == executable}

        def keep(message: DiagnosticStatus) -> None:
            values = {pair.key: pair.value for pair in message.values}
            level = int.from_bytes(message.level, 'little')
            heard.append({**values, 'message': message.message, 'level': str(level)})
            if len(message.message) > 100 or message.values[-1].key != 'text':
                self._unfit.add((name, message.message))
            if known and values['state'] not in known:
                self._unknown.add((executable, values['state']))

        self._hear(DiagnosticStatus, f'/{name}/status', keep, HEARD)

    def _hear(self, kind: Any, topic: str, keep: Callable[[Any], None], qos: QoSProfile) -> None:
        """Subscribe, and take all that waits at once, or one topic runs ahead of the others."""
        made = threading.Event()

        def take(message: Any) -> None:
            keep(message)
            made.wait()
            with subscription.handle:
                # a stream that comes as fast as it is taken must not hold up answers
                for _ in range(TURN):
                    if (found := subscription.handle.take_message(kind, False)) is None:
                        return
                    keep(found[0])

        subscription = self.node.create_subscription(kind, topic, take, qos)
        made.set()

    def _keep_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            level = int.from_bytes(status.level, 'little')
            self._diagnostics.setdefault(status.name.strip('/'), []).append(
                {
                    **values,
                    'message': status.message,
                    'level': str(level),
                    'hardware_id': status.hardware_id,
                }
            )

    def status(self, name: str) -> dict[str, str]:
        """Return the latest status of a node: state, progress, message, level, text, ..."""
        self.follow(name)
        heard = self._statuses[name]
        return (
            heard[-1]
            if heard
            else dict.fromkeys(('state', 'progress', 'message', 'level', 'text'), '')
        )

    def statuses(self, name: str) -> list[dict[str, str]]:
        """Return all that was heard of a node's status."""
        return self._statuses.get(name, [])

    def diagnostics(self, name: str) -> dict[str, str]:
        """Return the latest diagnostics of a node; empty when none came yet."""
        heard = self._diagnostics.get(name, [])
        return heard[-1] if heard else {}

    def diagnoses(self, name: str) -> list[dict[str, str]]:
        """Return all diagnostics of a node that were heard."""
        return self._diagnostics.get(name, [])

    def collect(self, topic: str) -> list[Samples]:
        """Return the blocks of a topic so far; subscribes on first use."""
        if topic not in self._samples:
            samples = self._samples[topic] = []
            messages = self._messages[topic] = []
            arrivals = self._arrivals[topic] = []

            def keep(message: Float64MultiArray) -> None:
                arrivals.append(time.monotonic())
                messages.append(message)
                samples.append(from_message(message))

            self._hear(Float64MultiArray, topic, keep, OBSERVED)
        return self._samples[topic]

    def messages(self, topic: str) -> list[Float64MultiArray]:
        """Return the messages of a topic that is collected."""
        self.collect(topic)
        return self._messages[topic]

    def arrivals(self, topic: str) -> list[float]:
        """Return when each block of a topic that is collected came, on time.monotonic."""
        self.collect(topic)
        return self._arrivals[topic]

    def lines(self) -> list[tuple[str, int, str]]:
        """Return node, level and text of all lines on /rosout; subscribes on first use."""
        if not self._lines:
            self._lines.append(('observer', Log.INFO, 'listens'))
            self._hear(
                Log, '/rosout', lambda m: self._lines.append((m.name, m.level, m.msg)), HEARD
            )
        return self._lines

    def texts(self, topic: str) -> list[str]:
        """Return the latched texts of a topic (model, report) so far; subscribes on first use."""
        if topic not in self._texts:
            texts = self._texts[topic] = []
            self._hear(String, topic, lambda m: texts.append(m.data), HEARD)
        return self._texts[topic]

    def matched(self, topic: str, publishers: int = 1) -> None:
        """Wait until this many publish a collected topic, and know who listens to it."""
        self.collect(topic)
        self._meet(self.node.get_publishers_info_by_topic, topic, publishers)

    def _meet(self, ask: Callable[[str], list[Any]], topic: str, count: int) -> None:
        """Wait until this many have an end of a topic, and know of the observer's."""

        def found() -> list[str]:
            infos = ask(self.node.resolve_topic_name(topic))
            return [f'{i.node_namespace}/{i.node_name}'.strip('/') for i in infos]

        # of an endpoint that was met before its node the name is not known
        self.wait(
            lambda: len(n := found()) >= count and not any('UNKNOWN' in x for x in n),
            f'those at {topic}',
        )
        for name in found():
            if name in self._statuses:
                self.known_to(name)

    def wait(
        self,
        condition: Callable[[], object],
        what: str,
        timeout: float = LIMIT,
        *,
        meanwhile: Callable[[], None] = lambda: None,
    ) -> None:
        """Wait until a condition holds; `AssertionError` with the whole state when it does not."""
        deadline = time.monotonic() + timeout
        while not condition():
            if self._broken is not None:
                raise AssertionError(f'{what}: the observer ended') from self._broken
            died = [h for h in self.handles if not h.is_ended and h.process.poll() is not None]
            if died:
                codes = {h.name: (h.process.returncode, h.log) for h in died}
                raise AssertionError(f'{what}: nodes ended by themselves: {codes}')
            if time.monotonic() > deadline:
                states = {name: self.status(name) for name in self._statuses}
                logs = {h.name: h.log for h in self.handles if h.log}
                raise AssertionError(f'{what}: not within {timeout} s; {states}; logs: {logs}')
            meanwhile()
            time.sleep(0.01)

    def until(
        self, name: str, *states: str, since: int = 0, after: str = '', timeout: float = LIMIT
    ) -> Any:
        """
        Wait for a state of a node after so many statuses, and return the status then.

        The node first leaves the state `after`, if that is given.
        """

        def found() -> list[dict[str, str]]:
            later = dropwhile(lambda s: s['state'] == after, self.statuses(name)[since:])
            return [s for s in later if s['state'] in states]

        self.wait(found, f'{name} to be {" or ".join(states)}', timeout)
        return found()[0]

    def finish(self, service: str, *states: str, timeout: float = WORK) -> dict[str, str]:
        """Call a service, and return the status in which its node ends what that began."""
        name = service.rpartition('/')[0]
        before, since = self.status(name)['state'], len(self.statuses(name))
        accepted, reason = self.call(service)
        assert accepted, reason
        # a node repeats its status each second, also while the call is on its way
        return self.until(name, *(states or ENDS), since=since, after=before, timeout=timeout)

    # acting

    def client(self, kind: Any, service: str, timeout: float = LIMIT) -> Any:
        """Return a client of a service that is there."""
        is_new = service not in self._clients
        if is_new:
            self._clients[service] = self.node.create_client(
                kind, f'/{service.lstrip("/")}', qos_profile=SERVICE
            )
        self.wait(self._clients[service].service_is_ready, f'service {service}', timeout)
        node = service.strip('/').rpartition('/')[0]
        if is_new and node in self._statuses:
            # a server drops the answer to one of whom it does not know
            self.known_to(node)
        return self._clients[service]

    def _ask(self, kind: Any, service: str, request: Any, timeout: float) -> Any:
        client = self.client(kind, service, timeout)
        done, answers, asked = threading.Event(), [], 0

        def take(future: Any) -> None:
            answers.append(future.result())
            done.set()

        deadline = time.monotonic() + timeout
        while not done.is_set() and time.monotonic() < deadline:
            client.call_async(request).add_done_callback(take)
            asked += 1
            done.wait(AGAIN)
        if not answers:
            raise AssertionError(f'{service}: no answer within {timeout} s')
        # what was asked twice is not to be done while the test is at the next thing
        late = time.monotonic() + AGAIN
        while len(answers) < asked and time.monotonic() < late:
            time.sleep(0.01)
        return answers[0]

    def call(self, service: str, timeout: float = LIMIT) -> tuple[bool, str]:
        """Call a Trigger service and return (success, message)."""
        answer = self._ask(Trigger, service, Trigger.Request(), timeout)
        return bool(answer.success), str(answer.message)

    def set(self, node: str, name: str, value: Any, timeout: float = LIMIT) -> tuple[bool, str]:
        """Set a parameter of a node and return (taken, reason)."""
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]
        )
        result = self._ask(SetParameters, f'{node}/set_parameters', request, timeout).results[0]
        return bool(result.successful), str(result.reason)

    def get(self, node: str, name: str, timeout: float = LIMIT) -> Any:
        """Return the value of a parameter of a node."""
        request = GetParameters.Request(names=[name])
        values = self._ask(GetParameters, f'{node}/get_parameters', request, timeout).values
        return parameter_value_to_python(values[0])

    def parameters(self, node: str, timeout: float = LIMIT) -> dict[str, Any]:
        """Return the descriptors of all parameters of a node by their names."""
        listed = self._ask(
            ListParameters, f'{node}/list_parameters', ListParameters.Request(), timeout
        ).result.names
        request = DescribeParameters.Request(names=listed)
        answer = self._ask(DescribeParameters, f'{node}/describe_parameters', request, timeout)
        return {d.name: d for d in answer.descriptors}

    def publish(self, topic: str, block: Samples | Float64MultiArray) -> None:
        """Publish a block; before the first one, wait for somebody else to listen."""
        if topic not in self._publishers:
            publisher = self.node.create_publisher(Float64MultiArray, topic, STREAM)
            self._publishers[topic] = publisher
            wanted = 1 + (topic in self._samples)
            self.wait(
                lambda: publisher.get_subscription_count() >= wanted, f'listeners to {topic}'
            )
            # who does not know the publisher yet hears nothing of it
            self._meet(self.node.get_subscriptions_info_by_topic, topic, wanted)
        message = to_message(block) if isinstance(block, Samples) else block
        self._publishers[topic].publish(message)

    def publish_text(self, topic: str, text: str) -> None:
        """Publish a latched text."""
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(String, topic, LATCHED)
        self._publishers[topic].publish(String(data=text))

    def unpublish(self, topic: str) -> None:
        """Take back the publisher of a topic, if there is one."""
        if topic in self._publishers:
            self.forget(self._publishers.pop(topic))

    def forget(self, entity: Publisher | Subscription) -> None:
        """Take back a publisher or a subscription, between two turns of the observer."""
        topic, gone = entity.topic_name, threading.Event()

        def destroy() -> None:
            if isinstance(entity, Publisher):
                self.node.destroy_publisher(entity)
            else:
                self.node.destroy_subscription(entity)
            gone.set()

        between_turns(self.node, destroy)
        self.wait(gone.is_set, f'{topic} to be forgotten')

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Take the messages of subscriptions without the executor.

The executor takes 0.3 ms to hand over one message.  Taking a message from its subscription takes
a fifth of this time, for a node that only collects blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
import importlib
import threading
import time
from typing import Any

from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.live.pacing import ArrivalClock
from piezo_ident.nodes.parameters import LATCHED_TOPICS, SAMPLE_TOPICS
from piezo_ident.nodes.wire import LATCHED, qos_of, STREAM
from piezo_ident.record.bags.write import knows_type, SAMPLE_QOS
from piezo_ident.record.channels import channel_of_quantity, role_of
from piezo_ident.record.stream import LossCount
from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.validate_topic_name import validate_topic_name
from rosbags.interfaces import Qos, QosDurability, QosReliability
from std_msgs.msg import Float64MultiArray


class _NotSpun(CallbackGroup):
    """Callback group that keeps subscriptions away from the executor."""

    def can_execute(self, entity: Any) -> bool:
        return False


def between_turns(node: Node, work: Callable[[], None]) -> None:
    """
    Call a function between two turns of the executor of a node; any thread may call this.

    Destroying an entity while the executor gathers its wait set breaks the executor.  Without an
    executor the function is called at once.
    """
    if node.executor is None:
        work()
    else:
        node.executor.create_task(work)


def message_class(name: str) -> Any:
    """
    Import the class of a message type like ``std_msgs/msg/String``.

    PiezoIdentError when the package of the type is not installed.
    """
    package, _, kind = name.partition('/msg/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), kind)
    except (ImportError, AttributeError, ValueError):
        raise PiezoIdentError(f'message type {name} is not installed; install {package}') from None


def topics_problem(names: Sequence[str], parameter: str = 'topics') -> str | None:
    """Return the problem if names of topics are invalid, else None."""
    if not names:
        return f'{parameter} must name at least one'
    for name in names:
        try:
            validate_topic_name(name)
        except (InvalidTopicNameException, ValueError) as error:
            reason = ' '.join(str(error).split())
            return f'{parameter}: {name!r} is no name of a topic ({reason})'
    return None


def unspun(
    node: Node, kind: Any, topic: str, profile: QoSProfile = STREAM, *, raw: bool = False
) -> Subscription:
    """Subscribe without the executor: the caller takes the messages."""
    return node.create_subscription(
        kind, topic, lambda _: None, profile, callback_group=_NotSpun(), raw=raw
    )


def received(subscription: Any, *, raw: bool) -> Iterator[tuple[Any, Mapping[str, Any]]]:
    """Take the messages of a subscription that the caller empties, with their information."""
    # one queue at most: a flood on one topic must not starve the other topics
    for _ in range(STREAM.depth):
        message = subscription.handle.take_message(subscription.msg_type, raw)
        if message is None:
            return
        yield message


@dataclass(frozen=True)
class _Request:
    """Requested type and QoS of a topic."""

    type: str
    reliable: bool
    latched: bool

    def profile(self) -> QoSProfile:
        return qos_of(reliable=self.reliable, latched=self.latched)


@dataclass(eq=False)
class _Topic:
    """One topic of a recording, and its subscription."""

    name: str
    request: _Request | None = None
    subscription: Any = None
    losses: LossCount = field(default_factory=LossCount)
    taken: int = 0
    problem: str = ''
    #: publishers, and whether the last two looks saw the same single publisher
    publishers: frozenset[bytes] = frozenset()
    is_single: bool = False
    #: whether the topic has had a single publisher since its last message
    is_followed: bool = False

    def note(self, number: int) -> None:
        """Note the number that the publisher gave a message."""
        if self.subscription.msg_type is Float64MultiArray:
            self.losses.note(number, alone=self.is_followed)
        # a latched message may be replaced before it arrives, so its numbers may have gaps
        elif self.request is not None and not self.request.latched:
            # a topic may have several publishers, as /diagnostics, which number on their own
            if not self.is_followed:
                self.losses.restart()
            self.losses.note(number, alone=True)


class RawSubscriptions:
    """
    Subscriptions of a recording to `topics`, by full names: serialised messages.

    A subscription requests the QoS that all publishers of its topic offer.
    """

    def __init__(self, node: Node, topics: Iterable[str]) -> None:
        self._node = node
        self._topics = {name: _Topic(name) for name in topics}
        self._lock = threading.Lock()
        self._closed = False
        self._clock = ArrivalClock()

    @property
    def lost(self) -> int:
        """Number of messages that were sent and not received."""
        return sum(topic.losses.lost for topic in self._topics.values())

    @property
    def problems(self) -> str:
        """Unrecorded topics with their reasons, and a clock that was set; '' without problems."""
        problems = [topic.problem for topic in self._topics.values() if topic.problem]
        if self._clock.set_by:
            moved = f'the clock of this machine was set by {self._clock.set_by * 1e-9:+.3g} s'
            problems.append(f'{moved}; log times go on as before')
        return '; '.join(problems)

    def look(self) -> bool:
        """Subscribe to new topics; return whether all existing publishers are matched."""
        matched = True
        for topic in self._topics.values():
            request = self._request(topic)
            if request is not None and request != topic.request:
                self._subscribe(topic, request)
            if topic.subscription is not None and self._node.count_publishers(topic.name):
                matched &= topic.subscription.get_publisher_count() > 0
        return matched

    def close(self) -> None:
        """Destroy all subscriptions; any thread may call this."""
        self._closed = True
        between_turns(self._node, self._destroy_all)

    def _destroy_all(self) -> None:
        with self._lock:
            for topic in self._topics.values():
                self._destroy(topic)

    def _request(self, topic: _Topic) -> _Request | None:
        """Choose type and QoS: as all publishers offer, or else as the graph agrees on."""
        # discovery of an endpoint is incomplete until its type is known
        infos = [
            i for i in self._node.get_publishers_info_by_topic(topic.name) if '/' in i.topic_type
        ]
        publishers = frozenset(bytes(i.endpoint_gid) for i in infos)
        with self._lock:
            topic.is_single = len(publishers) == 1 and publishers == topic.publishers
            topic.is_followed &= topic.is_single
            topic.publishers = publishers
        if not infos:
            if topic.request is not None:
                return topic.request
            base = topic.name.rpartition('/')[2]
            if base in SAMPLE_TOPICS or role_of(channel_of_quantity(base)):
                return _Request('std_msgs/msg/Float64MultiArray', True, False)
            return _Request('std_msgs/msg/String', True, True) if base in LATCHED_TOPICS else None
        offers = [i.qos_profile for i in infos]
        return _Request(
            infos[0].topic_type,
            all(o.reliability == ReliabilityPolicy.RELIABLE for o in offers),
            all(o.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offers),
        )

    def _subscribe(self, topic: _Topic, request: _Request) -> None:
        name, kind = topic.name, request.type
        if topic.taken and topic.request is not None and kind != topic.request.type:
            topic.problem = f'{name} changed its type to {kind}, which is not recorded'
            return
        topic.request = request
        try:
            if not knows_type(kind):
                raise PiezoIdentError(f'message type {kind} is none of Jazzy')
            message = message_class(kind)
        except PiezoIdentError as error:
            topic.problem = f'{name} is not recorded: {error}'
            return
        with self._lock:
            if self._closed:
                return
            self._destroy(topic)
            topic.problem = ''
            topic.subscription = unspun(self._node, message, name, request.profile(), raw=True)

    def _destroy(self, topic: _Topic) -> None:
        subscription, topic.subscription = topic.subscription, None
        if subscription is not None:
            self._node.destroy_subscription(subscription)

    def arrived(self) -> list[tuple[int, str, bytes]]:
        """Take all messages; return their log times, topics and bytes in order of log time."""
        messages = []
        self._clock.look()
        with self._lock:
            for topic in self._topics.values():
                if topic.subscription is None:
                    continue
                for raw, info in received(topic.subscription, raw=True):
                    topic.taken += 1
                    topic.note(info['publication_sequence_number'] or 0)
                    topic.is_followed = topic.is_single
                    arrival = info['received_timestamp'] or time.time_ns()
                    messages.append((self._clock.stamp(arrival), topic.name, raw))
        messages.sort(key=lambda m: m[0])
        return messages

    def offers(self, name: str) -> tuple[str, list[Qos]]:
        """Return the type of a topic, and the offered QoS profiles, or else the requested one."""
        request = self._topics[name].request
        if request is None:
            return '', []
        infos = self._node.get_publishers_info_by_topic(name)
        offers = [_offer(i.qos_profile) for i in infos] or [_offer(request.profile())]
        return request.type, [o for i, o in enumerate(offers) if o not in offers[:i]]


def _offer(profile: QoSProfile) -> Qos:
    """Convert a QoS profile to its form in a bag."""
    latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return SAMPLE_QOS._replace(
        # discovery does not tell the depth, so the agreed depth of the graph is written
        depth=LATCHED.depth if latched else STREAM.depth,
        reliability=QosReliability(int(profile.reliability)),
        durability=QosDurability(int(profile.durability)),
    )

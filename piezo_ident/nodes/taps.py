# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Subscriptions that follow what the publishers of their topics offer, emptied by a thread.

They are not spun by the executor, which would take 0.3 ms a message.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
import importlib
import threading
import time
from typing import Any

from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.live.pacing import LogClock
from piezo_ident.nodes.interfaces import ARRAY, TOPICS
from piezo_ident.nodes.wire import LATCHED, STREAM
from piezo_ident.record.bags.write import knows_type, LossCount
from rclpy.callback_groups import CallbackGroup
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.validate_topic_name import validate_topic_name
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)

__all__ = ['Aside', 'Taps', 'between_turns', 'message_class', 'topics_problem']

#: messages that a subscription keeps until it is emptied: five seconds of blocks
DEPTH = 1000


class Aside(CallbackGroup):
    """Keeps subscriptions away from the executor."""

    def can_execute(self, entity: Any) -> bool:
        """Return that it never may."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Return that it never may."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Do nothing."""


def between_turns(node: Node, work: Callable[[], None]) -> None:
    """
    Do something with the entities of a node between two turns of its executor; from any thread.

    One that goes while the executor gathers what to wait for breaks it.

    Parameters
    ----------
    node : Node
    work : callable
        Called at once where nobody spins the node.
    """
    if node.executor is None:
        work()
    else:
        node.executor.create_task(work)


def message_class(name: str) -> Any:
    """
    Return the class of a message type like ``std_msgs/msg/String``.

    Raises
    ------
    PiezoIdentError
        When it is not installed.
    """
    package, _, kind = name.partition('/msg/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), kind)
    except (ImportError, AttributeError, ValueError):
        raise PiezoIdentError(f'message type {name} is not installed; install {package}') from None


def topics_problem(names: Sequence[str]) -> str | None:
    """Return why these cannot be names of topics, None when they can."""
    if not names:
        return 'topics must name at least one'
    for name in names:
        try:
            validate_topic_name(name)
        except (InvalidTopicNameException, ValueError) as error:
            reason = ' '.join(str(error).split())
            return f'topics: {name!r} is no name of a topic ({reason})'
    return None


@dataclass(frozen=True)
class Request:
    """What is asked of the publishers of a topic."""

    type: str
    reliable: bool
    latched: bool

    def profile(self) -> QoSProfile:
        """Return the QoS of the subscription."""
        return QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=DEPTH,
            reliability=ReliabilityPolicy.RELIABLE
            if self.reliable
            else ReliabilityPolicy.BEST_EFFORT,
            durability=DurabilityPolicy.TRANSIENT_LOCAL
            if self.latched
            else DurabilityPolicy.VOLATILE,
        )


@dataclass(eq=False)
class Tap:
    """The subscription of one topic."""

    topic: str
    request: Request | None = None
    subscription: Any = None
    losses: LossCount = field(default_factory=LossCount)
    taken: int = 0
    problem: str = ''
    #: who publishes, and whether it has been one and the same at the last two looks
    publishers: frozenset[bytes] = frozenset()
    is_single: bool = False
    #: whether the last message came from who has been the only one since
    follows: bool = False


class Taps:
    """
    The subscriptions of a recording.

    Parameters
    ----------
    node : Node
        Whose they are.
    topics : iterable of str
        Full names.
    """

    def __init__(self, node: Node, topics: Iterable[str]) -> None:
        self._node = node
        self._taps = {topic: Tap(topic) for topic in topics}
        self._group = Aside()
        self._lock = threading.Lock()
        self._closed = False
        self._clock = LogClock()

    @property
    def lost(self) -> int:
        """Messages that were sent and not received."""
        return sum(tap.losses.lost for tap in self._taps.values())

    @property
    def problems(self) -> str:
        """Why a topic is not recorded, and a clock that was set; empty when all is well."""
        said = [tap.problem for tap in self._taps.values() if tap.problem]
        if self._clock.set_by:
            moved = f'the clock of this machine was set by {self._clock.set_by * 1e-9:+.3g} s'
            said.append(f'{moved}; log times go on as before')
        return '; '.join(said)

    def look(self) -> bool:
        """Subscribe to what has come; return whether all publishers that are there are met."""
        met = True
        for tap in self._taps.values():
            wish = self._wish(tap)
            if wish is not None and wish != tap.request:
                self._subscribe(tap, wish)
            if tap.subscription is not None and self._node.count_publishers(tap.topic):
                met &= tap.subscription.get_publisher_count() > 0
        return met

    def close(self) -> None:
        """Take back all subscriptions; from any thread."""
        self._closed = True
        between_turns(self._node, self._destroy_all)

    def _destroy_all(self) -> None:
        with self._lock:
            for tap in self._taps.values():
                self._destroy(tap)

    def _wish(self, tap: Tap) -> Request | None:
        """Return what to ask for: what all publishers offer, or what the graph agrees on."""
        # an endpoint without a type is not known in full yet
        found = [
            i for i in self._node.get_publishers_info_by_topic(tap.topic) if '/' in i.topic_type
        ]
        publishers = frozenset(bytes(i.endpoint_gid) for i in found)
        with self._lock:
            tap.is_single = len(publishers) == 1 and publishers == tap.publishers
            tap.follows &= tap.is_single
            tap.publishers = publishers
        if not found:
            if tap.request is not None:
                return tap.request
            base = tap.topic.rpartition('/')[2]
            agreed = next((t for t in TOPICS if t.name == base), None)
            # the rest of them is offered in more than one way
            if agreed is None or not (agreed.type == ARRAY or 'transient' in agreed.qos):
                return None
            return Request(agreed.type, True, 'transient' in agreed.qos)
        offers = [i.qos_profile for i in found]
        return Request(
            found[0].topic_type,
            all(o.reliability == ReliabilityPolicy.RELIABLE for o in offers),
            all(o.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offers),
        )

    def _subscribe(self, tap: Tap, request: Request) -> None:
        if tap.taken and tap.request is not None and request.type != tap.request.type:
            tap.problem = f'{tap.topic} changed its type to {request.type}, which is not recorded'
            return
        tap.request = request
        try:
            if not knows_type(request.type):
                raise PiezoIdentError(f'message type {request.type} is none of Jazzy')
            kind = message_class(request.type)
        except PiezoIdentError as error:
            tap.problem = f'{tap.topic} is not recorded: {error}'
            return
        with self._lock:
            if self._closed:
                return
            self._destroy(tap)
            tap.problem = ''
            tap.subscription = self._node.create_subscription(
                kind,
                tap.topic,
                _ignore,
                request.profile(),
                callback_group=self._group,
                raw=True,
            )

    def _destroy(self, tap: Tap) -> None:
        subscription, tap.subscription = tap.subscription, None
        if subscription is not None:
            self._node.destroy_subscription(subscription)

    def arrived(self) -> list[tuple[int, str, bytes]]:
        """Return log time, topic and bytes of what has arrived, in the order of arrival."""
        messages = []
        self._clock.look()
        with self._lock:
            for tap in self._taps.values():
                if tap.subscription is None:
                    continue
                handle, kind = tap.subscription.handle, tap.subscription.msg_type
                # no more at once than it keeps, or a flood on one topic starves the others
                for _ in range(DEPTH):
                    found = handle.take_message(kind, True)
                    if found is None:
                        break
                    raw, info = found
                    tap.taken += 1
                    number = info['publication_sequence_number'] or 0
                    tap.losses.note(number, alone=tap.follows)
                    tap.follows = tap.is_single
                    arrival = info['received_timestamp'] or time.time_ns()
                    messages.append((self._clock.stamp(arrival), tap.topic, raw))
        messages.sort(key=lambda m: m[0])
        return messages

    def offers(self, topic: str) -> tuple[str, list[Qos]]:
        """Return the type of a topic, and what its publishers offer or were asked for."""
        request = self._taps[topic].request
        if request is None:
            return '', []
        infos = self._node.get_publishers_info_by_topic(topic)
        offers = [_offer(i.qos_profile) for i in infos] or [_offer(request.profile())]
        return request.type, [o for i, o in enumerate(offers) if o not in offers[:i]]


def _ignore(_: object) -> None:
    """Do nothing: the messages are taken by the thread."""


def _offer(profile: QoSProfile) -> Qos:
    """Return a profile as it stands in a bag."""
    latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    # discovery carries no history, so it says what the graph agrees on
    depth = LATCHED.depth if latched else STREAM.depth
    times = (profile.deadline, profile.lifespan, profile.liveliness_lease_duration)
    deadline, lifespan, lease = (
        QosTime(*divmod(min(t.nanoseconds, 2**63 - 1), 1_000_000_000)) for t in times
    )
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability(int(profile.reliability)),
        durability=QosDurability(int(profile.durability)),
        deadline=deadline,
        lifespan=lifespan,
        liveliness=QosLiveliness(int(profile.liveliness)),
        liveliness_lease_duration=lease,
        avoid_ros_namespace_conventions=bool(profile.avoid_ros_namespace_conventions),
    )

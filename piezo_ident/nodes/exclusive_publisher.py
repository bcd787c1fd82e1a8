# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Publish only while no other publisher sends: the right to drive.

Publishers differ by their ids; two nodes may have the same name.  The middleware does not say
which publisher sent a message, but a listener gets each message once.  A node that hears more
messages than it has sent therefore hears another publisher.
"""

from __future__ import annotations

from collections.abc import Iterable
import threading
import time
from typing import Any

from piezo_ident.common.errors import ConfigError
from piezo_ident.nodes.subscriptions import between_turns, unspun
from piezo_ident.nodes.wire import await_readers, publishers, STREAM, to_message, UNNAMED
from piezo_ident.record.blocks import Samples
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

#: time of listening for another publisher before the first block [s]
LISTEN = 0.5
#: longest time to match all publishers [s]
MEET = 2.0
#: time after which a new node knows most other nodes [s]
YOUTH = 1.0
#: time in which two nodes that start at the same moment hear each other's first blocks [s]
TOGETHER = 1.0
#: time from the match of a subscriber to the first block, so that both sides know the match [s]
SETTLE = 0.1


class ExclusivePublisher:
    """
    A publisher of blocks that asks for the right to drive before it sends.

    With `stays` the publisher exists between two drives, too, and any publisher of another node
    name prevents a drive.  Without `stays` only a publisher that sends prevents a drive, so an
    excitation between two programs does not.  `topic` is the full name of the topic.
    """

    def __init__(self, node: Node, topic: str, *, stays: bool = False) -> None:
        self._node, self._stays, self._born = node, stays, time.monotonic()
        self.topic = node.resolve_topic_name(topic)
        self._publisher: Any = self._created() if stays else None
        self._listener: Any = None
        self._lock = threading.Lock()
        self._begin = self._met = self._free = self._drives = 0.0
        self._sent = self._heard = 0
        self._known: dict[bytes, str] = {}

    @property
    def is_open(self) -> bool:
        """Whether the publisher exists."""
        return self._publisher is not None

    def _created(self) -> Any:
        return self._node.create_publisher(Float64MultiArray, self.topic, STREAM)

    def open(self) -> None:
        """
        Ask for the right to drive, in the executor of the node; `poll` says when it is granted.

        ConfigError when another publisher exists, with `stays`.
        """
        # a node without a known name yet may have the own name
        self._refuse(name for name in self.others() if name != UNNAMED)
        self.stop_listening()
        self._begin, self._met, self._free, self._drives = time.monotonic(), 0.0, 0.0, 0.0
        self._sent = self._heard = 0
        if self._publisher is None:
            self._publisher = self._created()
        self._listener = unspun(self._node, Float64MultiArray, self.topic, raw=True)

    def poll(self, subscribers: int, limit: float) -> bool:
        """
        Return whether blocks may be sent; any thread may call this.

        ConfigError when another publisher drives, or too few listen within the `limit` [s].
        """
        now = time.monotonic()
        self.refuse_foreign_blocks()
        if self._free:
            return now > self._free
        if not self._met:
            self._await_publishers(now)
            return False
        others = self.others()
        if now < self._met + LISTEN + (MEET if UNNAMED in others else 0.0):
            return False
        self._refuse(others)
        # without our own listener
        count = self._publisher.get_subscription_count() - 1
        if count < subscribers:
            if now > self._met + limit + LISTEN:
                raise ConfigError(
                    f'{max(0, count)} of {subscribers} subscribers on {self.topic} after '
                    f'{limit:g} s; start the stage, or set subscribers or wait_limit'
                )
            return False
        self._known, self._free = publishers(self._node, self.topic), now + SETTLE
        return False

    def refuse_foreign_blocks(self) -> None:
        """
        Refuse to go on when another publisher has sent a block, with a ConfigError.

        The thread that sends calls this.  The search ends `TOGETHER` after the first sent block:
        two nodes that ask at the same moment hear each other only when both send.
        """
        with self._lock:
            listener = self._listener
            # one foreign block is enough; a flood of blocks would never end this loop
            while listener and self._heard <= self._sent:
                if listener.handle.take_message(Float64MultiArray, True) is None:
                    break
                self._heard += 1
        if listener and self._heard > self._sent:
            self.stop_listening()
            own, others = self._node.get_fully_qualified_name(), self.others()
            names = list(publishers(self._node, self.topic).values())
            if names.count(own) > 1 or not others:
                others.append(f'another {own}')
            raise ConfigError(f'{" or ".join(others)} drives {self.topic} now; end it first')
        if listener and self._drives and time.monotonic() > self._drives + TOGETHER:
            self.stop_listening()

    def _await_publishers(self, now: float) -> None:
        """Note when every publisher is matched; silence counts from then on."""
        # a new node does not know the other publishers at first
        begin = max(self._begin, self._born + YOUTH)
        known, listener = self._node.count_publishers(self.topic), self._listener
        is_matched = listener is None or listener.get_publisher_count() >= known
        if now > begin and (is_matched or now > begin + MEET):
            self._met = now

    def _refuse(self, names: Iterable[str]) -> None:
        if self._stays and (name := next(iter(names), '')):
            raise ConfigError(
                f'{name} publishes on {self.topic} too; end it first: '
                'two programs at once would tear the stage to and fro'
            )

    def send(self, samples: Samples) -> None:
        """Send a block."""
        self._sent += 1
        self._drives = self._drives or time.monotonic()
        self._publisher.publish(to_message(samples))

    def others(self) -> list[str]:
        """Return the names of other nodes that publish on the topic."""
        own = self._node.get_fully_qualified_name()
        return sorted(set(publishers(self._node, self.topic).values()) - {own})

    def second(self) -> str:
        """Return the name of a node that publishes since the right was granted, or ''."""
        now = publishers(self._node, self.topic) if self._free else {}
        new = (name for gid, name in now.items() if gid not in self._known)
        return min((name for name in new if name != UNNAMED), default='')

    def stop_listening(self) -> None:
        """Drop the listener, which gets every own block, between two turns of the executor."""
        with self._lock:
            listener, self._listener = self._listener, None
        if listener is not None:
            between_turns(self._node, lambda: self._node.destroy_subscription(listener))

    def close(self) -> None:
        """Give the right to drive back."""
        self.stop_listening()
        if self._publisher is not None:
            await_readers(self._publisher)
            if not self._stays:
                self._node.destroy_publisher(self._publisher)
                self._publisher = None

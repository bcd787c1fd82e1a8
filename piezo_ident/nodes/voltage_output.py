# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The right to drive: a publisher of `voltage` that is there only while it may send."""

from __future__ import annotations

import time
from typing import Any

from piezo_ident.common.errors import ConfigError
from piezo_ident.nodes.wire import STREAM, to_message
from piezo_ident.record.blocks import Samples
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

__all__ = ['VoltageOutput']

#: how long to listen whether somebody else drives [s]
LISTEN = 0.5
#: how long it may take to match all publishers [s]
MEET = 2.0
#: how long it takes a new node to know of most others [s]
YOUTH = 1.0
#: between the match of a subscriber and the first block, for the other side to know of it too [s]
SETTLE = 0.1


class VoltageOutput:
    """
    A publisher of `voltage` for as long as a node drives; all calls by the executor of the node.

    A publisher that is silent, as an excitation between two programs, is no hindrance: an
    excitation does not start beside this one.
    """

    def __init__(self, node: Node) -> None:
        self._node, self._born = node, time.monotonic()
        self._publisher: Any = None
        self._listener: Any = None
        self._begin = self._met = self._free = 0.0
        self._heard = False
        self._known: set[str] = set()

    @property
    def is_open(self) -> bool:
        """Whether it was asked for the right to drive."""
        return self._publisher is not None

    def open(self) -> None:
        """Ask for the right to drive; `poll` tells when it is there."""
        self._begin, self._met, self._free, self._heard = time.monotonic(), 0.0, 0.0, False
        self._publisher = self._node.create_publisher(Float64MultiArray, 'voltage', STREAM)
        self._listener = self._node.create_subscription(
            Float64MultiArray, 'voltage', self._on_other, STREAM
        )

    def poll(self, subscribers: int, limit: float) -> bool:
        """
        Return whether blocks may be sent.

        Raises
        ------
        ConfigError
            When somebody else drives, or too few listen within the limit [s].
        """
        now, topic = time.monotonic(), self._publisher.topic_name
        if self._free:
            return now > self._free
        if self._heard:
            raise ConfigError(f'{", ".join(self._others()) or "another node"} drives {topic} now')
        if not self._met:
            known = self._node.count_publishers(topic)
            is_old = now > self._born + YOUTH
            if is_old and self._listener.get_publisher_count() >= known:
                self._met = now
            elif now > max(self._begin + MEET, self._born + YOUTH):
                self._met = now
            return False
        if now < self._met + LISTEN:
            return False
        # without our own listener
        count = self._publisher.get_subscription_count() - 1
        if count < subscribers:
            if now > self._begin + limit + LISTEN:
                raise ConfigError(
                    f'{max(0, count)} of {subscribers} subscribers on {topic} after {limit:g} s; '
                    'start the stage, or set subscribers or wait_limit'
                )
            return False
        self._drop_listener()
        self._known, self._free = set(self._others()), now + SETTLE
        return False

    def send(self, samples: Samples) -> None:
        """Send a block."""
        self._publisher.publish(to_message(samples))

    def second(self) -> str:
        """Return a publisher that came since, empty without one."""
        new = set(self._others()) - self._known if self._free else set()
        return min(new, default='')

    def close(self) -> None:
        """Give the right to drive back."""
        self._drop_listener()
        if self._publisher is not None:
            self._publisher.wait_for_all_acked(Duration(seconds=0.1))
            self._node.destroy_publisher(self._publisher)
            self._publisher = None

    def _drop_listener(self) -> None:
        # it would get every block that this node sends
        if self._listener is not None:
            self._node.destroy_subscription(self._listener)
            self._listener = None

    def _on_other(self, _: Float64MultiArray) -> None:
        self._heard = True

    def _others(self) -> list[str]:
        """Return the other publishers; a namesake may be one that was killed."""
        own = self._node.get_fully_qualified_name()
        infos = self._node.get_publishers_info_by_topic(self._publisher.topic_name)
        names = [f'{info.node_namespace.rstrip("/")}/{info.node_name}' for info in infos]
        return sorted({name for name in names if name != own})

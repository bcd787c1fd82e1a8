# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""
What listeners say of how far they are, looked up where a sender would otherwise wait.

Only the newest block of each topic is kept, and the executor never sees it: an answer costs
nothing until somebody asks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
import threading
import time
from typing import Any

from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.live.flow import FlowControl
from piezo_ident.nodes.taps import Aside, between_turns, topics_problem
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64MultiArray

__all__ = ['Answers', 'answers_problem']

_NEWEST = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)

#: how often answers are looked for while they are waited for [s]
LOOK = 0.001


def answers_problem(text: str) -> str | None:
    """Return why a text is no list of topics with blanks between, None when it is; or is empty."""
    names = text.split()
    if not names:
        return None
    if len(set(names)) < len(names):
        return f'answers must name each topic once, got {text!r}'
    problem = topics_problem(names)
    return problem and problem.replace('topics', 'answers', 1)


class Answers:
    """
    Listens to the topics on which answers come, and keeps account of what is on its way.

    Parameters
    ----------
    node : Node
    topics : sequence of str
        Names, relative ones too.
    *required : str
        Those of them that have to answer; any other counts from its first answer on.
    """

    def __init__(self, node: Node, topics: Sequence[str], *required: str) -> None:
        self.flow = FlowControl(*required)
        self._required = required
        self._node = node
        self._lock = threading.Lock()
        group = Aside()
        self._ears: dict[str, Any] = {
            topic: node.create_subscription(
                Float64MultiArray, topic, _ignore, _NEWEST, callback_group=group
            )
            for topic in topics
        }

    @property
    def topics(self) -> tuple[str, ...]:
        """What is listened to."""
        return tuple(self._ears)

    @property
    def published(self) -> tuple[str, ...]:
        """Topics that somebody publishes."""
        return tuple(t for t, ear in self._ears.items() if ear.get_publisher_count())

    def look(self) -> int:
        """Return how many blocks the slowest listener that counts has not answered."""
        with self._lock:
            for topic, subscription in self._ears.items():
                found = subscription.handle.take_message(Float64MultiArray, False)
                if found is None:
                    continue
                # rows of time and value: what is in them was dealt with
                data = found[0].data
                for t in (data[0], data[-2]) if len(data) >= 2 else ():
                    if math.isfinite(t):
                        self.flow.heard(topic, t)
        return self.flow.ahead

    def wait(self, most: int, limit: float, pause: Callable[[float], None]) -> None:
        """
        Wait until the slowest listener has left fewer blocks unanswered than `most`.

        Who may be missing and publishes no more is no longer waited for.

        Parameters
        ----------
        most : int
        limit : float
            How long to wait for the next sign of a listener [s].
        pause : callable
            Sleeps for a time [s]; may raise.

        Raises
        ------
        PiezoIdentError
            When none comes, with the listener and its last sign.
        """
        flow, give_up = self.flow, time.monotonic() + limit
        while (before := flow.ahead) >= most and self.look() >= most:
            name = flow.slowest
            if flow.ahead < before:
                give_up = time.monotonic() + limit
            elif name not in self._required and name not in self.published:
                flow.leave(name)
                continue
            elif time.monotonic() > give_up:
                t = flow.last_time(name)
                last = 'none has come' if math.isnan(t) else f'the last was of t = {t:.6g} s'
                raise PiezoIdentError(f'no {name} for {limit:g} s: {last}')
            pause(LOOK)

    def close(self) -> None:
        """Listen no more; from any thread."""
        with self._lock:
            ears, self._ears = self._ears, {}

        def destroy() -> None:
            for subscription in ears.values():
                self._node.destroy_subscription(subscription)

        between_turns(self._node, destroy)


def _ignore(_: object) -> None:
    """Do nothing: the messages are taken where they are asked for."""

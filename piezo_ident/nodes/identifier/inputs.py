# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Take the blocks of the subscriptions of the identifier, and add them to the capture."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
import time
from typing import Any

from piezo_ident.common.errors import DataError
from piezo_ident.live.capture import Capture
from piezo_ident.nodes.identifier.excitation_client import Streams
from piezo_ident.nodes.subscriptions import received, unspun
from piezo_ident.nodes.wire import from_message
from piezo_ident.record.channels import APPLIED, applied_key, channel_of_quantity
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

#: quantities that the blocks of a topic may name, beside the name of the topic
_CARRIED = {'voltage': (), 'displacement': (), APPLIED: ('voltage',)}


class Inputs:
    """
    Subscriptions without the executor; `drain` moves their blocks into the capture.

    `channels` are topics of further axes and channels; `passed` counts the samples of each topic.
    """

    def __init__(self, node: Node, capture: Capture, channels: Sequence[str]) -> None:
        self.passed: Counter[str] = Counter()
        self._capture = capture
        self._held: deque[tuple[str, str, Float64MultiArray, Mapping[str, Any]]] = deque()
        keys = {key: key for key in ('voltage', 'displacement', APPLIED)}
        for topic in channels:
            keys[topic] = ''
            home, _, base = topic.rpartition('/')
            if applied := applied_key(base):
                keys[f'{home}/{applied}' if home else applied] = applied
        # key and subscription of each topic
        self._topics = {t: (key, unspun(node, Float64MultiArray, t)) for t, key in keys.items()}

    def drain(self, *, hold: bool) -> None:
        """Add the received blocks to the capture; with `hold` keep them for the next call."""
        for topic, (key, subscription) in self._topics.items():
            self._held += ((topic, key, *block) for block in received(subscription, raw=False))
        while self._held and not hold:
            self._take(*self._held.popleft())

    def _take(
        self, topic: str, key: str, message: Float64MultiArray, info: Mapping[str, Any]
    ) -> None:
        try:
            samples = from_message(message)
            known = (*_CARRIED.get(key, (key.removeprefix('applied_'),)), key) if key else ()
            quantity = samples.quantity
            # a block of a further axis or channel names its quantity
            if quantity not in known and (key or not channel_of_quantity(quantity)):
                base = topic.rpartition('/')[2]
                wanted = key or (base if channel_of_quantity(base) else 'x_<name>')
                raise DataError(f"layout says 't,{quantity}', not 't,{wanted}'")
        except DataError as error:
            self._capture.unreadable(topic, str(error))
            return
        arrival = info.get('received_timestamp') or time.time_ns()
        self._capture.add(key or samples.quantity, samples, arrival)
        self.passed[topic] += samples.t.size

    def streams(self) -> Streams:
        """Return the state of the streams, for the client of the excitation."""
        c = self._capture
        answered = c.last_time('displacement')
        for key in c.keys:
            # the stage sends these topics one after the other; the last one ends the answer
            if key.startswith((APPLIED, 'displacement_')):
                answered = min(answered, c.last_time(key))
        return Streams(self.passed['voltage'], c.last_time('voltage'), answered)

    @property
    def unpublished(self) -> str:
        """Topics of the stage without a matched publisher; the applied voltage may be absent."""
        unmatched = (x for x in self._topics.items() if not x[1][1].get_publisher_count())
        topics = [key or topic for topic, (key, _) in unmatched]
        driven = ('voltage', APPLIED)
        return ', '.join(t for t in topics if not t.rpartition('/')[2].startswith(driven))

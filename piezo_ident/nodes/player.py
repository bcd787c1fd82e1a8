# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Player node: replays a bag onto topics with the recorded spacing, or a multiple of it.

A replayed message equals the recorded message bit by bit, also in its t, at any `rate`.  The log
times give order and spacing, counted from the start of the replay.  If the clock of the log times
was set back, the messages keep the order of the file.

``~/start`` opens the bag and creates a publisher for each of `topics`, also beside other
publishers.  The replay begins when every topic has `subscribers` subscribers.  A late listener
does not hold up the replay; each listener reports its losses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
import functools
from pathlib import Path
import threading
import time
from typing import Any

from piezo_ident.common.errors import DataError, PiezoIdentError
from piezo_ident.live.pacing import Rate, Schedule, SLIP
from piezo_ident.nodes.ending import ENDING
from piezo_ident.nodes.lab_node import ERROR, LabNode, OK, WARN
from piezo_ident.nodes.parameters import with_axes
from piezo_ident.nodes.subscriptions import message_class, topics_problem
from piezo_ident.nodes.wire import LATCHED, qos_of, STREAM
from piezo_ident.record.bags.read import (
    blocks_in,
    carried_quantities,
    is_computed,
    LogClock,
    ordered_bag,
    steps_back,
)
from piezo_ident.record.bags.recover import Bag
from piezo_ident.record.blocks import Samples
from rclpy.qos import QoSProfile
from rosbags.interfaces import Connection, QosDurability, QosHistory, QosReliability

#: share of the time until the end of the node for the end of a replay
PATIENCE = 0.75
#: time between the match of the subscribers and the first message, so that both sides know it [s]
SETTLE = 0.2
#: time between two reports of progress [s]
REPORT_EVERY = 0.25


class _Stopped(Exception):
    """The replay was asked to end."""


@dataclass(eq=False)
class Replay:
    """State of a replay, shared by both threads."""

    bag: str
    topics: tuple[str, ...]
    stop: threading.Event = field(default_factory=threading.Event)
    failure: str = ''
    messages: int = 0
    total: int = 0
    progress: float = 0.0
    slipped: float = 0.0
    names: str = ''
    is_over: bool = False


class PlayerNode(LabNode):
    """Replays a bag from a thread."""

    executable = 'player'

    def __init__(self, **kwargs: Any) -> None:
        self._replay: Replay | None = None
        self._thread: threading.Thread | None = None
        self._senders: dict[tuple[str, str, str], Any] = {}
        self._rate = Rate()
        super().__init__(**kwargs)
        self.offer('start', self.start)
        self.offer('stop', self.stop)
        if self.values['autostart']:
            self.start()

    # parameters

    def refuse(self, name: str, value: Any) -> str | None:
        """Refuse invalid names of topics."""
        return topics_problem(value) if name == 'topics' else None

    # services

    def start(self) -> str:
        """
        Replay the bag from its beginning; see ``~/status``.

        PiezoIdentError when the bag is missing, or a replay runs already.
        """
        bag = self.values['bag']
        if not bag:
            raise PiezoIdentError('no bag is named; set the parameter bag')
        if not Path(bag).exists():
            raise PiezoIdentError(f'{bag} does not exist; set the parameter bag')
        if self._is_replaying():
            raise PiezoIdentError('replaying already; call stop, and wait until it has ended')
        self._replay = Replay(bag, tuple(with_axes(self.values['topics'], self.values['axes'])))
        # a daemon thread: an end of the node during the look through a large bag loses nothing
        self._thread = threading.Thread(
            target=self._work, args=(self._replay,), name='replay', daemon=True
        )
        self._thread.start()
        return f'replaying {bag}; see ~/status'

    def stop(self) -> str:
        """End the replay; PiezoIdentError when none runs."""
        if self._replay is None or not self._is_replaying():
            raise PiezoIdentError('not replaying; call start first')
        self._replay.stop.set()
        return 'stopping'

    def _is_replaying(self) -> bool:
        # the thread closes the bag after its last status
        return self._replay is not None and not self._replay.is_over

    # the replay, in a thread of its own

    def _work(self, replay: Replay) -> None:
        prepared = False
        try:
            look = functools.partial(self._looked_through, replay)
            with ordered_bag(replay.bag, look) as (bag, chosen):
                senders = self._prepared(bag, chosen)
                replay.names = ', '.join(chosen.values())
                replay.total = sum(c.msgcount for c in bag.connections if c.topic in senders)
                prepared = True
                self._await_subscribers(replay, senders)
                clock = LogClock()
                self._report_end(replay, bag, self._send(replay, bag, senders, clock), clock)
        except _Stopped:
            replay.is_over = True
            about = f'stopped after {replay.messages} of {replay.total} messages'
            self._report('stopped', about, OK, replay.progress)
        # the status has to report any failure of this thread
        except Exception as error:  # noqa: BLE001
            replay.failure, replay.is_over = self.reason(error), True
            state = 'failed' if prepared else 'refused'
            self._report(state, replay.failure, ERROR, replay.progress)

    def _looked_through(self, replay: Replay, bag: Bag) -> tuple[int, dict[str, str]]:
        """Count the chosen blocks whose time steps back; return the count and the topics."""
        chosen = chosen_topics(bag, replay.topics, self.resolve_topic_name)
        carried = {t: t for t in chosen if t in _carried(bag)}

        def blocks() -> Iterator[tuple[str, Samples]]:
            # messages without a block are replayed unchanged
            with suppress(DataError):
                for topic, samples, _ in blocks_in(bag, carried):
                    if replay.stop.is_set():
                        raise _Stopped
                    yield topic, samples

        return steps_back(blocks()), chosen

    def _prepared(self, bag: Bag, chosen: Mapping[str, str]) -> dict[str, Any]:
        """Return the publisher of each chosen topic of the bag."""
        senders = {}
        for connection in bag.connections:
            if connection.topic in chosen and connection.topic not in senders:
                target = chosen[connection.topic]
                profile = _profile(connection)
                key = target, connection.msgtype, str(profile)
                # publishers are kept for the next replay, as they have met their subscribers
                if key not in self._senders:
                    kind = message_class(connection.msgtype)
                    self._senders[key] = self.create_publisher(kind, target, profile)
                senders[connection.topic] = self._senders[key]
        if not any(c.msgcount for c in bag.connections if c.topic in senders):
            raise DataError(f'{bag.path}: no messages on {", ".join(chosen)}; name another bag')
        return senders

    def _await_subscribers(self, replay: Replay, senders: Mapping[str, Any]) -> None:
        """Wait for `subscribers` on every topic; PiezoIdentError after `wait_limit`."""
        need, limit = self.values['subscribers'], self.values['wait_limit']
        began = time.monotonic()
        while True:
            counts = {t: s.get_subscription_count() for t, s in senders.items()}
            if not (few := {t: n for t, n in counts.items() if n < need}):
                break
            lacking = ', '.join(f'{senders[t].topic_name} ({n} of {need})' for t, n in few.items())
            if time.monotonic() - began > limit:
                raise PiezoIdentError(
                    f'too few subscribers after {limit:g} s: {lacking}; start them, or lower '
                    'the parameter subscribers'
                )
            self._report('waiting', f'waiting for subscribers: {lacking}')
            self._pause(replay, 0.05)
        if need:
            self._pause(replay, SETTLE)

    def _send(
        self, replay: Replay, bag: Bag, senders: Mapping[str, Any], clock: LogClock
    ) -> Schedule:
        """Send every message when it is due."""
        schedule, first, reported = None, 0, float('-inf')
        chosen = [c for c in bag.connections if c.topic in senders]
        for connection, logged, raw in bag.messages(chosen):
            stamp = clock.rising(connection.topic, logged)
            now, rate = time.monotonic(), self.values['rate']
            if schedule is None:
                # messages that are sent late all at once must fit into the queues of the readers
                schedule, first = Schedule(rate, now, SLIP / max(1.0, rate)), stamp
            position = (stamp - first) * 1e-9
            if rate != schedule.speed:
                schedule.change_speed(rate, position, now)
            # short waits, so that stop and status stay prompt during a pause in the recording
            while True:
                if now - reported > REPORT_EVERY:
                    reported = now
                    self._report('playing', f'replaying {replay.names}', OK, replay.progress)
                ahead = schedule.due(position) - now
                self._pause(replay, min(max(ahead, 0.0), REPORT_EVERY))
                now = time.monotonic()
                if ahead <= REPORT_EVERY:
                    break
            senders[connection.topic].publish(raw)
            schedule.note(position, 0.0, now)
            replay.messages += 1
            replay.slipped = schedule.slipped
            replay.progress = 100.0 * replay.messages / replay.total
        if schedule is None:
            raise DataError(f'{bag.path}: no messages on {", ".join(senders)}; name another bag')
        return schedule

    def _pause(self, replay: Replay, seconds: float) -> None:
        if replay.stop.wait(seconds):
            raise _Stopped

    def _report_end(self, replay: Replay, bag: Bag, schedule: Schedule, clock: LogClock) -> None:
        about = f'replayed {replay.messages} messages of {replay.bag}'
        if schedule.slipped > 0.1:
            about += f', {schedule.slipped:.1f} s slower than asked'
        faults = '; '.join(str(f) for f in bag.faults)
        early = f'the bag ends early: {faults}' if faults else ''
        level = WARN if early else OK
        parts = [about, *map(str, clock.faults), early]
        replay.is_over = True
        self._report('done', '; '.join(filter(None, parts)), level, 100.0)

    # reports

    def _numbers(self) -> dict[str, Any]:
        replay = self._replay or Replay('', ())
        return {
            'messages': replay.messages,
            'total': replay.total,
            'bag': replay.bag,
            'slipped': f'{replay.slipped:.3f}',
        }

    def _report(self, state: str, message: str, level: bytes = OK, progress: float = 0.0) -> None:
        brief = f'{progress:.0f} %: {message}' if state == 'playing' else ''
        self.report_status(state, progress, message, level, brief=brief, **self._numbers())

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return counts, rate and problems of the replay."""
        replay = self._replay
        rate = self._rate.of(replay.messages if replay else 0)
        values = {**self._numbers(), 'rate': f'{rate:.1f}'}
        if replay is not None and replay.failure:
            return ERROR, replay.failure, values
        if replay is not None and replay.slipped > 0.1:
            return WARN, f'slower than asked by {replay.slipped:.1f} s; lower the rate', values
        return OK, 'ready', values

    def close(self) -> None:
        """End the replay before the node ends."""
        if self._replay is not None and self._thread is not None:
            self._replay.stop.set()
            self._thread.join(PATIENCE * ENDING.left)


def chosen_topics(
    bag: Bag, wanted: Sequence[str], resolve: Callable[[str], str]
) -> dict[str, str]:
    """
    Choose topics of an open bag; map the name of each in the bag to its name on the graph.

    `resolve` gives the name of a `wanted` topic on the graph.  The first rule with a match
    decides: the same name in the bag; the same end of the name, for a recording of another
    namespace; the quantity of the blocks.

    DataError if a wanted topic has no match or several.
    """
    topics = sorted({c.topic for c in bag.connections})
    chosen: dict[str, str] = {}
    for name in wanted:
        target = resolve(name)
        matches = [t for t in topics if t == target]
        if not matches and not name.startswith(('/', '~')):
            matches = [t for t in topics if t.endswith(f'/{name}')]
            if not matches and '/' not in name:
                matches = [t for t, q in _carried(bag).items() if q == name and not is_computed(t)]
        if not matches:
            raise DataError(
                f'{bag.path}: no topic {name} in it; set topics to some of: '
                + (', '.join(topics) or 'none')
            )
        if len(matches) > 1:
            raise DataError(
                f'{bag.path}: several topics could be {name}: {", ".join(matches)}; start the '
                'player in the namespace of one of them'
            )
        if chosen.setdefault(matches[0], target) != target:
            raise DataError(f'{bag.path}: {matches[0]} would be replayed twice; name it once')
    return chosen


def _carried(bag: Bag) -> dict[str, str]:
    try:
        return carried_quantities(bag)
    except DataError:
        return {}  # in a bag without samples, names alone select topics


def _profile(connection: Connection) -> QoSProfile:
    """Return the recorded QoS of a topic, or the QoS of the graph for an unknown QoS."""
    offered = getattr(connection.ext, 'offered_qos_profiles', None) or []
    reliable = all(o.reliability != QosReliability.BEST_EFFORT for o in offered)
    latched = bool(offered) and all(o.durability == QosDurability.TRANSIENT_LOCAL for o in offered)
    known = [o.depth for o in offered if o.history == QosHistory.KEEP_LAST and o.depth > 0]
    # a replay may be faster than the recording, so it queues as many messages as its readers
    least = LATCHED.depth if latched else STREAM.depth
    return qos_of(reliable=reliable, latched=latched, depth=max([least, *known]))

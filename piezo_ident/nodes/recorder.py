# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Recorder node: writes the serialised messages of topics to a bag, byte by byte.

The executor would take 0.3 ms for each message.  From ``~/start`` to ``~/stop`` a thread
therefore empties the subscriptions every `POLL` and writes the bag.  The log time of a message is
the time at which the middleware received the message, independent of thread and disk.

The recorder subscribes to topics of samples, model and report before they have a publisher, and to
any other topic once a publisher gives the type.  A subscription requests the QoS that all
publishers of its topic offer.

`max_bag_size` cuts a long recording into parts, each a bag of its own.  The subscriptions keep the
messages that arrive between two parts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import threading
import time
from typing import Any

import piezo_ident
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.live.pacing import Rate
from piezo_ident.nodes.lab_node import ERROR, LabNode, OK, WARN
from piezo_ident.nodes.parameter_node import home_problem
from piezo_ident.nodes.parameters import with_axes
from piezo_ident.nodes.subscriptions import RawSubscriptions, topics_problem
from piezo_ident.record.bags.write import BagWriter

#: time between two emptyings of the subscriptions [s]
POLL = 0.02
#: time between two searches for publishers [s]
LOOK = 0.1
#: longest time for closing a bag at the end of the node; ros2 launch waits 5 s [s]
END = 4.0
#: longest time for matching subscriptions with the existing publishers [s]
MATCH_LIMIT = 2.0


@dataclass(eq=False)
class Recording:
    """State of a recording, shared by both threads."""

    output: str
    started: float = field(default_factory=time.monotonic)
    ready: threading.Event = field(default_factory=threading.Event)
    end: threading.Event = field(default_factory=threading.Event)
    over: threading.Event = field(default_factory=threading.Event)
    path: str = ''
    messages: int = 0
    size: int = 0
    failure: str = ''


class RecorderNode(LabNode):
    """Records topics into bags."""

    executable = 'recorder'
    patience = END + 0.5

    def __init__(self, **kwargs: Any) -> None:
        self._inputs: RawSubscriptions | None = None
        self._recording: Recording | None = None
        self._thread: threading.Thread | None = None
        self._rate = Rate()
        super().__init__(**kwargs)
        self.offer('start', self.start)
        self.offer('stop', self.stop)
        self.create_timer(LOOK, self._look)
        if self.values['autostart']:
            self.start()

    # parameters

    def refuse(self, name: str, value: Any) -> str | None:
        """Refuse invalid names of topics and folders."""
        if name == 'output':
            if not value.strip():
                return 'output must name a folder'
            if value.endswith(('.mcap', '.db3')):
                return f'output must name a folder, without .mcap or .db3, got {value!r}'
            return home_problem(value)
        return topics_problem(value) if name == 'topics' else None

    # services

    def start(self) -> str:
        """
        Open a bag and record; ``~/status`` says when all publishers are matched.

        PiezoIdentError when a recording runs already.
        """
        if self._is_recording():
            raise PiezoIdentError('recording already; call stop, and wait until it is done')
        recording = Recording(self.values['output'])
        topics = with_axes(self.values['topics'], self.values['axes'])
        names = dict.fromkeys(self.resolve_topic_name(t) for t in topics)
        self._inputs = RawSubscriptions(self, names)
        self._recording = recording
        self._thread = threading.Thread(
            target=self._work, args=(recording, self._inputs), name='recording'
        )
        self._thread.start()
        return f'recording to {recording.output}; see ~/status'

    def stop(self) -> str:
        """End the recording and close the bag; PiezoIdentError when nothing is being recorded."""
        recording = self._recording
        if recording is None or not self._is_recording():
            raise PiezoIdentError('not recording; call start first')
        recording.end.set()
        return f'closing {recording.path or recording.output}; see ~/status'

    def _is_recording(self) -> bool:
        return self._recording is not None and not self._recording.over.is_set()

    # subscriptions, in the executor's thread

    def _look(self) -> None:
        """Subscribe to new publishers during a recording."""
        recording, subscriptions = self._recording, self._inputs
        if recording is None or subscriptions is None or recording.end.is_set():
            return
        if subscriptions.look() or time.monotonic() - recording.started > MATCH_LIMIT:
            recording.ready.set()

    # the bag, in a thread of its own

    def _work(self, recording: Recording, subscriptions: RawSubscriptions) -> None:
        try:
            writer = BagWriter(
                recording.output,
                self.values['storage'],
                {
                    'sample_rate': repr(float(self.values['sample_rate'])),
                    'namespace': self.get_namespace(),
                    'package_version': piezo_ident.__version__,
                    'log_time': 'received',
                },
                self.values['max_bag_size'],
            )
        # the status has to report any failure of this thread
        except Exception as error:  # noqa: BLE001
            self._end(recording, subscriptions, self.reason(error))
            return
        recording.path = str(writer.path)
        failure = ''
        try:
            self._record(recording, subscriptions, writer)
            writer.close()
        except Exception as error:  # noqa: BLE001
            failure = self.reason(error)
            writer.abort()
        recording.size = writer.size
        self._end(recording, subscriptions, failure)
        if not failure:
            parts = f' and {n} before it' if (n := len(writer.parts) - 1) else ''
            about = f'{writer.messages} messages in {writer.path}{parts}'
            lost = f'{n} messages were lost on their way' if (n := subscriptions.lost) else ''
            problems = '; '.join(filter(None, [lost, subscriptions.problems]))
            about, level = (f'{about}; {problems}', WARN) if problems else (about, OK)
            self._report('done', about, level, 100.0)

    def _record(
        self, recording: Recording, subscriptions: RawSubscriptions, writer: BagWriter
    ) -> None:
        flushed = time.monotonic()
        last = reported = False
        while not last:
            # one more round after the stop keeps the messages that have arrived by then
            last = recording.end.wait(POLL)
            for stamp, topic, raw in subscriptions.arrived():
                if topic not in writer:
                    writer.add_topic(topic, *subscriptions.offers(topic))
                writer.write(topic, stamp, raw)
            recording.messages = writer.messages
            now = time.monotonic()
            # early by two polls: the next round comes a poll later, and writing takes time, too
            due = now - flushed > self.values['flush'] - 2 * POLL
            if due:
                writer.flush()
                flushed = now
                recording.size = writer.size
                if recording.path != str(writer.path):
                    recording.path = str(writer.path)
                    self.journal.tell(f'the next part is {recording.path}')
            if recording.ready.is_set() and (due or not reported) and not last:
                reported = True
                problems = subscriptions.problems
                about = problems or f'recording to {writer.path}'
                self._report('recording', about, WARN if problems else OK)

    def _end(self, recording: Recording, subscriptions: RawSubscriptions, failure: str) -> None:
        recording.failure = failure
        recording.end.set()
        recording.over.set()
        if failure:
            self._report('failed', failure, ERROR)
        subscriptions.close()

    # reports

    def _lost(self) -> int:
        return 0 if self._inputs is None else self._inputs.lost

    def _numbers(self) -> dict[str, Any]:
        recording = self._recording or Recording('')
        return {
            'messages': recording.messages,
            'bytes': recording.size,
            'lost': self._lost(),
            'path': recording.path,
        }

    def _report(self, state: str, message: str, level: bytes = OK, progress: float = 0.0) -> None:
        numbers = self._numbers()
        brief = f'{numbers["messages"]} messages: {message}' if state == 'recording' else message
        self.report_status(state, progress, message, level, brief=brief, **numbers)

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return counts, rate and problems of the recording."""
        recording = self._recording
        rate = self._rate.of(recording.messages if recording else 0)
        values = {**self._numbers(), 'rate': f'{rate:.1f}'}
        if recording is not None and recording.failure:
            return ERROR, recording.failure, values
        if lost := self._lost():
            return WARN, f'{lost} messages were sent and not received', values
        return OK, 'recording' if self._is_recording() else 'not recording', values

    def close(self) -> None:
        """Close the bag before the node ends."""
        if self._recording is not None:
            self._recording.end.set()
        if self._thread is not None:
            self._thread.join(END)

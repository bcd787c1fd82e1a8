# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Call the excitation: have it play a program, and follow the program to its end.

The phases of a run are *finding* (services of the excitation, topics of the stage), *asking* (for
the present program), *setting* (the program of the run), *starting* and *playing*.  After the
answer to ``~/start`` the client sets the earlier program again, for the next start by a person.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from piezo_ident.live.pacing import Looks
from piezo_ident.nodes.wire import LATCHED, SERVICE
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

#: callback with None for a program that was captured to its end, or with the cause of another end
Ended = Callable[[str | None], None]
#: states of the excitation that plays no program
_RESTING = ('idle', 'done', 'failed', 'stopped', 'cancelled', '')
#: state until the first status after ``~/start`` was called
_UNHEARD = 'unheard'
#: longest wait for the last blocks after the status done: a lost one is sent again within 3 s [s]
_TAIL = 4.0
#: longest wait for displacement while the stage warns, as when it refuses the rate [s]
_UNANSWERED = 3.0
#: time after which an unanswered request is sent again [s]
_AGAIN = 2.0


@dataclass(frozen=True)
class Streams:
    """Number of voltages received, and time of the last sample of each stream."""

    voltage: int
    voltage_time: float
    displacement_time: float


class ExcitationClient:
    """
    Follows one run of the excitation at a time.

    All calls return at once; `poll` takes the run from phase to phase.  `streams` returns the
    present `Streams`, and `missing` the topics without a publisher, as text.
    """

    def __init__(
        self, node: Node, streams: Callable[[], Streams], missing: Callable[[], str]
    ) -> None:
        self._streams, self._missing = streams, missing
        self._begin: Callable[[], None] = lambda: None
        self._ended: Ended = lambda _: None
        self._set, self._get, self._start, self._stop = (
            node.create_client(kind, f'excitation/{name}', qos_profile=SERVICE)
            for kind, name in (
                (SetParameters, 'set_parameters'),
                (GetParameters, 'get_parameters'),
                (Trigger, 'start'),
                (Trigger, 'stop'),
            )
        )
        node.create_subscription(DiagnosticStatus, 'excitation/status', self._hear, LATCHED)
        node.create_subscription(DiagnosticStatus, 'stage/status', self._hear_stage, LATCHED)
        self._phase = self._trouble = ''
        self._future: Any = None
        # client and request of the future, and the time of the request
        self._asks: tuple[Any, Any] = (None, None)
        self._asked = 0.0
        # the earlier program of the excitation, until it is restored
        self._before: Any = None
        #: future of a start that was given up before its answer; an accepted start is stopped
        self.left: Any = None
        self._looks = Looks()
        self._state, self._message, self._sent = '', '', 0
        self.progress = 0.0

    @property
    def running(self) -> bool:
        """Whether a run has begun and not ended."""
        return bool(self._phase)

    @property
    def is_starting(self) -> bool:
        """Whether the excitation has not yet answered to the start."""
        return self._phase == 'starting'

    @property
    def waits_for(self) -> str:
        """Cause of the wait for the first block, for people; '' after the first block."""
        if self._phase == 'finding':
            missing = self._missing()
            about = f'waiting for a publisher of {missing}'
            return about if missing else 'looking for the excitation'
        if self._phase == 'playing' and self._state == 'waiting':
            return f'the excitation is {self._message}'
        return 'calling the excitation' if self._phase not in ('', 'playing') else ''

    @property
    def is_possible(self) -> bool:
        """Whether an excitation and a stage have been discovered."""
        return self._is_ready and not self._missing()

    @property
    def _is_ready(self) -> bool:
        return bool(self._set.service_is_ready() and self._start.service_is_ready())

    def start(
        self, program: str, limit: float, ended: Ended, begin: Callable[[], None] | None = None
    ) -> None:
        """
        Begin a run of a `program`; a silence of excitation or stage for `limit` [s] ends the run.

        The client calls `begin` when the excitation has accepted the start, and `ended` at the
        end of the run, but not after `stop`.
        """
        self._program, self._limit = program, limit
        self._begin, self._ended = begin or (lambda: None), ended
        self._phase, self._future, self.progress = 'finding', None, 0.0
        self._sign = time.monotonic()

    def stop(self) -> str:
        """Give up the run, and stop its program alone; return a message for people."""
        phase, self._phase = self._phase, ''
        if phase == 'starting' and self._future is not None:
            # the answer tells whether the excitation plays this program
            self.left = self._future
            self.left.add_done_callback(self._leave)
            return 'the excitation ramps to rest if it has accepted the start'
        self._give_back()
        if phase == 'playing' and not (self._active and self._state in _RESTING):
            self._stop.call_async(Trigger.Request())
            return 'the excitation ramps to rest'
        return f'the excitation {"is at rest" if phase == "playing" else "was not started"}'

    def _leave(self, answer: Any = None) -> None:
        """Stop the program of a start that was given up, unless the start was refused."""
        # the answer to a newer start tells which of the two programs plays
        if self._phase == 'starting':
            return
        is_last = answer is None or answer is self.left
        # the excitation refuses a newer start, given up as well, if it has accepted an earlier one
        if (is_last or self.left is not None) and (answer is None or answer.result().success):
            self._stop.call_async(Trigger.Request())
        if is_last:
            self.left = None
            self._give_back()

    def _give_back(self, *_: object) -> None:
        """Restore the earlier program of the excitation, unless another run is being started."""
        busy = self.left is not None or self._phase in ('setting', 'starting')
        if self._before is not None and not busy:
            self._set.call_async(_program(self._before))
            self._before = None

    def _end(self, reason: str | None) -> None:
        if reason is not None:
            self.stop()
        self._phase = ''
        self._ended(reason)

    def _hear(self, message: DiagnosticStatus) -> None:
        values = {pair.key: pair.value for pair in message.values}
        self._state, self._message = values.get('state', ''), values.get('text', message.message)
        sent = values.get('samples', '')
        self._sent = int(sent) if sent.isdecimal() else 0
        if self._phase != 'playing':
            return
        self._sign = time.monotonic()
        if self._state not in _RESTING:
            # an older latched status says that the excitation is at rest
            self._active = True
            with suppress(ValueError):
                self.progress = float(values.get('progress', '0'))

    def _hear_stage(self, message: DiagnosticStatus) -> None:
        text = {pair.key: pair.value for pair in message.values}.get('text', message.message)
        self._trouble = '' if message.level == DiagnosticStatus.OK else text

    def poll(self) -> None:
        """Take the run to its next phase, or give it up after too long a silence."""
        self._looks.look()
        if self._phase:
            getattr(self, f'_{self._phase}')()
        elif self.left is not None and self._plays and not self._silent():
            # later a program may be of someone else: the answer alone counts
            if self._looks.is_over(self._sign, _AGAIN):
                # the answer is lost, and the start was accepted
                self._leave()

    @property
    def _plays(self) -> bool:
        """Whether a status since the start says that the excitation plays a program."""
        return self._state not in (*_RESTING, _UNHEARD)

    @property
    def _patience(self) -> float:
        return min(self._limit, _UNANSWERED) if self._trouble else self._limit

    def _silent(self) -> bool:
        return self._looks.is_over(self._sign, self._limit)

    def _finding(self) -> None:
        ready = self._is_ready
        missing = self._missing() if ready else ''
        if ready and not missing:
            self._phase, self._sign = 'asking', time.monotonic()
            self._send(self._get, GetParameters.Request(names=['program']))
        elif missing and self._silent():
            self._end(f'no publisher of {missing} within {self._limit:g} s; start the stage')
        elif self._silent():
            self._end(
                f"no excitation offers '{self._start.srv_name}' within {self._limit:g} s; start "
                'it in this namespace, or remap that name'
            )

    def _send(self, client: Any, request: Any) -> None:
        self._future, self._asked = client.call_async(request), time.monotonic()
        self._asks = client, request

    def _insisted(self, doing: str) -> Any:
        """Return the response to the last request; send the request again after `_AGAIN`."""
        response = self._response(doing)
        # a request before both sides have matched is lost; a second request is harmless
        if response is None and self.running and time.monotonic() - self._asked > _AGAIN:
            client, request = self._asks
            client.remove_pending_request(self._future)
            self._send(client, request)
        return response

    def _asking(self) -> None:
        # without this service the excitation keeps the program of the run
        if self._get.service_is_ready() or time.monotonic() - self._sign < _AGAIN:
            if (response := self._insisted('telling its program')) is None:
                return
            if self._before is None and response.values:
                self._before = response.values[0]
        self._phase, self._sign = 'setting', time.monotonic()
        value = Parameter('program', value=self._program).get_parameter_value()
        self._send(self._set, _program(value))

    def _setting(self) -> None:
        response = self._insisted('taking the program')
        if response is None:
            return
        result = response.results[0]
        if not result.successful:
            self._end(f'the excitation refuses the program: {result.reason}')
            return
        self._first, self._active, self._done = self._streams(), False, 0.0
        self._seen, self._stage_sign, self._slowest = self._first, time.monotonic(), 0.0
        self._state, self._message = _UNHEARD, ''
        self._phase, self._sign = 'starting', time.monotonic()
        self._future = self._start.call_async(Trigger.Request())

    def _starting(self) -> None:
        response = self._response('starting')
        if response is None:
            # a lost answer: the excitation has taken the program, and plays
            if not (self.running and self._plays and self._looks.is_over(self._sign, _AGAIN)):
                return
            self._start.remove_pending_request(self._future)
        # after a refusal the excitation plays a program of someone else: `_end` does not stop it
        success = response is None or response.success
        self._phase = 'playing' if success else 'refused'
        if self.left is not None and success:
            # the program of an earlier start is over
            self._start.remove_pending_request(self.left)
            self.left = None
        elif self.left is not None and self.left.done():
            self._leave(self.left)
        self._give_back()
        if not success:
            self._end(f'the excitation does not start: {response.message}')
            return
        self._begin()
        self._sign = time.monotonic()
        # the status may have come before the answer
        self._active = self._plays

    def _response(self, doing: str) -> Any:
        if self._future.done():
            future, self._future = self._future, None
            if (response := future.result()) is not None:
                return response
            self._end(f'the excitation did not respond while {doing}')
        elif self._silent():
            self._end(f'the excitation did not respond within {self._limit:g} s while {doing}')
        return None

    def _playing(self) -> None:
        now, streams = time.monotonic(), self._streams()
        if _moved(streams.voltage_time, self._seen.voltage_time):
            self._sign = now
        heard = streams.voltage != self._first.voltage
        # both times are NaN while nothing has arrived
        behind = streams.displacement_time != streams.voltage_time
        gone_on = _moved(streams.displacement_time, self._seen.displacement_time)
        if gone_on or not behind or not heard:
            if heard:
                self._slowest = max(self._slowest, now - self._stage_sign)
            self._stage_sign = now
        self._seen = streams
        started = self._active or heard
        if started and self._state == 'done':
            self._done = self._done or now
            # a driver that answers in batches is as late with its last answer
            newest, patience = max(self._done, self._stage_sign), max(_TAIL, 2.0 * self._slowest)
            is_whole = streams.voltage - self._first.voltage >= self._sent and not behind
            if is_whole or self._looks.is_over(newest, patience):
                self._end(None)
        elif started and self._state in _RESTING:
            self._end(f'the excitation ended early ({self._state}): {self._message}')
        elif behind and heard and self._looks.is_over(self._stage_sign, self._patience):
            at = streams.displacement_time
            since = 'none at all' if math.isnan(at) else f'since t = {at:.6g} s'
            why = f'it says: {self._trouble}' if self._trouble else 'is it running?'
            self._end(f'no displacement from the stage for {self._patience:g} s, {since}; {why}')
        elif self._silent():
            last = f' (last: {self._state}, {self._message})' if self._state != _UNHEARD else ''
            self._end(f'no status of the excitation for {self._limit:g} s{last}')


def _program(value: Any) -> SetParameters.Request:
    """Make the request that sets the program of the excitation."""
    return SetParameters.Request(parameters=[ParameterMessage(name='program', value=value)])


def _moved(time: float, before: float) -> bool:
    """Return whether a stream has advanced; both times are NaN before its first sample."""
    return time != before and not (math.isnan(time) and math.isnan(before))

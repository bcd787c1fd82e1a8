# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""The identifier's route to the excitation: set its programme, start it, watch it to the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from piezo_ident.nodes.wire import LATCHED, SERVICE
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

__all__ = ['Drive', 'Streams']

#: states of the excitation in which it has ended, one way or the other, or not begun
_RESTING = ('idle', 'done', 'failed', 'stopped', 'cancelled', '')
#: before the first word since it was asked to start: what it said of an earlier run says nothing
_UNHEARD = 'unheard'
#: how long the last blocks may be under way after the excitation says done [s]
_TAIL = 1.0
#: after how long a programme that is not acknowledged is set once more [s]
_AGAIN = 2.0


@dataclass(frozen=True)
class Streams:
    """How far the two streams have come: a number that grows, and the time of the last sample."""

    voltage: int
    voltage_time: float
    displacement: int
    displacement_time: float


class Drive:
    """
    One run of the excitation's programme at a time.

    Nothing waits: answers are looked for whenever `poll` is called.

    Parameters
    ----------
    node : Node
        On which clients and subscription are made.
    streams : callable
        Returns the `Streams` as they are.
    missing : callable
        Returns the topics to which nobody publishes yet, for people; empty when all is there.
    """

    def __init__(
        self,
        node: Node,
        streams: Callable[[], Streams],
        missing: Callable[[], str],
    ) -> None:
        self._streams, self._missing = streams, missing
        self._begin: Callable[[], None] = _nothing
        self._ended: Callable[[str | None], None] = _nothing
        self._set, self._start, self._stop = (
            node.create_client(kind, f'excitation/{name}', qos_profile=SERVICE)
            for kind, name in (
                (SetParameters, 'set_parameters'),
                (Trigger, 'start'),
                (Trigger, 'stop'),
            )
        )
        node.create_subscription(DiagnosticStatus, 'excitation/status', self._hear, LATCHED)
        self._phase = ''
        self._future: Any = None
        self._asked = 0.0
        self._state, self._message = '', ''
        self.progress = 0.0

    @property
    def running(self) -> bool:
        """Whether a run is under way."""
        return bool(self._phase)

    @property
    def is_starting(self) -> bool:
        """Whether the excitation was asked to start and has not answered yet."""
        return self._phase == 'starting'

    @property
    def is_possible(self) -> bool:
        """Whether an excitation and a stage are there, as far as is known now."""
        ready = self._set.service_is_ready() and self._start.service_is_ready()
        return ready and not self._missing()

    def start(
        self,
        program: str,
        limit: float,
        ended: Callable[[str | None], None],
        begin: Callable[[], None] | None = None,
    ) -> None:
        """
        Begin a run.

        Parameters
        ----------
        program : str
            For the excitation's parameter ``program``.
        limit : float
            How long to wait for a sign of the excitation, or of the stage [s].
        ended : callable
            Called once with None when the programme was captured to its end, else with the
            reason; not called after `stop`.
        begin : callable, optional
            Called once the excitation has agreed to start.
        """
        self._program, self._limit = program, limit
        self._begin, self._ended = begin or _nothing, ended
        self._phase, self._future, self.progress = 'finding', None, 0.0
        self._sign = time.monotonic()

    def stop(self) -> None:
        """Give up the run, and ask the excitation to ramp to rest."""
        if self._phase in ('starting', 'playing') and self._stop.service_is_ready():
            self._stop.call_async(Trigger.Request())
        self._phase = ''

    def _end(self, reason: str | None) -> None:
        if reason is not None:
            self.stop()
        self._phase = ''
        self._ended(reason)

    def _hear(self, message: DiagnosticStatus) -> None:
        values = {pair.key: pair.value for pair in message.values}
        self._state, self._message = values.get('state', ''), message.message
        if self._phase != 'playing':
            return
        self._sign = time.monotonic()
        if self._state not in _RESTING:
            # what was latched before this run says nothing about it
            self._active = True
            try:
                self.progress = float(values.get('progress', '0'))
            except ValueError:
                pass

    def poll(self) -> None:
        """Go on where something has happened, and give up where nothing has for too long."""
        if self._phase:
            getattr(self, f'_{self._phase}')()

    def _silent(self) -> bool:
        return time.monotonic() - self._sign > self._limit

    def _finding(self) -> None:
        ready = self._set.service_is_ready() and self._start.service_is_ready()
        missing = self._missing() if ready else ''
        if ready and not missing:
            self._phase, self._sign = 'setting', time.monotonic()
            self._ask_for_programme()
        elif missing and self._silent():
            self._end(f'nobody publishes {missing} within {self._limit:g} s; start the stage')
        elif self._silent():
            self._end(
                f"no excitation offers '{self._start.srv_name}' within {self._limit:g} s; start "
                'it in this namespace, or remap that name'
            )

    def _ask_for_programme(self) -> None:
        parameter = Parameter('program', value=self._program).to_parameter_msg()
        if self._future is not None:
            self._set.remove_pending_request(self._future)
        self._future = self._set.call_async(SetParameters.Request(parameters=[parameter]))
        self._asked = time.monotonic()

    def _setting(self) -> None:
        answer = self._answer('taking the programme')
        if answer is None:
            # what both sides have not heard of each other yet is dropped by the middleware, and to
            # set a programme twice does no harm
            if self.running and time.monotonic() - self._asked > _AGAIN:
                self._ask_for_programme()
            return
        result = answer.results[0]
        if not result.successful:
            self._end(f'the excitation refuses the programme: {result.reason}')
            return
        self._first, self._active, self._done = self._streams(), False, 0.0
        self._seen, self._stage_sign = self._first, time.monotonic()
        self._state, self._message = _UNHEARD, ''
        self._phase, self._sign = 'starting', time.monotonic()
        self._future = self._start.call_async(Trigger.Request())

    def _starting(self) -> None:
        answer = self._answer('starting')
        if answer is None:
            return
        if not answer.success:
            # whatever it plays is not ours to stop
            self._phase = 'refused'
            self._end(f'the excitation does not start: {answer.message}')
            return
        self._begin()
        self._phase, self._sign = 'playing', time.monotonic()
        # the status may have come before the answer
        self._active = self._state not in (*_RESTING, _UNHEARD)

    def _answer(self, doing: str) -> Any:
        if self._future.done():
            future, self._future = self._future, None
            answer = future.result()
            if answer is not None:
                return answer
            self._end(f'the excitation gave no answer while {doing}')
        elif self._silent():
            self._end(f'the excitation gave no answer within {self._limit:g} s while {doing}')
        return None

    def _playing(self) -> None:
        now, streams = time.monotonic(), self._streams()
        if _moved(streams.voltage_time, self._seen.voltage_time):
            self._sign = now
        heard = streams.voltage != self._first.voltage
        # while nothing has come both times are NaN, and more may be under way
        behind = streams.displacement_time != streams.voltage_time
        gone_on = _moved(streams.displacement_time, self._seen.displacement_time)
        if gone_on or not behind or not heard:
            self._stage_sign = now
        self._seen = streams
        started = self._active or heard
        if started and self._state == 'done':
            self._done = self._done or now
            if not behind or now - self._done > _TAIL:
                self._end(None)
        elif started and self._state in _RESTING:
            self._end(f'the excitation ended early ({self._state}): {self._message}')
        elif behind and heard and now - self._stage_sign > self._limit:
            at = streams.displacement_time
            since = 'with none at all' if math.isnan(at) else f'since t = {at:.6g} s'
            self._end(
                f'the stage has given no displacement for {self._limit:g} s, {since}; is it '
                'running?'
            )
        elif self._silent():
            said = f' (last: {self._state}, {self._message})' if self._state != _UNHEARD else ''
            self._end(f'no sign of the excitation for {self._limit:g} s{said}')


def _moved(time: float, before: float) -> bool:
    """Return whether a stream has come further; both are NaN while there is none."""
    return time != before and not (math.isnan(time) and math.isnan(before))


def _nothing(*_: object) -> None:
    """Do nothing."""

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Base of the feedforward node: right to drive, ramps to rest, faults, safe end.

A node with the right to drive is the only node that sends `voltage`; see `ExclusivePublisher`.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import ConfigError
from piezo_ident.live.guard import LAST_RAMP
from piezo_ident.live.pacing import Pace
from piezo_ident.live.tracker import Tracker
from piezo_ident.nodes.exclusive_publisher import ExclusivePublisher
from piezo_ident.nodes.journal import RecentFaults
from piezo_ident.nodes.lab_node import LabNode
from piezo_ident.record.blocks import BLOCK_SIZE, Samples

#: period of the timer that waits, ramps and watches [s]
PERIOD = 0.01
#: states in which the node holds or awaits the right to drive, with their meaning for people
NOW = {
    'waiting': 'waiting for subscribers',
    'ready': 'waiting for a reference',
    'tracking': 'following the reference',
    'learning': 'learning',
    'stopping': 'ramping to rest',
}
DRIVING = tuple(NOW)


class DrivingNode(LabNode):
    """
    Node that takes the right to drive, and gives it back when the stage rests after a stop.

    A timer waits for the right, calls `work` every `PERIOD` until a stop, and then ramps to rest.
    A subclass sets the tracker before it drives, and publishes its state in `report_state`.
    """

    def __init__(self, **kwargs: Any) -> None:
        self._state: str = 'idle'
        self._end = ('', '')
        # the faults of the last drive
        self._caveats = ''
        super().__init__(**kwargs)
        self._rate_of_clock = self.values['sample_rate']
        self._tracker: Tracker | None = None
        # the reason for refusing the last model
        self._refusal = ''
        self._faults = RecentFaults()
        self._counts = self._faults.counts
        self._begin_ramp()
        self._tails = self.tails()
        self._outputs = [ExclusivePublisher(self, f'voltage{tail}') for tail in self._tails]
        self._timer = self.create_timer(PERIOD, self._on_timer, autostart=False)
        self.offer('stop', self._stop)

    def report_state(self) -> None:
        """Publish state, problems and numbers on ``~/status``."""

    def work(self) -> str:
        """Work for one `PERIOD`; the first call, with the right to drive, returns the state."""
        return ''

    def _take_right(self, tracker: Tracker) -> None:
        """Ask for the right to drive."""
        tracker.reset()
        self._faults.clear()
        self._caveats = ''
        for output in self._outputs:
            output.open()
        self._timer.reset()
        self._go('waiting')

    def _go(self, state: str) -> None:
        self._state = state
        self.report_state()

    def _stop(self) -> str:
        if self._state not in DRIVING:
            raise ConfigError('the node does not drive')
        # a ramp after a fault keeps its reason
        if self._state != 'stopping':
            self._halt('stopped', 'stopped')
        return f'ramping to {self.values["rest"]:g} V'

    def _on_timer(self) -> None:
        try:
            if self._state == 'waiting':
                limits = self.values['subscribers'], self.values['wait_limit']
                granted = [output.poll(*limits) for output in self._outputs]
                if all(granted):
                    self._go(self.work())
            elif self._state == 'stopping':
                self._ramp()
            else:
                for output in self._outputs:
                    output.refuse_foreign_blocks()
                self.work()
        except Exception as error:  # noqa: BLE001  # any fault ends at rest
            self._halt('failed', self.reason(error))

    def _send(self, t: NDArray[np.float64], v: NDArray[np.float64], segment: str) -> None:
        for k in range(0, t.size, BLOCK_SIZE * 10):
            cut = slice(k, k + BLOCK_SIZE * 10)
            rows = reversed([*zip(self._tails, self._outputs, np.atleast_2d(v), strict=True)])
            for tail, output, row in rows:
                output.send(Samples(t[cut], row[cut], segment, f'voltage{tail}'))
        self._counts['samples'] += t.size

    def _note_second(self) -> None:
        """Note a second publisher of a voltage as a fault; the node drives on."""
        for tail, output in zip(self._tails, self._outputs, strict=True):
            if second := output.second() if output.is_open else '':
                self._faults.note('second', f'second publisher {second} on voltage{tail}', 0)

    def _halt(self, state: str, text: str) -> None:
        """Begin a ramp to rest; at rest the node reports this state and text."""
        self._end = state, text
        self._begin_ramp()
        self._state = 'stopping'
        self._ramp()

    def _begin_ramp(self) -> None:
        self._pace = Pace(self._rate_of_clock, 5 * PERIOD)

    def _ramp(self) -> None:
        tracker = self._tracker
        if tracker is not None and not tracker.is_at_rest:
            self._send_ramp(tracker)
        if tracker is None or tracker.is_at_rest:
            self._finish()
        else:
            self.report_state()

    def _send_ramp(self, tracker: Tracker) -> None:
        if (due := self._pace.due()) > 0:
            self._send(*tracker.idle(due), 'ramp:stop')

    def _finish(self) -> None:
        self._close_outputs()
        self._timer.cancel()
        if self._tracker is not None:
            self._tracker.reset()
        self._caveats = self._faults.summary
        self._go(self._end[0])

    def _problems(self) -> str:
        problems = [self._refusal, *self._caveats.split('; '), *self._faults.text.split('; ')]
        return '; '.join(filter(None, dict.fromkeys(problems)))

    def close(self) -> None:
        """Ramp to rest within a second."""
        tracker, begin, sent = self._tracker, time.monotonic(), 0
        size = max(1, round(PERIOD * self._rate_of_clock))
        if tracker is not None:
            # replaces a slow ramp by a ramp that ends in time
            tracker.hurry()
        is_open = any(output.is_open for output in self._outputs)
        while tracker is not None and is_open and not tracker.is_at_rest:
            self._send(*tracker.idle(size, LAST_RAMP), 'ramp:stop')
            sent += size
            time.sleep(max(0.0, begin + sent / self._rate_of_clock - time.monotonic()))
        self._close_outputs()

    def _close_outputs(self) -> None:
        for output in self._outputs:
            output.close()

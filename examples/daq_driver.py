# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A DAQ card in the place of the node `stage`, with all that a driver of an amplifier must do."""

import time

import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.live.guard import Guard, GuardSettings
from piezo_ident.live.sample_clock import Kind, SampleClock
from piezo_ident.nodes.ending import ENDING
from piezo_ident.nodes.lab_node import LabNode, OK, run, WARN
from piezo_ident.nodes.wire import await_readers, from_message, publisher_ids, STREAM, to_message
from piezo_ident.record.blocks import Samples
from std_msgs.msg import Float64MultiArray

RATE = 20_000.0  # Hz, the clock of the card
PERIOD = 0.01  # s, of what is sent while no command comes
LIMITS = ('voltage_low', 'voltage_high', 'slew', 'ramp_slew', 'rest')


def convert(v: np.ndarray) -> np.ndarray:
    """Put v [V] out, and return the displacement [m] that was read on the same ticks."""
    return 7.5e-6 * v  # your card's call; it may wait until the samples are out


def held(rest: float) -> float:
    """Return what the card puts out now [V]: a driver that was killed left its last voltage."""
    return rest  # your card's call, where it can read its output back


class Driver(LabNode):
    """Publishes what the amplifier got and what the stage did, block by block."""

    executable = 'stage'  # whose name, parameters and config/stage.yaml it takes over

    def __init__(self) -> None:
        super().__init__()
        self.guard = Guard(self._settings(self.values), held(self.values['rest']))
        Guard(self.guard.settings).process([np.nan])  # compiles what blocks would wait for
        self.sample_clock = SampleClock(RATE, self.values['silence'])
        self.tick, self.heard = 0, time.monotonic()
        self.y = self.create_publisher(Float64MultiArray, 'displacement', STREAM)
        self.applied = self.create_publisher(Float64MultiArray, 'applied_voltage', STREAM)
        self.v = self.create_subscription(Float64MultiArray, 'voltage', self._on_block, STREAM)
        self.create_timer(PERIOD, self._on_timer)

    def _settings(self, values: dict) -> GuardSettings:
        return GuardSettings(*(values[name] for name in LIMITS), RATE)

    def refuse(self, name: str, value: object) -> str | None:
        """Refuse limits that are crossed; somebody may set them while the stage moves."""
        if name in LIMITS and set(LIMITS) <= set(self.wanted):
            self._settings(self.wanted)
        return None

    def apply(self, changed: dict) -> None:
        """Take new limits over at the next sample."""
        self.guard.settings = self._settings(self.values)
        self.sample_clock.longest_gap = self.values['silence']

    def _on_block(self, message: Float64MultiArray, info: dict) -> None:
        number = info.get('publication_sequence_number')
        try:
            samples = from_message(message, 'voltage')
        except DataError as error:
            self.sample_clock.skip(number)
            return self.report_status('running', 0.0, f'refused: {error}', WARN)
        verdict = self.sample_clock.judge(samples, number, lambda: publisher_ids(self, self.v))
        if not verdict.is_taken:  # of a second publisher, or one that came before, or too late
            return self.report_status('running', 0.0, f'refused: {verdict.reason}', WARN)
        self.heard = time.monotonic()
        if verdict.kind is Kind.GAP:  # for so long the voltage stayed where it was
            self._move(self.guard.hold(verdict.missing), 'hold:gap')
        self.tick = verdict.tick  # so that both topics carry the t of the command
        applied = self.guard.process(samples.values, restarted=verdict.kind is Kind.START)
        y = self._move(applied.voltage, samples.segment)
        self.y.publish(to_message(Samples(samples.t, y, samples.segment, 'displacement')))
        level, text = (WARN, dict(applied.altered)) if applied.altered else (OK, samples.segment)
        self.report_status('running', 0.0, f'{text}', level)

    def _move(self, v: np.ndarray, segment: str) -> np.ndarray:
        y, t = convert(v), np.arange(self.tick, self.tick + v.size) / RATE
        self.tick += v.size
        self.applied.publish(to_message(Samples(t, v, segment)))
        return y

    def _on_timer(self) -> None:
        if time.monotonic() - self.heard > self.values['silence']:
            self.sample_clock.pause()  # what comes next is a new stream, and joined by a ramp
            if self.guard.is_at_rest:
                self.sample_clock.end()  # and may be another publisher's
            else:
                self._move(self.guard.idle(round(PERIOD * RATE)), 'ramp:silence')
                self.report_status('ramping', 0.0, 'no voltage: ramping to rest', WARN)

    def close(self) -> None:
        """Be at rest within a second: a slow ramp that is under way gives way to this one."""
        self.guard, due = Guard(self.guard.settings, self.guard.applied), time.monotonic()
        while not self.guard.is_at_rest:
            self._move(self.guard.idle(round(PERIOD * RATE), 0.7), 'ramp:stop')
            due += PERIOD  # so that what comes late is made up
            time.sleep(max(0.0, due - time.monotonic()))
        await_readers(self.applied)  # what is still under way would be lost with this process


if __name__ == '__main__':
    ENDING.leave(run(Driver))

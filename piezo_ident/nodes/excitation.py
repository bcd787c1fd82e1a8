# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Excitation node: plays programs on `voltage`, or on `reference` for the feedforward node.

``~/start`` builds the program of the parameter `program`, waits for `subscribers`, and sends block
after block from a thread.  The clock of the samples starts at zero with every program.  A block is
sent when its first sample is due on this clock, which runs `rate_factor` times as fast as real
time.  Another `rate_factor` or `block_size` counts from the next start on.  A late listener does
not hold up the node; each listener reports its losses.

``~/stop`` ramps from the last voltage to rest with `ramp_slew`, as segment ``ramp:stop``.  SIGINT
and SIGTERM end in a ramp of at most a second, if necessary steeper than `ramp_slew`.  Ramps run in
real time.

With `axes` the node drives several axes, each on its own topic with its own random signals:
`voltage_b` for axis `b`.  The axes move at once, or with `in_turn` one after the other.  All axes
begin, end and stop together.

Two programs at once would tear the stage to and fro.  The node therefore refuses to start beside a
second publisher on its topic, and only reports a publisher that comes later.  The middleware lists
a killed excitation for some 20 s.  A silent publisher of the node's own name counts as killed; the
node listens for half a second before the first block.  Two nodes of one name that start together
hear each other in their first second; both ramp to rest, and their programs fail.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as Many
from dataclasses import dataclass, field, replace
import math
from pathlib import Path
import re
import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import ConfigError
from piezo_ident.excitation.axes import build_axes
from piezo_ident.excitation.program import parse_program, Program, Sequence
from piezo_ident.live.guard import Guard, GuardSettings, LAST_RAMP
from piezo_ident.live.pacing import Rate, Schedule, SLIP
from piezo_ident.nodes.exclusive_publisher import ExclusivePublisher
from piezo_ident.nodes.lab_node import guard_settings, LabNode, OK, WARN
from piezo_ident.record.blocks import cut_blocks, Samples

#: unit of a program, and its factor to the SI unit
UNITS = {'voltage': ('V', 1.0), 'reference': ('um', 1e-6)}
#: the unit in the messages of a program
_VOLTS = re.compile(r'(?<= )V\b')
#: most blocks that are sent at once after a delay
CATCH_UP = 50
#: share of the voltage range below which the answer to ~/start names the range of a program
NARROW = 0.5


def read_program(text: str) -> Program:
    """Read the program that a parameter names or contains; ConfigError if it has a fault."""
    if '\n' in text or ('segments' in text and ':' in text):
        return parse_program(text)
    return Program.load(text)


def _name(sequence: Sequence) -> str:
    """Return the name of a program without the folder of its file."""
    return Path(sequence.name).stem.removeprefix('program_')


@dataclass(eq=False)
class Playing:
    """State of a program that is played, shared by both threads; a sequence for each axis."""

    sequences: tuple[Sequence, ...]
    block_size: int
    factor: float
    stop: threading.Event = field(default_factory=threading.Event)
    hurry: bool = False
    tick: int = 0
    voltages: list[float] = field(default_factory=list)
    clock: Schedule | None = None
    work: float = 0.0
    segment: str = ''
    second: str = ''
    is_over: bool = False

    @property
    def sequence(self) -> Sequence:
        """Sequence of the first axis; all axes have the same segments."""
        return self.sequences[0]


class _Stopped(Exception):
    """~/stop was called, or the node ends."""


class ExcitationNode(LabNode):
    """Plays programs, each on a topic for every axis."""

    executable = 'excitation'

    def __init__(self, **kwargs: Any) -> None:
        self._built: tuple[tuple[object, ...], tuple[Sequence, ...]] | None = None
        self._playing: Playing | None = None
        self._thread: threading.Thread | None = None
        self._second = ''
        self._rate = Rate()
        super().__init__(**kwargs)
        self._tails = self.tails()
        self._build(self.values['program'])
        # compiles the kernel, so that a ramp to rest need not wait for it
        Guard(self._guard_settings())
        self._quantity = self.values['quantity']
        self._unit, self._scale = UNITS[self._quantity]
        # the topic of an axis is the quantity with the tail of the axis
        self._outputs = [
            ExclusivePublisher(self, f'{self._quantity}{tail}', stays=True) for tail in self._tails
        ]
        self._output = self._outputs[0]
        self.offer('start', self._start)
        self.offer('stop', self._stop)

    # parameters

    def refuse(self, name: str, value: Any) -> str | None:
        """Refuse programs that cannot be played, and limits that are crossed."""
        if name not in ('program', 'in_turn', 'voltage_low', 'voltage_high', 'rest'):
            return None
        # not all parameters are declared yet
        if not {'program', 'voltage_low', 'voltage_high', 'rest'} <= self.values.keys():
            return None
        if name not in ('program', 'in_turn') and self._is_playing():
            return f'{name} cannot be changed while a program is played; call ~/stop first'
        self._guard_settings(self.wanted)
        self._build(self.wanted['program'], self.wanted)
        return None

    def _build(self, text: str, values: Mapping[str, Any] | None = None) -> tuple[Sequence, ...]:
        values = values or self.values
        limits = (values['voltage_low'], values['voltage_high'])
        key = (text, limits, values.get('in_turn'))
        # a file may have changed, so it is read again
        if self._built is None or self._built[0] != key or '\n' not in text:
            try:
                count = 1 + sum(map(bool, values.get('axes', ())))
                program = replace(read_program(text), unit=UNITS[self.values['quantity']][0])
                in_turn = values.get('in_turn', False)
                built = build_axes(program, count, values['sample_rate'], limits, in_turn=in_turn)
            except ConfigError as error:
                unit = UNITS[self.values['quantity']][0]
                raise ConfigError(_VOLTS.sub(unit, str(error))) from None
            except (OSError, MemoryError) as error:
                raise ConfigError(f'program: {error}') from None
            self._built = (key, built)
        return self._built[1]

    def _guard_settings(self, values: Mapping[str, Any] | None = None) -> GuardSettings:
        v = values or self.values
        # a program keeps to its own slew
        return guard_settings({**v, 'slew': math.inf}, v['sample_rate'])

    # services

    def _start(self) -> str:
        if self._is_playing():
            raise ConfigError('a program is being played already; call ~/stop first')
        if self._thread is not None:
            self._thread.join()
        playing = Playing(
            self._build(self.values['program']),
            self.values['block_size'],
            self.values['rate_factor'],
        )
        sequence = playing.sequence
        # read before the start: the file of the program may be gone
        notes = f'{self._unused(sequence)}{self._other_rate(sequence)}'
        for output in self._outputs:
            output.open()
        self._playing = playing
        self._rate = Rate()
        self.report_status('waiting', 0.0, 'waiting for subscribers')
        self._thread = threading.Thread(
            target=self._run, args=(playing,), name='playing', daemon=True
        )
        self._thread.start()
        return (
            f'{_name(sequence)}: {sequence.duration:.1f} s, {len(sequence.segments)} segments, '
            f'{sequence.n} samples{notes}'
        )

    def _other_rate(self, sequence: Sequence) -> str:
        """Return a note if the program names another rate than this node has, or ''."""
        own, rate = read_program(self.values['program']).sample_rate, sequence.sample_rate
        if own is None or own == rate:
            return ''
        return f'; at the {rate:g} Hz of this node, not at the {own:g} Hz of the program'

    def _unused(self, sequence: Sequence) -> str:
        """Return a note if a program drives less than `NARROW` of the voltage range, or ''."""
        low, high = float(sequence.v.min()), float(sequence.v.max())
        limits = self.values['voltage_low'], self.values['voltage_high']
        if self._quantity != 'voltage' or high - low >= NARROW * (limits[1] - limits[0]):
            return ''
        return f'; it drives {low:g} .. {high:g} V of {limits[0]:g} .. {limits[1]:g} V'

    def _stop(self) -> str:
        playing = self._playing
        if playing is None or not self._is_playing():
            raise ConfigError('nothing is being played')
        playing.stop.set()
        return f'ramping to {self.values["rest"]:g} {self._unit}'

    def _is_playing(self) -> bool:
        thread, playing = self._thread, self._playing
        # the thread lives on for a moment after its last status
        is_over = playing is not None and playing.is_over
        return thread is not None and thread.is_alive() and not is_over

    # playing, in a thread of its own

    def _run(self, playing: Playing) -> None:
        try:
            self._await_graph(playing)
            self._play(playing)
        except _Stopped:
            self._ramp(playing, 'stopped', 'stopped')
        # the status has to report any failure of this thread
        except Exception as error:  # noqa: BLE001
            self._ramp(playing, 'failed', self.reason(error))
        else:
            clock, behind = playing.clock, ''
            level = WARN if playing.second else OK
            if clock is not None and clock.late:
                behind = f', {clock.late} blocks late, by up to {1e3 * clock.worst:.0f} ms'
            about = f'{_name(playing.sequence)} played{behind}'
            text = '; '.join(filter(None, [about, playing.second]))
            self._end(playing, 'done', 100.0, text, level)

    def _await_graph(self, playing: Playing) -> None:
        needed, limit = self.values['subscribers'], self.values['wait_limit']
        for output in self._outputs:
            while not output.poll(needed, limit):
                self._sleep(playing, time.monotonic() + 0.02)

    def _play(self, playing: Playing) -> None:
        sequence = playing.sequence
        speed = playing.factor * sequence.sample_rate
        # blocks that are sent late all at once must fit into the queues of the readers
        slip = min(SLIP, CATCH_UP * playing.block_size / speed)
        clock = Schedule(speed, time.monotonic(), slip)
        playing.clock = clock
        for start, stop, label in cut_blocks(sequence.n, sequence.segments, playing.block_size):
            self._sleep(playing, clock.due(start))
            self._send(playing, [axis.v[start:stop] for axis in playing.sequences], label)
            for output in self._outputs:
                output.refuse_foreign_blocks()
            clock.note(start, stop - start, time.monotonic())
            level, warning = (WARN, f'; {self._second}') if self._second else (OK, '')
            playing.second = self._second or playing.second
            percent = math.floor(100.0 * stop / sequence.n)
            text = f'{_name(sequence)}, segment {label}{warning}'
            more = {'brief': f'{percent} %: {text}', 'problems': self._second, 'segment': label}
            self.report_status('running', percent, text, level, **more)
        # a stop during the last block
        self._sleep(playing, time.monotonic())

    def _sleep(self, playing: Playing, until: float) -> None:
        if playing.stop.wait(max(0.0, until - time.monotonic())):
            raise _Stopped

    def _send(self, playing: Playing, voltages: Many[NDArray[np.float64]], label: str) -> None:
        begin, n = time.perf_counter(), voltages[0].size
        t = np.arange(playing.tick, playing.tick + n) / playing.sequence.sample_rate
        playing.tick += n
        playing.voltages, playing.segment = [float(v[-1]) for v in voltages], label
        # the first axis last: readers wait but a moment for the others, and for the first any time
        for tail, output, v in reversed([*zip(self._tails, self._outputs, voltages, strict=True)]):
            output.send(Samples(t, v * self._scale, label, f'{self._quantity}{tail}'))
        playing.work = time.perf_counter() - begin

    def _ramp(self, playing: Playing, state: str, message: str) -> None:
        """Ramp to rest from the last voltage, in real time, and report the result."""
        settings = self._guard_settings()
        level = WARN if state == 'failed' else OK
        progress = math.floor(100.0 * playing.tick / playing.sequence.n)
        if any(voltage != settings.rest for voltage in playing.voltages):
            self.report_status(
                'stopping', progress, f'ramping to {settings.rest:g} {self._unit}', level
            )
            self._send_ramp(playing, [Guard(settings, voltage) for voltage in playing.voltages])
        self._end(playing, state, progress, message, level)

    def _send_ramp(self, playing: Playing, guards: list[Guard]) -> None:
        settings = guards[0].settings
        hurried, origin = False, playing.tick
        clock = playing.clock = Schedule(settings.sample_rate, time.monotonic())
        # short blocks, whatever the size in the program: the end must not wait
        size = min(playing.block_size, max(1, round(0.005 * settings.sample_rate)))
        while not all(guard.is_at_rest for guard in guards):
            if playing.hurry and not hurried:
                guards, hurried = [Guard(settings, guard.applied) for guard in guards], True
                # the whole ramp fits into the queues of the readers, so every delay is made up
                size, origin = max(1, round(0.01 * settings.sample_rate)), playing.tick
                clock = playing.clock = Schedule(clock.speed, time.monotonic(), math.inf)
            longest = LAST_RAMP if hurried else math.inf
            voltages = [guard.idle(size, longest) for guard in guards]
            time.sleep(max(0.0, clock.due(playing.tick - origin) - time.monotonic()))
            start = playing.tick
            self._send(playing, voltages, 'ramp:stop')
            clock.note(start - origin, size, time.monotonic())

    def _end(
        self, playing: Playing, state: str, progress: float, message: str, level: bytes = OK
    ) -> None:
        """Report the result; the next start may follow at once."""
        playing.is_over = True
        self.report_status(state, progress, message, level, samples=playing.tick)

    # reports

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return rate, blocks, delays and head-room; watch for a second publisher."""
        playing = self._playing
        if not self._is_playing():
            for output in self._outputs:
                output.stop_listening()
        foreign = [
            f'{who} on {self._quantity}{tail}'
            for tail, output in zip(self._tails, self._outputs, strict=True)
            for who in sorted({*output.others(), output.second()} - {''})
        ]
        self._second = f'second publisher {foreign[0]}' if foreign else ''
        values: dict[str, object] = {'publishers': self.count_publishers(self._output.topic)}
        if playing is None:
            return (WARN if foreign else OK), self._second or 'nothing played yet', values
        clock = playing.clock
        values |= {
            'rate': f'{self._rate.of(playing.tick):.1f}',
            'samples': playing.tick,
            'segment': playing.segment,
        }
        if clock is not None:
            period = playing.block_size / clock.speed
            values |= {
                'blocks': clock.sent,
                'late': clock.late,
                'worst_delay': f'{clock.worst:.6f}',
                'slipped': f'{clock.slipped:.6f}',
                'head_room': f'{max(0.0, 1.0 - playing.work / period):.3f}',
            }
        level, message = OK, 'playing' if self._is_playing() else 'silent'
        if foreign:
            level, message = WARN, self._second
        elif clock is not None and clock.slipped:
            level, message = WARN, f'the clock fell behind by {clock.slipped:.3f} s'
        return level, message, values

    def close(self) -> None:
        """Ramp to rest within a second."""
        playing = self._playing
        if playing is not None and self._thread is not None:
            playing.hurry = True
            playing.stop.set()
            # `ENDING` ends the node with an error if this takes too long
            self._thread.join()
            for output in self._outputs:
                output.close()

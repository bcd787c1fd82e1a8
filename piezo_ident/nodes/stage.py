# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Stage node: simulates a stage sample by sample, at any block size.

Each block of `voltage` passes the guard (`piezo_ident.live.guard`) and drives the stage.  The node
answers by a block of `displacement` and a block of `applied_voltage`, with the same t and segment.
`applied_voltage` is the voltage after the guard, before the converter rounds it.

A second axis has a guard and topics of its own: `voltage_b`, `displacement_b`,
`applied_voltage_b`.  A block of `voltage` waits for the block of `voltage_b` with the same t, for
the shorter of `PATIENCE` and half of `silence`.  Without that block the last voltage of the second
axis stays in force.  A second axis without a publisher stays at rest.

Like a real stage, the stage keeps its memory from stream to stream, and its own clock (for drift
and hum) goes on.

| in the stream | what the stage does | status |
|---|---|---|
| wrong layout, stamps off the clock | the block is refused; its ticks become a gap | WARN |
| a sample that is NaN or infinite | the last command stays in force for it | WARN |
| outside the limits, faster than the slew | at the limit; followed at the slew | WARN |
| a block that came before | ignored: no displacement, the stage does not move | WARN |
| a gap up to `silence`, at most 10 s | the stage holds its voltage for as many ticks, on \
`applied_voltage` as `hold:gap`, and publishes no displacement for them; the guard then follows \
the stream at the slew | WARN |
| a longer gap | a new stream | WARN |
| swapped blocks | the early one makes a gap, the late one is refused: its time has passed | WARN |
| another block size | the answer has the same size | |
| t jumps back to where the stream began, or by more than 1000 samples | a new stream, joined by \
a ramp | |
| t jumps back otherwise | the block is refused: its time has passed | WARN |
| limits or rest that are moved in silence | ramp to rest, back into the limits at the slew | |
| no block for `silence` | ramp to rest in real time, on `applied_voltage` as `ramp:silence`, t \
going on; what comes next is a new stream | WARN, unless it was at rest |
| a second publisher | its blocks are refused until the first publisher is silent, and either has \
gone or has left the stage at rest | WARN |

`piezo_ident.live.sample_clock` distinguishes publishers.  A loss of blocks beside a second
publisher ends the stream, because either publisher may have sent the block after the loss.

SIGINT and SIGTERM end in a ramp of at most a second, if necessary steeper than `ramp_slew`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import functools
import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import DataError
from piezo_ident.live.guard import Guard, GuardSettings, LAST_RAMP
from piezo_ident.live.join import Join
from piezo_ident.live.pacing import Looks, Pace, Rate
from piezo_ident.live.sample_clock import Kind, SampleClock
from piezo_ident.model.two_axis_stage import load_stage
from piezo_ident.nodes.journal import RecentFaults
from piezo_ident.nodes.lab_node import guard_settings, LabNode, OK, WARN
from piezo_ident.nodes.wire import await_readers, from_message, publisher_ids, STREAM, to_message
from piezo_ident.record.blocks import BLOCK_SIZE, HELD, RAMPED, Samples
from std_msgs.msg import Float64MultiArray

#: period of the timer that ramps a silent stage [s]
RAMP_PERIOD = 0.01
#: longest wait of a block for the block of a further axis, also limited by half of `silence` [s]
PATIENCE = 0.2
#: longest gap in which the voltage is held [s]
LONGEST_GAP = 10.0

_WHY = {
    'not_finite': 'samples are no numbers: the last command stays in force',
    'outside_limits': 'samples are outside the voltage limits: applied at the limit',
    'too_fast': 'samples are faster than slew: followed at the slew',
    'joining': 'samples changed while the stream is joined by a ramp',
}


class StageNode(LabNode):
    """Simulates a stage on the topics of a driver."""

    executable = 'stage'

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        try:
            self._stage = load_stage(self.values['stage'])
        except OSError as error:
            raise DataError(f'stage: {error}') from None
        seed = self._stage.seed if self.values['seed'] < 0 else self.values['seed']
        self.sample_rate = self._stage.sample_rate
        # the topic of an axis ends with the tail of the axis
        self._tails = [f'_{name}' if name else '' for name in self._stage.axes]
        self._axis_guards = [Guard(self._settings()) for _ in self._tails]
        self._warm_up()
        self._run = self._stage.run(np.random.default_rng(seed))
        self._sample_clock = SampleClock(self.sample_rate, self._longest_gap())
        # tick of the next applied sample, from a command, a gap or a ramp
        self._tick = 0
        self._segment = ''
        self._faults = RecentFaults()
        self._counts = self._faults.counts
        self._state = 'idle'
        self._looks, self._last = Looks(), time.monotonic()
        self._pace = Pace(self.sample_rate, 5 * RAMP_PERIOD)
        self._rate, self._work_rate, self._busy = Rate(), Rate(), 0.0
        self._displacement, self._applied = (
            [self.create_publisher(Float64MultiArray, f'{q}{x}', STREAM) for x in self._tails]
            for q in ('displacement', 'applied_voltage')
        )
        self._join = Join(self._tails[1:], self.sample_rate)
        listen = functools.partial(self.create_subscription, Float64MultiArray, qos_profile=STREAM)
        self._further = {
            tail: listen(f'voltage{tail}', functools.partial(self._on_further, tail))
            for tail in self._tails[1:]
        }
        self._input = listen('voltage', self._on_voltage)
        self._watch = self.create_timer(self._watch_period(), self._on_watch)
        self._ramp_timer = self.create_timer(RAMP_PERIOD, self._on_ramp, autostart=False)

    def _warm_up(self) -> None:
        """Compile the kernels, so that the first block need not wait."""
        run, guard = self._stage.run(np.random.default_rng(0)), Guard(self._settings())
        rest = guard.applied
        for v in ([rest] * 2, [rest, math.nan]):
            run.process(self._command([guard.process(v).voltage] * len(self._tails)))

    # parameters

    def refuse(self, name: str, value: Any) -> str | None:
        """Refuse limits that are crossed, and a rest outside of them."""
        if name in ('voltage_low', 'voltage_high', 'rest') and 'silence' in self.values:
            self._settings(self.wanted)
        return None

    def apply(self, changed: Mapping[str, Any]) -> None:
        """Apply new limits and times from the next sample on."""
        for guard in self._axis_guards:
            guard.settings = self._settings()
        self._sample_clock.longest_gap = self._longest_gap()
        self._watch.timer_period_ns = int(self._watch_period() * 1e9)
        if self._sample_clock.head is None and not self._is_at_rest:
            self._begin_ramp()

    def _settings(self, values: Mapping[str, Any] | None = None) -> GuardSettings:
        return guard_settings(values or self.values, self.sample_rate)

    def _longest_gap(self) -> float:
        return min(self.values['silence'], LONGEST_GAP)

    def _watch_period(self) -> float:
        return min(0.05, max(0.005, self.values['silence'] / 4))

    # blocks of voltage

    def _on_voltage(self, message: Float64MultiArray, info: Mapping[str, Any]) -> None:
        begin = time.perf_counter()
        sequence = info.get('publication_sequence_number')
        try:
            samples = from_message(message, 'voltage')
        except DataError as error:
            self._sample_clock.skip(sequence)
            self._faults.note('malformed', f'a block is refused: {error}')
        else:
            self._join.add('', samples, time.monotonic(), sequence)
            self._take_complete()
            self._busy += time.perf_counter() - begin
        self._report_state()

    def _on_further(self, tail: str, message: Float64MultiArray) -> None:
        try:
            self._join.add(tail, from_message(message, f'voltage{tail}'), time.monotonic())
        except DataError as error:
            self._faults.note('malformed', f'a block is refused: {error}')
        self._take_complete()

    def _take_complete(self) -> None:
        """Process the blocks whose further voltages have come or are overdue."""
        patience = min(PATIENCE, self.values['silence'] / 2)
        silent = [tail for tail, x in self._further.items() if not x.get_publisher_count()]
        for samples, sequence, _ in self._join.complete(
            lambda since: self._looks.is_over(since, patience), silent
        ):
            self._take(samples, sequence)

    def _take(self, samples: Samples, sequence: int | None) -> None:
        verdict = self._sample_clock.judge(
            samples, sequence, lambda: publisher_ids(self, self._input)
        )
        kind = verdict.kind
        if not verdict.is_taken:
            self._faults.note(kind.value, f'a block is refused: {verdict.reason}')
            return
        self._last = time.monotonic()
        if verdict.missing:
            self._counts['lost'] += verdict.missing
            self._faults.note('gap', verdict.reason)
        if kind is Kind.START:
            self._ramp_timer.cancel()
            self._counts['streams'] += 1
        elif kind is Kind.GAP:
            self._move([guard.hold(verdict.missing) for guard in self._axis_guards], HELD)
        applied = [
            self._guarded(tail, guard, samples, kind is Kind.START)
            for tail, guard in zip(self._tails, self._axis_guards, strict=True)
        ]
        y = self._run.process(self._command(applied))
        for k, column in enumerate(y.reshape(samples.t.size, -1).T):
            moved = Samples(samples.t, column, samples.segment, f'displacement{self._tails[k]}')
            self._displacement[k].publish(to_message(moved))
        self._publish_applied(samples.t, applied, samples.segment)
        self._tick = verdict.tick + samples.t.size
        self._counts['blocks'] += 1
        self._counts['samples'] += samples.t.size
        self._state, self._segment = 'running', samples.segment

    def _guarded(
        self, tail: str, guard: Guard, samples: Samples, restarted: bool
    ) -> NDArray[np.float64]:
        """Pass the command of an axis through its guard; return the applied voltage."""
        command = samples.values
        if tail:
            command = self._join.take(tail, samples.t)
            missing = int(np.count_nonzero(np.isnan(command)))
            if missing and (missing < command.size or not guard.is_at_rest):
                about = f'{missing} samples of voltage{tail} are missing: the last stays in force'
                self._faults.note('missing', about, missing)
        applied = guard.process(command, restarted=restarted)
        for why, n in applied.altered.items():
            if not (tail and why == 'not_finite'):
                self._faults.note(why, f'{n} {_WHY[why]}', n)
        return applied.voltage

    def _move(self, voltages: Sequence[NDArray[np.float64]], segment: str) -> None:
        """Apply a voltage that was not commanded, and publish it as applied."""
        self._run.process(self._command(voltages))
        for start in range(0, voltages[0].size, BLOCK_SIZE):
            cut = [v[start : start + BLOCK_SIZE] for v in voltages]
            t = np.arange(self._tick, self._tick + cut[0].size) / self.sample_rate
            self._publish_applied(t, cut, segment)
            self._tick += cut[0].size

    def _publish_applied(
        self, t: NDArray[np.float64], voltages: Sequence[NDArray[np.float64]], segment: str
    ) -> None:
        for tail, publisher, v in zip(self._tails, self._applied, voltages, strict=True):
            publisher.publish(to_message(Samples(t, v, segment, f'voltage{tail}')))

    def _command(self, voltages: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Stack voltages for the stage: a vector for one axis, a matrix for several."""
        return voltages[0] if len(voltages) == 1 else np.column_stack(voltages)

    # silence

    def _on_watch(self) -> None:
        self._looks.look()
        self._take_complete()
        is_silent = self._looks.is_over(self._last, self.values['silence'])
        if self._sample_clock.head is not None and is_silent:
            self._sample_clock.pause()
            if self._is_at_rest:
                self._end_stream()
                self._state = 'idle'
            else:
                silent = time.monotonic() - self._last
                self._faults.note('silence', f'no voltage for {silent:.2f} s: ramping to rest')
                self._begin_ramp()
        self._report_state()

    def _begin_ramp(self) -> None:
        self._state, self._segment = 'ramping', RAMPED
        self._pace = Pace(self.sample_rate, 5 * RAMP_PERIOD)
        self._ramp_timer.reset()

    def _on_ramp(self) -> None:
        if (due := self._pace.due()) > 0:
            self._move([guard.idle(due) for guard in self._axis_guards], RAMPED)
        if self._is_at_rest:
            self._ramp_timer.cancel()
            self._end_stream()
            self._state = 'idle'
            self._faults.note('silence', 'no voltage: ramped to rest', 0)
        self._report_state()

    def _end_stream(self) -> None:
        self._sample_clock.end()
        self._join.clear()

    @property
    def _is_at_rest(self) -> bool:
        return all(guard.is_at_rest for guard in self._axis_guards)

    # reports

    def _report_state(self) -> None:
        faults = self._faults.text
        segment = f'segment {self._segment}'
        now = {'running': segment, 'ramping': 'to rest', 'idle': 'at rest'}[self._state]
        text = f'{faults}; {now}' if faults else now
        level = WARN if faults else OK
        self.report_status(self._state, 0.0, text, level, problems=faults, segment=self._segment)

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return rate, counts of lost, altered and refused samples or blocks, and head-room."""
        samples = self._counts['samples']
        rate, worked = self._rate.of(samples), self._work_rate.of(self._busy)
        faults = self._faults.text
        refused = ('malformed', 'repeat', 'late', 'second')
        values: dict[str, object] = {
            'rate': f'{rate:.1f}',
            'samples': samples,
            'blocks': self._counts['blocks'],
            'lost': self._counts['lost'],
            'gaps': self._counts['gap'],
            'streams': self._counts['streams'],
            'silences': self._counts['silence'],
            **{f'refused_{why}': self._counts[why] for why in refused},
            **{f'altered_{why}': self._counts[why] for why in _WHY},
            'clipped': self._run.clipped_input + self._run.clipped_output,
            'publishers': self._input.get_publisher_count(),
            **{
                f'applied{tail}': f'{guard.applied:.6f}'
                for tail, guard in zip(self._tails, self._axis_guards, strict=True)
            },
        }
        if self._further:
            values['missing'] = self._counts['missing']
        if rate:
            values['head_room'] = f'{max(0.0, 1.0 - worked * self.sample_rate / rate):.3f}'
        return (WARN if faults else OK), faults or self._state, values

    def close(self) -> None:
        """Ramp to rest within a second."""
        size = max(1, round(RAMP_PERIOD * self.sample_rate))
        # replaces a slow ramp by a ramp that ends in time
        guards = [Guard(guard.settings, guard.applied) for guard in self._axis_guards]
        begin, sent = time.monotonic(), 0
        while not all(guard.is_at_rest for guard in guards):
            self._move([guard.idle(size, LAST_RAMP) for guard in guards], 'ramp:stop')
            sent += size
            time.sleep(max(0.0, begin + sent / self.sample_rate - time.monotonic()))
        for publisher in self._applied:
            await_readers(publisher)

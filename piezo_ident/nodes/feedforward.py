# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The feedforward node: the voltage under which the stage goes where `reference` tells it.

``~/start`` takes the right to drive; from then on each block of `reference` is answered by one of
`voltage`, with its own clock from zero, for the reference `preview` seconds before.  The reference
is joined from rest along a raised cosine.  When it is silent for `silence`, what is still ahead is
played, and the node ramps to rest; ``~/stop``, SIGINT and SIGTERM ramp at once, as the excitation
does.  Nothing leaves the limits, nor is faster than `slew`.

A model that is refined takes over while the stage moves: without a step in the voltage, and with
the memory that it would have if it had run from the start.

| in the reference | what happens | status |
|---|---|---|
| layout of no block, stamps off the clock, a block that came before, a second publisher | the \
block is refused | WARN |
| a sample that is no number | the last one stays in force | |
| a gap up to `silence` | a straight line | WARN |
| another stream | is joined from where the first one ended | |
| out of reach | the voltage stays at its limit | WARN |
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
import math
from pathlib import Path
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import ConfigError, DataError, PiezoIdentError
from piezo_ident.live.guard import GuardSettings
from piezo_ident.live.monitor import LiveError, Matched, Matcher
from piezo_ident.live.pacing import Rate
from piezo_ident.live.sample_clock import Kind, SampleClock
from piezo_ident.live.tracker import Drive, Successor, Tracker
from piezo_ident.model.files import load
from piezo_ident.model.metrics import percent
from piezo_ident.model.stage_model import StageModel
from piezo_ident.nodes.lab_node import guard_settings, LabNode, OK, run, WARN
from piezo_ident.nodes.model_loader import ModelLoader
from piezo_ident.nodes.voltage_output import VoltageOutput
from piezo_ident.nodes.wire import from_message, LATCHED, publisher_ids, STREAM, to_message
from piezo_ident.record.blocks import BLOCK_SIZE, Samples
from std_msgs.msg import Float64MultiArray, String

__all__ = ['FeedforwardNode', 'main']

#: how long the ramp of a node that is ending may take [s]
LAST_RAMP = 0.7
#: how long a fault stays in the status [s]
FAULT_SHOWN = 3.0
#: period of the timer that waits, ramps and watches [s]
PERIOD = 0.01
#: states in which the node holds the right to drive
DRIVING = ('waiting', 'ready', 'tracking', 'stopping')
#: parameters that are taken over between two references
LIMITS = ('voltage_low', 'voltage_high', 'rest', 'slew', 'ramp_slew')

_NOW = {
    'idle': 'for ~/start',
    'waiting': 'waiting for subscribers',
    'ready': 'waiting for a reference',
    'tracking': 'following the reference',
    'stopping': 'ramping to rest',
}


class FeedforwardNode(LabNode):
    """Follows a reference with the inverse of a model."""

    executable = 'feedforward'

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._rate_of_clock = self.values['sample_rate']
        self._tracker: Tracker | None = None
        self._model: StageModel | None = None
        self._source, self._refusal, self._models = '', '', 0
        self._state, self._end = 'idle', ('', '')
        self._counts: Counter[str] = Counter()
        self._faults: dict[str, tuple[str, float]] = {}
        self._segment, self._last_value = '', 0.0
        self._last = self._ramp_begin = time.monotonic()
        self._ramped = 0
        self._sample_clock = SampleClock(self._rate_of_clock, self.values['silence'])
        self._clear()
        self._rate, self._work_rate, self._busy = Rate(), Rate(), 0.0
        self._output = VoltageOutput(self)
        self._tracking_error = self.create_publisher(Float64MultiArray, 'tracking_error', STREAM)
        self._loader = ModelLoader(self, self._prepared, self._take_model, self._report_state)
        if path := self.values['model']:
            try:
                self._take_model(self._prepared(load(path)), path)
            except PiezoIdentError as error:
                raise PiezoIdentError(f'model: {error}') from None
        self.create_subscription(String, 'model', self._on_model, LATCHED)
        self._reference = self.create_subscription(
            Float64MultiArray, 'reference', self._on_reference, STREAM
        )
        self.create_subscription(Float64MultiArray, 'displacement', self._on_displacement, STREAM)
        self._timer = self.create_timer(PERIOD, self._on_timer, autostart=False)
        self.offer('start', self._start)
        self.offer('stop', self._stop)
        self._report_state()

    # parameters and models

    def _settings(self, values: Mapping[str, Any] | None = None) -> GuardSettings:
        return guard_settings(values or self.values, self._rate_of_clock)

    def refuse(self, name: str, value: Any) -> str | None:
        """Refuse limits that are crossed or in use, and a model file that is not there."""
        if name == 'model' and value and not Path(value).is_file():
            return f'model: {value}: no such file'
        if name not in LIMITS or 'silence' not in self.values:
            return None
        if self._state in DRIVING:
            return f'{name} cannot be changed while the node drives; call ~/stop first'
        try:
            self._settings(self.wanted)
        except PiezoIdentError as error:
            return str(error)
        return None

    def apply(self, changed: Mapping[str, Any]) -> None:
        """Take a model file, another window, or other limits."""
        if path := changed.get('model'):
            self._loader.load_file(path)
        if 'window' in changed:
            self._error.window = changed['window']
        model = self._model
        if model is not None and set(changed) & set(LIMITS):
            self._tracker = None
            self._loader.load(self._source, lambda: model)

    def _on_model(self, message: String) -> None:
        self._loader.load_text(message.data, 'topic model')

    def _prepared(self, model: StageModel) -> tuple[StageModel, Tracker | Successor]:
        # by the thread of the loader
        tracker, settings = self._tracker, self._settings()
        if tracker is None or tracker.settings != settings:
            preview = max(1, round(self.values['preview'] * self._rate_of_clock))
            return model, Tracker(model, settings, preview)
        return model, tracker.successor(model, tracker.past())

    def _take_model(
        self, loaded: tuple[StageModel, Tracker | Successor] | None, source: str
    ) -> None:
        if loaded is None:
            kept = 'the old model is kept' if self._tracker else 'there is no model'
            self._refusal = f'model refused, {kept}: {source}'
            return
        self._model, new = loaded
        if isinstance(new, Tracker):
            self._tracker = new
        elif self._tracker is not None:
            self._tracker.take_over(new)
        self._source, self._refusal = source, ''
        self._models += 1
        if self._models > 1:
            self.journal.tell(f'{self._state}: model {self._models} is taken over, {source}')
        self._error.clear()

    # services

    def _start(self) -> str:
        if self._state in DRIVING:
            raise ConfigError(f'the node drives already: {_NOW[self._state]}; call ~/stop first')
        if self._tracker is None:
            reason = self._refusal or 'publish one on the topic model, or set the parameter model'
            raise ConfigError(f'there is no model: {reason}')
        self._tracker.reset()
        self._clear()
        self._counts.clear()
        self._faults.clear()
        self._sample_clock = SampleClock(self._rate_of_clock, self.values['silence'])
        self._output.open()
        self._timer.reset()
        self._go('waiting')
        delay = self._tracker.preview / self._rate_of_clock
        return f'the stage follows the reference {delay:.4g} s later'

    def _stop(self) -> str:
        if self._state not in DRIVING:
            raise ConfigError('the node does not drive')
        self._halt('stopped', 'stopped')
        return f'ramping to {self.values["rest"]:g} V'

    def _clear(self) -> None:
        self._told: float | None = None
        self._matcher, self._error = Matcher(), LiveError(self.values['window'])
        self._range = (math.inf, -math.inf)

    def _go(self, state: str) -> None:
        self._state = state
        self._report_state()

    # the reference

    def _on_reference(self, message: Float64MultiArray, info: Mapping[str, Any]) -> None:
        if self._state not in ('ready', 'tracking'):
            return
        begin = time.perf_counter()
        sequence = info.get('publication_sequence_number')
        try:
            samples = from_message(message)
            if samples.quantity != 'reference':
                raise DataError(f'a block of {samples.quantity!r}, expected is reference')
        except DataError as error:
            self._sample_clock.skip(sequence)
            self._note_fault('refused', f'a block is refused: {error}')
        else:
            self._take(samples, sequence)
            self._busy += time.perf_counter() - begin
        self._report_state()

    def _take(self, samples: Samples, sequence: int | None) -> None:
        verdict = self._sample_clock.judge(
            samples, sequence, lambda: publisher_ids(self, self._reference)
        )
        if not verdict.is_taken:
            self._note_fault('refused', f'a block is refused: {verdict.reason}')
            return
        x = samples.values
        if verdict.kind is Kind.GAP:
            self._note_fault('lost', verdict.reason, verdict.missing)
            share = np.arange(1, verdict.missing + 1) / (verdict.missing + 1)
            x = np.append(self._last_value + (x[0] - self._last_value) * share, x)
        self._last, self._last_value = time.monotonic(), float(x[-1])
        self._segment = samples.segment
        tracker = self._tracker
        if tracker is not None:
            is_new = verdict.kind is Kind.START
            self._counts['streams'] += is_new
            self._play(tracker.process(x, is_new and self._state == 'tracking'))
            self._state = 'tracking'

    def _play(self, drive: Drive) -> None:
        self._send(drive.t, drive.v, self._segment)
        if drive.clipped:
            self._note_fault('clipped', 'the reference is out of reach', drive.clipped)
        low, high = self._range
        self._range = min(low, float(drive.wanted.min())), max(high, float(drive.wanted.max()))
        wanted = Samples(drive.t, drive.wanted, self._segment, 'reference')
        self._compare(self._matcher.predicted(wanted))

    def _send(self, t: NDArray[np.float64], v: NDArray[np.float64], segment: str) -> None:
        for k in range(0, t.size, BLOCK_SIZE * 10):
            cut = slice(k, k + BLOCK_SIZE * 10)
            self._output.send(Samples(t[cut], v[cut], segment))
        self._counts['samples'] += t.size

    def _on_displacement(self, message: Float64MultiArray) -> None:
        if self._state not in ('tracking', 'stopping'):
            return
        try:
            samples = from_message(message)
        except DataError as error:
            self._note_fault('refused', f'a block of displacement is refused: {error}')
            return
        if samples.t.size and np.isfinite(samples.t).all():
            self._compare(self._matcher.measured(samples))

    def _compare(self, pairs: list[Matched]) -> None:
        for pair in pairs:
            e = pair.y_hat - pair.y
            block = Samples(pair.t, e, pair.segment, 'tracking_error')
            self._tracking_error.publish(to_message(block))
            self._error.add(pair.t, e)

    # waiting, silence and ramps

    def _on_timer(self) -> None:
        if self._state == 'waiting':
            try:
                if self._output.poll(self.values['subscribers'], self.values['wait_limit']):
                    self._go('ready')
            except PiezoIdentError as error:
                self._halt('failed', str(error))
        elif self._state == 'tracking':
            if time.monotonic() - self._last > self.values['silence'] and self._tracker:
                self._play(self._tracker.finish())
                self._halt('done', 'the reference has ended')
        elif self._state == 'stopping':
            self._ramp()

    def _halt(self, state: str, text: str) -> None:
        """Ramp to rest, and end in a state."""
        self._end = state, text
        self._ramped, self._ramp_begin = 0, time.monotonic()
        self._state = 'stopping'
        self._ramp()

    def _ramp(self) -> None:
        tracker = self._tracker
        if tracker is not None and not tracker.is_at_rest:
            now = round((time.monotonic() - self._ramp_begin) * self._rate_of_clock)
            # after a pause of this process the ramp goes on where it was, it does not catch up
            due = min(now - self._ramped, max(1, round(5 * PERIOD * self._rate_of_clock)))
            self._ramped = now
            if due > 0:
                self._send(*tracker.idle(due), 'ramp:stop')
        if tracker is None or tracker.is_at_rest:
            self._finish()
        else:
            self._report_state()

    def _finish(self) -> None:
        self._output.close()
        self._timer.cancel()
        if self._tracker is not None:
            self._tracker.reset()
        self._go(self._end[0])

    # reports

    def _note_fault(self, fault: str, message: str, count: int = 1) -> None:
        self._counts[fault] += count
        self._faults[fault] = (message, time.monotonic() + FAULT_SHOWN)

    def _problems(self) -> str:
        now = time.monotonic()
        self._faults = {k: fault for k, fault in self._faults.items() if fault[1] > now}
        return '; '.join(filter(None, [self._refusal, *(m for m, _ in self._faults.values())]))

    def _percent(self) -> float | None:
        """Return the tracking error over the last seconds [% of the span that was wanted]."""
        low, high = self._range
        return percent(self._error.rms, high - low) if self._error.seconds else None

    def _report_state(self) -> None:
        problems = self._problems()
        text = _NOW.get(self._state, self._end[1])
        if self._state == 'idle' and self._tracker is None:
            text = 'for a model'
        elif self._state in DRIVING:
            text += f', with {self._source}'
        level = WARN if problems or self._state == 'failed' else OK
        text = '; '.join(filter(None, [text, problems]))
        values: dict[str, object] = {'models': self._models, 'segment': self._segment}
        error, brief = self._told, ''
        if error is not None:
            values['tracking_percent'] = f'{error:.3g}'
            brief = f'{error:.3g} % of stroke, tracking error; {text}'
        self.report_status(self._state, 0.0, text, level, brief=brief, **values)

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return rate, what was lost and refused, head-room, and the tracking error."""
        # a figure that changed with each block would flood the status
        self._told = self._percent()
        self._report_state()
        rate, worked = self._rate.of(self._counts['samples']), self._work_rate.of(self._busy)
        values: dict[str, object] = {
            'rate': f'{rate:.1f}',
            **{name: self._counts[name] for name in ('samples', 'streams', 'lost', 'refused')},
            'clipped': self._counts['clipped'],
            'models': self._models,
            'publishers': self.count_publishers('voltage'),
        }
        if self._tracker is not None:
            inverse = self._tracker.inverse
            values['delay'] = f'{self._tracker.preview / self._rate_of_clock:.6g}'
            values['passes'], values['expected'] = inverse.passes, f'{inverse.error:.3g}'
        if rate:
            values['head_room'] = f'{max(0.0, 1.0 - worked * self._rate_of_clock / rate):.3f}'
        if self._told is not None:
            values['tracking_rms'] = f'{self._error.rms:.6g}'
            values['tracking_percent'] = f'{self._told:.4g}'
        second = self._output.second() if self._output.is_open else ''
        if second:
            self._note_fault('second', f'second publisher {second} on voltage', 0)
        problems = self._problems()
        return (WARN if problems else OK), problems or self._state, values

    def close(self) -> None:
        """Ramp to rest within a second."""
        self._loader.close()
        tracker, begin, sent = self._tracker, time.monotonic(), 0
        size = max(1, round(PERIOD * self._rate_of_clock))
        if tracker is not None:
            # a ramp that is under way at its own pace gives way to one that ends in time
            tracker.hurry()
        while tracker is not None and self._output.is_open and not tracker.is_at_rest:
            self._send(*tracker.idle(size, LAST_RAMP), 'ramp:stop')
            sent += size
            time.sleep(max(0.0, begin + sent / self._rate_of_clock - time.monotonic()))
        self._output.close()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node; see `piezo_ident.nodes.lab_node.run`."""
    return run(FeedforwardNode, argv)

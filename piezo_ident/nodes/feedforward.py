# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Feedforward node: makes the voltage that moves the stage along `reference`.

``~/start`` takes the right to drive.  The node then answers each block of `reference` by a block
of `voltage`.  The voltage has its own clock from zero, and belongs to the reference `preview`
seconds before.  The node joins the reference from rest along a raised cosine.  When the reference
is silent for `silence`, the node plays its remaining part and ramps to rest.  ``~/stop``, SIGINT
and SIGTERM ramp at once, as in the excitation.  The voltage always keeps its limits and `slew`.

``~/learn`` repeats the last reference, corrects the voltage by the measured error, and ends when
the error stops falling.  A further call goes on from the best repetition.

With `follow` an observer finds offset, creep of earlier motion, and gain in the displacement, and
the node corrects the voltage by them.

A refined model takes over while the stage moves.  The voltage does not step, and the model has the
memory that it would have if it had run from the start.

| in the reference | what happens | status |
|---|---|---|
| layout of no block, stamps off the clock, a block that came before, a second publisher, far \
from the stage, as in micrometres | the block is refused | WARN |
| a sample that is NaN or infinite | the last sample is repeated | WARN |
| a gap up to `silence` | a straight line | WARN |
| another stream | is joined from where the first one ended | |
| out of reach | the voltage stays at its limit | WARN |

Without displacement the node drives on, warns, and has no tracking error.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import line_between
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.live.follower import MOST
from piezo_ident.live.guard import GuardSettings
from piezo_ident.live.live_learning import LiveLearning
from piezo_ident.live.monitor import TrackingError
from piezo_ident.live.pacing import Looks, Rate
from piezo_ident.live.sample_clock import Kind, SampleClock
from piezo_ident.live.tracker import check_unit, Drive, held, Successor, Tracker
from piezo_ident.model.stage_model import StageModel
from piezo_ident.nodes.driving import DRIVING, DrivingNode, NOW
from piezo_ident.nodes.lab_node import guard_settings, OK, WARN
from piezo_ident.nodes.learner import Learner
from piezo_ident.nodes.model_loader import ModelLoader, no_file
from piezo_ident.nodes.wire import from_message, publisher_ids, STREAM, to_message
from piezo_ident.record.blocks import Samples
from std_msgs.msg import Float64MultiArray

#: parameters that cannot be changed while the node drives
LIMITS = ('voltage_low', 'voltage_high', 'rest', 'slew', 'ramp_slew', 'follow')
#: faults whose samples or blocks are counted
FAULTS = ('lost', 'refused', 'not_finite', 'clipped')
#: longest silence of the stage during a reference, before a warning [s]
SILENT = 1.0
#: warning when a correction reaches its limit
LIMITED = f'the stage is off by {MOST:.0%} of its stroke or more: is the sensor right?'


class FeedforwardNode(DrivingNode):
    """Follows a reference with the inverse of a model."""

    executable = 'feedforward'

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._model: StageModel | None = None
        self._source, self._models = '', 0
        self._segment = ''
        # labels of the reference, each with its first sample
        self._labels: deque[tuple[int, str]] = deque()
        self._heard = 0
        # the last reference, its length, and the learning of it
        self._kept: list[NDArray[np.float64]] = []
        self._length, self._last_value = 0, 0.0
        self._learner: Learner | None = None
        self._learned: LiveLearning | None = None
        self._looks = Looks()
        self._last = self._answered = time.monotonic()
        self._sample_clock = SampleClock(self._rate_of_clock, self.values['silence'])
        self._clear()
        self._rate, self._work_rate, self._busy = Rate(), Rate(), 0.0
        self._tracking_error = self.create_publisher(Float64MultiArray, 'tracking_error', STREAM)
        self._loader = ModelLoader(self, self._prepared, self._take_model, self.report_state)
        if path := self.values['model']:
            self._loader.begin_with(path)
        self._reference = self.create_subscription(
            Float64MultiArray, 'reference', self._on_reference, STREAM
        )
        self.create_subscription(Float64MultiArray, 'displacement', self._on_displacement, STREAM)
        self.offer('start', self._start)
        self.offer('learn', self._learn)
        self.report_state()

    # parameters and models

    def _settings(self, values: Mapping[str, Any] | None = None) -> GuardSettings:
        return guard_settings(values or self.values, self._rate_of_clock)

    def refuse(self, name: str, value: Any) -> str | None:
        """Refuse limits that are crossed or in use, and a model file that is not there."""
        if name == 'model':
            return no_file(value)
        if name not in LIMITS or 'silence' not in self.values:
            return None
        if self._state in DRIVING:
            return f'{name} cannot be changed while the node drives; call ~/stop first'
        self._settings(self.wanted)
        return None

    def apply(self, changed: Mapping[str, Any]) -> None:
        """Take a model file, another window, or other limits."""
        if path := changed.get('model'):
            self._loader.load_file(path)
        if 'window' in changed:
            self._error.live.window = changed['window']
        model = self._model
        if model is not None and set(changed) & set(LIMITS):
            self._tracker = None
            self._loader.load(self._source, lambda: model)

    def _prepared(self, model: StageModel) -> tuple[StageModel, Tracker | Successor]:
        # runs in the thread of the loader
        tracker, settings, follow = self._tracker, self._settings(), self.values['follow']
        if tracker is None or (tracker.settings, tracker.follow) != (settings, follow):
            preview = max(1, round(self.values['preview'] * self._rate_of_clock))
            return model, Tracker(model, settings, preview, follow)
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
        self._error.live.clear()

    # services

    def _start(self) -> str:
        tracker = self._begin()
        self._learner = None
        delay = tracker.preview / self._rate_of_clock
        return f'the stage follows the reference {delay:.4g} s later'

    def _learn(self) -> str:
        model, settings = self._model, self._settings()
        if not self._kept or model is None:
            raise ConfigError('there is no reference to repeat: call ~/start, and send one')
        if self._length > self.values['longest'] * self._rate_of_clock:
            raise ConfigError(
                'the last reference is longer than what is kept of it; raise the parameter longest'
            )
        self._begin()
        x, before = np.concatenate(self._kept), self._learned

        def make() -> LiveLearning:
            if before and before.model is model and np.array_equal(before.reference, x):
                return before
            return LiveLearning(model, x, settings)

        self._learner = Learner(make, self.values['repetitions'], self._played)
        return f'the last reference, {x.size / self._rate_of_clock:.3g} s, is repeated'

    def _begin(self) -> Tracker:
        """Take the right to drive."""
        if self._state in DRIVING:
            raise ConfigError(f'the node drives already: {NOW[self._state]}; call ~/stop first')
        if self._tracker is None:
            reason = self._refusal or 'publish one on the topic model, or set the parameter model'
            raise ConfigError(f'there is no model: {reason}')
        self._clear()
        self._labels.clear()
        self._heard = 0
        self._sample_clock = SampleClock(self._rate_of_clock, self.values['silence'])
        self._take_right(self._tracker)
        self._last_value = math.nan
        return self._tracker

    def _clear(self) -> None:
        self._told: float | None = None
        self._error = TrackingError(self.values['window'])

    # the reference

    def _on_reference(self, message: Float64MultiArray, info: Mapping[str, Any]) -> None:
        if self._state not in ('ready', 'tracking'):
            if self._state != 'stopping':
                now = NOW.get(self._state, 'it does not drive; call ~/start')
                self._faults.note('ignored', f'a reference is not followed: {now}')
                self.report_state()
            return
        begin = time.perf_counter()
        sequence = info.get('publication_sequence_number')
        try:
            samples = from_message(message, 'reference')
            if self._model is not None:
                check_unit(self._model, samples.values)
        except DataError as error:
            self._sample_clock.skip(sequence)
            self._faults.note('refused', f'a block is refused: {error}')
        else:
            self._take(samples, sequence)
            self._busy += time.perf_counter() - begin
        self.report_state()

    def _take(self, samples: Samples, sequence: int | None) -> None:
        verdict = self._sample_clock.judge(
            samples, sequence, lambda: publisher_ids(self, self._reference)
        )
        if not verdict.is_taken:
            self._faults.note('refused', f'a block is refused: {verdict.reason}')
            return
        is_new = verdict.kind is Kind.START
        # nothing comes before the first sample of a stream
        x = held(samples.values, math.nan if is_new else self._last_value)
        if bad := samples.not_finite:
            about = 'samples of the reference are no numbers: the last one stays in force'
            self._faults.note('not_finite', f'{bad} {about}', bad)
        if verdict.kind is Kind.GAP:
            self._faults.note('lost', verdict.reason, verdict.missing)
            x = np.append(line_between(self._last_value, float(x[0]), verdict.missing), x)
        self._last = time.monotonic()
        if not self._labels or self._labels[-1][1] != samples.segment:
            self._labels.append((self._heard, samples.segment))
        self._heard += x.size
        if is_new:
            self._kept, self._length = [], 0
            self._answered = self._last
        self._last_value, self._length = float(x[-1]), self._length + x.size
        is_short = self._length <= self.values['longest'] * self._rate_of_clock
        if is_short and math.isfinite(self._last_value):
            self._kept.append(x.copy())
        if (tracker := self._tracker) is not None:
            self._counts['streams'] += is_new
            self._play(tracker.process(x, is_new and self._state == 'tracking'))
            self._state = 'tracking'

    def _play(self, drive: Drive) -> None:
        self._segment = self._label(drive.t)
        self._send(drive.t, drive.v, self._segment)
        if drive.clipped:
            count = self._counts['clipped'] + drive.clipped
            about = f'the reference is out of reach for {count} samples'
            self._faults.note('clipped', about, drive.clipped)
        wanted = Samples(drive.t, drive.wanted, self._segment, 'reference')
        self._tell(self._error.wanted(wanted))

    def _label(self, t: NDArray[np.float64]) -> str:
        """Return the label of the reference that belongs to the first of these times."""
        labels, preview = self._labels, self.values['preview']
        at = round((float(t[0]) - preview) * self._rate_of_clock)
        while len(labels) > 1 and labels[1][0] <= at:
            labels.popleft()
        return labels[0][1]

    def _played(self, voltage: Samples, wanted: Samples) -> None:
        self._send(voltage.t, voltage.values, voltage.segment)
        self._segment = voltage.segment
        self._tell(self._error.wanted(wanted))

    def _on_displacement(self, message: Float64MultiArray) -> None:
        # a slow stage may answer the last blocks when the node is at rest already
        if self._state not in ('tracking', 'learning', 'stopping') and not self._error.is_waiting:
            return
        try:
            samples = from_message(message, 'displacement')
        except DataError as error:
            self._faults.note('refused', f'a block of displacement is refused: {error}')
            return
        if bad := samples.not_finite:
            about = 'samples of displacement are no numbers: left out of the tracking error'
            self._faults.note('not_finite', f'{bad} {about}', bad)
        self._answered = time.monotonic()
        self._tell(self._error.measured(samples))
        if self._learner is not None:
            self._learner.measured(samples)
        if self._tracker is not None:
            self._tracker.measured(samples)

    def _tell(self, errors: list[Samples]) -> None:
        for block in errors:
            self._tracking_error.publish(to_message(block))

    # work

    def work(self) -> str:
        """Watch for the end of a reference, or repeat it."""
        self._looks.look()
        tracker, learner = self._tracker, self._learner
        if self._state == 'waiting' or tracker is None:
            return 'learning' if learner else 'ready'
        if self._state == 'learning' and learner is not None:
            self._repeat(tracker, learner)
        elif self._state == 'tracking':
            if self._looks.is_over(self._last, self.values['silence']):
                self._play(tracker.finish())
                self._halt('done', 'the reference has ended')
        return ''

    def _repeat(self, tracker: Tracker, learner: Learner) -> None:
        learner.step(tracker)
        if learner.is_over:
            self._learned = learner.learning
            self._halt('done', learner.text)
        elif learner.is_played and not tracker.is_at_rest:
            self._send_ramp(tracker)
        else:
            self._begin_ramp()
        self.report_state()

    # reports

    def report_state(self) -> None:
        """Publish state, tracking error and problems."""
        problems = self._problems()
        text = NOW.get(self._state, self._end[1])
        if self._state == 'idle' and self._tracker is None:
            text = 'for a model'
        elif self._state == 'learning' and self._learner:
            text = self._learner.text
        elif self._state in DRIVING:
            text += f', with {self._source}'
        level = WARN if problems or self._state == 'failed' else OK
        text = '; '.join(filter(None, [text, problems]))
        values: dict[str, object] = {'models': self._models, 'segment': self._segment}
        error, brief = self._told, ''
        if error is not None:
            values['tracking_percent'] = f'{error:.3g}'
            brief = f'{error:.3g} % of stroke, tracking error; {text}'
        learns = self._state == 'learning' and self._learner
        progress = self._learner.progress if learns and self._learner else 0.0
        self.report_status(
            self._state, progress, text, level, brief=brief, problems=problems, **values
        )

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return rate, counts of lost and refused samples, head-room, and tracking error."""
        # while the reference pauses, the stage has no block to answer
        if self._state == 'tracking' and self._last - self._answered > SILENT:
            # the earlier error says nothing about the present
            self._error.live.clear()
            self._faults.note('silent', 'no displacement comes from the stage', 0)
        if outliers := self._error.live.outliers:
            about = 'wild readings of displacement are left out of the tracking error'
            self._faults.note('outliers', f'{outliers} {about}', 0)
        # updated once a second: a new figure with each block would flood the status
        self._told = self._error.percent
        self.report_state()
        rate, worked = self._rate.of(self._counts['samples']), self._work_rate.of(self._busy)
        values: dict[str, object] = {
            'rate': f'{rate:.1f}',
            **{name: self._counts[name] for name in ('samples', 'streams', *FAULTS)},
            'models': self._models,
            'publishers': self.count_publishers('voltage'),
        }
        if self._tracker is not None:
            inverse = self._tracker.inverse
            values['delay'] = f'{self._tracker.preview / self._rate_of_clock:.6g}'
            values['passes'], values['expected'] = inverse.passes, f'{inverse.error:.3g}'
            if follower := self._tracker.follower:
                values |= {name: f'{x:.6g}' for name, x in follower.corrector.told.items()}
                if follower.is_limited:
                    self._faults.note('limited', LIMITED, 0)
        if rate:
            values['head_room'] = f'{max(0.0, 1.0 - worked * self._rate_of_clock / rate):.3f}'
        if self._told is not None:
            values['tracking_rms'] = f'{self._error.live.rms:.6g}'
            values['tracking_percent'] = f'{self._told:.4g}'
        second = self._output.second() if self._output.is_open else ''
        if second:
            self._faults.note('second', f'second publisher {second} on voltage', 0)
        problems = self._problems()
        return (WARN if problems else OK), problems or self._state, values

    def close(self) -> None:
        """Ramp to rest within a second."""
        self._loader.close()
        super().close()

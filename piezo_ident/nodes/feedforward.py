# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Feedforward node: makes the voltage that moves the stage along `reference`.

``~/start`` takes the right to drive.  The node then answers each block of `reference` by a block
of `voltage`.  The voltage has its own clock from zero, and belongs to the reference `preview`
seconds before.  The node joins the reference from rest along a raised cosine.  When no block comes
for `silence`, the node plays the rest of the reference and ramps to rest.  ``~/stop``, SIGINT
and SIGTERM ramp at once, as in the excitation.  The voltage always keeps its limits and `slew`.

``~/learn`` repeats the last reference, and corrects the voltage by the measured error, until the
error stops falling or for `repetitions`.  A further call goes on from the best repetition.

With `axes` the node follows `reference_<name>` on `voltage_<name>`, too.  The inverse cancels the
coupling of the axes.  A block of `reference` waits up to `PATIENCE` for the blocks of the other
axes at the same t; an axis without a reference rests.

With `follow` an observer finds offset, creep of earlier motion, and gain from the displacement of
each axis.  The node corrects the reference by them before the inverse.  A new model of one axis
takes over while the stage moves, in the state of a run from the start; the voltage does not step.
A new model of several axes waits until the next ``~/start`` or ``~/learn``.

| in the streams | what happens | status |
|---|---|---|
| layout of no block, stamps off the clock, a block that came before, a second publisher, far \
from the stage, as in micrometres | the block is refused | WARN |
| a sample that is NaN or infinite | the last sample is repeated | WARN |
| a gap up to `silence` | a straight line | WARN |
| another stream | the node joins it from where the first one ended | |
| a reference out of reach | the voltage stays at its limit | WARN |
| modes that run away | the node ramps to rest and fails | WARN |
| no displacement | the node drives on, without a tracking error | WARN |
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import partial
import time
from typing import Any

import numpy as np
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.live.axis_drive import Drive, Successor
from piezo_ident.live.follower import MOST
from piezo_ident.live.guard import GuardSettings
from piezo_ident.live.join import Reference
from piezo_ident.live.live_learning import Learner, LiveLearning
from piezo_ident.live.monitor import TrackingErrors
from piezo_ident.live.pacing import Looks, Rate
from piezo_ident.live.sample_clock import Kind, SampleClock
from piezo_ident.live.tracker import check_unit, Prepared, prepared, Tracker
from piezo_ident.model.multi_axis import models_of
from piezo_ident.nodes.driving import DRIVING, DrivingNode, NOW
from piezo_ident.nodes.lab_node import guard_settings, OK, WARN
from piezo_ident.nodes.model_loader import Model, ModelLoader, no_file
from piezo_ident.nodes.wire import from_message, publisher_ids, STREAM, to_message
from piezo_ident.record.blocks import Samples
from std_msgs.msg import Float64MultiArray

#: longest wait of a block of the reference for a further axis [s]
PATIENCE = 0.2
#: parameters that cannot be changed while the node drives
LIMITS = ('voltage_low', 'voltage_high', 'rest', 'slew', 'ramp_slew', 'follow')
#: faults whose samples or blocks are counted
FAULTS = ('lost', 'refused', 'not_finite', 'clipped')
#: longest silence of the stage during a reference, before a warning [s]
SILENT = 1.0
#: warning when a correction reaches its limit
LIMITED = f'the stage is off by {MOST:.0%} of its stroke or more: is the sensor right?'


class FeedforwardNode(DrivingNode):
    """Drives the stage along a reference by the inverse of a model."""

    executable = 'feedforward'

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._model: Model | None = None
        self._later: tuple[Prepared, str] | None = None
        self._source, self._models, self._segment = '', 0, ''
        self._wanted = Reference(self._tails, self._rate_of_clock)
        self._learner: Learner | None = None
        self._learned: LiveLearning | None = None
        self._looks = Looks()
        self._last = self._answered = time.monotonic()
        self._sample_clock = SampleClock(self._rate_of_clock, self.values['silence'])
        self._errors = TrackingErrors(self._tails, self.values['window'])
        self._rate, self._work_rate, self._busy = Rate(), Rate(), 0.0
        self._tracking_errors = {
            topic: self.create_publisher(Float64MultiArray, topic, STREAM)
            for topic in (f'tracking_error{tail}' for tail in self._tails)
        }
        self._loader = ModelLoader(self, self._prepared, self._take_model, self.report_state)
        if path := self.values['model']:
            self._loader.begin_with(path)
        listen = partial(self.create_subscription, Float64MultiArray)
        self._references = {}
        for tail in self._tails:
            take = partial(self._on_reference, tail)
            self._references[tail] = listen(f'reference{tail}', take, STREAM)
            listen(f'displacement{tail}', partial(self._on_displacement, tail), STREAM)
        self.offer('start', self._start)
        self.offer('learn', self._learn)
        self.report_state()

    # parameters and models

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
        """Take another window or silence, other limits, and last a model file, which counts."""
        if 'silence' in changed:
            self._sample_clock.longest_gap = changed['silence']
        if 'window' in changed:
            for one in self._errors.each.values():
                one.live.window = changed['window']
        (model, _), source = self._later or ((self._model, None), self._source)
        if model is not None and set(changed) & set(LIMITS):
            self._tracker = None
            self._loader.load(source, lambda: model)
        if path := changed.get('model'):
            self._loader.load_file(path)

    def _settings(self, values: Mapping[str, Any] | None = None) -> GuardSettings:
        return guard_settings(values or self.values, self._rate_of_clock)

    def _prepared(self, model: Model) -> Prepared:
        # runs in the thread of the loader
        preview = max(1, round(self.values['preview'] * self._rate_of_clock))
        axes, follow = [f'y{tail}' for tail in self._tails], self.values['follow']
        return prepared(model, axes, self._settings(), preview, follow, self._tracker)

    def _take_model(self, loaded: Prepared | None, source: str) -> None:
        if loaded is not None and self._tails[1:] and self._state in DRIVING:
            self._later = loaded, source
            return
        if loaded is None:
            kept = 'the old model is kept' if self._tracker else 'there is no model'
            self._refusal = f'model refused, {kept}: {source}'
            return
        model, new = loaded
        if self._is_outdated(new):
            self._loader.load(source, lambda: model)
            return
        self._model = model
        if not isinstance(new, Successor):
            self._tracker = new
        elif self._tracker is not None:
            self._tracker.take_over(new)
        self._source, self._refusal, self._later = source, '', None
        self._models += 1
        if self._models > 1:
            self.journal.tell(f'{self._state}: model {self._models} is taken over, {source}')
        self._errors.clear()

    def _is_outdated(self, new: Tracker | Successor) -> bool:
        """Return whether a model was prepared for other limits, or for a voltage long ago."""
        if isinstance(new, Successor):
            return self._tracker is None or not self._tracker.remembers(new)
        return (new.settings, new.follow) != (self._settings(), self.values['follow'])

    # services

    def _start(self) -> str:
        delay = self._begin().preview / self._rate_of_clock
        self._learner = None
        return f'the stage follows the reference {delay:.4g} s later'

    def _learn(self) -> str:
        kept, axes = self._wanted.kept, [f'y{tail}' for tail in self._tails]
        if kept is None or self._model is None:
            raise ConfigError('there is no reference to repeat: call ~/start, and send one')
        if kept.shape[1] < self._wanted.length:
            raise ConfigError('the last reference was not kept: raise longest, and send it again')
        self._begin()
        model, settings, before = self._model, self._settings(), self._learned

        def make() -> LiveLearning:
            if before and before.model is model and before.settings == settings:
                if np.array_equal(before.reference, kept):
                    return before.again()
            return LiveLearning(model, kept, settings, axes)

        self._learner = Learner(make, self.values['repetitions'], self._played)
        return f'the last reference, {kept.shape[1] / self._rate_of_clock:.3g} s, is repeated'

    def _begin(self) -> Tracker:
        """Take the right to drive."""
        if self._state in DRIVING:
            raise ConfigError(f'the node drives already: {NOW[self._state]}; call ~/stop first')
        if self._later is not None:
            later, self._later = self._later, None
            self._take_model(*later)
        if self._tracker is None:
            how = 'call again soon' if self._model else 'publish one, or set the parameter model'
            raise ConfigError(f'there is no model: {self._refusal or how}')
        self._errors = TrackingErrors(self._tails, self.values['window'])
        self._sample_clock = SampleClock(self._rate_of_clock, self.values['silence'])
        self._take_right(self._tracker)
        self._wanted.reset(self._tracker.rest[1:])
        return self._tracker

    # blocks of the reference and of displacement

    def _on_reference(
        self, tail: str, message: Float64MultiArray, info: Mapping[str, Any]
    ) -> None:
        if self._state not in ('ready', 'tracking'):
            if self._state != 'stopping':
                now = NOW.get(self._state, 'it does not drive; call ~/start')
                self._faults.note('ignored', f'a reference is not followed: {now}')
                self.report_state()
            return
        begin = time.perf_counter()
        sequence = info.get('publication_sequence_number')
        try:
            samples = from_message(message, f'reference{tail}')
            if self._model is not None:
                check_unit(models_of(self._model)[f'y{tail}'], samples.values)
        except DataError as error:
            if not tail:
                self._sample_clock.skip(sequence)
            self._faults.note('refused', f'a block is refused: {error}')
        else:
            self._wanted.join.add(tail, samples, time.monotonic(), sequence)
            try:
                self._take_complete()
            except Exception as error:  # noqa: BLE001  # as ModelError for modes that run away
                self._halt('failed', self.reason(error))
            self._busy += time.perf_counter() - begin
        self.report_state()

    def _take_complete(self) -> None:
        """Take the blocks of the reference whose further axes have come or are overdue."""
        resting = [t for t, x in self._references.items() if t and not x.get_publisher_count()]
        for block in self._wanted.join.complete(
            lambda since: self._looks.is_over(since, PATIENCE), resting
        ):
            self._take(*block)

    def _take(self, samples: Samples, sequence: int | None, resting: Collection[str]) -> None:
        publishers = partial(publisher_ids, self, self._references[''])
        verdict = self._sample_clock.judge(samples, sequence, publishers)
        if not verdict.is_taken:
            self._faults.note('refused', f'a block is refused: {verdict.reason}')
            return
        is_new, self._last = verdict.kind is Kind.START, time.monotonic()
        x, faults = self._wanted.take(samples, verdict, resting, self.values['longest'])
        for fault in faults:
            self._faults.note(*fault)
        self._answered = self._last if is_new else self._answered
        if (tracker := self._tracker) is not None:
            self._counts['streams'] += is_new
            self._play(tracker.process(x, is_new and self._state == 'tracking'))
            self._state = 'tracking'

    def _play(self, drive: Drive) -> None:
        if not drive.t.size:
            return  # a single sample behind a change of the model
        at = round((float(drive.t[0]) - self.values['preview']) * self._rate_of_clock)
        self._segment = self._wanted.label(at)
        self._send(drive.t, drive.v, self._segment)
        if drive.clipped:
            count = self._counts['clipped'] + drive.clipped
            about = f'the reference is out of reach for {count} samples'
            self._faults.note('clipped', about, drive.clipped)
        self._tell(self._errors.wanted(drive.t, drive.wanted, self._segment))

    def _on_displacement(self, tail: str, message: Float64MultiArray) -> None:
        # a slow stage may answer the last blocks when the node is at rest already
        is_waiting = self._errors.each[tail].matcher.is_waiting
        if self._state not in ('tracking', 'learning', 'stopping') and not is_waiting:
            return
        try:
            samples = from_message(message, f'displacement{tail}')
        except DataError as error:
            self._faults.note('refused', f'a block of displacement is refused: {error}')
            return
        if bad := samples.not_finite:
            about = 'samples of displacement are no numbers: left out of the tracking error'
            self._faults.note('not_finite', f'{bad} {about}', bad)
        self._answered = time.monotonic()
        self._tell(self._errors.each[tail].measured(samples))
        if self._learner is not None:
            self._learner.measured(samples, self._tails.index(tail))
        if self._tracker is not None:
            self._tracker.measured(samples, self._tails.index(tail))

    def _tell(self, errors: list[Samples]) -> None:
        for block in errors:
            self._tracking_errors[block.quantity].publish(to_message(block))

    # the timer

    def work(self) -> str:
        """Play a repetition, or wait for the end of the reference, every `PERIOD`."""
        self._looks.look()
        tracker, learner = self._tracker, self._learner
        if self._state == 'waiting' or tracker is None:
            return 'learning' if learner else 'ready'
        if self._state in ('ready', 'tracking'):
            self._take_complete()
        if self._state == 'learning' and learner is not None:
            self._repeat(tracker, learner)
        elif self._state == 'tracking' and self._looks.is_over(self._last, self.values['silence']):
            self._play(tracker.finish())
            self._halt('done', 'the reference has ended')
        return ''

    def _repeat(self, tracker: Tracker, learner: Learner) -> None:
        learner.step(tracker)
        self._learned = learner.learning or self._learned
        if learner.is_over:
            self._halt('done', learner.text)
        elif learner.is_played and not tracker.is_at_rest:
            self._send_ramp(tracker)
        else:
            self._begin_ramp()
        self.report_state()

    def _played(self, voltage: Samples, wanted: Samples) -> None:
        self._send(voltage.t, voltage.values, voltage.segment)
        self._segment = voltage.segment
        self._tell(self._errors.wanted(wanted.t, wanted.values, wanted.segment))

    # reports

    def report_state(self) -> None:
        """Publish state, tracking error and problems."""
        problems = self._problems()
        text, progress = NOW.get(self._state, self._end[1]), 0.0
        if self._state == 'idle' and self._tracker is None:
            text = 'for a model'
        elif self._state == 'learning' and self._learner:
            text, progress = self._learner.text, self._learner.progress
        elif self._state in DRIVING:
            text += f', with {self._source}'
        level = WARN if problems or self._state == 'failed' else OK
        text = '; '.join(filter(None, [text, problems]))
        values: dict[str, object] = {'models': self._models, 'segment': self._segment}
        errors, brief = {t: f'{x:.3g}' for t, x in self._errors.percents.items()}, ''
        if errors:
            values |= {f'tracking_percent{tail}': error for tail, error in errors.items()}
            brief = f'{" and ".join(errors.values())} % of the span, tracking error; {text}'
        self.report_status(
            self._state, progress, text, level, brief=brief, problems=problems, **values
        )

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return rate, counts of lost and refused samples, head-room, and tracking error."""
        # while the reference pauses, the stage has no block to answer
        if self._state == 'tracking' and self._last - self._answered > SILENT:
            self._errors.clear()
            self._faults.note('silent', 'no displacement comes from the stage', 0)
        if outliers := self._errors.outliers:
            about = 'wild readings of displacement are left out of the tracking error'
            self._faults.note('outliers', f'{outliers} {about}', 0)
        # updated once a second: a new figure with each block would flood the status
        self._errors.look()
        self.report_state()
        rate, worked = self._rate.of(self._counts['samples']), self._work_rate.of(self._busy)
        values: dict[str, object] = {
            'rate': f'{rate:.1f}',
            **{name: self._counts[name] for name in ('samples', 'streams', *FAULTS)},
            'models': self._models,
            'publishers': self.count_publishers('voltage'),
        }
        if (tracker := self._tracker) is not None:
            values['delay'] = f'{tracker.preview / self._rate_of_clock:.6g}'
            values['passes'] = tracker.inverse.passes
            values['expected'] = f'{tracker.inverse.error:.3g}'
            for tail, follower in zip(self._tails, tracker.followers, strict=False):
                told = follower.corrector.told.items()
                values |= {f'{name}{tail}': f'{x:.6g}' for name, x in told}
                if follower.is_limited:
                    self._faults.note('limited', LIMITED, 0)
        if rate:
            values['head_room'] = f'{max(0.0, 1.0 - worked * self._rate_of_clock / rate):.3f}'
        values |= self._errors.figures()
        self._note_second()
        problems = self._problems()
        return (WARN if problems else OK), problems or self._state, values

    def close(self) -> None:
        """Ramp to rest within a second."""
        self._loader.close()
        super().close()

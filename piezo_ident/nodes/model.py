# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Run a model beside the stage: prediction, residual, estimate and preview of each block."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
import functools
from pathlib import Path
import time
from typing import Any

import numpy as np
from piezo_ident.common.errors import DataError, PiezoIdentError
from piezo_ident.live.corrector import Corrector, Estimated
from piezo_ident.live.monitor import LiveError, Matched, Matcher, Preview, PreviewBin
from piezo_ident.live.predictor import Predictor, warm_up
from piezo_ident.model.metrics import expected_error, percent
from piezo_ident.model.stage_model import StageModel
from piezo_ident.nodes.given import home_problem
from piezo_ident.nodes.lab_node import LabNode, OK, WARN
from piezo_ident.nodes.model_loader import ModelLoader, no_file
from piezo_ident.nodes.wire import from_message, PREVIEW, STREAM, to_message
from piezo_ident.record.blocks import Samples
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

QUANTITIES = ('voltage', 'displacement', 'prediction', 'residual', 'estimate')
#: time for which a problem of the stream stays in the status [s], and most problems there
REMEMBER, MOST = 5.0, 4
#: share of the predictions of a second that must meet a displacement, and number of seconds that
#: may fall short: the first second of a stream is incomplete
MET, PATIENCE = 0.5, 1


class ModelNode(LabNode):
    """Predicts the displacement, and warns when the stage moves differently."""

    executable = 'model'

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        warm_up()
        self._predictor, self._matcher = Predictor(self.values['interval']), Matcher()
        self._preview = Preview(self.values['preview_rate'])
        self._error = LiveError(self.values['window'])
        values = [self.values[n] for n in ('horizon', 'observe_gain', 'preview_rate', 'adapt')]
        self._corrector, self._estimates = Corrector(*values), Matcher()
        # error of the estimate
        self._left = LiveError(self.values['window'])
        self._source, self._refusal, self._unreadable, self._not_finite = '', '', 0, 0
        self._doubt = ''
        self._problems: dict[str, float] = {}
        self._range = (float('inf'), float('-inf'))
        self._count, self._count_at, self._work = 0, time.monotonic(), 0.0
        # samples of the last second, and seconds in which too few were compared
        self._predicted, self._measured, self._compared, self._unmet = 0, 0, 0, 0
        # samples of displacement that came again, until the last second
        self._again = 0
        self._models = 0
        self.offer('accept', self._corrector.accept)
        self.offer('save', self._save)
        self.offer('restore', self._corrector.restore)
        self._loader = ModelLoader(self, _tried, self._take_model, self._report_state)
        self._prediction = self.create_publisher(Float64MultiArray, 'prediction', STREAM)
        self._band = self.create_publisher(Float64MultiArray, 'prediction_band', STREAM)
        self._residual = self.create_publisher(Float64MultiArray, 'residual', STREAM)
        self._estimate = self.create_publisher(Float64MultiArray, 'estimate', STREAM)
        self._corrections = self.create_publisher(JointState, 'corrections', PREVIEW)
        self._joints = self.create_publisher(JointState, 'preview', PREVIEW)
        if path := self.values['model']:
            self._loader.begin_with(path)
        for topic, take in (('voltage', self._voltage), ('displacement', self._displacement)):
            on_message = functools.partial(self._on_block, topic, take)
            self.create_subscription(Float64MultiArray, topic, on_message, STREAM)
        self._report_state()

    # models

    def refuse(self, name: str, value: Any) -> str | None:
        """Refuse a missing model file; ``~/status`` reports faults inside a file."""
        return {'model': no_file, 'output': home_problem}.get(name, lambda _: None)(value)

    def apply(self, changed: Mapping[str, Any]) -> None:
        """Apply a model file, a window, or settings of the observer."""
        if path := changed.get('model'):
            self._loader.load_file(path)
        if 'window' in changed:
            self._error.window = self._left.window = changed['window']
        if {'horizon', 'observe_gain', 'adapt'} & set(changed):
            new = {**self.values, **changed}
            h, gain, adapt = (new[name] for name in ('horizon', 'observe_gain', 'adapt'))
            self._corrector.set_up(h, gain, adapt, self._predictor.caught_up)
            self._left.clear()

    def _take_model(self, model: StageModel | None, source: str) -> None:
        try:
            if model is not None:
                self._predictor.set_model(model)
                self._corrector.set_model(model, self._predictor.caught_up)
        except PiezoIdentError as error:
            model, source = None, f'{source}: {error}'
        if model is None:
            kept = 'the old model is kept' if self._predictor.model else 'there is no model'
            self._refusal = f'model refused, {kept}: {source}'
            return
        self._source, self._refusal = source, ''
        self._models += 1
        if self._models > 1:
            # the state stays the same, so the status writes no line
            self.journal.tell(f'predicting: model {self._models} is taken over, {source}')
        self._forget_errors()

    def _save(self) -> str:
        learnt, path = self._corrector.learnt, self.values['output']
        if not path:
            raise DataError("parameter 'output' is empty; set it to the file to write")
        learnt.save(Path(path).expanduser())
        return f'{path}: the model with what was learnt'

    def _forget_errors(self) -> None:
        self._error.clear()
        self._left.clear()

    # blocks

    def _on_block(self, topic: str, take: Any, message: Float64MultiArray) -> None:
        begin = time.perf_counter()
        try:
            samples = from_message(message, topic)
        except DataError as error:
            self._unreadable += 1
            self._note_problem(f'a message on {topic} is no block: {error}')
            return
        self._not_finite += samples.not_finite
        take(samples)
        self._work += time.perf_counter() - begin

    def _voltage(self, samples: Samples) -> None:
        predictor = self._predictor
        predictor.problem, known = '', predictor.memory_known
        prediction = predictor.process(samples)
        if self._is_lost:
            # the earlier error says nothing about the present
            self._error.clear()
        if prediction is not None:
            self._prediction.publish(to_message(prediction))
            if predictor.half_width is not None:
                self._band.publish(to_message(predictor.half_width))
        self._count += samples.t.size
        numbers, (low, high) = samples.values[np.isfinite(samples.values)], self._range
        self._range = float(numbers.min(initial=low)), float(numbers.max(initial=high))
        self._publish_preview(self._preview.add('voltage', samples.t, samples.values))
        if predictor.problem:
            self._note_problem(predictor.problem)
        if prediction is not None:
            self._predicted += prediction.t.size
            self._publish_preview(self._preview.add('prediction', prediction.t, prediction.values))
            self._compare(self._matcher.predicted(prediction))
            self._correct(self._corrector.predicted(prediction, samples, known))

    def _displacement(self, samples: Samples) -> None:
        usable = np.isfinite(samples.values)
        if not usable.all():
            self._note_problem(
                'a block of displacement holds NaN or infinite numbers; they are left out'
            )
            samples = replace(samples, t=samples.t[usable], values=samples.values[usable])
            if not samples.t.size:
                return
        self._measured += samples.t.size
        self._publish_preview(self._preview.add('displacement', samples.t, samples.values))
        if self._predictor.model is not None:
            self._left_by(self._estimates.measured(samples))
            self._compare(self._matcher.measured(samples))

    def _compare(self, pairs: list[Matched]) -> None:
        model = self._predictor.model
        stroke = abs(model.scaling.Y) if model else float('inf')
        for pair in pairs:
            residual = pair.residual
            self._compared += residual.t.size
            self._residual.publish(to_message(residual))
            self._publish_preview(self._preview.add('residual', residual.t, residual.values))
            if self._is_known:
                self._error.add(residual.t, residual.values, stroke, pair.y)
            self._correct(self._corrector.measured(pair.t, pair.y))

    @property
    def _is_known(self) -> bool:
        """Whether the memory of the plays is known, from rest or from sweeps."""
        return self._predictor.memory_known or self._corrector.knows_memory

    @property
    def _is_lost(self) -> bool:
        """Whether blocks arrive and the memory of the plays is not known."""
        return self._predictor.memory_lost and not self._is_known

    def _correct(self, several: list[Estimated]) -> None:
        for one in several:
            samples = one.samples
            self._estimate.publish(to_message(samples))
            self._publish_preview(self._preview.add('estimate', samples.t, samples.values))
            for told in one.corrections:
                message = JointState(name=list(told), position=list(told.values()))
                message.header.stamp = self.get_clock().now().to_msg()
                self._corrections.publish(message)
            if one.is_settled:
                self._left_by(self._estimates.predicted(samples))
        if several and (doubt := self._corrector.doubt) != self._doubt:
            self._doubt = doubt
            if doubt:
                self._note_problem(f'reading or zero of the displacement: {doubt}')

    def _left_by(self, pairs: list[Matched]) -> None:
        for pair in pairs:
            left = pair.residual
            self._left.add(left.t, left.values, self._corrector.span, pair.y)

    def _publish_preview(self, bins: list[PreviewBin]) -> None:
        for b in bins:
            message = JointState()
            message.header.stamp = self.get_clock().now().to_msg()
            for quantity in QUANTITIES:
                # a missing quantity is NaN, which leaves a gap in the plot
                values = b.values.get(quantity, (float('nan'),) * 3)
                message.name += [f'{quantity}/{what}' for what in ('mean', 'min', 'max')]
                message.position.extend(values)
            self._joints.publish(message)

    # status and diagnostics

    def _note_problem(self, problem: str) -> None:
        # a listener may miss a status, so each status names the last few problems
        self._problems.pop(problem, None)
        self._problems[problem] = time.monotonic()
        self._report_state()

    def _verdict(self) -> tuple[str, str]:
        """Return a reason to identify again, or else the corrections; both may be empty."""
        model, ratio = self._predictor.model, self.values['warn_ratio']
        if model is None or self._left.seconds < 0.5 * self._left.window:
            return '', ''
        before, span = expected_error(model), abs(model.scaling.Y)
        left = percent(np.fmin(self._left.rms, self._error.rms), span)
        if before is None:
            return '', ''
        if left > ratio * before:
            said = f'{left:.3g} % of stroke, {left / before:.1f} times that at identification'
            if changed := self._corrector.changed:
                said += f'; what changed: {changed}'
            return f'identify again, or diagnose on this motion: the live error is {said}', ''
        if self._error.seconds and self._live_error(model) > ratio * before:
            return '', f'corrected: {self._corrector.corrected}'
        return '', ''

    def _left_out(self) -> str:
        n = self._error.outliers
        return f'{n} wild readings of displacement are left out of the live error' if n else ''

    def _mismatch(self) -> str:
        """Return why predictions cannot be compared, or ''; called once a second."""
        predicted, measured, compared = self._predicted, self._measured, self._compared
        self._predicted = self._measured = self._compared = 0
        if self._count and not predicted:
            # the voltage is at fault, not the displacement
            self._forget_errors()
            return self._predictor.problem
        self._unmet = self._unmet + 1 if compared < MET * predicted else 0
        if self._unmet <= PATIENCE:
            return ''
        self._forget_errors()
        if not measured:
            return 'no displacement comes'
        share = 100.0 * compared / predicted
        return f'{share:.0f} % of the voltage is met by displacement of the same t'

    def _live_error(self, model: StageModel) -> float:
        return percent(self._error.rms, abs(model.scaling.Y))

    def _report_state(self) -> None:
        fresh = [p for p, at in self._problems.items() if time.monotonic() - at < REMEMBER]
        self._problems = {p: self._problems[p] for p in fresh[-MOST:]}
        problems = [self._refusal, *self._problems, self._left_out()]
        state = 'predicting' if self._predictor.model is not None else 'waiting'
        message = f'with {self._source}' if self._source else 'for a model'
        if self._predictor.model is not None and self._is_lost:
            message += '; its memory is unknown until the voltage has been at its lowest'
        text = '; '.join(filter(None, [message, *problems]))
        level = WARN if any(problems) else OK
        model, brief = self._predictor.model, ''
        values: dict[str, object] = {'models': self._models}
        if model is not None and self._error.seconds:
            values['residual_percent'] = error = f'{self._live_error(model):.3g}'
            brief = f'{error} % of stroke, live error; {text}'
        wrong = '; '.join(filter(None, problems))
        self.report_status(state, 0.0, text, level, brief=brief, problems=wrong, **values)

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return counts, errors and problems of the prediction."""
        self._report_state()
        now, p = time.monotonic(), self._predictor
        elapsed, mismatch = max(now - self._count_at, 1e-3), self._mismatch()
        values: dict[str, object] = {
            'rate': f'{self._count / elapsed:.0f}',
            'load': f'{100.0 * self._work / elapsed:.1f}',
            'lost': p.lost,
            'late': p.late,
            'restarts': p.restarts,
            'unreadable': self._unreadable,
            'not_finite': self._not_finite,
            'unmatched': self._matcher.unmatched,
            'unmeasured': self._matcher.unmeasured,
        }
        again, self._again = self._matcher.late - self._again, self._matcher.late
        (low, high), self._range = self._range, (float('inf'), float('-inf'))
        self._count, self._count_at, self._work = 0, now, 0.0
        model = p.model
        if model is None:
            return OK, 'no model yet', values
        values['memory_known'] = self._is_known
        values['residual_rms'] = f'{self._error.rms:.6g}'
        values['residual_percent'] = f'{self._live_error(model):.4g}'
        values['residual_mean'] = f'{self._error.mean:.6g}'
        values['outliers'] = self._error.outliers
        values['estimate_rms'] = f'{self._left.rms:.6g}'
        values['estimate_percent'] = f'{percent(self._left.rms, self._corrector.span):.4g}'
        values |= {name: f'{x:.6g}' for name, x in self._corrector.told.items()}
        verdict, corrected = (mismatch, '') if mismatch else self._verdict()
        problems = [verdict, self._left_out()]
        if again:
            about = 'samples of displacement came again or out of turn: do two nodes publish it?'
            problems.append(f'{again} {about}')
        if self._is_lost:
            problems.append('the memory is unknown until the voltage has been at its lowest')
        if low <= high:
            room = min(low - model.scaling.range[0], model.scaling.range[1] - high)
            values['head_room'] = f'{room:.6g}'
            if room < -1e-3 * (model.scaling.range[1] - model.scaling.range[0]):
                problems.append(f'the voltage leaves the identified range by {-room:.3g} V')
        message = '; '.join(filter(None, problems))
        told = '; '.join(filter(None, [message or 'predicting', corrected]))
        return WARN if message else OK, told, values

    def close(self) -> None:
        """Stop the loader."""
        self._loader.close()


def _tried(model: StageModel) -> StageModel:
    """Run a few samples, which compiles the kernels of a model and finds its faults."""
    model.stream().process(np.full(10, model.scaling.range[0]))
    return model

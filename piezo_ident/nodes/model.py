# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Model node: predicts the displacement, and estimates it with the sensor.

- A block of `voltage` gives blocks of `prediction` and `prediction_band` at the same t.  With
  `axes` the block waits up to `PATIENCE` for the voltages of the other axes.
- A block of `displacement` gives a block of `residual` for the predicted samples in it.
- A sample of `estimate` follows when the displacement `horizon` samples before has come, or is
  given up.
- All signals go into `preview`, and the corrections of the estimate into `corrections`.

A new model, from the parameter or the topic `model`, takes over between two blocks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
import functools
from pathlib import Path
import time
from typing import Any

import numpy as np
from piezo_ident.common.errors import DataError, PiezoIdentError
from piezo_ident.fitting.adaptation import check_learns, Recalled
from piezo_ident.live.comparison import AxisComparison, finite_readings
from piezo_ident.live.corrector import Corrector
from piezo_ident.live.join import Join
from piezo_ident.live.monitor import Preview, PreviewBin
from piezo_ident.live.pacing import Looks
from piezo_ident.live.predictor import Predictor, run_of, warm_up
from piezo_ident.model.multi_axis import alone, models_of, shares_modes, with_own
from piezo_ident.nodes.lab_node import LabNode, OK, WARN
from piezo_ident.nodes.model_loader import Model, ModelLoader, no_file
from piezo_ident.nodes.parameter_node import home_problem
from piezo_ident.nodes.wire import from_message, PREVIEW, publishers, STREAM, to_message
from piezo_ident.record.blocks import Samples
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

QUANTITIES = ('voltage', 'displacement', 'prediction', 'residual', 'estimate')
#: settings of the observer
OBSERVED = ('horizon', 'observe_gain', 'observe_drift', 'adapt', 'accept_after')
#: time for which a problem of the stream stays in the status [s], and most problems there
REMEMBER, MOST = 5.0, 4
#: longest wait of a block for the voltage of a further axis, and period of the time-outs [s]
PATIENCE, LOOK = 0.2, 0.05


class ModelNode(LabNode):
    """Predicts the displacement, and warns when it differs from the measured displacement."""

    executable = 'model'

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        warm_up()
        self._tails = self.tails()
        self._predictor = Predictor([f'y{tail}' for tail in self._tails], self.values['interval'])
        self._join, self._looks = Join(self._tails[1:]), Looks()
        self._preview = Preview(self.values['preview_rate'])
        self._source, self._refusal, self._unreadable, self._not_finite = '', '', 0, 0
        self._problems: dict[str, float] = {}
        self._count, self._count_at, self._work = 0, time.monotonic(), 0.0
        self._is_silent = True
        self._models = 0
        self._quantities = {
            f'{what}{tail}': self.create_publisher(Float64MultiArray, f'{what}{tail}', STREAM)
            for tail in self._tails
            for what in ('prediction', 'prediction_band', 'residual', 'estimate')
        }
        self._corrections = {
            tail: self.create_publisher(JointState, f'corrections{tail}', PREVIEW)
            for tail in self._tails
        }
        self._joints = self.create_publisher(JointState, 'preview', PREVIEW)
        self._comparisons = {tail: self._comparison(tail) for tail in self._tails}
        self.offer('accept', self._accept)
        self.offer('save', self._save)
        self.offer('restore', self._restore)
        self._loader = ModelLoader(self, _tried, self._take_model, self._report_state)
        if path := self.values['model']:
            self._loader.begin_with(path)
        self._voltages = {tail: self._listen('voltage', tail) for tail in self._tails}
        for tail in self._tails:
            self._listen('displacement', tail)
        if self._tails[1:]:
            self.create_timer(LOOK, self._look)
        self._report_state()

    def _comparison(self, tail: str) -> AxisComparison:
        values = [self.values[name] for name in (*OBSERVED, 'preview_rate')]
        return AxisComparison(
            self.values['window'],
            Corrector(*values),
            lambda what, samples: self._publish(f'{what}{tail}', samples),
            functools.partial(self._tell, tail),
            lambda: self._predictor.memory_known,
            lambda doubt: self._note_problem(self._joined({tail: doubt})),
        )

    def _listen(self, what: str, tail: str) -> Any:
        on_message = functools.partial(self._on_block, what, tail)
        return self.create_subscription(Float64MultiArray, f'{what}{tail}', on_message, STREAM)

    # parameters and models

    def refuse(self, name: str, value: Any) -> str | None:
        """Refuse a missing model file; ``~/status`` reports faults inside a file."""
        if name == 'adapt' and hasattr(self, '_predictor'):
            check_learns(value, shares_modes(self._predictor.model))
        return {'model': no_file, 'output': home_problem}.get(name, lambda _: None)(value)

    def apply(self, changed: Mapping[str, Any]) -> None:
        """Apply a model file, a window, or settings of the observer."""
        if path := changed.get('model'):
            self._loader.load_file(path)
        if 'window' in changed:
            for one in self._comparisons.values():
                one.error.window = one.left.window = changed['window']
        if {*OBSERVED} & set(changed):
            settings = [{**self.values, **changed}[name] for name in OBSERVED]
            for k, one in enumerate(self._comparisons.values()):
                one.corrector.set_up(*settings, recalled=self._recalled(k))
                one.left.clear()

    def _recalled(self, axis: int) -> Recalled:
        if shares_modes(self._predictor.model):
            return None
        return functools.partial(self._predictor.caught_up, axis=axis)

    def _take_model(self, model: Model | None, source: str) -> None:
        try:
            if model is not None:
                check_learns(self.values['adapt'], shares_modes(model))
                self._predictor.set_model(model)
                for k, (tail, one) in enumerate(self._comparisons.items()):
                    one.set_model(alone(model)[f'y{tail}'], self._recalled(k))
        except PiezoIdentError as error:
            model, source = None, f'{source}: {error}'
        if model is None:
            kept = 'the old model is kept' if self._predictor.model else 'there is no model'
            self._refusal = f'model refused, {kept}: {source}'
            return
        self._source, self._refusal = source, ''
        self._models += 1
        if self._models > 1:
            # the status logs a change of the state alone
            self.journal.tell(f'predicting: model {self._models} is taken over, {source}')

    # services

    def _accept(self) -> str:
        said, refused = dict[str, str](), dict[str, str]()
        for tail, one in self._comparisons.items():
            try:
                said[tail] = one.corrector.accept()
            except DataError as error:
                refused[tail] = str(error)
        if not said:
            raise DataError(self._joined(refused))
        return self._joined(said)

    def _save(self) -> str:
        each = self._comparisons.items()
        learnt, path = {f'y{k}': x.corrector.learnt for k, x in each}, self.values['output']
        if not path:
            raise DataError("parameter 'output' is empty; set it to the file to write")
        if (model := self._predictor.model) is not None:
            with_own(model, learnt).save(Path(path).expanduser())
        return f'{path}: the model with what was learnt'

    def _restore(self) -> str:
        return self._joined({k: x.corrector.restore() for k, x in self._comparisons.items()})

    # blocks of voltage and displacement

    def _on_block(self, what: str, tail: str, message: Float64MultiArray) -> None:
        begin = time.perf_counter()
        topic = f'{what}{tail}'
        try:
            samples = from_message(message, topic)
        except DataError as error:
            self._unreadable += 1
            self._note_problem(f'a message on {topic} is no block: {error}')
            return
        self._not_finite += samples.not_finite
        if what == 'displacement':
            self._displacement(tail, samples)
        else:
            self._join.add(tail, samples, time.monotonic())
            self._take_complete()
        self._work += time.perf_counter() - begin

    def _look(self) -> None:
        self._looks.look()
        self._take_complete()

    def _take_complete(self) -> None:
        """Take the blocks of voltage whose further axes have come or are overdue."""
        silent = [t for t in self._tails[1:] if not self._voltages[t].get_publisher_count()]
        for first, *_ in self._join.complete(
            lambda since: self._looks.is_over(since, PATIENCE), silent
        ):
            samples, missing = self._join.rows(first)
            for tail, n in missing.items():
                self._note_problem(f'{n} samples of voltage{tail} are missing: the last, or 0 V')
            self._voltage(samples)

    def _voltage(self, samples: Samples) -> None:
        predictor, each = self._predictor, self._comparisons.values()
        predictor.problem, known = '', predictor.memory_known
        prediction = predictor.process(samples)
        if self._is_lost:
            # the live error belongs to the time before the loss
            for one in each:
                one.error.clear()
        self._count += samples.t.size
        v, parts = np.atleast_2d(samples.values), []
        for k, tail in enumerate(self._tails):
            self._comparisons[tail].drove(v[k])
            self._publish_preview(self._preview.add(f'voltage{tail}', samples.t, v[k]))
            if prediction is not None:
                y = np.atleast_2d(prediction.values)[k]
                parts.append(Samples(prediction.t, y, prediction.segment, f'displacement{tail}'))
                self._publish(f'prediction{tail}', parts[-1])
                if (band := predictor.half_width) is not None:
                    half = replace(parts[-1], values=np.atleast_2d(band.values)[k])
                    self._quantities[f'prediction_band{tail}'].publish(to_message(half))
        if predictor.problem:
            self._note_problem(predictor.problem)
        self._is_silent &= prediction is None
        for one, part, row, felt in zip(each, parts, v, predictor.felt, strict=False):
            one.predicted(part, Samples(samples.t, row, samples.segment), known, felt)

    def _displacement(self, tail: str, samples: Samples) -> None:
        numbers = finite_readings(samples)
        if numbers.t.size < samples.t.size:
            self._note_problem(
                f'a block of displacement{tail} holds NaN or infinite numbers; they are left out'
            )
        if numbers.t.size:
            x = self._preview.add(f'displacement{tail}', numbers.t, numbers.values)
            self._publish_preview(x)
            self._comparisons[tail].measured(numbers)

    @property
    def _is_lost(self) -> bool:
        """Whether blocks arrive while the memory of the plays is unknown."""
        known = all(one.is_known for one in self._comparisons.values())
        return bool(np.isfinite(self._predictor.clock.last)) and not known

    def _publish(self, topic: str, samples: Samples) -> None:
        self._quantities[topic].publish(to_message(samples))
        self._publish_preview(self._preview.add(topic, samples.t, samples.values))

    def _tell(self, tail: str, told: dict[str, float]) -> None:
        message = JointState(name=list(told), position=list(told.values()))
        message.header.stamp = self.get_clock().now().to_msg()
        self._corrections[tail].publish(message)

    def _publish_preview(self, bins: list[PreviewBin]) -> None:
        names = [f'{quantity}{tail}' for tail in self._tails for quantity in QUANTITIES]
        for b in bins:
            message = JointState()
            message.header.stamp = self.get_clock().now().to_msg()
            for quantity in names:
                # a missing quantity is NaN, which leaves a gap in the plot
                values = b.values.get(quantity, (float('nan'),) * 3)
                message.name += [f'{quantity}/{what}' for what in ('mean', 'min', 'max')]
                message.position.extend(values)
            self._joints.publish(message)

    # reports

    def _note_problem(self, problem: str) -> None:
        # each status names the last few problems, as a listener may miss a status
        self._problems.pop(problem, None)
        self._problems[problem] = time.monotonic()
        self._report_state()

    def _joined(self, texts: Mapping[str, str]) -> str:
        """Join texts about the axes, each under its name if there are several."""
        several = len(self._tails) > 1
        return '; '.join(f'y{t}: {x}' if several else x for t, x in texts.items() if x)

    def _report_state(self) -> None:
        fresh = [p for p, at in self._problems.items() if time.monotonic() - at < REMEMBER]
        self._problems = {p: self._problems[p] for p in fresh[-MOST:]}
        left_out = self._joined({tail: one.left_out for tail, one in self._comparisons.items()})
        problems = [self._refusal, *self._problems, left_out]
        state = 'predicting' if self._predictor.model is not None else 'waiting'
        message = f'with {self._source}' if self._source else 'for a model'
        if self._predictor.model is not None and self._is_lost:
            message += '; its memory is unknown until the voltage has been at its lowest'
        text = '; '.join(filter(None, [message, *problems]))
        level = WARN if any(problems) else OK
        values: dict[str, object] = {'models': self._models}
        errors = {
            tail: f'{one.percent:.3g}'
            for tail, one in self._comparisons.items()
            if one.model is not None and one.error.seconds
        }
        values |= {f'residual_percent{tail}': x for tail, x in errors.items()}
        live = f'{" and ".join(errors.values())} % of stroke, live error; {text}'
        brief = live if errors else ''
        wrong = '; '.join(filter(None, problems))
        self.report_status(state, 0.0, text, level, brief=brief, problems=wrong, **values)

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return counts, errors and problems of the prediction."""
        self._report_state()
        now, p, each = time.monotonic(), self._predictor, self._comparisons
        elapsed, is_silent = max(now - self._count_at, 1e-3), bool(self._count) and self._is_silent
        problems = {tail: one.look(is_silent) for tail, one in each.items()}
        values: dict[str, object] = {
            'rate': f'{self._count / elapsed:.0f}',
            'load': f'{100.0 * self._work / elapsed:.1f}',
            'lost': p.clock.lost,
            'late': p.clock.late,
            'restarts': p.clock.restarts,
            'unreadable': self._unreadable,
            'not_finite': self._not_finite,
            'unmatched': sum(one.matcher.unmatched for one in each.values()),
            'unmeasured': sum(one.matcher.unmeasured for one in each.values()),
        }
        self._count, self._count_at, self._work, self._is_silent = 0, now, 0.0, True
        model = p.model
        if model is None:
            return OK, 'no model yet', values
        corrected = {}
        for tail, one in each.items():
            values |= {f'{name}{tail}': x for name, x in one.figures().items()}
            verdict, correction = one.verdict(self.values['warn_ratio'])
            mismatch = p.problem if is_silent else problems[tail]
            corrected[tail] = '' if mismatch else correction
            faults = one.problems(publishers(self, f'displacement{tail}').values())
            problems[tail] = '; '.join(filter(None, [mismatch or verdict, *faults]))
        lost = 'the memory is unknown until the voltage has been at its lowest'
        message = '; '.join(filter(None, [self._joined(problems), lost * self._is_lost]))
        told = '; '.join(filter(None, [message or 'predicting', self._joined(corrected)]))
        return WARN if message else OK, told, values

    def close(self) -> None:
        """Stop the loader."""
        self._loader.close()


def _tried(model: Model) -> Model:
    """Run a few samples, which compiles the kernels of a model and finds its faults."""
    axes = models_of(model)
    rest = np.array([[x.scaling.range[0]] * 10 for x in axes.values()])
    run_of(model, [*axes]).process(rest, np.arange(10) / model.sample_rate)
    return model

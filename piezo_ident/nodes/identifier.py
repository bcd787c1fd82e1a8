# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""The identifier: captures what passes, drives the excitation, and learns the model."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
import functools
from pathlib import Path
import time
from typing import Any

from piezo_ident.cli.outputs import check_folder
from piezo_ident.common.errors import Cancelled, DataError, PiezoIdentError
from piezo_ident.identification.results import Steps
from piezo_ident.model.files import load, model_to_yaml
from piezo_ident.model.stage_model import StageModel
from piezo_ident.nodes.diagnosis_jobs import Judgement, save_both_job
from piezo_ident.nodes.drive import Drive, Streams
from piezo_ident.nodes.helper import Helper
from piezo_ident.nodes.inquiry import Inquiry
from piezo_ident.nodes.jobs import (
    identify_job,
    Outcome,
    settings_of,
    share_of,
    Tick,
    warm_up,
)
from piezo_ident.nodes.lab_node import ERROR, LabNode, OK, run, WARN
from piezo_ident.nodes.subscriptions import BlockSubscriptions
from piezo_ident.nodes.wire import from_message, LATCHED
from piezo_ident.nodes.worker import Worker
from piezo_ident.record.capture import APPLIED, Capture
from std_msgs.msg import Float64MultiArray, String

__all__ = ['IdentifierNode', 'main']

#: quantities that a topic may say it carries, beside its own name
_CARRIED = {'voltage': (), 'displacement': (), APPLIED: ('voltage',)}
#: how often the run of the excitation is looked at [s]
POLL = 0.05
#: how often it is told how much was captured [s]
TELL = 0.5
#: how often it is looked for what has come [s]
DRAIN = 0.02
#: how long the end of the node waits for the work to end [s]
PATIENCE = 1.7


class IdentifierNode(LabNode):
    """Captures, identifies, and publishes model and report."""

    executable = 'identifier'

    def __init__(self, **kwargs: Any) -> None:
        self._files: dict[str, StageModel] = {}
        super().__init__(**kwargs)
        self._capture = Capture(self.values['capture_limit'])
        self._worker = Worker()
        self._helper = Helper(self.values['nice'], warm_up)
        self._outcomes: deque[Callable[[], None]] = deque()
        self._state, self._doing, self._told = 'idle', '', 0.0
        self._steps = Steps()
        self._found: Outcome | None = None
        self._inquiry = Inquiry(self, self._capture)
        # the capture that goes into the model at work, and the model that everybody has
        self._using: dict[str, int] = {}
        self._published = ''
        if self.values['model']:
            self._take_file(self.values['model'])
        self._counted, self._counted_at = 0, time.monotonic()
        self._passed: dict[str, int] = {}
        self._held: deque[tuple[str, str, Float64MultiArray, Mapping[str, Any]]] = deque()
        self._model = self.create_publisher(String, 'model', LATCHED)
        self._report = self.create_publisher(String, 'report', LATCHED)
        self._inputs = BlockSubscriptions(self, lambda *block: self._held.append(block))
        for key in ('voltage', 'displacement', APPLIED):
            self._inputs.add(key, key)
        for topic in self.values['channels'].split():
            self._inputs.add(topic, '')
        self._drive = Drive(self, self._streams, self._unheard)
        self.create_timer(DRAIN, self._drain)
        self.create_timer(POLL, self._poll)
        self._wake = self.create_guard_condition(self._take_outcomes)
        self.offer('run', self._run)
        self.offer('identify', functools.partial(self._identify, 'all'))
        for step in ('delay', 'dynamics', 'hysteresis'):
            self.offer(f'identify_{step}', functools.partial(self._identify, step))
        self.offer('diagnose', self._diagnose)
        self.offer('cancel', self._cancel)
        self.offer('clear', self._clear)
        self.offer('save', self._save)

    def offer(self, name: str, handler: Callable[[], str]) -> None:
        """Offer a service; what was sent before the call counts as captured."""

        def drained() -> str:
            self._drain()
            return handler()

        super().offer(name, drained)

    # capture

    def _drain(self) -> None:
        self._inputs.drain()
        # what was captured before a run is forgotten once it has begun, and kept if it does not
        if self._drive.is_starting or not self._held:
            return
        while self._held:
            self._take(*self._held.popleft())

    def _take(
        self, topic: str, key: str, message: Float64MultiArray, info: Mapping[str, Any]
    ) -> None:
        try:
            samples = from_message(message)
            known = (*_CARRIED[key], key) if key else ()
            quantity = samples.quantity
            # a further channel says itself what it is
            if quantity not in known and (key or not quantity.startswith('x_')):
                wanted = key or 'x_<name>'
                raise DataError(f"layout says 't,{quantity}', not 't,{wanted}'")
        except DataError as error:
            self._capture.unreadable(topic, str(error))
            return
        arrival = info.get('received_timestamp') or time.time_ns()
        self._capture.add(key or samples.quantity, samples, arrival)
        self._passed[topic] = self._passed.get(topic, 0) + samples.t.size

    def _streams(self) -> Streams:
        c = self._capture
        answered = c.last_time('displacement')
        if APPLIED in c.keys:
            # the stage says both, one after the other: a run ends with the later of them
            answered = min(answered, c.last_time(APPLIED))
        return Streams(
            self._passed.get('voltage', 0),
            c.last_time('voltage'),
            self._passed.get('displacement', 0),
            answered,
        )

    def _unheard(self) -> str:
        # what is sent before publisher and subscription have met is lost
        return ', '.join(t for t in self._inputs.unpublished if t not in ('voltage', APPLIED))

    # state

    def _say(self, state: str, progress: float, message: str, level: bytes = OK) -> None:
        self._state = state
        self.report_status(state, progress, message, level)

    def _poll(self) -> None:
        if self._drive.running:
            # a run that has ended is identified from all of it
            self._drain()
            self._drive.poll()
        if self._drive.running:
            segment = f', in segment {self._capture.segment}' if self._capture.segment else ''
            message = f'{self._doing}: {self._capture.seconds:.0f} s captured{segment}'
            self._say_with_problems('exciting', self._drive.progress, message)
        elif self._state == 'idle' and time.monotonic() - self._told > TELL:
            self._told = time.monotonic()
            self._say_with_problems('idle', 0.0, self._listening())

    def _say_with_problems(self, state: str, progress: float, message: str) -> None:
        problems = self._capture.problems
        text = '; '.join([message, *problems])
        self._say(state, progress, text, WARN if problems else OK)

    def _kept(self) -> str:
        keys = dict.fromkeys(('voltage', 'displacement', *self._capture.keys))
        return ', '.join(f'{self._capture.seconds_of(key):.3f} s of {key}' for key in keys)

    def _listening(self) -> str:
        return f'{self._kept()} captured' if self._capture.keys else 'ready'

    def _is_busy(self) -> bool:
        # the first values of parameters come before anything else is there
        return hasattr(self, '_drive') and (self._drive.running or self._worker.busy)

    def _refuse_when_busy(self) -> None:
        if self._is_busy():
            raise PiezoIdentError(f'busy: {self._doing}; wait for its end, or call ~/cancel')

    def refuse(self, name: str, value: Any) -> str | None:
        """Refuse what the settings would refuse later."""
        if name == 'thresholds':
            defaults = {'solver': 'least_squares', 'max_order': 15, 'seed': 0}
            swarm = {'swarm_size': 40, 'swarm_iterations': 1000}
            try:
                settings_of({**defaults, **swarm, 'thresholds': value})
            except PiezoIdentError as error:
                return str(error)
        if name.endswith('program') and not value.strip():
            return f'{name} must not be empty; name a programme, a path, or write YAML'
        if name == 'model' and value:
            if self._is_busy():
                return f'busy: {self._doing}; set the model when that has ended, or call ~/cancel'
            try:
                self._files = {value: load(value)}
            except PiezoIdentError as error:
                return str(error)
        return None

    def apply(self, changed: Mapping[str, Any]) -> None:
        """Hand the limit on to the capture; the rest is read when work begins."""
        if 'capture_limit' in changed:
            self._capture.limit = changed['capture_limit']
        if changed.get('model'):
            self._take_file(changed['model'])

    def _take_file(self, path: str) -> None:
        model = self._files.pop(path)
        self._inquiry.take(model, {})
        self._published = model_to_yaml(model)

    # services

    def _run(self) -> str:
        self._refuse_when_busy()
        settings_of(self.values)
        self._doing = 'excitation'
        self._drive.start(
            self.values['program'],
            self.values['excitation_limit'],
            self._run_ended,
            # a run stands for itself: older data may come from another stage, or another day
            self._forget,
        )
        self._say('exciting', 0.0, 'asking the excitation for the programme')
        return 'the programme is asked for; see ~/status'

    def _run_ended(self, reason: str | None) -> None:
        if reason is not None:
            self._say('failed', 0.0, reason, ERROR)
            return
        try:
            self._identify('all')
        except PiezoIdentError as error:
            self._say('failed', 0.0, str(error), ERROR)

    def _identify(self, which: str) -> str:
        self._refuse_when_busy()
        if not self._capture.n:
            raise DataError(
                'nothing has been captured; start the excitation, call ~/run, or replay a bag'
            )
        self._using = self._capture.mark()
        job = identify_job(self._capture.snapshot(), settings_of(self.values), which, self._steps)
        self._doing = 'identification' if which == 'all' else f'identification of the {which}'
        self._say('identifying', 0.0, f'{self._capture.seconds:.3g} s were captured')
        self._start(job)
        return f'{self._doing} has begun; see ~/status'

    def _start(self, job: Callable[[Tick], Outcome | Judgement | str]) -> None:
        self._worker.start(self._helper.job(job), progress=self._progress, ended=self._ended)

    def _save(self) -> str:
        self._refuse_when_busy()
        found, folder = self._found, self.values['output']
        identified = None
        if found is not None and found.identification is not None and found.record is not None:
            identified = (found.identification, found.record)
        if identified is None and self._inquiry.diagnosis is None:
            raise PiezoIdentError('there is no model to save; call ~/identify or ~/run first')
        if not folder:
            raise PiezoIdentError("parameter 'output' is empty; set it to the folder to write to")
        check_folder(Path(folder))
        self._doing = 'saving'
        self._say('saving', 0.0, f'writing to {folder}')
        self._start(save_both_job(identified, self._inquiry.diagnosis, folder))
        return f'writing to {folder}; see ~/status'

    def _cancel(self) -> str:
        if self._drive.running:
            self._drive.stop()
            self._inquiry.drop()
            self._say('cancelled', 0.0, 'the excitation was asked to ramp to rest')
            return 'cancelled; the excitation ramps to rest'
        if not self._worker.busy:
            raise PiezoIdentError('nothing is at work')
        self._worker.cancel()
        return f'{self._doing} is being cancelled; see ~/status'

    def _clear(self) -> str:
        self._refuse_when_busy()
        seconds = self._capture.seconds
        self._forget()
        self._say('idle', 0.0, 'ready')
        return f'{seconds:.3g} s of capture forgotten'

    def _forget(self) -> None:
        self._capture.clear()
        self._inquiry.forget()
        self._steps = Steps()

    # diagnosis: what its inquiry asks for

    def _diagnose(self) -> str:
        self._refuse_when_busy()
        return f'{self._inquiry.begin()}; see ~/status'

    def may_ask(self) -> bool:
        """Return whether an excitation and a stage are there."""
        return self._drive.is_possible

    def ask(self, program: str, why: str, ended: Callable[[str | None], None]) -> None:
        """Have the excitation play a programme."""
        self._doing = why
        self._drive.start(program, self.values['excitation_limit'], ended)
        self._say('exciting', 0.0, why)

    def judge(self, job: Callable[[Tick], Judgement], seconds: float) -> None:
        """Have the helper do a job."""
        self._doing = 'diagnosis'
        self._say('diagnosing', 0.0, f'the model is judged by {seconds:.3g} s')
        self._start(job)

    def give_verdict(self, found: Judgement, notes: tuple[str, ...]) -> None:
        """Publish report and model, and say the sentence."""
        self._report.publish(String(data=found.report))
        if found.model != self._published:
            self._publish_model(found.model)
        message = '; '.join([found.message.rstrip('.'), *notes])
        self._say('done', 100.0, message, WARN if notes else OK)

    def fail(self, reason: str) -> None:
        """Say why there is no verdict."""
        self._say('failed', 0.0, reason, ERROR)

    def _publish_model(self, text: str) -> None:
        self._published = text
        self._model.publish(String(data=text))

    # work

    def _progress(self, step: str, share: float) -> None:
        state = {'saving': 'saving', 'diagnosis': 'diagnosing'}.get(self._doing, 'identifying')
        percent = 100.0 * share if state == 'saving' else share_of(step, share)
        self.report_status(state, percent, step)

    def _ended(self, result: Outcome | Judgement | str | None, error: Exception | None) -> None:
        # published by the executor, so that who hears of the end finds the worker free
        self._outcomes.append(functools.partial(self._conclude, result, error))
        self._wake.trigger()

    def _take_outcomes(self) -> None:
        while self._outcomes:
            self._worker.join(1.0)
            self._outcomes.popleft()()

    def _conclude(self, result: Outcome | Judgement | str | None, error: Exception | None) -> None:
        if error is not None:
            self._inquiry.drop()
        if isinstance(error, Cancelled):
            self._say('cancelled', 0.0, f'{self._doing} was cancelled; nothing was changed')
        elif isinstance(error, PiezoIdentError):
            self._say('failed', 0.0, ' '.join(str(error).split()), ERROR)
        elif error is not None:
            reason = f'{self._doing}: {type(error).__name__}: {error}'
            self.get_logger().error(reason)
            self._say('failed', 0.0, ' '.join(reason.split()), ERROR)
        elif isinstance(result, Outcome):
            self._steps = result.steps or self._steps
            self._report.publish(String(data=result.report))
            if result.model and result.identification is not None:
                self._found = result
                self._inquiry.take(result.identification.model, self._using)
                self._publish_model(result.model)
            count = result.warnings
            said = f'; {count} warning{"s" * (count > 1)} in the report' if count else ''
            message = result.message.rstrip('.') + said if count else result.message
            self._say('done', 100.0, message, WARN if count else OK)
        elif isinstance(result, Judgement):
            self._inquiry.weigh(result)
        else:
            self._say('done', 100.0, f'written: {result}')

    # end and diagnostics

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return how the capture goes."""
        now, passed = time.monotonic(), self._passed.get('voltage', 0)
        rate = (passed - self._counted) / max(now - self._counted_at, 1e-3)
        self._counted, self._counted_at = passed, now
        capture = self._capture
        values: dict[str, object] = {
            'state': self._state,
            'rate': f'{rate:.0f}',
            'samples': min(passed, self._passed.get('displacement', 0)),
            'captured': f'{capture.seconds:.3f}',
            'topics': self._kept(),
            'segments': ' '.join(capture.segments),
            'room': f'{max(capture.limit - capture.seconds, 0.0):.1f}',
            'lost': sum(capture.lost.values()),
        }
        problems = capture.problems
        if problems:
            return WARN, '; '.join(problems), values
        return OK, self._doing if self._worker.busy else 'listening', values

    def close(self) -> None:
        """Cancel what is at work, and ask the excitation to ramp to rest."""
        if self._drive.running:
            self._drive.stop()
        if self._worker.busy:
            self._worker.cancel()
            self._worker.join(PATIENCE)
            self._say('cancelled', 0.0, 'the node ends')
        self._helper.close()


def main(argv: list[str] | None = None) -> int:
    """Run the node."""
    return run(IdentifierNode, argv)


if __name__ == '__main__':
    raise SystemExit(main())

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Identifier node: captures the streams of a stage, and identifies and diagnoses its model.

A timer takes the blocks of `voltage`, `displacement`, `applied_voltage`, further axes and channels
from their subscriptions every `DRAIN`, and adds them to the capture.  A service starts a job on
the capture in the worker process.  ``~/run`` and ``~/diagnose`` also have the excitation play a
program.  The executor publishes the result of a job on `model`, `report` and ``~/status``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
import functools
from pathlib import Path
import time
from typing import Any

from piezo_ident.cli.files import check_folder
from piezo_ident.common.errors import Cancelled, DataError, PiezoIdentError
from piezo_ident.common.process import Tick
from piezo_ident.identification.results import Identification, Steps
from piezo_ident.live.capture import Capture
from piezo_ident.live.pacing import Rate
from piezo_ident.model.axes_file import load
from piezo_ident.model.multi_axis import each_of, EachAxis
from piezo_ident.nodes.identifier import jobs
from piezo_ident.nodes.identifier.diagnosis_session import DiagnosisSession
from piezo_ident.nodes.identifier.excitation_client import Ended, ExcitationClient
from piezo_ident.nodes.identifier.inputs import Inputs
from piezo_ident.nodes.identifier.jobs import DiagnosisOutcome, IdentificationOutcome
from piezo_ident.nodes.identifier.worker import Worker
from piezo_ident.nodes.lab_node import ERROR, LabNode, OK, WARN
from piezo_ident.nodes.parameter_node import home_problem
from piezo_ident.nodes.parameters import NODES
from piezo_ident.nodes.subscriptions import topics_problem
from piezo_ident.nodes.wire import LATCHED
from std_msgs.msg import String

Result = IdentificationOutcome | DiagnosisOutcome | str

#: time between two polls of the excitation [s]
POLL = 0.05
#: time between two reports of the length of the capture [s]
TELL = 0.5
#: time between two emptyings of the subscriptions [s]
DRAIN = 0.02
#: longest wait for the end of the work when the node ends [s]
PATIENCE = 0.6


class IdentifierNode(LabNode):
    """Captures, identifies, diagnoses, and publishes model and report."""

    executable = 'identifier'

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._capture = Capture(self.values['capture_limit'])
        self._worker = Worker(self.values['nice'], jobs.warm_up)
        self._outcomes: deque[Callable[[], None]] = deque()
        self._state, self._task, self._reported_at = 'idle', '', 0.0
        self._steps = Steps()
        self._identified: Identification | EachAxis[Identification] | None = None
        self._axes = [name for name in self.values['axes'] if name]
        self._session = DiagnosisSession(self, self._capture)
        # mark of the capture of the running identification, and the last published model
        self._using, self._published = dict[str, int](), ''
        if path := self.values['model']:
            self._session.take(load(path), {}, is_file=True)
        self._rate = Rate()
        self._model = self.create_publisher(String, 'model', LATCHED)
        self._report = self.create_publisher(String, 'report', LATCHED)
        topics = [f'{what}_{x}' for x in self._axes for what in ('voltage', 'displacement')]
        topics += filter(None, self.values['channels'])
        self._inputs = Inputs(self, self._capture, list(dict.fromkeys(topics)))
        self._excitation = ExcitationClient(
            self, self._inputs.streams, lambda: self._inputs.unpublished
        )
        self.create_timer(DRAIN, self._drain)
        self.create_timer(POLL, self._poll)
        self._wake = self.create_guard_condition(self._take_outcomes)
        self.offer('identify', functools.partial(self._identify, 'all'))
        for step in ('delay', 'dynamics', 'hysteresis'):
            self.offer(f'identify_{step}', functools.partial(self._identify, step))
        for name in ('run', 'diagnose', 'cancel', 'clear', 'save'):
            self.offer(name, getattr(self, f'_{name}'))

    # parameters

    def refuse(self, name: str, value: Any) -> str | None:
        """Refuse values that the settings would refuse later."""
        if name == 'thresholds':
            jobs.settings_of({**{d.name: d.default for d in NODES['identifier']}, name: value})
        if name == 'output':
            return 'output is blank; name a folder' if value.isspace() else home_problem(value)
        if name == 'channels' and (topics := list(filter(None, value))):
            return topics_problem(topics, name)
        if name.endswith('program') and not value.strip():
            return f'{name} must not be empty; name a program, a path, or write YAML'
        if name == 'model' and (value or self.values.get(name)):
            if self._is_busy():
                return f'busy: {self._task}; set the model when that has ended, or call ~/cancel'
            try:
                if value:
                    load(value)
            except PiezoIdentError as error:
                return f'model: {error}'
        return None

    def apply(self, changed: Mapping[str, Any]) -> None:
        """Apply the limit of the capture and the model; the rest is read when work begins."""
        if 'capture_limit' in changed:
            self._capture.limit = changed['capture_limit']
        if path := changed.get('model'):
            # some milliseconds; nothing is compiled before a diagnosis
            self._session.take(load(path), {}, is_file=True)
            self._published = ''
        elif path is not None:
            self._session.leave_file()

    # topics

    def _drain(self) -> None:
        # blocks wait for the answer to the start: an accepted start clears the earlier capture
        self._inputs.drain(hold=self._excitation.is_starting)

    def _poll(self) -> None:
        if self._excitation.running:
            # a run may end once all its blocks are captured
            self._drain()
        self._excitation.poll()
        if waits_for := self._excitation.waits_for:
            # the capture is still the earlier one
            self._set_state('exciting', 0.0, f'{self._task}: {waits_for}')
        elif self._excitation.running:
            segment = f', in segment {self._capture.segment}' if self._capture.segment else ''
            about = f'{self._capture.seconds:.0f} s captured{segment}'
            text, brief = f'{self._task}: {about}', f'{about}: {self._task}'
            self._report_capture('exciting', self._excitation.progress, text, brief)
        elif self._state == 'idle' and time.monotonic() - self._reported_at > TELL:
            self._reported_at = time.monotonic()
            kept = f'{self._kept()} captured' if self._capture.keys else 'ready'
            self._report_capture('idle', 0.0, kept)

    def _report_capture(self, state: str, progress: float, text: str, brief: str = '') -> None:
        problems = self._capture.problems
        text, brief = ('; '.join([t, *problems]) if t else '' for t in (text, brief))
        more = {'brief': brief, 'problems': '; '.join(problems)}
        self._set_state(state, progress, text, WARN if problems else OK, **more)

    def _kept(self) -> str:
        keys = dict.fromkeys(('voltage', 'displacement', *self._capture.keys))
        return ', '.join(f'{self._capture.seconds_since({}, key):.3f} s of {key}' for key in keys)

    # services

    def offer(self, name: str, handler: Callable[[], str]) -> None:
        """Offer a service whose handler finds all blocks that came before the call."""

        def drained() -> str:
            self._drain()
            return handler()

        super().offer(name, drained)

    def _run(self) -> str:
        self._refuse_when_busy()
        jobs.settings_of(self.values)
        # the accepted start clears the capture: older data may come from another stage
        about = 'program for the identification'
        self.excite(self.values['program'], about, self._run_ended, self._forget)
        return 'the program is requested; see ~/status'

    def _run_ended(self, reason: str | None) -> None:
        if reason is not None:
            self.fail(reason)
            return
        try:
            self._identify('all')
        except Exception as error:  # noqa: BLE001  # the status must tell the end
            self.fail(self.reason(error))

    def _identify(self, which: str) -> str:
        self._refuse_when_busy()
        if self._axes and which != 'all':
            raise PiezoIdentError('single steps are for a stage of one axis; call ~/identify')
        if not self._capture.n:
            raise DataError(
                'nothing has been captured; start the excitation, call ~/run, or replay a bag'
            )
        self._using = self._capture.mark()
        snapshot, settings = self._capture.snapshot(), jobs.settings_of(self.values)
        more = which, self._steps, self._session.model, self._axes
        job = functools.partial(jobs.identify_capture, snapshot, settings, *more)
        self._task = 'identification' if which == 'all' else f'identification of the {which}'
        self._set_state('identifying', 0.0, f'{self._capture.seconds:.3g} s were captured')
        self._start(job)
        return f'{self._task} has begun; see ~/status'

    def _diagnose(self) -> str:
        self._refuse_when_busy()
        return f'{self._session.begin()}; see ~/status'

    def _save(self) -> str:
        self._refuse_when_busy()
        identified, folder = self._identified, Path(self.values['output']).expanduser().absolute()
        if identified is None and self._session.diagnosis is None:
            raise PiezoIdentError('there is no model to save; call ~/identify or ~/run first')
        if not self.values['output']:
            raise PiezoIdentError("parameter 'output' is empty; set it to the folder to write to")
        check_folder(folder)
        self._task = 'saving'
        self._set_state('saving', 0.0, f'writing to {folder}')
        self._start(functools.partial(jobs.save, identified, self._session.diagnosis, str(folder)))
        return f'writing to {folder}; see ~/status'

    def _cancel(self) -> str:
        if self._excitation.running:
            text = self._excitation.stop()
            self._session.drop()
            self._set_state('cancelled', 0.0, text)
            return f'cancelled; {text}'
        if not self._worker.is_busy:
            raise PiezoIdentError('there is no work to cancel')
        self._worker.cancel()
        return f'{self._task} is being cancelled; see ~/status'

    def _clear(self) -> str:
        self._refuse_when_busy()
        seconds = self._capture.seconds
        self._forget()
        self._set_state('idle', 0.0, 'ready')
        return f'{seconds:.3g} s of capture forgotten'

    def _forget(self) -> None:
        self._capture.clear()
        self._session.forget()
        self._steps = Steps()

    def _refuse_when_busy(self) -> None:
        if self._is_busy():
            raise PiezoIdentError(f'busy: {self._task}; wait for its end, or call ~/cancel')

    def _is_busy(self) -> bool:
        # false while `__init__` declares the parameters
        if not hasattr(self, '_excitation'):
            return False
        # a job has ended when its outcome is taken
        return self._excitation.running or self._worker.is_busy or bool(self._outcomes)

    # interface of the diagnosis session

    def can_excite(self) -> bool:
        """Return whether an excitation and a stage are present."""
        return self._excitation.is_possible

    def excite(
        self, program: str, why: str, ended: Ended, begin: Callable[[], None] | None = None
    ) -> None:
        """Play a program; `ended` gets None for a complete capture, else the reason."""
        self._task = why
        self._excitation.start(program, self.values['excitation_limit'], ended, begin)
        self._set_state('exciting', 0.0, why)

    def start_diagnosis(self, job: Callable[[Tick], DiagnosisOutcome], seconds: float) -> None:
        """Start the job of a diagnosis; `DiagnosisSession.take_outcome` gets its result."""
        self._task = 'diagnosis'
        self._set_state('diagnosing', 0.0, f'the model is tested on {seconds:.3g} s')
        self._start(job)

    def conclude(self, outcome: DiagnosisOutcome, notes: tuple[str, ...]) -> None:
        """Publish report, model and verdict, with notes on open questions."""
        self._report.publish(String(data=outcome.report))
        if outcome.model != (self._published or outcome.judged):
            self._publish_model(outcome.model)
        count = outcome.warnings
        text = jobs.with_warnings('; '.join([outcome.message.rstrip('.'), *notes]), count)
        level, brief = WARN if notes or count else OK, jobs.with_warnings(outcome.brief, count)
        figures = {**outcome.figures, 'warnings': count}
        self._set_state('done', 100.0, text, level, brief=brief, **figures)

    def fail(self, reason: str) -> None:
        """Report why the work failed."""
        self._set_state('failed', 0.0, reason, ERROR)

    # jobs of the worker process

    def _start(self, job: Callable[[Tick], Result]) -> None:
        self._worker.start(job, progress=self._progress, ended=self._ended)

    def _progress(self, step: str, share: float) -> None:
        state = {'saving': 'saving', 'diagnosis': 'diagnosing'}.get(self._task, 'identifying')
        axes = ['y', *(f'y_{name}' for name in self._axes)]
        percent = 100.0 * share if state == 'saving' else jobs.percent_of(step, share, axes)
        self.report_status(state, percent, step, brief=f'{percent:.0f} %: {step}')

    def _ended(self, result: Result | None, error: Exception | None) -> None:
        # runs in the thread of the worker; the executor publishes the result
        self._outcomes.append(functools.partial(self._conclude, result, error))
        self._wake.trigger()

    def _take_outcomes(self) -> None:
        while self._outcomes:
            self._worker.join(1.0)
            try:
                self._outcomes.popleft()()
            except Exception as error:  # noqa: BLE001  # the status must tell the end
                self.fail(self.reason(error))

    def _conclude(self, result: Result | None, error: Exception | None) -> None:
        if error is not None:
            self._session.drop()
        if isinstance(error, Cancelled):
            what = 'nothing was changed' if self._task != 'saving' else 'files may be replaced'
            self._set_state('cancelled', 0.0, f'{self._task} was cancelled; {what}')
        elif error is not None:
            self.fail(' '.join(self.reason(error).split()))
        elif isinstance(result, IdentificationOutcome):
            self._steps = result.steps or self._steps
            self._report.publish(String(data=result.report))
            if result.identification is not None:
                self._publish_model(result.model)
                self._identified = identified = result.identification
                self._session.take(identified.model, self._using)
                each = each_of(identified).values()
                for warning in dict.fromkeys(w for x in each for w in x.warnings):
                    self.journal.tell(warning, WARN)
            n = result.warnings
            text, brief = (jobs.with_warnings(t, n) for t in (result.message, result.brief))
            level, figures = WARN if n else OK, {**result.figures, 'warnings': n}
            self._set_state('done', 100.0, text, level, brief=brief, **figures)
        elif isinstance(result, DiagnosisOutcome):
            self._session.take_outcome(result)
        else:
            self._set_state('done', 100.0, f'written: {result}')

    def _publish_model(self, text: str) -> None:
        self._published = text
        self._model.publish(String(data=text))

    # reports

    def _set_state(
        self, state: str, progress: float, text: str, level: bytes = OK, **more: Any
    ) -> None:
        self._state = state
        self.report_status(state, progress, text, level, **more)

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return the state of the capture."""
        passed, capture = self._inputs.passed, self._capture
        values: dict[str, object] = {
            'state': self._state,
            'rate': f'{self._rate.of(passed["voltage"]):.0f}',
            'samples': min(passed['voltage'], passed['displacement']),
            'captured': f'{capture.seconds:.3f}',
            'topics': self._kept(),
            'segments': ' '.join(capture.segments),
            'room': f'{max(capture.limit - capture.seconds, 0.0):.1f}',
            'lost': sum(capture.lost.values()),
        }
        problems = capture.problems
        message = self._task if self._worker.is_busy else 'listening'
        return (WARN if problems else OK), '; '.join(problems) or message, values

    def close(self) -> None:
        """Cancel the work and have the excitation ramp to rest."""
        self._excitation.stop()
        if (start := self._excitation.left) is not None and self.executor is not None:
            # the answer tells whether there is a program to stop
            self.executor.spin_until_future_complete(start, PATIENCE)
        if self._worker.is_busy:
            self._worker.cancel()
            self._worker.join(PATIENCE)
            self._set_state('cancelled', 0.0, 'the node ends')
        self._worker.close()

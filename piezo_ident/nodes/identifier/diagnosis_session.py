# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Diagnose the model by the capture, request the deciding motion, and diagnose again."""

from __future__ import annotations

from collections.abc import Mapping
import functools
from typing import TYPE_CHECKING

from piezo_ident.common.errors import DataError, PiezoIdentError
from piezo_ident.diagnosis import Diagnosis, DiagnosisSettings
from piezo_ident.diagnosis.next_experiment import Experiment, Kind, next_experiment
from piezo_ident.live.capture import Capture
from piezo_ident.model.multi_axis import EachAxis, MultiAxisModel
from piezo_ident.model.stage_model import StageModel
from piezo_ident.nodes.identifier.jobs import diagnose_capture, DiagnosisOutcome

if TYPE_CHECKING:
    from piezo_ident.nodes.identifier.node import IdentifierNode


class DiagnosisSession:
    """
    One ``~/diagnose``: diagnoses, and requests of motion from the excitation between them.

    A request follows while a question is open and requests are left.  Each diagnosis judges the
    same `model` by all later data; `diagnosis` is the last result.
    """

    def __init__(self, host: IdentifierNode, capture: Capture) -> None:
        self._host, self._capture = host, capture
        self.model: StageModel | MultiAxisModel | None = None
        self.diagnosis: Diagnosis | EachAxis[Diagnosis] | None = None
        # mark of the end of the samples that the model was identified from
        self._used: Mapping[str, int] = {}
        # the identified model and its mark, also while a model file replaces them
        self._own: tuple[StageModel | MultiAxisModel | None, Mapping[str, int]] = (None, {})
        self.drop()

    def take(
        self, model: StageModel | MultiAxisModel, used: Mapping[str, int], *, is_file: bool = False
    ) -> None:
        """Take another model, identified from the samples up to the `Capture.mark` `used`."""
        self.model, self.diagnosis, self._used = model, None, used
        if not is_file:
            self._own = model, used

    def leave_file(self) -> None:
        """Take the identified model, or None, in place of the model of a file."""
        model, used = self._own
        if self.model is not model:
            self.model, self.diagnosis, self._used = model, None, used

    def forget(self) -> None:
        """Forget the marks of a capture that was cleared."""
        self._used, self._own = {}, (self._own[0], {})

    def drop(self) -> None:
        """End the present session without a result."""
        self._requested: list[Kind] = []
        self._last: DiagnosisOutcome | None = None
        self._notes: list[str] = []

    @property
    def seconds(self) -> float:
        """Length of the capture after the samples of the identification [s]."""
        keys = ('voltage', 'displacement')
        return min(self._capture.seconds_since(self._used, key) for key in keys)

    def begin(self) -> str:
        """
        Begin a session; return a message about its first step.

        PiezoIdentError without a model, or without both later data and an excitation.
        """
        self.drop()
        if self.model is None:
            raise PiezoIdentError(
                "there is no model to diagnose; call ~/run or ~/identify first, or set 'model'"
            )
        if self.seconds:
            self._diagnose(self.model)
            return 'diagnosis has begun'
        wanted, hindrance = next_experiment(None), self._hindrance()
        if wanted is None or hindrance:
            raise DataError(
                'nothing was captured except what the model was identified from; play another '
                f'program, or replay a bag ({hindrance})'
            )
        self._request(wanted)
        return self._reason(wanted)

    def _hindrance(self) -> str:
        """Return the reason against a request to the excitation, or ''."""
        most = self._host.values['requests']
        if len(self._requested) >= most:
            return f'no more than {most} requests are allowed'
        return '' if self._host.can_excite() else 'there is no excitation or no stage'

    def _diagnose(self, model: StageModel | MultiAxisModel) -> None:
        settings = DiagnosisSettings(seed=self._host.values['seed'])
        snapshot = self._capture.snapshot(self._used)
        job = functools.partial(
            diagnose_capture, snapshot, model, tuple(self._requested), settings
        )
        self._host.start_diagnosis(job, self.seconds)

    def _request(self, wanted: Experiment) -> None:
        self._requested.append(wanted.kind)
        program = self._host.values[f'{wanted.kind}_program']
        self._host.excite(program, self._reason(wanted), self._excited)

    @staticmethod
    def _reason(wanted: Experiment) -> str:
        return f'asking for {wanted.kind}: {wanted.reason}'

    def _excited(self, reason: str | None) -> None:
        if reason is None and self.model is not None:
            self._diagnose(self.model)
        elif self._last is None:
            self._host.fail(f'there is nothing to diagnose: {reason}')
        else:
            self._notes.append(f'{self._requested[-1]} were requested in vain: {reason}')
            self._conclude(self._last)

    def take_outcome(self, outcome: DiagnosisOutcome) -> None:
        """Take the result of a diagnosis; request a further experiment, or conclude."""
        if outcome.diagnosis is not None:
            self._last = outcome
        wanted, hindrance = outcome.wanted, self._hindrance()
        if wanted is not None and not hindrance:
            self._request(wanted)
        elif self._last is None:
            self._host.fail(
                f'there is nothing to diagnose: no motion was captured, and {hindrance}'
            )
        else:
            if wanted is not None:
                self._notes.append(f'{wanted.reason}, and {hindrance}')
            self._conclude(self._last)

    def _conclude(self, outcome: DiagnosisOutcome) -> None:
        self.diagnosis = outcome.diagnosis
        self._host.conclude(outcome, tuple(self._notes))

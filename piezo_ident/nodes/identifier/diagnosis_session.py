# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Diagnose a capture, request the motion that would decide, and diagnose again."""

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
    Diagnoses a model until no question is open or no request is left.

    Each diagnosis begins with the same `model`; `diagnosis` is the last result.
    """

    def __init__(self, host: IdentifierNode, capture: Capture) -> None:
        self._host, self._capture = host, capture
        self.model: StageModel | MultiAxisModel | None = None
        self.diagnosis: Diagnosis | EachAxis[Diagnosis] | None = None
        # the mark up to which samples went into the model, and cannot test it
        self._used: Mapping[str, int] = {}
        # the identified model and its mark, also while a model file replaces them
        self._own: tuple[StageModel | MultiAxisModel | None, Mapping[str, int]] = (None, {})
        self.drop()

    def take(
        self, model: StageModel | MultiAxisModel, used: Mapping[str, int], *, is_file: bool = False
    ) -> None:
        """
        Take another model to diagnose.

        `used` is the `Capture.mark` up to which the capture served to identify the model.
        """
        self.model, self.diagnosis, self._used = model, None, used
        if not is_file:
            self._own = model, used

    def leave_file(self) -> None:
        """Take the identified model in place of the model of a file; without one, none."""
        model, used = self._own
        if self.model is not model:
            self.model, self.diagnosis, self._used = model, None, used

    def forget(self) -> None:
        """Note that the capture was cleared."""
        self._used, self._own = {}, (self._own[0], {})

    def drop(self) -> None:
        """Give up the session under way."""
        self._requested: list[Kind] = []
        self._last: DiagnosisOutcome | None = None
        self._notes: list[str] = []

    @property
    def seconds(self) -> float:
        """Length of the capture that the identification did not use [s]."""
        keys = ('voltage', 'displacement')
        return min(self._capture.seconds_since(self._used, key) for key in keys)

    def begin(self) -> str:
        """
        Begin; return a message about the first step.

        PiezoIdentError without a model, or without both data and an excitation.
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
        return '' if self._host.can_excite() else 'there is no excitation and no stage'

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
        """Request the experiment that would decide an open question, or conclude."""
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

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""The course of a ``~/diagnose``: judge, ask for what would decide, judge again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from piezo_ident.common.errors import DataError, PiezoIdentError
from piezo_ident.diagnosis import Diagnosis, DiagnosisSettings
from piezo_ident.diagnosis.next_experiment import Experiment, Kind, next_experiment
from piezo_ident.model.stage_model import StageModel
from piezo_ident.nodes.diagnosis_jobs import diagnose_job, Judgement
from piezo_ident.nodes.jobs import Tick
from piezo_ident.record.capture import Capture

__all__ = ['Host', 'Inquiry']


class Host(Protocol):
    """What an inquiry has done for it."""

    values: dict[str, Any]

    def may_ask(self) -> bool:
        """Return whether an excitation and a stage are there."""

    def ask(self, program: str, why: str, ended: Callable[[str | None], None]) -> None:
        """Have a programme played; `ended` gets None, or why it was not captured to its end."""

    def judge(self, job: Callable[[Tick], Judgement], seconds: float) -> None:
        """Have a job done whose result comes to `Inquiry.weigh`."""

    def give_verdict(self, found: Judgement, notes: tuple[str, ...]) -> None:
        """Publish what was found in the end, with what stands in its way."""

    def fail(self, reason: str) -> None:
        """Say that there is no verdict."""


class Inquiry:
    """
    Asks what a model lacks, over and over, always from the model as it was identified.

    Parameters
    ----------
    host : Host
    capture : Capture

    Attributes
    ----------
    given : StageModel or None
        The model that is judged.
    diagnosis : Diagnosis or None
        The last one of this model.
    """

    def __init__(self, host: Host, capture: Capture) -> None:
        self._host, self._capture = host, capture
        self.given: StageModel | None = None
        self.diagnosis: Diagnosis | None = None
        # what was captured up to here went into the model, and cannot judge it
        self._used: Mapping[str, int] = {}
        self.drop()

    def take(self, model: StageModel, used: Mapping[str, int]) -> None:
        """
        Take another model to judge.

        Parameters
        ----------
        model : StageModel
        used : mapping
            From `Capture.mark`, when the capture up to then went into the model.
        """
        self.given, self.diagnosis, self._used = model, None, used

    def forget(self) -> None:
        """Know that the capture was cleared."""
        self._used = {}

    def drop(self) -> None:
        """Give up what is under way."""
        self._asked: list[Kind] = []
        self._found: Judgement | None = None
        self._notes: list[str] = []

    @property
    def seconds(self) -> float:
        """The time that was captured and did not go into the model [s]."""
        keys = ('voltage', 'displacement')
        return min(self._capture.seconds_since(self._used, key) for key in keys)

    def begin(self) -> str:
        """
        Begin, and return what is done first.

        Raises
        ------
        PiezoIdentError
            When there is no model, or no data and nobody to ask for them.
        """
        self.drop()
        if self.given is None:
            raise PiezoIdentError(
                "there is no model to judge; call ~/run or ~/identify first, or set 'model'"
            )
        if self.seconds:
            self._judge(self.given)
            return 'diagnosis has begun'
        wanted, hindrance = next_experiment(None), self._hindrance()
        if wanted is None or hindrance:
            raise DataError(
                'nothing was captured beside what the model was identified from; play another '
                f'programme, or replay a bag ({hindrance})'
            )
        self._ask(wanted)
        return self._reason(wanted)

    def _hindrance(self) -> str:
        """Return why the excitation is not asked, empty when it can be."""
        most = self._host.values['requests']
        if len(self._asked) >= most:
            return f'no more than {most} requests are allowed'
        return '' if self._host.may_ask() else 'no excitation and stage are there to be asked'

    def _judge(self, given: StageModel) -> None:
        settings = DiagnosisSettings(seed=self._host.values['seed'])
        snapshot = self._capture.snapshot(self._used)
        self._host.judge(diagnose_job(snapshot, given, tuple(self._asked), settings), self.seconds)

    def _ask(self, wanted: Experiment) -> None:
        self._asked.append(wanted.kind)
        program = self._host.values[f'{wanted.kind}_program']
        self._host.ask(program, self._reason(wanted), self._answered)

    @staticmethod
    def _reason(wanted: Experiment) -> str:
        return f'asking for {wanted.kind}: {wanted.reason}'

    def _answered(self, reason: str | None) -> None:
        if reason is None and self.given is not None:
            self._judge(self.given)
        elif self._found is None:
            self._host.fail(f'there is nothing to judge: {reason}')
        else:
            self._notes.append(f'{self._asked[-1]} were asked for in vain: {reason}')
            self._conclude(self._found)

    def weigh(self, found: Judgement) -> None:
        """Ask for what would decide what is open, or give the verdict."""
        if found.diagnosis is not None:
            self._found = found
        wanted, hindrance = found.wanted, self._hindrance()
        if wanted is not None and not hindrance:
            self._ask(wanted)
        elif self._found is None:
            why = f'what was captured holds no motion, and {hindrance}'
            self._host.fail(f'there is nothing to judge: {why}')
        else:
            if wanted is not None:
                self._notes.append(f'{wanted.reason}, and {hindrance}')
            self._conclude(self._found)

    def _conclude(self, found: Judgement) -> None:
        self.diagnosis = found.diagnosis
        self._host.give_verdict(found, tuple(self._notes))

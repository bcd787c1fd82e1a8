# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A diagnosis session without a graph: diagnose, request, diagnose again, conclude."""

from dataclasses import replace
import itertools

from diagnosis_examples import example, measured
import numpy as np
from piezo_ident.common.errors import DataError, PiezoIdentError
from piezo_ident.diagnosis.next_experiment import Experiment
from piezo_ident.live.capture import Capture, records_of_runs
from piezo_ident.model.files import model_to_yaml
from piezo_ident.nodes.identifier.diagnosis_session import DiagnosisSession
from piezo_ident.nodes.identifier.jobs import diagnose_capture, DiagnosisOutcome
from piezo_ident.record.blocks import cut_blocks, Samples
from piezo_ident.record.record import Piece, Record
from piezo_ident.report.json_data import json_text
from programs import slow_model
import pytest

HOLDS = Experiment('holds', 'this and that cannot be told apart')
SWEEPS = Experiment('sweeps', 'this cannot be tested')


def feed(capture, record, at=0):
    """Let a capture hear a record."""
    (piece,) = record
    for start, stop, label in cut_blocks(piece.n, piece.segments, 500):
        t = piece.t[start:stop]
        capture.add('voltage', Samples(t, piece.v[start:stop], label, 'voltage'), at)
        capture.add('displacement', Samples(t, piece.y[start:stop], label, 'displacement'), at)


class Lab:
    """A host that plays what is requested and keeps a log."""

    def __init__(self, requests=2, there=True, refusal=None):
        self.values = {
            'requests': requests,
            'seed': 0,
            'sweeps_program': 'diagnosis',
            'holds_program': 'holds',
        }
        self.there, self.refusal = there, refusal
        self.capture = Capture()
        self.session = DiagnosisSession(self, self.capture)
        self.log, self.end, self.clock = [], None, itertools.count(1)
        self.jobs, self.answers = [], []

    def can_excite(self):
        return self.there

    def excite(self, program, why, ended):
        self.log.append(why)
        self.answers.append((program, ended))

    def start_diagnosis(self, job, seconds):
        self.log.append('diagnosing')
        self.jobs.append((job.args, seconds))

    def conclude(self, outcome, notes):
        self.end = (outcome, notes)

    def fail(self, reason):
        self.end = reason

    def play(self):
        """Answer what was asked last."""
        _, ended = self.answers[-1]
        if self.refusal is None:
            feed(self.capture, measured(), next(self.clock))
        ended(self.refusal)


@pytest.fixture
def lab():
    lab = Lab()
    lab.session.take(slow_model(), {})
    return lab


def outcome_of(verdict, wanted=None):
    found = example(verdict)
    return DiagnosisOutcome(
        found.sentence,
        report=json_text(found),
        model=model_to_yaml(found.model),
        diagnosis=found,
        wanted=wanted,
    )


def test_without_a_model_or_data_and_an_excitation_it_refuses(lab):
    with pytest.raises(PiezoIdentError, match=r"~/identify .*'model'"):
        Lab().session.begin()
    lab.there = False
    with pytest.raises(DataError, match=r'excitation .* stage\)'):
        lab.session.begin()
    lab.there, lab.values['requests'] = True, 0
    with pytest.raises(DataError, match='no more than 0 requests'):
        lab.session.begin()
    assert not lab.log


def test_what_the_model_was_made_from_does_not_judge_it(lab):
    feed(lab.capture, measured())
    lab.session.take(slow_model(), lab.capture.mark())
    assert lab.session.begin().startswith('asking for sweeps')
    lab.play()
    (snapshot, given, asked, _), seconds = lab.jobs[-1]
    assert given is slow_model() and asked == ('sweeps',)
    assert seconds == pytest.approx(measured().duration, abs=0.01)
    assert snapshot.record().n == measured().n


def test_without_a_file_the_identified_model_is_judged_or_none():
    lab = Lab()
    lab.session.take(slow_model(), {}, is_file=True)
    lab.session.leave_file()
    with pytest.raises(PiezoIdentError, match=r"~/identify .*'model'"):
        lab.session.begin()
    feed(lab.capture, measured())
    own = replace(slow_model())
    lab.session.take(own, lab.capture.mark())
    lab.session.take(slow_model(), {}, is_file=True)
    assert lab.session.seconds > 0.0
    lab.session.leave_file()
    # the data that the model was made from do not judge it
    assert lab.session.model is own and lab.session.seconds == 0.0
    # without a file there is none to leave
    lab.session.diagnosis = 'kept'
    lab.session.leave_file()
    assert lab.session.diagnosis == 'kept'


def test_it_judges_asks_judges_everything_and_concludes(lab):
    feed(lab.capture, measured())
    assert lab.session.begin() == 'diagnosis has begun'
    lab.session.take_outcome(outcome_of('class', HOLDS))
    assert lab.log == ['diagnosing', 'asking for holds: this and that cannot be told apart']
    assert lab.end is None and lab.answers[-1][0] == 'holds'
    lab.play()
    (snapshot, given, asked, _), _ = lab.jobs[-1]
    assert given is slow_model() and asked == ('holds',)
    assert snapshot.record().n == 2 * measured().n
    last = outcome_of('named')
    lab.session.take_outcome(last)
    assert lab.end == (last, ()) and lab.session.diagnosis is last.diagnosis


def test_requests_are_bounded(lab):
    lab.session.begin()
    lab.play()
    lab.session.take_outcome(outcome_of('class', HOLDS))
    lab.play()
    last = outcome_of('class', SWEEPS)
    lab.session.take_outcome(last)
    assert len(lab.answers) == 2
    assert lab.end == (last, ('this cannot be tested, and no more than 2 requests are allowed',))
    lab.end = None
    lab.session.begin()
    lab.session.take_outcome(outcome_of('class', HOLDS))
    assert lab.end is None and len(lab.answers) == 3


def test_an_excitation_that_refuses_or_is_gone_leaves_the_verdict_as_it_is(lab):
    feed(lab.capture, measured())
    first = outcome_of('class', HOLDS)
    lab.session.begin()
    lab.session.take_outcome(first)
    lab.refusal = 'the excitation does not start: another one plays'
    lab.play()
    assert lab.end[0] is first
    assert lab.end[1] == (
        'holds were requested in vain: the excitation does not start: another one plays',
    )
    lab.there = False
    lab.session.begin()
    lab.session.take_outcome(first)
    assert lab.end[0] is first
    assert lab.end[1] == (
        'this and that cannot be told apart, and there is no excitation or no stage',
    )


def test_without_any_data_a_refusal_is_a_failure(lab):
    lab.refusal = 'no sign'
    lab.session.begin()
    lab.play()
    assert 'no sign' in lab.end


def test_a_capture_without_motion_asks_and_fails_where_nobody_can_be_asked(lab):
    (piece,) = measured()
    still = Record((Piece(np.zeros(4000), piece.y[:4000], piece.sample_rate),))
    feed(lab.capture, still)
    found = diagnose_capture(lab.capture.snapshot(), slow_model(), (), None, lambda *_: None)
    assert found.diagnosis is None and found.wanted.kind == 'sweeps'
    lab.session.begin()
    lab.session.take_outcome(found)
    assert len(lab.answers) == 1
    lab.there = False
    lab.session.begin()
    lab.session.take_outcome(found)
    assert 'no motion' in lab.end


def test_another_model_forgets_the_verdict(lab):
    feed(lab.capture, measured())
    lab.session.begin()
    lab.session.take_outcome(outcome_of('named'))
    lab.session.take(slow_model(), lab.capture.mark())
    assert lab.session.diagnosis is None and not lab.session.seconds
    lab.capture.clear()
    lab.session.forget()
    feed(lab.capture, measured())
    assert lab.session.seconds == pytest.approx(measured().duration, abs=0.01)


def test_runs_of_the_clock_are_records_of_their_own():
    capture = Capture()
    for i in range(3):
        feed(capture, measured(), i)
    records = records_of_runs(capture.record('capture'))
    assert [r.name for r in records] == ['capture 1', 'capture 2', 'capture 3']
    assert [r.n for r in records] == [measured().n] * 3
    assert [r.name for r in records_of_runs(measured())] == [measured().name]

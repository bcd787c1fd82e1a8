# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Promises: what another record of the same motion, and of other motion, will show."""

from dataclasses import replace
import functools

import numpy as np
from paper_stage import FS, PAPER
from piezo_ident import report
from piezo_ident.diagnosis.results import DiagnosisSettings, REFITTED
from piezo_ident.identification.results import Settings
from piezo_ident.record.record import Piece, Record, Segment
from piezo_ident.report.refined import validated
from piezo_ident.selection.judged import Judged, JudgedRun, Promise
from piezo_ident.uncertainty.band import KEY
from piezo_ident.uncertainty.promises import promised_identification
from piezo_ident.verbs.learn import diagnose, identify
import pytest

N = 24_000


def motion():
    t = np.arange(N) / FS
    slow, fast = 2.5 * (1 - np.cos(2 * np.pi * 5 * t)), 0.8 * np.sin(2 * np.pi * 130 * t)
    return slow * (1.0 + np.floor(4 * t) % 2) + np.where(t > 0.4, fast, 0.0) * (t < 1.0)


def record(hum, phase=0.0, seed=0):
    t, v = np.arange(N) / FS, np.clip(motion(), 0.0, 10.0)
    noise = 2e-9 * np.random.default_rng(seed).standard_normal(N)
    y = PAPER.simulate(v) + noise + hum * np.sin(2 * np.pi * 50.0 * t + phase)
    return Record.from_arrays(v, y, sample_rate=FS, name=f'record {seed}')


@functools.cache
def diagnosis(hum):
    few = DiagnosisSettings(effects=('periodic_disturbance', 'backlash'))
    return diagnose(PAPER, record(hum), few)


def test_hum_that_was_found_is_promised_to_the_next_record():
    hum = 2e-7
    result = diagnosis(hum)
    assert [e.name for e in result.effects] == ['periodic_disturbance']
    other = result.model.score(record(hum, 1.0, seed=1)).percent
    assert result.after.overall < 0.1 * other
    assert 0.8 < other / result.promise.same < 1.25
    assert result.promise.told in result.sentence


def test_nothing_missing_promises_the_noise():
    result = diagnosis(0.0)
    other = result.model.score(record(0.0, seed=1)).percent
    assert 0.8 < other / result.promise.same < 1.25
    assert set(result.model.identification[KEY]) == {'coefficients', 'ratios', 'speed'}


def test_promise_and_weights_are_in_the_json_and_the_page():
    result = diagnosis(2e-7)
    data = report.to_json(result)
    assert data['schema_version'] == 2
    assert data['promise']['same_motion'] == result.promise.same
    assert sum(data['weights'].values()) == pytest.approx(1.0)
    assert 'none of these' in report.to_json(diagnosis(0.0))['weights']
    text = ' '.join(report.diagnosis_text(result).split())
    assert result.promise.told in text and '█' in text


def test_every_set_of_changes_has_an_error_of_each_kind():
    errors = diagnosis(0.0).errors_of_sets
    assert {(), (REFITTED,)} <= set(errors)
    kinds = {len(own) for own in errors.values()}
    assert len(kinds) == 1 and kinds.pop() > 2
    # nothing is missing, so a tenth of the noise, 2e-9 of a stroke of 1e-5, is left
    assert 0.0 < max(errors[()]) < 0.05


def swept(frequency, seed=4):
    t = np.arange(6000) / 2000.0
    v = 5.0 - 5.0 * np.cos(2 * np.pi * frequency(t) * t)
    y = 1e-6 * v + 1e-7 * np.abs(np.sin(v))
    noise = 3e-9 * np.random.default_rng(seed).standard_normal(v.size)
    return Record.from_arrays(v, y + noise, sample_rate=2000.0)


QUICK = Settings(thresholds=6, order=(2, 2), delay=0)


@functools.cache
def of_sweep():
    """Return a sweep and what is identified from it."""
    record = swept(lambda t: 1.0 + t)
    return record, identify(record, QUICK)


def test_an_identification_promises_what_the_next_record_shows():
    _, result = of_sweep()
    other = result.model.score(swept(lambda t: 1.0 + t, seed=3)).percent
    assert 0.7 < other / result.promise.same < 1.3
    assert result.promise.told in ' '.join(report.identification_text(result).split())
    assert report.to_json(result)['promise']['other_motion'] == result.promise.other


def test_what_a_fitted_start_explains_is_not_promised():
    record, result = of_sweep()
    (piece,), use = record.pieces, np.ones(record.n, dtype=bool)
    # with the start of its own record the model errs by nothing
    run = JudgedRun(record.name, piece, piece.y, use, np.arange(record.n) > 3000)
    promise = promised_identification(result, Judged((run,))).promise
    assert 0.8 < promise.same / result.model.score(record).percent < 1.25


def test_a_known_zero_of_a_record_is_not_promised():
    one, other = of_sweep()[0], swept(lambda t: 2.0 + t)
    together = identify([other, one], QUICK).promise.same
    (p,) = other.pieces
    # a zero that does not show clearly beside the other errors
    moved = Record((replace(p, y=p.y + 0.02 * together * one.stroke),), 'moved')
    assert 0.8 < identify([moved, one], QUICK).promise.same / together < 1.25


def test_one_frequency_promises_nothing_of_other_motion():
    assert identify(swept(lambda t: 5.0), QUICK).promise.other is None
    assert of_sweep()[1].promise.other is not None


def test_a_measured_error_replaces_the_promise_of_a_diagnosis():
    result = validated(diagnosis(0.0), [record(0.0, seed=1)])
    text = ' '.join(report.diagnosis_text(result).split())
    assert result.promise.told not in text and result.unseen[0].record in text


def test_where_every_motion_was_fitted_the_error_of_other_motion_is_not_known():
    v = motion()[:1000]
    segments = (Segment('ramp', 0, 100), Segment('triangle', 100, 500), Segment('sine', 500, 1000))
    piece = Piece(v, 1e-6 * v, FS, segments=segments)
    outside = np.arange(v.size) >= 500
    run = JudgedRun('record', piece, piece.y, np.ones(v.size, dtype=bool), outside)
    assert Judged((run,)).tests_other_motion
    fitted = replace(run, held=np.arange(v.size) < 100)
    assert not Judged((fitted,)).tests_other_motion
    assert (
        'not known' in Promise(0.1, None).told
        and 'identification_loops' in Promise(0.1, None).told
    )

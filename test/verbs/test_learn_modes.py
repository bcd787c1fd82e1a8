# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""`identify` takes modes that axes share where they win, and `diagnose` leaves it at that."""

from dataclasses import replace
import functools
import json

import axes_scanner as scanner
import numpy as np
import piezo_ident as pi
from piezo_ident.diagnosis.shared_modes import Multisines
from piezo_ident.model.axes_file import text_of
from piezo_ident.model.axis_records import axis_record
from piezo_ident.model.metrics import expected_error, percent
from piezo_ident.model.multi_axis import judged_models
from piezo_ident.nodes.identifier import jobs
from piezo_ident.report.table import number
from piezo_ident.verbs import learn, learn_modes
from piezo_ident.verbs.learn_modes import _err_elsewhere, chains_were_kept
import pytest
from two_axes_record import FEW, measured, other


@functools.cache
def identified():
    return pi.identify(measured(), FEW, validation=[other()])


def refuse(*args, **options):
    raise AssertionError('shared modes are tried')


def sines_of_the_scanner(seed):
    """Return multisines of both axes of a stage of independent chains."""
    rng, parts = np.random.default_rng(seed), []
    t = np.arange(500) / scanner.RATE
    for amplitude in (1.0, 1.0, 4.0, 4.0):
        phases = rng.uniform(0, 2 * np.pi, (2, 40, 1))
        v = np.cos(4 * np.pi * np.arange(1, 41)[:, None] * t + phases).sum(axis=1)
        v *= amplitude / np.abs(v).max(axis=1, keepdims=True)
        parts.append(np.tile(v, 3))
    v, v_b = 5.0 + np.hstack(parts)
    labels = [f'multisine:{name}-{i}' for name in ('small', 'large') for i in (1, 2)]
    stage = pi.MultiAxisModel({a: scanner.scanner().own(a) for a in scanner.AXES})
    y = stage.simulate({'v': v, 'v_b': v_b})
    y = {a: x + 2e-9 * rng.standard_normal(x.size) for a, x in y.items()}
    return pi.Record.from_arrays(
        v,
        y['y'],
        sample_rate=scanner.RATE,
        channels={'v_b': v_b, 'y_b': y['y_b']},
        segments=(labels, [1500 * i for i in range(4)]),
        name='sines',
    )


def test_identify_takes_shared_modes_that_win():
    result = identified()
    assert result.modes is not None and result.model.modes is result.modes
    chains = pi.MultiAxisModel(result.model.axes)
    runs, of_chains = (pi.free_run(x, other()) for x in (result.model, chains))
    for axis, run in runs.items():
        assert run.errors.percent < 0.4 * of_chains[axis].errors.percent
        # the error held out is that of another record
        assert 0.5 < result[axis].error('held out') / result[axis].error('validation') < 2.0


def test_every_error_is_that_of_the_model():
    result = identified()
    for record in (measured(), other()):
        for axis, run in pi.free_run(result.model, record).items():
            seen = np.arange(record.n) >= run.late[0]
            own = [
                x for x in result[axis].errors if (x.data == 'validation') is (record is other())
            ]
            for row in (x for x in own if x.driven):
                (part,) = run.record.pieces[0].find(row.segment)
                e = (run.measured - run.predicted)[part.start : part.stop]
                e = e[seen[part.start : part.stop]]
                assert row.n == e.size
                expected = percent(np.sqrt(np.mean(e**2)), run.record.stroke)
                assert row.percent == pytest.approx(expected, rel=1e-9)
    data = {(x.record, x.segment): x.data for x in result['y'].errors}
    assert set(data.values()) == {'fitted', 'held out', 'validation'}
    held = [segment for (_, segment), kind in data.items() if kind == 'held out']
    assert sorted(x.rpartition('-')[0] for x in held) == ['multisine:large', 'multisine:small']
    assert result['y'].headline.data == 'validation'


def test_promise_report_and_json_are_those_of_the_modes(tmp_path):
    result = identified()
    for axis, x in result.items():
        run = pi.free_run(result.model, other(), 0.9)[axis]
        assert 0.75 < run.inside <= 1.0
        assert 0.5 < run.errors.percent / x.promise.same < 2.0
        assert not any('the model was then fitted' in text for text in x.warnings)
        assert sum('share modes' in text for text in x.warnings) == 1
        np.testing.assert_array_equal(x.runs[0].y_hat, result.model.predicted(measured())[axis][0])
    data = json.loads(pi.report.json_text(result))['axes']['y_b']
    assert data['shared_modes']['law'] in result['y'].shared.told
    assert data['errors']['validation'] == result['y_b'].headline.percent
    assert data['promise']['same_motion'] == result['y_b'].promise.same
    text = pi.report.identification_text(result)
    assert f'errs by {number(result["y"].headline.percent)} %' in ' '.join(text.split())
    assert 'hysteresis alone by' not in text
    outcome = jobs._identified(result)
    assert 'alone' not in outcome.brief and 'static_percent' not in outcome.figures
    assert outcome.model == text_of(result.model)
    page = pi.write_report(result['y'], tmp_path / 'report')
    assert 'Hysteresis of the chain' in page.read_text(encoding='utf-8')


def test_the_file_predicts_to_the_last_bit_and_knows_its_error(tmp_path):
    result = identified()
    result.model.save(tmp_path / 'model.yaml')
    read = pi.load(tmp_path / 'model.yaml')
    for axis, y in result.model.predicted(other()).items():
        np.testing.assert_array_equal(read.predicted(other())[axis][0], y[0])
        known = expected_error(judged_models(read)[axis])
        assert 0.5 < known / result[axis].error('held out') < 2.0


def test_a_diagnosis_leaves_shared_modes_as_they_are(monkeypatch, tmp_path):
    model = identified().model
    monkeypatch.setattr(learn, 'find_shared_modes', refuse)
    result = pi.diagnose(model, other())
    assert result.modes is model.modes
    for axis, run in pi.free_run(model, other()).items():
        one = result[axis]
        assert one.model is model.axes[axis] and 'nothing was searched' in one.sentence
        assert one.errors['before'] == one.errors['after']
        error = run.errors_after_start.percent_without_offset
        # in % of the stroke behind the start
        assert one.after.overall == pytest.approx(error, rel=0.1)
        assert 'multisine:large-1' in one.after.by_segment
    pi.write_report(result['y'], tmp_path / 'report')
    again = pi.report.validated(result, [measured()])
    assert again['y'].unseen[0].before == again['y'].unseen[0].after


def test_independent_chains_keep_their_chains_and_are_asked_once(monkeypatch):
    record, again = sines_of_the_scanner(1), sines_of_the_scanner(2)
    result = pi.identify(record, FEW)
    assert result.modes is None
    alone, x = learn.identify_axis(axis_record(record, 'y'), FEW), result['y']
    assert (x.errors, x.warnings, x.promise) == (alone.errors, alone.warnings, alone.promise)
    assert x.shared is None
    assert chains_were_kept(result.model, Multisines.of(result, [record]))
    monkeypatch.setattr(learn, 'find_shared_modes', refuse)
    only = pi.DiagnosisSettings(effects=('loop_hysteresis',))
    told = pi.diagnose(result.model, record, only)
    assert all('were not tried' in x.warnings[-1] for x in told.values())
    monkeypatch.setattr(learn, 'find_shared_modes', lambda *args: None)
    told = pi.diagnose(result.model, again, only)
    assert all('tried again' in x.warnings[-1] for x in told.values())


def test_other_records_are_not_asked(monkeypatch):
    monkeypatch.setattr(learn_modes, 'find_shared_modes', refuse)
    record = scanner.play(*scanner.raster(2500))
    result = pi.identify(record, FEW)
    assert chains_were_kept(result.model, Multisines((), np.zeros(2))) is None


def test_modes_that_err_on_other_motion_do_not_win():
    taken = identified()
    sines = {row.segment for row in taken['y'].errors}
    assert not _err_elsewhere(taken, taken, sines)

    def with_triangle(results, data, size):
        def more(_, x):
            row = replace(x.errors[0], segment='triangle', percent=size, data=data)
            return replace(x, errors=(*x.errors, row))

        return results.mapped(more)

    modes, chain = with_triangle(taken, 'held out', 2.0), with_triangle(taken, 'fitted', 1.0)
    assert _err_elsewhere(modes, chain, sines)
    assert not _err_elsewhere(with_triangle(taken, 'held out', 0.5), chain, sines)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A diagnosis for people: tables hold the numbers of the result."""

from dataclasses import replace

from diagnosis_examples import example, hostile, measured, refined_model
import numpy as np
from piezo_ident.diagnosis.results import changes, Errors, FoundParameter
from piezo_ident.model.free_run import free_run
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.report import diagnosis_text, validated
from piezo_ident.report.diagnosis import (
    diagnosis_page,
    error_table,
    headline,
    parameter_rows,
    unseen_tables,
    value_text,
)
from piezo_ident.report.html import page_html
from piezo_ident.report.table import number
from programs import slow_model
import pytest

VERDICTS = ['named', 'partly_explained', 'refitted', 'unexplained', 'none']


@pytest.mark.parametrize('verdict', VERDICTS)
def test_page_and_summary_hold_for_every_verdict(verdict):
    result = example(verdict)
    html = page_html(diagnosis_page(result, [], []))
    assert result.sentence in html
    assert result.sentence in diagnosis_text(result)
    assert ('<h3>Parameters</h3>' in html) == bool(result.effects)
    for errors in (result.before, result.refit, result.after):
        assert number(errors.overall) in html


def test_a_refit_tells_of_its_law_of_what_may_hide_and_of_the_motions_it_stands_for():
    result = example('refitted')
    for text in (page_html(diagnosis_page(result, [], [])), diagnosis_text(result)):
        words = ' '.join(text.split())
        assert 'creep, thermal_drift, gain_drift, which may hide in the base model' in words
        assert 'not a sum of plays: H has a Preisach density' in words
        assert 'plays 0.300 %, duhem 0.100 %' in words
        assert 'each predicted from the others: sine:5Hz, staircase, sine:50Hz' in words
    assert error_table(result).head == ('', 'as given', 'refined', 'times smaller')
    words = ' '.join(diagnosis_text(example('named')).split())
    assert 'parts were predicted' in words and 'hysteresis a sum of plays' in words


def test_unknown_numbers_are_dashes_or_left_out():
    result = replace(
        example('none'),
        noise_floor=None,
        noise_source='no repeats',
        smallest_detectable=None,
        candidates=(),
        untestable=(),
        faults=(),
        warnings=(),
        before=Errors(0.5, {}, {}),
        refit=Errors(0.5, {'hold': 0.1}, {}),
        after=Errors(float('nan'), {}, {}),
    )
    html = page_html(diagnosis_page(result, [], [('Errors', 'no <segment>')]))
    assert 'no &lt;segment&gt;' in html
    assert 'unknown (no repeats)' in html
    assert 'unknown (no repeats)' in diagnosis_text(result)
    assert error_table(result).rows[0] == ('overall', '0.500', '0.500', '–', '–')


def test_names_do_not_steer_a_terminal():
    assert '\x1b' not in diagnosis_text(hostile())


def test_errors_in_rows():
    result = example('named')
    overall, *segments, _, _ = rows = error_table(result).rows
    # rest and ramps come last, and then the sines by frequency
    names = ['idle', 'ramp', 'sines of 5 Hz', 'sines of 50 Hz']
    assert [row[0] for row in rows][-4:] == names
    states = (result.before, result.refit, result.after)
    assert overall[1:4] == tuple(number(errors.overall) for errors in states)
    assert float(overall[4]) == pytest.approx(
        result.before.overall / result.after.overall, rel=0.05
    )
    for label, *cells, _ in segments:
        assert cells == [number(errors.by_segment[label]) for errors in states]


def test_records_that_took_no_part():
    other = measured('other')
    result = validated(example('named'), [other])
    (unseen,) = result.unseen
    runs = [free_run(model, other) for model in (slow_model(), refined_model())]
    errors = [(run.errors_after_start or run.errors).percent for run in runs]
    assert [unseen.before, unseen.after] == errors
    assert errors[1] < 0.1 * errors[0]
    (table,) = unseen_tables(result)
    assert table.rows[0][:3] == ('other', number(errors[0]), number(errors[1]))
    for error in errors:
        assert f'{number(error)} %' in headline(result)
    assert headline(example('named')) == example('named').sentence
    assert unseen_tables(example('named')) == []


def test_values_for_people():
    inf = float('inf')
    for parameter, text in (
        (FoundParameter(0.5, '1', 0.01), '0.5000 ± 0.010'),
        (FoundParameter(-inf, '1', None), '-∞'),
        (FoundParameter((1.0, 2.0), 's', (0.1, inf)), '1.000 ± 0.10, 2.000'),
        (FoundParameter((1.0, 2.0), 's', 0.1), '1.000, 2.000'),
        (FoundParameter('x', '', None), 'x'),
    ):
        assert value_text(parameter) == text
    rows = parameter_rows(example('named'))
    assert [row[:2] for row in rows] == [('creep', 'gain'), ('creep', 'time_constant')]
    assert rows[0][2] == '0.01200 ± 0.00040, 0.01000 ± 0.00060'


def test_what_changed_in_a_model():
    given, refined = slow_model(), refined_model()
    assert changes(given, given) == ()
    assert changes(given, refined) == ('with creep',)
    assert changes(refined, given) == ('without creep',)
    # what follows time is not carried over to another record
    idle = EffectSetting('creep', {'gain': [0.0], 'time_constant': [1.0]})
    assert changes(given, replace(given, effects=(idle,))) == ('with creep, switched off',)
    h = given.hysteresis
    dull = Hysteresis(np.append(h.thresholds, 0.9), np.append(h.weights, 0.0), h.p1, h.p2)
    assert changes(replace(given, hysteresis=dull), given) == ()
    other = replace(
        refined,
        hysteresis=Hysteresis(h.thresholds, h.weights, h.p1, h.p2 + 0.1),
        scaling=replace(given.scaling, y0=1e-9),
        effects=(EffectSetting('creep', {'gain': [0.01], 'time_constant': [1.0]}),),
    )
    assert changes(refined, other) == ('H refitted', 'offset refitted', 'creep refitted')

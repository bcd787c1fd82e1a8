# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""An identification for people: tables hold the numbers of the result."""

from dataclasses import replace
import json
import math

from piezo_ident.identification.results import Steps
from piezo_ident.model.free_run import piece_runs
from piezo_ident.model.sines import SineError, sines_of
from piezo_ident.report import headline, identification_text, steps_to_json, table_one, to_json
from piezo_ident.report.html import Page, page_html, Section
from piezo_ident.report.identification import (
    dynamics_tables,
    error_table,
    facts,
    hysteresis_tables,
    sine_tables,
)
from piezo_ident.report.table import length, number, plain_text, Table
import pytest


def test_headline_is_about_the_record_for_validation(identified):
    rows = [r for r in identified.errors if r.data == 'validation' and r.driven]
    n = sum(row.n for row in rows)
    errors = [
        math.sqrt(sum(row.n * getattr(row, name) ** 2 for row in rows) / n)
        for name in ('percent', 'static_percent')
    ]
    # ramps are easy, and count for neither; the rests have another label here
    assert n == 50_000
    for error in errors:
        assert f' by {number(error)} %' in headline(identified)
    assert rows[0].record in headline(identified)


def test_headline_without_validation(identified):
    rows = tuple(row for row in identified.errors if row.data != 'validation')
    assert 'held out from the fit' in headline(replace(identified, errors=rows))
    rows = tuple(row for row in rows if row.data == 'fitted')
    assert 'Nothing was held out' in headline(replace(identified, errors=rows))
    assert '–' in headline(replace(identified, errors=()))


def test_error_table_holds_the_errors(identified):
    table = error_table(identified)
    cells = {
        (row.record, row.segment, row.data, number(row.percent), number(row.static_percent))
        for row in identified.errors
    }
    assert {row[:5] for row in table.rows} == cells
    assert [row[2] for row in table.rows] == sorted(
        (row[2] for row in table.rows), key=['validation', 'held out', 'selection', 'fitted'].index
    )
    # at rest there is nothing but noise to explain
    assert {row[5] for row in table.rows if row[1] == 'idle'} == {'–'}


def test_both_solvers_are_shown(identified):
    fit = identified.hysteresis
    weights, solvers = hysteresis_tables(identified)
    assert [float(row[1]) for row in solvers.rows] == [
        pytest.approx(fit.swarm_loss, rel=1e-4),
        pytest.approx(fit.optimum_loss, rel=1e-4),
    ]
    assert str(fit.swarm.nit) in solvers.rows[0][3]
    h = identified.model.hysteresis
    assert [row[3] for row in weights.rows] == [number(x, 4) for x in (*h.weights, h.p1, h.p2)]
    alone = replace(identified, hysteresis=replace(fit, swarm=None, swarm_loss=None))
    assert len(hysteresis_tables(alone)[1].rows) == 1


def test_dynamics_tables_hold_the_coefficients(identified):
    G = identified.model.dynamics
    delay, coefficients, poles, methods = dynamics_tables(identified)
    assert delay.rows[0][1] == '3'
    assert [row[1] for row in coefficients.rows if row[1]] == [number(x, 6) for x in G.a]
    assert [row[3] for row in coefficients.rows if row[3]] == [number(x, 6) for x in G.b]
    assert len(poles.rows) == len(G.modes(20_000.0))
    assert len(methods.rows) == len(identified.dynamics.methods)


def test_numbers_are_strict_json(identified):
    runs = piece_runs(identified.model, identified.records, identified.memories)
    data = to_json(identified, runs)
    json.dumps(data, allow_nan=False)
    assert data['delay']['samples'] == 3
    assert data['delay']['seconds'] == pytest.approx(150e-6)
    assert data['dynamics']['order'] == list(identified.dynamics.order)
    assert len(data['dynamics']['a_std']) == len(data['dynamics']['a'])
    assert data['errors']['validation'] == pytest.approx(identified.error('validation'))
    assert len(data['errors']['rows']) == len(identified.errors)
    assert [row['frequency'] for row in data['sines']] == [20.0, 100.0]
    assert [row['percent'] for row in data['sines']] == [
        pytest.approx(float(x), rel=0.01) for x in sine_tables(sines_of(runs))[0].rows[0][1:]
    ]
    assert data['data_faults'][0]['count'] == 3
    assert data['hysteresis']['thresholds_volt'][0] == pytest.approx(1.0)
    assert data['hysteresis']['swarm_loss'] == identified.hysteresis.swarm_loss


def test_unknown_numbers_are_null(identified):
    rows = (replace(identified.errors[0], fit=float('-inf'), percent=float('nan')),)
    data = to_json(replace(identified, errors=rows, noise_floor=None))
    json.dumps(data, allow_nan=False)
    assert data['errors']['rows'][0]['fit'] is None
    assert data['errors']['selection'] is None


def test_single_steps_have_the_keys_of_the_whole(identified):
    steps = Steps(identified.delay, (identified.dynamics, identified.model.dynamics))
    data, whole = steps_to_json(steps, 20_000.0, identified.records), to_json(identified)
    assert {**data['dynamics'], 'bias': None} == {**whole['dynamics'], 'bias': None}
    assert data['delay'] == whole['delay']
    assert data['data_faults'] == whole['data_faults']


def test_summary_for_a_terminal(identified):
    text = identification_text(identified)
    assert length(identified.stroke) in text
    assert 'warning: ' in text
    # names in files must not steer a terminal
    assert '\x1b' not in text
    assert max(map(len, text.splitlines())) < 150


def test_facts_tell_the_law_and_the_motions_that_the_error_stands_for(identified, unlabelled):
    about = dict(facts(identified))
    assert about['hysteresis'] == '9 thresholds, p1, p2'
    assert about['error holds'].startswith('for motion of these kinds: ')
    assert 'sine:100Hz' in about['error holds']
    wide = replace(identified, hysteresis=replace(identified.hysteresis, law='preisach'))
    assert dict(facts(wide))['hysteresis'].startswith('not a sum of plays: ')
    assert 'similar motion' in dict(facts(unlabelled))['error holds']
    assert 'error holds' not in dict(facts(replace(identified, errors=())))


def test_table_of_sines():
    rows = [SineError(1.0, 1.03, 1.03, 10), SineError(120.0, 3.59, 10.06, 10)]
    lines = table_one(rows).splitlines()[1:]
    assert lines[0].split() == ['frequency', '/', 'Hz', '1', '120']
    assert lines[1].split()[-2:] == ['1.03', '3.59']
    assert lines[2].split()[-2:] == ['1.03', '10.1']
    assert 'no sine' in table_one([])


@pytest.mark.parametrize(
    ('value', 'text'),
    [
        (None, '–'),
        (float('nan'), '–'),
        (float('inf'), '∞'),
        (0.0, '0'),
        (0.00323456, '0.00323'),
        (12.3456, '12.3'),
        (-1234.5, '-1234'),
        (3.2e-7, '3.20e-07'),
    ],
)
def test_numbers_for_people(value, text):
    assert number(value) == text


def test_lengths_and_columns():
    assert [length(x) for x in (2e-3, 71e-6, 3e-9, 0.0)] == [
        '2.000 mm',
        '71.00 µm',
        '3.000 nm',
        '0 nm',
    ]
    table = Table('t', ('', 'n', 'text'), [('a', '1', 'b'), ('bb\x1b', '12', '2')])
    assert table.text_columns == (False, False, True)
    # words stay whole on a narrow screen, and prose alone is wrapped
    wide = Table('t', ('', 'n', 'word', 'why'), [('a' * 50, '1', 'noise', 'so it is ' * 9)])
    assert wide.kinds == ('', '', 'text', 'prose')
    # prose goes below the rest of its row there
    page = Page('t', 's', 'h', [], [], [Section('a', [wide, table])], [], 'f')
    assert page_html(page).count('<table class="stacked">') == 1
    assert table.lines() == ['t:', '      n  text', 'a     1  b', 'bb?  12  2']
    assert Table('', ('', ''), [('a', 'b ' * 60)]).lines()[1].startswith('   b b')
    assert Table('t', ('', 'n'), []).text_columns == (False, False)
    assert plain_text(['a\x1b', '', Table('', ('', ''), [('b', 'c')])]) == 'a?\n\nb  c'

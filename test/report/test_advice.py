# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a result suggests to do next: commands that are understood, and fit the result."""

from dataclasses import replace
from html import unescape
import shlex
from types import SimpleNamespace

from diagnosis_examples import example
import numpy as np
import piezo_ident as pi
from piezo_ident.cli.main import cli
from piezo_ident.diagnosis.results import FoundEffect
from piezo_ident.excitation.scaled import scaled
from piezo_ident.record.record import Piece
from piezo_ident.report import next_steps, Prompt
import pytest

NAMED = Prompt(
    'new.yaml', 'old.yaml', {'val.npz': 'my lab/val.npz'}, ('--voltage-limits', '0', '9')
)


def commands(result, prompt=NAMED):
    lines = [step.command for step in next_steps(result, prompt)]
    for line in lines:
        program, *words = shlex.split(line)
        assert program == 'piezo_ident'
        assert vars(cli.main(words, 'piezo_ident', standalone_mode=False)), line
    return lines


def test_a_motion_that_was_not_fitted_comes_first(identified, unlabelled):
    result = replace(identified, errors=[e for e in identified.errors if e.data != 'validation'])
    *_, excitation, diagnose = commands(result)
    # what drives this stage: at the rate of its model, over all of its range, and no answer
    drive = '--sample-rate 20000 --limits 0 10 --voltage-only excitation.csv'
    assert excitation == f'piezo_ident simulate --program validation {drive}'
    assert diagnose.startswith('piezo_ident diagnose new.yaml other.csv --model refined.yaml')
    # as the records were read
    assert diagnose.endswith('--voltage-limits 0 9')
    missing = replace(unlabelled, not_identified=(('delay', 'no steps'),))
    assert commands(missing)[0] == f'piezo_ident simulate --program identification {drive}'


@pytest.mark.parametrize(
    ('measured', 'asked'),
    [((-0.0021, 99.987), '0 100'), ((-20.013, 120.02), '-20 120'), ((0.0, 0.4996), '0 0.4996')],
)
def test_noise_at_the_ends_of_the_range_is_not_asked_for(identified, measured, asked):
    scaling = replace(identified.model.scaling, range=measured)
    model = replace(identified.model, sample_rate=2000.0, scaling=scaling)
    errors = [e for e in identified.errors if e.data != 'validation']
    *_, line, _ = commands(replace(identified, model=model, errors=errors))
    assert f'--sample-rate 2000 --limits {asked} --voltage-only' in line


def test_the_error_on_validation_decides(identified):
    (fitted, *_) = identified.errors
    row = replace(fitted, record='val.npz', segment='sine:1Hz', data='validation')

    def after(factor, thresholds=None):
        settings = replace(identified.settings, thresholds=thresholds)
        row_of = replace(row, percent=factor * 0.1)
        return commands(replace(identified, errors=(row_of,), noise_floor=0.1, settings=settings))

    (use,) = after(1.5)
    assert use == 'piezo_ident predict new.yaml scan.csv --out predicted.csv'
    (diagnose,) = after(3.0)
    assert diagnose.startswith("piezo_ident diagnose new.yaml 'my lab/val.npz' --model")
    again, _ = after(3.0, thresholds=10)
    assert '--thresholds auto --model new.yaml --overwrite' in again
    assert len(after(1.5, thresholds=10)) == 1


@pytest.mark.parametrize('verdict', ['named', 'class', 'unexplained', 'refitted'])
def test_a_diagnosis_asks_for_the_experiment_that_decides(verdict):
    result = example(verdict)
    excitation, diagnose, *check = commands(result)
    assert excitation.startswith('piezo_ident simulate --program ')
    assert diagnose.startswith("piezo_ident diagnose old.yaml 'my lab/val.npz' other.csv")
    # a model that stays as given is not checked again
    is_new = verdict != 'unexplained'
    assert [line.split()[:3] for line in check] == [
        ['piezo_ident', 'predict', 'new.yaml']
    ] * is_new


@pytest.mark.parametrize(('rate', 'limits'), [(20_000.0, (0.0, 10.0)), (5_000.0, (-20.0, 130.0))])
def test_what_a_record_without_labels_plays_is_not_asked_for_again(rate, limits):
    effect = FoundEffect('rate_dependent_hysteresis', 'hidden', 0.99, 0.3, {})
    rng, residuals = np.random.default_rng(0), []
    for name, wanted in (('holds', 'diagnosis'), ('diagnosis', None)):
        q = scaled(pi.Program.load(name), limits, rate).build()
        # as an amplifier's monitor shows it, and recorded for longer
        v = 0.97 * np.pad(q.v, (1234, 4321), mode='edge') + rng.normal(0.2, 0.02, q.n + 5555)
        piece = Piece(v, np.zeros(v.size), rate)
        residuals.append(SimpleNamespace(piece=piece, record=name))
        found = replace(example('named'), effects=(effect,), untestable=())
        result = replace(found, residuals=tuple(residuals))
        asked = [line.split()[3] for line in commands(result) if ' simulate ' in line]
        assert asked == ([wanted] if wanted else [])


def test_a_record_that_is_there_is_not_named_as_the_next():
    prompt = replace(NAMED, records={'val.npz': 'other.csv'})
    _, diagnose, check = commands(example('named'), prompt)
    assert 'old.yaml other.csv other_2.csv' in diagnose and ' other_2.csv' in check


def test_a_model_that_lacks_nothing_is_used():
    result = replace(example('none'), untestable=())
    assert commands(result) == ['piezo_ident predict old.yaml scan.csv --out predicted.csv']
    # a refit of the hysteresis alone is a model to check
    scaling = replace(result.model.scaling, y0=1e-7)
    refitted = replace(result, model=replace(result.model, scaling=scaling))
    assert [line.split()[2] for line in commands(refitted)] == ['new.yaml']


def test_the_page_shows_the_commands(tmp_path, identified, blank_pictures):
    page = pi.write_report(identified, tmp_path / 'report', prompt=NAMED)
    html = unescape(page.read_text(encoding='utf-8'))
    for line in commands(identified):
        assert f'<pre>{line}</pre>' in html
    # without names, those of the folder
    page = pi.write_report(identified, tmp_path / 'report')
    assert str(tmp_path / 'report' / 'model.yaml') in page.read_text(encoding='utf-8')

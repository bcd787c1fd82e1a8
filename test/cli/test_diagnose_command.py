# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``piezo_ident diagnose`` and ``piezo_ident effects``: what they print, write and refuse."""

from dataclasses import replace
import json
from pathlib import Path
import signal
import sys
import time

from command_line import refuse, run, succeed
from diagnosis_examples import example, measured
import jsonschema
import numpy as np
import piezo_ident as pi
from piezo_ident.cli import diagnose_command as module
from piezo_ident.cli import effects_command
from piezo_ident.effects import catalogue
from piezo_ident.model.files import load
from piezo_ident.model.free_run import free_run
from piezo_ident.record.record import Record
from piezo_ident.report.json_data import diagnosis_schema
from programs import SLOW, slow_model
import pytest

ONLY = ('--only', 'creep')


@pytest.fixture
def made(tmp_path) -> Path:
    """Return a folder with a model that knows no creep, and records of a stage that creeps."""
    slow_model().save(tmp_path / 'model.yaml')
    record = measured('val.npz')
    pi.write(record, tmp_path / 'val.npz')
    (piece,) = record.pieces
    # another part of the same stage's life
    late = piece.cut(round(2.6 * SLOW), piece.n)
    pi.write(Record((late,), 'unseen.npz'), tmp_path / 'unseen.npz')
    return tmp_path


@pytest.fixture
def quick(monkeypatch):
    """Have every diagnosis give an example at once; its arguments are kept."""
    asked = {}

    def diagnose(model, records, settings, *, progress):
        progress('candidates', 0.5)
        asked.update(model=model, records=records, settings=settings)
        return asked.get('gives') or example('named')

    monkeypatch.setattr(module, 'diagnose', diagnose)
    return asked


def test_it_finds_creep_and_the_refined_model_is_better(capsys, made):
    refined, report = made / 'refined.yaml', made / 'deep' / 'report'
    argv = ['diagnose', made / 'model.yaml', made / 'val.npz', *ONLY]
    argv += ['--model', refined, '--report', report, '--validation', made / 'unseen.npz']
    text = succeed(capsys, *argv)
    data = json.loads((report / 'diagnosis.json').read_text(encoding='utf-8'))
    jsonschema.Draft202012Validator(diagnosis_schema()).validate(data)
    # drifts were not tried
    assert data['verdict'] == 'class'
    assert data['class']['names'] == ['creep', 'thermal_drift', 'gain_drift']
    assert [e['name'] for e in data['effects']] == ['creep']
    assert data['sentence'] in text.replace('\n', ' ')
    # the noise of the example is 0.0053 % of its stroke
    # without its mean: the zero of each record is free
    assert data['error']['before']['overall'] > 0.4
    assert data['error']['after']['overall'] < 0.01
    model = load(refined)
    assert [e.name for e in model.effects] == ['creep']
    assert (report / 'model.yaml').read_bytes() == refined.read_bytes()
    record = measured()
    # H and G are refitted together with creep
    assert free_run(model, record).errors.percent < 0.015
    assert free_run(slow_model(), record).errors.percent > 0.5
    (row,) = [line for line in text.splitlines() if line.startswith('unseen.npz  ')]
    before, after = map(float, row.split()[1:3])
    assert after < 0.2 * before
    assert f'model: {refined} (' in text
    assert 'with creep' in text
    assert (report / 'report.html').is_file()
    assert load(made / 'model.yaml').effects == ()


def test_what_it_prints(capsys, made, quick):
    quick['gives'] = example('class')
    text = succeed(capsys, 'diagnose', made / 'model.yaml', made / 'val.npz')
    starts = {line.partition('  ')[0] for line in text.splitlines()}
    assert {'overall', 'sine:5Hz', 'sines of 50 Hz', 'noise floor', 'detectable'} <= starts
    # effect and parameters, class and experiment, candidates, what cannot be tested, faults
    for words in (
        quick['gives'].sentence,
        'creep (slot: hidden), 93 %',
        '0.01200 ± 0.00040, 0.01000 ± 0.00060',
        'creep, thermal_drift, gain_drift',
        'a hold of 10 s',
        '29 %',
        'first 6 of 7',
        'a recorded voltage of another axis',
        'in val.npz at 1.2 s',
        'no repeated periods',
        '--model YAML',
    ):
        assert words in text, words
    assert 'slew_limit' not in text
    assert sorted(p.name for p in made.iterdir()) == ['model.yaml', 'unseen.npz', 'val.npz']


def test_json(capsys, made, quick):
    argv = ['diagnose', made / 'model.yaml', made / 'val.npz', '--json', '--seed', 5]
    data = json.loads(
        succeed(capsys, *argv, '--model', made / 'r.yaml', '--validation', made / 'unseen.npz')
    )
    jsonschema.Draft202012Validator(diagnosis_schema()).validate(data)
    assert data['model_changes'] == ['with creep']
    assert data['files'] == {'model': str(made / 'r.yaml'), 'report': None}
    (check,) = data['validation']
    assert check['record'] == 'unseen.npz'
    assert check['after'] < check['before']
    assert quick['settings'].seed == 5


def test_a_model_that_lacks_nothing_stays_as_it_is(capsys, made, quick):
    quick['gives'] = example('none')
    argv = ['diagnose', made / 'model.yaml', made / 'val.npz', '--model', made / 'same.yaml']
    text = succeed(capsys, *argv)
    assert f'model: {made / "same.yaml"} (the same as {made / "model.yaml"}' in text
    data = json.loads(succeed(capsys, *argv, '--overwrite', '--json'))
    assert data['model_changes'] == []


def test_a_record_of_the_identification_is_no_test(capsys, made, quick):
    argv = ['diagnose', made / 'model.yaml', made / 'val.npz', made / 'unseen.npz', '--json']
    said = 'val.npz: the model was identified from a record of this name'
    assert not any(said in x for x in json.loads(succeed(capsys, *argv))['warnings'])
    model = slow_model()
    known = {**model.identification, 'records': ['val.npz']}
    replace(model, identification=known).save(made / 'model.yaml')
    warnings = json.loads(succeed(capsys, *argv))['warnings']
    assert [x.startswith(said) for x in warnings].count(True) == 1


def test_options_reach_the_diagnosis(capsys, made, quick):
    argv = ['diagnose', made / 'model.yaml', made / 'val.npz', made / 'unseen.npz']
    succeed(capsys, *argv)
    assert quick['settings'].effects is None
    assert [record.name for record in quick['records']] == ['val.npz', 'unseen.npz']
    more = ['--without', 'creep,backlash', '--without', 'slew_limit', '--most-effects', 2]
    succeed(capsys, *argv, *more)
    assert quick['settings'].without == ('creep', 'backlash', 'slew_limit')
    assert quick['settings'].most_effects == 2
    succeed(capsys, *argv, '--only', 'creep', '--only', 'thermal_drift')
    assert quick['settings'].effects == ('creep', 'thermal_drift')


def test_a_unit_converts(capsys, made, quick):
    (piece,) = measured().pieces
    rows = np.column_stack([piece.t, piece.v, 1e6 * piece.y])
    np.savetxt(made / 'um.csv', rows, delimiter=',', header='t,v,y', comments='', fmt='%.9g')
    argv = ['diagnose', made / 'model.yaml', made / 'um.csv']
    succeed(capsys, *argv, '--displacement-unit', 'um')
    assert quick['records'][0].stroke == pytest.approx(measured().stroke, rel=1e-6)
    refuse(capsys, made, argv, 'um.csv', '--displacement-unit')


@pytest.mark.parametrize(
    ('options', 'word'),
    [
        (['--most-effects', 0], 'most_effects'),
        (['--most-effects', 'all'], '--most-effects'),
        (['--seed', -1], '--seed'),
        (['--only', ''], 'is empty; give a name'),
    ],
)
def test_bad_options(capsys, made, quick, options, word):
    refuse(capsys, made, ['diagnose', made / 'model.yaml', made / 'val.npz', *options], word)
    assert quick == {}


def test_inputs_and_other_reports_are_never_overwritten(capsys, made, quick):
    model, record = made / 'model.yaml', made / 'val.npz'
    argv = ['diagnose', model, record]
    refuse(capsys, made, [*argv, '--model', model], 'is one of the inputs')
    refuse(capsys, made, [*argv, '--validation', record], 'is no validation')
    # the report would put its model.yaml there
    refuse(capsys, made, [*argv, '--report', made], 'is one of the inputs')
    (made / 'old').mkdir()
    (made / 'old' / 'identification.json').write_text('{}')
    refuse(capsys, made, [*argv, '--report', made / 'old'], 'report of identification')
    (made / 'mine').mkdir()
    (made / 'mine' / 'model.yaml').write_text('')
    refuse(capsys, made, [*argv, '--report', made / 'mine'], 'of no earlier report')
    assert quick == {}


def test_models_and_records_that_do_not_fit(capsys, made):
    model, record = made / 'model.yaml', made / 'val.npz'
    for argv in ([record, model], [record, record], [model, model]):
        refuse(capsys, made, ['diagnose', *argv], 'MODEL comes first: piezo_ident diagnose')
    refuse(capsys, made, ['diagnose', model, made / 'no.csv'], 'no.csv', 'check the name')
    refuse(capsys, made, ['diagnose', made / 'no.yaml', record], 'no.yaml', 'check the name')
    (piece,) = measured().pieces
    fast = Record((replace(piece, sample_rate=4000.0),))
    pi.write(fast, made / 'fast.npz')
    refuse(capsys, made, ['diagnose', model, made / 'fast.npz', *ONLY], 'fast.npz', '4000')
    # what is looked at in the end is tried at the start
    argv = ['diagnose', model, record, '--validation', made / 'fast.npz']
    refuse(capsys, made, argv, 'fast.npz', '4000')
    pi.write(Record((piece.cut(600, 900),)), made / 'short.npz')
    refuse(capsys, made, ['diagnose', model, made / 'short.npz'], 'short.npz', 'longer')


def test_interrupt_leaves_nothing(capsys, made, monkeypatch):
    def diagnose(model, records, settings, *, progress):
        signal.raise_signal(signal.SIGINT)
        time.sleep(1.0)
        raise AssertionError('it went on')

    monkeypatch.setattr(module, 'diagnose', diagnose)
    before = sorted(made.rglob('*'))
    outputs = ['--model', made / 'r.yaml', '--report', made / 'report']
    code, out, err = run(capsys, 'diagnose', made / 'model.yaml', made / 'val.npz', *outputs)
    assert (code, out) == (130, '')
    assert err.startswith('piezo_ident: interrupted') and err.count('\n') == 1
    assert sorted(made.rglob('*')) == before


def test_catalogue(capsys, tmp_path):
    text = succeed(capsys, 'effects')
    data = json.loads(succeed(capsys, 'effects', '--json'))
    assert [e['name'] for e in data] == sorted(catalogue())
    for effect in data:
        assert f'{effect["name"]}  (slot: {effect["slot"]})\n' in text
        assert effect['about'] in text
        assert f'shows in: {effect["needs"]}\n' in text
    # one effect at length comes with another call
    assert len(text.splitlines()) < 4 * len(data)
    refuse(capsys, tmp_path, ['effects', 'back_lash'], 'did you mean backlash?')


@pytest.mark.parametrize('name', sorted(catalogue()))
def test_one_effect(capsys, name):
    text = succeed(capsys, 'effects', name)
    effect = json.loads(succeed(capsys, 'effects', name, '--json'))
    assert effect['name'] == name
    assert text.startswith(f'{name}  (slot: {effect["slot"]})\n')
    for p in catalogue()[name].parameters:
        (row,) = [line for line in text.splitlines() if line.startswith(f'{p.name}  ')]
        assert p.description in ' '.join(text.split())
        if p.kind == 'number':
            assert f'{p.lower:g}' in row
            assert f'{p.upper:g}' in row
            assert p.unit in row
    assert effect['documentation'].splitlines()[0] in text


def test_a_plug_in_is_listed_with_its_package(capsys, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / 'example_effect'))
    from example_effect import SoftStop

    effects = {**catalogue(), 'soft_stop': SoftStop}
    monkeypatch.setattr(effects_command, 'catalogue', lambda: effects)
    assert 'soft_stop  (slot: output)  from example_effect\n' in succeed(capsys, 'effects')
    text = succeed(capsys, 'effects', 'soft_stop')
    assert 'share k' in text
    assert effects_command.effect_name('soft_stop') == 'soft_stop'
    sys.modules.pop('example_effect', None)

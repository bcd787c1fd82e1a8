# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Sentence, tables, verdict, model file and JSON of a diagnosis agree, whatever the verdict is."""

from dataclasses import replace
import json
import re

from command_line import succeed
from diagnosis_examples import example
import jsonschema
from measured_data import measured_record
import numpy as np
import piezo_ident as pi
from piezo_ident.cli import diagnose_command
from piezo_ident.control.hysteresis_inverse import rising
from piezo_ident.diagnosis.messages import sentence
from piezo_ident.excitation.program import parse_program
from piezo_ident.model.files import load
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.record import Piece, Record
from piezo_ident.report import diagnosis_text
from piezo_ident.report.figures import style
from piezo_ident.report.json_data import diagnosis_schema
from piezo_ident.report.table import number
from programs import SLOW, slow_model
import pytest

PROGRAM = """
limits: [0, 10]
slew: 400
segments:
  - {signal: idle, duration: 0.1}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 5, duration: 1}
  - {signal: staircase, levels: [0, 4, 8, 4, 0], hold: 0.3}
  - {signal: sine, bias: 5, amplitude: 4, frequency: 20, duration: 0.5}
  - {signal: idle, duration: 0.1}
"""
CREEP = {'gain': [0.02], 'time_constant': [0.1]}


def played(measure=lambda x, t: x, *, labelled=True, **effects) -> Record:
    """Return what is measured of the slow stage with effects; `x` is its motion, 1 at most."""
    model = replace(slow_model(), effects=tuple(EffectSetting(*x) for x in effects.items()))
    sequence = parse_program(PROGRAM, 'program').build(SLOW)
    y = model.simulate(sequence.v)
    y = measure(y / y.max(), np.arange(y.size) / SLOW) * y.max()
    y = y + 4e-9 * np.random.default_rng(3).standard_normal(y.size)
    segments = sequence.segments if labelled else ()
    return Record((Piece(sequence.v, y, SLOW, segments=segments),), 'val.npz')


def vibration(size):
    """Return a disturbance that no candidate accounts for."""
    return lambda x, t: x + size * np.sin(2 * np.pi * 37 * t + 3 * np.sin(2 * np.pi * 3 * t))


def bent(x, t):
    """Return a motion with other loops."""
    return x * (1.05 - 0.05 * x)


def test_a_refit_that_errs_less_than_the_refined_model_names_its_data():
    named = example('named')
    refit = replace(named.refit, overall=0.5 * named.after.overall)
    said = f'with a refit alone to {refit.overall:.3g} % of blocks between those fitted'
    assert said in sentence(replace(named, refit=refit))


def narrow_model():
    """Return the slow model as identified up to 5 V: nothing told its wide plays."""
    h = slow_model().hysteresis
    is_known = h.thresholds < 0.5
    known = Hysteresis(h.thresholds[is_known], h.weights[is_known], h.p1, h.p2)
    scaling = replace(slow_model().scaling, range=(0.0, 5.0))
    return replace(slow_model(), hysteresis=known, scaling=scaling)


#: record, candidates, verdict, and whether the model changes
CASES = {
    'nothing is missing': (played, 'saturation', 'none', False),
    'one effect': (lambda: played(saturation={'high': 0.9}), 'saturation,backlash', 'named', True),
    'one of several': (lambda: played(creep=CREEP), 'creep', 'class', True),
    'follows time alone': (
        lambda: played(lambda x, t: x * (1 + 0.01 * t), labelled=False),
        'gain_drift',
        'class',
        True,
    ),
    'a part': (lambda: played(vibration(0.0012), creep=CREEP), 'creep', 'partly_explained', True),
    'another hysteresis': (lambda: played(bent), 'creep', 'refitted', True),
    'no candidate': (lambda: played(vibration(0.004)), 'saturation', 'unexplained', False),
    'another gain': (lambda: played(lambda x, t: 1.03 * x), 'creep', 'refitted', True),
    'extrapolated': (lambda: played(labelled=False), 'gain_drift', 'refitted', True),
}


@pytest.fixture
def diagnosed(capsys, tmp_path, monkeypatch):
    """Return a function that runs the command, and gives its result, JSON, page and model."""
    results = []

    def keep(*args, **kwargs):
        results.append(pi.diagnose(*args, **kwargs))
        return results[-1]

    def run(given, record, only):
        given.save(tmp_path / 'given.yaml')
        pi.write(record, tmp_path / 'val.npz')
        files = ['--model', tmp_path / 'refined.yaml', '--report', tmp_path / 'report']
        argv = ['diagnose', tmp_path / 'given.yaml', tmp_path / 'val.npz', '--only', only]
        printed = json.loads(succeed(capsys, *argv, *files, '--json'))
        stored = json.loads((tmp_path / 'report' / 'diagnosis.json').read_text(encoding='utf-8'))
        assert {key: printed[key] for key in stored} == stored
        model = tmp_path / 'refined.yaml'
        assert model.read_bytes() == (tmp_path / 'report' / 'model.yaml').read_bytes()
        page = (tmp_path / 'report' / 'report.html').read_text(encoding='utf-8')
        return results[-1], stored, page, load(model)

    monkeypatch.setattr(diagnose_command, 'diagnose', keep)
    # what the pictures show is tested elsewhere, and takes longer than the diagnosis
    monkeypatch.setattr(style, 'draw_each', lambda *_: style.Drawn((), ()))
    return run


@pytest.mark.parametrize('name', CASES)
def test_all_that_a_diagnosis_says_agrees(diagnosed, name):
    make, only, verdict, is_changed = CASES[name]
    given = narrow_model() if name == 'extrapolated' else slow_model()
    record = make()
    result, data, page, refined = diagnosed(given, record, only)
    assert data['verdict'] == verdict, data['sentence']
    assert bool(data['model_changes']) == is_changed, data['sentence']
    assert refined.hysteresis.lowest_slope() > 0.0
    agree(result, data, page, refined, record)


def test_a_measured_stage_whose_refit_is_not_kept(diagnosed):
    (piece,) = measured_record('piezo_levels.csv').pieces
    first, second = (
        Record((part,), 'val.npz')
        for part in (piece.cut(0, piece.n // 2), piece.cut(piece.n // 2, piece.n))
    )
    given = pi.identify(first, pi.Settings(thresholds=8)).model
    result, data, page, refined = diagnosed(given, second, 'saturation')
    assert data['error']['refit']['overall'] < 0.7 * data['error']['before']['overall']
    agree(result, data, page, refined, second)


def agree(result, data, page, refined, record):
    """Check that all that is said of a diagnosis follows from its numbers."""
    jsonschema.Draft202012Validator(diagnosis_schema()).validate(data)
    sentence, verdict = data['sentence'], data['verdict']
    text = ' '.join(diagnosis_text(result).split())
    before, refit, after = (data['error'][x]['overall'] for x in ('before', 'refit', 'after'))
    effects = [effect['name'] for effect in data['effects']]
    assert sentence in text and sentence in page
    assert f'verdict {verdict.replace("_", " ")}' in text
    # the table has the errors
    shown = [before, after] if verdict == 'refitted' else [before, refit, after]
    assert ' '.join(['overall', *map(number, shown)]) in text
    assert bool(effects) == (verdict in ('named', 'class', 'partly_explained'))
    if verdict == 'class':
        assert set(effects) < set(data['class']['names'])
    # the file: a model that stays is the given one, bit by bit, and errs as much
    (piece,) = record.pieces
    is_same = np.array_equal(refined.simulate(piece.v), result.given.simulate(piece.v))
    if data['model_changes']:
        assert after < before
        assert not is_same or 'switched off' in text
        assert 'as given' not in sentence.partition('lie outside')[0]
        assert set(effects) <= {effect.name for effect in refined.effects}
        kept = refined.identification['diagnosis']
        assert (kept['verdict'], kept['effects']) == (verdict, effects)
        assert kept['errors']['before'] == before
        assert kept['errors'].get('after', after) == after
    else:
        assert is_same and after == before
        assert verdict != 'refitted' and 'falls' not in sentence
        assert data['hysteresis']['law'] == '' and 'model stays as given' in text
        assert not effects
    # a model that cannot be inverted is no better one; H may fall within narrow plays alone
    assert rising(refined.hysteresis).lowest_slope() > 0.0
    # every number of the sentence is one of the result
    share = 100.0 * (1.0 - data['unexplained']['share_of_explainable'])
    gain = data['gain'] or {'value': 1.0, 'share': 0.0}
    told = [
        *(before, refit, after, share, 100.0 * gain['share'], gain['value']),
        data['unexplained']['rms_percent_of_stroke'],
        data['smallest_detectable']['percent_of_stroke'],
        *(100.0 * data['share_outside_range'], *result.given.scaling.range),
        *(data['promise'][key] for key in ('same_motion', 'other_motion')),
    ]
    for said in map(float, re.findall(r'\d+\.?\d*(?:e-?\d+)?', sentence)):
        assert any(x == pytest.approx(said, rel=0.05) for x in told), (said, sentence)
    # shares that are told are those of the table, and a gain is told where it is found alone
    if effects:
        found = sum(effect['share_of_explainable'] for effect in data['effects'])
        assert 100.0 * found == pytest.approx(share, abs=1.0) and share > 1.0
    assert ('the gain is' in sentence.lower()) == (data['gain'] is not None)
    # what was extrapolated is said, and makes no gain
    low, high = result.given.scaling.range
    is_outside = bool(np.any((piece.v < low) | (piece.v > high)))
    assert (data['share_outside_range'] > 0.0) == is_outside == ('lie outside' in sentence)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A diagnosis as JSON: strict, and as its schema wants it."""

from dataclasses import replace
import json
import math

from diagnosis_examples import example, hostile
import jsonschema
import numpy as np
from piezo_ident import __version__
from piezo_ident.diagnosis.results import Errors, FORMULA, FoundParameter
from piezo_ident.report.json_data import diagnosis_schema, json_text, to_json
import pytest

VERDICTS = ('named', 'class', 'partly_explained', 'refitted', 'unexplained', 'none')

nan, inf = math.nan, math.inf


def refuse(constant: str) -> float:
    raise ValueError(constant)


def check(data) -> None:
    jsonschema.Draft202012Validator(diagnosis_schema()).validate(data)


def unknown():
    """Return a diagnosis full of numbers that JSON cannot write."""
    found = example('named')
    (effect,) = found.effects
    parameters = {
        'low': FoundParameter(-inf, '1', None),
        'high': FoundParameter(np.float64(0.9), '1', inf),
        'knee': FoundParameter(nan, '1', nan),
        'list': FoundParameter(np.array([1.0, inf, nan]), 's', np.array([0.1, nan, inf])),
        'channel': FoundParameter('x', '', None),
    }
    table = {'sine:5Hz': nan, 'hold:4V': inf, 'idle': 0.1}
    return replace(
        found,
        effects=(replace(effect, share=1.02, rms_percent=nan, parameters=parameters),),
        unexplained=replace(found.unexplained, share=-0.02),
        before=Errors(0.5, table, {'5': nan, '0.5': 0.25}),
        refit=Errors(inf, table, {}),
        after=Errors(nan, {}, {}),
        noise_floor=None,
        smallest_detectable=inf,
    )


@pytest.mark.parametrize('make', [*VERDICTS, unknown, hostile])
def test_every_diagnosis_is_valid_and_strict(make):
    result = example(make) if isinstance(make, str) else make()
    text = json_text(result)
    assert '\n' not in text
    check(json.loads(text, parse_constant=refuse))


def test_the_schema_tells_good_from_bad():
    schema, data = diagnosis_schema(), to_json(example('class'))
    jsonschema.Draft202012Validator.check_schema(schema)
    for key in schema['required']:
        with pytest.raises(jsonschema.ValidationError):
            check({k: x for k, x in data.items() if k != key})
    for change in (
        {'verdict': 'perhaps'},
        {'effects': [{**data['effects'][0], 'share_of_explainable': 1.1}]},
        {'class': {'names': ['creep'], 'separating_experiment': 'a hold'}},
        {'error': {**data['error'], 'unit': 'nm'}},
        {'noise_floor': {'percent_of_stroke': 'low', 'source': ''}},
    ):
        with pytest.raises(jsonschema.ValidationError):
            check({**data, **change})


def test_what_it_says():
    found = example('named')
    data = to_json(found)
    assert data['schema_version'] == 2
    assert data['package_version'] == __version__
    assert data['verdict'] == 'named'
    (effect,) = data['effects']
    assert (effect['name'], effect['slot']) == ('creep', 'hidden')
    assert effect['parameters']['gain'] == {
        'value': [0.012, 0.01],
        'unit': '1',
        'std': [0.0004, 0.0006],
    }
    assert effect['parameters']['time_constant']['std'] is None
    error = data['error']
    assert (error['unit'], error['formula']) == ('% of stroke', FORMULA)
    assert error['before']['overall'] == found.before.overall > error['after']['overall']
    assert error['refit']['overall'] == found.refit.overall
    # a frequency is written in one way only
    assert list(error['after']['by_frequency']) == ['5.0', '50.0']
    assert data['class'] is None
    assert data['seed'] == 5
    assert data['records'] == ['val.npz']
    assert (data['hysteresis']['law'], data['held_out_kinds']) == ('plays', [])
    assert to_json(example('class'))['class']['names'] == ['creep', 'thermal_drift', 'gain_drift']


def test_a_refit_says_what_may_hide_in_it():
    data = to_json(example('refitted'))
    assert data['verdict'] == 'refitted' and data['effects'] == []
    assert len(data['class']['names']) == 3
    assert data['hysteresis'] == {
        'law': 'preisach',
        'errors_of_laws': {'plays': 0.3, 'duhem': 0.1},
    }
    assert data['held_out_kinds'] == ['sine:5Hz', 'staircase', 'sine:50Hz']


def test_what_is_not_finite():
    data = to_json(unknown())
    parameters = data['effects'][0]['parameters']
    # an end that is not there stays apart from one that is unknown
    assert parameters['low']['value'] == '-inf'
    assert parameters['high'] == {'value': 0.9, 'unit': '1', 'std': None}
    assert (parameters['knee']['value'], parameters['knee']['std']) == (None, None)
    assert parameters['list']['value'] == [1.0, 'inf', None]
    assert parameters['list']['std'] == [0.1, None, None]
    assert parameters['channel']['value'] == 'x'
    assert data['effects'][0]['share_of_explainable'] == 1.0
    assert data['unexplained']['share_of_explainable'] == 0.0
    assert min(c['share_of_explainable'] for c in data['candidates']) == 0.0
    by_segment = data['error']['before']['by_segment']
    assert by_segment == {'sine:5Hz': None, 'hold:4V': None, 'idle': 0.1}
    assert data['error']['before']['by_frequency'] == {'5.0': None, '0.5': 0.25}
    assert data['error']['after']['overall'] > 1e300
    assert data['noise_floor']['percent_of_stroke'] is None
    assert data['smallest_detectable']['percent_of_stroke'] is None

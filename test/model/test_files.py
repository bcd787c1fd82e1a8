# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Model files: exact, whole, and safe to read from anybody."""

import copy
from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_array_equal
import paper_stage
from paper_stage import CONFIG
from piezo_ident.common.errors import ConfigError, ModelError
from piezo_ident.model.files import (
    load,
    model_from_dict,
    model_to_dict,
    model_to_yaml,
    plain,
    SCHEMA_VERSION,
)
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.dynamics import Delay
import pytest
import yaml

PAPER = replace(
    paper_stage.PAPER,
    delay=Delay(3, 0.25),
    effects=(EffectSetting('creep', {'gain': [0.012, 0.01], 'time_constant': [0.1, 1 / 3]}),),
    identification={
        'method': 'three steps',
        'records': ['a.csv', 'b: c.csv'],
        'uncertainties': {'weights': np.array([1e-5, 2 / 3]), 'delay': np.float64(0.3)},
        'warnings': ['the sensor noise is 2 % of stroke: "µm"'],
    },
)


def data() -> dict:
    return copy.deepcopy(model_to_dict(PAPER))


def test_save_and_load_is_exact(tmp_path):
    PAPER.save(tmp_path / 'model.yaml')
    again = load(tmp_path / 'model.yaml')
    assert model_to_dict(again) == model_to_dict(PAPER)
    assert again.scaling == PAPER.scaling
    assert again.delay == PAPER.delay
    for part, name in (
        ('hysteresis', 'thresholds'),
        ('hysteresis', 'weights'),
        ('dynamics', 'a'),
        ('dynamics', 'b'),
    ):
        one, two = (getattr(getattr(m, part), name) for m in (PAPER, again))
        assert_array_equal(one, two)
    v = np.linspace(0, 10, 500)
    assert_array_equal(again.stream().process(v), PAPER.stream().process(v))
    # and writing it again gives the same text
    assert model_to_yaml(again) == (tmp_path / 'model.yaml').read_text(encoding='utf-8')


@pytest.mark.parametrize(
    'wide',
    [
        {'p0': 0.05},
        {'p0': 0.05, 'curves': np.full((9, 3), 0.01)},
        {'bias': np.full(9, 0.02), 'span': (0.0, 1.1)},
        {'thresholds': [], 'weights': [], 'curves': np.zeros((0, 3)), 'bias': []},
    ],
)
def test_a_wide_hysteresis_survives_exactly(wide, tmp_path):
    model = replace(PAPER, hysteresis=replace(PAPER.hysteresis, **wide))
    model.save(tmp_path / 'model.yaml')
    again = load(tmp_path / 'model.yaml')
    assert_array_equal(again.hysteresis.numbers, model.hysteresis.numbers)
    assert again.hysteresis.span == model.hysteresis.span
    v = np.linspace(0, 10, 500)
    assert_array_equal(again.simulate(v), model.simulate(v))


def test_a_plain_hysteresis_has_no_keys_of_a_wide_one():
    assert set(data()['hysteresis']) == {'thresholds', 'weights', 'p1', 'p2'}


@settings(deadline=None, max_examples=50)
@given(
    st.lists(st.floats(0, 1e3, allow_subnormal=True), min_size=2, max_size=2),
    st.floats(-1e300, 1e300),
)
def test_any_number_survives(weights, p1):
    d = data()
    d['hysteresis'] = {'thresholds': [0.1, 1 / 3], 'weights': weights, 'p1': p1, 'p2': -1e-300}
    text = yaml.safe_dump(model_to_dict(model_from_dict(d)))
    again = model_from_dict(yaml.safe_load(text))
    assert again.hysteresis.weights.tolist() == weights
    assert again.hysteresis.p1 == p1
    assert again.hysteresis.p2 == -1e-300


def test_numbers_as_people_write_them(tmp_path):
    text = (CONFIG / 'stage_paper.yaml').read_text(encoding='utf-8').split('sensor:')[0]
    # YAML 1.1 takes 75e-6 for text
    path = tmp_path / 'model.yaml'
    path.write_text(text.replace('75.0e-6', '75e-6').replace('20000.0', '2e4'), encoding='utf-8')
    model = load(path)
    assert model.scaling.Y == 75e-6
    assert model.sample_rate == 2e4


def test_file_without_a_schema_is_one_of_today():
    d = data()
    del d['schema_version'], d['package_version'], d['identification'], d['effects']
    assert model_from_dict(d).effects == ()


@pytest.mark.parametrize(
    'key', ['sample_rate', 'input', 'output', 'delay', 'hysteresis', 'dynamics']
)
def test_missing_part_is_named(key):
    d = data()
    del d[key]
    with pytest.raises(ModelError, match=f'missing {key}'):
        model_from_dict(d, 'm.yaml')


def test_unknown_keys_are_named():
    with pytest.raises(ModelError, match=r'm.yaml: unknown keys 7, dynmics'):
        model_from_dict({**data(), 'dynmics': {}, 7: 1}, 'm.yaml')


@pytest.mark.parametrize(
    ('part', 'key', 'message'),
    [
        ('delay', 'sample', r'sample in delay; did you mean samples\?'),
        ('hysteresis', 'P1', r'P1 in hysteresis; did you mean p1\?'),
        ('hysteresis', 'zzz', 'known are thresholds, weights, p1, p2'),
        ('dynamics', 3, 'unknown keys 3 in dynamics'),
    ],
)
def test_unknown_keys_inside_are_named(part, key, message):
    d = data()
    d[part][key] = 1.0
    with pytest.raises(ModelError, match=f'm.yaml: .*{message}'):
        model_from_dict(d, 'm.yaml')


@pytest.mark.parametrize(
    ('wrong', 'key'),
    [('wieghts', 'weights'), ('dynmics', 'dynamics'), ('paramters', 'parameters')],
)
def test_a_misspelt_key_is_named_rather_than_missing(wrong, key):
    text = model_to_yaml(PAPER).replace(f'{key}:', f'{wrong}:', 1)
    with pytest.raises(ModelError, match=f'{wrong}.*did you mean {key}'):
        model_from_dict(yaml.safe_load(text))


HUGE = 10**400
WRONG = {
    'sample_rate': ('fast', True, None, [1], 0, '.nan', HUGE),
    'input': ([1],),
    'input.V': (-1, {}),
    'input.range': ([0], '0..10', [10, 0], [0, 'ten'], [0, HUGE]),
    'output.Y': (0, float('inf')),
    'delay.samples': (1.5, -1, float('nan'), float('inf'), 1e18),
    'delay.fraction': (1,),
    'hysteresis.weights': ([0.1], {}, None),
    'hysteresis.p1': ('x',),
    'hysteresis.thresholds': ([[0.1]],),
    'dynamics.a': ([-1.1], 'none'),
    'dynamics.b': ([], [True], [HUGE]),
    'effects': (
        *({'name': 'creep'}, ['creep'], [{'name': 'creep'}]),
        *([{'name': name, 'parameters': {}}] for name in ('magic', None)),
        [{'name': 'creep', 'parameters': {1: 2, 'gain': [1]}}],
        [{'name': 'creep', 'parameters': {'gain': [HUGE], 'time_constant': [1]}}],
        [{'name': 'creep', 'parameters': {'gain': [[1]], 'time_constant': [1]}}],
    ),
    'identification': ([1],),
}
#: with what is said of them
TOLD = [
    *(('schema_version', x, 'schema_version') for x in (0, -1, 1.5, 'one', None, True, [1])),
    *(('schema_version', x, f'schema {x}, .* piezo_ident') for x in (SCHEMA_VERSION + 1, 99)),
    ('hysteresis.curves', [0.1] * 9, 'hysteresis.curves .*list'),
    ('hysteresis.curves', [[0.1]], r'curves of shape \(1, 1\) for 9'),
    ('hysteresis.curves', [[0.1], [0.1, 0.2]], 'hysteresis.curves .*rows'),
    ('hysteresis.curves', 'none', 'hysteresis.curves .*list'),
    ('hysteresis.bias', [0.1], r'bias of shape \(1,\) for 9'),
    ('hysteresis.bias', {}, 'bias .*list'),
    ('hysteresis.span', [0.0], 'hysteresis.span '),
    ('hysteresis.p0', [1], r'p0 .*\[1\]'),
]


@pytest.mark.parametrize(
    ('key', 'value', 'says'), [*((key, x, '') for key in WRONG for x in WRONG[key]), *TOLD]
)
def test_wrong_values_are_refused_in_one_line(key, value, says):
    d = data()
    *path, last = key.split('.')
    place = d
    for name in path:
        place = place[name]
    place[last] = value
    with pytest.raises(ModelError, match=says or None) as caught:
        model_from_dict(d, 'm.yaml')
    assert str(caught.value).startswith('m.yaml')
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    'text', ['', '- a\n- list', 'a: !!python/object/apply:os.system ["true"]', '[' * 5000]
)
def test_a_file_that_is_no_model_is_refused(tmp_path, text):
    path = tmp_path / 'model.yaml'
    path.write_text(text, encoding='utf-8')
    with pytest.raises((ConfigError, ModelError), match=r'model\.yaml'):
        load(path)


def test_plain_data_are_plain():
    class Tagged(dict):
        """A mapping of another class."""

    given_ = {'a': np.float64(1.5), 1: np.array([1, 2]), 'c': (np.bool_(True), Tagged(x=None))}
    assert plain(given_) == {'a': 1.5, '1': [1, 2], 'c': [True, {'x': None}]}
    assert type(plain(given_)['c'][0]) is bool
    assert type(plain(given_)['1'][0]) is int


@pytest.mark.parametrize(
    ('part', 'key', 'value'),
    [
        ('input', 'v0', 1e300),
        ('input', 'V', 5e-324),
        ('hysteresis', 'span', [-1e300, 1.0]),
        ('hysteresis', 'relaxations', [[1e-300, 0.1, 0.1, 0.1]]),
    ],
)
def test_numbers_that_overflow_are_refused(part, key, value):
    wrong = data()
    wrong['hysteresis']['relaxations'] = [[10.0, 0.1, 0.0, 0.0]]
    wrong[part][key] = value
    with pytest.raises(ModelError, match=r'mine: the displacement over .* is not finite'):
        model_from_dict(wrong, 'mine')

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Every effect of the catalogue: neutral values, streaming, files, rest, refusals, trials."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import get_args

from effect_table import (
    alone,
    FS,
    H,
    other,
    PAPER,
    played,
    rich,
    signal,
    VIEW,
    VISIBLE,
    with_effects,
)
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from piezo_ident.common.errors import ModelError
from piezo_ident.effects import catalogue, Effect, find_effect, Parameter, Trial, View
from piezo_ident.model.files import load, model_to_dict
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.operators.chain import Block, Slot
import pytest

EVERY = sorted(VISIBLE)


def shape_of(name: str) -> dict:
    """Return the visible setting without the parameters that may be left out."""
    needed = {p.name for p in catalogue()[name].parameters if p.default is None}
    return {key: value for key, value in VISIBLE[name].items() if key in needed}


def with_setting(name: str, values: dict):
    return replace(PAPER, effects=(EffectSetting(name, values),))


def test_what_is_tested_here_is_in_the_catalogue():
    own = {n for n, e in catalogue().items() if e.__module__.startswith('piezo_ident.')}
    assert set(VISIBLE) == own


@pytest.mark.parametrize('name', sorted(catalogue()))
def test_effect_is_declared_in_full(name):
    effect = catalogue()[name]
    assert effect.name == name
    assert effect.slot in get_args(Slot)
    assert effect.description
    assert effect.needs
    assert any(not np.isnan(p.neutral) for p in effect.parameters)
    assert effect.__doc__
    assert 'Notes' in effect.__doc__
    for p in effect.parameters:
        assert p.unit
        assert p.description
        assert p.lower < p.upper
        assert np.isnan(p.neutral) or p.lower <= p.neutral <= p.upper
        # an amplitude can be left out, and moved from its neutral value to either side of a step
        if p.is_amplitude:
            assert p.default == p.neutral
            assert p.neutral + p.step <= p.upper
        assert p.scale in ('linear', 'log', 'fixed')
        assert p.kind == 'text' or p.scale != 'log' or p.lower >= 0.0


def test_effects_that_are_driven_by_time_say_so():
    driven = {name for name in EVERY if catalogue()[name].time_driven}
    assert driven == {'gain_drift', 'periodic_disturbance', 'thermal_drift'}


@pytest.mark.parametrize('name', EVERY)
def test_neutral_values_change_nothing_nor_does_a_file_of_them(name, tmp_path):
    v, effect = signal(), catalogue()[name]
    plain, neutral = played(PAPER, v), with_setting(name, effect.neutral(VISIBLE[name]))
    assert_array_equal(played(neutral, v), plain)
    # nor do those that are left out
    assert_array_equal(played(with_setting(name, shape_of(name)), v), plain)
    # and the values of the other tests do change something
    assert np.abs(played(with_effects(name), v) - plain).max() > 1e-9
    # infinity and the like have to survive the file too
    neutral.save(tmp_path / 'model.yaml')
    again = load(tmp_path / 'model.yaml')
    assert model_to_dict(again)['effects'] == model_to_dict(neutral)['effects']
    assert_array_equal(played(again, v), plain)


@pytest.mark.parametrize('name', EVERY)
def test_inputs_are_left_alone(name):
    u, other_axis = signal() / 10, other(4000)
    before, channel = u.copy(), other_axis.copy()
    values = {k: np.array(x) if isinstance(x, list) else x for k, x in VISIBLE[name].items()}
    given_values = {k: np.copy(x) for k, x in values.items()}
    alone(name, values, u, other_axis=other_axis)
    assert_array_equal(u, before)
    assert_array_equal(other_axis, channel)
    for key, value in given_values.items():
        assert_array_equal(values[key], value)


@pytest.mark.parametrize('name', EVERY)
def test_rest_is_rest(name):
    # after a reset a constant command moves nothing but what time itself moves
    effect = find_effect(name)(FS, VISIBLE[name], H)
    for at in (0.3, 0.9, 0.0):
        rest = effect.reset(at, at)
        still, channels = np.full(200, at), {'other_axis': np.full(200, 0.25)}
        x = effect.process(Block(np.zeros(200), still, still, channels)).x
        assert_array_equal(x, np.full(200, x[0]))
        if name != 'periodic_disturbance':
            assert x[0] == pytest.approx(rest, abs=1e-15)


def numbers_of(state):
    """Yield every number that an effect holds, in itself or in what it is made of."""
    if isinstance(state, np.ndarray | float):
        yield from np.ravel(state)
    elif isinstance(state, list | tuple):
        for part in state:
            yield from numbers_of(part)
    elif hasattr(state, '__dict__'):
        yield from numbers_of(list(vars(state).values()))


@pytest.mark.parametrize('name', EVERY)
def test_what_dies_away_at_rest_becomes_zero(name):
    # a number near the end of its range would cost a hundred times the time of another
    values = VISIBLE[name] | ({'time_constant': [1e-3, 2e-3]} if name == 'creep' else {})
    effect = find_effect(name)(FS, values, H)
    u = np.concatenate([signal() / 10, np.zeros(200_000)])
    effect.reset(0.0, 0.0)
    # some bounds of parameters are that small
    before = set(numbers_of(effect))
    channels = {'other_axis': np.concatenate([other(4000), np.zeros(200_000)])}
    effect.process(Block(np.arange(u.size) / FS, u, u, channels))
    small = {x for x in numbers_of(effect) if 0.0 < abs(x) < 1e-200}
    assert not small - before


@pytest.mark.parametrize('name', EVERY)
def test_reset_forgets_everything(name):
    u, effect = signal() / 10, find_effect(name)(FS, VISIBLE[name], H)
    block = Block(np.arange(u.size) / FS, u, u, {'other_axis': other(u.size)})
    effect.reset(u[0], u[0])
    first = effect.process(block).x
    effect.reset(u[0], u[0])
    assert_array_equal(effect.process(block).x, first)


@settings(deadline=None, max_examples=80)
@given(
    cuts=st.lists(st.integers(0, 4000), max_size=8),
    names=st.permutations(EVERY).flatmap(
        lambda order: st.integers(1, len(order)).map(lambda n: order[:n])
    ),
    t0=st.sampled_from([0.0, 3.7, 1e4]),
)
def test_result_does_not_depend_on_the_cutting(cuts, names, t0):
    model, v, other_axis = with_effects(*names), signal(), other(4000)
    t = t0 + np.arange(v.size) / FS
    whole = model.stream().process(v, t, {'other_axis': other_axis})
    run, edges = model.stream(), [0, *sorted(cuts), v.size]
    parts = [
        run.process(v[a:b], t[a:b], {'other_axis': other_axis[a:b]}) for a, b in pairwise(edges)
    ]
    assert_allclose(np.concatenate(parts), whole, rtol=0, atol=1e-12 * 75e-6)


def test_saving_and_loading_changes_nothing(tmp_path):
    model = with_effects(*VISIBLE)
    model.save(tmp_path / 'model.yaml')
    again = load(tmp_path / 'model.yaml')
    assert [e.name for e in again.effects] == list(VISIBLE)
    assert_array_equal(played(again, signal()), played(model, signal()))


@pytest.mark.parametrize(
    ('name', 'p'),
    [(n, p) for n in EVERY for p in catalogue()[n].parameters if p.kind == 'number'],
    ids=lambda x: getattr(x, 'name', x),
)
def test_numbers_out_of_bounds_are_refused(name, p):
    def given(x):
        complete = find_effect(name).check(VISIBLE[name])
        value = np.full(np.shape(complete[p.name]), x) if p.vector else x
        return {**VISIBLE[name], p.name: value}

    beyond = [float('nan')]
    for end in (p.lower, p.upper):
        if np.isfinite(end):
            beyond.append(float(np.nextafter(end, np.inf if end == p.upper else -np.inf)))
    for x in beyond:
        with pytest.raises(ModelError, match=f'{name}: {p.name} = .* leaves its bounds'):
            find_effect(name).check(given(x))
    other, shown = (1.0, '1.0') if p.vector else ([1.0], r'\[1.0\]')
    with pytest.raises(ModelError, match=f'{name}: {p.name} .* {shown}'):
        find_effect(name).check({**VISIBLE[name], p.name: other})
    with pytest.raises(ModelError, match=f"{name}: {p.name} .*'much'"):
        find_effect(name).check({**VISIBLE[name], p.name: 'much'})


@pytest.mark.parametrize('name', EVERY)
def test_missing_and_unknown_parameters_are_refused(name):
    effect = find_effect(name)
    with pytest.raises(ModelError, match='unknown'):
        effect.check({**VISIBLE[name], 'speed': 0.0})
    for key in shape_of(name):
        with pytest.raises(ModelError, match=f'missing .*{key}'):
            effect.check({k: x for k, x in VISIBLE[name].items() if k != key})


@pytest.mark.parametrize(
    ('name', 'change', 'says'),
    [
        ('creep', {'gain': [0.1]}, 'creep: .*gain has 1'),
        ('periodic_disturbance', {'phase': [0.0]}, 'periodic_disturbance: .*phase has 1'),
        ('changed_dynamics', {'damping': [0.1]}, 'changed_dynamics: .*damping has 1'),
        ('changed_dynamics', {'frequency': [100.0, 10_000.0]}, 'mode at 10000 Hz'),
        ('cross_coupling', {'frequency': 10_000.0}, 'mode at 10000 Hz'),
        ('cross_coupling', {'channel': 2.0}, r'cross_coupling: channel .*2\.0'),
        ('cross_coupling', {'channel': ''}, "cross_coupling: channel .*''"),
        ('gain_drift', {'time': [0.0, 0.2, 0.2]}, r'time = .* 0\.2, 0\.2\]'),
        ('gain_drift', {'time': [], 'gain': []}, r'time = \[\]'),
        ('noncongruent_minor_loops', {'threshold': [], 'slope': []}, 'minor_loops: .*threshold'),
        ('saturation', {'low': 0.6}, r'low = 0\.6 .* high = '),
    ],
)
def test_values_that_contradict_each_other_are_refused(name, change, says):
    with pytest.raises(ModelError, match=says):
        find_effect(name)(FS, {**VISIBLE[name], **change}, H)


def columns(effect: type[Effect], trial: Trial, v: np.ndarray) -> list[np.ndarray]:
    """Return what each setting of a trial adds to the prediction, as a share of the span."""
    plain = played(PAPER, v)
    return [(played(with_setting(effect.name, s), v) - plain) / 75e-6 for s in trial.settings()]


@pytest.mark.parametrize('name', EVERY)
def test_on_a_rich_input_every_column_of_a_trial_is_seen_and_every_step_a_difference(name):
    effect, v = catalogue()[name], rich()
    assert effect.trials(VIEW)
    for trial in effect.trials(VIEW):
        each = columns(effect, trial, v)
        for column in each:
            assert np.all(np.isfinite(column))
            # a step is small against the span and large against rounding
            size = np.sqrt(np.mean(column**2))
            assert 1e-6 < size < (0.1 if trial.moves else 1.0), (dict(trial.values), size)
        if not trial.moves or name == 'amplifier_lag':
            continue
        # twice the step makes about twice the column, jumps and powers of the speed included
        twice = replace(trial, steps=tuple(2 * s for s in trial.steps))
        for one, two in zip(each, columns(effect, twice, v), strict=True):
            bent = np.sqrt(np.mean((two - 2 * one) ** 2) / np.mean(two**2))
            assert bent < 0.25, (dict(trial.values), bent)


@pytest.mark.parametrize('name', EVERY)
def test_trials_start_from_nothing(name):
    effect, v = catalogue()[name], signal()
    for trial in effect.trials(VIEW):
        if trial.moves:
            model = with_setting(name, trial.values)
            assert_array_equal(played(model, v), played(PAPER, v))
            assert len(trial.settings()) == len(trial.moves) == len(trial.steps)
        else:
            assert len(trial.settings()) == 1


@settings(deadline=None, max_examples=60)
@given(
    rate=st.floats(20.0, 1e6),
    low=st.floats(-2.0, 2.0),
    span=st.just(0.0) | st.floats(1e-9, 3.0),
    fastest=st.just(0.0) | st.floats(1e-9, 1e5),
    duration=st.floats(0.01, 1e5),
    lines=st.lists(st.floats(1e-6, 1e6), max_size=3),
    modes=st.lists(st.tuples(st.floats(0.1, 1e6), st.floats(1e-3, 1.0)), max_size=5),
    top=st.floats(0.0, 1e6),
)
def test_trials_are_valid_on_any_data(rate, low, span, fastest, duration, lines, modes, top):
    view = View(
        sample_rate=rate,
        low=low,
        high=low + span,
        speeds=fastest * np.array([0.0, 0.1, 0.5, 0.9, 1.0]),
        duration=duration,
        channels={'still': (1.0, 0.0), 'temperature': (290.0, 0.1)},
        lines=tuple(lines),
        modes=tuple(modes),
        max_frequency=top,
        thresholds=H.thresholds,
    )
    for name in EVERY:
        effect = catalogue()[name]
        trials = effect.trials(view)
        assert len(trials) <= 24
        for trial in trials:
            assert set(trial.values) == {p.name for p in effect.parameters}
            for setting in trial.settings():
                effect(rate, setting, H)


def test_trials_need_what_an_effect_needs_and_another_displacement_is_no_cause():
    moving = {'v_b': (0.0, 1.0), 'y_b': (0.0, 1.0), 'heat': (0.0, 1.0)}
    view = View(FS, 0.0, 1.0, np.ones(5), 1.0, channels=moving)
    trials = find_effect('cross_coupling').trials(view)
    assert {trial.values['channel'] for trial in trials} == {'v_b', 'heat'}
    view = View(FS, 0.0, 0.0, np.zeros(5), 1.0)
    for name in ('backlash', 'cross_coupling', 'periodic_disturbance', 'slew_limit'):
        assert catalogue()[name].trials(view) == ()
    assert catalogue()['rate_dependent_hysteresis'].trials(view) == ()


def test_trials_of_an_effect_that_only_declares_are_a_product():
    nan = float('nan')

    class Mine(Effect):
        name = 'mine'
        slot = 'output'
        parameters = (
            Parameter('gain', '1', 'g', 0.0, -1.0, 1.0, vector=True, default=0.0, step=0.01),
            Parameter('at', '1', 'a', nan, 0.0, 1.0, vector=True, tries=([0.1, 0.2], [0.5])),
            Parameter('size', '1', 's', nan, 0.0, 1.0, tries=(0.3, 0.4)),
            Parameter('bias', '1', 'b', nan, 0.0, 1.0, default=0.7),
        )

    trials = Mine.trials(VIEW)
    assert [(t.values['at'].tolist(), t.values['size']) for t in trials] == [
        ([0.1, 0.2], 0.3),
        ([0.1, 0.2], 0.4),
        ([0.5], 0.3),
        ([0.5], 0.4),
    ]
    assert trials[0].moves == (('gain', 0), ('gain', 1))
    assert [s['gain'].tolist() for s in trials[0].settings()] == [[0.01, 0.0], [0.0, 0.01]]
    assert trials[0].values['gain'].tolist() == [0.0, 0.0]
    assert {t.values['bias'] for t in trials} == {0.7}

    class Shapeless(Mine):
        parameters = (*Mine.parameters, Parameter('width', '1', 'w', nan, 0.0, 1.0))

    assert Shapeless.trials(VIEW) == ()


def test_the_page_has_a_row_for_each_name():
    page = Path(__file__).resolve().parents[3] / 'docs/diagnosis.md'
    body = page.read_text(encoding='utf-8').partition('<!-- table: names -->')[2]
    rows = [
        [cell.strip() for cell in line.split('|')[1:-1]]
        for line in body.partition('<!-- end -->')[0].strip().splitlines()[2:]
    ]
    assert sorted(name.strip('`') for name, _, _ in rows) == sorted(VISIBLE)
    assert all(imitated for _, _, imitated in rows)


def test_the_readme_counts_the_names_and_has_two_screens():
    readme = (Path(__file__).resolve().parents[3] / 'README.md').read_text(encoding='utf-8')
    assert f'among {len(VISIBLE)} effects' in ' '.join(readme.split())
    assert len(readme.splitlines()) <= 80


def test_creep_is_tried_up_to_the_time_that_is_judged():
    for judged, longest in ((1.5, 1.5), (np.inf, 8.0)):
        view = View(FS, 0.0, 1.0, np.ones(5), 8.0, judged=judged)
        trials = find_effect('creep').trials(view)
        assert max(max(x.values['time_constant']) for x in trials) == pytest.approx(longest)
        assert min(min(x.values['time_constant']) for x in trials) == pytest.approx(0.01)
    # elements that look like a gain of H in slow motion are none
    trials = find_effect('creep').trials(replace(view, is_fast=False))
    assert min(min(x.values['time_constant']) for x in trials) == pytest.approx(0.05)


def test_a_slew_limit_is_tried_from_the_slowest_motion_to_little_below_the_fastest():
    speeds = np.array([1.0, 2.0, 5.0, 100.0])
    view = View(FS, 0.0, 0.0, speeds, 1.0)
    tried = [trial.values['limit'] for trial in find_effect('slew_limit').trials(view)]
    assert min(tried) == speeds[0]
    assert {70.0, 80.0, 90.0} <= {round(limit, 9) for limit in tried}
    assert max(tried) >= 0.5 * view.span * FS

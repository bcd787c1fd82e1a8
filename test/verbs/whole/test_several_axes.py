# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A stage of several axes: identified, diagnosed, predicted, inverted, saved and exported."""

from dataclasses import replace
import subprocess

from axes_scanner import chain, CROSS, path, play, raster, scanner, sweeps
from c_compiler import COMPILER, needs_compiler, STRICT
import numpy as np
import piezo_ident as pi
from piezo_ident.identification.results import Steps
from piezo_ident.model.axis_records import axis_record
from piezo_ident.model.multi_axis import MultiAxisModel
from piezo_ident.uncertainty.band import PredictionBand
from piezo_ident.uncertainty.promises import with_band
from piezo_ident.verbs.predict import bands, predict
import pytest

#: plays voltages from its input through a header, a line a sample
MAIN = """
#include <stdio.h>
#include "stage.h"

int main(void)
{
    stage_state s;
    double v[2] = {0.0, 0.0}, y[2];
    stage_reset(&s, v, y);
    while (scanf("%lf %lf", &v[0], &v[1]) == 2) {
        stage_step(&s, v, y);
        printf("%.17g %.17g\\n", y[0], y[1]);
    }
    return 0;
}
"""
#: saves the choice of numbers
FEW = pi.Settings(thresholds=8, order=(1, 1))
ONLY_PATHS = pi.DiagnosisSettings(effects=('cross_coupling', 'backlash'))


@pytest.fixture(scope='module')
def one_by_one():
    rng = np.random.default_rng(0)
    first, second, rest = sweeps(2000, rng), sweeps(2000, rng), np.zeros(2000)
    v, v_b = np.concatenate([first, rest]), np.concatenate([rest, second])
    return pi.identify(play(v, v_b, name='one by one'), FEW)


@pytest.fixture(scope='module')
def diagnosed(one_by_one):
    rng = np.random.default_rng(1)
    both = play(sweeps(2000, rng), sweeps(2000, rng), seed=1, name='both')
    return pi.diagnose(one_by_one.model, both, ONLY_PATHS)


def test_axes_that_move_one_after_the_other_are_identified_each_alone(one_by_one):
    assert list(one_by_one) == ['y', 'y_b']
    for axis, result in one_by_one.items():
        assert result.headline.percent < 0.1
        assert result.model.scaling.Y == pytest.approx(scanner().axes[axis].scaling.Y, rel=0.1)


def test_each_path_is_named_with_its_source_and_size_and_predicts_a_raster(diagnosed, one_by_one):
    for axis, source, share in (('y', 'motion_b', CROSS[1]), ('y_b', 'motion', CROSS[0])):
        (effect,) = diagnosed[axis].effects
        assert effect.name == 'cross_coupling'
        assert effect.parameters['channel'].value == source
        gain = effect.parameters['gain'].value * diagnosed[axis].model.scaling.Y
        assert gain == pytest.approx(share, rel=0.02)
    record = play(*raster(4000), seed=2)
    before, after = (m.predict(record) for m in (one_by_one.model, diagnosed.model))
    score = diagnosed.model.score(record)
    for axis in ('y', 'y_b'):
        assert before[axis].errors.percent > 0.3
        assert after[axis].errors.percent < 0.1
        assert score[axis] == (after[axis].errors_after_start or after[axis].errors)


def test_an_axis_that_never_moves_is_left_out_and_told():
    v = sweeps(1500, np.random.default_rng(4))
    first = pi.identify(play(v, np.zeros(1500)), FEW)
    assert isinstance(first, pi.Identification)
    assert any('y_b is not identified' in x for x in first.warnings)
    other = pi.identify(play(np.zeros(1500), v), FEW)
    assert list(other) == ['y_b']
    assert any('axis y is not identified' in x for x in other['y_b'].warnings)


def test_axes_of_a_raster_are_identified():
    result = pi.identify(play(*raster(2500)), FEW)
    for axis in ('y', 'y_b'):
        # what the other axis does is no part of either chain
        assert result[axis].headline.percent < 1.5


def test_all_axes_are_inverted_together():
    stage, t = scanner(), np.arange(3000) / 1000.0
    wanted = {
        'y': 25e-6 * (1 - 0.8 * np.cos(2 * np.pi * 2 * t)),
        'y_b': 15e-6 * (1 - 0.8 * np.cos(2 * np.pi * 0.5 * t)),
    }
    drive = stage.inverse(wanted)
    assert set(drive.voltages) == {'v', 'v_b'}
    y = stage.simulate(drive.voltages)
    for axis, goal in wanted.items():
        assert np.abs(y[axis][drive.lead :] - goal).max() < 1e-4 * np.ptp(goal)
        assert drive.errors[axis] < 0.005
    # each alone, as if the other did not move, misses by its path
    alone = {axis: pi.invert(stage.own(axis), y) for axis, y in wanted.items()}
    y = stage.simulate({f'v{axis[1:]}': x.v[x.lead :] for axis, x in alone.items()})
    assert np.ptp(y['y'] - wanted['y']) > 4e-3 * np.ptp(wanted['y'])


def test_an_axis_that_is_not_named_stays_at_rest():
    drive = pi.invert(scanner(), {'y_b': np.full(500, 10e-6)})
    assert np.ptp(drive.predicted['y']) < 0.01e-6


@pytest.mark.parametrize('model', [scanner(), scanner().own('y')])
def test_a_channel_that_no_effect_uses_is_told_once(model):
    y = np.full(500, 10e-6)
    wanted = {'y': y} if isinstance(model, MultiAxisModel) else y
    with pytest.warns(UserWarning, match=r' channel heat$') as told:
        pi.invert(model, wanted, channels={'heat': y})
    assert len(told) == 1


@pytest.mark.parametrize(
    ('wanted', 'names'),
    [
        (np.zeros(10), 'y, y_b'),
        ({'z': np.zeros(10)}, 'z'),
        ({}, 'y, y_b'),
        ({'y': np.zeros(10), 'y_b': np.zeros(9)}, 'length'),
    ],
)
def test_motions_that_do_not_fit_the_axes_are_refused(wanted, names):
    with pytest.raises(pi.DataError, match=names):
        pi.invert(scanner(), wanted)


def test_one_file_holds_all_axes(tmp_path):
    stage, v = scanner(), dict(zip(('v', 'v_b'), raster(500), strict=True))
    stage.save(tmp_path / 'stage.yaml')
    read = pi.load(tmp_path / 'stage.yaml')
    assert isinstance(read, MultiAxisModel)
    for axis, y in stage.simulate(v).items():
        np.testing.assert_array_equal(read.simulate(v)[axis], y)


@pytest.mark.parametrize(
    ('text', 'names'),
    [
        ('schema_version: 5\naxes: {}\n', 'schema 5'),
        ('axes: {}\n', 'each axis'),
        ('axes: 3\n', 'axes'),
        ('axes: {z: {}}\n', 'z'),
        ('axes: {y: {sample_rate: 3}}\n', 'axes.y'),
    ],
)
def test_a_file_that_is_no_model_of_axes_is_refused_by_its_name(tmp_path, text, names):
    (tmp_path / 'wrong.yaml').write_text(text)
    with pytest.raises(pi.ModelError, match=f'wrong.yaml.*{names}'):
        pi.load(tmp_path / 'wrong.yaml')


ONE = chain([0.1, 0.1, 0.1], 0.5, 50e-6)


@pytest.mark.parametrize(
    ('work', 'names'),
    [
        (lambda: MultiAxisModel({'y': ONE, 'y_b': replace(ONE, sample_rate=2e3)}), 'sample_rate'),
        (lambda: MultiAxisModel({'y': path(ONE, 'motion_c', 0.01), 'y_b': ONE}), 'motion_c'),
        (lambda: pi.identify(play(*raster(500)), FEW, steps=Steps()), 'y, y_b'),
        # one name in C
        (
            lambda: pi.export_c(MultiAxisModel(dict.fromkeys(('y', 'y_b', 'y_B'), ONE))),
            'y_b and y_B',
        ),
        (lambda: scanner().simulate({'v': np.zeros(20), 'v_b': np.zeros(10)}), 'length'),
        (lambda: scanner().simulate({'v': [0.0], 'v_b': ['low']}), 'v_b: expected real numbers'),
    ],
)
def test_axes_that_do_not_belong_together_are_refused(work, names):
    with pytest.raises(pi.PiezoIdentError, match=names):
        work()


@pytest.mark.parametrize(('lacks', 'names'), [('v_b', 'no voltage v_b'), ('y_b', 'of y_b')])
def test_a_record_that_lacks_a_column_is_refused_by_its_name(lacks, names):
    v = np.linspace(0.0, 10.0, 100)
    columns = {k: x for k, x in {'v_b': v, 'y_b': 1e-6 * v}.items() if k != lacks}
    record = pi.Record.from_arrays(v, 1e-6 * v, sample_rate=1000.0, channels=columns)
    with pytest.raises(pi.DataError, match=names):
        pi.free_run(scanner(), record)


def test_an_axis_that_was_measured_is_compared_alone():
    whole = play(*raster(500))
    (piece,) = whole
    part = replace(piece, channels={'v_b': piece.channels['v_b']})
    run = pi.free_run(scanner(), replace(whole, pieces=(part,)), axes=['y'])
    assert list(run) == ['y'] and run['y'].errors.percent < 0.02


def test_a_band_is_made_for_the_axes_that_are_predicted():
    band = PredictionBand(np.array([1e-3, 2e-3, 1e-5]), np.ones(5), 1e3)
    model = MultiAxisModel({axis: with_band(x, band) for axis, x in scanner().axes.items()})
    record = play(*raster(500))
    (half,) = bands(model, record, {'y_b': predict(model, record)['y_b']}, 0.9)['y_b']
    assert half.shape == (500,) and half.min() > 0.0


def test_records_of_other_axes_are_refused_though_they_have_one_name():
    v = np.arange(10.0)
    y = 1e-6 * v
    one = pi.Record.from_arrays(v, y, sample_rate=10.0)
    two = pi.Record.from_arrays(v, y, sample_rate=10.0, channels={'v_b': v, 'y_b': y})
    for records in ([one, two], [two, one]):
        with pytest.raises(pi.DataError, match='y_b'):
            pi.identify(records)


def test_an_axis_sees_no_label_under_which_it_rests():
    moves, rests = np.linspace(0, 10, 100), np.zeros(100)
    v, v_b = np.concatenate([moves, rests]), np.concatenate([rests, moves])
    record = play(v, v_b, segments=(['triangle:1', 'triangle:2'], [0, 100]))
    labels = [axis_record(record, axis).labels for axis in ('y', 'y_b')]
    assert labels == [('triangle:1',), ('triangle:2',)]


@needs_compiler
@pytest.mark.parametrize('name', ['b', 'own'])
def test_the_header_in_c_does_what_the_model_does(name, tmp_path):
    first, second = scanner().axes.values()
    first, axis = path(first, f'motion_{name}', CROSS[1]), f'y_{name}'
    stage, v = MultiAxisModel({'y': first, axis: second}), [x - x[0] for x in raster(400)]
    (tmp_path / 'stage.h').write_text(pi.export_c(stage))
    (tmp_path / 'main.c').write_text(MAIN)
    command = [COMPILER, *STRICT, 'main.c', '-o', 'main', '-lm']
    subprocess.run(command, cwd=tmp_path, check=True)
    given = '\n'.join(f'{a!r} {b!r}' for a, b in np.transpose(v).tolist())
    done = subprocess.run([tmp_path / 'main'], input=given, capture_output=True, text=True)
    made = np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
    y = stage.simulate({'v': v[0], f'v_{name}': v[1]})
    np.testing.assert_allclose(made, np.column_stack([y['y'], y[axis]]), atol=1e-15)


def test_the_header_names_all_channels_that_the_caller_sets():
    first, second = scanner().axes.values()
    header = pi.export_c(MultiAxisModel({'y': path(first, 'heat', 0.01), 'y_b': second}))
    assert 's.own_y.channel[0]  heat' in header and 's.y.channel[0]  heat' in header

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Readings that a slow scanner loses now and then cost nothing, whatever is asked of a record."""

from dataclasses import replace
import json

from command_line import run
import numpy as np
import piezo_ident as pi
from piezo_ident.many.table import identified as cells
from piezo_ident.operators.play import play_columns
from piezo_ident.report.picture import plot
import pytest

#: samples; of fewer the noise of the check is not known
LENGTHS = {'fit': 2400, 'check': 3000, 'test': 1500}
NOISE, LOST = 0.012, 0.016


def scan(n, rng):
    """Return voltage and displacement [um] of random ramps, and which readings are lost."""
    knots, at = np.r_[0, rng.uniform(0, 150, n // 8)], np.r_[0, rng.integers(8, 50, n // 8)]
    v = np.interp(np.arange(n), np.cumsum(at), knots)
    plays = play_columns(v, np.array([25.0, 50.0, 75.0]), np.zeros(3))
    y = 41.2 + 0.025 * v + 0.007 * plays.sum(axis=0) + NOISE * rng.standard_normal(n)
    lost = rng.random(n) < LOST
    return v, np.where(lost, 0.0, y), lost


@pytest.fixture(scope='module')
def scanner(tmp_path_factory):
    folder, lost = tmp_path_factory.mktemp('scanner'), {}
    for seed, (name, n) in enumerate(LENGTHS.items()):
        v, y, lost[name] = scan(n, np.random.default_rng(seed))
        rows = np.column_stack([np.arange(n) / 50, v, y])
        head = 't [s],v [V],y [um]'
        np.savetxt(folder / f'{name}.csv', rows, delimiter=',', header=head, comments='')
    return folder, lost


@pytest.fixture(scope='module')
def identified(scanner):
    folder, _ = scanner
    return pi.identify(pi.read(folder / 'fit.csv'), pi.Settings(thresholds=6))


@pytest.fixture(scope='module')
def model(scanner, identified):
    identified.model.save(scanner[0] / 'model.yaml')
    return scanner[0] / 'model.yaml'


def test_a_model_of_lossy_readings_errs_by_the_noise(capsys, tmp_path, scanner, model):
    folder, lost = scanner
    out = tmp_path / 'out.csv'
    argv = ['predict', model, folder / 'test.csv', '--out', out, '--plot', tmp_path / 'out.png']
    code, text, _ = run(capsys, *argv, '--json')
    said = json.loads(text)
    assert code == 0 and said['whole']['percent_of_stroke'] < 0.4
    assert said['whole']['n'] == np.count_nonzero(~lost['test'])
    # nothing that stands in for a reading is written, or drawn, as one
    table = np.genfromtxt(out, delimiter=',', names=True)
    np.testing.assert_array_equal(np.isnan(table['y']), lost['test'])
    assert np.isfinite(table['y_hat']).all() and np.isfinite(table['v']).all()
    figure = plot(pi.free_run(pi.load(model), pi.read(folder / 'test.csv')))
    for axes in figure.axes[1:3]:
        np.testing.assert_array_equal(np.isnan(axes.lines[0].get_ydata()), lost['test'])
    assert f'{lost["test"].sum()} readings left out' in figure.axes[1].get_title('right')
    said = run(capsys, *argv, '--overwrite')[1]
    assert f'{lost["test"].sum()} readings are left out' in said


def test_no_effect_is_found_in_lossy_readings(capsys, tmp_path, scanner, model):
    folder, _ = scanner
    argv = ['diagnose', model, folder / 'check.csv', '--model', tmp_path / 'refined.yaml']
    code, text, _ = run(capsys, *argv, '--json')
    said = json.loads(text)
    assert code == 0 and said['verdict'] in ('none', 'refitted')
    refined = pi.load(tmp_path / 'refined.yaml')
    assert pi.free_run(refined, pi.read(folder / 'test.csv')).errors.percent < 0.4


def test_the_table_of_many_records_has_the_stroke_of_sound_readings(scanner, identified):
    folder, _ = scanner
    (piece,) = pi.read(folder / 'fit.csv')
    # a run of them looks like a place where the stage was
    y = np.where(abs(piece.t - 20) < 0.1, 0, piece.y)
    row = cells(identified, pi.Record((replace(piece, y=y),)))
    assert row['stroke'] == pytest.approx(identified.stroke, rel=0.02) and row['stroke'] < 7e-6

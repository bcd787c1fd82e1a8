# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The verbs of the command line on a stage of two axes."""

from dataclasses import replace
import json
from zipfile import ZipFile

from axes_scanner import play, raster, scanner, sweeps
from command_line import refuse, run, succeed
import numpy as np
import piezo_ident as pi
from piezo_ident.identification.results import Identification
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.report import check_report_folder
from piezo_ident.uncertainty.band import PredictionBand
from piezo_ident.uncertainty.promises import with_band
import pytest


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Return a folder with records of two axes, and the model of their stage."""
    made, rng = tmp_path_factory.mktemp('axes'), np.random.default_rng(0)
    for name in ('learn', 'both'):
        pi.write(play(sweeps(2000, rng), sweeps(2000, rng)), made / f'{name}.npz')
    pi.write(play(*raster(3000), seed=2), made / 'raster.npz')
    scanner().save(made / 'stage.yaml')
    return made


def test_identify_and_diagnose_write_the_model_of_all_axes(capsys, folder, tmp_path):
    model, refined = tmp_path / 'model.yaml', tmp_path / 'refined.yaml'
    learn, scan = folder / 'learn.npz', folder / 'raster.npz'
    words = ['identify', learn, '--validation', scan, '--model', model]
    words += ['--thresholds', '8', '--order', '1,1', '--delay', '1']
    data = json.loads(succeed(capsys, *words, '--json'))
    assert list(data['axes']) == ['y', 'y_b']
    assert data['validation'][0]['axes']['y_b']['whole']['percent_of_stroke'] > 0.1
    words = ['diagnose', model, folder / 'both.npz', '--only', 'cross_coupling']
    words += ['--model', refined]
    said = succeed(capsys, *words, '--report', tmp_path / 'report')
    assert 'motion_b' in said and str(refined) in said
    assert list(pi.load(refined).axes) == ['y', 'y_b']
    for axis in ('y', 'y_b'):
        page = tmp_path / 'report' / axis / 'report.html'
        assert page.is_file() and f'report: {page}' in said


def test_the_report_of_an_axis_is_kept_until_it_may_be_replaced(capsys, folder, tmp_path):
    page, words = tmp_path / 'y_b' / 'report.html', ['identify', folder / 'learn.npz']
    words += ['--report', tmp_path]
    page.parent.mkdir()
    page.write_text('mine')
    refuse(capsys, tmp_path, words, f'{page}: exists and is of no earlier report')
    for path in (page.with_name('identification.json'), tmp_path / 'model.yaml'):
        path.write_text('')
    refuse(capsys, tmp_path, words, f'{page.parent}: holds a report already', '--overwrite')
    check_report_folder(tmp_path, Identification)
    refuse(capsys, tmp_path, ['diagnose', folder / 'stage.yaml', *words[1:]], 'of identification')


def test_invert_reads_a_motion_of_each_axis(capsys, folder, tmp_path):
    t = np.arange(1000) / 1000.0
    y, y_b = (1e-5 * (1 - 0.8 * np.cos(2 * np.pi * f * t)) for f in (3, 1))
    np.savez(tmp_path / 'wanted.npz', t=t, y=y, y_b=y_b)
    out = tmp_path / 'drive.npz'
    succeed(capsys, 'invert', folder / 'stage.yaml', tmp_path / 'wanted.npz', '--out', out)
    drive = np.load(out)
    made = scanner().simulate({name: drive[name] for name in ('v', 'v_b')})
    assert np.abs(made['y_b'][-1000:] - y_b).max() < 1e-8


def test_export_writes_a_step_of_all_axes(capsys, folder, tmp_path):
    told = succeed(capsys, 'export', folder / 'stage.yaml', '--out', tmp_path / 'stage.h')
    assert 'stage_y_feedforward_step' in told and 'no feed-forward' not in told
    assert 'stage_step(stage_state *s, const double v[2]' in (tmp_path / 'stage.h').read_text()
    out = tmp_path / 'stage.fmu'
    assert f'wrote {out}' in succeed(capsys, 'export', folder / 'stage.yaml', '--out', out)
    assert 'name="voltage_b"' in ZipFile(out).read('modelDescription.xml').decode()


@pytest.mark.parametrize('measured', [['y', 'y_b'], ['y'], ['y_b']])
def test_every_axis_is_predicted_and_those_with_a_displacement_are_compared(
    capsys, folder, tmp_path, measured
):
    raster, out = dict(np.load(folder / 'raster.npz')), tmp_path / 'out.npz'
    part = {k: x for k, x in raster.items() if k[0] != 'y' or k in measured}
    np.savez(tmp_path / 'part.npz', **part)
    words = ['predict', folder / 'stage.yaml', tmp_path / 'part.npz', '--out', out, '--json']
    data = json.loads(succeed(capsys, *words))['axes']
    assert list(data) == measured
    assert all(data[axis]['whole']['percent_of_stroke'] < 0.02 for axis in measured)
    made = np.load(out)
    for axis in ('', '_b'):
        assert np.std(made[f'y_hat{axis}'] - raster[f'y{axis}']) < 4e-9


@pytest.mark.parametrize('measured', [['y', 'y_b'], ['y_b'], []])
def test_the_bands_of_all_axes_are_written_and_shown(capsys, folder, tmp_path, measured):
    band = PredictionBand(np.array([1e-4, 1e-3, 1e-6, 0.0]), np.ones(4), 1e3)
    axes = {axis: with_band(x, band) for axis, x in scanner().axes.items()}
    pi.MultiAxisModel(axes).save(tmp_path / 'model.yaml')
    raster, out = dict(np.load(folder / 'raster.npz')), tmp_path / 'out.npz'
    part = {k: x for k, x in raster.items() if k[0] != 'y' or k in measured}
    np.savez(tmp_path / 'part.npz', **part)
    words = ['predict', tmp_path / 'model.yaml', tmp_path / 'part.npz', '--interval', '0.9']
    words += ['--out', out, '--overwrite']
    said = succeed(capsys, *words)
    assert all(f'band at 90 %, axis {axis}: half width ' in said for axis in ('y', 'y_b'))
    told = json.loads(succeed(capsys, *words, '--json'))['interval']['axes']
    made = np.load(out)
    for axis, tail in (('y', ''), ('y_b', '_b')):
        half = made[f'half_width{tail}']
        assert half.size == made['t'].size and half.min() > 0.0
        share = 100.0 * half.mean() / abs(axes[axis].scaling.Y)
        assert told[axis]['mean_half_width_percent_of_span'] == pytest.approx(share)


def test_a_model_of_a_further_axis_alone_is_inverted(capsys, folder, tmp_path):
    pi.MultiAxisModel({'y_b': scanner().own('y_b')}).save(tmp_path / 'alone.yaml')
    t = np.arange(1000) / 1000.0
    y_b = 1e-5 * (1 - 0.8 * np.cos(2 * np.pi * t))
    for columns in ({'y_b': y_b}, {'y': 2 * y_b, 'y_b': y_b}):
        np.savez(tmp_path / 'wanted.npz', t=t, **columns)
        words = [tmp_path / 'wanted.npz', '--out', tmp_path / 'drive.npz', '--overwrite']
        code, said, _ = run(capsys, 'invert', tmp_path / 'alone.yaml', *words)
        assert code == 0
        assert ('left out: y;' in said) == ('y' in columns)
        drive = np.load(tmp_path / 'drive.npz')
        assert set(drive) == {'t', 'v_b'}
        made = scanner().own('y_b').simulate(drive['v_b'])
        assert np.abs(made[-1000:] - y_b).max() < 1e-8


def test_the_picture_of_an_axis_replaces_no_file(capsys, folder, tmp_path):
    words = ['predict', folder / 'stage.yaml', folder / 'raster.npz']
    words += ['--plot', tmp_path / 'p.png']
    pictures = [tmp_path / name for name in ('p_y.png', 'p_y_b.png')]
    pictures[1].write_text('mine')
    refuse(capsys, tmp_path, words, f'{pictures[1]}: exists already', '--overwrite')
    data = json.loads(succeed(capsys, *words, '--overwrite', '--json'))
    assert data['plot'] == [str(path) for path in pictures]
    assert sorted(tmp_path.iterdir()) == pictures
    said = succeed(capsys, *words, '--overwrite')
    assert [line for line in said.splitlines() if 'wrote' in line] == [
        f'wrote {path}' for path in pictures
    ]


def test_the_slew_of_static_axes_is_at_the_rate_of_the_motion(capsys, folder, tmp_path):
    still = {
        axis: replace(x, dynamics=Dynamics(np.empty(0), np.ones(1)), delay=Delay(0), effects=())
        for axis, x in scanner().axes.items()
    }
    assert all(x.is_static for x in still.values())
    pi.MultiAxisModel(still).save(tmp_path / 'static.yaml')
    t = np.arange(2000) / 5000.0
    y = 1e-5 * (1 - 0.8 * np.cos(2 * np.pi * 20 * t))
    np.savez(tmp_path / 'wanted.npz', t=t, y=y, y_b=y)
    words = ['invert', tmp_path / 'static.yaml', tmp_path / 'wanted.npz', '--slew', '100']
    out = tmp_path / 'drive.npz'
    succeed(capsys, *words, '--clip', '--out', out)
    for v in (np.load(out)[name] for name in ('v', 'v_b')):
        # at the 1000 Hz of the model it would be five times as steep
        assert np.abs(np.diff(v)).max() * 5000.0 == pytest.approx(100.0, rel=1e-6)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The verbs of the command line on a stage of two axes."""

import json

from axes_scanner import play, raster, scanner, sweeps
from command_line import refuse, succeed
import numpy as np
import piezo_ident as pi
import pytest


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Return a folder with records of two axes, and the model of their stage."""
    made, rng = tmp_path_factory.mktemp('axes'), np.random.default_rng(0)
    for name in ('learn', 'both'):
        pi.write(play(sweeps(4000, rng), sweeps(4000, rng)), made / f'{name}.npz')
    pi.write(play(*raster(3000), seed=2), made / 'raster.npz')
    scanner().save(made / 'stage.yaml')
    return made


def test_identify_and_diagnose_write_the_model_of_all_axes(capsys, folder, tmp_path):
    model, refined = tmp_path / 'model.yaml', tmp_path / 'refined.yaml'
    learn, scan = folder / 'learn.npz', folder / 'raster.npz'
    words = ['identify', learn, '--validation', scan, '--model', model, '--thresholds', '8']
    data = json.loads(succeed(capsys, *words, '--json'))
    assert list(data['axes']) == ['y', 'y_b']
    assert data['validation'][0]['axes']['y_b']['whole']['percent_of_stroke'] > 0.1
    words = [
        'diagnose',
        model,
        folder / 'both.npz',
        '--only',
        'cross_coupling',
        '--model',
        refined,
    ]
    said = succeed(capsys, *words, '--report', tmp_path / 'report')
    assert 'motion_b' in said and str(refined) in said
    assert list(pi.load(refined).axes) == ['y', 'y_b']
    for axis in ('y', 'y_b'):
        assert (tmp_path / 'report' / axis / 'report.html').is_file()


def test_predict_writes_each_axis(capsys, folder, tmp_path):
    out = tmp_path / 'out.npz'
    words = ['predict', folder / 'stage.yaml', folder / 'raster.npz', '--out', out, '--json']
    data = json.loads(succeed(capsys, *words))
    assert data['axes']['y_b']['whole']['percent_of_stroke'] < 0.02
    made = np.load(out)
    for axis in ('', '_b'):
        assert np.std(made[f'y_hat{axis}'] - made[f'y{axis}']) < 4e-9


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
    words = ['export', folder / 'stage.yaml', '--out', tmp_path / 'stage.fmu']
    refuse(capsys, tmp_path, words, 'stage.yaml', 'several axes')

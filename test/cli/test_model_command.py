# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``invert`` writes the voltage for a wanted motion, ``export`` a header or an FMU."""

from dataclasses import replace
import json
from zipfile import ZipFile

from command_line import refuse, run, succeed
import numpy as np
from paper_stage import PAPER
import piezo_ident as pi
from piezo_ident.operators.hysteresis import Hysteresis
import pytest

RATE = 2000.0
T = np.arange(2000) / RATE
#: rest, a rise, and a motion around the middle [um]
WANTED = 30 + 15 * np.minimum(1.0, T / 0.2) * np.sin(2 * np.pi * 3 * T)


@pytest.fixture
def scan(tmp_path):
    path = tmp_path / 'scan.csv'
    np.savetxt(path, np.c_[T, WANTED], delimiter=',', header='t,y_um', comments='')
    return path


@pytest.mark.parametrize('suffix', ['.csv', '.npz'])
def test_the_model_moves_as_the_file_says(capsys, tmp_path, made, scan, suffix):
    out, picture = tmp_path / f'drive{suffix}', tmp_path / 'drive.png'
    argv = ['invert', made / 'model.yaml', scan, '--columns', 'y=y_um']
    code, text, _ = run(capsys, *argv, '--out', out, '--plot', picture)
    assert code == 0 and '% of stroke' in text
    assert picture.read_bytes().startswith(b'\x89PNG')
    drive = pi.read(out, voltage_alone=True).pieces[0]
    y = pi.load(made / 'model.yaml').simulate(drive.v)
    lead = round(-drive.t[0] * RATE)
    assert np.abs(1e6 * y[lead:] - WANTED).max() < 0.01
    data = json.loads(run(capsys, *argv, '--json')[1])
    assert data['percent_of_stroke'] < 0.01 and data['clipped'] == 0
    assert data['expected_percent_of_stroke'] < 0.5
    assert data['voltage_range'] == [drive.v.min(), drive.v.max()]


def test_what_is_out_of_reach_is_refused_or_clipped(capsys, made, scan):
    argv = ['invert', made / 'model.yaml', scan, '--columns', 'y=y_um', '--limits', 2, 5]
    code, _, error = run(capsys, *argv)
    assert code == 2
    assert 'out of reach within 2 .. 5 V' in error and error.rstrip().endswith('--clip')
    data = json.loads(run(capsys, *argv, '--clip', '--json')[1])
    assert data['clipped'] > 0 and data['voltage_range'][1] == 5.0
    assert 'out of reach' in data['warnings'][0]
    data = json.loads(run(capsys, *argv[:5], '--slew', 40, '--clip', '--json')[1])
    assert data['steepest'] == pytest.approx(40.0)
    code, _, error = run(capsys, *argv[:5], '--slew', '-1')
    assert code == 2 and "'-1' is no speed" in error


def test_a_model_without_dynamics_takes_any_rate(capsys, tmp_path, made, scan):
    model = pi.load(made / 'model.yaml')
    static = replace(model.without_dynamics(), sample_rate=4 * RATE)
    static.save(tmp_path / 'static.yaml')
    out = tmp_path / 'drive.csv'
    argv = ['invert', tmp_path / 'static.yaml', scan, '--columns', 'y=y_um', '--out', out]
    data = json.loads(run(capsys, *argv, '--json')[1])
    v = pi.read(out, voltage_alone=True).pieces[0].v
    assert data['steepest'] == pytest.approx(RATE * np.abs(np.diff(v)).max(), rel=1e-6)


@pytest.mark.parametrize(
    ('t', 'y', 'reason'),
    [
        (2 * T, WANTED, 'is sampled at 1000 Hz, the model at 2000 Hz'),
        (np.where(T > 0.5, T + 0.1, T), WANTED, 'gap (1) at 0.5 s'),
        (T, np.where(T == 0.5, np.nan, WANTED), 'not_finite (1) at 0.5 s'),
        (T, np.where(T > 0.5, np.nan, WANTED), 'NaN or infinite'),
        (T, 1e9 * WANTED, 'is no piezo stage'),
        (T, WANTED + 500, 'the wanted motion starts at 530 um; between 0 and 10 V'),
    ],
    ids=['rate', 'gap', 'hole', 'nan', 'unit', 'reach'],
)
def test_no_motion_costs_one_line(capsys, tmp_path, made, t, y, reason):
    path = tmp_path / 'scan.csv'
    np.savetxt(path, np.c_[t, y], delimiter=',', header='t,y', comments='')
    argv = ['invert', made / 'model.yaml', path, '--displacement-unit', 'um']
    code, _, error = run(capsys, *argv)
    assert code == 2 and reason in error and error.count('\n') == 1


def test_a_drive_shows_itself(made):
    drive = pi.load(made / 'model.yaml').inverse(1e-6 * WANTED)
    assert 'left by the inversion' in repr(drive)
    # limits that keep the stage far from the motion are no error of the model
    assert 'on top' not in repr(drive)
    assert 'elsewhere; what the inversion leaves' in ' '.join(
        repr(replace(drive, error=15.0)).split()
    )
    labels = [text for axes in drive.plot().axes for text in axes.get_legend_handles_labels()[1]]
    assert labels[:2] == ['wanted', 'model under the voltage']
    assert '<table' in drive._repr_html_()
    # what rounding leaves is drawn as none
    still = np.full(200, 30e-6)
    exact = pi.SimulatedStage.load('paper').model.inverse(still)
    assert exact.plot().axes[2].get_ylim() == (-1.0, 1.0)
    # beside what is expected of the stage, which need not stand still
    drive = pi.load(made / 'model.yaml').inverse(still)
    assert drive.plot().axes[2].get_ylim()[1] > 1e9 * drive.expected_rms > 0.0


@pytest.fixture
def model(tmp_path):
    PAPER.save(tmp_path / 'model.yaml')
    return tmp_path / 'model.yaml'


def test_a_header_is_written(capsys, tmp_path, model):
    out = tmp_path / 'My-Stage.h'
    said = succeed(capsys, 'export', model, '--format', 'c', '--out', out, '--limits', 0, 9)
    assert f'wrote {out} with my_stage_step, my_stage_feedforward_step' in said
    assert 'samples ahead, 15.2 ms; --preview N' in said
    header = out.read_text()
    assert 'The stage of model.yaml' in header and '#define MY_STAGE_HIGHEST 9.0' in header
    assert (
        header.splitlines()[3:]
        == pi.export_c(PAPER, 'my_stage', limits=(0.0, 9.0)).splitlines()[4:]
    )
    more = ['--overwrite', '--name', 'axis', '--slew', '5e3', '--json']
    result = json.loads(succeed(capsys, 'export', model, '--out', out, *more))
    assert result['functions'] == ['axis_step', 'axis_feedforward_step']
    assert result['preview'] == 304
    assert '#define AXIS_STEP 0.25' in out.read_text()


def test_an_fmu_is_written(capsys, tmp_path, model):
    out = tmp_path / 'stage.fmu'
    result = json.loads(succeed(capsys, 'export', model, '--out', out, '--json'))
    assert result['format'] == 'fmu' and result['functions'] == []
    with ZipFile(out) as archive:
        assert 'modelName="stage"' in archive.read('modelDescription.xml').decode()
        assert 'sources/stage.h' in archive.namelist()


def test_what_has_no_inverse_is_said(capsys, tmp_path, model):
    replace(PAPER, hysteresis=Hysteresis([0.1], [0.1], -0.8, 2.0)).save(model)
    assert 'no feed-forward' in succeed(capsys, 'export', model, '--out', tmp_path / 'stage.h')


@pytest.mark.parametrize(
    ('words', 'what'),
    [
        ([], '--out stage.h'),
        (['--out', 'stage.txt'], 'choose .h, .fmu'),
        (['--out', 'stage.fmu', '--format', 'c'], 'choose .h'),
        (['--out', 'stage.fmu', '--slew', '100'], 'has no feed-forward'),
        (['--out', 'stage.h', '--format', 'fortran'], 'fortran'),
        (['--out', '3.h'], '--name stage'),
        (['--out', 'stage.h', '--slew', '0'], 'no speed'),
        (['--out', 'stage.h', '--limits', '3', '1'], 'lower one first'),
        (['--out', 'none/stage.h'], 'there is no folder'),
    ],
)
def test_an_export_is_refused_in_one_line(capsys, tmp_path, monkeypatch, model, words, what):
    monkeypatch.chdir(tmp_path)
    refuse(capsys, tmp_path, ['export', 'model.yaml', *words], what)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``invert``: a file with the motion that is wanted, to a file with the voltage."""

from dataclasses import replace
import json

from command_line import run
import numpy as np
import piezo_ident as pi
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

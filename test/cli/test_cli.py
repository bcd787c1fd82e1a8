# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The command line: every verb works, and whatever a user gets wrong ends in one line."""

from collections.abc import Callable, Iterator
import contextlib
from dataclasses import replace
import json
import os
from pathlib import Path
import pty
import signal
import sqlite3
import subprocess
import sys

import numpy as np
import piezo_ident as pi
from piezo_ident import __version__
from piezo_ident.cli import main
from piezo_ident.cli.console import Console
from piezo_ident.cli.outputs import check_file, check_folder
from piezo_ident.cli.records import expand
from piezo_ident.common.config import find_config, shipped_names
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.many.run import MARK
from piezo_ident.model.files import load
from piezo_ident.record.record import Piece, Record
import pytest
import yaml

# a stage with one slow mode at 2 kHz, so that an identification takes a moment only
STAGE = """\
schema_version: 1
sample_rate: 2000.0
input: {v0: 0.0, V: 10.0, range: [0.0, 10.0]}
output: {y0: 0.0, Y: 75.0e-6}
delay: {samples: 2}
hysteresis: {thresholds: [0.2, 0.4, 0.6], weights: [0.3, 0.2, 0.1], p1: -0.2, p2: 0.9}
dynamics: {a: [-1.2, 0.5], b: [0.2, 0.1]}
sensor: {noise_rms: 1.0e-9}
seed: 7
"""
PROGRAM = """\
limits: [0, 10]
seed: 1
segments:
  - {signal: idle, duration: 0.3}
  - {signal: step, bias: 5, size: 1, hold: 0.06, count: 8}
  - {signal: settle, bias: 5, amplitude: 0.48, cycles: 12, frequency: 20}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 600, duration: 3}
  - {signal: triangle, slope: 10}
  - {signal: idle, duration: 0.3}
"""
SINE = """\
limits: [0, 10]
segments:
  - {signal: sine, bias: 5, amplitude: 5, frequency: 5, duration: 2}
"""
FAST = ['--order', '2,2', '--thresholds', '5', '--solver', 'least_squares']


def run(capsys, *argv: object) -> tuple[int, str, str]:
    code = main([str(a) for a in argv])
    said = capsys.readouterr()
    return code, said.out, said.err


def succeed(capsys, *argv: object) -> str:
    code, out, err = run(capsys, *argv)
    assert (code, err) == (0, '')
    return out


def refuse(capsys, folder: Path, argv: list[object], *words: object) -> str:
    """Run a command that cannot work: one line, exit code 2, and nothing new on disk."""
    before = sorted(folder.rglob('*'))
    code, out, err = run(capsys, *argv)
    assert code == 2, out
    assert out == ''
    assert err.count('\n') == 1, err
    assert err.endswith('\n')
    assert err.startswith('piezo_ident')
    assert 'Traceback' not in err
    for word in words:
        assert str(word) in err
    assert sorted(folder.rglob('*')) == before
    return err


@pytest.fixture(scope='module')
def made(tmp_path_factory) -> Path:
    """Return a folder with a stage, its record, a record of a sine and the model."""
    folder = tmp_path_factory.mktemp('made')
    (folder / 'stage.yaml').write_text(STAGE)
    (folder / 'program.yaml').write_text(PROGRAM)
    (folder / 'sine.yaml').write_text(SINE)
    for program, out in (('program.yaml', 'record.npz'), ('sine.yaml', 'sine.csv')):
        files = ['--config', folder / 'stage.yaml', '--program', folder / program, folder / out]
        assert main(['simulate', *map(str, files)]) == 0
    argv = ['identify', folder / 'record.npz', '--model', folder / 'model.yaml', *FAST]
    assert main([str(a) for a in argv]) == 0
    return folder


# --- the way it is meant --------------------------------------------------------------------


def test_version_and_help(capsys):
    assert succeed(capsys, '--version') == f'piezo_ident {__version__}\n'
    text = succeed(capsys, '--help')
    for verb in ('simulate', 'identify', 'predict', 'convert', 'diagnose', 'effects'):
        assert verb in text
        assert verb in succeed(capsys, verb, '--help')


def test_heavy_libraries_wait_for_the_arguments():
    code = (
        'import sys; from piezo_ident.cli import main; main(["--version"]); '
        'print([m for m in ("numpy", "scipy", "numba", "matplotlib") if m in sys.modules])'
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[1] == '[]'


def test_the_module_runs_as_a_program():
    done = subprocess.run(
        [sys.executable, '-m', 'piezo_ident', 'simulate', 'no.xyz'], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (2, '')
    assert done.stderr.startswith('piezo_ident: error: no.xyz')
    assert done.stderr.count('\n') == 1


def test_effects(capsys):
    text = succeed(capsys, 'effects')
    data = json.loads(succeed(capsys, 'effects', '--json'))
    assert {'creep', 'thermal_drift'} <= {e['name'] for e in data}
    for effect in data:
        assert effect['name'] in text
        assert effect['about'] in text
        assert effect['slot'] in ('input', 'hysteresis', 'hidden', 'output', 'acquisition')
        for p in effect['parameters']:
            # JSON has no infinity: an open end is null
            assert None in (p['lower'], p['upper']) or p['lower'] < p['upper']
            assert p['name'] in text


def test_simulate_is_repeatable_and_its_seed_counts(capsys, tmp_path, made):
    def simulated(name: str, *more: object) -> np.ndarray:
        out = tmp_path / name
        files = ['--config', made / 'stage.yaml', '--program', made / 'sine.yaml']
        succeed(capsys, 'simulate', *files, *more, out)
        return pi.read(out).pieces[0].y

    first = simulated('a.csv')
    np.testing.assert_array_equal(simulated('b.mat'), first)
    np.testing.assert_array_equal(simulated('c.db3', '--seed', 7), first)
    assert np.any(simulated('d', '--seed', 8) != first)


def test_simulate_json(capsys, tmp_path, made):
    files = ['--config', made / 'stage.yaml', '--program', made / 'program.yaml']
    data = json.loads(succeed(capsys, 'simulate', *files, '--json', tmp_path / 'r.npz'))
    assert data['seed'] == 7
    assert data['samples'] == pi.read(tmp_path / 'r.npz').n
    assert {'noise', 'triangle', 'step'} <= set(data['labels'])


def test_identify_finds_the_stage_and_predict_confirms_it(capsys, tmp_path, made):
    model = load(made / 'model.yaml')
    assert model.delay.samples == 2
    out, picture = tmp_path / 'y.csv', tmp_path / 'y.png'
    argv = ['predict', made / 'model.yaml', made / 'sine.csv', '--out', out, '--plot', picture]
    text = succeed(capsys, *argv)
    assert '% of stroke' in text
    assert 'rms(y - y_hat)' in text
    assert picture.read_bytes().startswith(b'\x89PNG')
    table = np.genfromtxt(out, delimiter=',', names=True)
    assert table.dtype.names == ('t', 'v', 'y', 'y_hat')
    piece = pi.read(made / 'sine.csv').pieces[0]
    np.testing.assert_array_equal(table['y'], piece.y)
    np.testing.assert_array_equal(table['y_hat'], model.predict_piece(piece))
    data = json.loads(succeed(capsys, *argv[:3], '--json', '--out', tmp_path / 'y.npz'))
    error = 100 * np.sqrt(np.mean((table['y'] - table['y_hat']) ** 2)) / np.ptp(table['y'])
    assert data['whole']['percent_of_stroke'] == pytest.approx(error, rel=1e-9)
    # thresholds of the truth lie on the grid of the fit, so little but noise is left
    assert error < 0.2
    assert data['memory_estimated'] == [False]
    assert data['warnings'] == []
    with np.load(tmp_path / 'y.npz') as archive:
        np.testing.assert_array_equal(archive['y_hat'], table['y_hat'])


def test_predict_estimates_an_unknown_start_and_says_so(capsys, tmp_path, made):
    piece = pi.read(made / 'sine.csv').pieces[0]
    cut = Record((piece.cut(piece.n // 2 + 130, piece.n),))
    pi.write(cut, tmp_path / 'cut.npz')
    argv = ['predict', made / 'model.yaml', tmp_path / 'cut.npz']
    text = succeed(capsys, *argv)
    assert 'start forgotten' in text
    assert 'estimated' in text
    data = json.loads(succeed(capsys, *argv, '--json'))
    assert data['memory_estimated'] == [True]
    assert data['start_forgotten']['n'] < data['whole']['n']
    assert data['start_forgotten']['percent_of_stroke'] < 0.3


@pytest.mark.parametrize('suffix', ['.csv', '.npz'])
def test_predict_from_a_voltage_alone(capsys, tmp_path, made, suffix):
    piece = pi.read(made / 'sine.csv').pieces[0]
    scan, out = tmp_path / f'scan{suffix}', tmp_path / f'out{suffix}'
    if suffix == '.csv':
        rows = np.column_stack([piece.t, piece.v])
        np.savetxt(scan, rows, delimiter=',', header='t,v', comments='', fmt='%.17g')
    else:
        np.savez(scan, t=piece.t, v=piece.v)
    argv = ['predict', made / 'model.yaml', scan]
    assert '% of stroke' not in succeed(capsys, *argv, '--out', out)
    if suffix == '.csv':
        table = np.genfromtxt(out, delimiter=',', names=True)
        names = table.dtype.names
    else:
        table = np.load(out)
        names = tuple(table.files)
    assert names == ('t', 'v', 'y_hat')
    y_hat = load(made / 'model.yaml').simulate(piece.v)
    np.testing.assert_array_equal(table['y_hat'], y_hat)
    data = json.loads(succeed(capsys, *argv, '--json'))
    assert data['samples'] == piece.n and 'whole' not in data
    # what needs the displacement misses it
    refuse(capsys, tmp_path, ['identify', scan], scan.name, 'y missing')
    refuse(capsys, tmp_path, [*argv, '--plot', tmp_path / 'p.png'], scan.name, '--plot')


def test_predict_warns_outside_the_identified_range(capsys, tmp_path, made):
    t = np.arange(2000) / 2000.0
    v = 14.0 * np.sin(np.pi * t) ** 2
    pi.write(Record((Piece(v, 7e-6 * v, 2000.0),)), tmp_path / 'far.csv')
    text = succeed(capsys, 'predict', made / 'model.yaml', tmp_path / 'far.csv')
    assert 'outside the identified range' in text


def test_predict_tells_an_offset_from_a_bad_model(capsys, tmp_path, made):
    piece = pi.read(made / 'sine.csv').pieces[0]
    pi.write(Record((replace(piece, y=piece.y + 5e-6),)), tmp_path / 'shifted.npz')
    argv = ['predict', made / 'model.yaml', tmp_path / 'shifted.npz']
    text = succeed(capsys, *argv)
    assert '% after removing a mean of 5.00' in text
    assert 'set to zero elsewhere' in text
    whole = json.loads(succeed(capsys, *argv, '--json'))['whole']
    assert whole['offset'] == pytest.approx(5e-6, rel=0.01)
    assert whole['percent_of_stroke'] > 5.0
    assert whole['percent_of_stroke_without_offset'] < 0.2
    # nothing is said where there is no offset
    plain = succeed(capsys, 'predict', made / 'model.yaml', made / 'sine.csv')
    assert 'after removing' not in plain
    assert 'set to zero' not in plain


def test_identify_without_model_writes_nothing(capsys, tmp_path, made, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = succeed(capsys, 'identify', made / 'record.npz', *FAST)
    assert '--model' in text
    assert list(tmp_path.iterdir()) == []


def test_identify_writes_model_and_report_and_json(capsys, tmp_path, made):
    folder = tmp_path / 'in'
    folder.mkdir()
    pi.write(pi.read(made / 'record.npz'), folder / 'bag')
    (folder / 'notes.txt').write_text('not a record')
    model, report = tmp_path / 'm.yaml', tmp_path / 'deep' / 'report'
    model.write_text('an older one')
    argv = ['identify', folder, '--model', model, '--report', report, *FAST]
    data = json.loads(succeed(capsys, *argv, '--validation', made / 'sine.csv', '--json'))
    assert data['files'] == {'model': str(model), 'report': str(report / 'report.html')}
    assert load(model).delay.samples == 2
    assert (report / 'report.html').is_file()
    (check,) = data['validation']
    assert check['record'] == 'sine.csv'
    assert check['sines'][0]['frequency'] == 5
    assert check['sines'][0]['percent'] < check['sines'][0]['static_percent']
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith('.')] == []


@pytest.mark.parametrize('name', ['r.csv', 'r.npz', 'r.mat', 'r.mcap', 'r.db3', 'bag'])
def test_convert_round_trip(capsys, tmp_path, made, name):
    record = pi.read(made / 'record.npz')
    there, back = tmp_path / name, tmp_path / 'back.npz'
    data = json.loads(succeed(capsys, 'convert', '--json', made / 'record.npz', there))
    assert (data['faults'], data['not_kept']) == ([], [])
    succeed(capsys, 'convert', there, back)
    again = pi.read(back)
    np.testing.assert_array_equal(again.pieces[0].y, record.pieces[0].y)
    assert again.labels == record.labels


def test_convert_refuses_to_replace_unless_told(capsys, tmp_path, made):
    out = tmp_path / 'r.csv'
    out.write_text('precious')
    argv = ['convert', made / 'record.npz', out]
    refuse(capsys, tmp_path, argv, out, '--overwrite')
    assert out.read_text() == 'precious'
    succeed(capsys, *argv, '--overwrite')
    assert pi.read(out).n == pi.read(made / 'record.npz').n


def test_convert_keeps_its_input(capsys, tmp_path, made):
    bag, table = tmp_path / 'bag', tmp_path / 'r.csv'
    for path in (bag, table):
        succeed(capsys, 'convert', made / 'record.npz', path)
    (tmp_path / 'link.csv').symlink_to(table)
    before = {p: p.read_bytes() for p in tmp_path.rglob('*') if p.is_file()}
    for there, out in (
        (table, table),
        (tmp_path / 'link.csv', table),
        (table, bag / '..' / 'r.csv'),
        (bag, bag),
        (bag / 'bag.mcap', bag),
        (bag, bag / 'r.csv'),
    ):
        for option in ([], ['--overwrite']):
            refuse(capsys, tmp_path, ['convert', there, out, *option], out, 'is the input')
    assert {p: p.read_bytes() for p in tmp_path.rglob('*') if p.is_file()} == before


# --- measured data as they come -------------------------------------------------------------


def table(n: int = 1000) -> dict[str, np.ndarray]:
    v = 5 - 5 * np.cos(np.arange(n) / 50)
    return {'t': np.arange(n) / 1000, 'v': v, 'y': 7.5e-6 * v}


def csv_text(**columns: object) -> str:
    c = {**table(), **columns}
    rows = [','.join(map(str, row)) for row in zip(*c.values(), strict=True)]
    return '\n'.join([','.join(c), *rows]) + '\n'


def with_values(column: str, rows: range, value: object) -> str:
    x = table()[column].tolist()
    for i in rows:
        x[i] = value
    return csv_text(**{column: x})


def without(column: str) -> str:
    c = table()
    del c[column]
    rows = [','.join(map(str, row)) for row in zip(*c.values(), strict=True)]
    return '\n'.join([','.join(c), *rows]) + '\n'


BAD_FILES: dict[str, tuple[Callable[[], str], list[object], str]] = {
    'missing column': (lambda: without('y'), [], 'name the columns'),
    'text in numbers': (lambda: with_values('v', range(40, 41), 'off'), [], 'line 42'),
    'many NaN': (lambda: with_values('y', range(0, 1000, 50), 'nan'), [], 'cut the bad stretch'),
    'constant input': (
        lambda: csv_text(v=np.ones(1000), y=1e-6 * np.sin(np.arange(1000) / 9)),
        [],
        'while it is driven',
    ),
    'constant output': (lambda: csv_text(y=np.full(1000, 1e-6)), [], 'sensor'),
    'empty file': (lambda: '', [], 'header line'),
    'header alone': (lambda: 't,v,y\n', [], 'record some samples'),
    'one sample': (lambda: 't,v,y\n0,0,0\n', [], 'at least two'),
    'wrong unit': (lambda: csv_text(y=7.5 * table()['v']), [], '--displacement-unit'),
    'unsorted time': (lambda: with_values('t', range(500, 501), 0.1234), [], ';'),
    'voltage limits': (csv_text, ['--voltage-limits', 0, 8], 'check the limits'),
    'limits turned round': (csv_text, ['--voltage-limits', 8, 0], '--voltage-limits'),
    'garbage': (lambda: '\x00\x01\x02\n\x03', [], ';'),
}


@pytest.mark.parametrize('case', BAD_FILES)
def test_bad_data_end_in_one_line(capsys, tmp_path, case):
    text, options, cure = BAD_FILES[case]
    path = tmp_path / 'bad.csv'
    path.write_text(text())
    argv = ['identify', path, '--model', tmp_path / 'm.yaml', '--report', tmp_path / 'r', *options]
    named = '--voltage-limits' if case == 'limits turned round' else path.name
    refuse(capsys, tmp_path, argv, named, cure)


def test_few_nan_are_met_and_reported(capsys, tmp_path):
    path = tmp_path / 'r.csv'
    path.write_text(with_values('y', range(300, 303), 'nan'))
    text = succeed(capsys, 'convert', path, tmp_path / 'r.npz')
    assert 'not_finite (3)' in text
    assert 'split' in text


def test_a_unit_converts(capsys, tmp_path):
    path = tmp_path / 'r.csv'
    path.write_text(csv_text(y=7.5 * table()['v']))
    succeed(capsys, 'convert', '--displacement-unit', 'µm', path, tmp_path / 'r.npz')
    assert pi.read(tmp_path / 'r.npz').stroke == pytest.approx(75e-6, rel=1e-3)


def test_one_unit_for_all_records(capsys, tmp_path, made):
    path = tmp_path / 'um.csv'
    path.write_text(csv_text(y=7.5 * table()['v']))
    argv = ['identify', path, made / 'record.npz', '--displacement-unit', 'um']
    refuse(capsys, tmp_path, argv, 'record.npz', 'one unit holds for all', 'piezo_ident convert')
    argv = ['identify', path, '--validation', made / 'record.npz']
    refuse(capsys, tmp_path, argv, 'um.csv', 'one unit holds for all', 'piezo_ident convert')
    assert 'one unit' not in refuse(capsys, tmp_path, ['identify', path], '--displacement-unit')


def test_bag_without_the_topics(capsys, tmp_path, made):
    bag = tmp_path / 'bag'
    succeed(capsys, 'convert', '--storage', 'sqlite3', made / 'record.npz', bag)
    (data,) = bag.glob('*.db3')
    with contextlib.closing(sqlite3.connect(data)) as connection, connection:
        connection.execute('delete from messages')
    refuse(capsys, tmp_path, ['identify', bag], bag, 'record the stage')
    refuse(
        capsys,
        tmp_path,
        ['identify', made / 'record.npz', '--namespace', 'other', '--model', 'x/m.yaml'],
        'x/m.yaml',
        'make it first',
    )


def test_folder_without_records(capsys, tmp_path):
    (tmp_path / 'empty').mkdir()
    refuse(capsys, tmp_path, ['identify', tmp_path / 'empty'], tmp_path / 'empty', 'give a bag')


def test_a_folder_of_records_leaves_none_out_unsaid(capsys, tmp_path):
    for name in ('TEK0001.CSV', 'b.csv', 'notes.txt', '.hidden.csv'):
        (tmp_path / name).write_text('')
    (tmp_path / 'crashed').mkdir()
    (tmp_path / 'crashed' / 'crashed.mcap').write_bytes(b'')
    (tmp_path / 'pictures').mkdir()
    # a table beside a ledger holds the results of many records
    (tmp_path / 'line').mkdir()
    for name in (MARK, 'records.csv'):
        (tmp_path / 'line' / name).write_text('')
    taken = ['TEK0001.CSV', 'b.csv', 'crashed.mcap']
    assert [path.name for path in expand([tmp_path], Console())] == taken
    assert capsys.readouterr().err == ''
    (tmp_path / 'monday').mkdir()
    (tmp_path / 'monday' / 'a.NPZ').write_text('')
    (tmp_path / 'bags' / 'whole').mkdir(parents=True)
    (tmp_path / 'bags' / 'whole' / 'metadata.yaml').write_text('')
    assert [path.name for path in expand([tmp_path], Console())] == taken
    said = capsys.readouterr().err
    assert '(bags, monday)' in said
    assert said.count('\n') == 1


def test_files_of_one_name_are_two_records(capsys, tmp_path, made):
    paths = [tmp_path / day / 'run.npz' for day in ('mon', 'tue')]
    for path in paths:
        path.parent.mkdir()
        path.write_bytes((made / 'record.npz').read_bytes())
    data = json.loads(succeed(capsys, 'identify', *paths, *FAST, '--json'))
    assert {row['record'] for row in data['errors']['rows']} == {str(path) for path in paths}


def test_a_record_that_is_fitted_is_no_validation(capsys, tmp_path, made):
    (tmp_path / 'again.npz').symlink_to(made / 'record.npz')
    for path in (made / 'record.npz', tmp_path / 'again.npz'):
        argv = ['identify', made / 'record.npz', '--validation', path, *FAST]
        refuse(capsys, tmp_path, argv, path, 'is no validation')


def test_options_for_bags_are_refused_for_tables(capsys, tmp_path, made):
    record, model = made / 'record.npz', made / 'model.yaml'
    for argv in (
        ['identify', record, '--namespace', 'other'],
        ['predict', model, record, '--voltage-topic', 'v'],
        ['convert', record, tmp_path / 'r.csv', '--displacement-topic', 'y'],
        ['identify', record, '--each', tmp_path / 'out', '--namespace', 'other'],
    ):
        refuse(capsys, tmp_path, argv, 'is for bags', 'record.npz')


def test_a_topic_that_carries_something_else(capsys, tmp_path, made):
    bag = tmp_path / 'bag'
    succeed(capsys, 'convert', made / 'record.npz', bag)
    argv = ['identify', bag, '--voltage-topic', 'displacement']
    refuse(capsys, tmp_path, argv, '/displacement carries displacement, not voltage', '/voltage')


def test_bags_in_capital_letters(capsys, tmp_path, made):
    out = tmp_path / 'R.MCAP'
    refuse(capsys, tmp_path, ['convert', made / 'record.npz', out], 'small letters')
    succeed(capsys, 'convert', made / 'record.npz', tmp_path / 'r.mcap')
    (tmp_path / 'r.mcap').rename(out)
    refuse(capsys, tmp_path, ['identify', out], 'R.MCAP', 'rename it')


@pytest.mark.parametrize('suffix', ['.mcap', '.db3', ''])
def test_times_that_no_bag_can_hold(capsys, tmp_path, suffix):
    columns = table()
    # days since year 0, as seconds
    columns['t'] = columns['t'] + 7.4e5 * 86400.0
    np.savez(tmp_path / 'r.npz', **columns)
    argv = ['convert', tmp_path / 'r.npz', tmp_path / f'out{suffix}']
    refuse(capsys, tmp_path, argv, 'cannot be the stamp', 'let t begin at zero')


def test_an_output_without_a_name(capsys, tmp_path, made, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'metadata.yaml').write_text('rosbag2_bagfile_information: {}')
    refuse(capsys, tmp_path, ['convert', made / 'record.npz', '.', '--overwrite'], 'no file')


def test_missing_record(capsys, tmp_path):
    refuse(capsys, tmp_path, ['identify', tmp_path / 'no.csv'], 'no.csv', 'check the name')
    refuse(capsys, tmp_path, ['convert', tmp_path / 'no', tmp_path / 'r.csv'], 'no', ';')


# --- models and configurations --------------------------------------------------------------


@pytest.mark.parametrize(
    ('text', 'cure'),
    [
        ('schema_version: 99\n', 'update piezo_ident'),
        (': : :\n\t{', 'write it again'),
        ('- 1\n', 'mapping'),
        ('', 'mapping'),
        ('schema_version: 1\n', 'is this a model file'),
    ],
)
def test_bad_model(capsys, tmp_path, made, text, cure):
    path = tmp_path / 'model.yaml'
    path.write_text(text)
    argv = ['predict', path, made / 'sine.csv', '--out', tmp_path / 'y.csv']
    refuse(capsys, tmp_path, argv, path, cure)


def test_model_and_record_in_the_wrong_order(capsys, tmp_path, made):
    model, record = made / 'model.yaml', made / 'sine.csv'
    for argv in ([record, model], [record, record], [model, model], [tmp_path, record]):
        refuse(capsys, tmp_path, ['predict', *argv], 'MODEL comes first: piezo_ident predict')


def test_empty_names(capsys, tmp_path, made, monkeypatch):
    monkeypatch.chdir(tmp_path)
    record, model = made / 'record.npz', made / 'model.yaml'
    for argv in (
        ['identify', ''],
        ['identify', record, '--model', ''],
        ['identify', record, '--report', ''],
        ['identify', record, '--validation', ''],
        ['identify', record, '--namespace', ''],
        ['identify', record, '--voltage-topic', ' '],
        ['predict', '', record],
        ['predict', model, ''],
        ['predict', model, record, '--out', ''],
        ['convert', record, ''],
        ['simulate', ''],
        ['simulate', '--config', '', 'r.csv'],
        ['simulate', '--program', '', 'r.csv'],
    ):
        refuse(capsys, tmp_path, argv, 'is empty; give a name')


def test_links_that_lead_nowhere(capsys, tmp_path, made):
    gone, loop = tmp_path / 'gone.csv', tmp_path / 'loop.yaml'
    gone.symlink_to('nowhere.csv')
    loop.symlink_to('loop.yaml')
    record = made / 'record.npz'
    for argv, said in (
        (['identify', gone], 'gone.csv: is a link to'),
        (['convert', record, '--overwrite', gone], 'gone.csv: is a link to'),
        (['predict', loop, record], 'loop.yaml: is a link to'),
        (['simulate', '--config', loop, tmp_path / 'r.csv'], 'is a link to'),
        (['identify', record, '--model', loop], 'is a link to'),
        (['identify', record, '--report', gone], 'gone.csv: is a link to'),
        (['identify', record, '--report', gone / 'below'], 'gone.csv: is a link to'),
    ):
        refuse(capsys, tmp_path, argv, said, 'mend the link')


def test_model_of_another_rate(capsys, tmp_path, made):
    path = tmp_path / 'slow.csv'
    path.write_text(csv_text())
    argv = ['predict', made / 'model.yaml', path, '--out', tmp_path / 'y.csv']
    refuse(capsys, tmp_path, argv, 'slow.csv', '1000 Hz', 'identify a model')


def test_misspelt_names(capsys, tmp_path, made):
    out = tmp_path / 'r.csv'
    refuse(capsys, tmp_path, ['simulate', '--program', 'validaton', out], 'mean validation?')
    refuse(capsys, tmp_path, ['simulate', '--config', 'stage_papper', out], 'mean paper?')
    refuse(capsys, tmp_path, ['convert', '--displacement-unit', 'ym', out, out], 'nm')
    stage = tmp_path / 'stage.yaml'
    stage.write_text(
        yaml.safe_dump({**yaml.safe_load(STAGE), 'effects': [{'name': 'crep', 'parameters': {}}]})
    )
    refuse(capsys, tmp_path, ['simulate', '--config', stage, out], stage, 'crep', 'creep')
    program = tmp_path / 'program.yaml'
    program.write_text('limits: [0, 10]\nsegments: [{signal: sinus}]\n')
    refuse(capsys, tmp_path, ['simulate', '--program', program, out], program, 'sine')


@pytest.mark.parametrize(
    ('options', 'word'),
    [
        (['--thresholds', 'many'], '--thresholds'),
        (['--thresholds', 1], 'thresholds'),
        (['--order', '3'], '--order'),
        (['--order', '3,0'], 'order'),
        (['--solver', 'magic'], '--solver'),
        (['--seed', -1], '--seed'),
        (['--hold-out', -1], 'hold_out'),
        (['--hold-out', 'inf'], 'hold_out'),
        (['--model', 'm.csv'], 'm.csv'),
        (['--mdoel', 'm.yaml'], '--mdoel'),
    ],
)
def test_bad_options(capsys, tmp_path, made, options, word):
    refuse(capsys, tmp_path, ['identify', made / 'record.npz', *options], word)


def test_stage_of_another_rate(capsys, tmp_path):
    argv = ['simulate', '--sample-rate', 1000, tmp_path / 'r.csv']
    refuse(capsys, tmp_path, argv, 'stage_paper.yaml', 'leave out --sample-rate')


def test_shipped_files_are_found_by_name_and_by_path(capsys, tmp_path, monkeypatch, made):
    assert {'identification', 'validation', 'survey'} <= set(shipped_names('program_'))
    assert find_config('paper', 'stage').name == 'stage_paper.yaml'
    assert find_config('stage_paper', 'stage').name == 'stage_paper.yaml'
    # elsewhere, the path of the contract still works, and it is said what was taken
    monkeypatch.chdir(tmp_path)
    argv = ['--config', 'config/stage_paper.yaml', '--program', made / 'sine.yaml', 'r.npz']
    code, _, err = run(capsys, 'simulate', *argv)
    assert code == 0
    assert 'taking the shipped' in err
    # a workspace comes first
    share = tmp_path / 'share' / 'piezo_ident' / 'config'
    share.mkdir(parents=True)
    (share / 'program_own.yaml').write_text(SINE)
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{os.pathsep}{tmp_path}')
    assert find_config('own', 'program') == share / 'program_own.yaml'
    with pytest.raises(ConfigError, match='own'):
        find_config('owner', 'program')


# --- outputs --------------------------------------------------------------------------------


def test_unwritable_outputs_are_refused_before_the_work(capsys, tmp_path, made, monkeypatch):
    def forbidden(*args: object, **kwargs: object) -> None:
        raise AssertionError('the work began')

    monkeypatch.setattr('piezo_ident.cli.model_commands.identify', forbidden)
    monkeypatch.setattr('piezo_ident.cli.model_commands.free_run', forbidden)
    monkeypatch.setattr('piezo_ident.cli.commands.SimulatedStage.play', forbidden)
    (tmp_path / 'file').write_text('')
    (tmp_path / 'mine').mkdir()
    (tmp_path / 'mine' / 'model.yaml').write_text('')
    below, record = tmp_path / 'file' / 'm.yaml', made / 'record.npz'
    for argv in (
        ['identify', record, '--model', below],
        ['identify', record, '--model', '/proc/m.yaml'],
        ['identify', record, '--model', tmp_path],
        ['identify', record, '--model', tmp_path / 'no' / 'm.yaml'],
        ['identify', record, '--report', below],
        ['identify', record, '--report', tmp_path / 'file'],
        ['identify', record, '--report', '/proc/report'],
        ['identify', record, '--report', tmp_path / 'mine'],
        ['predict', made / 'model.yaml', record, '--out', below.with_suffix('.csv')],
        ['predict', made / 'model.yaml', record, '--plot', below.with_suffix('.png')],
        ['predict', made / 'model.yaml', record, '--out', record],
        ['predict', made / 'model.yaml', record, '--out', tmp_path / 'y.mat'],
        ['simulate', below.with_suffix('.csv')],
        ['simulate', '/dev/null'],
        ['simulate', '--overwrite', '/dev/null'],
        ['convert', record, below.with_suffix('.csv')],
    ):
        refuse(capsys, tmp_path, argv, argv[-1], ';')


def test_long_names_and_devices(tmp_path):
    with pytest.raises(DataError, match='cannot be written'):
        check_file(tmp_path / ('x' * 300), overwrite=True)
    with pytest.raises(DataError, match='device'):
        check_file(Path('/dev/null'), overwrite=True)
    check_folder(tmp_path / 'a' / 'b')
    assert list(tmp_path.iterdir()) == []


# --- interrupted ----------------------------------------------------------------------------


@contextlib.contextmanager
def on_a_terminal(argv: list[object]) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """Run a command whose standard error is a terminal; yield it and the terminal's other end."""
    here, there = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, '-m', 'piezo_ident', *map(str, argv)],
        stdout=subprocess.PIPE,
        stderr=there,
        # a shell that runs the tests in the background has them ignore Ctrl-C
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    os.close(there)
    try:
        yield process, here
    finally:
        process.kill()
        process.communicate()
        os.close(here)


def read_terminal(terminal: int) -> bytes:
    try:
        return os.read(terminal, 4096)
    except OSError:  # the other end is closed
        return b''


def test_interrupt_leaves_nothing(capsys, tmp_path):
    record = tmp_path / 'r.npz'
    succeed(capsys, 'simulate', record)
    outputs = ['--model', tmp_path / 'm.yaml', '--report', tmp_path / 'report']
    argv = ['identify', record, *outputs, '--thresholds', 'auto']
    with on_a_terminal(argv) as (process, terminal):
        seen = b''
        # the bar of the second step: the work is under way
        while b'dynamics' not in seen:
            chunk = read_terminal(terminal)
            assert chunk, seen
            seen += chunk
        process.send_signal(signal.SIGINT)
        after = b''
        while chunk := read_terminal(terminal):
            after += chunk
        assert process.wait() == 130
        assert process.stdout.read() == b''
    assert b'Traceback' not in after
    assert b'piezo_ident: interrupted' in after
    assert after.count(b'\n') == 1
    assert list(tmp_path.iterdir()) == [record]


def interrupt_while(module: str, function: str, argv: list[object]) -> tuple[int, str, str]:
    """Run a command that gets a SIGINT when it calls a function, before the function works."""
    code = (
        'import os, signal, sys, time\n'
        f'import {module} as module\n'
        f'def striking(*args, work=module.{function}, **more):\n'
        '    os.kill(os.getpid(), signal.SIGINT); time.sleep(0.01)\n'
        '    return work(*args, **more)\n'
        f'module.{function} = striking\n'
        f"sys.argv = ['piezo_ident', *{[str(a) for a in argv]!r}]\n"
        'from piezo_ident.cli import main\n'
        'sys.exit(main())\n'
    )
    done = subprocess.run(
        [sys.executable, '-c', code],
        capture_output=True,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    return done.returncode, done.stdout, done.stderr


def test_interrupt_while_outputs_are_put_in_place(tmp_path, made):
    # the report and the model are whole, whichever file was at work
    argv = ['identify', made / 'record.npz', '--model', tmp_path / 'm.yaml', *FAST]
    argv += ['--report', tmp_path / 'report']
    code, out, err = interrupt_while('os', 'fsync', argv)
    assert (code, out, err.count('\n')) == (130, '', 1)
    assert sorted(p.name for p in tmp_path.iterdir()) == ['m.yaml', 'report']
    names = {p.name for p in (tmp_path / 'report').iterdir()}
    assert {'report.html', 'model.yaml', 'identification.json'} <= names
    assert load(tmp_path / 'm.yaml').delay.samples == 2


def test_interrupt_while_pictures_are_drawn(tmp_path, made):
    argv = ['identify', made / 'record.npz', '--report', tmp_path / 'report', *FAST]
    code, out, err = interrupt_while('matplotlib.figure', 'Figure.savefig', argv)
    assert (code, out, err.count('\n')) == (130, '', 1)
    assert list(tmp_path.rglob('*.png')) == []


def test_a_reader_that_leaves_is_no_error():
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, '-m', 'piezo_ident', 'effects'], stdout=write, stderr=subprocess.PIPE
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (0, b'')

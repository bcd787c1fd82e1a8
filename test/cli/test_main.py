# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The command line: every verb works, reads what labs have, and can be interrupted."""

from collections.abc import Iterator
import contextlib
from dataclasses import replace
import json
import logging
import os
import pty
import re
import shlex
import signal
import subprocess
import sys

from command_line import refuse, run, succeed
import numpy as np
import piezo_ident as pi
from piezo_ident import __version__
from piezo_ident.cli.console import Console
from piezo_ident.cli.files import expand
from piezo_ident.cli.main import cli
from piezo_ident.common.config import find_config, shipped_names
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.excitation.program import Program
from piezo_ident.live.guard import Guard, GuardSettings
from piezo_ident.many.run import MARK
from piezo_ident.model.files import load
from piezo_ident.record.record import Piece, Record
from piezo_ident.report.figures import style
import pytest

FAST = ['--order', '2,2', '--thresholds', '5', '--solver', 'least_squares']


def columns_of(path):
    if path.suffix == '.npz':
        return dict(np.load(path))
    table = np.genfromtxt(path, delimiter=',', names=True)
    return {name: table[name] for name in table.dtype.names}


def tree(folder, *names, text=''):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def test_version_and_help(capsys):
    assert succeed(capsys, '--version') == f'piezo_ident {__version__}\n'
    text = succeed(capsys, '--help')
    assert all(verb in text for verb in cli.commands)


#: imports, one after the other in one process, and what none of them up to there may import
IMPORTS = (
    ('from piezo_ident.cli import main; main(["--version"])', 'numpy scipy numba rosbags jinja2'),
    ('import piezo_ident.cli.effects_command', 'scipy.optimize rosbags jinja2'),
    ('import piezo_ident.cli.record_command', 'scipy.optimize jinja2'),
    ('import piezo_ident.cli.model_command', 'scipy.signal scipy.stats jinja2 matplotlib'),
    ('import piezo_ident.report', 'jinja2 matplotlib'),
    ('import piezo_ident.report.figures.diagnosis', 'matplotlib.pyplot'),
)


def test_only_what_is_needed_is_imported():
    lines = ['import sys']
    for work, spared in IMPORTS:
        lines += [work, f'print([m for m in {spared.split()} if m in sys.modules])']
    command = [sys.executable, '-c', '\n'.join(lines)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [f'piezo_ident {__version__}', *['[]'] * len(IMPORTS)]


def test_notices_are_for_terminals(capsys, monkeypatch):
    log = logging.getLogger('piezo_ident')
    for is_terminal, said in ((False, ''), (True, 'piezo_ident: compiling\n')):
        monkeypatch.setattr(sys.stderr, 'isatty', lambda known=is_terminal: known)
        with Console().notices():
            log.warning('compiling')
        assert capsys.readouterr() == ('', said)


def test_simulate_is_repeatable_and_its_seed_counts(capsys, tmp_path, made):
    def simulated(name: str, *more: object) -> np.ndarray:
        files = ['--config', made / 'stage.yaml', '--program', made / 'sine.yaml']
        data = json.loads(succeed(capsys, 'simulate', *files, *more, '--json', tmp_path / name))
        assert data['seed'] == (more[1] if more else 7)
        piece = pi.read(tmp_path / name).pieces[0]
        assert data['samples'] == piece.n and 'sine:5Hz' in data['labels']
        return piece.y

    first = simulated('a.csv')
    np.testing.assert_array_equal(simulated('b.mat'), first)
    np.testing.assert_array_equal(simulated('c.db3', '--seed', 7), first)
    assert np.any(simulated('d', '--seed', 8) != first)


def test_the_voltage_that_is_asked_for_next_fits_the_model(capsys, tmp_path, made, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = load(made / 'model.yaml')
    model = replace(model, scaling=replace(model.scaling, V=100.0, range=(-10.0, 90.0)))
    model.save('wide.yaml')
    files = ['--config', 'wide.yaml', '--program', made / 'program.yaml', '--limits', -10, 90]
    succeed(capsys, 'simulate', *files, 'record.npz')
    text = succeed(capsys, 'identify', 'record.npz', *FAST, '--model', 'model.yaml')
    (line,) = (x for x in text.splitlines() if 'excitation.csv' in x)
    succeed(capsys, *shlex.split(line)[1:])
    table = np.genfromtxt('excitation.csv', delimiter=',', names=True)
    assert table.dtype.names == ('t', 'v', 'segment')
    assert (table['v'].min(), table['v'].max()) == pytest.approx((-10.0, 90.0), abs=0.1)
    # neither another rate nor a voltage outside the range
    assert 'warning' not in succeed(capsys, 'predict', 'model.yaml', 'excitation.csv')


@pytest.mark.parametrize('program', ['identification', 'diagnosis', 'holds'])
def test_a_scaled_program_is_written_for_the_graph(capsys, tmp_path, program):
    argv = ['simulate', '--program', program, '--sample-rate', 10e3, '--limits', -20, 130]
    said = succeed(capsys, *argv, tmp_path / 'mine.yaml')
    command = succeed(capsys, *argv, '--voltage-only', tmp_path / 'command.npz')
    assert said.splitlines()[2:] == command.splitlines()[1:]
    mine = Program.load(tmp_path / 'mine.yaml').build(limits=(-20.0, 130.0))
    v = np.load(tmp_path / 'command.npz')['v']
    np.testing.assert_array_equal(mine.v, v)
    slew = float(said.splitlines()[1].split()[1])
    assert slew == pytest.approx(1e4 * np.abs(np.diff(v)).max(), rel=2e-5)
    assert not Guard(GuardSettings(-20, 130, slew, 20, -20, 1e4), -20.0).process(v).altered
    refuse(capsys, tmp_path, [*argv, tmp_path / 'mine.yaml'], 'exists already')


def test_the_steepest_of_all_axes_is_said(capsys, tmp_path):
    argv = ['simulate', '--config', 'two_axes', '--program', 'two_axes', '--json']
    said = json.loads(succeed(capsys, *argv, tmp_path / 'mine.yaml'))
    succeed(capsys, *argv, '--voltage-only', tmp_path / 'both.npz')
    both = np.load(tmp_path / 'both.npz')
    assert both.files == ['t', 'v', 'v_b', 'segment_name', 'segment_start']
    steepest = [2000.0 * np.abs(np.diff(both[name])).max() for name in ('v', 'v_b')]
    assert steepest[0] < steepest[1] == pytest.approx(said['steepest'])
    assert said['samples'] == both['v'].size


def test_a_displacement_beside_the_voltages_makes_a_labelled_record(capsys, tmp_path):
    argv = ['--program', 'identification', '--sample-rate', 10_000, '--limits', 0, 100]
    succeed(capsys, 'simulate', *argv, '--voltage-only', tmp_path / 'drive.csv')
    head, *rows = (tmp_path / 'drive.csv').read_text().splitlines()
    measured = [f'{row},{7e-8 * float(row.split(",")[1])}' for row in rows]
    (tmp_path / 'record.csv').write_text('\n'.join([f'{head},y', *measured]))
    record = pi.read(tmp_path / 'record.csv')
    assert (record.faults, record.voltage_range) == ((), (0.0, 100.0))
    program = pi.Program.load('identification').build(10e3)
    assert record.labels == tuple(dict.fromkeys(s.label for s in program.segments))


def test_identify_finds_the_stage_and_predict_confirms_it(capsys, tmp_path, made):
    model = load(made / 'model.yaml')
    assert model.delay.samples == 2
    out, picture = tmp_path / 'y.csv', tmp_path / 'y.png'
    argv = ['predict', made / 'model.yaml', made / 'sine.csv', '--out', out, '--plot', picture]
    text = succeed(capsys, *argv)
    assert '% of stroke' in text
    assert 'rms(y - y_hat)' in text
    assert picture.read_bytes().startswith(b'\x89PNG')
    table = columns_of(out)
    assert [*table] == ['t', 'v', 'y', 'y_hat', 'estimate']
    piece = pi.read(made / 'sine.csv').pieces[0]
    np.testing.assert_array_equal(table['y'], piece.y)
    np.testing.assert_array_equal(table['y_hat'], model.predict_piece(piece))
    data = json.loads(succeed(capsys, *argv[:3], '--json', '--out', tmp_path / 'y.npz'))
    error = 100 * np.sqrt(np.mean((table['y'] - table['y_hat']) ** 2)) / np.ptp(table['y'])
    assert data['whole']['percent_of_stroke'] == pytest.approx(error, rel=1e-9)
    left = 100 * np.sqrt(np.mean((table['y'] - table['estimate']) ** 2)) / np.ptp(table['y'])
    assert data['estimate']['percent_of_stroke'] == pytest.approx(left, rel=1e-9)
    assert 'estimate   ' in text and 'displacement 100 samples before' in text
    # thresholds of the truth lie on the grid of the fit, so little but noise is left
    assert error < 0.2
    assert data['memory_estimated'] == [False]
    assert data['warnings'] == []
    np.testing.assert_array_equal(columns_of(tmp_path / 'y.npz')['y_hat'], table['y_hat'])


@pytest.fixture
def predicted(capsys, tmp_path, made):
    """Return what predicts a piece by the model, and returns what is said, and that as JSON."""

    def predict(piece):
        pi.write(Record((piece,)), tmp_path / 'r.npz', overwrite=True)
        argv = ['predict', made / 'model.yaml', tmp_path / 'r.npz']
        return succeed(capsys, *argv), json.loads(succeed(capsys, *argv, '--json'))

    return predict


@pytest.fixture
def sine(made):
    return pi.read(made / 'sine.csv').pieces[0]


def test_predict_estimates_an_unknown_start_and_says_so(predicted, sine):
    text, data = predicted(sine.cut(sine.n // 2 + 130, sine.n))
    assert 'start forgotten' in text and 'estimated' in text
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
    table = columns_of(out)
    assert [*table] == ['t', 'v', 'y_hat']
    y_hat = load(made / 'model.yaml').simulate(piece.v)
    np.testing.assert_array_equal(table['y_hat'], y_hat)
    data = json.loads(succeed(capsys, *argv, '--json'))
    assert data['samples'] == piece.n and 'whole' not in data


def test_predict_from_a_voltage_that_starts_in_its_middle(capsys, tmp_path, made):
    v = pi.read(made / 'sine.csv').pieces[0].v
    start = int(np.argmin(np.abs(v - v.mean())))
    t = np.arange(v.size - start) / 2000.0
    scan = tmp_path / 'scan.csv'
    np.savetxt(scan, np.column_stack([t, v[start:]]), delimiter=',', header='t,v', comments='')
    text = succeed(capsys, 'predict', made / 'model.yaml', scan)
    (warning,) = (line for line in text.splitlines() if 'warning' in line)
    width = float(re.search(r'stands (\S+) % of its span apart', warning)[1])
    model = load(made / 'model.yaml')
    # the same voltage from below and from above
    up, down = (
        model.simulate(np.repeat(way, 4000))[-1] for way in ([0, v[start]], [0, 10, v[start]])
    )
    assert width == pytest.approx(100 * abs((down - up) / model.scaling.Y), rel=0.05)


def test_predict_warns_outside_the_identified_range(predicted):
    v = 14.0 * np.sin(np.pi * np.arange(2000) / 2000.0) ** 2
    text, _ = predicted(Piece(v, 7e-6 * v, 2000.0))
    assert 'outside the identified range' in ' '.join(text.split())


def test_predict_tells_an_offset_from_a_bad_model(predicted, sine):
    text, data = predicted(replace(sine, y=sine.y + 5e-6))
    assert '% after removing a mean of 5.00' in text and 'as if the sensor were zeroed' in text
    whole = data['whole']
    assert whole['offset'] == pytest.approx(5e-6, rel=0.01)
    assert whole['percent_of_stroke'] > 5.0
    assert whole['percent_of_stroke_without_offset'] < 0.2
    # nothing is said where there is no offset
    plain, _ = predicted(sine)
    assert not any(words in plain for words in ('after removing', 'set to zero', 'runs against'))


def test_lost_readings_are_left_out_of_all_that_is_said_written_and_drawn(
    capsys, tmp_path, made, sine
):
    path, out, model = tmp_path / 'r.csv', tmp_path / 'out.csv', made / 'model.yaml'
    # so few that every sample is drawn
    piece = sine.cut(0, 2400)
    lost = np.random.default_rng(0).random(piece.n) < 0.016
    pi.write(Record((replace(piece, y=np.where(lost, 2e-4, piece.y)),)), path)
    argv = ['predict', model, path, '--out', out]
    whole = json.loads(succeed(capsys, *argv, '--json'))['whole']
    assert whole['percent_of_stroke'] < 0.2 and whole['n'] == np.count_nonzero(~lost)
    table = columns_of(out)
    np.testing.assert_array_equal(np.isnan(table['y']), lost)
    assert np.isfinite(table['y_hat']).all() and np.isfinite(table['v']).all()
    said = succeed(capsys, *argv, '--overwrite')
    assert f'{lost.sum()} readings are left out' in said
    axes = pi.free_run(load(model), pi.read(path)).plot().axes
    for drawn in axes[1:3]:
        np.testing.assert_array_equal(np.isnan(drawn.lines[0].get_ydata()), lost)
    assert f'{lost.sum()} readings left out' in axes[1].get_title('right')
    # nor are they taken for an effect
    said = succeed(capsys, 'diagnose', model, path, '--only', 'creep', '--json')
    assert json.loads(said)['verdict'] in ('none', 'refitted')


def test_predict_asks_after_a_reversed_sign(predicted, sine):
    text, data = predicted(replace(sine, y=-40e-6 - sine.y))
    assert 'runs against the model: is a sign reversed' in text
    # more than half of the error is a mean, but the zero is where it was
    assert 'after removing a mean of' in text
    assert 'set to zero' not in text
    assert any('runs against' in x for x in data['warnings'])


def test_identify_without_model_writes_nothing(capsys, tmp_path, made, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = succeed(capsys, 'identify', made / 'record.npz', *FAST)
    assert '--model' in text
    assert '2 ± ' in text and '(given)' not in text
    assert list(tmp_path.iterdir()) == []


def test_a_delay_that_is_typed_is_used_and_said_to_be_given(capsys, made):
    # not what the record tells
    text = succeed(capsys, 'identify', made / 'record.npz', *FAST, '--delay', 3)
    assert '3 samples (given)' in text


def test_identify_writes_model_and_report_and_json(capsys, tmp_path, made):
    folder = tmp_path / 'in'
    folder.mkdir()
    pi.write(pi.read(made / 'record.npz'), folder / 'bag')
    (folder / 'notes.txt').write_text('not a record')
    model, report = tmp_path / 'm.yaml', tmp_path / 'deep' / 'report'
    model.write_text('an older one')
    argv = ['identify', folder, '--model', model, '--report', report, '--overwrite', *FAST]
    data = json.loads(succeed(capsys, *argv, '--validation', made / 'sine.csv', '--json'))
    assert data['files'] == {'model': str(model), 'report': str(report / 'report.html')}
    assert load(model).delay.samples == 2
    assert (report / 'report.html').is_file()
    (check,) = data['validation']
    assert check['record'] == 'sine.csv'
    assert check['sines'][0]['frequency'] == 5
    assert check['sines'][0]['percent'] < check['sines'][0]['static_percent']
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith('.')] == []


def test_convert_round_trip(capsys, tmp_path, made):
    record = pi.read(made / 'record.npz')
    there, back = tmp_path / 'bag', tmp_path / 'back.npz'
    data = json.loads(succeed(capsys, 'convert', '--json', made / 'record.npz', there))
    assert (data['faults'], data['not_kept']) == ([], [])
    succeed(capsys, 'convert', there, back)
    again = pi.read(back)
    np.testing.assert_array_equal(again.pieces[0].y, record.pieces[0].y)
    assert again.labels == record.labels


def test_a_folder_of_records_leaves_none_out_unsaid(capsys, tmp_path):
    lab = tree(tmp_path / 'lab', 'TEK0001.CSV', 'b.csv', 'notes.txt', '.hidden.csv')
    # a table beside a ledger holds the results of many records
    tree(lab, 'crashed/crashed.mcap', f'line/{MARK}', 'line/records.csv')
    (lab / 'pictures').mkdir()

    def names():
        return [path.name for path in expand([lab], Console())]

    taken = ['TEK0001.CSV', 'b.csv', 'crashed.mcap']
    assert names() == taken and capsys.readouterr().err == ''
    text = '1.0 2.0\n' * 5000
    tree(lab, 'long.dat', text=text)
    assert names() == taken
    assert 'long.dat: not read, as text may be anything; name' in capsys.readouterr().err
    (lab / 'long.dat').unlink()
    with pytest.raises(DataError, match=r'long\.dat: not read, .*; name them$'):
        expand([tree(tmp_path / 'other', 'long.dat', text=text)], Console())
    tree(lab, 'monday/a.NPZ', 'bags/whole/metadata.yaml')
    assert names() == taken
    said = capsys.readouterr().err
    assert '(bags, monday)' in said and said.count('\n') == 1


def test_files_of_one_name_are_two_records(capsys, tmp_path, made):
    paths = [tmp_path / day / 'run.npz' for day in ('mon', 'tue')]
    for path in paths:
        path.parent.mkdir()
        path.write_bytes((made / 'record.npz').read_bytes())
    data = json.loads(succeed(capsys, 'identify', *paths, *FAST, '--json'))
    assert {row['record'] for row in data['errors']['rows']} == {str(path) for path in paths}


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
    (share / 'program_own.yaml').write_bytes((made / 'sine.yaml').read_bytes())
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'{os.pathsep}{tmp_path}')
    assert find_config('own', 'program') == share / 'program_own.yaml'
    with pytest.raises(ConfigError, match='own'):
        find_config('owner', 'program')


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


@pytest.fixture
def interrupted(capsys, monkeypatch):
    """Return what runs a command that gets a SIGINT each time a function begins to work."""

    def run_it(owner, function: str, argv: list[object]) -> tuple[int, str, str]:
        work = getattr(owner, function)

        def striking(*args, **more):
            signal.raise_signal(signal.SIGINT)
            return work(*args, **more)

        monkeypatch.setattr(owner, function, striking)
        return run(capsys, *argv)

    return run_it


def test_interrupt_while_outputs_are_put_in_place(tmp_path, made, interrupted):
    # the report and the model are whole, whichever file was at work
    argv = ['identify', made / 'record.npz', '--model', tmp_path / 'm.yaml', *FAST]
    argv += ['--report', tmp_path / 'report']
    code, out, err = interrupted(os, 'fsync', argv)
    assert (code, out, err.count('\n')) == (130, '', 1)
    assert sorted(p.name for p in tmp_path.iterdir()) == ['m.yaml', 'report']
    names = {p.name for p in (tmp_path / 'report').iterdir()}
    assert {'report.html', 'model.yaml', 'identification.json'} <= names
    assert load(tmp_path / 'm.yaml').delay.samples == 2


def test_interrupt_while_pictures_are_drawn(tmp_path, made, interrupted):
    argv = ['identify', made / 'record.npz', '--report', tmp_path / 'report', *FAST]
    code, out, err = interrupted(style, 'png', argv)
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


@pytest.mark.parametrize(
    ('words', 'end'),
    [
        ('effects >&-', (0, b'')),
        ('effects nope --json >&- 2>&-', (2, b'')),
        ('effects >/dev/full', (2, b'piezo_ident: error: No space left on device\n')),
    ],
)
def test_output_that_cannot_be_written(words, end):
    # a buffered output fails at its end, and again while the interpreter ends
    env = {**os.environ, 'PYTHONUNBUFFERED': ''}
    done = subprocess.run(
        f'{shlex.quote(sys.executable)} -m piezo_ident {words}',
        shell=True,
        stderr=subprocess.PIPE,
        env=env,
    )
    assert (done.returncode, done.stderr) == end

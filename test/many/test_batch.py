# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Many records at once: one table whoever does the work, and a failure is a row."""

from collections.abc import Iterator
import contextlib
import csv
from dataclasses import dataclass
import importlib.util
import json
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import time

from diagnosis_examples import base_model, measured
import numpy as np
from piezo_ident.cli import main
from piezo_ident.cli.each_command import SUMMARY
from piezo_ident.common.errors import ConfigError
from piezo_ident.excitation.program import parse_program
from piezo_ident.many import executors
from piezo_ident.many.executors import cores, run_all
from piezo_ident.many.figures import PICTURES, write_spread
from piezo_ident.many.figures_of_merit import character
from piezo_ident.many.ledger import LEDGER, Ledger
from piezo_ident.many.run import Diagnose, fingerprint, Identify, Outcome, Row
from piezo_ident.many.spread import in_order, QUANTITIES, spread_of
from piezo_ident.many.table import COLUMNS, columns_of, csv_text
from piezo_ident.model.files import load_model, model_to_yaml, save_model
from piezo_ident.model.simulated_stage import Sensor, simulate, SimulatedStage
from piezo_ident.model.stage_model import Scaling, StageModel
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.io import write_record
import pytest

ROOT = Path(__file__).resolve().parents[2]
RATE = 2000.0
PROGRAM = """\
limits: [0, 10]
seed: 1
segments:
  - {signal: idle, duration: 0.3}
  - {signal: step, bias: 5, size: 1, hold: 0.06, count: 8}
  - {signal: settle, bias: 5, amplitude: 0.48, cycles: 12, frequency: 20}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 600, duration: 2}
  - {signal: triangle, slope: 10}
"""
FAST = ['--order', '2,2', '--thresholds', '5', '--solver', 'least_squares']
GAINS = {'stage_1': 70e-6, 'stage_2': 72e-6, 'stage_10': 74e-6}


def stage(span: float) -> SimulatedStage:
    model = StageModel(
        sample_rate=RATE,
        scaling=Scaling(0.0, 10.0, 0.0, span, (0.0, 10.0)),
        hysteresis=Hysteresis(
            np.array([0.2, 0.4, 0.6]), np.array([0.3, 0.2, 0.1]), p1=-0.2, p2=0.9
        ),
        dynamics=Dynamics(np.array([-1.2, 0.5]), np.array([0.2, 0.1])),
        delay=Delay(2),
    )
    return SimulatedStage(model, Sensor(noise_rms=1e-9))


@pytest.fixture(scope='module')
def records(tmp_path_factory) -> Path:
    """Return a folder with three records and one that is none."""
    folder = tmp_path_factory.mktemp('line')
    sequence = parse_program(PROGRAM).build(RATE)
    for i, (name, span) in enumerate(GAINS.items()):
        record = simulate(stage(span), sequence, np.random.default_rng(i))
        write_record(record, folder / f'{name}.npz')
    (folder / 'stage_3.npz').write_bytes(b'a cable was loose')
    return folder


@pytest.fixture(scope='module')
def result(records, tmp_path_factory) -> Path:
    """Return what two processes make of them."""
    out = tmp_path_factory.mktemp('result')
    argv = ['identify', records, '--each', out, '--jobs', 2, *FAST]
    assert main([str(a) for a in argv]) == 0
    return out


def run(capsys, *argv: object) -> tuple[int, str, str]:
    code = main([str(a) for a in argv])
    said = capsys.readouterr()
    return code, said.out, said.err


def refused(capsys, *argv: object) -> str:
    code, out, err = run(capsys, *argv)
    assert (code, out) == (2, '')
    assert err.count('\n') == 1, err
    return err


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / 'records.csv').open(encoding='utf-8', newline='') as file:
        return list(csv.DictReader(file))


def living(group: int) -> list[str]:
    """Return the processes of a group; what has ended and only waits to be noted is none."""
    found = []
    for path in Path('/proc').glob('[0-9]*/stat'):
        with contextlib.suppress(OSError):
            state, _, number = path.read_text().rpartition(')')[2].split()[:3]
            if int(number) == group and state != 'Z':
                found.append(path.parent.name)
    return found


def lines(folder: Path) -> list[str]:
    return (folder / LEDGER).read_text(encoding='utf-8').splitlines()


# --- one machine ----------------------------------------------------------------------------


def test_every_record_is_a_row_with_its_stage(result):
    rows = {row['record']: row for row in table(result)}
    # in the order in which people count
    assert list(rows) == ['stage_1', 'stage_2', 'stage_3', 'stage_10']
    for name, span in GAINS.items():
        row, model = rows[name], load_model(result / 'models' / f'{name}.yaml')
        assert (row['status'], row['reason']) == ('ok', '')
        truth = character(stage(span).model)
        assert float(row['gain']) == pytest.approx(truth.gain, rel=1e-3)
        assert float(row['loop_width']) == pytest.approx(truth.loop_width, rel=1e-2)
        assert float(row['resonance']) == pytest.approx(truth.resonance, rel=1e-2)
        assert float(row['bandwidth']) == pytest.approx(truth.bandwidth, rel=1e-2)
        assert float(row['delay']) == model.delay.total / RATE == 2 / RATE
        assert float(row['q2']) == model.hysteresis.weights[1]
        assert 0.0 < float(row['error_selection']) < 0.05


def test_a_failing_record_is_a_row_with_its_reason(result):
    (row,) = [row for row in table(result) if row['status'] == 'failed']
    assert row['record'] == 'stage_3'
    assert 'zip' in row['reason']
    assert str(result) not in row['reason']
    assert row['gain'] == ''
    assert not (result / 'models' / 'stage_3.yaml').exists()


def test_pictures_and_every_column_is_known(result):
    for name in ('errors.png', 'parameters.png'):
        assert (result / name).read_bytes().startswith(b'\x89PNG')
    assert not (result / 'effects.png').exists()
    plays = {f'{letter}{i}' for letter in 'rq' for i in range(1, 10)}
    assert set(table(result)[0]) <= set(COLUMNS) | plays


def test_parquet_says_the_same_with_units(result):
    parquet = pytest.importorskip('pyarrow.parquet')
    found = parquet.read_table(result / 'records.parquet')
    assert found.schema.field('gain').metadata == {b'unit': b'm/V'}
    for row, line in zip(found.to_pylist(), table(result), strict=True):
        assert {k: '' if v is None else str(v) for k, v in row.items()} == line


def test_a_second_run_does_what_is_new_or_changed_alone(capsys, records, result, tmp_path):
    folder, out = tmp_path / 'in', tmp_path / 'out'
    shutil.copytree(records, folder)
    shutil.copytree(result, out)
    before = (out / 'records.csv').read_bytes()
    argv = ['identify', folder, '--each', out, '--jobs', 1, *FAST]
    # copytree keeps the times, so these are the same records; a failed one is tried again
    code, text, _ = run(capsys, *argv)
    assert code == 0
    assert text.startswith('3 of 4 records identified, 3 of them earlier; 1 failed\n')
    assert len(lines(out)) == 5
    assert (out / 'records.csv').read_bytes() == before
    shutil.copyfile(folder / 'stage_1.npz', folder / 'stage_3.npz')
    (out / 'models' / 'stage_2.yaml').unlink()
    data = json.loads(run(capsys, *argv, '--json')[1])
    assert (data['records'], data['failed']) == (4, 0)
    assert len(lines(out)) == 7
    assert data['units']['gain'] == 'm/V'
    rows = {row['record']: row for row in table(out)}
    assert rows['stage_3']['gain'] == rows['stage_1']['gain']
    # other settings make another result
    argv = ['identify', folder / 'stage_1.npz', '--each', out, '--jobs', 1, *FAST, '--delay', 2]
    assert run(capsys, *argv)[0] == 0
    assert len(lines(out)) == 8
    assert [row['record'] for row in table(out)] == ['stage_1']


def test_interrupted_it_keeps_what_is_done_and_goes_on(capsys, records, result, tmp_path):
    folder, out = tmp_path / 'in', tmp_path / 'out'
    shutil.copytree(records, folder)
    for i in range(20, 40):
        shutil.copyfile(folder / 'stage_1.npz', folder / f'stage_{i}.npz')
    argv = ['identify', folder, '--each', out, '--jobs', 1, *FAST]
    process = subprocess.Popen(
        [sys.executable, '-m', 'piezo_ident', *map(str, argv)],
        cwd=ROOT,
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        while process.poll() is None and not ((out / LEDGER).exists() and lines(out)):
            time.sleep(0.01)
        # as a terminal does: to all of them
        os.killpg(process.pid, signal.SIGINT)
        said, complaint = process.communicate(timeout=60)
    finally:
        process.kill()
    done = len(lines(out))
    assert (process.returncode, said) == (130, '')
    assert complaint.splitlines()[0] == (
        f'piezo_ident: {done} of 24 records are done and kept; the same command goes on with the '
        'rest'
    )
    assert 1 <= done < 24
    end = time.monotonic() + 10
    while living(process.pid):
        assert time.monotonic() < end
        time.sleep(0.05)
    assert not (out / 'records.csv').exists()
    for i in range(22, 40):
        (folder / f'stage_{i}.npz').unlink()
    code, text, _ = run(capsys, *argv)
    assert code == 0
    assert 'of them earlier' in text
    fresh = {row['record']: row for row in table(result)}
    for row in table(out):
        assert row == fresh.get(row['record'], {**fresh['stage_1'], 'record': row['record']})


def test_nothing_good_is_refused_with_the_first_reason(capsys, records, tmp_path):
    argv = ['identify', records / 'stage_3.npz', tmp_path / 'no.csv', '--each', tmp_path / 'out']
    err = refused(capsys, *argv)
    assert 'none of 2 records' in err
    assert 'stage_3: damaged' in err or 'no: does not exist' in err
    assert {row['status'] for row in table(tmp_path / 'out')} == {'failed'}


@pytest.mark.parametrize(
    ('options', 'word'),
    [
        (['--jobs', '2'], '--each'),
        (['--reports'], '--each'),
        (['--scheduler', 'x:1'], '--each'),
        (['--each', 'o', '--model', 'm.yaml'], 'models go to'),
        (['--each', 'o', '--report', 'r'], '--reports'),
        (['--each', 'o', '--validation', 'v.csv'], 'own segments'),
        (['--each', 'o', '--jobs', '0'], 'at least 1'),
        (['--each', 'o', '--jobs', '2', '--scheduler', 'x:1'], 'for this machine'),
        (['--each', 'o', '--voltage-limits', '3', '1'], 'lower one first'),
    ],
)
def test_options_that_do_not_go_together(capsys, records, tmp_path, monkeypatch, options, word):
    monkeypatch.chdir(tmp_path)
    assert word in refused(capsys, 'identify', records, *options)
    assert list(tmp_path.iterdir()) == []


def test_places_that_will_not_do(capsys, records, result, tmp_path):
    assert 'choose another folder' in refused(capsys, 'identify', records, '--each', records)
    shutil.copyfile(records / 'stage_1.npz', tmp_path / 'stage_1.npz')
    both = [records / 'stage_1.npz', tmp_path / 'stage_1.npz']
    assert 'both called stage_1' in refused(capsys, 'identify', *both, '--each', tmp_path / 'o')
    argv = ['diagnose', result, records, '--each', result]
    assert 'identify --each found' in refused(capsys, *argv)


def test_no_input_and_nothing_foreign_is_written_over(capsys, records, tmp_path):
    record, model = tmp_path / 'in' / 'a.npz', tmp_path / 'models' / 'a.yaml'
    record.parent.mkdir()
    model.parent.mkdir()
    shutil.copyfile(records / 'stage_1.npz', record)
    save_model(base_model(), model)
    kept = model.read_bytes()
    out = tmp_path / 'out'
    # the model that is asked about, its folder, and what holds that
    for given in (model, model.parent, tmp_path):
        err = refused(capsys, 'diagnose', given, record, '--each', tmp_path)
        assert 'is an input, or holds one' in err
    # a shell's glob names files, and not their folder
    assert 'where the records are' in refused(capsys, 'identify', record, '--each', record.parent)
    # a record that stands where its report would
    bag = out / 'reports' / 'run'
    bag.mkdir(parents=True)
    shutil.copyfile(record, bag / 'run.npz')
    argv = ['identify', bag / 'run.npz', '--each', out, '--reports']
    assert 'is an input, or holds one' in refused(capsys, *argv)
    # somebody's own file under the name of a model
    (out / 'models').mkdir()
    (out / 'models' / 'a.yaml').write_text('mine')
    assert 'is there already' in refused(capsys, 'identify', record, '--each', out)
    assert (out / 'models' / 'a.yaml').read_text() == 'mine'
    # and under the name of a table or a picture
    assert set(PICTURES) < set(SUMMARY)
    for name in SUMMARY:
        (tmp_path / name).mkdir()
        (tmp_path / name / name).write_text('mine')
        argv = ['identify', record, '--each', tmp_path / name]
        assert f'{name}: is there already' in refused(capsys, *argv)
        assert [p.name for p in (tmp_path / name).iterdir()] == [name]
    assert model.read_bytes() == kept
    assert (bag / 'run.npz').is_file()


def test_a_record_of_the_same_name_is_another_one(capsys, records, result, tmp_path):
    out, other = tmp_path / 'out', tmp_path / 'stage_1.npz'
    shutil.copytree(result, out)
    shutil.copyfile(records / 'stage_2.npz', other)
    before = {p: p.read_bytes() for p in out.rglob('*') if p.is_file()}
    err = refused(capsys, 'identify', other, '--each', out, '--jobs', 1, *FAST)
    assert f'{records / "stage_1.npz"} under the name stage_1; choose another folder' in err
    assert {p: p.read_bytes() for p in out.rglob('*') if p.is_file()} == before
    # the one that failed has left nothing that could be lost
    shutil.copyfile(other, tmp_path / 'stage_3.npz')
    argv = ['--each', out, '--jobs', 1, *FAST]
    assert run(capsys, 'identify', tmp_path / 'stage_3.npz', *argv)[0] == 0
    # earlier ledgers do not say where the records were
    entries = [json.loads(line) for line in lines(out)]
    text = ''.join(json.dumps({k: e[k] for k in e if k != 'path'}) + '\n' for e in entries)
    (out / LEDGER).write_text(text)
    assert run(capsys, 'identify', other, *argv)[0] == 0


def test_the_folder_one_is_in_has_a_name(capsys, records, tmp_path, monkeypatch):
    here = tmp_path / 'mine'
    here.mkdir()
    (here / 'metadata.yaml').write_text('no bag')
    monkeypatch.chdir(here)
    refused(capsys, 'identify', '.', '--each', tmp_path / 'out', '--reports')
    assert [row['record'] for row in table(tmp_path / 'out')] == ['mine']


def test_reports(capsys, records, tmp_path):
    argv = ['identify', records / 'stage_1.npz', '--each', tmp_path, '--reports', '--jobs', 1]
    assert run(capsys, *argv, *FAST)[0] == 0
    folder = tmp_path / 'reports' / 'stage_1'
    assert (folder / 'report.html').is_file()
    model = (tmp_path / 'models' / 'stage_1.yaml').read_bytes()
    assert (folder / 'model.yaml').read_bytes() == model


# --- diagnosis ------------------------------------------------------------------------------


def test_diagnose_with_one_model_and_with_one_each(capsys, tmp_path):
    folder, models = tmp_path / 'in', tmp_path / 'models'
    folder.mkdir()
    models.mkdir()
    write_record(measured(), folder / 'a.npz')
    save_model(base_model(), tmp_path / 'model.yaml')
    only = ['--only', 'creep', '--jobs', 1]
    argv = ['diagnose', tmp_path / 'model.yaml', folder, '--each', tmp_path / 'one', *only]
    code, text, _ = run(capsys, *argv)
    assert code == 0
    assert '1   creep (1)\n' in text
    (row,) = table(tmp_path / 'one')
    assert row['verdict'] in ('named', 'class')
    assert (row['effects'], row['model']) == ('creep', 'model.yaml')
    assert float(row['error_after']) < 0.1 * float(row['error_before'])
    assert float(row['creep.share']) > 0.9
    assert np.isfinite(float(row['creep.gain.1']))
    model = load_model(tmp_path / 'one' / 'models' / 'a.yaml')
    assert [effect.name for effect in model.effects] == ['creep']
    save_model(base_model(), models / 'a.yaml')
    shutil.copyfile(folder / 'a.npz', folder / 'b.npz')
    argv = ['diagnose', tmp_path, folder, '--each', tmp_path / 'two', *only]
    assert run(capsys, *argv)[0] == 0
    own, missing = table(tmp_path / 'two')
    assert {**own, 'model': ''} == {**row, 'model': ''}
    assert (missing['status'], missing['reason']) == ('failed', 'there is no model b.yaml for it')
    assert 'holds no models' in refused(capsys, 'diagnose', folder, folder, '--each', models)


# --- a cluster ------------------------------------------------------------------------------

# runs a module as a program that ends with the tests, whatever ends those
TIED = """
import os, runpy, sys, threading
threading.Thread(target=lambda: (sys.stdin.buffer.read(), os._exit(0)), daemon=True).start()
sys.argv = sys.argv[1:]
runpy.run_module(sys.argv[0], run_name='__main__')
"""


@pytest.fixture(scope='module')
def scheduler(tmp_path_factory) -> Iterator[str]:
    """Return the address of a dask scheduler with two workers, three processes of their own."""
    if importlib.util.find_spec('distributed') is None:
        pytest.skip('dask.distributed is not installed: pip install "piezo_ident[cluster]"')
    folder = tmp_path_factory.mktemp('cluster')
    file = folder / 'scheduler.json'
    environment = {**os.environ, 'PYTHONPATH': str(ROOT)}
    processes = []

    def start(what: str, *options: str) -> None:
        command = [sys.executable, '-c', TIED, f'distributed.cli.dask_{what}', *options]
        command += ['--scheduler-file', str(file), '--no-dashboard']
        with (folder / f'{len(processes)}.log').open('wb') as log:
            processes.append(
                subprocess.Popen(
                    command,
                    cwd=folder,
                    env=environment,
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=subprocess.STDOUT,
                )
            )

    try:
        start('scheduler', '--host', '127.0.0.1', '--port', '0')
        end = time.monotonic() + 60
        while not (file.exists() and file.read_text(encoding='utf-8').endswith('}')):
            assert time.monotonic() < end, (folder / '0.log').read_text(encoding='utf-8')
            time.sleep(0.05)
        for _ in range(2):
            start('worker', '--nthreads', '1', '--no-nanny')
        yield json.loads(file.read_text(encoding='utf-8'))['address']
    finally:
        for process in processes:
            process.kill()
            process.communicate()


def test_two_workers_make_the_same_table(
    capsys, records, result, scheduler, tmp_path, monkeypatch
):
    # the workers have to find what is named from here
    monkeypatch.chdir(records.parent)
    monkeypatch.setattr(executors, 'PATIENCE', 60.0)
    argv = ['identify', records.name, '--each', tmp_path, '--scheduler', scheduler, *FAST]
    code, text, err = run(capsys, *argv)
    assert (code, err) == (0, '')
    assert text.startswith('3 of 4 records identified; 1 failed\n')
    for name in ('records.csv', *(f'models/{name}.yaml' for name in GAINS)):
        assert (tmp_path / name).read_bytes() == (result / name).read_bytes()


def test_a_scheduler_that_is_not_there(capsys, records, tmp_path, monkeypatch):
    pytest.importorskip('distributed')
    monkeypatch.setattr(executors, 'PATIENCE', 0.2)
    argv = ['identify', records, '--each', tmp_path, '--scheduler', 'tcp://127.0.0.1:1']
    assert 'no dask scheduler answers there' in refused(capsys, *argv)


def test_without_dask_it_says_how_to_get_it(capsys, records, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    argv = ['identify', records, '--each', tmp_path, '--scheduler', 'x:1']
    assert 'pip install "piezo_ident[cluster]"' in refused(capsys, *argv)


# --- what it is made of ---------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """Ends its process, raises, or gives back a number."""

    number: int

    def __call__(self) -> int:
        if self.number == 1:
            os._exit(9)
        if self.number == 2:
            raise ValueError('no')
        return self.number


def test_a_process_that_dies_takes_no_other_record_with_it():
    with cores(2) as places:
        found = dict(run_all([Job(i) for i in range(6)], places, lambda i, error: f'{i}: {error}'))
    assert found.pop(1) == '1: the process at work ended by itself; is there enough memory?'
    assert found == {0: 0, 2: '2: no', 3: 3, 4: 4, 5: 5}


def test_whatever_a_record_dies_of_is_its_reason(monkeypatch):
    def broken(*args: object) -> None:
        raise RuntimeError('two\nlines')

    monkeypatch.setattr('piezo_ident.many.run.read_record', lambda path, **options: measured())
    monkeypatch.setattr('piezo_ident.many.run.identify', broken)
    monkeypatch.setattr('piezo_ident.many.run.diagnose', broken)
    model = model_to_yaml(base_model())
    for job in (Identify('a', '/x/a.npz'), Diagnose('a', '/x/a.npz', model, 'model.yaml')):
        assert job().row == Row('a', {}, 'RuntimeError: two lines')


def test_the_key_follows_the_record_and_the_settings(tmp_path):
    path = tmp_path / 'a.csv'
    path.write_text('1')
    first = fingerprint(str(path))
    path.write_text('12')
    assert fingerprint(str(path)) != first
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag' / 'x.db3').write_text('1')
    assert fingerprint(str(tmp_path / 'bag')).startswith('1-1-')
    job = Identify('a', 'a.csv')
    # where it lies does not matter, how it is reported does
    assert job.settled() == Identify('b', '/elsewhere/b.csv').settled()
    assert job.settled() != Identify('a', 'a.csv', report=len).settled()


def test_half_a_line_of_a_killed_run_is_passed_over(tmp_path):
    good = Outcome(Row('a', {'gain': 1e-6}))
    Ledger(tmp_path, 'identify').add('key', good, '/in/a.csv')
    with (tmp_path / LEDGER).open('a') as file:
        file.write('{"verb": "ident')
    ledger = Ledger(tmp_path, 'identify')
    assert ledger.done('a', 'key') == good.row
    assert ledger.done('a', 'other') is None
    ledger.add('key', Outcome(Row('b', reason='no')), '/in/b.csv')
    ledger = Ledger(tmp_path, 'identify')
    assert ledger.done('a', 'key') == good.row
    # to be tried again
    assert ledger.done('b', 'key') is None
    (tmp_path / LEDGER).write_text('hello\nworld\n')
    with pytest.raises(ConfigError, match='line 1'):
        Ledger(tmp_path, 'identify')


def test_the_table_does_not_depend_on_who_was_first():
    rows = [Row('b', {'gain': 0.1, 'q2': 1.0, 'r1': 2.0}), Row('a', {'q1': None}, 'x, "y"')]
    text = csv_text(rows)
    assert text == csv_text(rows[::-1])
    assert (
        text == 'record,status,reason,gain,r1,q1,q2\na,failed,"x, ""y""",,,,\nb,ok,,0.1,2.0,,1.0\n'
    )
    assert columns_of([Row('a', {'creep.gain.1': 1, 'warnings': '', 'creep.share': 1})]) == [
        *('record', 'status', 'reason', 'creep.share', 'creep.gain.1', 'warnings')
    ]


def test_drift_and_who_stands_out():
    rng = np.random.default_rng(1)
    gains = 8e-6 * (1.0 - 0.05 * np.linspace(0, 1, 50) + 0.002 * rng.standard_normal(50))
    gains[7] = 9e-6
    names = [f'cal_2026-{1 + i // 25:02d}-{1 + i % 25:02d}' for i in range(50)]
    rows = [Row(name, {'gain': g}) for name, g in zip(names, gains, strict=True)]
    (gain,) = [q for q in QUANTITIES if q.name == 'gain']
    found = spread_of(in_order(rows[::-1]), gain)
    # 5 % of 8 um/V in all
    assert found.drift == pytest.approx(-0.4, rel=0.05)
    assert found.far == (names[7],)
    mixed = [Row(name, {'gain': g}) for name, g in zip(names, rng.permutation(gains), strict=True)]
    assert spread_of(mixed, gain).drift is None


def test_pictures_of_rows_that_say_little(tmp_path):
    (tmp_path / 'errors.png').write_bytes(b'of an earlier run')
    assert write_spread([Row('a', {'gain': 1.0}), Row('b', reason='x')], tmp_path) == []
    assert list(tmp_path.iterdir()) == []
    rows = [
        Row(f'$x^{i}$', {'gain': 1e-6 * i, 'error_held_out': 0.0, 'error_selection': None})
        for i in range(1, 4)
    ]
    assert [path.name for path in write_spread(rows, tmp_path)] == ['parameters.png']
    rows = [Row(row.record, {'effects': 'creep', 'creep.rms': 0.1}) for row in rows]
    assert [path.name for path in write_spread(rows, tmp_path)] == ['effects.png']


def test_every_column_is_in_the_documentation():
    text = (ROOT / 'docs' / 'many_records.md').read_text(encoding='utf-8')
    for name, column in COLUMNS.items():
        about = column.about.replace('|', r'\|')
        assert f'| `{name}` | {column.unit} | {about} |' in text

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Many records at once: a failure is a row, a stopped run goes on, workers change no number."""

import contextlib
from dataclasses import replace
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from diagnosis_examples import measured
import numpy as np
import piezo_ident as pi
from piezo_ident.cli import main
from piezo_ident.common.errors import ConfigError
from piezo_ident.excitation.program import parse_program
from piezo_ident.identification.results import Settings
from piezo_ident.many.run import Diagnose, Identify, run_many
from piezo_ident.many.table import csv_text, Row
from piezo_ident.model.files import load
from piezo_ident.model.simulated_stage import Sensor, SimulatedStage
from process_jobs import Deadly
from programs import SLOW, slow_model, SLOW_PROGRAM
import pytest

ROOT = Path(__file__).resolve().parents[2]
FAST = Identify(Settings(order=(2, 2), thresholds=5, solver='least_squares'))
STROKES = {'stage_1': 70e-6, 'stage_2': 72e-6, 'stage_10': 74e-6}


def stage(stroke: float) -> SimulatedStage:
    model = slow_model()
    return SimulatedStage(
        replace(model, scaling=replace(model.scaling, Y=stroke)), Sensor(noise_rms=1e-9)
    )


@pytest.fixture(scope='module')
def records(tmp_path_factory) -> list[Path]:
    """Three records and a file that is none."""
    folder = tmp_path_factory.mktemp('line')
    sequence = parse_program(SLOW_PROGRAM).build(SLOW)
    for i, (name, stroke) in enumerate(STROKES.items()):
        record = stage(stroke).play(sequence, np.random.default_rng(i))
        pi.write(record, folder / f'{name}.npz')
    (folder / 'stage_3.npz').write_bytes(b'a cable was loose')
    return [folder / f'stage_{i}.npz' for i in (1, 2, 10, 3)]


@pytest.fixture(scope='module')
def folder(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp('result')


class Here:
    """Does the work of a process in this one."""

    def run(self, job):
        return job(lambda step, share: None)

    def close(self):
        pass


@pytest.fixture
def in_this_process(monkeypatch):
    """Start no process where it is not about processes."""
    monkeypatch.setattr('piezo_ident.many.workers.WorkerProcess', Here)


@pytest.fixture(scope='module')
def rows(records, folder) -> list[Row]:
    return run_many(records, folder, FAST, jobs=2)


def test_each_record_is_a_row_with_its_stage(rows, folder):
    assert [row.record for row in rows] == ['stage_1', 'stage_2', 'stage_3', 'stage_10']
    gains = [row.values['gain'] for row in rows if row.record in STROKES]
    assert gains == sorted(gains)
    for row in rows:
        if row.record in STROKES:
            assert row.values['delay_samples'] == pytest.approx(2, abs=0.3)
            model = load(folder / 'models' / f'{row.record}.yaml')
            assert row.values['p2'] == pytest.approx(model.hysteresis.p2)


def test_a_record_that_fails_is_a_row_with_its_reason(rows, folder):
    (failed,) = (row for row in rows if not row.is_good)
    assert failed.record == 'stage_3' and failed.reason and not failed.values
    assert not (folder / 'models/stage_3.yaml').exists()


def test_a_second_run_does_only_what_failed_or_changed(rows, records, folder, in_this_process):
    models = folder / 'models'
    before = {path.name: path.stat().st_mtime_ns for path in models.iterdir()}
    os.utime(records[0])
    again = run_many(records, folder, FAST, jobs=1)
    after = {path.name: path.stat().st_mtime_ns for path in models.iterdir()}
    assert {name for name in after if after[name] != before[name]} == {'stage_1.yaml'}
    assert csv_text(again) == csv_text(rows)


def test_other_settings_do_all_again(rows, records, folder, in_this_process):
    before = (folder / 'models/stage_10.yaml').stat().st_mtime_ns
    other = Identify(replace(FAST.settings, thresholds=4))
    (row,) = run_many(records[2:3], folder, other, jobs=1)
    assert row.is_good
    assert (folder / 'models/stage_10.yaml').stat().st_mtime_ns > before


def test_an_older_file_that_takes_the_place_of_another_is_done(records, tmp_path, in_this_process):
    path, out = tmp_path / 'stage_7.npz', tmp_path / 'out'
    path.write_bytes(records[0].read_bytes())
    (wrong,) = run_many([path], out, FAST, jobs=1)
    path.write_bytes(records[2].read_bytes())
    # as cp -p and an unpacked archive leave it
    os.utime(path, (0, 0))
    (right,) = run_many([path], out, FAST, jobs=1)
    assert right.values['stroke'] > 1.04 * wrong.values['stroke']


def test_a_process_that_dies_costs_one_record(records, tmp_path):
    done = run_many(records[:3], tmp_path / 'out', Deadly(), jobs=1)
    assert [row.record for row in done if row.is_good] == ['stage_1', 'stage_10']


def test_places_that_are_refused(records, rows, folder, tmp_path):
    with pytest.raises(ConfigError, match=records[0].name):
        run_many(records, records[0].parent, FAST)
    (tmp_path / 'notes.txt').write_text('mine')
    with pytest.raises(ConfigError, match=f'{tmp_path}.* identify'):
        run_many(records, tmp_path, FAST)
    with pytest.raises(ConfigError, match=f'{folder}.* diagnose'):
        run_many(records, folder, Diagnose(tmp_path / 'model.yaml'))
    twin = tmp_path / 'twin' / records[0].name
    twin.parent.mkdir()
    twin.write_bytes(records[0].read_bytes())
    with pytest.raises(ConfigError, match='stage_1'):
        run_many([*records, twin], tmp_path / 'new', FAST)


def test_diagnosis_with_a_model_for_each(tmp_path, in_this_process):
    (tmp_path / 'records').mkdir()
    (tmp_path / 'given').mkdir()
    record = measured()
    paths = [tmp_path / 'records' / f'{name}.npz' for name in ('a', 'b')]
    for path in paths:
        pi.write(record, path)
    slow_model().save(tmp_path / 'given/a.yaml')
    task = Diagnose(tmp_path / 'given', pi.DiagnosisSettings(effects=('creep',)))
    first, second = run_many(paths, tmp_path / 'out', task, jobs=1)
    assert first.is_good, first.reason
    assert first.values['verdict'] and first.values['model'] == 'a.yaml'
    assert 'b.yaml' in second.reason


def living(group: int) -> list[str]:
    """Return the processes of a group that have not ended."""
    processes = []
    for path in Path('/proc').glob('[0-9]*/stat'):
        with contextlib.suppress(OSError):
            state, _, number = path.read_text().rpartition(')')[2].split()[:3]
            if int(number) == group and state != 'Z':
                processes.append(path.parent.name)
    return processes


def test_interrupted_it_keeps_what_is_done_and_leaves_no_process(records, tmp_path):
    out = tmp_path / 'out'
    command = [sys.executable, '-m', 'piezo_ident', 'identify', *map(str, records)]
    command += ['--each', str(out), '--jobs', '1', '--order', '2,2', '--thresholds', '5']
    process = subprocess.Popen(command, cwd=ROOT, start_new_session=True)
    end = time.monotonic() + 120
    while not list(out.glob('rows/*.json')) and time.monotonic() < end:
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130
    while living(process.pid) and time.monotonic() < end:
        time.sleep(0.05)
    assert living(process.pid) == []
    for row in out.glob('rows/*.json'):
        assert (out / 'models' / f'{row.stem}.yaml').is_file()


def test_the_command_line(records, tmp_path, capsys, blank_pictures, in_this_process):
    argv = ['identify', *map(str, records[:2]), '--each', str(tmp_path / 'out'), '--jobs', '1']
    assert main([*argv, '--order', '2,2', '--thresholds', '5', '--reports', '--json']) == 0
    result = json.loads(capsys.readouterr().out)
    assert result['records'] == 2 and result['failed'] == 0
    assert result['units']['stroke'] == 'm'
    for name in ('records.csv', 'reports/stage_1/report.html'):
        assert (tmp_path / 'out' / name).stat().st_size > 0
    assert main(['identify', str(records[3]), '--each', str(tmp_path / 'bad')]) == 2
    said = capsys.readouterr()
    assert 'stage_3' in said.err
    # a log, which shows no bar, has a line a record
    assert said.out == '1 of 1: stage_3 failed\n'


@pytest.mark.parametrize('options', [['--model', 'm.yaml'], ['--report', 'r'], ['--jobs', '0']])
def test_options_that_do_not_go_with_each(records, tmp_path, options):
    assert main(['identify', str(records[0]), '--each', str(tmp_path / 'o'), *options]) == 2


def test_a_cluster_gives_the_same_table(records, tmp_path, in_this_process):
    distributed = pytest.importorskip('distributed')
    cluster = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, dashboard_address=None, processes=False
    )
    with cluster:
        address = cluster.scheduler_address
        there = run_many(records[:1], tmp_path / 'there', FAST, scheduler=address)
    assert csv_text(there) == csv_text(run_many(records[:1], tmp_path / 'here', FAST, jobs=1))


def test_a_scheduler_that_is_not_there(records, tmp_path, monkeypatch):
    pytest.importorskip('distributed')
    monkeypatch.setattr('piezo_ident.many.workers.WAIT_FOR_SCHEDULER', 0.5)
    with pytest.raises(ConfigError, match=r'127\.0\.0\.1:9'):
        run_many(records, tmp_path / 'out', FAST, scheduler='tcp://127.0.0.1:9')

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Files that are empty, damaged, of another kind or unreadable end in one clear error."""

from pathlib import Path
import random
import re
import struct
import zipfile

import numpy as np
import piezo_ident as pi
from piezo_ident.cli import main
from piezo_ident.common import files
from piezo_ident.common.config import find_config
from piezo_ident.common.errors import ConfigError, DataError, ModelError, PiezoIdentError
from piezo_ident.common.files import parse_yaml
from piezo_ident.excitation.program import parse_program
from piezo_ident.model.files import load, model_from_dict
from piezo_ident.model.simulated_stage import stage_from_dict
from piezo_ident.record.record import Piece, Record, Segment
import pytest
import scipy.io
import scipy.sparse

FORMATS = ('r.csv', 'r.npz', 'r.mat', 'r.mcap', 'r.db3', 'bag')
STAGE = find_config('paper', 'stage').read_text()


@pytest.fixture(scope='module')
def record():
    v = 5.0 + 4.0 * np.sin(np.arange(400) / 7.0)
    segments = (Segment('noise', 0, 200), Segment('sine:50Hz', 200, 400))
    return Record((Piece(v, 7.5e-6 * v, 1000.0, 0.0, segments),))


def refused(action, *words, kind=PiezoIdentError):
    """Check that an error of ours refuses it in one short line."""
    with pytest.raises(kind) as caught:
        action()
    message = str(caught.value)
    assert message.isprintable() and len(message) < 1000
    for word in words:
        assert word in message


def file_of(path):
    """Return the file that holds the samples."""
    return next(f for f in path.iterdir() if f.suffix == '.mcap') if path.is_dir() else path


@pytest.mark.parametrize('name', FORMATS)
def test_empty_truncated_and_foreign_files(tmp_path, record, name):
    path = tmp_path / name
    pi.write(record, path)
    file = file_of(path)
    whole = file.read_bytes()
    # a part of a table may be a table, and a reading of .mat costs a process
    shares = {'.csv': (), '.mat': (0.5,)}.get(file.suffix, (0.1, 0.5, 0.9, 0.99))
    parts = [whole[: int(share * len(whole))] for share in shares]
    noise = np.random.default_rng(0).bytes(5000)
    for data in (b'', *parts, b'\x89PNG' + bytes(300), bytes(1000), noise):
        file.write_bytes(data)
        refused(lambda: pi.read(path), path.name, kind=DataError)


@pytest.mark.parametrize('name', FORMATS)
def test_damaged_files(tmp_path, record, name):
    path, rng = tmp_path / name, random.Random(0)
    pi.write(record, path)
    file = file_of(path)
    whole = file.read_bytes()
    # a reading of .mat costs a process
    for _ in range(3 if name == 'r.mat' else 40):
        data = bytearray(whole)
        for _ in range(rng.randint(1, 4)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        file.write_bytes(data[: rng.choice([None, rng.randrange(len(data))])])
        for recover in (False, True):
            try:
                pi.read(path, recover=recover)
            except PiezoIdentError as error:
                assert str(error).isprintable() and len(str(error)) < 1000


@pytest.mark.parametrize('suffix', ['.csv', '.npz', '.mat', '.mcap', '.db3', '.yaml'])
def test_devices_and_folders_are_not_read(tmp_path, suffix):
    path = tmp_path / f'r{suffix}'
    read = load if suffix == '.yaml' else pi.read
    path.symlink_to('/dev/zero')
    refused(lambda: read(path), path.name)
    path.unlink()
    path.mkdir()
    refused(lambda: read(path), path.name)


def test_no_right_to_read(tmp_path, record, monkeypatch, capsys):
    def denied(*arguments, **options):
        raise PermissionError(13, 'Permission denied')

    for name in FORMATS[:3]:
        pi.write(record, tmp_path / name)
        monkeypatch.setattr(Path, 'open', denied)
        monkeypatch.setattr(zipfile, 'ZipFile', denied)
        refused(lambda n=name: pi.read(tmp_path / n), name, 'Permission denied')
        assert main(['convert', str(tmp_path / name), str(tmp_path / 'out.csv')]) == 2
        monkeypatch.undo()
    assert capsys.readouterr().err.count('\n') == 3


def test_more_than_a_file_may_hold(tmp_path, record, monkeypatch):
    pi.write(record, tmp_path / 'r.npz')
    monkeypatch.setattr('piezo_ident.record.tables.arrays.UNPACKED_SIZE', 1000)
    refused(lambda: pi.read(tmp_path / 'r.npz'), 'unpacks to more', kind=DataError)
    assert files.UNPACKED_SIZE > 2**32


def test_a_mat_file_that_ends_its_reader(tmp_path, record, monkeypatch):
    # as SciPy does on some damaged files
    crash = 'import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n'
    (tmp_path / 'scipy').mkdir()
    (tmp_path / 'scipy' / '__init__.py').write_text(crash)
    pi.write(record, tmp_path / 'r.mat')
    monkeypatch.syspath_prepend(tmp_path)
    refused(lambda: pi.read(tmp_path / 'r.mat'), 'r.mat', '-11', kind=DataError)


def test_a_mat_file_that_announces_too_much(tmp_path):
    def element(kind, content):
        return struct.pack('<II', kind, len(content)) + content + bytes(-len(content) % 8)

    body = element(6, struct.pack('<II', 6, 0)) + element(5, struct.pack('<2i', 2**31 - 1, 9))
    matrix = element(14, body + element(1, b't') + element(9, bytes(8)))
    (tmp_path / 'r.mat').write_bytes(b'MATLAB'.ljust(124) + b'\x00\x01IM' + matrix)
    refused(lambda: pi.read(tmp_path / 'r.mat'), 'r.mat', kind=DataError)


@pytest.mark.parametrize('packed', [False, True])
def test_other_variables_of_a_workspace_are_left_alone(tmp_path, packed):
    deep = np.empty(1, dtype=object)
    deep[0] = {'a': [1, 'b', {'c': np.eye(3)}]}
    others = {'deep': deep, 'sparse': scipy.sparse.eye(3).tocsc(), 'text': 'abc', 'z': 1j}
    t = np.arange(9) / 1000
    path = tmp_path / 'r.mat'
    scipy.io.savemat(path, {**others, 't': t, 'v': t, 'y': 1e-6 * t}, do_compression=packed)
    read = pi.read(path)
    assert read.n == 9
    assert {f.where for f in read.faults} == {repr(k) for k in others}
    scipy.io.savemat(path, {'t': t, 'v': deep, 'y': 1e-6 * t})
    refused(lambda: pi.read(path), 'v holds', kind=DataError)


@pytest.mark.parametrize(
    'segment',
    [
        'signal: step, bias: 5, size: 1, hold: 1e-9, count: 1000000000000',
        'signal: minor_loops, biases: [5], amplitude: 1, cycles: 1e300',
        'signal: sine, bias: 5, amplitude: 1, frequency: 1e300, duration: 1e300',
        'signal: noise, bias: 5, amplitude: 1, cutoff: 1e-300, duration: 1',
        'signal: triangle, slope: 1e-300',
    ],
)
def test_programs_without_end(segment):
    program = parse_program(f'{{limits: [0, 10], segments: [{{{segment}}}]}}')
    refused(lambda: program.build(sample_rate=1000.0), kind=ConfigError)


def test_models_that_ask_for_too_much():
    data = {k: v for k, v in parse_yaml(STAGE, 's').items() if k not in ('sensor', 'seed')}
    for key, value in (
        ('dynamics', {'a': [0.0] * 5000, 'b': [1.0]}),
        ('delay', {'samples': 10**15}),
        ('effects', [{'name': 'backlash', 'parameters': {'width': 0.1}}] * 1000),
        ('sample_rate', 10**400),
    ):
        refused(lambda k=key, v=value: model_from_dict({**data, k: v}), kind=ModelError)
    refused(lambda: stage_from_dict({**data, 'sensor': {'noise_rms': 10**400}}))


def test_no_pickle_and_no_unsafe_yaml_in_what_reads_files():
    package = Path(files.__file__).parents[1]
    for room in ('common', 'record', 'model', 'excitation'):
        for file in (package / room).rglob('*.py'):
            if file.name == 'process.py':
                continue  # reads what a child process of its own has written
            text = file.read_text(encoding='utf-8').replace('yaml.safe_load(', '')
            assert not re.search(r'pickle\.load|allow_pickle=True|yaml\.\w*load', text), file

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Bags written as a recorder does, killed at any moment, and what comes back of them."""

import json
import os
from pathlib import Path
import shutil
import signal
import sqlite3
import subprocess
import sys

from bag_data import raw_blocks, recording
import numpy as np
import piezo_ident as pi
from piezo_ident.cli import main
from piezo_ident.common.errors import DataError
from piezo_ident.record.bags.read import MESSAGE_TYPE, opened_bag, read_bag, typestore
from piezo_ident.record.bags.write import write_bag
from piezo_ident.record.record import Piece, Record
import pytest
from rosbags.rosbag2 import Reader

pytest.importorskip('mcap_ros2', reason="mcap is not installed: see the extra 'test'")

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

TEST = Path(__file__).resolve().parents[2]
RATE = 20000.0
STORAGES = ('mcap', 'sqlite3')

# writes blocks of both topics for ever, flushes every fifth pair, says how far it is
ENDLESS = """
import sys
from bag_data import raw_blocks
from piezo_ident.record.bags.write import BagWriter

writer = BagWriter(sys.argv[1], sys.argv[2], {'sample_rate': '20000.0'})
for topic in ('/voltage', '/displacement'):
    writer.add_topic(topic, 'std_msgs/msg/Float64MultiArray')
for k, (voltage, displacement) in enumerate(raw_blocks()):
    writer.write('/voltage', 10**18 + k * 5_000_000, voltage)
    writer.write('/displacement', 10**18 + k * 5_000_000 + 1, displacement)
    if k % 1200 == 999:
        writer.flush()
        print(k, flush=True)
"""


def killed(path: Path, **options) -> Path:
    """Leave a bag as SIGKILL would after a flush."""
    writer = recording(path.with_name('alive'), **options)
    shutil.copytree(writer.path, path)
    (path / writer.file.name).rename(path / f'{path.name}{writer.file.suffix}')
    writer.abort()
    return path


def refused(path: Path) -> None:
    with pytest.raises(DataError, match=f'{path.name}: damaged or unfinished bag'):
        read_bag(path, recover=True)


def truncation(record: Record) -> str:
    (fault,) = (f for f in record.faults if f.name == 'truncated_bag')
    return str(fault)


@pytest.mark.parametrize('storage', STORAGES)
def test_sigkill(tmp_path, storage):
    # in sqlite3 it comes with more than the page cache uncommitted: a hot journal is left
    process = subprocess.Popen(
        [sys.executable, '-c', ENDLESS, str(tmp_path / 'bag'), storage],
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(map(str, (TEST, TEST.parent)))},
        stdout=subprocess.PIPE,
    )
    try:
        for _ in range(2):
            flushed = int(process.stdout.readline())
        file = tmp_path / 'bag' / ('bag.mcap' if storage == 'mcap' else 'bag.db3')
        journal = file.with_name('bag.db3-journal')
        size = file.stat().st_size
        while storage == 'sqlite3' and not (journal.is_file() and file.stat().st_size > size):
            assert process.poll() is None
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
    before = {f.name: f.read_bytes() for f in (tmp_path / 'bag').iterdir()}
    record = read_bag(tmp_path / 'bag', recover=True)
    assert len(record.pieces) == 1
    assert record.pieces[0].n >= 100 * (flushed + 1)
    t = np.arange(record.n) / RATE
    np.testing.assert_array_equal(record.pieces[0].t, t)
    np.testing.assert_array_equal(record.pieces[0].v, 5 + np.sin(t))
    assert 'metadata.yaml is missing' in truncation(record)
    with pytest.raises(DataError, match=r"'piezo_ident convert .* OUT'"):
        read_bag(tmp_path / 'bag')
    lacking = 'bag.mcap' if storage == 'mcap' else 'transaction that was never finished'
    assert lacking in truncation(record)
    # nothing of what was measured is touched
    assert {f.name: f.read_bytes() for f in (tmp_path / 'bag').iterdir()} == before


@pytest.mark.parametrize('storage', STORAGES)
def test_convert_says_so_and_recovers(tmp_path, storage, capsys):
    killed(tmp_path / 'bag', storage=storage)
    assert main(['convert', str(tmp_path / 'bag'), str(tmp_path / 'whole')]) == 0
    said = capsys.readouterr().out
    assert 'met: truncated_bag' in said
    assert 'recovered the 80 messages' in said
    assert 'is unknown' in said
    whole = pi.read(tmp_path / 'whole', recover=True)
    assert (whole.n, whole.faults) == (4000, ())
    assert main(['convert', '--json', str(tmp_path / 'bag'), str(tmp_path / 'out.npz')]) == 0
    story = json.loads(capsys.readouterr().out)
    assert [f['name'] for f in story['faults']] == ['truncated_bag']


@pytest.mark.parametrize('storage', STORAGES)
def test_a_lone_file_and_a_bag_without_metadata(tmp_path, storage):
    killed(tmp_path / 'bag', storage=storage)
    (file,) = (tmp_path / 'bag').iterdir()
    if storage == 'mcap':
        assert 'the end of bag.mcap is missing' in truncation(pi.read(file, recover=True))
    else:
        # all of it is committed: as a file of its own nothing is amiss
        assert pi.read(file, recover=True).faults == ()
    recording(tmp_path / 'good', storage).close()
    (tmp_path / 'good' / 'metadata.yaml').unlink()
    record = pi.read(tmp_path / 'good', recover=True)
    assert record.n == 4000
    assert 'recovered the 80 messages' in truncation(record)
    assert 'metadata.yaml is missing' in truncation(record)


def test_several_files(tmp_path):
    for i, part in enumerate(('bag_0', 'bag_1')):
        recording(tmp_path / part).close()
        folder = tmp_path / 'bag'
        folder.mkdir(exist_ok=True)
        (tmp_path / part / f'{part}.mcap').rename(folder / f'bag_{i}.mcap')
    with opened_bag(folder) as bag:
        assert sum(c.msgcount for c in bag.connections) == 160
        assert len(list(bag.messages(bag.connections))) == 160
    (folder / 'bag_1.mcap').rename(folder / 'another.mcap')
    with pytest.raises(DataError, match=r'files: another\.mcap, bag_0\.mcap'):
        read_bag(folder, recover=True)


def test_a_stray_file_is_no_part_of_a_bag(tmp_path):
    recording(tmp_path / 'bag').close()
    (tmp_path / 'bag' / 'stray.mcap').write_bytes(b'')
    assert read_bag(tmp_path / 'bag').faults == ()


@pytest.mark.parametrize('share', [0.0, 0.2, 0.5, 0.9])
@pytest.mark.parametrize('metadata', [True, False])
def test_truncated_mcap_file(tmp_path, share, metadata):
    # a chunk holds 1 MiB
    v = np.random.default_rng(0).normal(size=100_000)
    write_bag(Record((Piece(v, 1e-6 * v, RATE),)), tmp_path / 'b')
    file = tmp_path / 'b' / 'b.mcap'
    size = file.stat().st_size
    file.write_bytes(file.read_bytes()[: int(share * size)])
    if not metadata:
        (tmp_path / 'b' / 'metadata.yaml').unlink()
    if share < 0.3:
        refused(tmp_path / 'b')
        return
    record = read_bag(tmp_path / 'b', recover=True)
    # all but the chunk that is cut
    assert share - 1.3 * 2**20 / size <= record.n / v.size <= share
    assert truncation(record)
    np.testing.assert_array_equal(record.pieces[0].v, v[: record.n])


def test_truncated_database(tmp_path):
    recording(tmp_path / 'b', 'sqlite3').close()
    file = tmp_path / 'b' / 'b.db3'
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    refused(tmp_path / 'b')


def test_recovery_without_the_package_mcap(tmp_path, monkeypatch):
    path = killed(tmp_path / 'bag')
    monkeypatch.setitem(sys.modules, 'mcap.stream_reader', None)
    with pytest.raises(DataError, match=r'bag\.mcap.*pip install mcap'):
        read_bag(path, recover=True)


@pytest.mark.parametrize('compression', ['NONE', 'ZSTD', 'LZ4'])
@pytest.mark.parametrize('crc', [True, False])
def test_compressed_bags_of_other_writers(tmp_path, compression, crc):
    (tmp_path / 'bag').mkdir()
    file = tmp_path / 'bag' / 'bag.mcap'
    with file.open('wb') as out:
        writer = McapWriter(
            out, chunk_size=20000, compression=CompressionType[compression], enable_crcs=crc
        )
        writer.start('ros2', 'test')
        definition, _ = typestore().generate_msgdef(MESSAGE_TYPE, ros_version=2)
        schema = writer.register_schema(MESSAGE_TYPE, 'ros2msg', definition.encode())
        topics = ('/voltage', '/displacement')
        ids = [writer.register_channel(topic, 'cdr', schema) for topic in topics]
        for k, pair in enumerate(raw_blocks(50)):
            for i, data in zip(ids, pair, strict=True):
                writer.add_message(i, 10**18 + k, data, 10**18 + k)
        writer.finish()
    data = file.read_bytes()
    assert pi.read(tmp_path / 'bag', recover=True).n == 5000
    file.write_bytes(data[: len(data) // 2])
    record = pi.read(tmp_path / 'bag', recover=True)
    assert 1000 < record.n < 5000
    # a byte within a later chunk
    broken = bytearray(data[: len(data) // 2])
    broken[-len(data) // 4] ^= 0xFF
    file.write_bytes(broken)
    if crc:
        assert 0 < pi.read(tmp_path / 'bag', recover=True).n < record.n


def test_a_database_that_is_no_bag(tmp_path):
    with sqlite3.connect(tmp_path / 'bag.db3') as database:
        database.execute('CREATE TABLE topics(id)')
    database.close()
    (tmp_path / 'bag').mkdir()
    (tmp_path / 'bag.db3').rename(tmp_path / 'bag' / 'bag.db3')
    with pytest.raises(DataError, match=r'bag\.db3'):
        read_bag(tmp_path / 'bag', recover=True)


def test_write_ahead_log(tmp_path):
    # rosbag2 can be told to write sqlite3 so; what is only in the log counts
    recording(tmp_path / 'bag', 'sqlite3').close()
    file = tmp_path / 'bag' / 'bag.db3'
    database = sqlite3.connect(file)
    database.execute('PRAGMA journal_mode=WAL').fetchone()
    (topic,) = database.execute("SELECT id FROM topics WHERE name = '/voltage'").fetchone()
    database.execute('INSERT INTO messages VALUES(?, ?, ?, ?)', (999, topic, 2 * 10**18, b'new'))
    database.commit()
    shutil.copytree(tmp_path / 'bag', tmp_path / 'killed')
    database.close()
    assert (tmp_path / 'killed' / 'bag.db3-wal').stat().st_size
    with opened_bag(tmp_path / 'killed') as bag:
        assert [m.raw for m in bag.messages(bag.connections)][-1] == b'new'
        assert bag.faults


def test_both_ways_of_reading_agree(tmp_path):
    for storage in STORAGES:
        path = tmp_path / storage
        recording(path, storage).close()
        with Reader(path) as reader:
            want = [(c.topic, stamp, bytes(data)) for c, stamp, data in reader.messages()]
            qos = {c.topic: c.ext.offered_qos_profiles for c in reader.connections}
        (path / 'metadata.yaml').unlink()
        with opened_bag(path) as bag:
            got = [(m.connection.topic, m.stamp, m.raw) for m in bag.messages(bag.connections)]
            assert got == want
            assert {c.topic: c.ext.offered_qos_profiles for c in bag.connections} == qos
            assert (bag.start, bag.end) == (10**18, 10**18 + 39 * 5_000_000 + 100_000)


def test_a_name_that_no_disk_takes_is_refused(tmp_path):
    with (
        pytest.raises(DataError, match='x' * 300),
        opened_bag(tmp_path / ('x' * 300)),
    ):
        pass

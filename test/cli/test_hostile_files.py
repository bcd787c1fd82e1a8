# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""
Files from strangers: whatever they hold, an error of ours comes out, soon and without much memory.

`make fuzz` tries the same readers more than a million times.
"""

import ast
import json
import os
from pathlib import Path
import random
import re
import sqlite3
import struct
import sys
import time
import zipfile
import zlib

from hypothesis import given, HealthCheck, settings
import numpy as np
from piezo_ident.cli import main
from piezo_ident.common import yaml_io
from piezo_ident.common.errors import ConfigError, DataError, ModelError, PiezoIdentError
from piezo_ident.excitation.program import parse_program
from piezo_ident.model.files import load, model_from_dict, parse_yaml
from piezo_ident.model.simulated_stage import stage_from_dict
from piezo_ident.record.bags.check import check_journal
from piezo_ident.record.blocks import decode, Dimension
from piezo_ident.record.io import read_record, write_record
from piezo_ident.record.mat_read import read_variables
from piezo_ident.report.figures import NAMES
from piezo_ident.report.figures.diagnosis import DIAGNOSIS_NAMES
import pytest
import scipy.io
import yaml

pytest.importorskip('mcap_ros2', reason="mcap is not installed: see the extra 'test'")

from mcap.writer import CompressionType
from mcap_ros2.writer import Writer as McapWriter

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / 'benchmarks'))
from reliability.shapes import mutated, shapes  # noqa: E402
from reliability.targets import attempt, example, seeds, TARGETS  # noqa: E402

sys.path.remove(str(ROOT / 'benchmarks'))

#: inputs of each kind for each reader; those behind a file of their own are slow
TRIES = {'wire': 250, 'message': 250, 'effect': 250, 'csv': 150, 'programme': 120}
FEW = 50


@pytest.fixture(scope='session')
def place(tmp_path_factory):
    return tmp_path_factory.mktemp('hostile')


def soon(action, *words, seconds=10.0, kind=PiezoIdentError):
    """Check that an action is refused in one line, in little time, and by an error of ours."""
    start = time.process_time()  # the machine may be busy with something else
    with pytest.raises(kind) as caught:
        action()
    assert time.process_time() - start < seconds
    message = str(caught.value)
    assert message.isprintable()
    assert len(message) < 1000
    for word in words:
        assert word in message
    return message


# --- many inputs ----------------------------------------------------------------------------


@pytest.mark.parametrize('name', TARGETS)
def test_valid_inputs_are_taken(name, place):
    assert any(attempt(name, data, place) for data in seeds(name, place))


@pytest.mark.parametrize('name', TARGETS)
def test_wrong_contents_in_the_right_structure(name, place):
    @settings(
        max_examples=TRIES.get(name, FEW),
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=shapes(name, place))
    def run(data):
        attempt(name, data, place)

    run()


@pytest.mark.parametrize('name', TARGETS)
def test_changed_bytes(name, place):
    @settings(
        max_examples=TRIES.get(name, FEW),
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=mutated(seeds(name, place)))
    def run(data):
        attempt(name, data, place)

    run()


# --- what is never done ---------------------------------------------------------------------

#: it reads what a process that this package started has written, never a file
OWN_PIPE = 'helper.py'


def calls(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func), {k.arg: ast.unparse(k.value) for k in node.keywords}


@pytest.mark.parametrize(
    'file', sorted((ROOT / 'piezo_ident').rglob('*.py')), ids=lambda p: p.stem
)
def test_no_pickle_and_no_unsafe_yaml(file):
    tree = ast.parse(file.read_text(encoding='utf-8'))
    for called, options in calls(tree):
        base, _, last = called.rpartition('.')
        if base in ('pickle', 'cPickle', 'cloudpickle', 'dill', 'joblib', 'marshal', 'shelve'):
            assert last in ('dumps', 'dump', 'PickleBuffer') or file.name == OWN_PIPE
        assert last not in ('Unpickler', 'fromfile', 'eval', 'exec') or base
        if base in ('np', 'numpy') and last == 'load':
            assert options.get('allow_pickle') == 'False'
        if base == 'yaml':
            assert last in ('safe_dump', 'dump', 'load')
            assert last != 'load' or (file.name == 'yaml_io.py' and options['Loader'] == '_Loader')


def test_the_loader_is_a_safe_one():
    assert issubclass(yaml_io._Loader, yaml.SafeLoader)
    for tag in ('python/object/apply:os.system [x]', 'python/name:os.system', 'python/tuple [1]'):
        soon(lambda t=tag: parse_yaml(f'a: !!{t}', 'x.yaml'), 'not valid YAML')


def test_pictures_are_named_by_the_package_alone():
    assert all(re.fullmatch('[a-z0-9_]+', name) for name in (*NAMES, *DIAGNOSIS_NAMES))


# --- YAML -----------------------------------------------------------------------------------

ALIASES = 'a0: &a0 [1, 1]\n' + ''.join(f'a{i}: &a{i} [*a{i - 1}, *a{i - 1}]\n' for i in range(40))
MERGES = 'a0: &a0 {x: 1}\n' + ''.join(
    f'a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}\n' for i in range(1, 40)
)
BOMBS = {
    'aliases': ALIASES.replace('a0: &a0 [*a-1, *a-1]\n', ''),
    'merge keys': MERGES,
    'base 60': 'a: 1' + ':59' * 150_000,
    'depth': 'a: ' + '[' * 100_000,
    'mappings': 'a: ' + '{b: ' * 100_000,
    'length': 'a: ' + 'x' * 1_000_000,
    'entries': 'a: [' + '1,' * 60_000 + ']',
    'itself': 'a: &a [*a]',
}


@pytest.mark.parametrize('count', [[], 'many', {}, None, 1.5])
def test_counts_of_another_type_in_metadata(tmp_path, count):
    bag = tmp_path / 'bag'
    write_record(example(), bag)
    data = yaml.safe_load((bag / 'metadata.yaml').read_text())
    topics = data['rosbag2_bagfile_information']['topics_with_message_count']
    topics[0]['message_count'] = count
    (bag / 'metadata.yaml').write_text(yaml.safe_dump(data))
    with pytest.raises(DataError, match='damaged'):
        read_record(bag)


@pytest.mark.parametrize('bomb', BOMBS)
def test_yaml_bombs(tmp_path, bomb):
    path = tmp_path / 'x.yaml'
    path.write_text(BOMBS[bomb])
    for read in (load, lambda p: parse_program(p.read_text())):
        soon(lambda r=read: r(path), seconds=20.0)


def test_a_bomb_is_not_printed(tmp_path):
    # under every key whose wrong value is shown
    bomb = ['x' * 50] * 1000
    soon(lambda: parse_program(json.dumps({'limits': bomb, 'segments': [{'signal': 'idle'}]})))
    for item in ({'signal': bomb}, {'signal': 'idle', 'duration': bomb, 'name': bomb}):
        soon(lambda i=item: parse_program(json.dumps({'limits': [0, 1], 'segments': [i]})))
    soon(lambda: stage_from_dict({'seed': bomb}), kind=PiezoIdentError)


@pytest.mark.parametrize(
    'segment',
    [
        'signal: step, bias: 5, size: 1, hold: 1e-9, count: 1000000000000',
        'signal: step, bias: 5, size: 1, hold: 1, count: 1e300',
        'signal: decaying_triangle, bias: 5, amplitude: 1, cycles: 1e300',
        'signal: minor_loops, biases: [5], amplitude: 1, cycles: 1e300',
        'signal: sine, bias: 5, amplitude: 1, frequency: 1e300, duration: 1e300',
        'signal: multisine, bias: 5, amplitude: 1, lowest: 1, highest: 1e300, period: 1e300, '
        'periods: 1',
        'signal: multisine, bias: 5, amplitude: 1, lowest: 1, highest: 5, period: 1, periods: 1, '
        'realisations: 1000000000000',
        'signal: noise, bias: 5, amplitude: 1, cutoff: 1e-300, duration: 1',
        'signal: settle, bias: 5, amplitude: 1, cycles: 1e300',
        'signal: triangle, slope: 1e-300',
        'signal: idle, duration: 1e300',
    ],
)
def test_programmes_without_end(segment):
    program = parse_program(f'{{limits: [0, 10], segments: [{{{segment}}}]}}')
    soon(lambda: program.build(sample_rate=1000.0), kind=ConfigError)


def test_no_sample_of_a_programme_is_no_number():
    # its least and largest value are NaN, and pass every comparison
    program = parse_program(
        '{limits: [-1e308, 1e308], slew: 1e308, segments: '
        '[{signal: decaying_triangle, bias: 1.7e308, amplitude: 1.7e308, cycles: 2, '
        'slope: 1e308}]}'
    )
    with np.errstate(all='ignore'):
        soon(lambda: program.build(sample_rate=1000.0), kind=ConfigError)


def test_models_that_ask_for_too_much():
    (text, *_) = seeds('model', Path())
    data = json.loads(text)
    for key, value in (
        ('dynamics', {'a': [0.0] * 5000, 'b': [1.0]}),
        ('delay', {'samples': 10**15}),
        ('effects', [{'name': 'backlash', 'parameters': {'width': 0.1}}] * 1000),
        ('sample_rate', 10**400),
    ):
        soon(lambda k=key, v=value: model_from_dict({**data, k: v}), kind=ModelError)
    soon(lambda: stage_from_dict({**data, 'sensor': {'noise_rms': 10**400}}), kind=ConfigError)


def test_a_layout_with_negative_sizes():
    dims = (Dimension('sample:', -1, -2), Dimension('t,voltage', 2, 2))
    soon(lambda: decode(np.zeros(4), dims, 6), kind=DataError)


# --- tables ---------------------------------------------------------------------------------


def npz_of(path, members, packing=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, 'w', packing) as archive:
        for name, x in members.items():
            with archive.open(f'{name}.npy', 'w', force_zip64=True) as member:
                np.save(member, x)


@pytest.mark.parametrize('packing', [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2])
def test_npz_that_unpacks_without_bound(tmp_path, packing):
    path = tmp_path / 'r.npz'
    n = 4_000_000
    npz_of(path, {'t': np.arange(3.0), 'v': np.zeros(n), 'y': np.zeros(3 * n)}, packing)
    assert path.stat().st_size < 1_000_000
    soon(lambda: read_record(path), 'unpacks to more than', kind=DataError)


def test_packed_npz_is_read(tmp_path):
    t = np.arange(100_000) / 1000
    npz_of(tmp_path / 'r.npz', {'t': t, 'v': np.zeros(t.size), 'y': np.zeros(t.size)})
    assert read_record(tmp_path / 'r.npz').n == t.size


def mat_of(kind, dims, data, name=b't', packed=False):
    """Return a MATLAB file of one array whose parts need not fit."""

    def element(mi, content):
        return struct.pack('<II', mi, len(content)) + content + bytes(-len(content) % 8)

    body = element(6, struct.pack('<II', kind, 0))
    body += element(5, struct.pack(f'<{len(dims)}i', *dims)) + element(1, name) + data
    matrix = struct.pack('<II', 14, len(body)) + body
    if packed:
        raw = zlib.compress(matrix)
        matrix = struct.pack('<II', 15, len(raw)) + raw
    return bytes(124) + b'\x00\x01IM' + matrix


def cells(depth):
    inner = b''
    for _ in range(depth):
        body = struct.pack('<IIII', 6, 8, 1, 0) + struct.pack('<IIii', 5, 8, 1, 1)
        body += struct.pack('<II', 1, 0) + inner
        inner = struct.pack('<II', 14, len(body)) + body
    return inner


@pytest.mark.parametrize('packed', [False, True])
@pytest.mark.parametrize(
    'arguments',
    [
        (4, (2**31 - 1, 1), struct.pack('<II', 16, 0)),
        (4, (2**31 - 1, 2**31 - 1), struct.pack('<II', 16, 0)),
        (1, (2**31 - 1, 1), b''),
        (1, (1, 1), cells(20_000)),
        (6, (2**31 - 1, 1), struct.pack('<II', 9, 2**32 - 1)),
        (6, (-1, -1), struct.pack('<II', 9, 8) + bytes(8)),
        (6, (2, 1), struct.pack('<II', 9, 8) + bytes(8)),
        (2, (1, 1), b''),
        (5, (1, 1), b''),
        (6, (1, 1), b''),
    ],
)
def test_mat_that_announces_too_much(tmp_path, packed, arguments):
    path = tmp_path / 'r.mat'
    path.write_bytes(mat_of(*arguments, packed=packed))
    soon(lambda: read_record(path), 'no MATLAB file', kind=DataError)


def test_mat_that_unpacks_without_bound(tmp_path):
    path = tmp_path / 'r.mat'
    scipy.io.savemat(path, {k: np.zeros(9_000_000) for k in 'tvy'}, do_compression=True)
    assert path.stat().st_size < 1_000_000
    soon(lambda: read_record(path), 'unpacks to more than', kind=DataError)


def same(ours, theirs):
    if theirs.dtype == object:
        pairs = zip(ours.ravel(), theirs.ravel(), strict=True)
        return ours.shape == theirs.shape and all(same(a, np.asarray(b)) for a, b in pairs)
    if theirs.dtype.kind == 'U':
        return ours.tolist() == (theirs.tolist() or [''])
    return ours.shape == theirs.shape and np.array_equal(
        ours, theirs, equal_nan=theirs.dtype.kind in 'fc'
    )


def test_matlab_files_read_as_scipy_reads_them():
    # those that MATLAB wrote for SciPy's own tests, of both byte orders
    files = sorted((Path(scipy.io.__file__).parent / 'matlab' / 'tests' / 'data').glob('*.mat'))
    compared = 0
    for file in files:
        try:
            theirs = scipy.io.loadmat(file, struct_as_record=False)
            ours = read_variables(file.read_bytes(), lambda name: True)[1]
        # structures, functions, sparse matrices; version 4; and files that are damaged
        except (ValueError, TypeError, NotImplementedError, UnicodeDecodeError, zlib.error):
            continue
        for name, array in ours.items():
            assert same(array, theirs[name]), (file.name, name)
            compared += 1
    if not files:
        pytest.skip('SciPy came without its tests')
    assert compared > 30


@pytest.mark.parametrize('packed', [False, True])
def test_other_variables_of_a_workspace_are_left_alone(tmp_path, packed):
    deep = np.empty(1, dtype=object)
    deep[0] = {'a': [1, 'b', {'c': np.eye(3)}]}
    others = {'deep': deep, 'sparse': scipy.sparse.eye(3).tocsc(), 'text': 'abc', 'z': 1j}
    t = np.arange(9) / 10
    scipy.io.savemat(
        tmp_path / 'r.mat', {**others, 't': t, 'v': t, 'y': 1e-6 * t}, do_compression=packed
    )
    record = read_record(tmp_path / 'r.mat')
    assert record.n == 9
    assert {f.where for f in record.faults} == {repr(k) for k in others}


def test_a_wide_table_is_refused_soon(tmp_path):
    path = tmp_path / 'r.csv'
    path.write_text(','.join(['t,v,y', *(f'x_{i}' for i in range(200_000))]) + '\n')
    soon(lambda: read_record(path), 'columns', kind=DataError)


def test_time_in_pieces_without_number(tmp_path):
    # every run of twelve samples has a clock of its own
    rng = np.random.default_rng(0)
    steps = np.repeat(10.0 ** rng.uniform(-4, -2, 25_000), 12)
    path = tmp_path / 'r.npz'
    np.savez(path, t=np.cumsum(steps), v=np.zeros(steps.size), y=np.zeros(steps.size))
    soon(lambda: read_record(path), 'breaks', kind=DataError)


# --- links, pipes, devices ------------------------------------------------------------------


@pytest.mark.parametrize('suffix', ['.csv', '.npz', '.mat', '.mcap', '.db3', '.yaml'])
@pytest.mark.parametrize('target', ['/dev/zero', 'pipe'])
def test_what_has_no_end_is_not_opened(tmp_path, suffix, target):
    os.mkfifo(tmp_path / 'pipe')
    path = tmp_path / f'r{suffix}'
    path.symlink_to(target)
    read = load if suffix == '.yaml' else read_record
    soon(lambda: read(path), 'device or a pipe')


@pytest.mark.parametrize('unfinished', [False, True])
def test_links_out_of_a_bag(tmp_path, unfinished):
    write_record(example(), tmp_path / 'bag')
    (tmp_path / 'bag' / 'bag.mcap').rename(tmp_path / 'elsewhere.mcap')
    (tmp_path / 'bag' / 'bag.mcap').symlink_to(tmp_path / 'elsewhere.mcap')
    if unfinished:
        (tmp_path / 'bag' / 'metadata.yaml').unlink()
    soon(lambda: read_record(tmp_path / 'bag', recover=True), 'link out of the bag')
    # the bag itself may stand anywhere
    write_record(example(), tmp_path / 'other')
    (tmp_path / 'link').symlink_to(tmp_path / 'other')
    assert read_record(tmp_path / 'link').n == example().n


def bag_with(tmp_path, **changes):
    path = tmp_path / 'bag'
    write_record(example(), path)
    text = (path / 'metadata.yaml').read_text()
    data = yaml.safe_load(text)
    data['rosbag2_bagfile_information'].update(changes)
    (path / 'metadata.yaml').write_text(yaml.safe_dump(data))
    return path


def test_metadata_that_leads_elsewhere(tmp_path):
    write_record(example(), tmp_path / 'secret.mcap')
    bag = bag_with(tmp_path, relative_file_paths=['../secret.mcap'])
    soon(lambda: read_record(bag), 'bag')
    (tmp_path / 'b').mkdir()
    bag = bag_with(tmp_path / 'b', relative_file_paths=['bag.mcap'] * 1000)
    soon(lambda: read_record(bag), 'names a file twice')


@pytest.mark.parametrize('wrong', [['a'], {'a': 1}, 5, None])
@pytest.mark.parametrize('key', ['name', 'type'])
def test_topics_that_are_no_text(tmp_path, key, wrong):
    bag = bag_with(tmp_path)
    data = yaml.safe_load((bag / 'metadata.yaml').read_text())
    topics = data['rosbag2_bagfile_information']['topics_with_message_count']
    topics[0]['topic_metadata'][key] = wrong
    (bag / 'metadata.yaml').write_text(yaml.safe_dump(data))
    soon(lambda: read_record(bag, recover=True), kind=DataError)


@pytest.mark.parametrize('bomb', ['aliases', 'merge keys', 'depth', 'length', 'base 60'])
def test_bombs_in_metadata(tmp_path, bomb):
    bag = bag_with(tmp_path)
    (bag / 'metadata.yaml').write_text(BOMBS[bomb])
    soon(lambda: read_record(bag), kind=DataError)
    # beside a file that is read by itself they say nothing
    assert read_record(bag / 'bag.mcap').n == example().n


# --- mcap -----------------------------------------------------------------------------------


def test_mcap_that_unpacks_without_bound(tmp_path):
    path = tmp_path / 'r.mcap'
    with path.open('wb') as out:
        writer = McapWriter(out, compression=CompressionType.ZSTD)
        schema = writer.register_msgdef('std_msgs/msg/String', 'string data')
        writer.write_message('/a', schema, {'data': 'x' * 70_000_000}, 1, 1)
        writer.finish()
    assert path.stat().st_size < 100_000
    soon(lambda: read_record(path), 'more than a file of this size holds', kind=DataError)


def test_an_index_that_leads_elsewhere(tmp_path):
    path = tmp_path / 'r.mcap'
    write_record(example(), path)
    data = bytearray(path.read_bytes())
    # the chunk index: opcode, length, two times, then where the chunk begins
    at = data.rindex(b'\x08', 0, len(data) - 200)
    (start,) = struct.unpack_from('<Q', data, at + 25)
    assert data[start] == 6
    for wrong in (start + 60, 2**62):
        struct.pack_into('<Q', data, at + 25, wrong)
        path.write_bytes(data)
        soon(lambda: read_record(path), 'index', kind=DataError)


# --- sqlite3 --------------------------------------------------------------------------------

ENDLESS = (
    'WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i+1 FROM n) '
    'SELECT i AS id, 1 AS topic_id, i AS timestamp, zeroblob(100) AS data FROM n'
)


@pytest.mark.parametrize(
    'change',
    [
        f'DROP TABLE messages; CREATE VIEW messages AS {ENDLESS}',
        'ALTER TABLE messages ADD COLUMN more BLOB AS (zeroblob(900000000))',
        f'CREATE VIEW other AS {ENDLESS}',
        'CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM messages; END',
        'DROP TABLE topics; CREATE TABLE topics(id, name, type, CHECK (id = hex(randomblob(9))))',
    ],
)
def test_databases_that_compute(tmp_path, change):
    path = tmp_path / 'r.db3'
    write_record(example(), path)
    with sqlite3.connect(path) as database:
        database.executescript(change)
    database.close()
    for recover in (False, True):
        soon(lambda r=recover: read_record(path, recover=r), 'is no bag', kind=DataError)


def test_an_unexpected_table_is_harmless(tmp_path):
    path = tmp_path / 'r.db3'
    write_record(example(), path)
    with sqlite3.connect(path) as database:
        database.execute('CREATE TABLE passwords(name TEXT, secret BLOB)')
    database.close()
    assert read_record(path).n == example().n


def test_a_tree_that_leads_back_to_itself(tmp_path):
    path = tmp_path / 'r.db3'
    write_record(example(60_000), path)
    data = bytearray(path.read_bytes())
    page = int.from_bytes(data[16:18], 'big')
    # inner pages of tables: every child becomes the first one
    for start in range(page, len(data), page):
        if data[start] == 5:
            (count,) = struct.unpack_from('>H', data, start + 3)
            places = struct.unpack_from(f'>{count}H', data, start + 12)
            for p in places:
                data[start + p : start + p + 4] = data[start + places[0] : start + places[0] + 4]
    path.write_bytes(data)
    soon(lambda: read_record(path), 'damaged', kind=DataError)


def test_a_journal_deletes_no_other_file(tmp_path):
    victim = tmp_path / 'precious.txt'
    victim.write_text('of the user')
    bag = tmp_path / 'bag.db3'
    write_record(example(), bag)
    page = int.from_bytes(bag.read_bytes()[16:18], 'big')
    pages = bag.stat().st_size // page
    name = os.fsencode(victim)
    # a journal without pages, in which SQLite finds the name of a super-journal
    head = bytes.fromhex('d9d505f920a163d7') + struct.pack('>IIIII', 0, 0, pages, 512, page)
    tail = struct.pack('>I', 2**30 // page + 1) + name
    tail += struct.pack('>II', len(name), sum(name)) + head[:8]
    journal = tmp_path / 'bag.db3-journal'
    journal.write_bytes(head.ljust(512, b'\0') + tail)
    soon(lambda: read_record(bag, recover=True), 'several databases', kind=DataError)
    assert main(['convert', str(bag), str(tmp_path / 'out.csv')]) == 2
    assert victim.read_text() == 'of the user'
    # and it is SQLite that would
    copy = tmp_path / 'copy.db3'
    copy.write_bytes(bag.read_bytes())
    (tmp_path / 'copy.db3-journal').write_bytes(journal.read_bytes())
    with sqlite3.connect(copy) as database:
        database.execute('SELECT count(*) FROM sqlite_master').fetchone()
    database.close()
    assert not victim.exists()
    journal.write_bytes(b'ordinary')
    check_journal(journal)


def test_random_bytes_are_no_file(tmp_path):
    rng = random.Random(0)
    for suffix in ('.csv', '.npz', '.mat', '.mcap', '.db3'):
        for start in (b'', b'PK\x03\x04', b'\x89MCAP0\r\n', b'SQLite format 3\0', b't,v,y\n'):
            path = tmp_path / f'r{suffix}'
            path.write_bytes(start + rng.randbytes(300))
            soon(lambda p=path: read_record(p, recover=True), kind=DataError)


def test_markup_is_carried_but_does_nothing(tmp_path):
    # as a label it is text; as the name of a channel it is refused
    label = '<script>alert(1)</script>'
    rows = ''.join(f'{i / 10},{i},{i}e-6,{label}\n' for i in range(9))
    (tmp_path / 'r.csv').write_text(f't,v,y,segment\n{rows}')
    record = read_record(tmp_path / 'r.csv')
    assert record.labels == (label,)
    write_record(record, tmp_path / 'bag')
    assert read_record(tmp_path / 'bag').labels == (label,)

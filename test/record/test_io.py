# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Every format keeps every bit, and bad files end in one line that names the cure."""

import itertools
from pathlib import Path
import re
import zipfile

from hypothesis import given, HealthCheck, Phase, settings
from hypothesis import strategies as st
from measured_data import measured_record
import numpy as np
import piezo_ident as pi
from piezo_ident.common.errors import DataError
from piezo_ident.record.record import Piece, Record, Segment
import pytest
import scipy.io

FORMATS = ('r.csv', 'r.npz', 'r.mat', 'r.mcap', 'r.db3', 'r_mcap', 'r_sqlite3')
LABELS = st.sampled_from(['noise', 'sine:50Hz', 'hold:4V', 'a, "quoted" label', 'größer'])
FINITE = st.floats(-10, 10, allow_nan=False)


def storage(name: str) -> str | None:
    return 'sqlite3' if name == 'r_sqlite3' else None


@st.composite
def records(draw) -> Record:
    pieces = []
    rate = draw(st.sampled_from([1000.0, 20000.0, 2048.0, 1 / 3e-4]))
    tick = draw(st.integers(-1000, 10**6))
    names = st.sampled_from(['temperature', 'v2', 'T_1', 'v_b', 'y_b'])
    channels = draw(st.sets(names, max_size=3))
    for i in range(draw(st.integers(1, 3))):
        n = draw(st.integers(10, 250))
        # equal pieces would be taken for repeated rows
        seed = np.random.default_rng([i, draw(st.integers(0, 2**32))])
        cuts = sorted(draw(st.sets(st.integers(0, n), max_size=4)))
        segments: list[Segment] = []
        for start, stop in itertools.pairwise(cuts):
            label = draw(LABELS)
            if not (segments and segments[-1].stop == start and segments[-1].label == label):
                segments.append(Segment(label, start, stop))
        v = seed.uniform(-10, 10, n)
        v[0] = draw(FINITE)
        pieces.append(
            Piece(
                v=v,
                y=seed.normal(scale=1e-5, size=n),
                sample_rate=rate,
                start_time=tick / rate,
                segments=tuple(segments),
                channels={c: seed.normal(size=n) for c in sorted(channels)},
            )
        )
        tick += n + draw(st.integers(1, 1000))
        if draw(st.booleans()):
            tick = draw(st.integers(-1000, round(pieces[0].start_time * rate)))
    if any(b.start_time < a.start_time for a, b in itertools.pairwise(pieces)):
        # a jump back is a restart only where it returns to the beginning
        pieces = pieces[:2] if pieces[1].start_time <= pieces[0].start_time else pieces[:1]
    return Record(tuple(pieces), 'r')


def assert_equal(a: Record, b: Record) -> None:
    assert len(a.pieces) == len(b.pieces)
    for p, q in zip(a, b, strict=True):
        assert p.sample_rate == pytest.approx(q.sample_rate, rel=1e-9)
        # a rate such as 10 kHz over 3 has no exact decimals: the last digit of the clock may go
        np.testing.assert_allclose(p.t, q.t, rtol=1e-11, atol=1e-12)
        np.testing.assert_array_equal(p.v, q.v)
        np.testing.assert_array_equal(p.y, q.y)
        assert p.segments == q.segments
        assert set(p.channels) == set(q.channels)
        for name, x in p.channels.items():
            np.testing.assert_array_equal(x, q.channels[name])


@settings(
    max_examples=5,
    deadline=None,
    # shrinking files takes minutes and finds nothing that the message does not say
    phases=[Phase.explicit, Phase.reuse, Phase.generate],
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(record=records())
@pytest.mark.parametrize('name', FORMATS)
def test_round_trip_is_exact(tmp_path_factory, name, record):
    path = tmp_path_factory.mktemp('r') / name
    assert pi.write(record, path, storage=storage(name)) == ()
    back = pi.read(path)
    assert_equal(back, record)
    assert back.name == name
    assert {f.name for f in back.faults} <= {'gap', 'restart'}
    assert [p.name for p in path.parent.iterdir()] == [name]


def table(n: int = 300) -> dict[str, np.ndarray]:
    v = 5 + 5 * np.sin(np.arange(n) / 10)
    return {'t': np.arange(n) / 1000, 'v': v, 'y': 7.5e-6 * v}


def record() -> Record:
    c = table()
    return Record((Piece(c['v'], c['y'], 1000.0, segments=(Segment('noise', 5, 300),)),))


def csv_text(**columns: object) -> str:
    c = {**table(), **columns}
    lines = [','.join(map(str, row)) for row in zip(*c.values(), strict=True)]
    return '\n'.join([','.join(c), *lines]) + '\n'


def refuse(path: Path, *words: str) -> str:
    with pytest.raises(DataError) as caught:
        pi.read(path)
    message = str(caught.value)
    assert '\n' not in message
    for word in (str(path), *words):
        assert word in message
    assert caught.value.__cause__ is None
    return message


def test_losses_are_said(tmp_path):
    c = table()
    first = Piece(c['v'], c['y'], 1000.0)
    lone = Piece([1.0], [0.0], 1000.0, start_time=9.0)
    joint = Record((first, Piece(c['v'], c['y'], 1000.0, start_time=0.3), lone))
    (note,) = pi.write(joint, tmp_path / 'r.csv')
    assert note == '3 pieces with 601 samples read back as 1 with 600'
    bad = Record((first, Piece(c['v'], c['y'], 1000.0, start_time=0.2)))
    (note,) = pi.write(bad, tmp_path / 'bad.csv')
    assert 'reading refuses it' in note


def test_what_cannot_be_written_is_refused(tmp_path):
    c = table()
    piece = Piece(c['v'], c['y'], 1000.0, segments=(Segment('a\nb', 0, 9),))
    with pytest.raises(DataError, match=r"r\.csv: .*'a\\nb'"):
        pi.write(Record((piece,)), tmp_path / 'r.csv')
    piece = Piece(c['v'], c['y'], 1000.0, channels={'a b': c['v']})
    with pytest.raises(DataError, match=r"r\.csv: .*'a b'"):
        pi.write(Record((piece,)), tmp_path / 'r.csv')
    with pytest.raises(DataError, match=r'r\.xls'):
        pi.write(record(), tmp_path / 'r.xls')
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('name', FORMATS)
def test_outputs_are_kept_unless_asked_and_places_refused(tmp_path, name):
    path = tmp_path / name
    pi.write(record(), path, storage=storage(name))
    with pytest.raises(DataError, match=re.escape(str(path))):
        pi.write(record(), path, storage=storage(name))
    pi.write(record(), path, storage=storage(name), overwrite=True)
    assert_equal(pi.read(path), record())
    assert [p.name for p in tmp_path.iterdir()] == [name]
    nowhere = tmp_path / 'missing' / name
    with pytest.raises(DataError, match=f'{nowhere}.*cannot be written'):
        pi.write(record(), nowhere, storage=storage(name))


@pytest.mark.parametrize(
    ('metadata', 'other', 'reason'),
    [
        (None, 'thesis.tex', 'home: .*no bag'),
        # others call their files metadata.yaml, too
        ('author: me', 'thesis.tex', 'home: .*no bag'),
        ('[', 'thesis.tex', 'home: .*no bag'),
        ('', 'thesis.tex', 'home: .*no bag'),
        (..., 'notes.txt', r'home: .* notes\.txt,'),
        (..., 'model.yaml', r'home: .* model\.yaml,'),
    ],
)
def test_a_folder_that_is_no_bag_or_holds_more_is_never_replaced(
    tmp_path, metadata, other, reason
):
    path = tmp_path / 'home'
    if metadata is ...:
        pi.write(record(), path)
        for part in ('bag.db3-wal', 'bag_1.mcap.zstd'):
            (path / part).touch()
        pi.write(record(), path, overwrite=True)
    else:
        path.mkdir()
        if metadata is not None:
            (path / 'metadata.yaml').write_text(metadata)
    (path / other).touch()
    with pytest.raises(DataError, match=reason):
        pi.write(record(), path, overwrite=True)
    assert (path / other).exists()


def test_csv_as_spreadsheets_write_it(tmp_path):
    path = tmp_path / 'r.CSV'
    text = csv_text(segment=[' noise '] * 300, x_temp=[21.5] * 300, comment=['-'] * 300)
    text = (
        text.replace('t,v,y', ' t, v ,y', 1)
        .replace('comment\n', 'comment,\n')
        .replace('-\n', '-,\n')
    )
    path.write_bytes(b'\xef\xbb\xbf' + text.replace('\n', '\r\n').encode() + b'\r\n')
    got = pi.read(path)
    assert got.pieces[0].segments == (Segment('noise', 0, 300),)
    assert list(got.pieces[0].channels) == ['temp']
    assert [(f.name, f.where) for f in got.faults] == [('ignored_column', "'comment'")]


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('', ['empty file']),
        ('t,v,y\n', ['no rows']),
        ('0,1,2\n1,2,3\n', ['no header line']),
        ('0,1,2,noise\n1,2,3,noise\n', ['no header line']),
        ('# by hand\n0,1,2\n1,2,3\n', ['no header line']),
        ('# t,v,y\n', ['empty file']),
        ('t;v;y\n0;1,5;2\n1;1,000.5;2\n', ['line 3, column v', "'1,000.5'"]),
        ('t;v;y\n0;1.5;2\n1;1,5;2\n', ['line 3, column v', 'commas and points']),
        ('t,v,y\n0,1,2\n\n1,oops,3\n', ['line 4, column v', "'oops'"]),
        ('t,v,y\n0,1,2\n1,,3\n', ['1 of 2 samples are NaN']),
        ('t,v,y\n0,1,2\n1,NAN1,3\n', ['line 3, column v', "'NAN1'"]),
        (
            'time,v,y\n' + ''.join(f'04/13/2024 10:00:00.00{k}000,{k},{k}\n' for k in range(9)),
            ["column time holds text, '04/13/2024 10:00:00.000000'", 'as in --rate 20e3'],
        ),
        (
            't,v,y\n2024-04-13T10:00:00Z,1,2\n2024-04-13T10:00:01Z,oops,3\n',
            ['line 3, column v', "'oops'"],
        ),
        ('t,v,y\n0,low,2\n1,high,3\n', ["column v holds text, 'low'", '--columns v=NAME']),
        ('t;v;y\n0;1;2,5\n1;2;1.002,5\n', ["'1.002,5'", 'without marks between thousands']),
        ('t,v,y\n0,1,2\n1,3,OVERLOAD\n', ["'OVERLOAD'", 'leave the cell empty']),
        ('t,v,y\n1795600000000,1,2\n1795600000001,2,3\n', ['--time-unit ms']),
        ('t,v,y\n0,1,2\n1,1_000,3\n', ['line 3, column v', "'1_000'"]),
        ('t,v,y\n0,1,2\n1,2\n', ['line 3 has 2 columns, the header has 3; mend']),
        ('t,v,y\n0,0,1,5,2,25e-6\n', ['line 2 has 6 columns', 'decimal commas', 'points']),
        ('t,v,y\n0,0,0\n0,1,1,5,-2,2\n', ['line 3 has 6 columns', 'decimal commas']),
        ('t,v,y,segment\n0,0,1,5,2,2,noise\n', ['line 2 has 7 columns', 'decimal commas']),
        ('t,v,y\n0.0,1.5,2.5,2.0\n', ['line 2 has 4 columns', 'mend or delete']),
        ('# one\n\n# two\nt,v,y\n0,1,2\n1,oops,3\n', ['line 6, column v', "'oops'"]),
        ('# one\n# t,v,y\n0,1,2\n1,oops,3\n', ['line 4, column v', "'oops'"]),
        ('t,v,y\n0,1,2\n1,"2,3\n', ['no CSV file']),
        ('t,v,y,segment\n0,1,2,"a\n1,2,3,b\n2,3,4,b\n', ['no CSV file']),
        ('t,v,y,segment\n0,1,2,"a"b\n1,2,3,b\n', ['no CSV file']),
        ('t,v,y\n0,1,2\n1,\0,3\n', ['r.csv']),
        ('Zeit,Weg,U\n0,0,1,5,2,25e-6\n', ['line 2 has 6 columns', 'decimal commas']),
        ('t,v,y,segment\n0,1,2,\x81\n', ['UTF-8']),
    ],
)
def test_bad_csv(tmp_path, text, words):
    path = tmp_path / 'r.csv'
    path.write_bytes(text.encode('latin-1'))
    refuse(path, *words)


@pytest.mark.parametrize('cell', ['', 'NA', '#N/A'])
@pytest.mark.parametrize('row', [0, 150])
@pytest.mark.parametrize('form', ['{},{},{}', '{};{};{}', '{}\t{}\t{}', '{}\t {}\t{}'])
def test_cells_without_a_number_are_left_out(tmp_path, cell, row, form):
    path = tmp_path / 'r.csv'
    columns = [['time_s', *[k / 1000 for k in range(300)]]]
    columns += [[name, *[1.5 * (k % 10) for k in range(300)]] for name in ('voltage', 'y_um')]
    columns[2][row + 1] = cell
    text = ''.join(form.format(*cells) + '\n' for cells in zip(*columns, strict=True))
    text += 2 * (form.format('', '', '') + '\n')
    for written in (text, text.replace('.', ',')) if ',' not in form else (text,):
        path.write_text(written)
        got = pi.read(path)
        assert [(f.name, f.count) for f in got.faults][1:] == [('not_finite', 1)]
        assert got.n == 299


@pytest.mark.parametrize(
    'above',
    [
        '# the "first", of "two"\n# again\n\nt,v,y\n',
        '#made by hand\n# t, v,y\n',
        '\ufeff# x\nt,v,y\n',
    ],
)
def test_comments_above_the_header(tmp_path, above):
    path = tmp_path / 'r.csv'
    path.write_text(csv_text().replace('t,v,y\n', above, 1), encoding='utf-8')
    got = pi.read(path)
    np.testing.assert_array_equal(got.pieces[0].y, table()['y'])
    assert got.faults == ()


def test_error_beyond_the_first_rows(tmp_path):
    path = tmp_path / 'r.csv'
    lines = [f'{k / 1000},{k % 10},{k % 10}e-6' for k in range(70000)]
    lines[69000] = '69,nothing,1e-6'
    path.write_text('\n'.join(['t,v,y', *lines]))
    refuse(path, 'line 69002, column v', 'nothing')


def test_a_quoted_cell_may_go_on_over_the_rows_that_are_read_together(tmp_path):
    path = tmp_path / 'r.csv'
    cells = ['-'] * 70000
    cells[65535] = '"one\ntwo"'
    lines = [f'{k / 1000},{k % 10},{k % 10}e-6,{cell}' for k, cell in enumerate(cells)]
    path.write_text('\n'.join(['t,v,y,note', *lines]))
    (piece,) = pi.read(path).pieces
    assert piece.n == 70000


def save(path: Path, arrays: dict) -> None:
    if path.suffix == '.npz':
        np.savez(path, **arrays)
    else:
        scipy.io.savemat(path, arrays)


@pytest.mark.parametrize('name', ['r.npz', 'r.mat'])
@pytest.mark.parametrize('shape', [(-1,), (-1, 1), (1, -1)])
def test_columns_of_any_orientation(tmp_path, name, shape):
    save(tmp_path / name, {k: x.reshape(shape) for k, x in table().items()})
    c = table()
    assert_equal(pi.read(tmp_path / name), Record((Piece(c['v'], c['y'], 1000.0),)))


@pytest.mark.parametrize('name', ['r.npz', 'r.mat'])
def test_segments_by_start(tmp_path, name):
    names = np.array(['noise', 'sine:50Hz'])
    save(tmp_path / name, {**table(), 'segment_name': names, 'segment_start': [10, 200]})
    want = (Segment('noise', 10, 200), Segment('sine:50Hz', 200, 300))
    assert pi.read(tmp_path / name).pieces[0].segments == want


@pytest.mark.parametrize('name', ['r.npz', 'r.mat'])
@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'v': None}, ['v missing']),
        ({'v': np.ones((150, 2))}, ['v is 150 x 2', 'one column']),
        ({'v': np.ones(299)}, ['differ in length', 'v 299']),
        ({'v': np.array(['a'] * 300)}, ['v holds']),
        ({'v': np.ones(300) * 1j}, ['v holds complex128']),
        ({'segment_name': np.array(['a'])}, ['need each other']),
        ({'segment_name': np.array([1.0]), 'segment_start': [0]}, ['segment_name holds no text']),
        ({'segment_name': np.array(['a']), 'segment_start': [-1]}, ['segments need']),
    ],
)
def test_bad_arrays(tmp_path, name, change, words):
    arrays = {k: x for k, x in {**table(), **change}.items() if x is not None}
    save(tmp_path / name, arrays)
    refuse(tmp_path / name, *words)


def test_pickled_objects_are_refused(tmp_path):
    path = tmp_path / 'r.npz'
    np.savez(path, **{**table(), 'v': np.array([{}] * 300)})
    refuse(path, 'v is an array of Python objects', 'np.asarray(v, float)')
    labels = {'segment_name': np.array(['sine'], object), 'segment_start': [0]}
    np.savez(path, **table(), **labels)
    refuse(path, 'np.asarray(segment_name, str)')


@pytest.mark.parametrize(
    ('option', 'cure'),
    [('sample_rate', 'did you mean rate'), ('colums', 'did you mean columns'), ('x', 'give disp')],
)
def test_an_unknown_option_is_refused_with_the_one_that_was_meant(option, cure):
    with pytest.raises(DataError, match=f'read: no option {option}; {cure}'):
        pi.read('r.csv', **{option: 1000.0})


def test_a_model_is_no_record_to_write(tmp_path):
    model = pi.SimulatedStage.load('paper').model
    with pytest.raises(DataError, match=r'Record.* StageModel.* save'):
        pi.write(model, tmp_path / 'model.yaml')


def test_array_that_announces_too_much(tmp_path):
    path = tmp_path / 'r.npz'
    np.savez(path, **table())
    with zipfile.ZipFile(path) as archive:
        members = {n: archive.read(n) for n in archive.namelist()}
    members['v.npy'] = members['v.npy'].replace(b'(300,), }         ', b'(300000000000,), }', 1)
    assert b'300000000000' in members['v.npy']
    with zipfile.ZipFile(path, 'w') as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    refuse(path, 'damaged')


def test_what_is_not_there_unknown_or_of_matlab_73(tmp_path):
    refuse(tmp_path / 'r.csv', 'does not exist')
    refuse(tmp_path / 'r_bag', 'does not exist')
    refuse(tmp_path, 'metadata.yaml')
    (tmp_path / 'r.xls').touch()
    refuse(tmp_path / 'r.xls', 'unknown format .xls')
    path = tmp_path / 'r.mat'
    path.write_bytes(b'MATLAB 7.3 MAT-file'.ljust(512) + b'\x89HDF\r\n\x1a\n' + bytes(600))
    refuse(path, 'save -v7')


@pytest.mark.parametrize('name', ['r.csv', 'r.mcap', 'bag'])
def test_links_that_lead_nowhere(tmp_path, name):
    path = tmp_path / name
    path.symlink_to('gone')
    refuse(path, 'is a link to gone', 'mend')
    path.unlink()
    path.symlink_to(name)
    refuse(path, 'is a link', 'mend')
    (tmp_path / 'there.csv').write_text(csv_text())
    path = tmp_path / 'link.csv'
    path.symlink_to('there.csv')
    assert pi.read(path).n == 300


@pytest.mark.parametrize(
    ('name', 'rates', 'sizes'),
    [
        ('piezo_1hz.csv', [5000.0], [35000]),
        ('afm_hold.csv', [256.0, 2048.0, 256.0, 2048.0], [256, 2048, 7680, 1951]),
        ('afm_open_loop.csv', [2048.0], [8192]),
    ],
)
def test_measured_files(tmp_path, name, rates, sizes):
    measured = measured_record(name)
    assert [p.sample_rate for p in measured] == rates
    assert [p.n for p in measured] == sizes
    assert {f.name for f in measured.faults} <= {'rate_change'}
    for out in ('r.csv', 'r.mcap'):
        assert pi.write(measured, tmp_path / out, storage=storage(out)) == ()
        assert_equal(pi.read(tmp_path / out), measured)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Records of several axes: every format carries them, units hold for all, and one view of them."""

import h5py
import numpy as np
import piezo_ident as pi
from piezo_ident.common.errors import DataError
from piezo_ident.live.capture import Capture
from piezo_ident.record.bags.write import write_bag
from piezo_ident.record.blocks import cut_blocks, Samples
from piezo_ident.record.join import APPLIED
import pytest

N = 600
RATE = 5000.0
K = np.arange(N)
RNG = np.random.default_rng(18)
COLUMNS = {
    't': K / RATE,
    'v': RNG.uniform(0, 10, N),
    'y': RNG.normal(scale=1e-5, size=N),
    'v_b': RNG.uniform(0, 10, N),
    'y_b': RNG.normal(scale=1e-6, size=N),
    'v_c': RNG.uniform(0, 10, N),
}
NAMES = ('v', 'v_b', 'v_c'), ('y', 'y_b')


def write_csv(path, columns, **heads):
    head = ','.join(heads.get(name, name) for name in columns)
    rows = zip(*(map(repr, x.tolist()) for x in columns.values()), strict=True)
    path.write_text('\n'.join([head, *map(','.join, rows)]) + '\n')
    return path


def assert_same(record):
    axes = pi.Axes.of(record.pieces[0])
    assert (axes.input_names, axes.output_names) == NAMES
    for name, x in zip(
        (*axes.input_names, *axes.output_names), (*axes.inputs.T, *axes.outputs.T), strict=True
    ):
        np.testing.assert_allclose(x, COLUMNS[name], rtol=1e-12)


@pytest.fixture
def record():
    channels = {name: COLUMNS[name] for name in ('v_b', 'y_b', 'v_c')}
    return pi.Record.from_arrays(*(COLUMNS[k] for k in 'tvy'), channels=channels)


@pytest.mark.parametrize('kind', ['hdf5', 'parquet'])
def test_formats_that_are_read_only(tmp_path, kind):
    path = tmp_path / f'r.{kind}'
    if kind == 'hdf5':
        with h5py.File(path, 'w') as file:
            for name, x in COLUMNS.items():
                file.create_dataset(name, data=x)
    else:
        arrow = pytest.importorskip('pyarrow')
        parquet = pytest.importorskip('pyarrow.parquet')
        parquet.write_table(arrow.table(COLUMNS), path)
    assert_same(pi.read(path))


def test_a_unit_holds_for_the_other_axes(tmp_path):
    big = {k: x * {'v': 1e3, 'y': 1e6}.get(k[0], 1.0) for k, x in COLUMNS.items()}
    path = write_csv(tmp_path / 'plain.csv', big)
    assert_same(pi.read(path, voltage_unit='mV', displacement_unit='um'))
    write_csv(path, big, v='v [mV]', y='y [um]', y_b='y_b [um]')
    assert_same(pi.read(path))
    # an axis with a unit of its own
    write_csv(path, {**big, 'y_b': 1e3 * big['y_b']}, v='v [mV]', y='y [um]', y_b='y_b [nm]')
    assert_same(pi.read(path))
    groups = write_csv(
        tmp_path / 'named.csv', COLUMNS, v='drive', v_b='other', y='position', y_b='tilt'
    )
    assert_same(pi.read(groups, columns='v_b=other,y_b=tilt,v=drive'))


def test_the_limits_hold_for_every_voltage(tmp_path):
    path = write_csv(tmp_path / 'r.csv', {**COLUMNS, 'v_b': 2 * COLUMNS['v_b']})
    with pytest.raises(DataError, match='unit of v_b'):
        pi.read(path, voltage_limits=(0, 10))


@pytest.mark.parametrize(
    ('extra', 'reason'),
    [
        ({'x_v_b': K}, 'v_b stands there twice|x_v_b stands there twice'),
        ({'x_v': K}, 'r.csv: .* v;'),
    ],
)
def test_two_columns_of_one_name_are_refused(tmp_path, extra, reason):
    path = write_csv(tmp_path / 'r.csv', COLUMNS | extra)
    with pytest.raises(DataError, match=reason):
        pi.read(path)


def test_a_unit_is_no_axis(record, tmp_path):
    path = write_csv(tmp_path / 'r.csv', COLUMNS | {'y_um': 1e6 * COLUMNS['y']})
    assert [f.where for f in pi.read(path).faults] == ["'y_um'"]
    with pytest.raises(DataError, match=r'r\.csv: --columns y_mm: mm'):
        pi.read(path, columns={'y_mm': 'y_b'})


def test_a_live_capture_is_the_record_of_a_bag_and_each_axis_has_its_guard(record, tmp_path):
    write_bag(record, tmp_path / 'bag')
    (piece,) = record
    columns = {
        'voltage': piece.v,
        'displacement': piece.y,
        'voltage_b': piece.channels['v_b'],
        'displacement_b': piece.channels['y_b'],
        'voltage_c': piece.channels['v_c'],
    }
    guarded = piece.channels['v_b'].copy()
    guarded[320:330] -= 1.0
    plain, other = Capture(), Capture()
    for start, stop, label in cut_blocks(piece.n, ()):
        t = piece.time(start, stop)
        for key, x in columns.items():
            plain.add(key, Samples(t, x[start:stop], label, key), start)
            other.add(key, Samples(t, x[start:stop], label, key), start)
        applied = Samples(t, guarded[start:stop], label, 'voltage_b')
        other.add(f'{APPLIED}_b', applied, start)
    assert_same(plain.record())
    assert_same(pi.read(tmp_path / 'bag'))
    assert [p.n for p in other.record()] == [320, 270]


def test_a_piece_of_one_axis_has_one_input_and_one_output():
    axes = pi.Axes.of(pi.Record.from_arrays(*(COLUMNS[k] for k in 'tvy')).pieces[0])
    assert axes.inputs.shape == axes.outputs.shape == (N, 1)
    assert not axes.inputs.flags.writeable

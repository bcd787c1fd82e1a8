# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Read and write records; the suffix of a file names its format."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
import re
from typing import Any, BinaryIO

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import DataError, did_you_mean, expect
from piezo_ident.common.files import broken_link, check_regular, temporary_output
from piezo_ident.record.assemble import assemble
from piezo_ident.record.bags.read import read_bag
from piezo_ident.record.bags.recover import storage_of
from piezo_ident.record.bags.write import write_bag
from piezo_ident.record.channels import channel_of_column, column_of, role_of
from piezo_ident.record.options import ReadOptions, unit_factor
from piezo_ident.record.record import Fault, Record
from piezo_ident.record.tables.arrays import read_hdf5, read_mat, read_npz, read_parquet, read_tdms
from piezo_ident.record.tables.columns import RecordTable
from piezo_ident.record.tables.text_table import read_text, write_csv
from piezo_ident.record.tables.write import Blocks, blocks_of, labels_of, write_mat, write_npz

READERS: Mapping[str, Callable[[Path, ReadOptions], RecordTable]] = {
    **dict.fromkeys(('.csv', '.txt', '.tsv', '.dat', '.lvm', '.asc'), read_text),
    '.npz': read_npz,
    '.mat': read_mat,
    **dict.fromkeys(('.h5', '.hdf5', '.hdf'), read_hdf5),
    '.tdms': read_tdms,
    **dict.fromkeys(('.parquet', '.pq'), read_parquet),
}
WRITERS: Mapping[str, Callable[[BinaryIO, Blocks, Sequence[str], Sequence[int]], None]] = {
    '.csv': write_csv,
    '.npz': write_npz,
    '.mat': write_mat,
}

SHEETS = ('.xlsx', '.xls', '.ods')
_WRITTEN = 'a bag folder, .mcap, .db3, .csv, .npz or .mat'
_READ = f'a bag folder, .mcap, .db3, {", ".join(READERS)}'
#: another unit than seconds is likelier at lower or higher sampling rates [Hz] (taste)
SLOW, FAST = 50.0, 1e6
#: another unit is likelier at larger strokes [m] or spans of a voltage [V] (taste)
LARGE_STROKE, HIGH_VOLTAGE = 1e-3, 2e3
#: a named unit is doubtful at larger gains [m/V] (taste)
LARGE_GAIN = 5e-4


def read(path: str | Path, options: ReadOptions | None = None, **choices: Any) -> Record:
    """
    Read a record of any format.

    Parameters
    ----------
    path : path
        A bag folder, .mcap, .db3, or a table: .csv and other text, .lvm, .npz, .mat, .h5, .tdms,
        .parquet.
    options : ReadOptions, optional
    **choices
        Fields of `ReadOptions` that replace those of `options`.  For tables
        ``columns={'t': 'time_s', 'v': 'voltage', 'y': 'position_um'}``, by default guessed by the
        header; ``rate=20e3`` for a table without time; ``time_unit='ms'``, ``voltage_unit``,
        ``displacement_unit='um'``; ``voltage_limits=(0, 10)``; ``voltage_alone=True`` for a table
        without displacement, which is then NaN, ``displacement_alone=True`` for a table without
        voltage.  For bags ``namespace``, ``voltage_topic``, ``displacement_topic``, and
        ``recover=True`` for an unfinished bag.

    Returns
    -------
    Record
        In SI units; its `faults` name every fault of the data, and its treatment.

    Raises
    ------
    DataError
        If the file cannot be used; the message names the file, the place and the cure.

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> v = np.sin(0.01 * np.arange(2000))
    >>> pi.write(pi.Record.from_arrays(v, 7.5e-6 * v, sample_rate=1000.0), 'record.csv')
    ()
    >>> record = pi.read('record.csv', displacement_unit='m', voltage_limits=(-1.0, 1.0))
    >>> record.n, round(1e6 * record.stroke)
    (2000, 15)
    """
    known = [field.name for field in fields(ReadOptions)]
    for name in choices.keys() - known:
        # other functions of the package say sample_rate
        guess = did_you_mean(name.removeprefix('sample_'), known)
        raise DataError(f'read: no option {name}; {guess or "give " + ", ".join(known)}')
    options = replace(options or ReadOptions(), **choices)
    path = Path(path)
    suffix = path.suffix.lower()
    if broken := broken_link(path):
        raise DataError(f'{path}: {broken}')
    if path.is_dir() or storage_of(path):
        return read_bag(path, options)
    if not path.exists():
        raise DataError(f'{path}: does not exist; check the name')
    check_regular(path)
    if suffix not in READERS:
        sheet = 'save its sheet as CSV, or ' if suffix in SHEETS else ''
        raise DataError(f'{path}: unknown format {suffix or "(no suffix)"}; {sheet}give {_READ}')
    try:
        table = READERS[suffix](path, options)
    except OSError as error:
        reason = error.strerror or str(error)
        raise DataError(f'{path}: cannot be read ({reason}); check the file') from None
    columns = dict(table.columns)
    factors = {k: unit_factor(role_of(k) or k, table.units.get(k, '')) for k in ('y', *columns)}
    for role in columns.keys() - {'y'}:
        # `assemble` scales all displacements by the unit of y
        factor = factors[role] / (factors['y'] if role_of(role) == 'y' else 1.0)
        if factor != 1.0:
            columns[role] = columns[role] / factor
    v, y = (columns.pop(role, None) for role in 'vy')
    n = next(x.size for x in (v, y) if x is not None)
    t = columns.pop('t') if table.rate is None else np.arange(n) / table.rate
    record = assemble(
        t,
        v,
        y,
        (table.names, table.starts),
        {channel_of_column(name): x for name, x in columns.items()},
        name=str(path),
        options=replace(
            options, displacement_unit=table.units.get('y'), time_unit=table.units.get('t')
        ),
        faults=[
            *table.faults,
            *(Fault('ignored_column', repr(c), 1, 'not read') for c in table.ignored),
        ],
    ).renamed(path.name)
    return replace(record, faults=(*record.faults, *_doubts(record, table, options)))


def _doubts(record: Record, table: RecordTable, options: ReadOptions) -> Iterator[Fault]:
    """Yield a fault for each quantity that likely has another unit than the header says."""
    rates = [piece.sample_rate for piece in record]
    slow, fast = ('slow', min(rates)), ('fast', max(rates))
    for kind, rate in [slow] * (slow[1] <= SLOW) + [fast] * (fast[1] > FAST):
        where = f'sampled at {rate:.6g} Hz'
        if table.rate is not None:
            # the file may count its rate in another unit
            other = f'{rate * (1e3 if kind == "slow" else 1e-3):.9g}'
            way = f'--rate {other if options.rate is None else "20e3"}'
            cure = f'is it in Hz? else give it as in {way}'
        elif options.time_unit is None:
            unit = table.units.get('t', 's')
            finer = {'ms': 'us', 'us': 'ns'}.get(unit, 'ms')
            other = finer if kind == 'slow' else 's' * (unit != 's')
            # a unit with a number overrides the header; a plain unit must agree with it
            other = f'1{other}' if other and 't' in table.units else other
            where += f' with t in {unit}'
            cure = 'is the time unit right?' + (other and f' else add --time-unit {other}')
        else:
            continue
        yield Fault(f'{kind}_sampling', f'{where}, unusual for a stage', 1, cure)
    low, high = record.voltage_range
    stroke = record.stroke if 'y' in table.columns else 0.0
    if 'y' not in table.units and stroke > LARGE_STROKE:
        where = f'a stroke of {1e3 * stroke:.3g} mm with y in metres'
        cure = 'if y counts micrometres, add --displacement-unit um'
        yield Fault('large_stroke', where, 1, cure)
    if stroke > LARGE_GAIN * (high - low) > 0.0:
        where = f'a stroke of {1e6 * stroke:.3g} um from {low:.4g} to {high:.4g} V'
        cure = 'are the units right? --voltage-unit and --displacement-unit name others'
        yield Fault('large_gain', where, 1, cure)
    if high - low > HIGH_VOLTAGE and 'v' not in table.units:
        where = f'a voltage from {low:.4g} to {high:.4g} V'
        cure = 'if v counts millivolts, add --voltage-unit mV'
        yield Fault('high_voltage', where, 1, cure)


def write(
    record: Record,
    path: str | Path,
    *,
    overwrite: bool = False,
    storage: str | None = None,
    custom_data: Mapping[str, str] | None = None,
) -> tuple[str, ...]:
    """
    Write a record; the suffix names the format, no suffix a bag folder.

    Parameters
    ----------
    record : Record
        No file keeps its faults.
    path : path
        Nothing is left there if writing fails.
    overwrite : bool
        Replace an older file.
    storage : {'mcap', 'sqlite3'}, optional
        Storage of a bag folder.
    custom_data : mapping of str to str, optional
        For a bag's metadata: seed, program.

    Returns
    -------
    tuple of str
        A line for each loss: a difference between the record and the file read again.

    Raises
    ------
    DataError
        If the record does not fit into a file, or the file cannot be written.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> stage = pi.SimulatedStage.load('paper')
    >>> record = stage.play(pi.Program.load('minor_loops'))
    >>> pi.write(record, 'minor_loops.npz')
    ()
    >>> pi.read('minor_loops.npz').n == record.n
    True
    """
    expect(record, Record, 'write, first argument', 'a model has the method save')
    path = Path(path)
    suffix = path.suffix.lower()
    _check_labels(record, path)
    is_bag = suffix in ('', '.mcap', '.db3') or (path / 'metadata.yaml').is_file()
    if not is_bag and suffix not in WRITERS:
        raise DataError(f'{path}: unknown format {suffix}; give {_WRITTEN}')
    if not is_bag and storage is not None:
        raise DataError(f'{path}: a storage is for bags only; leave it out')
    # NaN displacements keep the voltage between two pieces
    every = (part for piece in record for part in (piece.before, piece) if part)
    rows = replace(record, pieces=tuple(every))
    if is_bag:
        write_bag(rows, path, storage=storage, overwrite=overwrite, custom_data=custom_data)
    else:
        write_columns(path, blocks_of(rows), *labels_of(rows), overwrite=overwrite)
    notes = ('custom data are kept by bags only',) if custom_data and not is_bag else ()
    return notes + _losses(record, rows)


def write_columns(
    path: Path,
    blocks: Blocks,
    labels: Sequence[str] = (),
    starts: Sequence[int] = (),
    *,
    overwrite: bool = True,
) -> None:
    """Write blocks of columns, with the labels of their segments, to a file of `WRITERS`."""
    with temporary_output(path, overwrite=overwrite) as target, target.open('xb') as file:
        WRITERS[path.suffix.lower()](file, blocks, labels, starts)


def _check_labels(record: Record, path: Path) -> None:
    for label in record.labels:
        if label != label.strip() or not label.isprintable():
            raise DataError(
                f'{path}: segment label {label!r} cannot be written; use printable text without '
                'blanks around it'
            )
    if len({frozenset(p.channels) for p in record}) > 1:
        raise DataError(f'{path}: pieces carry different channels; write them one by one')
    for name in record.pieces[0].channels:
        # the names that ROS topics and MATLAB variables can have
        is_plain = re.fullmatch(r'[A-Za-z0-9_]{1,60}', name)
        if not is_plain or channel_of_column(column_of(name)) != name:
            raise DataError(
                f'{path}: channel name {name!r} cannot be written and read; use letters, digits '
                'and _, and no unit'
            )


def _losses(record: Record, rows: Record) -> tuple[str, ...]:
    """Read the rows as a reader of the file does; return their differences from the record."""

    def whole(parts: list[Array]) -> Array:
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    t, v, y = (whole([getattr(p, name) for p in rows]) for name in 'tvy')
    channels = {k: whole([p.channels[k] for p in rows]) for k in rows.pieces[0].channels}
    try:
        back = assemble(t, v, y, labels_of(rows), channels, name='the file')
    except DataError as error:
        return (f'reading refuses it: {error}',)
    if len(back.pieces) != len(record.pieces) or back.n != record.n:
        before = f'{len(record.pieces)} pieces with {record.n} samples'
        return (f'{before} read back as {len(back.pieces)} with {back.n}',)
    rates = [(a.sample_rate, b.sample_rate) for a, b in zip(record, back, strict=True)]
    if any(abs(a / b - 1.0) > 1e-9 for a, b in rates):
        text = ', '.join(f'{rate:.12g}' for rate in dict.fromkeys(b for _, b in rates))
        return (f'sampling rates read back as {text} Hz',)
    segments = [[s for p in one for s in p.segments] for one in (record, back)]
    if segments[0] != segments[1]:
        return (f'{len(segments[0])} segments read back as {len(segments[1])}',)
    return ()

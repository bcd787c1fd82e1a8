# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Records on disk: the suffix names the format, and every format carries the same."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import re
from typing import Any

import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.common.files import temporary_output
from piezo_ident.common.limits import regular_file
from piezo_ident.common.yaml_io import broken_link
from piezo_ident.record.assemble import assemble
from piezo_ident.record.bags.read import read_bag, write_bag
from piezo_ident.record.long_bag import read_long_bag
from piezo_ident.record.long_record import LongRecord, NeedsWhole, Progress
from piezo_ident.record.overall import Overall
from piezo_ident.record.record import Fault, Record
from piezo_ident.record.table_parts import PART_WRITERS
from piezo_ident.record.tables import READERS, Table, WRITERS

__all__ = ['read_long', 'read_record', 'write_record']

_FORMATS = 'a bag folder, .mcap, .db3, .csv, .npz or .mat'


def read_record(
    path: str | Path,
    *,
    displacement_unit: str = 'm',
    voltage_limits: tuple[float, float] | None = None,
    namespace: str | None = None,
    voltage_topic: str | None = None,
    displacement_topic: str | None = None,
    recover: bool = False,
) -> Record:
    """
    Read a record of any format.

    Parameters
    ----------
    path : path
        A bag folder, .mcap, .db3, .csv, .npz or .mat.
    displacement_unit : {'m', 'mm', 'um', 'nm'}
        Unit of the displacement in the file.
    voltage_limits : tuple of float, optional
        Smallest and largest voltage [V] that may occur.
    namespace, voltage_topic, displacement_topic : str, optional
        Which topics of a bag to take, when it holds several stages.
    recover : bool, optional
        Read an unfinished bag as far as it goes instead of refusing it.

    Returns
    -------
    Record
        In SI units; its `faults` say what was wrong with the data and what was done about it.

    Raises
    ------
    DataError
        When the file cannot be used; the message names the file, the place and the cure.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    broken = broken_link(path)
    if broken:
        raise DataError(f'{path}: {broken}')
    if path.is_dir() or suffix in ('.mcap', '.db3'):
        return read_bag(
            path,
            namespace=namespace,
            voltage_topic=voltage_topic,
            displacement_topic=displacement_topic,
            displacement_unit=displacement_unit,
            voltage_limits=voltage_limits,
            recover=recover,
        )
    if not path.exists():
        raise DataError(f'{path}: does not exist; check the name')
    regular_file(path)
    if suffix not in READERS:
        raise DataError(f'{path}: unknown format {suffix or "(no suffix)"}; give {_FORMATS}')
    try:
        table = READERS[suffix](path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise DataError(f'{path}: cannot be read ({reason}); check the file') from None
    columns = dict(table.columns)
    return assemble(
        columns.pop('t'),
        columns.pop('v'),
        columns.pop('y'),
        (table.names, table.starts),
        {name[2:]: x for name, x in columns.items()},
        name=str(path),
        displacement_unit=displacement_unit,
        voltage_limits=voltage_limits,
        faults=[Fault('ignored_column', repr(c), 1, 'not read') for c in table.ignored],
    ).renamed(path.name)


def read_long(
    path: str | Path,
    *,
    progress: Progress = lambda step, share: None,
    to_write: bool = False,
    **options: Any,
) -> Record | LongRecord:
    """
    Read a record as `read_record` does, but leave the samples of a long bag in it.

    Parameters
    ----------
    path : path
    progress : callable, optional
        Called as ``progress(step, share)`` while a long bag is looked through.
    to_write : bool, optional
        Whether it is for `write_record`, which says what a file will not give back: the whole
        record is then read where there is something to say.
    **options
        Of `read_record`.

    Raises
    ------
    DataError
        As `read_record` does.
    """
    path = Path(path)
    is_bag = path.is_dir() or path.suffix.lower() in ('.mcap', '.db3')
    if not is_bag or broken_link(path):
        return read_record(path, **options)
    inspect = _refuse_losses if to_write else None
    return read_long_bag(path, progress=progress, inspect=inspect, **options)


def _refuse_losses(record: Record) -> None:
    _check_labels(record, Path(record.name))
    losses = _losses(record, _flatten(record), Overall())
    if losses:
        raise NeedsWhole(losses[0])


def write_record(
    record: Record | LongRecord,
    path: str | Path,
    *,
    overwrite: bool = False,
    storage: str | None = None,
    custom_data: Mapping[str, str] | None = None,
    progress: Progress = lambda step, share: None,
) -> tuple[str, ...]:
    """
    Write a record; the suffix names the format, no suffix a bag folder.

    Parameters
    ----------
    record : Record or LongRecord
        What to write; its faults are no part of any file.  A long one must have been read for
        this, and is not written as .mat.
    path : path
        Where to; nothing is left there when writing fails.
    overwrite : bool
        Replace what stands there.
    storage : {'mcap', 'sqlite3'}, optional
        Storage of a bag folder.
    custom_data : mapping of str to str, optional
        For a bag's metadata: seed, programme.
    progress : callable, optional
        Called as ``progress(step, share)`` while a long record is read.

    Returns
    -------
    tuple of str
        What reading the file will not give back, a line each; empty when it gives back all.

    Raises
    ------
    DataError
        When the record does not fit into a file, or the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    _check_labels(record, path)
    is_bag = suffix in ('', '.mcap', '.db3') or (path / 'metadata.yaml').is_file()
    if not is_bag and suffix not in WRITERS:
        raise DataError(f'{path}: unknown format {suffix}; give {_FORMATS}')
    if not is_bag and storage is not None:
        raise DataError(f'{path}: a storage is for bags only; leave it out')
    if is_bag:
        write_bag(
            record,
            path,
            storage=storage,
            overwrite=overwrite,
            custom_data=custom_data,
            progress=progress,
        )
    elif isinstance(record, Record):
        with temporary_output(path, overwrite=overwrite) as target, target.open('xb') as file:
            WRITERS[suffix](file, _flatten(record))
    elif suffix in PART_WRITERS:
        _write_parts(record, path, overwrite, progress)
    else:
        raise DataError(f'{path}: a long bag is not written as {suffix}; choose .csv or .npz')
    notes = ('custom data are kept by bags only',) if custom_data and not is_bag else ()
    return notes + (_losses(record, _flatten(record)) if isinstance(record, Record) else ())


def _write_parts(record: LongRecord, path: Path, overwrite: bool, progress: Progress) -> None:
    columns = ['t', 'v', 'y', *(f'x_{name}' for name in record.pieces[0].channels)]
    names, starts = _labels(record)
    with (
        temporary_output(path, overwrite=overwrite) as target,
        target.open('xb') as file,
        PART_WRITERS[path.suffix.lower()](file, columns, names, starts) as add,
    ):
        for _, parts in record.parts(progress):
            for part in parts:
                channels = {f'x_{name}': x for name, x in part.channels.items()}
                add({'t': part.t, 'v': part.v, 'y': part.y, **channels})


def _check_labels(record: Record | LongRecord, path: Path) -> None:
    for label in record.labels:
        if label != label.strip() or not label.isprintable():
            raise DataError(
                f'{path}: segment label {label!r} cannot be written; use printable text without '
                'blanks around it'
            )
    channels = {tuple(p.channels) for p in record}
    if len({frozenset(c) for c in channels}) > 1:
        raise DataError(f'{path}: pieces carry different channels; write them one by one')
    for name in record.pieces[0].channels:
        # the names that ROS topics and MATLAB variables can have
        if not re.fullmatch(r'[A-Za-z0-9_]{1,60}', name):
            raise DataError(
                f'{path}: channel name {name!r} cannot be written; use letters, digits and _'
            )


def _flatten(record: Record) -> Table:
    """Return all pieces below each other; time alone tells them apart."""
    columns = {
        't': np.concatenate([p.t for p in record]),
        'v': np.concatenate([p.v for p in record]),
        'y': np.concatenate([p.y for p in record]),
    }
    for name in record.pieces[0].channels:
        columns[f'x_{name}'] = np.concatenate([p.channels[name] for p in record])
    return Table(columns, *_labels(record))


def _labels(record: Record | LongRecord) -> tuple[list[str], list[int]]:
    """Return the label of each stretch and its first row, nothing for unlabelled records."""
    names: list[str] = []
    starts: list[int] = []
    offset = 0
    for piece in record:
        end = offset
        for s in piece.segments:
            if offset + s.start > end:
                names.append('')
                starts.append(end)
            names.append(s.label)
            starts.append(offset + s.start)
            end = offset + s.stop
        offset += piece.n
        if end < offset:
            names.append('')
            starts.append(end)
    return (names, starts) if any(names) else ([], [])


def _losses(record: Record, table: Table, overall: Overall | None = None) -> tuple[str, ...]:
    """Read the columns as a reader would, and say what differs."""
    columns = dict(table.columns)
    try:
        back = assemble(
            columns.pop('t'),
            columns.pop('v'),
            columns.pop('y'),
            (table.names, table.starts),
            columns,
            name='the file',
            overall=overall,
        )
    except DataError as error:
        return (f'reading refuses it: {error}',)
    losses = []
    if len(back.pieces) != len(record.pieces) or back.n != record.n:
        losses.append(
            f'{len(record.pieces)} pieces with {record.n} samples read back as '
            f'{len(back.pieces)} with {back.n}'
        )
    elif any(
        abs(a.sample_rate / b.sample_rate - 1.0) > 1e-9 for a, b in zip(record, back, strict=True)
    ):
        rates = ', '.join(f'{r:.12g}' for r in dict.fromkeys(p.sample_rate for p in back))
        losses.append(f'sampling rates read back as {rates} Hz')
    before = [s for p in record for s in p.segments]
    after = [s for p in back for s in p.segments]
    if not losses and before != after:
        losses.append(f'{len(before)} segments read back as {len(after)}')
    return tuple(losses)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Records on disk: the suffix names the format, and every format carries the same."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
import re

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import DataError
from piezo_ident.common.files import broken_link, check_regular, temporary_output
from piezo_ident.record.assemble import assemble
from piezo_ident.record.bags.read import read_bag
from piezo_ident.record.bags.write import write_bag
from piezo_ident.record.record import Fault, Record
from piezo_ident.record.tables import blocks_of, labels_of, READERS, WRITERS

__all__ = ['read_record', 'write_record']

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
    check_regular(path)
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


def write_record(
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
        What to write; its faults are no part of any file.
    path : path
        Where to; nothing is left there when writing fails.
    overwrite : bool
        Replace what stands there.
    storage : {'mcap', 'sqlite3'}, optional
        Storage of a bag folder.
    custom_data : mapping of str to str, optional
        For a bag's metadata: seed, programme.

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
        )
    else:
        with temporary_output(path, overwrite=overwrite) as target, target.open('xb') as file:
            WRITERS[suffix](file, blocks_of(record), *labels_of(record))
    notes = ('custom data are kept by bags only',) if custom_data and not is_bag else ()
    return notes + _losses(record)


def _check_labels(record: Record, path: Path) -> None:
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


def _losses(record: Record) -> tuple[str, ...]:
    """Read the columns as a reader would, and say what differs."""

    def whole(parts: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    t, v, y = (
        whole([p.t for p in record]),
        whole([p.v for p in record]),
        whole([p.y for p in record]),
    )
    channels = {k: whole([p.channels[k] for p in record]) for k in record.pieces[0].channels}
    try:
        back = assemble(t, v, y, labels_of(record), channels, name='the file')
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

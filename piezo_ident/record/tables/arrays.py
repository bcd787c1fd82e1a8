# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Read files of named arrays: npz, MATLAB, HDF5, TDMS and Parquet, each by its library.

A file whose arrays are called ``t``, ``v`` and ``y`` is read as it is.  In any other file,
`piezo_ident.record.tables.columns` chooses among all columns of numbers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
import importlib
from pathlib import Path
import re
from types import MappingProxyType
from typing import Any
import zipfile

import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.common.files import UNPACKED_SIZE
from piezo_ident.record.assemble import label_runs
from piezo_ident.record.options import ReadOptions
from piezo_ident.record.tables.columns import choose, RecordTable, words_of
from piezo_ident.record.tables.mat_read import flat, read_variables

_LABELS = ('segment_name', 'segment_start')
_USED = '[tvy]|[vyx]_.+|segment_name|segment_start'
_SLOWER = 'give one value a sample: of a slower sensor, the voltage at its times'
_HDF5 = b'\x89HDF\r\n\x1a\n'


def read_npz(path: Path, options: ReadOptions) -> RecordTable:
    """Read a NumPy archive; pickled objects are refused in the record, and ignored beside it."""
    with damage_as_data_error(path, 'no npz archive', 'save it again with numpy.savez'):
        with zipfile.ZipFile(path) as archive:
            _check_size(sum(info.file_size for info in archive.infolist()))
        with np.load(path, allow_pickle=False) as archive:
            names = archive.files
            if {*names}.issuperset(options.needed) and not options.columns:
                used = {k: _unpickled(archive, k, path) for k in names if re.fullmatch(_USED, k)}
                return _table(used, names, path, options)
            arrays: dict[str, Any] = {}
            for name in names:
                try:
                    arrays |= flat(name, archive[name]) if name not in _LABELS else {}
                except ValueError as error:
                    if 'allow_pickle' not in str(error):
                        raise
            arrays |= {k: _unpickled(archive, k, path) for k in _LABELS if k in names}
    return _table(arrays, arrays, path, options)


def _unpickled(archive: Any, name: str, path: Path) -> Any:
    try:
        return archive[name]
    except ValueError as error:
        if 'allow_pickle' not in str(error):
            raise
        kind = 'str' if name == 'segment_name' else 'float'
        cure = f'save it as np.asarray({name}, {kind})'
        raise DataError(f'{path}: {name} is an array of Python objects; {cure}') from None


def read_mat(path: Path, options: ReadOptions) -> RecordTable:
    """Read a MATLAB file of any version."""
    with path.open('rb') as file:
        head = file.read(1024)
    if _HDF5 in (head[:8], head[512:520]) or head.startswith(b'MATLAB 7.3'):
        return read_hdf5(path, options)
    with damage_as_data_error(path, 'no MATLAB file', 'save it again with save -v7'):
        needed = None if options.columns else options.needed
        names, arrays, paths = read_variables(path, _USED, needed)
    return _table(arrays, names, path, _renamed(options, paths.items(), arrays))


def read_hdf5(path: Path, options: ReadOptions) -> RecordTable:
    """Read an HDF5 file, such as MATLAB's version 7.3."""
    h5py = library('h5py', path)
    arrays: dict[str, Any] = {}
    size = 0

    def visit(name: str, node: Any) -> None:
        nonlocal size
        for key, value in node.attrs.items():
            if np.ndim(value) == 0 and isinstance(value, (int, float, np.number)):
                arrays[f'{name}.{key}'] = np.array([value])  # a sampling rate, perhaps
        # MATLAB's cells refer to groups whose names begin with #
        if not isinstance(node, h5py.Dataset) or name.startswith('#'):
            return
        key, kind = name.replace('/', '.'), node.attrs.get('MATLAB_class', b'')
        units = [np.ravel(x) for k, x in node.attrs.items() if k.lower() in ('unit', 'units')]
        unit = units[0][0] if units and units[0].size else ''
        text = unit.decode(errors='replace') if isinstance(unit, bytes) else unit
        if key == 'segment_name' and kind == b'cell':
            cells = (node.file[r][()].ravel() for r in node[()].ravel())
            arrays[key] = np.array([''.join(map(chr, cell)) for cell in cells])
        elif key == 'segment_name':
            texts = np.ravel(node[()])
            arrays[key] = np.array([x.decode() if isinstance(x, bytes) else str(x) for x in texts])
        elif kind != b'char' and (node.dtype.kind in 'biuf' or node.dtype.names):
            size += node.nbytes
            _check_size(size)
            end = f' [{text}]' if isinstance(text, str) and text else ''
            parts = {key: node[()]} if key in _LABELS else dict(flat(key, node[()]))
            arrays.update({name + end: x for name, x in parts.items()})

    cure = 'save it again; MATLAB: save -v7'
    with damage_as_data_error(path, 'no HDF5 file', cure), h5py.File(path, 'r') as file:
        visit('', file)
        file.visititems(visit)
    return _table(arrays, arrays, path, options)


def read_tdms(path: Path, options: ReadOptions) -> RecordTable:
    """Read a file of LabVIEW's TDMS."""
    tdms = library('nptdms', path, 'npTDMS')
    arrays: dict[str, Any] = {}
    periods: dict[str, float] = {}
    paths: list[tuple[str, str]] = []
    with (
        damage_as_data_error(path, 'no TDMS file', 'write it again'),
        tdms.TdmsFile.open(path) as file,
    ):
        channels = [channel for group in file.groups() for channel in group.channels()]
        counts = Counter(channel.name for channel in channels)
        _check_size(8 * sum(map(len, channels)))
        for channel in channels:
            name = channel.name
            name = f'{channel.group_name}.{name}' if counts[name] > 1 else name
            unit = str(channel.properties.get('unit_string', ''))
            name = f'{name} [{unit}]' if unit else name
            paths.append((f'{channel.group_name}/{channel.name}', name))
            arrays[name] = channel[:]
            if 'wf_increment' in channel.properties:
                periods[name] = float(channel.properties['wf_increment'])
        cut = getattr(file.file_status, 'channel_statuses', None) or {}
    # channels that end at one sample lack the end of the record alone
    uneven = len({len(channel) for channel in channels}) > 1
    for name, part in cut.items():
        if uneven and part.read_length < part.expected_length:
            raise DataError(
                f'{path}: ends early, {name} has {part.read_length} of {part.expected_length} '
                'samples in its last segment; copy or record it again'
            )
    return _table(arrays, arrays, path, _renamed(options, paths, arrays), periods)


def read_parquet(path: Path, options: ReadOptions) -> RecordTable:
    """Read a file of Apache Parquet."""
    parquet = library('pyarrow.parquet', path, 'pyarrow')
    with (
        damage_as_data_error(path, 'no Parquet file', 'write it again'),
        parquet.ParquetFile(path) as file,
    ):
        _check_size(8 * file.metadata.num_rows * file.metadata.num_columns)
        table = file.read()
        columns = zip(table.column_names, table.columns, strict=True)
        arrays = {name: column.to_numpy() for name, column in columns}
    return _table(arrays, arrays, path, options)


def _renamed(
    options: ReadOptions, paths: Iterable[tuple[str, str]], names: Container[str]
) -> ReadOptions:
    """Return options whose columns have their names in place of their paths."""
    known: dict[tuple[str, ...], set[str]] = {}
    for place, name in paths:
        known.setdefault(words_of(place), set()).add(name)
    columns = {}
    for role, wanted in options.named.items():
        # two paths may have the same words
        fitting = [] if wanted in names else [*known.get(words_of(wanted), ())]
        columns[role] = fitting[0] if len(fitting) == 1 else wanted
    return replace(options, columns=columns)


def library(module: str, path: Path, package: str = '') -> Any:
    """Import the library of a kind of file; DataError with the command that installs it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = package or module
        raise DataError(
            f'{path}: {package} reads {path.suffix} files, and cannot be imported ({error}): '
            f'pip install {package}'
        ) from None


def _check_size(size: int) -> None:
    if size > UNPACKED_SIZE:
        raise ValueError(f'it unpacks to more than {UNPACKED_SIZE >> 30} GiB')


def _table(
    arrays: Mapping[str, Any],
    everything: Iterable[str],
    path: Path,
    options: ReadOptions,
    periods: Mapping[str, float] = MappingProxyType({}),
) -> RecordTable:
    """Choose and check the columns among some arrays; `periods` are sampling periods [s]."""
    numbers = {k: np.asarray(x) for k, x in arrays.items() if k not in _LABELS}
    own = numbers.keys() >= {*options.needed}
    candidates = [
        name
        for name, x in numbers.items()
        if own or (x.ndim == 1 and x.size > 1 and (x.dtype.kind in 'biufM' or name == 'segment'))
    ]
    scalars = {
        k: float(x.ravel()[0]) for k, x in numbers.items() if x.size == 1 and x.dtype.kind in 'iuf'
    }

    def chosen(period: Sequence[float]) -> tuple[dict[str, int], RecordTable]:
        known = {**scalars, **dict(zip(['wf_increment'], period, strict=False))}
        return choose(candidates, options, path, scalars=known)

    indices, table = chosen([*periods.values()])
    if periods and table.rate is not None and options.rate is None:
        # another channel may have been sampled at another rate
        named = [candidates[indices[role]] for role in 'vy' if role in indices]
        steps = sorted({periods[name] for name in named if name in periods})
        if len(steps) > 1:
            text = ' and '.join(f'{x:g} s' for x in steps)
            raise DataError(f'{path}: v and y are sampled every {text}; {_SLOWER}')
        indices, table = chosen(steps)
    places = {role: candidates[place] for role, place in indices.items()}
    columns = {r: _column(k, numbers[k], path) for r, k in places.items() if r != 'segment'}
    lengths = {places[role]: x.size for role, x in columns.items()}
    if len(set(lengths.values())) > 1:
        text = ', '.join(f'{k} {n}' for k, n in lengths.items())
        raise DataError(f'{path}: columns differ in length ({text}); {_SLOWER}')
    names: list[str] = []
    starts: Any = ()
    if 'segment' in places:
        names, starts = label_runs(str(x).strip() for x in numbers[places['segment']])
    elif any(k in arrays for k in _LABELS):
        names, starts = _segments(arrays, path)
    used = {*places.values(), *_LABELS, *scalars}
    ignored = tuple(k for k in everything if k not in used)
    return replace(table, columns=columns, names=names, starts=starts, ignored=ignored)


def _column(name: str, x: Any, path: Path) -> Any:
    if x.dtype.kind == 'M':
        # dates: seconds from the first one
        return (x - x[0]) / np.timedelta64(1, 's')
    if x.dtype.kind not in 'fiu':
        raise DataError(f'{path}: {name} holds {x.dtype}, no real numbers; save plain numbers')
    if x.ndim != 1 and sum(s != 1 for s in x.shape) > 1:
        shape = ' x '.join(map(str, x.shape))
        raise DataError(f'{path}: {name} is {shape}; give one column of samples')
    return x.astype(np.float64).reshape(-1)


def _segments(arrays: Mapping[str, Any], path: Path) -> tuple[list[str], Any]:
    if not all(k in arrays for k in _LABELS):
        raise DataError(f'{path}: segment_name and segment_start need each other; save both')
    starts = np.asarray(arrays['segment_start'])
    if starts.dtype.kind not in 'fiu':
        raise DataError(f'{path}: segment_start holds no numbers; save sample indices from 0')
    names = np.ravel(arrays['segment_name'])
    if names.dtype.kind != 'U':
        raise DataError(f'{path}: segment_name holds no text; save it as text (MATLAB: a cellstr)')
    return [name.strip() for name in names.tolist()], starts.ravel()


@contextmanager
def damage_as_data_error(path: Path, kind: str, cure: str) -> Iterator[None]:
    """Turn any error of a reader into a DataError: the file is damaged or of another `kind`."""
    try:
        yield
    except DataError:
        raise
    # damage surfaces as anything from an assertion to an error of zlib or zstd
    except Exception as error:  # noqa: BLE001
        if isinstance(error, OSError) and error.errno is not None:
            reason = error.strerror or str(error)
            raise DataError(f'{path}: cannot be read ({reason}); check the file') from None
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise DataError(f'{path}: damaged or {kind} ({reason[:200]}); {cure}') from None

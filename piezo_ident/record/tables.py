# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Records in tables: columns by name, in NumPy's npz and MATLAB's mat.

``t``, ``v`` and ``y`` must be there; ``x_<name>`` are further channels.  npz and mat carry
``segment_name`` and ``segment_start``, the sample (counted from 0) at which each segment begins.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
import re
from typing import Any, BinaryIO
import zipfile

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.errors import DataError
from piezo_ident.common.files import UNPACKED_SIZE
from piezo_ident.record.mat_read import read_variables
from piezo_ident.record.record import Record

__all__ = [
    'ROWS',
    'Blocks',
    'RecordTable',
    'blocks_of',
    'check_names',
    'is_wanted',
    'labels_of',
    'read_mat',
    'read_npz',
    'write_mat',
    'write_npz',
]

Vector = NDArray[np.float64]
#: yields the columns block by block, each time it is called
Blocks = Callable[[], Iterator[Mapping[str, Vector]]]

#: rows that are read and written together
ROWS = 65536
#: names of columns, and what else npz and mat carry
_WANTED = 't|v|y|x_.+'
_USED = f'{_WANTED}|segment_name|segment_start'


@dataclass(frozen=True, eq=False)
class RecordTable:
    """Raw columns of a file, the segments' names and starts, and the names of unused columns."""

    columns: dict[str, NDArray[np.float64]]
    names: list[str] = field(default_factory=list)
    starts: ArrayLike = ()
    ignored: tuple[str, ...] = ()


def blocks_of(record: Record, **further: Sequence[Vector]) -> Blocks:
    """
    Return the columns of a record, its pieces below each other, as the writers take them.

    Further columns, one array a piece, stand in place of the channels.
    """

    def blocks() -> Iterator[Mapping[str, Vector]]:
        for i, piece in enumerate(record):
            columns = {'v': piece.v, 'y': piece.y}
            if further:
                columns |= {name: parts[i] for name, parts in further.items()}
            else:
                columns |= {f'x_{name}': x for name, x in piece.channels.items()}
            for a in range(0, piece.n, ROWS):
                cut = slice(a, min(a + ROWS, piece.n))
                yield {'t': piece.time(cut.start, cut.stop)} | {
                    name: x[cut] for name, x in columns.items()
                }

    return blocks


def labels_of(record: Record) -> tuple[list[str], list[int]]:
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


def is_wanted(name: str) -> bool:
    """Return whether a column of this name is read."""
    return re.fullmatch(_WANTED, name) is not None


def check_names(names: Iterable[str], path: Path) -> None:
    """Refuse a column that stands there twice, and a missing one."""
    # a mapping would be taken for counts
    counts = Counter(iter(names))
    twice = sorted(c for c, n in counts.items() if c and n > 1)
    if twice:
        raise DataError(
            f'{path}: column {", ".join(twice)[:200]} stands there twice; keep one of them'
        )
    # whoever needs a displacement misses it itself
    missing = [c for c in ('t', 'v') if c not in counts]
    if missing:
        raise DataError(
            f'{path}: {", ".join(missing)} missing (found: {", ".join(counts)[:200] or "nothing"})'
            '; name the columns t [s], v [V] and y'
        )


# --- npz ------------------------------------------------------------------------------------


def read_npz(path: Path) -> RecordTable:
    """Read a NumPy archive; pickled objects are refused."""
    with _damage(path, 'npz archive', 'save it again with numpy.savez'):
        with zipfile.ZipFile(path) as archive:
            if sum(info.file_size for info in archive.infolist()) > UNPACKED_SIZE:
                raise ValueError(f'it unpacks to more than {UNPACKED_SIZE >> 30} GiB')
        with np.load(path, allow_pickle=False) as archive:
            return _from_arrays({k: archive[k] for k in archive.files if _used(k)}, archive, path)


def _used(name: str) -> bool:
    return re.fullmatch(_USED, name) is not None


def _from_arrays(arrays: Mapping[str, Any], everything: Iterable[str], path: Path) -> RecordTable:
    check_names(everything, path)
    columns = {}
    for name in filter(is_wanted, arrays):
        x = np.asarray(arrays[name])
        if x.dtype.kind not in 'fiu':
            raise DataError(f'{path}: {name} holds {x.dtype}, no real numbers; save plain numbers')
        if x.ndim != 1 and sum(s != 1 for s in x.shape) > 1:
            shape = ' x '.join(map(str, x.shape))
            raise DataError(f'{path}: {name} is {shape}; give one column of samples')
        columns[name] = x.astype(np.float64).reshape(-1)
    lengths = {name: x.size for name, x in columns.items()}
    if len(set(lengths.values())) > 1:
        text = ', '.join(f'{k} {n}' for k, n in lengths.items())
        raise DataError(f'{path}: columns differ in length ({text}); give one value a sample')
    ignored = tuple(k for k in everything if not _used(k))
    if ('segment_name' in arrays) != ('segment_start' in arrays):
        raise DataError(f'{path}: segment_name and segment_start need each other; save both')
    if 'segment_name' not in arrays:
        return RecordTable(columns, ignored=ignored)
    starts = np.asarray(arrays['segment_start'])
    if starts.dtype.kind not in 'fiu':
        raise DataError(f'{path}: segment_start holds no numbers; save sample indices from 0')
    names = np.ravel(arrays['segment_name'])
    if names.dtype.kind != 'U':
        raise DataError(f'{path}: segment_name holds no text; save it as text (MATLAB: a cellstr)')
    return RecordTable(columns, [name.strip() for name in names.tolist()], starts.ravel(), ignored)


def write_npz(
    file: BinaryIO, blocks: Blocks, names: Sequence[str] = (), starts: Sequence[int] = ()
) -> None:
    """Write a NumPy archive, one column after the other."""
    size = sum(block['t'].size for block in blocks())
    head = {'descr': '<f8', 'fortran_order': False, 'shape': (size,)}
    with zipfile.ZipFile(file, 'w', allowZip64=True) as archive:
        for name in next(blocks()):
            with archive.open(f'{name}.npy', 'w', force_zip64=True) as member:
                to: Any = member  # the stubs know other files only
                np.lib.format.write_array_header_1_0(to, head)
                for block in blocks():
                    member.write(np.ascontiguousarray(block[name], dtype='<f8').data)
        labels = {'segment_name': np.array(names), 'segment_start': np.array(starts)}
        for name, x in labels.items() if names else ():
            with archive.open(f'{name}.npy', 'w', force_zip64=True) as member:
                to = member
                np.lib.format.write_array(to, x, allow_pickle=False)


# --- MATLAB ---------------------------------------------------------------------------------


def read_mat(path: Path) -> RecordTable:
    """Read a MATLAB file of version 4 to 7."""
    with _damage(path, 'MATLAB file', 'save it again with save -v7'):
        with path.open('rb') as file:
            head = file.read(1024)
        if b'\x89HDF\r\n\x1a\n' in (head[:8], head[512:520]) or head.startswith(b'MATLAB 7.3'):
            raise DataError(f'{path}: MATLAB 7.3 file (HDF5); save it with save -v7')
        names, arrays = read_variables(path, _USED)
        return _from_arrays(arrays, names, path)


def write_mat(
    file: BinaryIO, blocks: Blocks, names: Sequence[str] = (), starts: Sequence[int] = ()
) -> None:
    """Write a MATLAB 5 file of column vectors."""
    import scipy.io  # takes longer than a short command

    parts = list(blocks())
    arrays: dict[str, Any] = {k: np.concatenate([block[k] for block in parts]) for k in parts[0]}
    if names:
        cells = np.empty(len(names), dtype=object)
        cells[:] = names
        arrays |= {'segment_name': cells, 'segment_start': np.asarray(starts, dtype=np.float64)}
    to: Any = file  # the stubs know paths only
    scipy.io.savemat(to, arrays, oned_as='column', long_field_names=True)


@contextmanager
def _damage(path: Path, kind: str, cure: str) -> Iterator[None]:
    """Turn whatever a parser throws at damaged bytes into one line."""
    try:
        yield
    except DataError:
        raise
    # zip, zlib, struct, numpy and scipy each have errors of their own for the same damage
    except Exception as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise  # the disk's fault, not the file's
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise DataError(f'{path}: damaged or no {kind} ({reason[:200]}); {cure}') from None

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Records in tables: CSV, NumPy's npz and MATLAB's mat, columns by name.

``t``, ``v`` and ``y`` must be there; ``x_<name>`` are further channels.  In CSV the column
``segment`` labels each row, and comments, lines with ``#``, may stand above the header; npz and
mat carry ``segment_name`` and ``segment_start``, the sample (counted from 0) at which each segment
begins.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import csv
from dataclasses import dataclass, field
import io
import itertools
from pathlib import Path
import re
from typing import Any, BinaryIO
import zipfile

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.errors import DataError
from piezo_ident.common.files import UNPACKED_SIZE
from piezo_ident.record.assemble import label_runs
from piezo_ident.record.mat_read import read_variables
from piezo_ident.record.record import Record

__all__ = ['READERS', 'WRITERS', 'Blocks', 'RecordTable', 'blocks_of', 'labels_of']

Vector = NDArray[np.float64]
#: yields the columns block by block, each time it is called
Blocks = Callable[[], Iterator[Mapping[str, Vector]]]

#: rows that are read and written together
_ROWS = 65536
_REQUIRED = ('t', 'v', 'y')
#: names of columns, and what else npz and mat carry
_WANTED = 't|v|y|x_.+'
_USED = f'{_WANTED}|segment_name|segment_start'
_POINTS = (
    'these look like decimal commas: save it with decimal points (in a spreadsheet, with the '
    'number format of English)'
)


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
            for a in range(0, piece.n, _ROWS):
                cut = slice(a, min(a + _ROWS, piece.n))
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


def _wanted(name: str) -> bool:
    return re.fullmatch(_WANTED, name) is not None


def _check_names(names: Iterable[str], path: Path) -> None:
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


# --- CSV ------------------------------------------------------------------------------------


def read_csv(path: Path) -> RecordTable:
    """Read a CSV file with a header line; comments may stand above it."""
    try:
        # utf-8-sig drops a byte order mark
        with path.open(encoding='utf-8-sig') as file:
            return _parse_csv(_uncommented(file), path)
    except UnicodeDecodeError:
        raise DataError(f'{path}: no text in UTF-8; save it as CSV in UTF-8') from None
    except csv.Error as error:
        raise DataError(f'{path}: no CSV file ({error}); save it as comma-separated CSV') from None


def _uncommented(lines: Iterable[str]) -> Iterator[str]:
    """
    Yield as many lines as there are, with empty ones for the comments above the header.

    Where numbers follow a comment that names the columns, as numpy.savetxt writes it, that is the
    header.
    """
    rest = iter(lines)
    comment: str | None = None
    for line in rest:
        bare = line.strip()
        if bare.startswith('#'):
            if comment is not None:
                yield '\n'
            comment = bare.lstrip('#').strip()
        elif bare:
            if comment is not None:
                names = {c.strip() for c in comment.split(',')}
                is_header = names.issuperset(_REQUIRED) and _is_number(bare.partition(',')[0])
                yield f'{comment}\n' if is_header else '\n'
            yield line
            break
        else:
            yield '\n'
    yield from rest


def _parse_csv(lines: Iterator[str], path: Path) -> RecordTable:
    line, header = _header(lines, path)
    wanted = {name: i for i, name in enumerate(header) if _wanted(name)}
    # a name may be empty
    dtype = np.dtype([(f'{i}', float if c in wanted else object) for i, c in enumerate(header)])
    parts: list[Any] = []
    names: list[str] = []
    starts: list[int] = []
    n = 0
    while chunk := _whole_rows(lines):
        if any(map(str.strip, chunk)):
            try:
                part = np.loadtxt(
                    chunk, dtype, delimiter=',', comments=None, quotechar='"', ndmin=1
                )
            except ValueError:
                raise _culprit(chunk, line + 1, header, path) from None
            if 'segment' in header:
                new, at = label_runs(map(str.strip, part[f'{header.index("segment")}']))
                names += new
                starts += [n + i for i in at]
            parts.append({name: part[f'{i}'].copy() for name, i in wanted.items()})
            n += part.size
        line += len(chunk)
    if not n:
        raise DataError(f'{path}: no rows below the header; record some samples')
    return RecordTable(
        {name: np.concatenate([part[name] for part in parts]) for name in wanted},
        names,
        starts,
        tuple(c for c in header if c and c not in wanted and c != 'segment'),
    )


def _whole_rows(lines: Iterator[str]) -> list[str]:
    """Return the next lines, up to the end of a quoted cell; csv.Error where that never comes."""
    chunk = list(itertools.islice(lines, _ROWS))

    def further() -> Iterator[str]:
        for line in lines:
            chunk.append(line)
            yield line

    # numpy takes all up to the end for a cell whose quote is missing
    if any('"' in line for line in chunk):
        n = len(chunk)
        reader = csv.reader(itertools.chain(chunk[:], further()), strict=True)
        while reader.line_num < n and next(reader, None) is not None:
            pass
    return chunk


def _header(lines: Iterator[str], path: Path) -> tuple[int, list[str]]:
    """Return the number of the header line, and the names in it."""
    number, text = next(((i, x) for i, x in enumerate(lines, 1) if x.strip()), (0, ''))
    header = [c.strip() for c in next(csv.reader([text], strict=True), [])]
    if not header:
        raise DataError(f'{path}: empty file; write a header line t,v,y and the samples below it')
    for separator, name in ((';', 'semicolons'), ('\t', 'tabs')):
        if len(header) == 1 and separator in header[0]:
            raise DataError(f'{path}: separated by {name}; save it with commas and decimal points')
    if not set(_REQUIRED).intersection(header) and _is_number(header[0]):
        raise DataError(
            f"{path}: no header line; put 't,v,y', and a name for each further column, on top of "
            'the numbers'
        )
    _check_names(header, path)
    return number, header


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    # float takes 1_000 and digits of other scripts too, numpy does not
    return '_' not in text and text.strip().isascii()


def _culprit(chunk: list[str], line: int, header: list[str], path: Path) -> DataError:
    """Return the error for the first of some lines that cannot be read."""
    reader = csv.reader(chunk, strict=True)
    for row in filter(None, reader):
        at = f'{path}: line {line + reader.line_num - 1}'
        if len(row) != len(header):
            return DataError(
                f'{at} has {len(row)} columns, the header has {len(header)}; '
                + (_POINTS if _torn_at_commas(row, header) else 'mend or delete the line')
            )
        for name, text in zip(header, row, strict=True):
            if _wanted(name) and not _is_number(text):
                comma = re.fullmatch(r'\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*', text)
                return DataError(
                    f'{at}, column {name}: {text[:40]!r} is no number; '
                    + (_POINTS if comma else 'mend or delete the line')
                )
    return DataError(f'{path}: unreadable rows from line {line}; save it again')


def _torn_at_commas(row: list[str], header: list[str]) -> bool:
    """Return whether a row looks as if its decimal commas were taken for separators."""
    whole = sum(re.fullmatch(r'\s*[-+]?\d+([eE][-+]?\d+)?\s*', c) is not None for c in row)
    texts = sum(not _wanted(name) for name in header)
    return len(header) < len(row) <= 2 * len(header) and len(row) - whole <= texts


def write_csv(
    file: BinaryIO, blocks: Blocks, names: Sequence[str] = (), starts: Sequence[int] = ()
) -> None:
    """Write a CSV file whose numbers read back exactly."""
    labels, n = [_quoted(name) for name in names], 0
    for block in blocks():
        if not n:
            file.write((','.join([*block, *(['segment'] if labels else [])]) + '\n').encode())
        texts: list[Iterable[str]] = [map(repr, x.tolist()) for x in block.values()]
        rows = np.arange(n, n + block['t'].size)
        if labels:
            texts.append(labels[j] for j in np.searchsorted(starts, rows, 'right') - 1)
        file.write(('\n'.join(map(','.join, zip(*texts, strict=True))) + '\n').encode())
        n += rows.size


def _quoted(text: str) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator='').writerow([text, ''])
    return line.getvalue()[:-1]


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
    _check_names(everything, path)
    columns = {}
    for name in filter(_wanted, arrays):
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


READERS: Mapping[str, Callable[[Path], RecordTable]] = {
    '.csv': read_csv,
    '.npz': read_npz,
    '.mat': read_mat,
}
WRITERS: Mapping[str, Callable[[BinaryIO, Blocks, Sequence[str], Sequence[int]], None]] = {
    '.csv': write_csv,
    '.npz': write_npz,
    '.mat': write_mat,
}

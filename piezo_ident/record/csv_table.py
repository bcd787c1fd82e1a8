# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Records in CSV: a header line, the column ``segment`` labels each row.

Comments, lines with ``#``, may stand above the header.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import csv
import io
import itertools
from pathlib import Path
import re
from typing import Any, BinaryIO

import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.record.assemble import label_runs
from piezo_ident.record.tables import Blocks, check_names, is_wanted, RecordTable, ROWS

__all__ = ['read_csv', 'write_csv']

_REQUIRED = ('t', 'v', 'y')
_POINTS = (
    'these look like decimal commas: save it with decimal points (in a spreadsheet, with the '
    'number format of English)'
)


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
    wanted = {name: i for i, name in enumerate(header) if is_wanted(name)}
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
    chunk = list(itertools.islice(lines, ROWS))

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
    check_names(header, path)
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
            if is_wanted(name) and not _is_number(text):
                comma = re.fullmatch(r'\s*[-+]?\d*,\d+([eE][-+]?\d+)?\s*', text)
                return DataError(
                    f'{at}, column {name}: {text[:40]!r} is no number; '
                    + (_POINTS if comma else 'mend or delete the line')
                )
    return DataError(f'{path}: unreadable rows from line {line}; save it again')


def _torn_at_commas(row: list[str], header: list[str]) -> bool:
    """Return whether a row looks as if its decimal commas were taken for separators."""
    whole = sum(re.fullmatch(r'\s*[-+]?\d+([eE][-+]?\d+)?\s*', c) is not None for c in row)
    texts = sum(not is_wanted(name) for name in header)
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

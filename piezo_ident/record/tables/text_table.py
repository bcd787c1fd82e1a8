# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Read tables in text: CSV of spreadsheets in any language, and files of LabVIEW and others.

`piezo_ident.record.tables.text_layout` finds the table; NumPy reads its numbers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
import csv
from dataclasses import replace
from datetime import datetime, timezone
import functools
import io
import itertools
from pathlib import Path
import re
from typing import Any, BinaryIO

import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.record.assemble import label_runs
from piezo_ident.record.options import ReadOptions
from piezo_ident.record.tables.columns import choose, rate_option, RecordTable
from piezo_ident.record.tables.text_layout import COMMENT, find_layout, is_number, Layout
from piezo_ident.record.tables.write import Blocks, ROWS

#: most lines above the table
HEAD = 1000
#: cells of programs that stand for no number, in lower case
MISSING = ('', 'na', 'n/a', '#na', '#n/a')
#: a date, which may be absent, the time of day, its decimals, and a zone
_STAMP = re.compile(
    r'(?:(\d{4}-\d\d-\d\d)[T ])?(\d\d:\d\d:\d\d)(?:[.,](\d{1,9}))?'
    r'\s*(?:Z|([-+])(\d\d):?(\d\d)?)?',
    re.ASCII,
)
_DAY = 86_400 * 10**9


def read_text(path: Path, options: ReadOptions) -> RecordTable:
    """Read a table in text, below any other text."""
    with path.open('rb') as file:
        marked = file.read(2) in (b'\xff\xfe', b'\xfe\xff')
    # utf-8-sig drops a byte order mark; Windows writes cp1252 in the west
    for encoding in ['utf-16'] if marked else ['utf-8-sig', 'cp1252']:
        try:
            with path.open(encoding=encoding) as file:
                return _parse(file, path, options)
        except UnicodeError:
            continue
        except csv.Error as error:
            raise DataError(f'{path}: no CSV file ({error}); save it as CSV again') from None
    raise DataError(f'{path}: no text in UTF-8, UTF-16 or cp1252; save it as CSV in UTF-8')


def _parse(lines: Iterator[str], path: Path, options: ReadOptions) -> RecordTable:
    head = list(itertools.islice(lines, HEAD))
    layout = find_layout(head)
    if layout is None:
        filled = any(x.strip() and not x.lstrip().startswith(COMMENT) for x in head)
        fault = f'no rows of numbers in the first {len(head)} lines' if filled else 'empty file'
        raise DataError(f'{path}: {fault}; save it as a table with a header line t,v,y')
    names = layout.names
    if not names and not options.columns:
        way = f'--columns v=1,y=2 {rate_option(layout.numbers)}'
        way = '--columns t=1,v=2,y=3' if layout.width - len(layout.empty) > 2 else way
        raise DataError(
            f'{path}: no header line; name the columns by their numbers, 1 to {layout.width}: '
            f'{way}',
            options=way,
        )
    every = names or [''] * layout.width
    places, table = choose(every, options, path, scalars=layout.numbers, empty=layout.empty)
    rows = itertools.chain(head[layout.above :], lines)
    columns, labels, starts = _rows(rows, layout, places, path)
    return replace(table, columns=columns, names=labels, starts=starts)


def _rows(
    lines: Iterator[str], layout: Layout, places: dict[str, int], path: Path
) -> tuple[dict[str, Any], list[str], list[int]]:
    wanted = {name: i for name, i in places.items() if name != 'segment'}
    # a comma as separator splits decimal commas: the reader then checks every cell
    width = len(layout.names) or layout.width
    use = range(width) if layout.separator == ',' else sorted({*places.values()})
    number = {*wanted.values()}
    dtype = np.dtype([(f'{i}', float if i in number else object) for i in use])
    options: dict[str, Any] = {'delimiter': layout.separator, 'quotechar': '"', 'comments': None}
    options |= {'ndmin': 1, 'encoding': 'utf-8'}
    options['usecols'] = None if layout.separator == ',' else [*use]
    parts: list[Any] = []
    names: list[str] = []
    starts: list[int] = []
    n, line = 0, layout.above
    # slow ways come last: cells without a number, decimal commas, comments between the rows
    ways: list[Any] = [None, *(dict.fromkeys(number, way) for way in (_with_point, _with_comma))]
    if 't' in wanted:
        stamp = _Stamps()
        ways += [way | {wanted['t']: stamp} for way in ways[1:]]
    held: list[str] = []
    while chunk := _whole_rows(lines):
        # rows of empty cells below the last row are no rows
        chunk = held + chunk
        end = len(chunk)
        while end and not chunk[end - 1].strip(f' \t\r\n{layout.separator or ""}'):
            end -= 1
        chunk, held = chunk[:end], chunk[end:]
        if chunk:
            for rows, way in itertools.product((chunk, None), ways):
                rows = rows or _without_comments(chunk)
                try:
                    part = np.loadtxt(rows, dtype, converters=way, **options)
                except ValueError:
                    continue
                break
            else:
                raise _culprit(_without_comments(chunk), line + 1, layout, wanted, path)
            if 'segment' in places:
                new, at = label_runs(map(str.strip, part[f'{places["segment"]}']))
                names += new
                starts += [n + i for i in at]
            parts.append({name: part[f'{i}'].copy() for name, i in wanted.items()})
            n += part.size
        line += len(chunk)
    if not n:
        raise DataError(f'{path}: no rows below the header; record some samples')
    columns = {name: np.concatenate([part[name] for part in parts]) for name in wanted}
    return columns, names, starts


def _without_comments(lines: Iterable[str]) -> list[str]:
    return ['\n' if line.lstrip().startswith(COMMENT) else line for line in lines]


def _with_point(text: str) -> float:
    if '_' in text:
        raise ValueError  # no number
    return np.nan if text.strip().lower() in MISSING else float(text)


def _with_comma(text: str) -> float:
    if '.' in text or '_' in text:
        raise ValueError  # commas between thousands, or no number
    return _with_point(text.replace(',', '.'))


class _Stamps:
    """Seconds from the first of ISO 8601 stamps; a stamp may lack its date."""

    def __init__(self) -> None:
        self._first: int | None = None
        self._last = 0

    def __call__(self, text: str) -> float:
        match = _STAMP.fullmatch(text.strip())
        if not match:
            raise ValueError
        day, clock, decimals, sign, hours, minutes = match.groups()
        zone = 60 * int(f'{sign}1') * (60 * int(hours) + int(minutes or 0)) if sign else 0
        # counted in ns: a float64 holds a tenth of a microsecond since 1970
        at = (_second(day or '1970-01-01', clock) - zone) * 10**9 + int(f'{decimals or 0:0<9}')
        if self._first is None:
            self._first = self._last = at
        if not day:
            # midnight may lie between
            at += _DAY * round((self._last - at) / _DAY)
        self._last = at
        return (at - self._first) / 1e9


@functools.lru_cache(maxsize=16)
def _second(day: str, clock: str) -> int:
    return round(datetime.fromisoformat(f'{day} {clock}').replace(tzinfo=timezone.utc).timestamp())


def _whole_rows(lines: Iterator[str]) -> list[str]:
    """Return the next lines, up to the end of a quoted cell; csv.Error without that end."""
    chunk = list(itertools.islice(lines, ROWS))
    quotes = ''.join(chunk).count('"')
    while quotes % 2:
        line = next(lines, '')
        if not line:
            raise csv.Error('a quoted cell has no end')
        chunk.append(line)
        quotes += line.count('"')
    # numpy drops a quote inside of a cell
    for _ in csv.reader(chunk if quotes else (), strict=True):
        pass
    return chunk


def _culprit(
    chunk: list[str], line: int, layout: Layout, wanted: dict[str, int], path: Path
) -> DataError:
    """Return the error for the first unreadable line."""
    width = len(layout.names) or layout.width
    separator = layout.separator
    reader: Any = csv.reader(chunk, delimiter=separator, strict=True) if separator else None
    rows = filter(None, reader or map(str.split, chunk))
    marks: set[str] = set()
    for number, row in enumerate(rows, line):
        at = f'{path}: line {line + reader.line_num - 1 if reader else number}'
        if len(row) <= max(wanted.values()) or (separator == ',' and len(row) != width):
            # decimal commas may have been taken for separators
            whole = sum(re.fullmatch(r'\s*[-+]?\d+([eE][-+]?\d+)?\s*', c) is not None for c in row)
            torn = width < len(row) <= 2 * width and len(row) - whole <= width - len(wanted)
            cure = 'save it with decimal points, or with semicolons between the columns'
            cure = f'these look like decimal commas: {cure}' if torn else 'mend or delete the line'
            return DataError(f'{at} has {len(row)} columns, the header has {width}; {cure}')
        for name, place in wanted.items():
            text = row[place].strip()
            title = layout.names[place] if layout.names else name
            if text.lower() in MISSING or (name == 't' and _STAMP.fullmatch(text)):
                continue
            if not is_number(text):
                below = [r[place] for r in itertools.islice(rows, 100) if len(r) > place]
                if number == layout.above + 1 and below and not any(map(is_number, below)):
                    way = rate_option(layout.numbers) if name == 't' else f'--columns {name}=NAME'
                    cure = 'give the sampling rate' if name == 't' else 'name another column'
                    return DataError(
                        f'{path}: column {title} holds text, {text[:40]!r}, no numbers; {cure}, '
                        f'as in {way}',
                        options=way if name == 't' else '',
                    )
                cure = 'mend it, or leave the cell empty if there is no reading'
                if re.fullmatch(r'[-+]?\d{1,3}([.,]\d{3})+([.,]\d*)?', text):
                    cure = 'save it without marks between thousands'
                return DataError(f'{at}, column {title}: {text[:40]!r} is no number; {cure}')
            marks |= {*text} & {',', '.'}
            if len(marks) > 1:
                return DataError(
                    f'{at}, column {title}: {text[:40]!r}, but there are both decimal commas '
                    'and points above it; save it with one of them'
                )
    return DataError(f'{path}: unreadable rows from line {line}; save it again')


def write_csv(
    file: BinaryIO, blocks: Blocks, names: Sequence[str] = (), starts: Sequence[int] = ()
) -> None:
    """Write a CSV file whose numbers read back exactly."""
    quoted = io.StringIO()
    csv.writer(quoted, lineterminator='\0').writerows([name, ''] for name in names)
    labels, n = [line[:-1] for line in quoted.getvalue().split('\0')[:-1]], 0
    for block in blocks():
        if not n:
            file.write((','.join([*block, *(['segment'] if labels else [])]) + '\n').encode())
        texts: list[Iterable[str]] = [map(repr, x.tolist()) for x in block.values()]
        rows = np.arange(n, n + block['t'].size)
        if labels:
            texts.append(labels[j] for j in np.searchsorted(starts, rows, 'right') - 1)
        file.write(('\n'.join(map(','.join, zip(*texts, strict=True))) + '\n').encode())
        n += rows.size

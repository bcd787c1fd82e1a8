# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Tables and numbers for people, as plain text that a page or a terminal shows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
import math
import textwrap

from piezo_ident.common.errors import printable

#: width of a terminal [characters]
WIDTH = 99
#: columns of a table of faults in the data
FAULTS = ('fault', 'count', 'where', 'action')
#: longer cells are wrapped on a page [characters]
PROSE = 28
#: most names on a line
LISTED = 8


@dataclass(frozen=True)
class Table:
    """
    A table of text cells.

    A `head` of empty cells is not shown.  The `note` on units and formulas follows on a page.
    """

    title: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    note: str = ''

    @property
    def text_columns(self) -> tuple[bool, ...]:
        """Whether each column, but for the first, holds text rather than numbers."""
        cells = list(zip(*self.rows, strict=True)) or [()] * len(self.head)
        return tuple(i > 0 and not all(map(_is_number, column)) for i, column in enumerate(cells))

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each column on a page: numbers (empty), a word (text), or prose."""
        longest = [max(map(len, column), default=0) for column in zip(*self.rows, strict=True)]
        kinds = zip(self.text_columns, longest, strict=False)
        return tuple(
            ('prose' if size > PROSE else 'text') if is_text else '' for is_text, size in kinds
        )

    def lines(self) -> list[str]:
        """Write the table for a terminal; a last column of text is wrapped."""
        rows = [self.head, *self.rows] if any(self.head) else list(self.rows)
        cells = [[printable(cell) for cell in row] for row in rows]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        left = [True, *self.text_columns[1:]]
        if left[-1]:
            widths[-1] = 0
        indent = ' ' * (sum(widths[:-1]) + 2 * len(widths) - 2)
        lines = [f'{self.title}:'] if self.title and any(self.head) else []
        for row in cells:
            parts = [
                cell.ljust(width) if is_text else cell.rjust(width)
                for cell, width, is_text in zip(row, widths, left, strict=True)
            ]
            lines += _wrapped('  '.join(parts).rstrip(), indent)
        return lines


def table(
    title: str, head: tuple[str, ...], rows: Sequence[tuple[str, ...]], note: str = ''
) -> list[Table]:
    """Make a list with one table, or an empty list if `rows` is empty."""
    return [Table(title, head, rows, note)] if rows else []


def listed(names: Iterable[str]) -> str:
    """
    Join names on one line, the first of many and how many more there are.

    >>> listed('abcdefghijk')
    'a, b, c, d, e, f, g, h and 3 more'
    """
    all_names = list(names)
    more = len(all_names) - LISTED
    return ', '.join(all_names[:LISTED]) + (f' and {more} more' if more > 0 else '')


def plain_text(parts: Iterable[Table | str]) -> str:
    """Write tables and paragraphs for a terminal; empty paragraphs are left out."""
    blocks = (
        part.lines() if isinstance(part, Table) else _wrapped(printable(part), '')
        for part in parts
        if part
    )
    return '\n\n'.join('\n'.join(lines) for lines in blocks)


def number(value: float | None, digits: int = 3) -> str:
    """Format a number with significant digits; a dash stands for an unknown number."""
    if value is None or math.isnan(value):
        return '–'
    if math.isinf(value):
        return '∞' if value > 0 else '-∞'
    if value == 0.0:
        return '0'
    if not 1e-4 <= abs(value) < 1e6:
        return f'{value:.{digits - 1}e}'
    return f'{value:.{max(0, digits - 1 - math.floor(math.log10(abs(value))))}f}'


def length(metres: float) -> str:
    """Format a length in mm, µm or nm."""
    for limit, factor, unit in ((1e-3, 1e3, 'mm'), (1e-6, 1e6, 'µm')):
        if abs(metres) >= limit:
            return f'{number(metres * factor, 4)} {unit}'
    return f'{number(metres * 1e9, 4)} nm'


def share_text(share: float) -> str:
    """Format a share as a percentage within 0 .. 100; a dash stands for an unknown share."""
    return f'{100.0 * min(1.0, max(0.0, share)):.0f} %' if math.isfinite(share) else '–'


def origin_tables(
    settings: Mapping[str, object], unset: str, versions: Mapping[str, object]
) -> list[Table]:
    """List the settings and versions of a result; `unset` stands for a setting of None."""

    def text(value: object) -> str:
        if isinstance(value, tuple):
            return ', '.join(map(str, value)) or 'none'
        if isinstance(value, bool):
            return 'yes' if value else 'no'
        return unset if value is None else str(value)

    rows = [(name.replace('_', ' '), text(value)) for name, value in settings.items()]
    return [
        Table('Settings', ('setting', 'value'), rows),
        Table('Versions', ('software', 'version'), [(n, str(x)) for n, x in versions.items()]),
    ]


def _is_number(cell: str) -> bool:
    return not cell or (cell[0] in '0123456789-–∞' and len(cell) < 16)


def _wrapped(text: str, indent: str) -> list[str]:
    deep = len(indent) > WIDTH // 2
    return textwrap.wrap(text, WIDTH, subsequent_indent='' if deep else indent) or ['']

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Tables and numbers for people, as plain text that a page or a terminal shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
import textwrap

__all__ = ['FAULTS', 'Table', 'columns', 'length', 'number', 'printable', 'table', 'wrapped']

#: of a terminal [characters]
WIDTH = 99
#: columns of a table of faults in the data
FAULTS = ('fault', 'count', 'where', 'action')


@dataclass(frozen=True)
class Table:
    """
    A table of text cells.

    Attributes
    ----------
    title : str
    head : tuple of str
    rows : sequence of tuple of str
    note : str
        Stands below: units and formulas.
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


def table(
    title: str, head: tuple[str, ...], rows: Sequence[tuple[str, ...]], note: str = ''
) -> list[Table]:
    """Return a table, or nothing without rows."""
    return [Table(title, head, rows, note)] if rows else []


def _is_number(cell: str) -> bool:
    return not cell or (cell[0] in '0123456789-–∞' and len(cell) < 16)


def number(value: float | None, digits: int = 3) -> str:
    """Return a number to so many significant digits, a dash where there is none."""
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
    """Return a length in the unit in which it reads best."""
    for limit, factor, unit in ((1e-3, 1e3, 'mm'), (1e-6, 1e6, 'µm')):
        if abs(metres) >= limit:
            return f'{number(metres * factor, 4)} {unit}'
    return f'{number(metres * 1e9, 4)} nm'


def printable(text: str) -> str:
    """Return text without control characters: names in files must not steer a terminal."""
    return ''.join(c if c.isprintable() else '?' for c in text)


def columns(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return lines for a terminal; the first column stands left, the others right."""
    cells = [[printable(cell) for cell in row] for row in (head, *rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [
        '  '.join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip()
        for row in cells
    ]


def wrapped(text: str, indent: str = '', first: str = '') -> list[str]:
    """Return a text as lines for a terminal, `first` before the first and `indent` further."""
    text = printable(text)
    return textwrap.wrap(text, WIDTH, initial_indent=first, subsequent_indent=indent)

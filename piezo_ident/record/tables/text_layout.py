# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Find the layout of a text file: separator, header and first row.

Instruments write other text above their table.  The table begins with the first rows of numbers.
Its header is the last line above these rows; a line of units may stand in between.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import csv
from dataclasses import dataclass, field
import re

from piezo_ident.record.options import plain_unit, UNITS

#: first characters of comments in the programs of the field
COMMENT = ('#', '%', '//', '!')

_DIGITS = r'[-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][-+]?\d+)?'
_NUMBER = re.compile(rf'{_DIGITS}|[-+]?(nan|inf)', re.IGNORECASE | re.ASCII)
#: a name and one number behind it, with a unit or a cell that may be a unit
_ALONE = (
    r'\W*(?P<name>.+?)\s*[:=,;\t]+\s*(?P<value>{})'
    r'(\s*(?P<unit>[^\W\d]+(/s)?)|\s*[,;\t]\s*(?P<cell>[^\W\d]+(/s)?))?(\W.*)?'
)
_LVM_UNITS = 'Y_Unit_Label'
#: further cells of a line of units; Rigol's oscilloscopes count samples in Sequence
_OTHER_UNITS = ('', '-', 'Hz', 'kHz', 'MHz', 'S/s', 'Sa/s', 'N', 'A', 'K', 'Sequence')
#: None: blanks
_SEPARATORS = ('\t', ';', ',', None)


@dataclass(frozen=True)
class Layout:
    """
    Separator, names of the columns if a line names them, and number of lines above the rows.

    `numbers` are numbers behind a name above the table; `empty` are the places of columns without
    a cell in the first rows.
    """

    separator: str | None
    names: tuple[str, ...]
    above: int
    numbers: Mapping[str, float] = field(default_factory=dict)
    empty: tuple[int, ...] = ()
    width: int = 0


def is_number(text: str) -> bool:
    """Return whether a cell is a number, with a decimal point or comma."""
    return _NUMBER.fullmatch(text.strip()) is not None


def cells_of(line: str, separator: str | None) -> list[str]:
    """Return the cells of a line."""
    if separator is None:
        return line.split()
    row = next(csv.reader([line], delimiter=separator), [])
    return [cell.strip() for cell in row]


def find_layout(lines: Sequence[str]) -> Layout | None:
    """Return the layout of the first lines of a file, or None if the lines hold no table."""
    filled = [i for i, line in enumerate(lines) if line.strip()]
    if own := _own(lines, filled):
        return own
    # tables behind a column of text come last, since LabVIEW lists properties of channels so
    for is_table in (_is_table, _is_table_behind_text):
        for k, i in enumerate(filled):
            following = [lines[j] for j in filled[k : k + 3]]
            for separator in _SEPARATORS:
                rows = [cells_of(line, separator) for line in following]
                if is_table(rows, separator):
                    return _above(lines, filled[:k], i, separator)
    return None


def _own(lines: Sequence[str], filled: Sequence[int]) -> Layout | None:
    """Return the layout of a file whose first line below comments names t, v or y."""
    first = next((i for i in filled if not lines[i].lstrip().startswith(COMMENT)), None)
    if first is None:
        return None
    for separator in (',', ';', '\t', None):
        cells = cells_of(lines[first], separator)
        # between blanks, prose has a lone v too
        if {'t', 'v', 'y'}.intersection(cells) and (separator or {'t', 'v'}.issubset(cells)):
            below = cells_of(next((lines[i] for i in filled if i > first), ''), separator)
            if any(below) and all(map(_is_unit, below)):
                return None  # the header has a second line
            return Layout(separator, tuple(_as_wide(cells, below)), first + 1)
    return None


def _is_table(rows: Sequence[Sequence[str]], separator: str | None) -> bool:
    """Return whether consecutive rows are the first rows of a table of numbers."""
    if separator == ',' and any(re.search(r'\d\s+[-+.\d]', cell) for cell in rows[0]):
        return False  # decimal commas between blanks
    # the reader refuses a spoiled second row; LabVIEW leaves unknown times empty
    return all(sum(map(is_number, r)) > 1 and (not r[0] or is_number(r[0])) for r in rows[:2])


def _is_table_behind_text(rows: Sequence[Sequence[str]], separator: str | None) -> bool:
    """Return whether rows are the first of a table whose first column is text."""
    places = [[j for j, cell in enumerate(row) if is_number(cell)] for row in rows]
    return len(places[0]) > 1 and len(rows) == 3 and places[0] == places[1] == places[2]


def _above(
    lines: Sequence[str], filled: Sequence[int], first: int, separator: str | None
) -> Layout:
    row = cells_of(lines[first], separator)
    need = 1 + max(j for j, cell in enumerate(row) if is_number(cell))
    names: list[str] = []
    units: list[str] = []
    for i in reversed(filled[-2:]):
        line = lines[i].strip('\r\n')
        is_comment = line.lstrip().startswith(COMMENT)
        line = line.strip().lstrip('#%/!').strip() if is_comment else line
        cells = _named(line, separator, need)
        known = all(_is_unit(x) or is_number(x) for x in cells)
        if cells and not units and known and not all(map(is_number, cells)):
            units = cells
            continue
        names = cells
        break
    if not names and units:
        names, units = units, []
    if not units:
        # LabVIEW lists the units of its columns far above them
        rows = [cells_of(lines[i], separator) for i in filled if lines[i].startswith(_LVM_UNITS)]
        units = ['', *rows[-1][1:]] if rows else []
    # LabVIEW leaves a column of unknown times empty; one empty cell is no empty column
    some = [cells_of(line, separator) for line in lines[first : first + 100]]
    width = max(len(row), len(names))
    empty = {j for j in range(width) if not any(''.join(cells[j : j + 1]) for cells in some)}
    numbers = dict(filter(None, (_alone(lines[i], separator) for i in filled)))
    for j, (name, unit) in enumerate(zip(names, [*units, *[''] * len(names)], strict=False)):
        # oscilloscopes write numbers beside the columns: Increment over 1e-3, or tInc = 1e-3
        alone = _alone(f'{name}={unit}' if is_number(unit) else name, separator)
        if alone and j in empty:
            numbers |= [alone]
            names[j] = ''
        elif unit and name:
            names[j] = f'{name} [{unit.strip("[]()")}]'
    names = _as_wide(names, row)
    return Layout(separator, tuple(names), first, numbers, tuple(empty), len(row))


def _as_wide(names: list[str], row: Sequence[str]) -> list[str]:
    """Return as many names as a row has cells: without empty names, or with empty cells."""
    while len(names) > len(row) and not names[-1]:
        names = names[:-1]
    more = row[len(names) :]
    return names if any(more) or not names else [*names, *more]


def _alone(line: str, separator: str | None) -> tuple[str, float] | None:
    """Return the name, with its unit, of the only number in a line, and the number."""
    digits = _DIGITS.replace('[.,]', '[.]') if separator == ',' else _DIGITS
    match = re.fullmatch(_ALONE.format(digits), line.strip().replace('"', ''))
    if not match:
        return None
    unit = match['unit'] or (match['cell'] if _is_unit(match['cell'] or '') else '')
    name = f'{match["name"]} [{unit}]' if unit else match['name']
    return name, float(match['value'].replace(',', '.'))


def _named(line: str, separator: str | None, need: int) -> list[str]:
    """Return the cells of a header, nothing for a line with too few cells."""
    cells = cells_of(line, separator)
    # decimal commas split the cells of a row
    if separator and len(cells) >= (2 if separator == ',' else need):
        return cells
    # a header and its rows may have different separators
    others = [cells_of(line, other) for other in ('\t', ';', ',')]
    others += [re.split(way, line.strip()) for way in (r'\s{2,}', r'\s+(?![\[(])')]
    return next((x for x in others if len(x) == need), [])


def _is_unit(text: str) -> bool:
    unit = plain_unit(text.strip().strip('[]()'))
    return unit in _OTHER_UNITS or any(unit in units for units in UNITS.values())

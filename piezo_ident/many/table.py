# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The table of many records: one row each, CSV for everybody, Parquet where pyarrow is installed.

The same rows give the same bytes of CSV, in whatever order they were made.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import csv
from dataclasses import dataclass
import importlib.util
import io
from pathlib import Path
import re
from typing import Any

from piezo_ident.common.files import temporary_output
from piezo_ident.many.run import Row, Value

__all__ = ['COLUMNS', 'Column', 'columns_of', 'csv_text', 'natural', 'unit_of', 'write_tables']


@dataclass(frozen=True)
class Column:
    """A column: unit ('' for text and plain numbers), and what it holds."""

    unit: str
    about: str


#: the columns that do not depend on what was found, in their order
COLUMNS = {
    'record': Column('', 'name of the file or bag, without its ending'),
    'status': Column('', 'ok or failed'),
    'reason': Column('', 'why it failed'),
    'model': Column('', 'model that was judged (diagnose)'),
    'sample_rate': Column('Hz', 'of the first piece'),
    'samples': Column('', 'in all pieces'),
    'duration': Column('s', 'of all pieces'),
    'voltage_low': Column('V', 'lowest voltage'),
    'voltage_high': Column('V', 'highest voltage'),
    'stroke': Column('m', 'largest minus smallest displacement'),
    'method': Column('', 'three steps, or a joint fit where nothing is labelled'),
    'verdict': Column('', 'named, class, partly_explained, unexplained or none'),
    'effects': Column('', 'effects that were added'),
    'alike': Column('', 'effects that these data cannot tell apart'),
    'error_held_out': Column('% of stroke', 'free run on segments that were not fitted'),
    'error_selection': Column('% of stroke', 'on what only chose between models'),
    'error_fitted': Column('% of stroke', 'on what was fitted'),
    'error_before': Column('% of stroke', 'of the model as it was given'),
    'error_refit': Column('% of stroke', 'with H refitted, held out'),
    'error_after': Column('% of stroke', 'of the refined model, held out'),
    'unexplained': Column('% of stroke', 'rms of what is left beyond the noise'),
    'noise_floor': Column('% of stroke', 'rms of the sensor noise'),
    'smallest_detectable': Column('% of stroke', 'rms of the smallest effect that would show'),
    'gain': Column('m/V', 'displacement over voltage between the ends of the range'),
    'loop_width': Column('%', 'largest width of the loop over the range, of its stroke'),
    'delay': Column('s', 'delay'),
    'delay_samples': Column('', 'delay in samples'),
    'delay_std': Column('', 'standard deviation of the delay in samples'),
    'bandwidth': Column('Hz', 'frequency at which |G| has fallen by 3 dB'),
    'resonance': Column('Hz', 'frequency of the largest |G|, if it rises by 5 %'),
    'resonance_peak': Column('', '|G| there, over that at rest'),
    'order_a': Column('', 'order na of G'),
    'order_b': Column('', 'order nb of G'),
    'p1': Column('', 'cubic coefficient of H, normalised'),
    'p2': Column('', 'linear coefficient of H, normalised'),
    'faults': Column('', 'faults in the data'),
    'warnings': Column('', 'what a reader has to know'),
}
#: columns of an effect, or of a play, in their order
FOUND = {
    'share': Column('', 'part of what can be explained, 0 to 1'),
    'rms': Column('% of stroke', 'rms of what the effect explains'),
}
#: these stand behind whatever was found
_LAST = ('faults', 'warnings')


def natural(text: str) -> tuple[tuple[int, int, str], ...]:
    """
    Return a key that sorts as people do: numbers by value.

    Examples
    --------
    >>> sorted(['stage_10', 'stage_9', 'Stage'], key=natural)
    ['Stage', 'stage_9', 'stage_10']
    """
    parts = re.split(r'(\d+)', text)
    # the text itself decides between 01 and 1
    key = [(1, int(p), p) if p.isdecimal() else (0, 0, p) for p in parts if p]
    return (*key, (2, 0, text))


def unit_of(column: str) -> str:
    """Return the unit of a column; '' for text and plain numbers, and for those of effects."""
    if column in COLUMNS:
        return COLUMNS[column].unit
    return FOUND[kind].unit if (kind := column.partition('.')[2]) in FOUND else ''


def columns_of(rows: Iterable[Row]) -> list[str]:
    """Return the columns that these rows need, in the order of the table."""
    found = {name for row in rows for name in row.values}
    known = [name for name in COLUMNS if name in ('record', 'status', 'reason') or name in found]
    others = sorted(found - set(COLUMNS), key=_place)
    first = [name for name in known if name not in _LAST]
    return [*first, *others, *(name for name in known if name in _LAST)]


def _place(column: str) -> tuple[Any, ...]:
    # r1 q1 r2 q2 ...; share and rms of an effect before its parameters
    play = re.fullmatch(r'([rq])(\d+)', column)
    if play:
        return 0, int(play[2]), -ord(play[1])
    effect, _, name = column.partition('.')
    return 1, effect, name not in FOUND, natural(name)


def _cells(row: Row) -> dict[str, Value]:
    status = 'ok' if row.good else 'failed'
    return {**row.values, 'record': row.record, 'status': status, 'reason': row.reason}


def _text(value: Value) -> str:
    if isinstance(value, float):
        # as short as it can be for the same number to be read back
        return repr(value)
    return '' if value is None else str(value)


def _sorted(rows: Iterable[Row]) -> list[Row]:
    return sorted(rows, key=lambda row: natural(row.record))


def csv_text(rows: Iterable[Row]) -> str:
    """
    Return the table as CSV, a row a record in the order of their names.

    Parameters
    ----------
    rows : iterable of Row

    Returns
    -------
    str
        An empty cell where there is no value.
    """
    ordered = _sorted(rows)
    columns = columns_of(ordered)
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator='\n')
    writer.writerow(columns)
    for row in ordered:
        cells = _cells(row)
        writer.writerow([_text(cells.get(name)) for name in columns])
    return buffer.getvalue()


def write_tables(rows: Sequence[Row], folder: Path) -> list[Path]:
    """
    Write ``records.csv``, and ``records.parquet`` where pyarrow is installed.

    Parameters
    ----------
    rows : sequence of Row
    folder : path
        Is there.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    DataError
        When the folder cannot be written.
    """
    written = [folder / 'records.csv']
    with temporary_output(written[0], overwrite=True) as target:
        target.write_text(csv_text(rows), encoding='utf-8', errors='replace')
    other = folder / 'records.parquet'
    if importlib.util.find_spec('pyarrow') is not None:
        with temporary_output(other, overwrite=True) as target:
            _write_parquet(_sorted(rows), target)
        written.append(other)
    elif other.exists():
        # one of another run would contradict the CSV
        other.unlink()
    return written


def _write_parquet(rows: Sequence[Row], path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    cells = [_cells(row) for row in rows]
    arrays, fields = [], []
    for name in columns_of(rows):
        values = [cell.get(name) for cell in cells]
        kinds = {type(value) for value in values if value is not None}
        if str in kinds:
            kind = pyarrow.string()
            # file names need not be Unicode
            values = [
                None if v is None else _text(v).encode('utf-8', 'replace').decode() for v in values
            ]
        else:
            kind = pyarrow.int64() if kinds == {int} else pyarrow.float64()
        arrays.append(pyarrow.array(values, kind))
        unit = unit_of(name)
        fields.append(pyarrow.field(name, kind, metadata={'unit': unit} if unit else None))
    table = pyarrow.Table.from_arrays(arrays, schema=pyarrow.schema(fields))
    pyarrow.parquet.write_table(table, path)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The table of many records: one row a record, written as CSV."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import csv
from dataclasses import dataclass, field
import io
import math
from pathlib import Path
import re
from typing import Any

from piezo_ident.common.files import write_text
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.identification.results import Identification
from piezo_ident.many.figures_of_merit import figures_of_merit
from piezo_ident.record.record import Record

__all__ = [
    'COLUMNS',
    'Row',
    'Value',
    'columns_of',
    'csv_text',
    'diagnosed',
    'identified',
    'natural',
    'unit_of',
    'write_table',
]

#: content of a cell
Value = str | float | int | None


@dataclass(frozen=True)
class Row:
    """
    A line of the table.

    Attributes
    ----------
    record : str
    values : mapping of str to Value
        By column; empty where the record failed.
    reason : str
        Why it failed, in one line; empty where it did not.
    """

    record: str
    values: Mapping[str, Value] = field(default_factory=dict)
    reason: str = ''

    @property
    def is_good(self) -> bool:
        """Whether the record carried a result."""
        return not self.reason


@dataclass(frozen=True)
class Column:
    """A column: unit ('' for text and plain numbers) and content."""

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
    present = {name for row in rows for name in row.values}
    known = [name for name in COLUMNS if name in ('record', 'status', 'reason') or name in present]
    others = sorted(present - set(COLUMNS), key=_place)
    first = [name for name in known if name not in _LAST]
    return [*first, *others, *(name for name in known if name in _LAST)]


def _place(column: str) -> tuple[Any, ...]:
    # r1 q1 r2 q2 ...; share and rms of an effect before its parameters
    play = re.fullmatch(r'([rq])(\d+)', column)
    if play:
        return 0, int(play[2]), -ord(play[1])
    effect, _, name = column.partition('.')
    return 1, effect, name not in FOUND, natural(name)


def csv_text(rows: Sequence[Row]) -> str:
    """
    Return the table as CSV; a cell without a value is empty.

    Text that a spreadsheet would run as a formula gets an apostrophe in front.

    Examples
    --------
    >>> print(csv_text([Row('=1+1', {'delay': 0.25}), Row('b', reason='empty file')]), end='')
    record,status,reason,delay
    '=1+1,ok,,0.25
    b,failed,empty file,
    """
    columns = columns_of(rows)
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator='\n')
    writer.writerow(map(_text, columns))
    for row in rows:
        status = 'ok' if row.is_good else 'failed'
        cells = {**row.values, 'record': row.record, 'status': status, 'reason': row.reason}
        writer.writerow([_text(cells.get(name)) for name in columns])
    return buffer.getvalue()


def _text(value: Value) -> str:
    if isinstance(value, str):
        return f"'{value}" if value.startswith(('=', '+', '-', '@', '\t', '\r')) else value
    # the shortest text from which the same number is read
    return '' if value is None else repr(value)


def write_table(rows: Sequence[Row], path: Path) -> None:
    """
    Write the table as a CSV file.

    Raises
    ------
    DataError
        When the file cannot be written.
    """
    # file names need not be Unicode
    write_text(path, csv_text(rows).encode('utf-8', 'replace').decode('utf-8'))


def _head(record: Record) -> dict[str, Value]:
    low, high = record.voltage_range
    return {
        'sample_rate': record.pieces[0].sample_rate,
        'samples': record.n,
        'duration': record.duration,
        'voltage_low': low,
        'voltage_high': high,
        'stroke': record.stroke,
    }


def _number(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None


def identified(result: Identification, record: Record) -> dict[str, Value]:
    """
    Return the cells of an identification.

    Parameters
    ----------
    result : Identification
    record : Record

    Returns
    -------
    dict of str to Value
        By the columns of `COLUMNS`; SI units, errors in % of stroke.
    """
    model = result.model
    h, stage = model.hysteresis, figures_of_merit(model)
    values: dict[str, Value] = {
        **_head(record),
        'method': str(model.identification['method']),
        'error_held_out': _number(result.error('held out')),
        'error_selection': _number(result.error('selection')),
        'error_fitted': _number(result.error('fitted')),
        'noise_floor': _number(result.noise_floor),
        'gain': stage.gain,
        'loop_width': stage.loop_width,
        'delay': model.delay.total / model.sample_rate,
        'delay_samples': model.delay.total,
        'delay_std': _number(result.delay.std),
        'bandwidth': stage.bandwidth,
        'resonance': stage.resonance,
        'resonance_peak': stage.peak,
        'order_a': model.dynamics.a.size,
        'order_b': model.dynamics.b.size,
        'p1': h.p1,
        'p2': h.p2,
    }
    for i, (r, q) in enumerate(zip(h.thresholds, h.weights, strict=True), 1):
        values[f'r{i}'], values[f'q{i}'] = float(r), float(q)
    values['warnings'] = _joined(result.warnings)
    return values


def diagnosed(result: Diagnosis, record: Record) -> dict[str, Value]:
    """
    Return the cells of a diagnosis.

    Parameters
    ----------
    result : Diagnosis
    record : Record

    Returns
    -------
    dict of str to Value
        By the columns of `COLUMNS`, and for every effect that was added
        ``<effect>.share``, ``<effect>.rms`` and its parameters, in the units of the catalogue.
    """
    values: dict[str, Value] = {
        **_head(record),
        'verdict': result.verdict,
        'effects': ' '.join(effect.name for effect in result.effects),
        'alike': '' if result.group is None else ' '.join(result.group.names),
        'error_before': _number(result.before.overall),
        'error_refit': _number(result.refit.overall),
        'error_after': _number(result.after.overall),
        'unexplained': _number(result.unexplained.rms_percent),
        'noise_floor': _number(result.noise_floor),
        'smallest_detectable': _number(result.smallest_detectable),
    }
    for effect in result.effects:
        values[f'{effect.name}.share'] = _number(effect.share)
        values[f'{effect.name}.rms'] = _number(effect.rms_percent)
        for name, parameter in effect.parameters.items():
            values.update(_cells(f'{effect.name}.{name}', parameter.value))
    values['faults'] = _joined(result.faults)
    values['warnings'] = _joined(result.warnings)
    return values


def _cells(column: str, value: float | str | tuple[float, ...]) -> dict[str, Value]:
    if isinstance(value, str):
        return {column: value}
    if isinstance(value, tuple):
        return {f'{column}.{i}': _number(x) for i, x in enumerate(value, 1)}
    return {column: _number(value)}


def _joined(items: Iterable[object]) -> str:
    # lines would make a table hard to read elsewhere
    return ' | '.join(' '.join(str(x).split()) for x in items)

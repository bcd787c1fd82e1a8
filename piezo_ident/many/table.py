# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Write the table of many records: one row for each record, as CSV."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
import csv
from dataclasses import dataclass, field
import io
import math
import re
from typing import Any

from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.identification.results import Identification
from piezo_ident.many.figures_of_merit import figures_of_merit
from piezo_ident.record.readings.faults import without_faults
from piezo_ident.record.record import Record

#: content of a cell
Value = str | float | int | None


@dataclass(frozen=True)
class Row:
    """Row of the table: its values by column, or the reason in one line if the record failed."""

    record: str
    values: Mapping[str, Value] = field(default_factory=dict)
    reason: str = ''

    @property
    def is_good(self) -> bool:
        """Whether the record gave a result."""
        return not self.reason


#: units of the fixed columns, in their order; '' for text and plain numbers; docs/many_records.md
#: explains the columns
COLUMNS = {
    **dict.fromkeys(('record', 'status', 'reason', 'model'), ''),
    **{'sample_rate': 'Hz', 'samples': '', 'duration': 's'},
    **{'voltage_low': 'V', 'voltage_high': 'V', 'stroke': 'm'},
    **dict.fromkeys(('method', 'verdict', 'effects', 'alike'), ''),
    **dict.fromkeys(('error_held_out', 'error_selection', 'error_fitted'), '% of stroke'),
    **dict.fromkeys(('error_before', 'error_refit', 'error_after'), '% of stroke'),
    **dict.fromkeys(('unexplained', 'noise_floor', 'smallest_detectable'), '% of stroke'),
    **{'gain': 'm/V', 'loop_width': '%'},
    **{'delay': 's', 'delay_samples': '', 'delay_std': ''},
    **{'bandwidth': 'Hz', 'resonance': 'Hz', 'resonance_peak': ''},
    **dict.fromkeys(('order_a', 'order_b', 'p1', 'p2', 'faults', 'warnings'), ''),
}
#: units of the first columns of an effect, as ``creep.share``
FOUND = {'share': '', 'rms': '% of stroke'}
#: columns behind all others
_LAST = ('faults', 'warnings')


def natural(text: str) -> tuple[tuple[int, int, str], ...]:
    """
    Make a key that sorts numbers in a text by value.

    Examples
    --------
    >>> sorted(['stage_10', 'stage_9', 'Stage'], key=natural)
    ['Stage', 'stage_9', 'stage_10']
    """
    parts = re.split(r'(\d+)', text)
    # the text itself decides between equal numbers such as 01 and 1
    key = [(1, int(p), p) if p.isdecimal() else (0, 0, p) for p in parts if p]
    return (*key, (2, 0, text))


def unit_of(column: str) -> str:
    """Find the unit of a column; '' for text, plain numbers, and parameters of effects."""
    return COLUMNS.get(column) or FOUND.get(column.partition('.')[2], '')


def columns_of(rows: Iterable[Row]) -> list[str]:
    """List the columns that these rows need, in the order of the table."""
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
    Write the table as CSV; a cell without a value is empty.

    Text that a spreadsheet would run as a formula gets a leading apostrophe.

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
    # the shortest text that gives the same number when it is read
    return '' if value is None else repr(value)


def _head(record: Record) -> dict[str, Value]:
    record = without_faults(record)
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
    """Collect the cells of an identification by their columns."""
    model = result.model
    h = model.hysteresis
    values: dict[str, Value] = {
        **_head(record),
        'method': str(model.identification['method']),
        'error_held_out': _number(result.error('held out')),
        'error_selection': _number(result.error('selection')),
        'error_fitted': _number(result.error('fitted')),
        'noise_floor': _number(result.noise_floor),
        **figures_of_merit(model),
        'delay': model.delay.total / model.sample_rate,
        'delay_samples': model.delay.total,
        'delay_std': _number(result.delay.std),
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
    """Collect the cells of a diagnosis, including those of every added effect."""
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
    # line breaks in a cell would make the table hard to read in other programs
    return ' | '.join(' '.join(str(x).split()) for x in items)

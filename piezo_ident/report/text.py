# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The result of an identification for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import textwrap

from piezo_ident.identification.results import Identification
from piezo_ident.model.free_run import sine_errors, SineError
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record
from piezo_ident.report.numbers import fit_share, KINDS, length, moves, number, verdict

__all__ = ['error_table_for_sines', 'table_one', 'text_summary']

#: [characters]
WIDTH = 99


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines; the first column stands left, the others right."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        '  '.join(
            cell.ljust(w) if i == 0 else cell.rjust(w)
            for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def printable(text: str) -> str:
    """Return text without control characters: names in files must not steer a terminal."""
    return ''.join(c if c.isprintable() else '?' for c in text)


def table_one(rows: Sequence[SineError]) -> str:
    """
    Return the errors of sines as a table, one column a frequency.

    Parameters
    ----------
    rows : sequence of SineError
        From `piezo_ident.model.free_run.sine_errors`.
    """
    if not rows:
        return 'no sine segment is long enough for its steady state'
    table = [
        ['frequency / Hz', *(f'{row.frequency:g}' for row in rows)],
        ['model with dynamics', *(number(row.percent) for row in rows)],
        ['hysteresis alone', *(number(row.static_percent) for row in rows)],
    ]
    return '\n'.join(
        [
            *columns(table),
            '% of stroke: 100 rms(y - y_hat) / (max y - min y), free run, steady state',
        ]
    )


def error_table_for_sines(model: StageModel, records: Iterable[Record] | Record) -> str:
    """
    Return the errors of a model at all sine segments of some records, as a table.

    Parameters
    ----------
    model : StageModel
    records : iterable of Record, or Record

    Raises
    ------
    ModelError
        When a piece with sines has another sampling rate than the model.
    """
    if isinstance(records, Record):
        records = [records]
    found = [row for record in records for row in sine_errors(model, record)]
    return table_one(sorted(found, key=lambda row: row.frequency))


def text_summary(identification: Identification) -> str:
    """Return the verdict, what was found, the errors and the warnings."""
    model, dynamics, delay = (
        identification.model,
        identification.dynamics,
        identification.delay,
    )
    low, high = model.scaling.range
    lines = [*textwrap.wrap(verdict(identification), WIDTH), '']
    facts = [
        ('stage', f'{length(identification.stroke)} over {low:g} .. {high:g} V'),
        *([('direction', 'retracts with rising voltage')] if model.scaling.Y < 0.0 else []),
        ('rate', f'{model.sample_rate:g} Hz'),
        ('delay', f'{delay.samples} samples ({delay.source})'),
        ('dynamics', f'na = {dynamics.order[0]}, nb = {dynamics.order[1]}'),
        ('hysteresis', f'{model.hysteresis.thresholds.size} thresholds'),
    ]
    missing = dict(identification.not_identified)
    facts = [(what, 'not identified' if what in missing else said) for what, said in facts]
    if identification.noise_floor is None:
        facts.append(('sensor noise', printable(identification.noise_source)))
    else:
        facts.append(('sensor noise', f'{number(identification.noise_floor)} % of stroke rms'))
    lines += [f'{what:<14}{said}' for what, said in facts]
    table = [['error / % of stroke', 'model', 'hysteresis alone', 'NRMSE fit / %', 'samples']]
    for kind in KINDS:
        # what rests or only moves over comes last
        for row in sorted(identification.errors, key=lambda row: not moves(row.segment)):
            if row.data == kind:
                name = printable(' '.join(filter(None, (row.record, row.segment))))
                table.append(
                    [
                        f'{name}, {kind}',
                        number(row.percent),
                        number(row.static_percent),
                        fit_share(row),
                        str(row.n),
                    ]
                )
    lines += ['', *columns(table)]
    for what, why in identification.not_identified:
        lines += _item(f'not identified: {printable(what)}: {printable(why)}')
    for said in identification.warnings:
        lines += _item(f'warning: {printable(said)}')
    return '\n'.join(lines)


def _item(text: str) -> list[str]:
    return ['', *textwrap.wrap(text, WIDTH, subsequent_indent='  ')]

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``--each``: process every record on its own, and write a table of all records."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import statistics
import sys
from types import SimpleNamespace

from piezo_ident.cli.console import Console
from piezo_ident.cli.files import check_bag_options, expand, options_of
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.files import write_text
from piezo_ident.diagnosis.results import DiagnosisSettings
from piezo_ident.identification.settings import Settings
from piezo_ident.many.outliers import stand_out
from piezo_ident.many.run import Diagnose, Identify, run_many, Task
from piezo_ident.many.table import columns_of, csv_text, Row, unit_of, Value
from piezo_ident.model.files import load
from piezo_ident.report.table import plain_text, table

#: most failed records that are printed
PRINTED = 10
#: columns whose spread is printed
SPREAD = (
    *('error_held_out', 'error_before', 'error_after', 'unexplained'),
    *('stroke', 'gain', 'loop_width', 'delay', 'bandwidth', 'resonance'),
)
#: units for people, with the factor from the unit of the table
UNITS = {'stroke': ('µm', 1e6), 'gain': ('µm/V', 1e6), 'delay': ('ms', 1e3)}


def check_each(args: SimpleNamespace) -> None:
    """Refuse options that need --each without it, and options that exclude it."""
    if args.each is None:
        for option in ('jobs', 'scheduler', 'reports'):
            if getattr(args, option):
                raise ConfigError(f'--{option} goes with --each DIR; add it, or leave this out')
        return
    for option in ('model', 'report', 'validation', 'overwrite'):
        if getattr(args, option):
            raise ConfigError(f'--{option} does not go with --each')
    if args.jobs == 0:
        raise ConfigError('--jobs 0: give at least 1')


def identify_each(args: SimpleNamespace, settings: Settings, console: Console) -> None:
    """Run ``piezo_ident identify RECORD... --each DIR``."""
    _each(args, Identify(settings, options_of(args)), console)


def diagnose_each(args: SimpleNamespace, settings: DiagnosisSettings, console: Console) -> None:
    """Run ``piezo_ident diagnose MODEL RECORD... --each DIR``."""
    if not args.model_file.is_dir():
        # a bad model is a single error, instead of an error for each record
        load(args.model_file)
    _each(args, Diagnose(args.model_file.absolute(), settings, options_of(args)), console)


def _each(args: SimpleNamespace, task: Task, console: Console) -> None:
    paths = expand(args.records, console)
    check_bag_options(paths, args)
    folder: Path = args.each
    with console.progress() as progress:

        def show(done: int, of: int, row: Row | None) -> None:
            progress('records', done / of)
            # without a terminal a line replaces the bar
            if row and not sys.stderr.isatty():
                console.say(f'{done} of {of}: {row.record}{"" if row.is_good else " failed"}')
                sys.stdout.flush()

        rows = run_many(
            paths,
            folder,
            task,
            reports=args.reports,
            jobs=args.jobs,
            scheduler=args.scheduler,
            progress=show,
        )
    place = folder / 'records.csv'
    write_text(place, csv_text(rows))
    bad = [row for row in rows if not row.is_good]
    if len(bad) == len(rows):
        raise DataError(
            f'none of {len(rows)} records gave a result, see {place}; the first: '
            f'{bad[0].record}: {bad[0].reason}'
        )
    odd = _print(rows, bad, console)
    console.say(f'\nmodels and table: {folder}')
    console.result(
        {
            'records': len(rows),
            'failed': len(bad),
            'units': {name: unit_of(name) for name in columns_of(rows) if unit_of(name)},
            'stand_out': {name: list(columns) for name, columns in odd.items()},
            'rows': [
                {'record': row.record, 'reason': row.reason or None, **row.values} for row in rows
            ],
            'files': {'folder': str(folder), 'table': str(place)},
        }
    )


def _told(row: Row) -> tuple[str, str]:
    """Name the columns of a verdict; a refit shows the effects that may hide in it."""
    return 'verdict', 'alike' if row.values.get('verdict') == 'refitted' else 'effects'


def _print(
    rows: Sequence[Row], bad: Sequence[Row], console: Console
) -> dict[str, dict[str, float]]:
    """Print a summary of all records; return the outliers."""
    console.say(f'{len(rows) - len(bad)} of {len(rows)} records done; {len(bad)} failed')
    for row in bad[:PRINTED]:
        console.say(f'  {row.record}: {row.reason}')
    if len(bad) > PRINTED:
        console.say(f'  and {len(bad) - PRINTED} more')
    verdicts = [
        ' '.join(str(row.values.get(key) or '') for key in _told(row)).strip()
        for row in rows
        if row.values.get('verdict')
    ]
    for verdict in sorted(set(verdicts), key=lambda v: -verdicts.count(v)):
        console.say(f'  {verdict}: {verdicts.count(verdict)}')
    numbers = {
        column: [x for row in rows if isinstance(x := row.values.get(column), (int, float))]
        for column in SPREAD
    }
    spread = [
        (
            column.replace('_', ' '),
            _unit(column),
            *(_shown(column, f(x)) for f in (min, statistics.median, max)),
        )
        for column, x in numbers.items()
        if x
    ]
    console.say()
    console.say(plain_text(table('Spread', ('', 'unit', 'lowest', 'median', 'highest'), spread)))
    odd = stand_out(rows)
    if odd:
        console.say('\nThese stand out, with the median of all in brackets:')
    values = {row.record: row.values for row in rows}
    for record in list(odd)[:PRINTED]:
        texts = [
            f'{column.replace("_", " ")} {_shown(column, values[record][column])} '
            f'{_unit(column)} ({_shown(column, median)})'.replace('  ', ' ')
            for column, median in odd[record].items()
        ]
        console.say(f'  {record}: {", ".join(texts)}')
    if len(odd) > PRINTED:
        console.say(f'  and {len(odd) - PRINTED} more')
    return odd


def _unit(column: str) -> str:
    """Name the unit of a column for people."""
    return UNITS.get(column, (unit_of(column), 1.0))[0]


def _shown(column: str, value: Value) -> str:
    """Write a number in the unit for people."""
    return f'{UNITS.get(column, ("", 1.0))[1] * float(value or 0.0):.4g}'

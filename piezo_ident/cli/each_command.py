# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``--each``: process every record on its own, and write a table of all records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
import statistics
import sys
from types import SimpleNamespace

from piezo_ident.cli.console import Console
from piezo_ident.cli.files import check_bag_options, expand, options_of
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.files import write_text
from piezo_ident.diagnosis.results import DiagnosisSettings
from piezo_ident.identification.results import Settings
from piezo_ident.many.outliers import stand_out
from piezo_ident.many.run import Diagnose, Identify, run_many, Task
from piezo_ident.many.table import columns_of, csv_text, Row, unit_of
from piezo_ident.model.files import load

#: most failed records that are printed
PRINTED = 10
#: columns whose spread is printed: name, unit for people, and factor from the unit of the table
SPREAD = {
    'error_held_out': ('held-out error', '% of stroke', 1.0),
    'error_before': ('error before', '% of stroke', 1.0),
    'error_after': ('error after', '% of stroke', 1.0),
    'unexplained': ('unexplained', '% of stroke', 1.0),
    'stroke': ('stroke', 'µm', 1e6),
    'gain': ('gain', 'µm/V', 1e6),
    'loop_width': ('loop width', '% of stroke', 1.0),
    'delay': ('delay', 'ms', 1e3),
    'bandwidth': ('bandwidth', 'Hz', 1.0),
    'resonance': ('resonance', 'Hz', 1.0),
}
#: further columns in which a record may stand out
OTHERS = {
    'sample_rate': ('sampling rate', 'Hz', 1.0),
    'duration': ('duration', 's', 1.0),
    'voltage_high': ('highest voltage', 'V', 1.0),
    'delay_samples': ('delay', 'samples', 1.0),
    'error_fitted': ('fitted error', '% of stroke', 1.0),
    'noise_floor': ('noise floor', '% of stroke', 1.0),
}


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
    table = folder / 'records.csv'
    write_text(table, csv_text(rows))
    bad = [row for row in rows if not row.is_good]
    if len(bad) == len(rows):
        raise DataError(
            f'none of {len(rows)} records gave a result, see {table}; the first: '
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
            'files': {'folder': str(folder), 'table': str(table)},
        }
    )


def _told(row: Row) -> tuple[str, str]:
    """Name the columns of a verdict; a refit shows the effects that may hide in it."""
    return 'verdict', 'alike' if row.values.get('verdict') == 'refitted' else 'effects'


def _print(
    rows: Sequence[Row], bad: Sequence[Row], console: Console
) -> dict[str, dict[str, float]]:
    """Print a summary of all records; return the records that stand out."""
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
    console.say(f'\n{"":30s}{"lowest":>11s}{"median":>11s}{"highest":>11s}')
    for column, (name, unit, factor) in SPREAD.items():
        values = [x for row in rows if isinstance(x := row.values.get(column), (int, float))]
        if values:
            numbers = (factor * f(values) for f in (min, statistics.median, max))
            cells = ''.join(f'{x:11.4g}' for x in numbers)
            console.say(f'{f"{name} / {unit}":30s}{cells}')
    odd = stand_out(rows)
    _print_odd(rows, odd, console)
    return odd


def _print_odd(
    rows: Sequence[Row], odd: Mapping[str, Mapping[str, float]], console: Console
) -> None:
    of, columns = {row.record: row for row in rows}, {**SPREAD, **OTHERS}
    if odd:
        console.say('\nThese stand out, with the median of all in brackets:')
    for record in list(odd)[:PRINTED]:
        told = []
        for column, median in odd[record].items():
            name, unit, factor = columns[column]
            here = factor * float(of[record].values[column] or 0.0)
            told.append(f'{name} {here:.4g} {unit} ({factor * median:.4g})')
        console.say(f'  {record}: {", ".join(told)}')
    if len(odd) > PRINTED:
        console.say(f'  and {len(odd) - PRINTED} more')

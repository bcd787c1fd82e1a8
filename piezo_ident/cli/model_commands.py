# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``identify`` and ``predict``: the verbs that make and use a model."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from piezo_ident.cli.console import Console, deferred_interrupts
from piezo_ident.cli.each_command import check_each, identify_each
from piezo_ident.cli.outputs import check_distinct, check_file, check_folder, check_suffix
from piezo_ident.cli.records import (
    data_of,
    expand_apart,
    given,
    naming,
    print_faults,
    read_all,
    RECORD_FILES,
)
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.files import temporary_output
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.identification.identify import identify
from piezo_ident.identification.results import Identification, Settings
from piezo_ident.model.files import load
from piezo_ident.model.free_run import free_run, FreeRun, FreeRunErrors, predict
from piezo_ident.model.metrics import FORMULA
from piezo_ident.model.sines import sine_errors
from piezo_ident.record.io import WRITERS
from piezo_ident.record.record import Record
from piezo_ident.record.tables import blocks_of

__all__ = [
    'check_order',
    'checked',
    'identify_command',
    'keep',
    'predict_command',
    'print_files',
    'read_both',
]

MODEL_FILES = ('.yaml', '.yml')
TABLE_FILES = ('.csv', '.npz')
PICTURES = ('.png', '.pdf', '.svg')


def identify_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident identify``."""
    check_each(args)
    settings = Settings(**given(args, Settings))
    if args.each is not None:
        identify_each(args, settings, console)
        return
    from piezo_ident import report

    paths, further = checked(args, Identification, console)
    records, validation = read_both(paths, further, args)
    with naming(*(record.name for record in records)), console.progress() as progress:
        result = identify(records, settings, validation=validation, progress=progress)
    keep(result, args)
    console.say(report.identification_text(result))
    checks = []
    for record in validation:
        run = free_run(result.model, record)
        sines = sine_errors(result.model, record) if record.find('sine') else ()
        checks.append(
            {**_error_data(run), 'record': record.name, 'sines': list(map(asdict, sines))}
        )
        console.say(f'\n{record.name}, not fitted:')
        _print_errors(run, console)
        if sines:
            console.say(f'\n{report.table_one(sines)}')
    files = print_files(args, console)
    console.result({**report.to_json(result), 'validation': checks, 'files': files})


def checked(
    args: SimpleNamespace, kind: type, console: Console, *others: Path
) -> tuple[list[Path], list[Path]]:
    """Return the records for the work and for validation; refuse outputs before the work."""
    from piezo_ident.report import check_report_folder

    paths, further = expand_apart(args.records, args.validation, console)
    inputs = [*others, *paths, *further]
    if args.report is not None:
        check_folder(args.report)
    if args.model is not None:
        check_suffix(args.model, MODEL_FILES, 'a model')
        check_distinct(args.model, inputs)
        # a report makes its folder first
        if args.model.parent != args.report or args.report.is_dir():
            check_file(args.model, overwrite=args.overwrite)
    if args.report is not None:
        other = 'diagnosis' if kind is Identification else 'identification'
        if (args.report / f'{other}.json').exists():
            raise ConfigError(f'{args.report}: holds the report of {other}; choose another folder')
        for name in ('model.yaml', 'diagnosis.json', 'report.html'):
            check_distinct(args.report / name, inputs)
        check_report_folder(args.report, kind)
        if (args.report / 'report.html').exists() and not args.overwrite:
            raise DataError(
                f'{args.report}: holds a report already; choose another folder or add --overwrite'
            )
    return paths, further


def read_both(
    paths: Sequence[Path], further: Sequence[Path], args: SimpleNamespace
) -> tuple[list[Record], list[Record]]:
    """Read records and those for validation as the records of one call."""
    everything = read_all([*paths, *further], args)
    return everything[: len(paths)], everything[len(paths) :]


def keep(result: Identification | Diagnosis, args: SimpleNamespace) -> None:
    """Write report and model where the arguments say."""
    from piezo_ident.report import write_report

    with deferred_interrupts() as check:
        if args.report is not None:
            write_report(result, args.report, progress=check)
        if args.model is not None:
            result.model.save(args.model)


def print_files(args: SimpleNamespace, console: Console, note: str = '') -> dict[str, Any]:
    """Print where model and report are, and return that for programs."""
    page = None if args.report is None else str(args.report / 'report.html')
    console.say()
    if args.model is not None:
        console.say(f'model: {args.model}{note}')
    if page is not None:
        console.say(f'report: {page}')
    if args.model is None and page is None:
        console.say('nothing was written; --model YAML keeps the model, --report DIR the report')
    return {'model': None if args.model is None else str(args.model), 'report': page}


def predict_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident predict``."""
    for path, suffixes, what in (
        (args.out, TABLE_FILES, 'a prediction'),
        (args.plot, PICTURES, 'a picture'),
    ):
        if path is not None:
            check_suffix(path, suffixes, what)
            check_distinct(path, [args.model, args.record])
            check_file(path, overwrite=args.overwrite)
    check_order(args.model, args.record, 'predict')
    model = load(args.model)
    (record,) = read_all([args.record], args, voltage_alone=True)
    data: dict[str, Any] = {'model': str(args.model)}
    if record.is_measured:
        with naming(str(args.model)):
            run = free_run(model, record)
        # without faulty samples
        record, pieces = run.record, run.pieces
        console.say(f'{args.model} on {record.name}, free run:')
        _print_errors(run, console)
        data |= _error_data(run)
        if args.plot is not None:
            from piezo_ident.report import save_plot

            with deferred_interrupts():
                save_plot(run, args.plot)
    else:
        if args.plot is not None:
            raise ConfigError(
                f'{record.name}: has no displacement to compare with; leave out --plot'
            )
        with naming(str(args.model)):
            pieces = predict(model, record)
        warnings = model.extrapolation(record)
        console.say(f'{args.model} on {record.name}, which has no displacement: no error is known')
        for warning in warnings:
            console.say(f'  warning: {warning}')
        data['warnings'] = list(warnings)
    if args.out is not None:
        with deferred_interrupts():
            _write_prediction(record, pieces, args.out)
    print_faults(record, (), console)
    for path in filter(None, (args.out, args.plot)):
        console.say(f'wrote {path}')
    files = {key: path and str(path) for key, path in (('out', args.out), ('plot', args.plot))}
    console.result({**data, **data_of(record), **files})


def _write_prediction(record: Record, pieces: Sequence[NDArray[np.float64]], path: Path) -> None:
    blocks = blocks_of(record, y_hat=pieces)

    def columns() -> Iterator[dict[str, NDArray[np.float64]]]:
        for block in blocks():
            yield {k: x for k, x in block.items() if k != 'y' or record.is_measured}

    with temporary_output(path, overwrite=True) as target, target.open('xb') as file:
        WRITERS[path.suffix.lower()](file, columns, (), ())


def check_order(model: Path, record: Path, verb: str) -> None:
    """Refuse a model and a record in the wrong order."""
    order = f'MODEL comes first: piezo_ident {verb} model.yaml record.csv'
    if model.suffix.lower() in RECORD_FILES or model.is_dir():
        raise ConfigError(f'{model}: is a record, no model file; {order}')
    if record.suffix.lower() in MODEL_FILES:
        raise ConfigError(f'{record}: is no record; {order}')


def _print_errors(run: FreeRun, console: Console) -> None:
    from piezo_ident.report import length

    rows = [('whole record', run.errors)]
    if any(run.estimated):
        if run.errors_after_start is None:
            console.say('  no sample at which the start is forgotten: drive a wider range')
        else:
            rows.append(('start forgotten', run.errors_after_start))
    for name, e in rows:
        console.say(
            f'  {name:16s} {e.percent:8.3g} % of stroke   fit {e.fit:8.3f} %   {e.n} samples'
        )
        if e.mostly_offset:
            console.say(
                f'  {"":16s} {e.percent_without_offset:8.3g} % after removing a mean of '
                f'{length(e.offset)}: the sensor was set to zero elsewhere'
            )
    console.say(f'  % of stroke = {FORMULA}; fit = 100 (1 - |y - y_hat| / |y - mean y|)')
    for warning in run.warnings:
        console.say(f'  warning: {warning}')


def _error_data(run: FreeRun) -> dict[str, Any]:
    def row(errors: FreeRunErrors) -> dict[str, Any]:
        return {
            'percent_of_stroke': errors.percent,
            'fit_percent': errors.fit,
            'n': errors.n,
            'offset': errors.offset,
            'percent_of_stroke_without_offset': errors.percent_without_offset,
        }

    late = run.errors_after_start
    return {
        'formula': FORMULA,
        'whole': row(run.errors),
        'start_forgotten': None if late is None else row(late),
        'memory_estimated': list(run.estimated),
        'warnings': list(run.warnings),
    }

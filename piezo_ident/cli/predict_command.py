# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``predict``: a model over a record, or over a voltage alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from piezo_ident.cli.console import Console, deferred_interrupts
from piezo_ident.cli.outputs import check_table_and_picture
from piezo_ident.cli.records import check_order, data_of, print_faults, read_all
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ConfigError, naming
from piezo_ident.model.files import load
from piezo_ident.model.free_run import free_run, FreeRun, FreeRunErrors, predict
from piezo_ident.model.initial_memory import unknown_starts
from piezo_ident.model.metrics import FORMULA
from piezo_ident.record.io import write_columns
from piezo_ident.record.record import Record
from piezo_ident.record.tables import blocks_of


def predict_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident predict``."""
    check_table_and_picture(
        args.out,
        'a prediction',
        args.plot,
        inputs=(args.model, args.record),
        overwrite=args.overwrite,
    )
    check_order(args.model, args.record, 'predict')
    model = load(args.model)
    (record,) = read_all([args.record], args, console, voltage_alone=True)
    data: dict[str, Any] = {'model': str(args.model)}
    if record.is_measured:
        with naming(str(args.model)):
            run = free_run(model, record)
        # without faulty samples
        record, pieces = run.record, run.pieces
        console.say(f'{args.model} on {record.name}, free run:')
        print_errors(run, console)
        lost = record.n - run.errors.n
        if lost and args.out is not None:
            console.say(f'  {lost} readings are left out: y is nan there in {args.out}')
        data |= error_data(run)
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
        warnings = (*unknown_starts(model, record), *model.extrapolation(record))
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


def _write_prediction(record: Record, pieces: Sequence[Array], path: Path) -> None:
    # nothing that stands in for a reading is written as one
    blocks = blocks_of(record, y=[piece.measured for piece in record], y_hat=pieces)

    def columns() -> Iterator[dict[str, Array]]:
        for block in blocks():
            yield {k: x for k, x in block.items() if k != 'y' or record.is_measured}

    write_columns(path, columns)


def print_errors(run: FreeRun, console: Console) -> None:
    """Print the errors of a free run, and what it warns of."""
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
            from piezo_ident.report import length

            console.say(
                f'  {"":16s} {e.percent_without_offset:8.3g} % after removing a mean of '
                f'{length(e.offset)}'
                + (': the sensor was set to zero elsewhere' if e.only_offset else '')
            )
    console.say(f'  % of stroke = {FORMULA}; fit = 100 (1 - |y - y_hat| / |y - mean y|)')
    for warning in run.warnings:
        console.say(f'  warning: {warning}')


def error_data(run: FreeRun) -> dict[str, Any]:
    """Return the errors of a free run for programs."""

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

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``predict``: a model over a record, or over a voltage alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from piezo_ident.cli.console import Console, deferred_interrupts
from piezo_ident.cli.outputs import check_table_and_picture
from piezo_ident.cli.records import check_order, data_of, print_faults, read_all
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ConfigError, naming
from piezo_ident.model.free_run import FreeRun, FreeRunErrors
from piezo_ident.model.metrics import FORMULA
from piezo_ident.model.multi_axis import EachAxis, load, voltage_of
from piezo_ident.record.io import write_columns
from piezo_ident.record.record import Record
from piezo_ident.record.tables import blocks_of
from piezo_ident.verbs.use import free_run, predict, prediction_doubts


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
    # nothing that stands in for a reading is written as one
    columns: dict[str, Sequence[Array]] = {}
    if record.is_measured:
        with naming(str(args.model)):
            run = free_run(model, record)
        console.say(f'{args.model} on {record.name}, free run:')
        data |= print_run(run, console)
        runs = {**run} if isinstance(run, EachAxis) else {'y': run}
        lost = sum(x.record.n - x.errors.n for x in runs.values())
        if lost and args.out is not None:
            console.say(f'  {lost} readings are left out: y is nan there in {args.out}')
        # without faulty samples
        record = runs['y'].record if isinstance(run, FreeRun) else record
        pieces = {axis: x.pieces for axis, x in runs.items()}
        for axis, x in runs.items():
            columns[axis] = [piece.measured for piece in x.record]
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
            made = predict(model, record)
        pieces = {**made} if isinstance(made, EachAxis) else {'y': made}
        warnings = prediction_doubts(model, record)
        console.say(f'{args.model} on {record.name}, which has no displacement: no error is known')
        for warning in warnings:
            console.say(f'  warning: {warning}')
        data['warnings'] = list(warnings)
    if args.out is not None:
        with deferred_interrupts():
            for axis, parts in pieces.items():
                if axis != 'y':
                    v = voltage_of(axis)
                    columns[v] = [piece.channels[v] for piece in record]
                columns[f'y_hat{axis[1:]}'] = parts
            _write_prediction(record, columns, args.out)
    print_faults(record, (), console)
    for path in filter(None, (args.out, args.plot)):
        console.say(f'wrote {path}')
    files = {key: path and str(path) for key, path in (('out', args.out), ('plot', args.plot))}
    console.result({**data, **data_of(record), **files})


def _write_prediction(record: Record, columns: Mapping[str, Sequence[Array]], path: Path) -> None:
    blocks = blocks_of(record, **columns)

    def known() -> Iterator[dict[str, Array]]:
        for block in blocks():
            yield {k: x for k, x in block.items() if k != 'y' or record.is_measured}

    write_columns(path, known)


def print_run(run: FreeRun | EachAxis[FreeRun], console: Console) -> dict[str, Any]:
    """Print the errors of a free run, of each axis where there are several, and return them."""
    if not isinstance(run, EachAxis):
        print_errors(run, console)
        return error_data(run)
    for axis, x in run.items():
        console.say(f' axis {axis}:')
        print_errors(x, console)
    return {'axes': {axis: error_data(x) for axis, x in run.items()}}


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

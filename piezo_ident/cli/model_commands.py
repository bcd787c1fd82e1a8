# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``identify`` and ``predict``: the verbs that make and use a model."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from piezo_ident.cli.common import (
    expand_apart,
    naming,
    read,
    read_all,
    RECORD_FILES,
    say_faults,
    story,
)
from piezo_ident.cli.console import Console
from piezo_ident.cli.each_command import check_each, identify_each
from piezo_ident.cli.interrupts import interrupts
from piezo_ident.cli.outputs import check_distinct, check_file, check_folder, check_suffix
from piezo_ident.common.errors import ConfigError
from piezo_ident.common.files import temporary_output
from piezo_ident.identification.identify import identify
from piezo_ident.identification.results import Identification, Settings
from piezo_ident.model.files import load
from piezo_ident.model.free_run import free_run, FreeRun
from piezo_ident.model.metrics import FORMULA
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record
from piezo_ident.record.tables import blocks_of, WRITERS

__all__ = ['MODEL_FILES', 'check_order', 'identify_command', 'predict_command']

MODEL_FILES = ('.yaml', '.yml')
TABLE_FILES = ('.csv', '.npz')
PICTURES = ('.png', '.pdf', '.svg')


def identify_command(args: argparse.Namespace, console: Console) -> None:
    """``piezo_ident identify``."""
    check_each(args)
    settings = Settings(
        thresholds=args.thresholds,
        solver=args.solver,
        polish=args.polish,
        max_order=args.max_order,
        order=args.order,
        delay=args.delay,
        hold_out=args.hold_out,
        seed=args.seed,
    )
    if args.each is not None:
        identify_each(args, settings, console)
        return
    paths, further = expand_apart(args.records, args.validation, console)
    if args.model is not None:
        check_suffix(args.model, MODEL_FILES, 'a model')
        if args.model.parent == args.report:
            # the report makes the folder first
            check_folder(args.report)
        else:
            check_file(args.model, overwrite=True)
        check_distinct(args.model, [*paths, *further])
    if args.report is not None:
        check_folder(args.report)
        if (args.report / 'diagnosis.json').exists():
            raise ConfigError(
                f'{args.report}: holds the report of a diagnosis; choose another folder'
            )
        with interrupts.quitting():
            from piezo_ident.report import check_report_folder
        check_report_folder(args.report, Identification)
    everything = read_all([*paths, *further], args)
    records, validation = everything[: len(paths)], everything[len(paths) :]
    with naming(*(record.name for record in records)), console.progress() as progress:
        result = identify(records, settings, validation=validation, progress=progress)
    checks = [_validate(result.model, record) for record in validation]

    with interrupts.quitting():
        from piezo_ident import report

    page = None
    with interrupts.waiting():
        if args.report is not None:
            page = report.write_report(
                result,
                args.report,
                progress=lambda step, share: interrupts.check(),
            )
        if args.model is not None:
            result.model.save(args.model)
    console.say(report.identification_text(result))
    for check in checks:
        console.say()
        console.say('\n'.join(check.text))
    if args.model is not None:
        console.say(f'\nmodel: {args.model}')
    if page is not None:
        console.say(f'report: {page}')
    if args.model is None and page is None:
        console.say(
            '\nnothing was written; --model model.yaml keeps the model, --report DIR the tables '
            'and pictures'
        )
    console.result(
        {
            **report.to_json(result),
            'validation': [check.data for check in checks],
            'files': {
                'model': None if args.model is None else str(args.model),
                'report': None if page is None else str(page),
            },
        }
    )


class _Check:
    """What a record that was not fitted says about a model, as text and as data."""

    def __init__(self, text: list[str], data: Mapping[str, Any]) -> None:
        self.text, self.data = text, data


def _validate(model: StageModel, record: Record) -> _Check:
    from piezo_ident.model.free_run import sine_errors
    from piezo_ident.report import table_one

    run = free_run(model, record)
    text = [f'{record.name}, not fitted:', *_error_lines(run)]
    sines = sine_errors(model, record) if record.find('sine') else ()
    if sines:
        text += ['', *table_one(sines).splitlines()]
    data = {
        **_error_data(run),
        'record': record.name,
        'sines': [asdict(row) for row in sines],
    }
    return _Check(text, data)


def predict_command(args: argparse.Namespace, console: Console) -> None:
    """``piezo_ident predict``."""
    for path, suffixes, what in (
        (args.out, TABLE_FILES, 'a prediction'),
        (args.plot, PICTURES, 'a picture'),
    ):
        if path is not None:
            check_suffix(path, suffixes, what)
            check_file(path, overwrite=True)
            check_distinct(path, [args.model, args.record])
    check_order(args.model, args.record, 'predict')
    model = load(args.model)
    record = read(args.record, args)
    with naming(str(args.model)):
        run = free_run(model, record)
    record = run.record
    if args.out is not None:
        with (
            interrupts.waiting(),
            temporary_output(args.out, overwrite=True) as target,
            target.open('xb') as file,
        ):
            rows = blocks_of(record, y_hat=run.pieces)
            WRITERS[args.out.suffix.lower()](file, rows, (), ())
    if args.plot is not None:
        from piezo_ident.report import save_plot

        with interrupts.waiting():
            save_plot(run, args.plot)
    console.say(f'{args.model} on {record.name}, free run:')
    console.say('\n'.join(_error_lines(run)))
    say_faults(record, (), console)
    for path in (args.out, args.plot):
        if path is not None:
            console.say(f'wrote {path}')
    console.result(
        {
            'model': str(args.model),
            **story(record, ()),
            **_error_data(run),
            'out': None if args.out is None else str(args.out),
            'plot': None if args.plot is None else str(args.plot),
        }
    )


def check_order(model: Path, record: Path, verb: str) -> None:
    """
    Refuse a model and a record in the wrong order.

    Raises
    ------
    ConfigError
    """
    order = f'MODEL comes first: piezo_ident {verb} model.yaml record.csv'
    if model.suffix.lower() in RECORD_FILES or model.is_dir():
        raise ConfigError(f'{model}: is a record, no model file; {order}')
    if record.suffix.lower() in MODEL_FILES:
        raise ConfigError(f'{record}: is no record; {order}')


def _error_lines(run: FreeRun) -> list[str]:
    from piezo_ident.report import length

    lines = []
    rows = [('whole record', run.errors)]
    if any(run.estimated):
        if run.errors_after_start is None:
            lines.append('  no sample at which the start is forgotten: drive a wider range')
        else:
            rows.append(('start forgotten', run.errors_after_start))
    centred = [
        f', {e.percent_without_offset:.3g} % after removing a mean of {length(e.offset)}'
        if e.mostly_offset
        else ''
        for _, e in rows
    ]
    width = max(map(len, centred))
    table = [
        f'  {name:16s} {e.percent:8.3g} % of stroke{text:{width}s}   fit {e.fit:8.3f} %   '
        f'{e.n} samples'
        for (name, e), text in zip(rows, centred, strict=True)
    ]
    if width:
        lines.append('  such a mean is what a sensor shows that was set to zero elsewhere')
    return [
        *table,
        *lines,
        f'  % of stroke = {FORMULA}; fit = 100 (1 - |y - y_hat| / |y - mean y|)',
        *(f'  warning: {warning}' for warning in run.warnings),
    ]


def _error_data(run: FreeRun) -> dict[str, Any]:
    def row(errors: Any) -> dict[str, Any]:
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

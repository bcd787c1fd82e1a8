# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``identify``, and functions that ``diagnose`` uses, too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import chain
from pathlib import Path
import textwrap
from types import SimpleNamespace
from typing import Any, TYPE_CHECKING

import numpy as np
from piezo_ident import report
from piezo_ident.cli.console import Console, deferred_interrupts
from piezo_ident.cli.each_command import check_each, identify_each
from piezo_ident.cli.files import (
    check_distinct,
    check_file,
    check_folder,
    check_suffix,
    expand_apart,
    fields_of,
    MODEL_FILES,
    read_all,
)
from piezo_ident.cli.options import READING
from piezo_ident.common.errors import ConfigError, DataError, naming
from piezo_ident.identification.results import Identification
from piezo_ident.identification.settings import Settings
from piezo_ident.model.multi_axis import EachAxis
from piezo_ident.model.sines import sine_errors, SineError
from piezo_ident.record.record import Record
from piezo_ident.verbs.learn import identify
from piezo_ident.verbs.predict import free_run

if TYPE_CHECKING:
    from piezo_ident.report import Prompt
    from piezo_ident.report.folder import Results


def identify_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident identify``."""
    check_each(args)
    settings = Settings(**fields_of(args, Settings))
    if args.each is not None:
        identify_each(args, settings, console)
        return
    paths, further = checked(args, Identification, console)
    records, validation = read_both(paths, further, args, console)
    with naming(*(record.name for record in records)), console.progress() as progress:
        result = identify(records, settings, validation=validation, progress=progress)
    prompt = prompt_of(args, [*records, *validation], [*paths, *further])
    keep(result, args, prompt)
    console.say(report.identification_text(result))
    checks = []
    for record in validation:
        sines: tuple[SineError, ...] = ()
        if not isinstance(result, EachAxis) and record.find('sine'):
            sines = sine_errors(result.model, record)
        run = free_run(result.model, record)
        console.say(f'\n{run}')
        checks.append({**report.to_json(run), 'sines': list(map(asdict, sines))})
        if sines:
            console.say(f'\n{report.table_one(sines)}')
    files = print_files(result, args, console)
    steps = print_next(result, prompt, console)
    console.result({**report.to_json(result), 'validation': checks, 'files': files, 'next': steps})


def checked(
    args: SimpleNamespace, kind: type, console: Console, *others: Path
) -> tuple[list[Path], list[Path]]:
    """List the records for the work and for validation; refuse bad outputs before the work."""
    paths, further = expand_apart(args.records, args.validation, console)
    inputs = [*others, *paths, *further]
    if args.report is not None:
        check_folder(args.report)
    if args.model is not None:
        check_suffix(args.model, MODEL_FILES, 'a model')
        check_distinct(args.model, inputs)
        # a model inside the folder of the report: the report makes the folder first
        if args.model.parent != args.report or args.report.is_dir():
            check_file(args.model, overwrite=args.overwrite)
    if args.report is not None:
        other = 'diagnosis' if kind is Identification else 'identification'
        for folder in (*args.report.glob('y'), *args.report.glob('y_*'), args.report):
            if (folder / f'{other}.json').exists():
                raise ConfigError(f'{folder}: holds the report of {other}; choose another folder')
            for name in ('model.yaml', 'diagnosis.json', 'report.html'):
                check_distinct(folder / name, inputs)
            report.check_report_folder(folder, kind)
            if (folder / 'report.html').exists() and not args.overwrite:
                raise DataError(
                    f'{folder}: holds a report already; choose another folder or add --overwrite'
                )
    return paths, further


def read_both(
    paths: Sequence[Path], further: Sequence[Path], args: SimpleNamespace, console: Console
) -> tuple[list[Record], list[Record]]:
    """Read records and validation records as the records of one call."""
    everything = read_all([*paths, *further], args, console)
    return everything[: len(paths)], everything[len(paths) :]


def prompt_of(args: SimpleNamespace, records: Sequence[Record], paths: Sequence[Path]) -> Prompt:
    """Collect the names of the files of a call, for the suggested commands."""
    given = getattr(args, 'model_file', '')
    written = args.report and args.report / 'model.yaml'
    read = {x.opts[0]: getattr(args, str(x.name)) for x in READING}
    words = [[name, *_words(x)] for name, x in read.items() if x is not None]
    return report.Prompt(
        model=str(args.model or written or ('refined.yaml' if given else 'model.yaml')),
        given=str(given),
        records={x.name: str(path) for x, path in zip(records, paths, strict=True)},
        reading=tuple(chain(*words)),
    )


def _words(value: Any) -> list[str]:
    """Format the value of an option as typed on a command line."""
    if isinstance(value, Mapping):
        return [','.join(f'{key}={x}' for key, x in value.items())]
    return [f'{x:g}' if isinstance(x, float) else str(x) for x in np.atleast_1d(value).tolist()]


def print_next(result: Results, prompt: Prompt, console: Console) -> list[dict[str, str]]:
    """Print the suggested next steps with their command lines; return them for JSON."""
    steps = report.next_steps(result, prompt)
    console.say('\nnext:')
    for step in steps:
        console.say(textwrap.indent(textwrap.fill(f'{step.reason}:', 97), '  '))
        # the command stays in one line, for copying
        console.say(f'      {step.command}')
    return [asdict(step) for step in steps]


def keep(result: Results, args: SimpleNamespace, prompt: Prompt) -> None:
    """Write report and model to the places in the arguments."""
    with deferred_interrupts() as check:
        if args.report is not None:
            report.write_report(result, args.report, progress=check, prompt=prompt)
        if args.model is not None:
            result.model.save(args.model)


def print_files(
    result: Results, args: SimpleNamespace, console: Console, note: str = ''
) -> dict[str, Any]:
    """Print the places of model and reports; return them for JSON, several reports as a list."""
    axes = list(result) if isinstance(result, EachAxis) else ['']
    pages = [str(args.report / axis / 'report.html') for axis in axes if args.report is not None]
    console.say()
    if args.model is not None:
        console.say(f'model: {args.model}{note}')
    for page in pages:
        console.say(f'report: {page}')
    if args.model is None and not pages:
        console.say('nothing was written; --model YAML keeps the model, --report DIR the report')
    model = None if args.model is None else str(args.model)
    return {'model': model, 'report': pages if pages[1:] else next(iter(pages), None)}

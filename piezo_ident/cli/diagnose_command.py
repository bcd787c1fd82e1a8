# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``diagnose``: which effect does a model lack?  Add it, and say what that is worth."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from piezo_ident.cli.common import expand_apart, naming, read_all
from piezo_ident.cli.console import Console
from piezo_ident.cli.each_command import check_each, diagnose_each
from piezo_ident.cli.effects_command import effect_names
from piezo_ident.cli.interrupts import interrupts
from piezo_ident.cli.model_commands import check_order, MODEL_FILES
from piezo_ident.cli.outputs import check_distinct, check_file, check_folder, check_suffix
from piezo_ident.common.errors import ConfigError
from piezo_ident.diagnosis import diagnose, Diagnosis, DiagnosisSettings
from piezo_ident.effects import catalogue
from piezo_ident.model.files import load
from piezo_ident.model.metrics import FORMULA
from piezo_ident.report import (
    changes,
    check_report_folder,
    diagnosis_text,
    to_json,
    validated,
    write_report,
)

__all__ = ['diagnose_command']


def diagnose_command(args: argparse.Namespace, console: Console) -> None:
    """``piezo_ident diagnose``."""
    check_each(args)
    settings = _settings(args)
    if args.each is not None:
        if not args.model_file.is_dir():
            check_order(args.model_file, args.records[0], 'diagnose')
        diagnose_each(args, settings, console)
        return
    check_order(args.model_file, args.records[0], 'diagnose')
    paths, further = expand_apart(args.records, args.validation, console)
    _check_outputs(args, [args.model_file, *paths, *further])
    given = load(args.model_file)
    everything = read_all([*paths, *further], args)
    records, validation = everything[: len(paths)], everything[len(paths) :]
    for record in validation:
        # what is only looked at in the end must not fail there
        with naming(record.name):
            for piece in record:
                given.check_rate(piece)
    with (
        naming(str(args.model_file), *(record.name for record in records)),
        console.progress() as progress,
    ):
        found = diagnose(given, records, settings, progress=progress)
    found = validated(found, validation)
    page = None
    with interrupts.waiting():
        if args.report is not None:
            page = write_report(
                found,
                args.report,
                progress=lambda step, share: interrupts.check(),
            )
        if args.model is not None:
            found.model.save(args.model)
    console.say(diagnosis_text(found))
    changed = changes(given, found.model)
    _say_files(args, page, changed, console)
    console.result(
        {
            **to_json(found),
            'model_changes': list(changed),
            'validation': [{'formula': FORMULA, **asdict(x)} for x in found.unseen],
            'files': {
                'model': None if args.model is None else str(args.model),
                'report': None if page is None else str(page),
            },
        }
    )


def _settings(args: argparse.Namespace) -> DiagnosisSettings:
    only, without = effect_names(args.only), effect_names(args.without)
    if not set(only or catalogue()) - set(without):
        raise ConfigError('--only and --without leave no candidate; name one that is not in both')
    return DiagnosisSettings(
        effects=only or None,
        without=without,
        most_effects=args.most_effects,
        most_samples=args.most_samples,
        seed=args.seed,
    )


def _check_outputs(args: argparse.Namespace, inputs: Sequence[Path]) -> None:
    if args.model is not None:
        check_suffix(args.model, MODEL_FILES, 'a model')
        if args.model.parent == args.report:
            # the report makes the folder first
            check_folder(args.report)
        else:
            check_file(args.model, overwrite=True)
        check_distinct(args.model, inputs)
    if args.report is not None:
        check_folder(args.report)
        if (args.report / 'identification.json').exists():
            raise ConfigError(
                f'{args.report}: holds the report of an identification; choose another folder'
            )
        for name in ('model.yaml', 'diagnosis.json', 'report.html'):
            check_distinct(args.report / name, inputs)
        check_report_folder(args.report, Diagnosis)


def _say_files(
    args: argparse.Namespace, page: Path | None, changed: Sequence[str], console: Console
) -> None:
    if args.model is not None:
        how = ', '.join(changed) if changed else f'the same as {args.model_file}, nothing changed'
        console.say(f'\nmodel: {args.model} ({how})')
    if page is not None:
        console.say(f'{"" if args.model else chr(10)}report: {page}')
    if args.model is None and page is None:
        console.say(
            '\nnothing was written; --model refined.yaml keeps the refined model, --report DIR the'
            ' tables and pictures'
        )

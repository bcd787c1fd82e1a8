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
from piezo_ident.diagnosis import diagnose, DiagnosisSettings
from piezo_ident.diagnosis.diagnosis_json import to_json
from piezo_ident.effects import catalogue
from piezo_ident.model.files import load
from piezo_ident.model.free_run import free_run, sine_errors
from piezo_ident.model.metrics import FORMULA
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record
from piezo_ident.report import (
    changes,
    check_diagnosis_folder,
    diagnosis_summary,
    Unseen,
    write_diagnosis_report,
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
    unseen = [_unseen(given, found.model, record) for record in validation]
    page = None
    with interrupts.waiting():
        if args.report is not None:
            page = write_diagnosis_report(
                found,
                args.report,
                unseen=unseen,
                progress=lambda step, share: interrupts.check(),
            )
        if args.model is not None:
            found.model.save(args.model)
    console.say(diagnosis_summary(found, unseen))
    changed = changes(given, found.model)
    _say_files(args, page, changed, console)
    console.result(
        {
            **to_json(found),
            'model_changes': list(changed),
            'validation': [{'formula': FORMULA, **asdict(x)} for x in unseen],
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
        check_diagnosis_folder(args.report)


def _unseen(given: StageModel, refined: StageModel, record: Record) -> Unseen:
    """Return the errors of both models on a record that took no part in the diagnosis."""
    runs = [free_run(model, record) for model in (given, refined)]
    before, after = (run.errors_after_start or run.errors for run in runs)
    sines = zip(*(sine_errors(model, record) for model in (given, refined)), strict=True)
    return Unseen(
        record=record.name,
        before=before.percent,
        after=after.percent,
        before_centred=before.percent_without_offset,
        after_centred=after.percent_without_offset,
        n=after.n,
        sines=tuple((a.frequency, a.percent, b.percent) for a, b in sines),
    )


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

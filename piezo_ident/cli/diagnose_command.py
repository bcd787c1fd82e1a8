# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``diagnose``: find the effect that a model lacks, and measure its benefit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from types import SimpleNamespace

from piezo_ident.cli.console import Console
from piezo_ident.cli.each_command import check_each, diagnose_each
from piezo_ident.cli.effects_command import effect_names
from piezo_ident.cli.files import check_order, fields_of
from piezo_ident.cli.identify_command import (
    checked,
    keep,
    print_files,
    print_next,
    prompt_of,
    read_both,
)
from piezo_ident.common.errors import ConfigError, naming
from piezo_ident.diagnosis import Diagnosis, DiagnosisSettings
from piezo_ident.effects import catalogue
from piezo_ident.model.axes_file import load
from piezo_ident.model.metrics import FORMULA
from piezo_ident.model.multi_axis import EachAxis, mapped, models_of
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record
from piezo_ident.report import diagnosis_text, to_json, validated
from piezo_ident.verbs.learn import diagnose


def diagnose_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident diagnose``."""
    check_each(args)
    settings = _settings(args)
    if args.each is None or not args.model_file.is_dir():
        check_order(args.model_file, args.records[0], 'diagnose')
    if args.each is not None:
        diagnose_each(args, settings, console)
        return
    paths, further = checked(args, Diagnosis, console, args.model_file)
    model = load(args.model_file)
    records, validation = read_both(paths, further, args, console)
    for record in validation:
        # a wrong rate is refused before the long work
        with naming(record.name):
            for piece in record:
                model.check_rate(piece)
    with (
        naming(str(args.model_file), *(record.name for record in records)),
        console.progress() as progress,
    ):
        diagnosis = diagnose(model, records, settings, progress=progress)
    diagnosis = validated(diagnosis, validation)
    of_axes = models_of(model)
    diagnosis = mapped(diagnosis, lambda axis, x: _named(x, of_axes[axis], records))
    prompt = prompt_of(args, [*records, *validation], [*paths, *further])
    keep(diagnosis, args, prompt)
    console.say(diagnosis_text(diagnosis))
    note = _changes(diagnosis) or f'the same as {args.model_file}, nothing changed'
    files = print_files(diagnosis, args, console, f' ({note})')
    steps = print_next(diagnosis, prompt, console)
    console.result(
        {
            **to_json(diagnosis),
            'validation': [
                {'formula': FORMULA, **axis, **asdict(x)}
                for axis, one in _of_each(diagnosis)
                for x in one.unseen
            ],
            'files': files,
            'next': steps,
        }
    )


def _of_each(diagnosis: Diagnosis | EachAxis[Diagnosis]) -> list[tuple[dict[str, str], Diagnosis]]:
    """List the diagnoses; with several axes, each with the name of its axis."""
    if isinstance(diagnosis, EachAxis):
        return [({'axis': axis}, x) for axis, x in diagnosis.items()]
    return [({}, diagnosis)]


def _changes(diagnosis: Diagnosis | EachAxis[Diagnosis]) -> str:
    texts = [(*axis.values(), ', '.join(x.changes)) for axis, x in _of_each(diagnosis)]
    return '; '.join(': '.join(text) for text in texts if text[-1])


def _named(diagnosis: Diagnosis, model: StageModel, records: Sequence[Record]) -> Diagnosis:
    """Add warnings about records from which the model may have been identified."""
    told = _of_names(model, records)
    return replace(diagnosis, warnings=(*told, *diagnosis.warnings))


def _of_names(model: StageModel, records: Sequence[Record]) -> list[str]:
    """Warn about each record whose name is among the records of the identification."""
    used = model.identification.get('records')
    known = used if isinstance(used, Sequence) else ()
    return [
        f'{record.name}: the model was identified from a record of this name. The error on the '
        'same record says nothing about other motion; give another record'
        for record in records
        if record.name in known
    ]


def _settings(args: SimpleNamespace) -> DiagnosisSettings:
    only, without = effect_names(args.only), effect_names(args.without)
    if not set(only or catalogue()) - set(without):
        raise ConfigError('--only and --without leave no candidate; give --without fewer effects')
    named = {**fields_of(args, DiagnosisSettings), 'effects': only or None, 'without': without}
    return DiagnosisSettings(**named)

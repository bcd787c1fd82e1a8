# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``predict``, ``invert`` and ``export``: use a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
import math
from pathlib import Path
import re
from types import SimpleNamespace
from typing import Any, TYPE_CHECKING

import numpy as np
from piezo_ident.cli.console import Console, deferred_interrupts
from piezo_ident.cli.files import (
    check_order,
    check_output,
    check_suffix,
    data_of,
    print_faults,
    read_all,
    TABLE_FILES,
)
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ConfigError, DataError, naming
from piezo_ident.common.files import write_text
from piezo_ident.model.axes_file import load
from piezo_ident.model.axis_records import is_measured, voltage_of
from piezo_ident.model.free_run import FreeRun
from piezo_ident.model.multi_axis import each_of, EachAxis, files_of, models_of, MultiAxisModel
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.channels import role_of
from piezo_ident.record.io import write_columns
from piezo_ident.record.record import Piece, Record
from piezo_ident.record.tables.write import blocks_of
from piezo_ident.report import save_plot, to_json
from piezo_ident.report.picture import ENDINGS
from piezo_ident.uncertainty.prediction import unknown_parts
from piezo_ident.verbs.predict import bands, free_run, predict, prediction_doubts

if TYPE_CHECKING:
    from piezo_ident.control.inverse import Inverse
    from piezo_ident.verbs.invert import MultiAxisInverse

SUFFIXES = {'c': '.h', 'fmu': '.fmu'}


def _checked(args: SimpleNamespace, what: str) -> StageModel | MultiAxisModel:
    """Load the model; refuse outputs that cannot be written, and files in the wrong order."""
    checks: dict[str, Any] = {'inputs': (args.model, args.record), 'overwrite': args.overwrite}
    if args.out is not None:
        check_output(args.out, TABLE_FILES, what, **checks)
    check_order(args.model, args.record, args.verb)
    model = load(args.model)
    if args.plot is not None:
        check_suffix(args.plot, ENDINGS, 'a picture')
        for path in files_of(model, args.plot).values():
            check_output(path, ENDINGS, 'a picture', **checks)
    return model


def _wrote(args: SimpleNamespace, result: object, console: Console) -> dict[str, Any]:
    """Print the written files; return them for JSON, several pictures as a list."""
    plots = [str(path) for path in files_of(result, args.plot).values()] if args.plot else []
    out = None if args.out is None else str(args.out)
    for path in filter(None, (out, *plots)):
        console.say(f'wrote {path}')
    return {'out': out, 'plot': plots if plots[1:] else next(iter(plots), None)}


def predict_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident predict``."""
    model = _checked(args, 'a prediction')
    (record,) = read_all([args.record], args, console, voltage_alone=True)
    data: dict[str, Any] = {'model': str(args.model)}
    # values that replace faulty readings are not written as readings
    columns: dict[str, Sequence[Array]] = {}
    known = [axis for axis in models_of(model) if is_measured(record, axis)]
    pieces: dict[str, Sequence[Array]] = {}
    halves: dict[str, Sequence[Array]] = {}
    runs: Mapping[str, FreeRun] = {}
    run: FreeRun | EachAxis[FreeRun] | None = None
    if known:
        with naming(str(args.model)):
            run = free_run(model, record, args.interval, known)
        console.say(str(run))
        data |= to_json(run)
        runs = each_of(run)
        lost = sum(x.record.n - x.errors.n for x in runs.values())
        if lost and args.out is not None:
            console.say(f'  {lost} readings are left out: y is nan there in {args.out}')
        # the record of the run lacks the faulty samples
        record = runs['y'].record if isinstance(run, FreeRun) else record
        pieces = {axis: x.pieces for axis, x in runs.items()}
        for axis, x in runs.items():
            columns[axis] = [piece.measured for piece in x.record]
        halves = {axis: x.half_widths for axis, x in runs.items()}
        if args.plot is not None:
            with deferred_interrupts():
                save_plot(run, args.plot)
    elif args.plot is not None:
        raise ConfigError(f'{record.name}: has no displacement to compare with; leave out --plot')
    if unknown := [axis for axis in models_of(model) if axis not in known]:
        with naming(str(args.model)):
            made = each_of(predict(model, record))
            others = {axis: made[axis] for axis in unknown}
            pieces |= others
            if args.interval:
                made_bands = bands(model, record, made, args.interval)
                halves |= {axis: made_bands[axis] for axis in unknown}
        unsure = [text for axis in others for text in unknown_parts(halves.get(axis, ()))]
        warnings = (*prediction_doubts(model, record), *unsure)
        lacks = f'displacement of {", ".join(unknown)}' if known else 'displacement'
        console.say(f'{args.model} on {record.name}, which has no {lacks}: the error is unknown')
        for warning in warnings:
            console.say(f'  warning: {warning}')
        data['warnings'] = list(warnings)
    if args.interval:
        data['interval'] = print_bands(args.interval, halves, model, console)
    if args.out is not None:
        with deferred_interrupts():
            for axis, parts in pieces.items():
                if (v := voltage_of(axis)) != 'v':
                    columns[v] = [piece.channels[v] for piece in record]
                columns[f'y_hat{axis[1:]}'] = parts
                if args.interval:
                    columns[f'half_width{axis[1:]}'] = halves[axis]
            columns |= {f'estimate{axis[1:]}': x.estimate for axis, x in runs.items()}
            _write_prediction(record, columns, args.out)
    print_faults(record, (), console)
    console.result({**data, **data_of(record), **_wrote(args, run, console)})


def _write_prediction(record: Record, columns: Mapping[str, Sequence[Array]], path: Path) -> None:
    blocks = blocks_of(record, **columns)
    left_out = () if record.is_measured else ('y',)
    write_columns(path, lambda: ({k: b[k] for k in b if k not in left_out} for b in blocks()))


def print_bands(
    level: float,
    halves: Mapping[str, Sequence[Array]],
    model: StageModel | MultiAxisModel,
    console: Console,
) -> dict[str, Any]:
    """Print the mean and the largest half width of each axis; return them for JSON."""
    axes = {}
    for axis, parts in halves.items():
        span = abs(models_of(model)[axis].scaling.Y)
        half = 100.0 * np.concatenate(parts) / span
        known = half[np.isfinite(half)]
        mean, most = (float(f(known)) if known.size else math.nan for f in (np.mean, np.max))
        console.say(
            f'  band at {100.0 * level:g} %{f", axis {axis}" * (len(halves) > 1)}: half width '
            f'{mean:.3g} % of the span of the model in the mean, {most:.3g} % at most'
        )
        axes[axis] = {
            'mean_half_width_percent_of_span': mean,
            'largest_half_width_percent_of_span': most,
            'share_unknown': 1.0 - known.size / half.size,
        }
    return {'level': level, 'axes': axes}


def invert_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident invert``."""
    from piezo_ident.verbs.invert import invert

    model = _checked(args, 'a voltage')
    (reference,) = read_all([args.record], args, console, displacement_alone=True)
    piece = _whole(reference, model)
    further = {k: x for k, x in piece.channels.items() if role_of(k) != 'y'}
    options = {'limits': args.limits, 'slew': args.slew or np.inf, 'clip': args.clip}
    drive: Inverse | MultiAxisInverse
    with naming(str(args.record), model=str(args.model)):
        model = _at_rate(model, piece.sample_rate)
        if isinstance(model, MultiAxisModel):
            drive = invert(model, _wanted(model, reference, console), channels=further, **options)
            axes, voltages = {**drive}, {**drive.voltages}
        else:
            drive = invert(model, piece.y, channels=piece.channels, **options)
            axes, voltages = {'y': drive}, {'v': drive.v}
    console.say(f'{args.model}, told to move as {reference.name}:')
    console.say(str(drive))
    with deferred_interrupts():
        if args.out is not None:
            n = next(iter(voltages.values())).size
            columns = {'t': piece.start_time + (np.arange(n) - drive.lead) / piece.sample_rate}
            columns |= voltages
            write_columns(args.out, lambda: iter([columns]))
        if args.plot is not None:
            save_plot(drive, args.plot)
    print_faults(reference, (), console)
    console.result(
        {
            'model': str(args.model),
            'reference': str(args.record),
            **to_json(next(iter(axes.values()))),
            'axes': {axis: to_json(x) for axis, x in axes.items()},
            **_wrote(args, drive, console),
        }
    )


def _at_rate(model: StageModel | MultiAxisModel, rate: float) -> StageModel | MultiAxisModel:
    """Set the sampling rate of a model to that of a motion; a static model holds for any rate."""
    if isinstance(model, StageModel):
        return replace(model, sample_rate=rate)
    axes = {k: replace(x, sample_rate=rate) for k, x in model.axes.items()}
    return replace(model, axes=axes)


def _wanted(model: MultiAxisModel, reference: Record, console: Console) -> dict[str, Array]:
    """Return the wanted motion of each axis; a single motion belongs to a single axis."""
    (piece,) = reference
    wanted = {'y': piece.y, **{k: x for k, x in piece.channels.items() if role_of(k) == 'y'}}
    if len(wanted) == len(model.axes) == 1:
        return dict(zip(model.axes, wanted.values(), strict=True))
    if left := [axis for axis in wanted if axis not in model.axes]:
        console.say(f'left out: {", ".join(left)}; the model holds for {", ".join(model.axes)}')
    return {axis: y for axis, y in wanted.items() if axis in model.axes}


def _whole(reference: Record, model: StageModel | MultiAxisModel) -> Piece:
    """Return the piece of a reference; refuse several pieces, or a rate other than the model's."""
    (piece, *more) = reference
    if more:
        met = '; '.join(str(fault) for fault in reference.faults if not fault.is_note)
        raise DataError(
            f'{reference.name}: falls into {1 + len(more)} pieces; {met}; a wanted motion is one '
            'piece: fill in the missing samples'
        )
    if not model.takes(piece):
        raise DataError(
            f'{reference.name}: is sampled at {piece.sample_rate:g} Hz, the model at '
            f'{model.sample_rate:g} Hz; write the motion at the rate of the model'
        )
    return piece


def export_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident export``."""
    from piezo_ident.verbs.export import export_c, export_fmu

    if args.out is None:
        raise ConfigError('export: no file is named', options='--out stage.h')
    suffixes = [SUFFIXES[args.format]] if args.format else SUFFIXES.values()
    check_output(args.out, suffixes, 'a model', inputs=[args.model], overwrite=args.overwrite)
    is_header = args.out.suffix.lower() == '.h'
    if not is_header and (args.limits or args.slew or args.preview is not None):
        raise ConfigError(
            f'{args.out}: has no feed-forward, which --limits, --slew and --preview are for; '
            'leave them out, or write a header .h'
        )
    name = args.name or re.sub(r'\W', '_', args.out.stem, flags=re.ASCII).lower()
    model = load(args.model)
    title = f'The stage of {args.model.name}'
    header, functions = '', []
    with naming(str(args.model)), deferred_interrupts():
        if is_header:
            header = export_c(
                model,
                name,
                limits=args.limits,
                slew=args.slew or math.inf,
                preview=args.preview,
                title=title,
            )
            write_text(args.out, header)
            axes = [f'_{axis.lower()}' for axis in getattr(model, 'axes', ())]
            known = [f'{name}_step', *(f'{name}{x}_feedforward_step' for x in ('', *axes))]
            functions = [function for function in known if f'{function}(' in header]
        else:
            export_fmu(model, args.out, name)
    console.say(' '.join([f'wrote {args.out}', *([f'with {", ".join(functions)}'] * is_header)]))
    ahead = re.search(r'_PREVIEW = (\d+)', header)
    preview = int(ahead[1]) if ahead else None
    if preview is not None:
        console.say(
            f'the feed-forward knows the motion {preview} samples ahead, '
            f'{1e3 * preview / model.sample_rate:.4g} ms; --preview N makes it shorter'
        )
    if len(functions) == 1:
        head = header.partition('There is no feed-forward:')[2].partition('*/')[0]
        reason = ' '.join(word for word in head.split() if word != '*')
        console.say(f'  warning: {args.model}: there is no feed-forward: {reason}')
    console.result(
        {
            'model': str(args.model),
            'out': str(args.out),
            'format': 'c' if is_header else 'fmu',
            'name': name,
            'functions': functions,
            'preview': preview,
        }
    )

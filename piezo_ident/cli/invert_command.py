# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``invert``: the voltage under which a stage moves as wanted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from piezo_ident.cli.console import Console, deferred_interrupts
from piezo_ident.cli.outputs import check_table_and_picture
from piezo_ident.cli.records import check_order, print_faults, read_all
from piezo_ident.common.errors import DataError, naming
from piezo_ident.control.inverse import Inverse
from piezo_ident.model.metrics import FORMULA
from piezo_ident.model.multi_axis import load, MultiAxisModel
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.channels import role_of
from piezo_ident.record.io import write_columns
from piezo_ident.record.record import Piece, Record
from piezo_ident.verbs.use import invert, MultiAxisInverse


def invert_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident invert``."""
    check_table_and_picture(
        args.out,
        'a voltage',
        args.plot,
        inputs=(args.model, args.record),
        overwrite=args.overwrite,
    )
    check_order(args.model, args.record, 'invert')
    model = load(args.model)
    (reference,) = read_all([args.record], args, console, displacement_alone=True)
    piece = _whole(reference, model)
    further = {k: x for k, x in piece.channels.items() if role_of(k) != 'y'}
    options = {'limits': args.limits, 'slew': args.slew or np.inf, 'clip': args.clip}
    drive: Inverse | MultiAxisInverse
    with naming(str(args.record), model=str(args.model)):
        if isinstance(model, MultiAxisModel):
            wanted = {
                'y': piece.y,
                **{k: x for k, x in piece.channels.items() if k not in further},
            }
            drive = invert(model, wanted, channels=further, **options)
            axes, voltages = {**drive}, {**drive.voltages}
        else:
            model = replace(model, sample_rate=piece.sample_rate)
            drive = invert(model, piece.y, channels=piece.channels, **options)
            axes, voltages = {'y': drive}, {'v': drive.v}
    console.say(f'{args.model}, told to move as {reference.name}:')
    console.say(str(drive))
    with deferred_interrupts():
        if args.out is not None:
            n = voltages['v'].size
            columns = {'t': piece.start_time + (np.arange(n) - drive.lead) / piece.sample_rate}
            columns |= voltages
            write_columns(args.out, lambda: iter([columns]))
        if args.plot is not None:
            from piezo_ident.report import save_plot

            save_plot(drive, args.plot)
    print_faults(reference, (), console)
    files: dict[str, Path | None] = {'out': args.out, 'plot': args.plot}
    for path in filter(None, files.values()):
        console.say(f'wrote {path}')
    console.result(
        {
            'model': str(args.model),
            'reference': str(args.record),
            'formula': FORMULA,
            **_told(axes['y'], piece.sample_rate),
            'axes': {k: _told(x, piece.sample_rate) for k, x in axes.items()},
            **{key: path and str(path) for key, path in files.items()},
        }
    )


def _told(drive: Inverse, rate: float) -> dict[str, Any]:
    """Return what there is to tell of a voltage, for programs."""
    return {
        'percent_of_stroke': drive.error,
        'expected_percent_of_stroke': drive.expected,
        'expected_offset': drive.expected_offset,
        'lead': drive.lead,
        'clipped': int(np.count_nonzero(drive.clipped)),
        'voltage_range': [float(drive.v.min()), float(drive.v.max())],
        'steepest': float(np.abs(np.diff(drive.v)).max()) * rate,
        'warnings': list(drive.warnings),
    }


def _whole(reference: Record, model: StageModel | MultiAxisModel) -> Piece:
    """Return a reference that is one piece at the rate of the model, or refuse it."""
    (piece, *more) = reference
    if more:
        met = '; '.join(str(fault) for fault in reference.faults if not fault.is_note)
        raise DataError(
            f'{reference.name}: falls into {1 + len(more)} pieces; {met}; a wanted motion is one '
            'piece: fill in what is missing'
        )
    if not model.takes(piece):
        raise DataError(
            f'{reference.name}: is sampled at {piece.sample_rate:g} Hz, the model at '
            f'{model.sample_rate:g} Hz; write the motion at the rate of the model'
        )
    return piece

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""``simulate`` and ``convert``: write records."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
from piezo_ident.cli.console import Console, deferred_interrupts
from piezo_ident.cli.files import (
    BAG_FILES,
    check_apart,
    check_file,
    check_link,
    check_suffix,
    data_of,
    print_faults,
    read_all,
    spans,
)
from piezo_ident.common.config import find_config
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.files import write_text
from piezo_ident.excitation.axes import build_axes
from piezo_ident.excitation.program import Program
from piezo_ident.excitation.scaled import program_to_yaml, scaled
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.two_axis_stage import load_stage
from piezo_ident.record import io as record_io
from piezo_ident.record.record import Piece, Record
from piezo_ident.record.tables.write import labels_of

PROGRAM_FILES = ('.yaml', '.yml')


def simulate_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident simulate``."""
    out: Path = args.out
    is_program = out.suffix.lower() in PROGRAM_FILES
    if is_program:
        check_file(out, overwrite=args.overwrite)
    else:
        _check_record_output(args, voltage_only=args.voltage_only)
    if is_program or args.voltage_only:
        _refuse_unused(args)
    files = {}
    for kind, name in (('stage', args.config), ('program', args.program)):
        check_link(Path(name))
        files[kind] = find_config(name, kind)
        if Path(name).suffix and not Path(name).is_file():
            console.note(f'{name} is not here; taking the shipped {files[kind]}')
    stage, program = load_stage(files['stage']), Program.load(files['program'])
    rate = stage.sample_rate if args.sample_rate is None else args.sample_rate
    is_static = isinstance(stage, SimulatedStage) and stage.model.is_static
    if not (is_static or args.voltage_only or is_program) and rate != stage.sample_rate:
        raise ConfigError(
            f'{files["stage"]}: the stage holds for {stage.sample_rate:g} Hz, not for '
            f'{rate:g} Hz; leave out --sample-rate'
        )
    seed = stage.seed if args.seed is None else args.seed
    if args.limits is not None or is_program:
        program = scaled(program, args.limits or program.limits, rate)
    if is_program:
        _write_program(out, program, len(stage.axes), console)
        return
    sequence, *others = build_axes(program, len(stage.axes), rate)
    rng = np.random.default_rng(seed)
    if args.voltage_only:
        channels = {f'v_{axis}': q.v for axis, q in zip(stage.axes[1:], others, strict=True)}
        unknown = np.full(sequence.n, np.nan)
        piece = Piece(sequence.v, unknown, rate, segments=sequence.segments, channels=channels)
        record = Record((piece,), out.name)
    elif isinstance(stage, SimulatedStage):
        record = stage.play(sequence, rng, name=out.name)
    else:
        record = stage.play((sequence, *others), rng, name=out.name)
    data = {'stage': str(files['stage']), 'program': str(files['program']), 'seed': str(seed)}
    is_bag = out.suffix.lower() in ('', '.mcap', '.db3')
    losses: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    with deferred_interrupts():
        if args.voltage_only:
            columns = {'t': piece.t, 'v': piece.v, **piece.channels}
            # with the labels: a measured column added later makes a labelled record
            record_io.write_columns(out, lambda: iter([columns]), *labels_of(record))
        else:
            losses = record_io.write(
                record,
                out,
                overwrite=args.overwrite,
                storage=args.storage,
                custom_data=data if is_bag else None,
            )
    content = 'the voltage alone' if args.voltage_only else f'seed {seed}'
    console.say(f'{out}: {record.duration:.4g} s at {rate:g} Hz, {record.n} samples, {content}')
    console.say(sequence.describe())
    print_faults(record, losses, console)
    if isinstance(stage, SimulatedStage) and not args.voltage_only:
        warnings = stage.model.extrapolation(record)
    for warning in warnings:
        console.say(f'warning: {warning}')
    if console.as_json:
        console.result(
            {
                **data,
                'seed': seed,
                'out': str(out),
                **data_of(record, losses),
                'warnings': warnings,
            }
        )


def _refuse_unused(args: SimpleNamespace) -> None:
    if args.storage is not None:
        raise DataError(f'{args.out}: a storage is for bags only; leave it out')
    if args.seed is not None:
        raise ConfigError(
            f'{args.out}: --seed is of the sensor noise, and nothing is measured; leave it out, '
            'and write the seed of noise and multisines into the program'
        )


def _write_program(out: Path, program: Program, axes: int, console: Console) -> None:
    text = program_to_yaml(program)
    every = build_axes(program, axes)  # refuses a program that the graph would refuse
    sequence = every[0]
    write_text(out, text)
    console.say(f'{out}: a program of {sequence.duration:.4g} s at {sequence.sample_rate:g} Hz')
    largest = max(float(np.abs(np.diff(q.v)).max(initial=0.0)) for q in every)
    steepest = largest * sequence.sample_rate
    shown = f'{steepest:.6g}'
    if float(shown) < (1.0 - 1e-9) * steepest:  # rounded down: such a slew would be too slow
        shown = f'{(1.0 + 1e-5) * steepest:.6g}'
    console.say(f'steepest: {shown} V/s; the slew of the stage must be as large')
    console.say(sequence.describe())
    console.result({'out': str(out), 'samples': sequence.n, 'steepest': steepest})


def convert_command(args: SimpleNamespace, console: Console) -> None:
    """``piezo_ident convert``."""
    check_apart(args.out, args.record)
    _check_record_output(args)
    # recovers the complete part of an unfinished bag
    (record,) = read_all([args.record], args, console, recover=True)
    with deferred_interrupts():
        losses = record_io.write(record, args.out, overwrite=args.overwrite, storage=args.storage)
    console.say(
        f'{args.record} -> {args.out}: {len(record.pieces)} pieces, {record.n} samples, '
        f'{record.duration:.6g} s, {spans([record])}'
    )
    print_faults(record, losses, console)
    if console.as_json:
        console.result({'in': str(args.record), 'out': str(args.out), **data_of(record, losses)})


def _check_record_output(args: SimpleNamespace, *, voltage_only: bool = False) -> None:
    suffixes = tuple(record_io.WRITERS)
    if voltage_only:
        check_suffix(args.out, suffixes, 'a voltage')
    check_suffix(args.out, (*suffixes, *BAG_FILES, ''), 'a record')
    check_file(args.out, overwrite=args.overwrite, folder_too=True)

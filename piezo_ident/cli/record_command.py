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
from piezo_ident.excitation.program import Program, Sequence
from piezo_ident.excitation.scaled import program_to_yaml, scaled
from piezo_ident.model.simulated_stage import SimulatedStage
from piezo_ident.model.two_axis_stage import load_stage, TwoAxisStage
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
    files = _files_of(args, console)
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
    sequences = build_axes(program, len(stage.axes), rate)
    record = _record_of(stage, sequences, None if args.voltage_only else seed, out.name)
    data = {**{kind: str(file) for kind, file in files.items()}, 'seed': str(seed)}
    losses = _write_record(args, record, data)
    content = 'the voltage alone' if args.voltage_only else f'seed {seed}'
    console.say(f'{out}: {record.duration:.4g} s at {rate:g} Hz, {record.n} samples, {content}')
    console.say(sequences[0].describe())
    print_faults(record, losses, console)
    warnings: tuple[str, ...] = ()
    if isinstance(stage, SimulatedStage) and not args.voltage_only:
        warnings = stage.model.extrapolation(record)
    for warning in warnings:
        console.say(f'warning: {warning}')
    if console.as_json:
        end = {'out': str(out), **data_of(record, losses), 'warnings': warnings}
        console.result({**data, 'seed': seed, **end})


def _files_of(args: SimpleNamespace, console: Console) -> dict[str, Path]:
    """Find the files of stage and program; report a shipped file in place of a missing one."""
    files = {}
    for kind, name in (('stage', args.config), ('program', args.program)):
        check_link(Path(name))
        files[kind] = find_config(name, kind)
        if Path(name).suffix and not Path(name).is_file():
            console.note(f'{name} is not here; taking the shipped {files[kind]}')
    return files


def _record_of(
    stage: SimulatedStage | TwoAxisStage,
    sequences: tuple[Sequence, ...],
    seed: int | None,
    name: str,
) -> Record:
    """Play the sequences on the stage; without a seed, make a record of the voltages alone."""
    if seed is None:
        first, *others = sequences
        channels = {f'v_{axis}': q.v for axis, q in zip(stage.axes[1:], others, strict=True)}
        unknown, rate = np.full(first.n, np.nan), first.sample_rate
        piece = Piece(first.v, unknown, rate, segments=first.segments, channels=channels)
        return Record((piece,), name)
    rng = np.random.default_rng(seed)
    if isinstance(stage, SimulatedStage):
        return stage.play(sequences[0], rng, name=name)
    return stage.play(sequences, rng, name=name)


def _write_record(args: SimpleNamespace, record: Record, data: dict[str, str]) -> tuple[str, ...]:
    """Write a record, or its voltages alone; return the data that the file cannot keep."""
    is_bag = args.out.suffix.lower() in ('', *BAG_FILES)
    with deferred_interrupts():
        if not args.voltage_only:
            return record_io.write(
                record,
                args.out,
                overwrite=args.overwrite,
                storage=args.storage,
                custom_data=data if is_bag else None,
            )
        (piece,) = record
        columns = {'t': piece.t, 'v': piece.v, **piece.channels}
        # with the labels: a measured column added later makes a labelled record
        record_io.write_columns(args.out, lambda: iter([columns]), *labels_of(record))
        return ()


def _refuse_unused(args: SimpleNamespace) -> None:
    if args.storage is not None:
        raise DataError(f'{args.out}: a storage is for bags only; leave it out')
    if args.seed is not None:
        raise ConfigError(
            f'{args.out}: --seed is for the sensor noise of a record; leave it out, and write the '
            'seed of noise and multisines into the program'
        )


def _write_program(out: Path, program: Program, axes: int, console: Console) -> None:
    text = program_to_yaml(program)
    every = build_axes(program, axes)  # refuses the programs that the graph refuses
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

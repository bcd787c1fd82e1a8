# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What several commands share: reading records, and saying what was met in them."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
import os
from pathlib import Path
from typing import Any

from piezo_ident.cli.console import Console
from piezo_ident.cli.outputs import check_file, check_suffix
from piezo_ident.common.errors import ConfigError, DataError, PiezoIdentError
from piezo_ident.many.run import MARK
from piezo_ident.record import io as record_io
from piezo_ident.record.assemble import ReadOptions
from piezo_ident.record.record import Record

__all__ = [
    'RECORD_FILES',
    'check_bag_options',
    'check_limits',
    'check_record_output',
    'expand',
    'expand_apart',
    'naming',
    'options_of',
    'read',
    'read_all',
    'say_faults',
    'story',
]

BAG_FILES = ('.mcap', '.db3')
RECORD_FILES = ('.csv', '.npz', '.mat', *BAG_FILES)


@contextmanager
def naming(*names: str) -> Iterator[None]:
    """Put the names of the inputs before messages that do not say which of them they mean."""
    try:
        yield
    except PiezoIdentError as error:
        if any(name in str(error) for name in names):
            raise
        raise type(error)(f'{", ".join(names)}: {error}') from None


def expand(paths: Sequence[Path], console: Console) -> list[Path]:
    """Return the records that are named: a folder that is no bag stands for all in it."""
    found = []
    for path in paths:
        if not path.is_dir() or (path / 'metadata.yaml').is_file():
            found.append(path)
            continue
        places = sorted(path.iterdir())
        inside = [record for p in places for record in _records_of(p)]
        if not inside:
            raise DataError(
                f'{path}: a folder without records; give a bag, or a folder with '
                f'{", ".join(RECORD_FILES)} files'
            )
        left_out = [p.name for p in places if _is_left_out(p)]
        if left_out:
            console.note(
                f'{path}: what is in its folders is not read ({", ".join(left_out)}); name them, '
                'too, where their records are meant'
            )
        found += inside
    return found


def expand_apart(
    records: Sequence[Path], validation: Sequence[Path], console: Console
) -> tuple[list[Path], list[Path]]:
    """
    Return the records that are named for a model and for its validation.

    Raises
    ------
    DataError
        When one is named for both.
    """
    paths, further = expand(records, console), expand(validation, console)
    # pathlib has an error of its own for links in a circle
    fitted = set(map(os.path.realpath, paths))
    for path in further:
        if os.path.realpath(path) in fitted:
            raise DataError(
                f'{path}: is among the records, too, so it is no validation; leave out one of them'
            )
    return paths, further


def _records_of(path: Path) -> list[Path]:
    """Return what a folder of records has in one of its places."""
    if path.name.startswith('.'):
        return []
    if _is_record(path):
        return [path]
    # a bag that was not finished is not to be left out unsaid
    return [p for p in sorted(path.glob('*')) if p.suffix.lower() in BAG_FILES]


def _is_left_out(path: Path) -> bool:
    """Tell whether one of the places in a folder of records is a folder of further ones."""
    # the table of many records is none itself
    if path.name.startswith('.') or _is_record(path) or (path / MARK).is_file():
        return False
    return any(_is_record(p) and p.suffix.lower() not in BAG_FILES for p in path.glob('[!.]*'))


def _is_record(path: Path) -> bool:
    return (path / 'metadata.yaml').is_file() or (
        path.is_file() and path.suffix.lower() in RECORD_FILES
    )


def check_bag_options(paths: Sequence[Path], args: argparse.Namespace) -> None:
    """
    Refuse options that choose topics where no record is a bag.

    Raises
    ------
    ConfigError
    """
    for option in ('namespace', 'voltage_topic', 'displacement_topic'):
        # one that is not there is said by whoever reads it
        is_table = (p.is_file() and p.suffix.lower() not in BAG_FILES for p in paths)
        if getattr(args, option) is not None and all(is_table):
            raise ConfigError(
                f'--{option.replace("_", "-")} is for bags, and {paths[0]} is none; leave it out'
            )


def check_limits(args: argparse.Namespace) -> tuple[float, float] | None:
    """
    Return the voltage limits that are asked for.

    Raises
    ------
    ConfigError
        When the higher one comes first.
    """
    if args.voltage_limits is None:
        return None
    low, high = args.voltage_limits
    if not low < high:
        raise ConfigError(f'--voltage-limits {low:g} {high:g}: give the lower one first')
    return low, high


def read(path: Path, args: argparse.Namespace) -> Record:
    """Read one record as the options say."""
    check_bag_options([path], args)
    return record_io.read(path, options_of(args))


def options_of(args: argparse.Namespace) -> ReadOptions:
    """Return how records are to be read."""
    return ReadOptions(
        displacement_unit=args.displacement_unit,
        voltage_limits=check_limits(args),
        namespace=args.namespace,
        voltage_topic=args.voltage_topic,
        displacement_topic=args.displacement_topic,
        # saving what is whole of a bag is for convert; the others send there
        recover=args.verb == 'convert',
    )


def read_all(paths: Sequence[Path], args: argparse.Namespace) -> list[Record]:
    """Read records of one call, which share the options; files of one name keep their folders."""
    check_bag_options(paths, args)
    names = Counter(path.name for path in {path.resolve(): path for path in paths}.values())
    records = []
    for path in paths:
        try:
            record = record_io.read(path, options_of(args))
            records.append(record.renamed(str(path)) if names[path.name] > 1 else record)
        except DataError as error:
            if len(paths) == 1 or '--displacement-unit' not in str(error):
                raise
            raise DataError(
                f'{error}; one unit holds for all records of a call: where theirs differ, first '
                'turn those that are not in m into m, with piezo_ident convert '
                '--displacement-unit um IN OUT.npz'
            ) from None
    return records


def check_record_output(args: argparse.Namespace) -> None:
    """Refuse an OUT to which no record could be written."""
    check_suffix(args.out, (*RECORD_FILES, ''), 'a record')
    check_file(args.out, overwrite=args.overwrite, folder_too=True)


def say_faults(record: Record, losses: Sequence[str], console: Console) -> None:
    """Say what was met in a record, and what the file it was written to cannot keep."""
    for fault in record.faults:
        console.say(f'met: {fault}')
    for loss in losses:
        console.say(f'not kept: {loss}')


def story(record: Record, losses: Sequence[str]) -> dict[str, Any]:
    """Return for programs what `say_faults` says, and what the record holds."""
    return {
        'record': record.name,
        'pieces': len(record.pieces),
        'samples': record.n,
        'duration': record.duration,
        'sample_rates': list(dict.fromkeys(p.sample_rate for p in record)),
        'labels': list(record.labels),
        'faults': [
            {'name': f.name, 'where': f.where, 'count': f.count, 'action': f.action}
            for f in record.faults
        ],
        'not_kept': list(losses),
    }

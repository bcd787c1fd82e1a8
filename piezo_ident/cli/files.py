# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Read the records of a command line, and check its outputs before the work."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
import math
import os
from pathlib import Path
import tempfile
from types import SimpleNamespace
from typing import Any

from piezo_ident.cli.console import Console
from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.files import broken_link, check_replaceable, unwritable
from piezo_ident.record import io as record_io
from piezo_ident.record.bags.recover import storage_of
from piezo_ident.record.io import READERS
from piezo_ident.record.options import ReadOptions
from piezo_ident.record.record import Fault, Record

#: faults that are printed directly after reading a record
SHOWN = ('columns', 'slow_sampling', 'fast_sampling', 'large_stroke', 'large_gain', 'high_voltage')
BAG_FILES = ('.mcap', '.db3')
MODEL_FILES = ('.yaml', '.yml')
#: suffixes of files that may be records, but often are other texts
UNCERTAIN = ('.txt', '.dat', '.asc')
#: smallest size of such a file that suggests a record instead of notes [bytes]
NOTES = 20_000
#: suffixes of the files that are searched in a folder
RECORD_FILES = (*(x for x in READERS if x not in UNCERTAIN), *BAG_FILES)
TABLE_FILES = ('.csv', '.npz')


def expand(paths: Sequence[Path], console: Console) -> list[Path]:
    """List the named records; a folder other than a bag stands for all records in it."""
    from piezo_ident.many.run import MARK

    records = []
    for path in paths:
        if not path.is_dir() or _is_record(path):
            records.append(path)
            continue
        inside: list[Path] = []
        skipped, others = list[str](), list[str]()
        for place in sorted(path.glob('[!.]*')):
            if _is_record(place):
                inside.append(place)
            elif place.is_dir():
                below = sorted(filter(_is_record, place.glob('[!.]*')))
                # parts of an unfinished bag
                parts = [*filter(storage_of, below)]
                inside += parts
                # MARK means a folder with results of --each
                if len(below) > len(parts) and not (place / MARK).is_file():
                    skipped.append(place.name)
            elif place.suffix.lower() in UNCERTAIN and place.is_file():
                others += [place.name] if place.stat().st_size > NOTES else []
        some = ', '.join(others[:3]) + (', ...' if len(others) > 3 else '')
        unread = f'{path}: {some}: not read, as text may be anything; name them too'
        if not inside:
            raise DataError(
                unread.removesuffix(' too')
                if others
                else f'{path}: a folder without records; give a bag, or a folder with '
                f'{", ".join(RECORD_FILES)} files'
            )
        if skipped:
            console.note(f'{path}: its folders are not read ({", ".join(skipped)}); name them too')
        if others:
            console.note(unread)
        records += inside
    return records


def _is_record(path: Path) -> bool:
    return (path / 'metadata.yaml').is_file() or (path.is_file() and _is_named_as_record(path))


def _is_named_as_record(path: Path) -> bool:
    return path.suffix.lower() in RECORD_FILES or bool(storage_of(path))


def expand_apart(
    records: Sequence[Path], validation: Sequence[Path], console: Console
) -> tuple[list[Path], list[Path]]:
    """List the records for a model and for its validation; refuse a record in both."""
    paths, further = expand(records, console), expand(validation, console)
    fitted = set(map(os.path.realpath, paths))
    for path in further:
        if os.path.realpath(path) in fitted:
            raise DataError(f'{path}: is among the records too; it is no validation')
    return paths, further


def check_order(model: Path, record: Path, verb: str) -> None:
    """Refuse a model and a record in the wrong order."""
    order = f'MODEL comes first: piezo_ident {verb} model.yaml record.csv'
    if _is_named_as_record(model) or model.is_dir():
        raise ConfigError(f'{model}: is a record, no model file; {order}')
    if record.suffix.lower() in MODEL_FILES:
        raise ConfigError(f'{record}: is no record; {order}')


def check_bag_options(paths: Sequence[Path], args: SimpleNamespace) -> None:
    """Refuse options for bags if all records are tables, and options for tables if all bags."""
    if all(p.is_file() and not storage_of(p) for p in paths):
        kind, own, names = 'bags', 'a table', ['namespace', 'voltage_topic', 'displacement_topic']
    elif all(p.is_dir() or storage_of(p) for p in paths):
        kind, own, names = 'tables', 'a bag', ['columns', 'rate', 'time_unit', 'voltage_unit']
    else:
        return
    for name in names:
        if getattr(args, name, None) is not None:
            option = f'--{name.replace("_", "-")}'
            raise ConfigError(f'{option} is for {kind}, and {paths[0]} is {own}; leave it out')


def fields_of(args: SimpleNamespace, kind: type) -> dict[str, Any]:
    """Pick the options that are fields of `kind`; absent options keep their defaults."""
    named = {f.name: getattr(args, f.name, None) for f in fields(kind)}
    return {name: x for name, x in named.items() if x is not None}


def options_of(args: SimpleNamespace) -> ReadOptions:
    """Make the options for reading records from the arguments."""
    return ReadOptions(**fields_of(args, ReadOptions))


def read_all(
    paths: Sequence[Path], args: SimpleNamespace, console: Console, **further: Any
) -> list[Record]:
    """
    Read the records of one call, and report the chosen columns and units.

    Files with the same name keep their folders in the names of their records.
    """
    check_bag_options(paths, args)
    options = replace(options_of(args), **further)
    # realpath, because Path.resolve raises its own error for circular links
    names = Counter(path.name for path in {os.path.realpath(p): p for p in paths}.values())
    records = []
    for path in paths:
        try:
            record = record_io.read(path, options)
        except DataError as error:
            if len(paths) == 1 or '--displacement-unit' not in str(error):
                raise
            raise DataError(
                f'{error}; one unit holds for all records of a call: where theirs differ, first '
                'piezo_ident convert --displacement-unit um IN OUT.npz'
            ) from None
        records.append(record.renamed(str(path)) if names[path.name] > 1 else record)
    # reported before the work, which may fail through a wrong unit
    shown: dict[Fault, list[Record]] = {}
    for record in records:
        for fault in record.faults:
            if fault.name in SHOWN:
                shown.setdefault(fault, []).append(record)
    for fault, of in shown.items():
        name = f'{of[0].name} and {len(of) - 1} more' if of[1:] else of[0].name
        reached = spans(of) if fault.is_note else ''
        console.note(f'{name}: {fault.where} ({fault.action}){reached and "; "}{reached}')
    return records


def spans(records: Sequence[Record]) -> str:
    """Describe the strokes and voltages of records, as a check of their units."""
    strokes = [1e6 * record.stroke for record in records]
    ends = [end for record in records for end in record.voltage_range]
    parts = []
    for name, unit, x in (('stroke', 'um', strokes), ('voltage', 'V', ends)):
        # a displacement or voltage that was not recorded is NaN
        if all(map(math.isfinite, x)):
            both = dict.fromkeys(f'{end:.4g}' for end in (min(x), max(x)))
            parts.append(f'{name} {" to ".join(both)} {unit}')
    return ', '.join(parts)


def print_faults(record: Record, losses: Sequence[str], console: Console) -> None:
    """Print the faults of a record, and the data that its output file cannot keep."""
    for fault in record.faults:
        if fault.name not in SHOWN:
            console.say(f'met: {fault}')
    for loss in losses:
        console.say(f'not kept: {loss}')


def data_of(record: Record, losses: Sequence[str] = ()) -> dict[str, Any]:
    """Return a record, and the losses of its output file, for JSON."""
    from piezo_ident.report import to_json

    return {**to_json(record), 'not_kept': list(losses)}


# --- outputs


def check_suffix(path: Path, suffixes: Iterable[str], what: str) -> None:
    """Refuse an unknown suffix."""
    known = list(suffixes)
    if path.suffix.lower() not in known:
        names = ', '.join(s or 'a folder' for s in known)
        way = f'as {path.suffix}' if path.suffix else 'without an ending'
        raise ConfigError(f'{path}: {what} cannot be written {way}; choose {names}')


def check_output(
    path: Path, suffixes: Iterable[str], what: str, *, inputs: Iterable[Path], overwrite: bool
) -> None:
    """Refuse an output that has an unknown suffix, is an input, or cannot be written."""
    check_suffix(path, suffixes, what)
    check_distinct(path, inputs)
    check_file(path, overwrite=overwrite)


def check_link(path: Path) -> None:
    """Refuse a symbolic link without a target."""
    broken = broken_link(path)
    if broken:
        raise DataError(f'{path}: {broken}')


def check_file(path: Path, *, overwrite: bool, folder_too: bool = False) -> None:
    """Refuse an output that cannot be written; `folder_too` allows a folder, as for a bag."""
    check_link(path)
    try:
        if path.is_dir() and not folder_too:
            raise DataError(f'{path}: is a folder; name a file')
        if path.is_dir():
            check_replaceable(path)
        if path.exists() and not (path.is_dir() or path.is_file()):
            raise DataError(f'{path}: is a device, no file; choose another name')
        if (path.exists() or path.is_symlink()) and not overwrite:
            raise DataError(f'{path}: exists already; choose another name or add --overwrite')
        if not path.parent.exists():
            raise DataError(f'{path}: there is no folder {path.parent}; make it first')
        _try(path.parent)
    except OSError as error:
        raise unwritable(path, error) from None


def check_folder(path: Path) -> None:
    """Refuse a folder in which files cannot be written; the folder may still be missing."""
    check_link(path)
    try:
        if path.exists() and not path.is_dir():
            raise DataError(f'{path}: is a file; name a folder')
        here = path.absolute()
        while not here.exists():
            check_link(here)
            here = here.parent
        _try(here)
    except OSError as error:
        raise unwritable(path, error) from None


def check_distinct(output: Path, inputs: Iterable[Path]) -> None:
    """Refuse to write a result over one of its inputs."""
    if output.exists() and any(p.exists() and output.samefile(p) for p in inputs):
        raise DataError(f'{output}: is one of the inputs; choose another name')


def check_apart(output: Path, record: Path) -> None:
    """Refuse an output that is the record, lies in its folder, or contains it."""
    out, source = (Path(os.path.realpath(path)) for path in (output, record))
    if out == source or out in source.parents or source in out.parents:
        raise DataError(
            f'{output}: is the input {record}, lies in it or holds it; choose another name'
        )


def _try(folder: Path) -> None:
    # a test by a real file: root passes all permission bits, and a file system may be read-only
    with tempfile.TemporaryFile(dir=folder, prefix='.piezo_ident.'):
        pass

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Files: outputs that appear whole or not at all, and YAML by the safe loader.

An output is written under a temporary name beside its place and renamed.  The leftovers of a
killed process are called ``.<name>.<random>.tmp`` and can be deleted.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
import ctypes
import os
from pathlib import Path
import re
import shutil
import sqlite3
import tempfile
from typing import Any

from piezo_ident.common.errors import ConfigError, DataError
import yaml

#: the largest YAML text [characters, 20 us each], and values in it with aliases written out
YAML_SIZE = 500_000
#: most bytes of unpacked samples of one file: four hours of three columns at 20 kHz
UNPACKED_SIZE = 8 << 30

#: the files of a bag
_BAG_FILE = re.compile(r'metadata\.yaml|.*\.(mcap|db3)(\.zstd|-wal|-shm|-journal)?')
#: merge keys double a mapping with every line
_MERGE_KEY = re.compile(r'(^|[{,])\s*<<\s*:', re.MULTILINE)


def broken_link(path: str | os.PathLike[str]) -> str | None:
    """Describe the fault of a symbolic link that leads nowhere; else None."""
    if os.path.islink(path) and not os.path.exists(path):
        return f'is a link to {os.readlink(path)}, which cannot be reached; mend the link'
    return None


def check_regular(path: Path) -> None:
    """Refuse folders, and devices and pipes, whose data never end, with a DataError."""
    if not path.is_file():
        kind = 'a folder' if path.is_dir() else 'a device or a pipe'
        raise DataError(f'{path}: is {kind}, no file; copy the data into a file')


def load_yaml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """
    Read a YAML mapping with the safe loader.

    A file that cannot be read, or that `parse_yaml` refuses, raises ConfigError.
    """
    file = Path(path)
    try:
        if broken := broken_link(file):
            raise ConfigError(f'{path}: {broken}')
        if file.exists():
            check_regular(file)
        with file.open(encoding='utf-8') as stream:
            text = stream.read(YAML_SIZE + 1)
    except FileNotFoundError:
        raise ConfigError(f'{path}: no such file; check the name') from None
    except DataError as error:
        raise ConfigError(str(error)) from None
    except (OSError, ValueError) as error:
        reason = getattr(error, 'strerror', None) or type(error).__name__
        raise ConfigError(f'{path}: cannot be read as text ({reason})') from None
    return parse_yaml(text, str(path))


def parse_yaml(text: str, name: str) -> dict[str, Any]:
    """
    Parse a YAML mapping of at most `YAML_SIZE` characters with the safe loader.

    A ConfigError with the `name` refuses a text that is no YAML mapping, or too large.

    >>> parse_yaml('limits: [0, 10]', 'program')
    {'limits': [0, 10]}
    """
    if len(text) > YAML_SIZE:
        raise ConfigError(f'{name}: too large for a model or program; check the name')
    if _MERGE_KEY.search(text):
        raise ConfigError(f'{name}: merge keys (<<) are not read; write the values out')
    try:
        data = yaml.safe_load(text)
        _count(data, 0, name)
    except (
        # the loader passes on the errors of its constructors
        yaml.YAMLError,
        ArithmeticError,
        AttributeError,
        LookupError,
        RecursionError,
        TypeError,
        ValueError,
    ) as error:
        mark = getattr(error, 'problem_mark', None)
        where = f' at line {mark.line + 1}' if mark is not None else ''
        raise ConfigError(f'{name}: not valid YAML{where}; correct it or write it again') from None
    if not isinstance(data, dict):
        raise ConfigError(
            f'{name}: expected a YAML mapping, got {type(data).__name__}; check the name'
        )
    return data


def _count(node: object, count: int, name: str) -> int:
    """Count the values in nested data; few lines with aliases can stand for any number."""
    inner = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    for value in inner:
        count = _count(value, count + 1, name)
        if count > YAML_SIZE:
            raise ConfigError(f'{name}: too large, {YAML_SIZE} values at most; check the name')
    return count


@contextmanager
def temporary_output(path: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """
    Yield a path of the same file name in a new folder beside `path`; rename it on success.

    A new output gets the rights of the umask, a replaced output keeps its own.  A symbolic link
    stays, and its target is written.  `overwrite` replaces an older output, and a folder if it is
    a bag and nothing else.  DataError if the place is taken or cannot be written to; then nothing
    is left there.
    """
    path = Path(path)
    if path.name in ('', '..'):
        raise DataError(f'{path}: names no file; add one')
    if os.path.lexists(path) and not overwrite:
        raise DataError(f'{path}: exists already; choose another name or ask to overwrite it')
    target = Path(os.path.realpath(path)) if path.is_symlink() else path
    if target.is_dir():
        check_replaceable(target)
    # in a folder of its own the output keeps its name, which rosbag2 repeats inside
    with _work_folder(path, target.parent, target.name) as work:
        yield work / target.name
        _put_in_place(work / target.name, target, work / 'replaced')


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write or replace a text file in one step, or raise DataError; see `temporary_output`."""
    with temporary_output(Path(path), overwrite=True) as file:
        # file names and labels need not be Unicode
        file.write_text(text, encoding='utf-8', errors='replace')


def write_together(folder: str | os.PathLike[str], files: Mapping[str, bytes]) -> None:
    """
    Write several files into a folder: all of them, or none if the disk is full.

    The folder is made if it does not exist; the files, contents by name, come to their places in
    order.  A folder that cannot be written raises DataError.
    """
    folder = Path(folder)
    with _work_folder(folder, folder, 'new') as work:
        for name, content in files.items():
            (work / name).write_bytes(content)
        for name in files:
            target = Path(os.path.realpath(folder / name))
            _put_in_place(work / name, target, work / 'replaced')


def check_replaceable(folder: Path) -> None:
    """Refuse a folder that is no bag, or holds other files: replacing it would delete them."""
    try:
        is_bag = 'rosbag2_bagfile_information' in load_yaml(folder / 'metadata.yaml')
    except ConfigError:
        is_bag = False
    if not is_bag:
        raise DataError(f'{folder}: is a folder and no bag; choose another name')
    others = [p for p in folder.iterdir() if p.is_dir() or not _BAG_FILE.fullmatch(p.name)]
    if others:
        raise DataError(
            f'{folder}: holds {min(others).name}, which is no part of a bag; choose another name'
        )


def unwritable(path: Path, error: Exception) -> DataError:
    """Make the error for a place that the disk refuses."""
    reason = getattr(error, 'strerror', None) or str(error)
    return DataError(
        f'{path}: cannot be written ({reason}); choose a folder that exists, with room and the '
        'right to write'
    )


@contextmanager
def _work_folder(path: Path, parent: Path, name: str) -> Iterator[Path]:
    """Yield a temporary folder in `parent`; an error of the disk is one about `path`."""
    try:
        if path == parent:
            parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f'.{name}.', suffix='.tmp', dir=parent))
        try:
            yield work
        finally:
            shutil.rmtree(work, ignore_errors=True)
    # a full disk is an error of its own to SQLite
    except (OSError, sqlite3.Error) as error:
        raise unwritable(path, error) from None


def _put_in_place(new: Path, target: Path, replaced: Path) -> None:
    """Bring a finished output to its place, the old one of a folder to `replaced`."""
    for path in (new, *(new.rglob('*') if new.is_dir() else ())):
        _sync(path)
    if target.exists():
        shutil.copymode(target, new)
    if not target.is_dir():
        new.replace(target)
    elif not _exchanged(new, target):
        target.rename(replaced)
        try:
            new.replace(target)
        except BaseException:
            replaced.rename(target)
            raise
    # not every file system can bring the names in a folder to disk
    with suppress(OSError):
        _sync(target.parent)


def _sync(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _exchanged(new: Path, old: Path) -> bool:
    """Swap two folders in one step, so that one is always there; False where that fails."""
    here, exchange = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux
    try:
        swap = ctypes.CDLL(None).renameat2
    except (OSError, AttributeError, TypeError):
        return False
    return bool(swap(here, os.fsencode(new), here, os.fsencode(old), exchange) == 0)

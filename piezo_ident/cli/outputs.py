# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Checks of output paths, which come before the long work; each raises a `PiezoIdentError`."""

from __future__ import annotations

from collections.abc import Iterable
import os
from pathlib import Path
import tempfile

from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.files import broken_link, check_replaceable, unwritable

TABLE_FILES = ('.csv', '.npz')
PICTURES = ('.png', '.pdf', '.svg')


def check_suffix(path: Path, suffixes: Iterable[str], what: str) -> None:
    """Refuse a suffix that names no format."""
    known = list(suffixes)
    if path.suffix.lower() not in known:
        names = ', '.join(s or 'a folder' for s in known)
        raise ConfigError(
            f'{path}: {what} cannot be written as {path.suffix or "a folder"}; choose {names}'
        )


def check_output(
    path: Path, suffixes: Iterable[str], what: str, *, inputs: Iterable[Path], overwrite: bool
) -> None:
    """Refuse a file whose suffix names no format, that is an input, or cannot be written."""
    check_suffix(path, suffixes, what)
    check_distinct(path, inputs)
    check_file(path, overwrite=overwrite)


def check_table_and_picture(
    table: Path | None, what: str, picture: Path | None, *, inputs: Iterable[Path], overwrite: bool
) -> None:
    """Refuse the files of ``--out`` and ``--plot`` that are given, as `check_output` does."""
    named = (table, TABLE_FILES, what), (picture, PICTURES, 'a picture')
    for path, suffixes, content in named:
        if path is not None:
            check_output(path, suffixes, content, inputs=inputs, overwrite=overwrite)


def check_link(path: Path) -> None:
    """Refuse a symbolic link that leads nowhere."""
    broken = broken_link(path)
    if broken:
        raise DataError(f'{path}: {broken}')


def check_file(path: Path, *, overwrite: bool, folder_too: bool = False) -> None:
    """Refuse an output that could not be written in the end; a bag may be a folder too."""
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
    """Refuse a folder in which files could not be written in the end; it need not exist yet."""
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
    """Refuse to write a result over what it is made of."""
    if output.exists() and any(p.exists() and output.samefile(p) for p in inputs):
        raise DataError(f'{output}: is one of the inputs; choose another name')


def check_apart(output: Path, record: Path) -> None:
    """Refuse to write a record over another, into the folder of it, or where that lies below."""
    # pathlib has an error of its own for links in a circle
    out, given = (Path(os.path.realpath(path)) for path in (output, record))
    if out == given or out in given.parents or given in out.parents:
        raise DataError(
            f'{output}: is the input {record}, lies in it or holds it; choose another name'
        )


def _try(folder: Path) -> None:
    # root passes every permission bit, and a read-only file system shows only when written to
    with tempfile.TemporaryFile(dir=folder, prefix='.piezo_ident.'):
        pass

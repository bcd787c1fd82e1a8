# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Outputs appear whole or not at all: written under a temporary name beside, then renamed.

What a process that was killed leaves behind is called ``.<name>.<random>.tmp`` and can be deleted.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
import ctypes
import os
from pathlib import Path
import re
import shutil
import sqlite3
import tempfile

from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.yaml_io import load_yaml

__all__ = ['check_replaceable', 'temporary_output']

#: what a bag is made of
_PART = re.compile(r'metadata\.yaml|.*\.(mcap|db3)(\.zstd|-wal|-shm|-journal)?')


@contextmanager
def temporary_output(path: str | Path, *, overwrite: bool = False) -> Iterator[Path]:
    """
    Yield a path of the same file name in a new folder beside `path`; rename it on success.

    Parameters
    ----------
    path : path
        Where the finished file or folder will stand.
    overwrite : bool
        Replace what stands there.  A folder is only replaced when it is a bag and nothing else.

    Raises
    ------
    DataError
        When the place is taken or cannot be written to.

    Examples
    --------
    >>> with temporary_output('model.yaml', overwrite=True) as file:  # doctest: +SKIP
    ...     file.write_text(text)
    """
    path = Path(path)
    if path.name in ('', '..'):
        raise DataError(f'{path}: names no file; add one')
    taken = path.exists() or path.is_symlink()
    if taken and not overwrite:
        raise DataError(f'{path}: exists already; choose another name or ask to overwrite it')
    if path.is_dir():
        check_replaceable(path)
    # a folder of our own keeps the name, which rosbag2 repeats inside, and takes the old output
    try:
        work = Path(tempfile.mkdtemp(prefix=f'.{path.name}.', suffix='.tmp', dir=path.parent))
        try:
            yield work / path.name
            if not (path.is_dir() and _exchanged(work / path.name, path)):
                if path.is_dir():
                    path.rename(work / 'replaced')
                (work / path.name).replace(path)
        except BaseException:
            old = work / 'replaced'
            if old.exists() and not path.exists():
                with suppress(OSError):
                    old.rename(path)
            raise
        finally:
            shutil.rmtree(work, ignore_errors=True)
    # a full disk is an error of its own to SQLite
    except (OSError, sqlite3.Error) as error:
        reason = getattr(error, 'strerror', None) or str(error)
        raise DataError(
            f'{path}: cannot be written ({reason}); choose a folder that exists, with room and '
            'the right to write'
        ) from None


def check_replaceable(folder: Path) -> None:
    """
    Refuse a folder that is no bag, or holds what is no part of it: replacing it deletes all.

    Raises
    ------
    DataError
    """
    try:
        is_bag = 'rosbag2_bagfile_information' in load_yaml(folder / 'metadata.yaml')
    except ConfigError:
        is_bag = False
    if not is_bag:
        raise DataError(f'{folder}: is a folder and no bag; choose another name')
    others = [p for p in folder.iterdir() if p.is_dir() or not _PART.fullmatch(p.name)]
    if others:
        raise DataError(
            f'{folder}: holds {min(others).name}, which is no part of a bag; choose another name'
        )


def _exchanged(new: Path, old: Path) -> bool:
    """Swap two folders in one step, so that no moment is without one; False where that fails."""
    here, exchange = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux
    try:
        swap = ctypes.CDLL(None).renameat2
    except (OSError, AttributeError, TypeError):
        return False
    return bool(swap(here, os.fsencode(new), here, os.fsencode(old), exchange) == 0)

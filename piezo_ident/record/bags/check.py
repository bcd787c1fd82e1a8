# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""
What a bag may hold, looked at before rosbags opens it.

rosbags unpacks what it finds, follows what an index says, and asks a database as it is.  That is
right for a bag of one's own; one from a stranger may name files elsewhere, unpack without end, or
answer a query with a view that never ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
import re
import sqlite3
import tempfile
from typing import Any
from urllib.parse import quote

from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.files import check_regular, load_yaml
from piezo_ident.record.bags.mcap_scan import McapScan, unpacked
from rosbags.rosbag2 import storage_mcap

__all__ = [
    'check_index',
    'check_inside',
    'check_journal',
    'check_storage',
    'check_tables',
    'connected',
    'metadata',
    'rate_of',
    'unpacked_message',
]

# what rosbags itself unpacks with, whatever the version of Python
_zstd: Any = storage_mcap.__dict__['zstd']
_STEP = 1 << 20
_SUPER_JOURNAL = bytes.fromhex('d9d505f920a163d7')


def metadata(folder: Path) -> dict[str, Any]:
    """
    Return what ``metadata.yaml`` of a folder says, empty when it says nothing.

    Raises
    ------
    ConfigError
        When it is no YAML, or too much of it.
    """
    info = load_yaml(folder / 'metadata.yaml').get('rosbag2_bagfile_information')
    return info if isinstance(info, dict) else {}


def check_inside(folder: Path, files: Sequence[Path]) -> None:
    """
    Refuse files of a bag that lie elsewhere, stand there twice, or have no end.

    Raises
    ------
    DataError
    """
    home = folder.resolve()
    for file in files:
        if not file.resolve().is_relative_to(home):
            raise DataError(f'{file}: is a link out of the bag; copy the file into it')
        check_regular(file)
    if len(set(files)) < len(files):
        raise DataError(f'{folder}: metadata.yaml names a file twice; mend it')


def check_storage(file: Path) -> set[tuple[int, str, int, int]]:
    """
    Refuse a finished file that rosbags could not open without harm.

    Returns
    -------
    set of tuple
        Place, compression, packed size and size of the chunks of an mcap file.

    Raises
    ------
    DataError
    """
    check_regular(file)
    if file.suffix == '.mcap':
        return McapScan(file).chunks()
    if file.suffix == '.db3':
        if re.search('[?#%]', str(file)):
            raise DataError(f'{file}: rosbags cannot open names with ?, # or %; rename it')
        with closing(connected(file)) as database:
            check_tables(database, file)
            # pages that are part of several trees make a table without end
            for (said,) in database.execute('PRAGMA quick_check(1)'):
                if re.search(r'\bpage\b', said, re.IGNORECASE):
                    reason = ' '.join(said.split())[-80:]
                    raise DataError(
                        f'{file}: damaged or unfinished bag ({reason}); record it again'
                    )
    elif file.suffix == '.zstd':
        _check_packed(file)
    return set()


def check_index(chunks: set[tuple[int, str, int, int]], index: Sequence[Any], file: Path) -> None:
    """
    Refuse an index of an mcap file that leads to anything but its chunks.

    Parameters
    ----------
    chunks : set of tuple
        Of `check_storage`.
    index : sequence
        What rosbags read of it.
    file : Path

    Raises
    ------
    DataError
    """
    named = [
        (x.chunk_start_offset, x.compression, x.compressed_size, x.uncompressed_size)
        for x in index
    ]
    if len(set(named)) < len(named) or not chunks.issuperset(named):
        raise DataError(
            f'{file}: damaged or unfinished bag, its index names chunks that are not there; '
            "try 'mcap recover'"
        )


def _check_packed(file: Path) -> None:
    left = unpacked(file.stat().st_size)
    with tempfile.TemporaryDirectory(prefix='piezo_ident_bag_') as folder:
        inner = Path(folder) / file.stem
        with _zstd.open(file, 'rb') as source, inner.open('wb') as target:
            while step := source.read(_STEP):
                left -= len(step)
                if left < 0:
                    raise DataError(f'{file}: unpacks to more than a file of its size holds')
                target.write(step)
        check_storage(inner)


def unpacked_message(data: bytes) -> bytes:
    """
    Return a message that was packed by itself.

    Raises
    ------
    ValueError
        When it is larger than any message.
    """
    most = unpacked(len(data))
    raw: bytes = _zstd.ZstdDecompressor().decompress(data, max_length=most + 1)
    if len(raw) > most:
        raise ValueError('a message unpacks to more than its size holds')
    return raw


def connected(file: Path) -> sqlite3.Connection:
    """Return a database, only to be read, whatever journal lies beside it."""
    return sqlite3.connect(f'file:{quote(str(file.absolute()))}?mode=ro&immutable=1', uri=True)


def check_tables(database: sqlite3.Connection, file: Path) -> None:
    """
    Refuse a database whose answers are computed instead of stored.

    Raises
    ------
    DataError
    """
    for kind, name, text in database.execute('SELECT type, name, sql FROM sqlite_master'):
        plain = kind in ('table', 'index') and not re.search(
            r'\b(as|check|generated|virtual)\b', text or '', re.IGNORECASE
        )
        if not plain:
            raise DataError(
                f'{file}: is no bag, {kind} {str(name)[:40]!r} computes what it holds; copy its '
                'topics and messages into a plain database'
            )


def check_journal(journal: Path) -> None:
    """
    Refuse a journal that names another file: SQLite deletes that one when it is done.

    Raises
    ------
    DataError
    """
    with journal.open('rb') as file:
        file.seek(max(0, journal.stat().st_size - len(_SUPER_JOURNAL)))
        if file.read() == _SUPER_JOURNAL:
            raise DataError(
                f'{journal}: belongs to a transaction of several databases, which no recorder '
                'makes; move it away, and what was committed can be read'
            )


def rate_of(folder: Path, file: str | None = None) -> float | None:
    """Return the sampling rate [Hz] in a bag's custom data, None without a sensible one."""
    try:
        info = metadata(folder)
        if file is not None and file not in info['relative_file_paths']:
            return None
        rate = float(info['custom_data']['sample_rate'])
    except (ConfigError, ValueError, TypeError, KeyError, OverflowError):
        return None  # the stamps tell it as well
    return rate if 0 < rate < float('inf') else None

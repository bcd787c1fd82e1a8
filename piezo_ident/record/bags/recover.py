# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Opens bags, and those whose recorder was killed as far as they go.

An unfinished bag has no metadata.yaml, an mcap file without its end, or an sqlite3 file beside
which the journal of a transaction is left.  Nothing of it is changed: a journal is applied to a
copy.  What was recovered, and what cannot be known, is said as a `Fault`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager, ExitStack
from dataclasses import dataclass
from pathlib import Path
import re
import shutil
import sqlite3
import tempfile
from typing import Any, NamedTuple

from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.files import check_regular
from piezo_ident.record.bags.check import (
    check_index,
    check_inside,
    check_journal,
    check_storage,
    check_tables,
    connected,
    metadata,
    unpacked_message,
)
from piezo_ident.record.bags.mcap_scan import Channel, MAGIC, McapScan, Message
from piezo_ident.record.record import Fault
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.metadata import parse_qos

__all__ = ['Bag', 'Stored', 'damage_as_data_error', 'is_unfinished', 'opened_bag']

#: bytes that a row of a database takes at least, and topics of a recording at most
_ROW, _TOPICS = 6, 10_000
_SIDECARS = ('-journal', '-wal')
_FORMATS = {
    'ros2msg': MessageDefinitionFormat.MSG,
    'ros2idl': MessageDefinitionFormat.IDL,
}


class Stored(NamedTuple):
    """A message as it is in a bag: its topic, when it was logged [ns], its bytes."""

    connection: Connection
    stamp: int
    raw: bytes


@dataclass(frozen=True)
class Bag:
    """
    An open bag.

    Attributes
    ----------
    path : Path
        The folder or file.
    connections : list of Connection
        The topics, with types, QoS profiles and numbers of messages.
    messages : callable
        Yields the messages of some connections in the order of their log times.
    start, end : int
        Log times of the first and the last message [ns]; equal for an empty bag.
    faults : tuple of Fault
        What was wrong with the bag as a whole.
    """

    path: Path
    connections: list[Connection]
    messages: Callable[[Collection[Connection]], Iterator[Stored]]
    start: int
    end: int
    faults: tuple[Fault, ...] = ()


@contextmanager
def opened_bag(path: str | Path) -> Iterator[Bag]:
    """
    Open a rosbag2 folder, or a single .mcap or .db3 file.

    Parameters
    ----------
    path : path
        The folder or file; one that was not finished is read as far as it goes.

    Raises
    ------
    DataError
        When it is no bag, or damaged beyond what a killed recorder leaves; its messages raise
        it too, for damage that shows itself later.
    """
    path = Path(path)
    try:
        is_there = path.exists()
    except OSError as error:
        raise DataError(f'{path}: cannot be read ({error.strerror or error})') from None
    if not is_there:
        raise DataError(f'{path}: does not exist; check the name')
    if path.is_file() and path.suffix != path.suffix.lower():
        raise DataError(f'{path}: a bag is known by .mcap or .db3 in small letters; rename it')
    with ExitStack() as stack:
        with damage_as_data_error(path):
            bag = _recovered(path, stack) if is_unfinished(path) else _finished(path, stack)
        yield bag


@contextmanager
def damage_as_data_error(path: Path) -> Iterator[None]:
    """Turn whatever a damaged bag provokes into a `DataError` that names the bag."""
    try:
        yield
    except DataError:
        raise
    # damage surfaces in a reader as anything from an assertion to a zstd error
    except Exception as error:  # noqa: BLE001
        reason = ' '.join(str(error).split()) or type(error).__name__
        raise DataError(
            f'{path}: damaged or unfinished bag ({reason[:200]}); record it again, or try '
            "'ros2 bag reindex' and 'mcap recover'"
        ) from None


def _finished(path: Path, stack: ExitStack) -> Bag:
    if path.is_dir():
        metadata(path)
    chunks = {file.name: check_storage(file) for file in _storage_files(path)}
    reader = stack.enter_context(Reader(path))
    inside: Any = reader.storage
    for storage in getattr(inside, 'storages', [inside]):
        if storage.path.name in chunks and hasattr(storage, 'chunks'):
            check_index(chunks[storage.path.name], storage.chunks, storage.path)
    is_packed = inside.metadata.compression_mode == 'message'
    if is_packed:
        # unpacked here, where there is a limit
        inside.metadata = inside.metadata._replace(compression_mode=None)

    def messages(connections: Collection[Connection]) -> Iterator[Stored]:
        with damage_as_data_error(path):
            for connection, stamp, raw in reader.messages(connections=list(connections)):
                yield Stored(connection, stamp, unpacked_message(raw) if is_packed else raw)

    empty = reader.message_count == 0
    start = 0 if empty else reader.start_time
    end = 0 if empty else reader.end_time - 1
    # rosbags takes over from the metadata whatever stands there
    texts = [text for c in reader.connections for text in (c.topic, c.msgtype)]
    numbers = {type(x) for x in (start, end, *(c.msgcount for c in reader.connections))}
    if not all(isinstance(x, str) for x in texts) or numbers != {int}:
        raise DataError(f'{path}: damaged or unfinished bag (metadata of wrong types); mend it')
    return Bag(path, reader.connections, messages, start, end)


def is_unfinished(path: Path) -> bool:
    """
    Return whether a bag lacks what closing it writes.

    Raises
    ------
    DataError
        For a folder without any bag in it.
    """
    if path.is_dir() and not (path / 'metadata.yaml').is_file():
        _storage_files(path)
        return True
    return any(_cut_off(f) for f in _storage_files(path) if f.suffix in ('.mcap', '.db3'))


def _listed(path: Path) -> list[Path]:
    """Return the files that the metadata of a folder names, none when it names none."""
    try:
        files = [path / Path(name).name for name in metadata(path)['relative_file_paths']]
    except (ConfigError, TypeError, KeyError):
        return []
    return [f for f in files if f.exists()]


def _storage_files(path: Path) -> list[Path]:
    """Return the files of a folder that belong to one recording, in order."""
    if not path.is_dir():
        check_regular(path)
        return [path]
    if (path / 'metadata.yaml').is_file():
        listed = _listed(path)
        check_inside(path, listed)
        return listed
    found = [f for f in sorted(path.iterdir()) if f.suffix in ('.mcap', '.db3')]
    if not found:
        raise DataError(
            f'{path}: no bag, metadata.yaml is missing; name a bag folder, or restore it with '
            "'ros2 bag reindex'"
        )
    check_inside(path, found)
    # a split recording numbers its files; other files side by side are recordings of their own
    recordings = {(re.sub(r'_\d+$', '', f.stem), f.suffix) for f in found}
    if len(recordings) > 1:
        raise DataError(
            f'{path}: no bag, metadata.yaml is missing; name one of its files: '
            + ', '.join(f.name for f in found)
        )
    return sorted(found, key=lambda f: int((re.findall(r'\d+$', f.stem) or ['0'])[0]))


def _cut_off(file: Path) -> bool:
    size = file.stat().st_size
    with file.open('rb') as f:
        if file.suffix == '.mcap':
            f.seek(max(0, size - len(MAGIC)))
            return f.read() != MAGIC
        head = f.read(100)
    left = any(s.is_file() and s.stat().st_size for s in _sidecars(file))
    page = int.from_bytes(head[16:18], 'big')
    # 1 stands for 65536
    return left or size < (65536 if page == 1 else page) * int.from_bytes(head[28:32], 'big')


def _sidecars(file: Path) -> list[Path]:
    return [file.with_name(file.name + end) for end in _SIDECARS]


class _SqliteScan:
    """An sqlite3 bag that need not be finished; what `McapScan` is for mcap."""

    def __init__(self, path: Path, database: Path) -> None:
        self.path = path
        self.whole, self.left = True, 0
        self._database = database

    def __iter__(self) -> Iterator[Channel | Message]:
        self.whole = True
        yielded = False
        # a damaged tree may lead back to itself, and give more than the file holds
        left = self._database.stat().st_size
        try:
            with closing(connected(self._database)) as database:
                check_tables(database, self.path)
                yield from _sqlite_channels(database)
                rows = database.execute('SELECT topic_id, timestamp, data FROM messages')
                for channel_id, stamp, data in rows:
                    if not (isinstance(stamp, int) and isinstance(data, bytes)):
                        raise sqlite3.DatabaseError('a message is no bytes')
                    left -= len(data) + _ROW
                    if left < 0:
                        raise sqlite3.DatabaseError('more messages than the file has room for')
                    yielded = True
                    yield Message(channel_id, stamp, data)
        except sqlite3.Error as error:
            if not yielded:
                reason = ' '.join(str(error).split())[:200]
                raise DataError(
                    f'{self.path}: damaged or unfinished bag ({reason}); record it again'
                ) from None
            self.whole = False


def _sqlite_channels(database: sqlite3.Connection) -> list[Channel]:
    def columns(table: str) -> set[str]:
        return {row[1] for row in database.execute(f'PRAGMA table_info({table})')}

    definitions = {}
    if 'encoded_message_definition' in columns('message_definitions'):
        definitions = {
            name: (text, kind)
            for name, text, kind in database.execute(
                'SELECT topic_type, encoded_message_definition, encoding FROM message_definitions '
                f'LIMIT {_TOPICS}'
            )
        }
    qos = 'offered_qos_profiles' if 'offered_qos_profiles' in columns('topics') else "''"
    return [
        Channel(key, topic, kind, *definitions.get(kind, ('', '')), encoding, profiles)
        for key, topic, kind, encoding, profiles in database.execute(
            f'SELECT id, name, type, serialization_format, {qos} FROM topics LIMIT {_TOPICS}'
        )
    ]


def _applied(file: Path, stack: ExitStack) -> Path:
    """Return a database with its journal applied: itself when there is none, else a copy."""
    parts = [file, *(s for s in _sidecars(file) if s.is_file() and s.stat().st_size)]
    if len(parts) == 1:
        return file
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='piezo_ident_bag_')))
    need = sum(p.stat().st_size for p in parts)
    if shutil.disk_usage(folder).free < 2 * need:
        raise DataError(
            f'{file}: a copy is needed to recover it, and {folder.parent} has no room for '
            f'{2 * need / 1e6:.0f} MB; make room, or set TMPDIR to a place with room'
        )
    for sidecar in parts[1:]:
        check_regular(sidecar)
        check_journal(sidecar)
    for part in parts:
        shutil.copyfile(part, folder / part.name)
    copy = folder / file.name
    with closing(sqlite3.connect(copy)) as database:
        # the first look at it takes back what was not committed
        database.execute('SELECT count(*) FROM sqlite_master').fetchone()
        # and this brings what is in a write-ahead log into the file
        database.execute('PRAGMA journal_mode=DELETE').fetchone()
    return copy


@dataclass
class _Pass:
    """What the first look through one file found."""

    scan: McapScan | _SqliteScan
    connections: dict[int, Connection]
    stamps: tuple[int, int] = (2**63 - 1, 0)
    count: int = 0


def _recovered(path: Path, stack: ExitStack) -> Bag:
    known: dict[tuple[str, str], Connection] = {}
    passes = []
    counts: dict[int, int] = {}
    for file in _storage_files(path):
        scan = (
            McapScan(file) if file.suffix == '.mcap' else _SqliteScan(file, _applied(file, stack))
        )
        this = _Pass(scan, {})
        first, last = this.stamps
        for entry in scan:
            if isinstance(entry, Channel):
                if entry.encoding == 'cdr':
                    key = (entry.topic, entry.type)
                    known.setdefault(key, _connection(entry, len(known) + 1))
                    this.connections[entry.id] = known[key]
            elif entry.channel in this.connections:
                topic = this.connections[entry.channel].id
                counts[topic] = counts.get(topic, 0) + 1
                this.count += 1
                first, last = min(first, entry.stamp), max(last, entry.stamp)
        this.stamps = (first, last)
        passes.append(this)
    total = sum(p.count for p in passes)
    if not total:
        raise DataError(
            f'{path}: damaged or unfinished bag without one whole message; record it again'
        )
    final = {c.id: c._replace(msgcount=counts.get(c.id, 0)) for c in known.values()}
    for this in passes:
        this.connections = {key: final[c.id] for key, c in this.connections.items()}

    def messages(connections: Collection[Connection]) -> Iterator[Stored]:
        wanted = {c.id for c in connections}
        for this in passes:
            for entry in this.scan:
                if isinstance(entry, Message):
                    connection = this.connections.get(entry.channel)
                    if connection is not None and connection.id in wanted:
                        yield Stored(connection, entry.stamp, entry.data)

    filled = [p.stamps for p in passes if p.count]
    start, end = min(first for first, _ in filled), max(last for _, last in filled)
    return Bag(path, list(final.values()), messages, start, end, (_fault(path, passes),))


def _connection(channel: Channel, number: int) -> Connection:
    try:
        qos = parse_qos(channel.qos)
    # the profiles matter to a replay alone, and it has its own
    except Exception:  # noqa: BLE001
        qos = []
    form = _FORMATS.get(channel.definition_format, MessageDefinitionFormat.NONE)
    return Connection(
        id=number,
        topic=channel.topic,
        msgtype=channel.type,
        msgdef=MessageDefinition(form, channel.definition),
        digest='',
        msgcount=0,
        ext=ConnectionExtRosbag2(channel.encoding, qos),
        owner=None,
    )


def _fault(path: Path, passes: list[_Pass]) -> Fault:
    """Say what is not there and what cannot be known."""
    lacking = []
    if path.is_dir() and not (path / 'metadata.yaml').is_file():
        lacking.append('metadata.yaml is missing')
    for this in passes:
        scan = this.scan
        if any(s.is_file() and s.stat().st_size for s in _sidecars(scan.path)):
            lacking.append(f'{scan.path.name} has a transaction that was never finished')
        elif not scan.whole:
            left = f' and {scan.left} bytes before it cannot be used' if scan.left else ''
            lacking.append(f'the end of {scan.path.name} is missing{left}')
    total = sum(p.count for p in passes)
    first = min(p.stamps[0] for p in passes if p.count)
    last = max(p.stamps[1] for p in passes if p.count)
    return Fault(
        'truncated_bag',
        f'in {path.name}, {(last - first) / 1e9:.3f} s after its first message',
        len(lacking) or 1,
        f'recovered the {total} messages before that; the recorder did not close the bag '
        f'({"; ".join(lacking) or "its end is missing"}), so what came later is lost and how much '
        'it was is unknown',
    )

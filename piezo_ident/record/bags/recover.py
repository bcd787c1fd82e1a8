# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Read bags without an index: from the beginning of each file, message by message.

An unfinished bag lacks metadata.yaml or the end of an mcap file, or has a journal beside an
sqlite3 file.  Recovery reads every whole chunk of an mcap file, and all committed rows of a
database.  The bag stays unchanged: recovery applies journals to copies, and unpacks compressed
files into copies.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import closing, ExitStack
from dataclasses import dataclass
import heapq
import itertools
from pathlib import Path
import re
import shutil
import sqlite3
import tempfile
from typing import Any, NamedTuple

from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.common.files import check_regular, load_yaml
from piezo_ident.record.record import Fault
from piezo_ident.record.tables.arrays import damage_as_data_error, library
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
)
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.metadata import parse_qos

#: first and last bytes of an mcap file
_MAGIC = b'\x89MCAP0\r\n'
_SIDECARS = ('-journal', '-wal')
_BAG_FILE = re.compile(r'(?P<name>.+(?P<storage>\.mcap|\.db3))(\.zstd?)?', re.IGNORECASE)
#: first bytes of zstd data; a message itself begins with a zero
_ZSTD = b'\x28\xb5\x2f\xfd'
#: most messages that a recorder compresses at once, and may write in another order
_AT_ONCE = 64
_FORMATS = {'ros2msg': MessageDefinitionFormat.MSG, 'ros2idl': MessageDefinitionFormat.IDL}


class Stored(NamedTuple):
    """A message in a bag: its topic, log time [ns] and bytes."""

    connection: Connection
    stamp: int
    raw: bytes


Messages = Callable[[Collection[Connection]], Iterator[Stored]]


@dataclass(frozen=True)
class Bag:
    """
    An open bag: its folder or file, and topics with types, QoS profiles and message counts.

    `messages` yields the messages of some connections: in the order of their log times from a bag
    with an index, else in the order of the files.  `start` and `end` are the log times of the
    first and the last message [ns]; they are equal for an empty bag.  `faults` lists the damage.
    """

    path: Path
    connections: list[Connection]
    messages: Messages
    start: int
    end: int
    faults: tuple[Fault, ...] = ()


def storage_of(path: Path) -> str:
    """
    Return the storage of a bag file from its name; empty for the name of another file.

    >>> [storage_of(Path(x)) for x in ('a.mcap', 'a_0.db3.zstd', 'a.csv')]
    ['.mcap', '.db3', '']
    """
    match = _BAG_FILE.fullmatch(path.name)
    return match['storage'].lower() if match else ''


#: arguments of `damage_as_data_error` for bags
DAMAGED = 'unfinished bag', "record it again, or try 'ros2 bag reindex' and 'mcap recover'"


def metadata(folder: Path) -> dict[str, Any]:
    """Return the contents of ``metadata.yaml`` in a folder; ConfigError unless it is YAML."""
    info = load_yaml(folder / 'metadata.yaml').get('rosbag2_bagfile_information')
    return info if isinstance(info, dict) else {}


def is_unfinished(path: Path) -> bool:
    """Return whether a bag was never closed; DataError for a folder without a bag."""
    files = _storage_files(path)
    if path.is_dir() and not (path / 'metadata.yaml').is_file():
        return True
    return any(map(_is_cut_off, files))


def _storage_files(path: Path) -> list[Path]:
    """Return the files that belong to one recording, in order."""
    if not path.is_dir():
        check_regular(path)
        return [path]
    if (path / 'metadata.yaml').is_file():
        try:
            listed = [path / Path(name).name for name in metadata(path)['relative_file_paths']]
        except (ConfigError, TypeError, KeyError):
            return []  # opening the bag refuses the file
        return [file for file in listed if file.exists()]
    files = [f for f in sorted(path.iterdir()) if storage_of(f)]
    if not files:
        raise DataError(
            f'{path}: no bag, metadata.yaml is missing; name a bag folder, or restore it with '
            "'ros2 bag reindex'"
        )
    # a split recording numbers its files; other files side by side are recordings of their own
    names = {f: f.name[: f.name.lower().index(storage_of(f))] for f in files}
    if len({(re.sub(r'_\d+$', '', name), storage_of(f)) for f, name in names.items()}) > 1:
        raise DataError(
            f'{path}: no bag, metadata.yaml is missing; name one of its files: '
            + ', '.join(f.name for f in files)
        )
    return sorted(files, key=lambda f: int((re.findall(r'\d+$', names[f]) or ['0'])[0]))


def _is_cut_off(file: Path) -> bool:
    size = file.stat().st_size
    with file.open('rb') as stream:
        head = stream.read(100)
        stream.seek(max(0, size - len(_MAGIC)))
        tail = stream.read()
    if file.suffix == '.db3':
        page = int.from_bytes(head[16:18], 'big')
        # 1 stands for 65536
        whole = (65536 if page == 1 else page) * int.from_bytes(head[28:32], 'big')
        return bool(_sidecars(file)) or size < whole
    return file.suffix == '.mcap' and tail != _MAGIC


def _sidecars(file: Path) -> list[Path]:
    """Return the non-empty journals of a database."""
    beside = [file.with_name(file.name + end) for end in _SIDECARS]
    return [s for s in beside if s.is_file() and s.stat().st_size]


class _Part(NamedTuple):
    """Contents and damage of one file."""

    connections: list[Connection]
    messages: Callable[[], Iterator[Stored]]
    start: int
    end: int
    lacking: str


def scanned_bag(path: Path, stack: ExitStack) -> Bag:
    """
    Open a bag whose messages come in the order of its files; `stack` closes it.

    The faults name the missing parts.  DataError for a bag without a whole message.
    """
    parts = []
    for packed in _storage_files(path):
        file = _unpacked_file(packed, stack)
        is_mcap = storage_of(packed) == '.mcap'
        part = _mcap_part(file) if is_mcap else _sqlite_part(file, stack)
        parts += [part] if part.connections else []
    if not parts:
        raise DataError(
            f'{path}: damaged or unfinished bag, or an empty bag: it holds no whole message; '
            'leave it out, or record it again'
        )
    known: dict[tuple[str, str], Connection] = {}
    for connection in itertools.chain.from_iterable(part.connections for part in parts):
        key = (connection.topic, connection.msgtype)
        old = known.get(key, connection._replace(id=len(known) + 1, msgcount=0))
        known[key] = old._replace(msgcount=old.msgcount + connection.msgcount)

    def messages(connections: Collection[Connection]) -> Iterator[Stored]:
        wanted = {(c.topic, c.msgtype) for c in connections}
        with damage_as_data_error(path, *DAMAGED):
            every = itertools.chain.from_iterable(part.messages() for part in parts)
            keys = ((m, (m.connection.topic, m.connection.msgtype)) for m in every)
            yield from unpacked(
                (m._replace(connection=known[key]) for m, key in keys if key in wanted), path
            )

    connections = list(known.values())
    start, end = min(part.start for part in parts), max(part.end for part in parts)
    lacking = [part.lacking for part in parts if part.lacking]
    if path.is_dir() and not (path / 'metadata.yaml').is_file():
        lacking.insert(0, 'metadata.yaml is missing')
    fault = Fault(
        'truncated_bag',
        f'in {path.name}, {(end - start) / 1e9:.3f} s after its first message',
        len(lacking),
        f'recovered the {sum(c.msgcount for c in connections)} messages before that; the recorder '
        f'did not close the bag ({"; ".join(lacking)}), so later messages are lost, and their '
        'number is unknown',
    )
    return Bag(path, connections, messages, start, end, (fault,) if lacking else ())


def unpacked(messages: Iterable[Stored], path: Path) -> Iterator[Stored]:
    """Yield messages; messages that were compressed one by one are unpacked and sorted."""
    held: list[tuple[int, int, Stored]] = []
    for i, message in enumerate(messages):
        if message.raw[:4] != _ZSTD:
            yield message
            continue
        zstd = library('zstandard', path).ZstdDecompressor().decompressobj()
        raw = zstd.decompress(message.raw)
        heapq.heappush(held, (message.stamp, i, message._replace(raw=raw)))
        if len(held) > _AT_ONCE:
            yield heapq.heappop(held)[2]
    while held:
        yield heapq.heappop(held)[2]


def _unpacked_file(file: Path, stack: ExitStack) -> Path:
    """Unpack a compressed file into a copy, and return the copy; return any other file itself."""
    match = _BAG_FILE.fullmatch(file.name)
    if match is None or match['name'] == file.name:
        return file
    copy = _work_folder(stack) / match['name']
    try:
        with file.open('rb') as source, copy.open('wb') as target:
            zstd = library('zstandard', file).ZstdDecompressor()
            shutil.copyfileobj(
                zstd.stream_reader(source, read_across_frames=True), target, 1 << 22
            )
    except OSError as error:
        raise DataError(
            f'{file}: cannot be unpacked in {copy.parent.parent} ({error.strerror}); make room, '
            'or set TMPDIR to a place with room'
        ) from None
    return copy


def _work_folder(stack: ExitStack) -> Path:
    return Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='piezo_ident_bag_')))


def _mcap_part(file: Path) -> _Part:
    """Read an mcap file from its beginning by the package `mcap`, as far as chunks are whole."""
    # the distributions of ROS lack this package, so it may be missing
    kinds = library('mcap.records', file, 'mcap')
    stream_reader = library('mcap.stream_reader', file, 'mcap')
    ended: list[bool] = []

    def messages() -> Iterator[Stored]:
        schemas: dict[int, Any] = {}
        connections: dict[int, Connection] = {}
        size = file.stat().st_size
        with file.open('rb') as stream:
            reader = stream_reader.StreamReader(stream, validate_crcs=True, record_size_limit=size)
            try:
                for record in reader.records:
                    if isinstance(record, kinds.Schema):
                        schemas[record.id] = record
                    elif isinstance(record, kinds.Channel):
                        if record.message_encoding == 'cdr':
                            connections[record.id] = _connection(record, schemas[record.schema_id])
                    elif isinstance(record, kinds.Message):
                        if record.channel_id in connections:
                            connection = connections[record.channel_id]
                            yield Stored(connection, record.log_time, record.data)
                    elif isinstance(record, kinds.DataEnd):
                        ended.append(True)
                        return
            # if a file ends too early, struct, zstd, lz4 and mcap raise different errors
            except Exception:  # noqa: BLE001
                return

    counted: dict[tuple[str, str], Connection] = {}
    start, end = 2**63 - 1, 0
    for connection, stamp, _ in messages():
        key = (connection.topic, connection.msgtype)
        old = counted.get(key, connection)
        counted[key] = old._replace(msgcount=old.msgcount + 1)
        start, end = min(start, stamp), max(end, stamp)
    lacking = '' if ended and not _is_cut_off(file) else f'the end of {file.name} is missing'
    return _Part([*counted.values()], messages, start, end, lacking)


def _connection(channel: Any, schema: Any) -> Connection:
    try:
        qos = parse_qos(channel.metadata.get('offered_qos_profiles', ''))
    # only a replay needs the profiles, and it has its own
    except Exception:  # noqa: BLE001
        qos = []
    form = _FORMATS.get(schema.encoding, MessageDefinitionFormat.NONE)
    return Connection(
        id=0,
        topic=channel.topic,
        msgtype=schema.name,
        msgdef=MessageDefinition(form, schema.data.decode('utf-8', 'replace')),
        digest='',
        msgcount=0,
        ext=ConnectionExtRosbag2(channel.message_encoding, qos),
        owner=None,
    )


def _sqlite_part(file: Path, stack: ExitStack) -> _Part:
    database = _applied(file, stack)
    reader = stack.enter_context(Reader(database))
    connections = {c.id: c for c in reader.connections if c.msgcount}

    def messages() -> Iterator[Stored]:
        # rosbags yields messages by their log times, not in the order of the file
        place = f'{database.resolve().as_uri()}?mode=ro&immutable=1'
        with closing(sqlite3.connect(place, uri=True)) as opened:
            for topic, *stored in opened.execute(
                'SELECT topic_id, timestamp, data FROM messages ORDER BY id'
            ):
                if topic in connections:
                    yield Stored(connections[topic], *stored)

    lacking = f'{file.name} has a transaction that was never finished' if _sidecars(file) else ''
    if not lacking and _is_cut_off(file):
        lacking = f'the end of {file.name} is missing'
    return _Part(
        [*connections.values()], messages, reader.start_time, reader.end_time - 1, lacking
    )


def _applied(file: Path, stack: ExitStack) -> Path:
    """Apply the journal to a copy of a database; without a journal return the database itself."""
    parts = [file, *_sidecars(file)]
    if len(parts) == 1:
        return file
    folder = _work_folder(stack)
    need = sum(p.stat().st_size for p in parts)
    if shutil.disk_usage(folder).free < 2 * need:
        raise DataError(
            f'{file}: a copy is needed to recover it, and {folder.parent} has no room for '
            f'{2 * need / 1e6:.0f} MB; make room, or set TMPDIR to a place with room'
        )
    for part in parts:
        shutil.copyfile(part, folder / part.name)
    copy = folder / file.name
    with closing(sqlite3.connect(copy)) as database:
        # the first query rolls back an unfinished transaction
        database.execute('SELECT count(*) FROM sqlite_master').fetchone()
        # this moves the contents of a write-ahead log into the file
        database.execute('PRAGMA journal_mode=DELETE').fetchone()
    return copy

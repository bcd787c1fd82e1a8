# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Write bags: a whole record, or messages as they arrive.

rosbags keeps an mcap chunk of 1 MiB in memory, and an sqlite3 bag in one transaction until the bag
is closed.  `BagWriter` ends chunks and transactions early, so that messages are on disk soon.  The
calls for this are internals of rosbags: `BagWriter` checks them before the first message, and
`setup.py` bounds the version.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
import os
from pathlib import Path
import sqlite3
from typing import Any, cast

from piezo_ident.common.errors import DataError
from piezo_ident.common.files import temporary_output, unwritable
from piezo_ident.record.bags.read import MESSAGE_TYPE, typestore
from piezo_ident.record.blocks import BLOCK_SIZE, cut_blocks, encode, Samples
from piezo_ident.record.channels import quantity_of_channel
from piezo_ident.record.record import Record
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.errors import WriterError

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
#: most numbers of a taken name
NAMES = 10_000

_FOREVER = QosTime(9223372036, 854775807)
#: reliable, volatile, keep last 1000: the contract of every topic that carries samples
SAMPLE_QOS = Qos(
    history=QosHistory.KEEP_LAST,
    depth=1000,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.VOLATILE,
    deadline=_FOREVER,
    lifespan=_FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_FOREVER,
    avoid_ros_namespace_conventions=False,
)


def knows_type(name: str) -> bool:
    """Return whether a message type can be described in a bag."""
    return name in typestore().fielddefs


class BagWriter:
    """
    An open bag, or several one after the other; all calls must come from one thread.

    A recording with a `max_size` [bytes on disk] has several parts.  When a `flush` finds a part
    of this size, the next message begins the next part, so no part is empty.  Each part is a whole
    bag with all topics.  The parts are numbered in their names; their custom data hold ``part``
    and ``recording``.  DataError if a bag cannot be made.

    Parameters
    ----------
    path : path
        The new folder; a taken name gets a number.
    storage : {'mcap', 'sqlite3'}
    custom_data : mapping of str to str, optional
        Entries in the metadata of the bag.
    max_size : int, optional
        Size of a part [bytes on disk]; 0 for a single bag.

    Attributes
    ----------
    parts : list of Path
        The folders so far; the last one is being written.
    file : Path
        The file that is being written.
    messages : int
        Number of written messages, all parts together.
    """

    def __init__(
        self,
        path: str | Path,
        storage: str = 'mcap',
        custom_data: Mapping[str, str] | None = None,
        max_size: int = 0,
    ) -> None:
        self.max_size = max_size
        self.messages = 0
        self.parts: list[Path] = []
        # absolute: the working directory may change
        self._path = Path(os.path.abspath(Path(path).expanduser()))
        self._storage = storage
        self._custom_data = dict(custom_data or {})
        self._topics: dict[str, tuple[str, Sequence[Qos]]] = {}
        self._number = self._closed_size = self._closed_messages = 0
        self._is_full = False
        self._begin()

    def _begin(self) -> None:
        """Open the next bag."""
        self._writer = self._opened()
        self._connections: dict[str, Connection] = {}
        storage: Any = self._writer.storage
        self.file = Path(storage.path)
        try:
            self._hand_over = _hand_over(storage, self._storage)
        except AttributeError:
            with suppress(Exception):
                self._writer.abort()
            raise DataError(
                f'{self.path}: this version of rosbags cannot be told to put messages on disk; '
                'install a version that setup.py names'
            ) from None
        custom = dict(self._custom_data)
        if self.max_size:
            name = self.parts[0].name if self.parts else ''
            custom |= {'part': str(len(self.parts)), 'recording': name}
        for key, value in custom.items():
            self._writer.set_custom_data(key, value)
        self.parts.append(self.path)
        for topic in self._topics:
            self._connect(topic)

    def _opened(self) -> Writer:
        path, begin = self._path, self._number + 1 if self.parts else 0
        # begin at the last number, because a recording of a week has more parts than `NAMES`
        for number in range(begin, begin + NAMES):
            place = path.with_name(f'{path.name}_{number}') if number else path
            try:
                if os.path.lexists(place):
                    continue
                writer = Writer(place, version=9, storage_plugin=STORAGES[self._storage])
                writer.open()
            except WriterError:
                continue  # another recorder was faster
            except (OSError, sqlite3.Error) as error:
                with suppress(OSError):
                    place.rmdir()
                raise unwritable(place, error) from None
            self._number = number
            return writer
        raise DataError(f'{path}: this name and {NAMES} numbered ones are taken; choose another')

    @property
    def path(self) -> Path:
        """The folder that is being written."""
        return self._writer.path

    @property
    def size(self) -> int:
        """Bytes on disk, all parts together."""
        return self._closed_size + self._size_here()

    def _size_here(self) -> int:
        try:
            return self.file.stat().st_size
        except OSError:
            return 0

    def __contains__(self, topic: str) -> bool:
        """Return whether a topic was added."""
        return topic in self._topics

    def add_topic(self, topic: str, message_type: str, qos: Sequence[Qos] = (SAMPLE_QOS,)) -> None:
        """Add a topic by its full name, once; DataError for a type that Jazzy does not know."""
        if not knows_type(message_type):
            raise DataError(f'{topic}: type {message_type} is not known here; leave the topic out')
        self._topics[topic] = (message_type, tuple(qos))
        self._connect(topic)

    def _connect(self, topic: str) -> None:
        message_type, qos = self._topics[topic]
        with self._disk_errors():
            self._connections[topic] = self._writer.add_connection(
                topic, message_type, typestore=typestore(), offered_qos_profiles=list(qos)
            )

    def write(self, topic: str, stamp: int, raw: bytes) -> None:
        """Write a serialised message with its log time [ns]; DataError for a full disk."""
        if self._is_full:
            self._begin_part()
        with self._disk_errors():
            self._writer.write(self._connections[topic], stamp, raw)
        self.messages += 1

    def flush(self) -> None:
        """
        Hand all messages to the system, so that they survive the end of this process.

        DataError if a bag cannot be written.
        """
        with self._disk_errors():
            self._hand_over()
        is_large = 0 < self.max_size <= self._size_here()
        self._is_full = is_large and self.messages > self._closed_messages

    def _begin_part(self) -> None:
        self.close()
        size = self.size
        self._begin()
        self._closed_size, self._closed_messages = size, self.messages
        self._is_full = False

    def close(self) -> None:
        """Write index and metadata.yaml; after a DataError the messages can be recovered."""
        try:
            with self._disk_errors():
                self._writer.close()
        except DataError:
            self.abort()
            raise

    def abort(self) -> None:
        """Close the file without index and metadata."""
        with suppress(Exception):
            self._hand_over()
        with suppress(Exception):
            self._writer.abort()

    @contextmanager
    def _disk_errors(self) -> Iterator[None]:
        try:
            yield
        except (OSError, sqlite3.Error) as error:
            reason = getattr(error, 'strerror', None) or str(error)
            raise DataError(
                f'{self.path}: cannot be written any more ({reason}); make room, and convert it: '
                'the written messages can be recovered'
            ) from None


def _hand_over(storage: Any, name: str) -> Callable[[], None]:
    """Return a function that puts all messages on disk; AttributeError if rosbags has none."""
    if name == 'sqlite3':
        return cast(Callable[[], None], storage.conn.commit)
    close_chunk, flush, _ = storage.close_chunk, storage.bio.flush, storage.chunk.bio.tell

    def hand_over() -> None:
        if storage.chunk.bio.tell():
            close_chunk()
        flush()

    return hand_over


def write_bag(
    record: Record,
    path: str | Path,
    *,
    storage: str | None = None,
    overwrite: bool = False,
    custom_data: Mapping[str, str] | None = None,
    block_size: int = BLOCK_SIZE,
) -> None:
    """
    Write a record as a rosbag2 folder, or as a single file when `path` ends in .mcap or .db3.

    The log time of a block is the time of its first sample.  Log times must be positive and rise.
    Whole seconds are therefore added to them if the record starts before zero or its clock
    restarts.  The samples keep their own times.  The `storage` of a folder is mcap or sqlite3,
    mcap by default.  The metadata hold ``sample_rate`` and the custom data, such as seed and
    program.  Raises DataError if the place is taken or cannot be written to.
    """
    path = Path(path)
    suffix = {'.mcap': 'mcap', '.db3': 'sqlite3'}.get(path.suffix.lower())
    if suffix and path.suffix != path.suffix.lower():
        raise DataError(f'{path}: no reader of bags takes {path.suffix}; write small letters')
    if storage is not None and (storage not in STORAGES or (suffix or storage) != storage):
        raise DataError(
            f'{path}: storage {storage!r} is not possible; use mcap or sqlite3, and a file name '
            'that agrees'
        )
    rates = {p.sample_rate for p in record}
    custom = dict(custom_data or {})
    if len(rates) == 1:
        custom.setdefault('sample_rate', repr(float(next(iter(rates)))))
    with temporary_output(path, overwrite=overwrite) as target:
        folder = target.with_name('bag') if suffix else target
        plugin = STORAGES[suffix or storage or 'mcap']
        with Writer(folder, version=9, storage_plugin=plugin) as writer:
            for key, value in custom.items():
                writer.set_custom_data(key, value)
            _write_pieces(writer, record, block_size)
        if suffix:
            next(f for f in folder.iterdir() if f.suffix == path.suffix).replace(target)


def _write_pieces(writer: Writer, record: Record, block_size: int) -> None:
    store = typestore()
    types: Any = store.types
    layout, message = types['std_msgs/msg/MultiArrayLayout'], types[MESSAGE_TYPE]
    further = dict.fromkeys(quantity_of_channel(k) for p in record for k in p.channels)
    connections = {
        q: writer.add_connection(
            f'/{q}', MESSAGE_TYPE, typestore=store, offered_qos_profiles=[SAMPLE_QOS]
        )
        for q in ('voltage', 'displacement', *further)
    }
    shift, latest = 0, 0.0
    for piece in record:
        columns = {'voltage': piece.v, 'displacement': piece.y}
        columns |= {quantity_of_channel(k): x for k, x in piece.channels.items()}
        first, last = (float(piece.time(k, k + 1)[0]) for k in (0, piece.n - 1))
        # shift by whole seconds, until the piece follows the previous piece
        while first + shift < latest:
            shift += 1 + int(latest - first - shift)
        latest = last + shift
        for start, stop, label in cut_blocks(piece.n, piece.segments, block_size):
            t = piece.time(start, stop)
            stamp = round(t[0] * 1e9) + shift * 1_000_000_000
            if stamp >= 2**63:
                raise DataError(
                    f't = {t[0]:.10g} s cannot be the stamp of a message, which ends at '
                    f'{2**63 / 1e9:.4g} s; write .csv or .npz, or let t begin at zero'
                )
            for quantity, x in columns.items():
                data, dims = encode(Samples(t, x[start:stop], label, quantity))
                filled = [types['std_msgs/msg/MultiArrayDimension'](*d) for d in dims]
                raw = store.serialize_cdr(message(layout(filled, 0), data), MESSAGE_TYPE)
                writer.write(connections[quantity], stamp, raw)

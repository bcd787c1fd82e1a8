# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
A bag that is written as messages arrive, and is on disk soon after, whatever ends the writer.

rosbags itself keeps an mcap chunk of 1 MiB in memory, and an sqlite3 bag in one transaction until
it is closed.  The two calls that end a chunk and a transaction early are internals of it, so they
are looked for before the first message, and `setup.py` bounds the version.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
import os
from pathlib import Path
import sqlite3
from typing import Any

from piezo_ident.common.errors import DataError
from piezo_ident.record.bags.read import SAMPLE_QOS, typestore
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.errors import WriterError

__all__ = ['STORAGES', 'BagWriter', 'LossCount', 'PartWriter', 'knows_type']

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
#: what `flush` uses inside of rosbags: storage -> attribute -> what that must have
INTERNALS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    'mcap': {'chunk': ('bio',), 'bio': ('flush',), 'close_chunk': ()},
    'sqlite3': {'conn': ('commit',)},
}
#: how many numbered names are tried
NAMES = 10_000


def knows_type(name: str) -> bool:
    """Return whether a message type can be described in a bag."""
    return name in typestore().fielddefs


class BagWriter:
    """
    An open bag; all calls must come from one thread.

    Parameters
    ----------
    path : path
        The folder to make; a number is added when it is there.
    storage : {'mcap', 'sqlite3'}
        Format.
    custom_data : mapping of str to str, optional
        For the bag's metadata.
    number : int, optional
        The first one that is tried behind the name; 0: the name itself.

    Attributes
    ----------
    number : int
        The one behind the name, 0 where there is none.
    path, file : Path
        The folder that was made, and the file in it.
    messages : int
        How many were written.

    Raises
    ------
    DataError
        When the bag cannot be made.

    Examples
    --------
    >>> writer = BagWriter('recording')  # doctest: +SKIP
    >>> writer.add_topic('/voltage', 'std_msgs/msg/Float64MultiArray')  # doctest: +SKIP
    >>> writer.write('/voltage', time.time_ns(), raw)  # doctest: +SKIP
    >>> writer.close()  # doctest: +SKIP
    """

    def __init__(
        self,
        path: str | Path,
        storage: str = 'mcap',
        custom_data: Mapping[str, str] | None = None,
        number: int = 0,
    ) -> None:
        self.messages = 0
        self.number = number
        self._storage = storage
        self._topics: dict[str, Connection] = {}
        self._writer = self._opened(Path(path).expanduser())
        self.path = self._writer.path
        inside: Any = self._writer.storage
        self._inside = inside
        self.file: Path = inside.path
        for key, value in (custom_data or {}).items():
            self._writer.set_custom_data(key, value)
        for name, parts in INTERNALS[storage].items():
            if not all(
                hasattr(getattr(inside, name, None), part) for part in parts or ('__call__',)
            ):
                self.abort()
                raise DataError(
                    f'{self.path}: this version of rosbags cannot be told to put messages on '
                    'disk; install one that setup.py names'
                )

    def _opened(self, path: Path) -> Writer:
        # made whole, so that a later change of the working directory changes nothing
        path = Path(os.path.abspath(path))
        for number in range(self.number, self.number + NAMES):
            place = path.with_name(f'{path.name}_{number}') if number else path
            try:
                if place.exists() or place.is_symlink():
                    continue
                writer = Writer(place, version=9, storage_plugin=STORAGES[self._storage])
                writer.open()
            except WriterError:
                continue  # another recorder was faster
            except (OSError, sqlite3.Error) as error:
                with suppress(OSError):
                    place.rmdir()
                reason = getattr(error, 'strerror', None) or str(error)
                raise DataError(
                    f'{place}: cannot be written ({reason}); choose a place with room and the '
                    'right to write'
                ) from None
            self.number = number
            return writer
        raise DataError(f'{path}: this name and {NAMES} numbered ones are taken; choose another')

    def __contains__(self, topic: str) -> bool:
        """Return whether a topic was added."""
        return topic in self._topics

    def add_topic(self, topic: str, message_type: str, qos: Sequence[Qos] = (SAMPLE_QOS,)) -> None:
        """
        Add a topic, once.

        Parameters
        ----------
        topic : str
            Full name.
        message_type : str
            As in ``std_msgs/msg/String``.
        qos : sequence of Qos
            What its publishers offer.

        Raises
        ------
        DataError
            When the type is none of Jazzy's, or the bag cannot be written any more.
        """
        if not knows_type(message_type):
            raise DataError(f'{topic}: type {message_type} is not known here; leave the topic out')
        try:
            self._topics[topic] = self._writer.add_connection(
                topic, message_type, typestore=typestore(), offered_qos_profiles=list(qos)
            )
        except (OSError, sqlite3.Error) as error:
            raise self._failure(error) from None

    def write(self, topic: str, stamp: int, raw: bytes) -> None:
        """
        Write a message as it is.

        Parameters
        ----------
        topic : str
            One that was added.
        stamp : int
            Log time [ns].
        raw : bytes
            Serialised message.

        Raises
        ------
        DataError
            When the bag cannot be written any more.
        """
        try:
            self._writer.write(self._topics[topic], stamp, raw)
        except (OSError, sqlite3.Error) as error:
            raise self._failure(error) from None
        self.messages += 1

    def flush(self) -> None:
        """
        Hand all that was written to the system: no end of this process loses it.

        Raises
        ------
        DataError
            When the bag cannot be written any more.
        """
        try:
            if self._storage == 'sqlite3':
                self._inside.conn.commit()
                return
            if self._inside.chunk.bio.tell():
                self._inside.close_chunk()
            self._inside.bio.flush()
        except (OSError, sqlite3.Error) as error:
            raise self._failure(error) from None

    @property
    def size(self) -> int:
        """Bytes of the file on disk."""
        try:
            return self.file.stat().st_size
        except OSError:
            return 0

    def close(self) -> None:
        """
        Finish the bag: index and metadata.yaml.

        Raises
        ------
        DataError
            When that cannot be written; what was written before can be recovered.
        """
        try:
            self._writer.close()
        except (OSError, sqlite3.Error) as error:
            self.abort()
            raise self._failure(error) from None

    def abort(self) -> None:
        """Let go of the file as it is."""
        with suppress(Exception):
            self.flush()
        with suppress(Exception):
            self._writer.abort()

    def _failure(self, error: Exception) -> DataError:
        reason = getattr(error, 'strerror', None) or str(error)
        return DataError(
            f'{self.path}: cannot be written any more ({reason}); make room, and convert it: what '
            'was written can be recovered'
        )


class PartWriter:
    """
    Bags one after the other: when one is large enough, it is closed and the next one begun.

    The parts have the name of the first with a number behind it; each is a whole bag with all
    topics, and its custom data say which ``part`` of which ``recording`` it is.  All calls must
    come from one thread.

    Parameters
    ----------
    path, storage, custom_data
        As for `BagWriter`.
    max_size : int, optional
        Bytes on disk from which the next part is begun, looked at when the bag is flushed; 0 for
        one bag without end.

    Attributes
    ----------
    parts : list of Path
        The folders so far; the last one is being written.

    Raises
    ------
    DataError
        When a bag cannot be made.
    """

    def __init__(
        self,
        path: str | Path,
        storage: str = 'mcap',
        custom_data: Mapping[str, str] | None = None,
        max_size: int = 0,
    ) -> None:
        self.max_size = max_size
        self._make = (Path(path), storage, dict(custom_data or {}))
        self._topics: dict[str, tuple[str, Sequence[Qos]]] = {}
        self._messages = self._size = 0
        self.parts: list[Path] = []
        self._bag = self._next()

    def _next(self) -> BagWriter:
        path, storage, custom = self._make
        number = self._bag.number + 1 if self.parts else 0
        if self.max_size:
            name = self.parts[0].name if self.parts else ''
            custom = {**custom, 'part': str(len(self.parts)), 'recording': name}
        # a week has more parts than names are tried
        bag = BagWriter(path, storage, custom, number)
        self.parts.append(bag.path)
        for topic, (message_type, qos) in self._topics.items():
            bag.add_topic(topic, message_type, qos)
        return bag

    @property
    def path(self) -> Path:
        """The folder that is being written."""
        return self._bag.path

    @property
    def messages(self) -> int:
        """How many were written, all parts together."""
        return self._messages + self._bag.messages

    @property
    def size(self) -> int:
        """Bytes on disk, all parts together."""
        return self._size + self._bag.size

    def __contains__(self, topic: str) -> bool:
        """Return whether a topic was added."""
        return topic in self._topics

    def add_topic(self, topic: str, message_type: str, qos: Sequence[Qos] = (SAMPLE_QOS,)) -> None:
        """Add a topic, once; see `BagWriter.add_topic`."""
        self._bag.add_topic(topic, message_type, qos)
        self._topics[topic] = (message_type, tuple(qos))

    def write(self, topic: str, stamp: int, raw: bytes) -> None:
        """Write a message as it is; see `BagWriter.write`."""
        self._bag.write(topic, stamp, raw)

    def flush(self) -> None:
        """
        Hand all that was written to the system, and begin the next part when it is time.

        Raises
        ------
        DataError
            When a bag cannot be written any more, or the next one not be made.
        """
        self._bag.flush()
        if self.max_size and self._bag.size >= self.max_size and self._bag.messages:
            self._bag.close()
            messages, size = self.messages, self.size
            self._bag = self._next()
            self._messages, self._size = messages, size

    def close(self) -> None:
        """Finish the last bag; see `BagWriter.close`."""
        self._bag.close()

    def abort(self) -> None:
        """Let go of the file as it is."""
        self._bag.abort()


class LossCount:
    """
    Counts what is missing in the numbers of a topic's messages, whoever of several sent them.

    >>> losses = LossCount()
    >>> for number in (7, 8, 1, 9, 2, 5):
    ...     losses.note(number)
    >>> losses.lost
    2
    """

    #: among several publishers a larger gap is another one, joined late
    GAP = 1000

    def __init__(self) -> None:
        self.lost = 0
        self._last: list[int] = []

    def note(self, number: int, *, alone: bool = False) -> None:
        """Take note of a number; `alone`: of who gave the one before, and is the only one."""
        before = [n for n in self._last if n < number and (alone or number - n <= self.GAP)]
        if not before:
            self._last.append(number)
            return
        nearest = max(before)
        self.lost += number - nearest - 1
        self._last[self._last.index(nearest)] = number

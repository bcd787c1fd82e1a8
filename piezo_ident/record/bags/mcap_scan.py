# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
An mcap file read record by record from its beginning, finished or not.

A recorder that was killed leaves no index and no footer, and perhaps half a record at the end.
Everything before that is whole, and is found here.  What a file says of its own sizes is checked
against the file before any memory is taken.
"""

from __future__ import annotations

from binascii import crc32
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
import struct
from typing import Any, BinaryIO, NamedTuple

from piezo_ident.common.errors import DataError
from rosbags.rosbag2 import storage_mcap

__all__ = ['MAGIC', 'Channel', 'McapScan', 'Message']

# what rosbags itself unpacks with, whatever the version of Python
_zstd: Any = storage_mcap.__dict__['zstd']
_lz4_decompress: Any = storage_mcap.__dict__['lz4_decompress']

MAGIC = b'\x89MCAP0\r\n'


def unpacked(size: int) -> int:
    """Return how many bytes a packed file of a size [bytes] may unpack to."""
    return max(64 * 1024 * 1024, 100 * size)


#: no chunk of ours passes 1 MiB by more than a message; others write some MiB
LARGEST = 256 * 1024 * 1024

_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
_U16, _U32, _U64 = struct.Struct('<H'), struct.Struct('<I'), struct.Struct('<Q')
_HEAD = struct.Struct('<BQ')
_MESSAGE_HEAD = struct.Struct('<HIQQ')
_CHUNK_HEAD = struct.Struct('<QQQI')


class Channel(NamedTuple):
    """A topic as the file declares it."""

    id: int
    topic: str
    type: str
    definition: str
    definition_format: str
    encoding: str
    qos: str


class Message(NamedTuple):
    """One message: of which channel, when it was logged [ns], and its bytes."""

    channel: int
    stamp: int
    data: bytes


class _Damage(Exception):
    """A record that is all there and yet makes no sense."""


@dataclass
class McapScan:
    """
    An mcap file that need not be finished; iterate over it for its channels and messages.

    Attributes
    ----------
    path : Path
        The file.
    whole : bool
        Whether the last iteration came to the regular end of the data.
    left : int
        Bytes behind the last whole record that it could not use.
    """

    path: Path
    whole: bool = False
    left: int = 0

    def __iter__(self) -> Iterator[Channel | Message]:
        """
        Yield every channel and every message, in the order of the file.

        Raises
        ------
        DataError
            When the file is none, or a record in it is damaged.
        """
        self.whole, self.left = False, 0
        schemas: dict[int, tuple[str, str, str]] = {}
        with self.path.open('rb') as file:
            size = file.seek(0, 2)
            file.seek(0)
            if file.read(len(MAGIC)) != MAGIC:
                raise DataError(f'{self.path}: damaged or unfinished bag: is no mcap file')
            try:
                for opcode, body in self._top_level(file, size):
                    yield from _entries(opcode, body, schemas)
            except (_Damage, struct.error, UnicodeDecodeError) as error:
                raise self._damaged(file, error) from None

    def chunks(self) -> set[tuple[int, str, int, int]]:
        """
        Return place, compression, packed size and size of each chunk of a finished file.

        Each was unpacked once, so that whoever relies on these numbers takes no more memory.

        Raises
        ------
        DataError
            When the file is not what it says.
        """
        found = set()
        with self.path.open('rb') as file:
            size = file.seek(0, 2)
            left, at = unpacked(size), file.seek(len(MAGIC))
            try:
                while at < size - len(MAGIC):
                    opcode, length = _HEAD.unpack(file.read(_HEAD.size))
                    end = at + _HEAD.size + length
                    if end > size:
                        raise _Damage(f'a record of {length} bytes')
                    if opcode == _CHUNK:
                        body = memoryview(file.read(_allowed(length, 'a chunk')))
                        head = _chunk_head(body)
                        left -= head.size
                        if left < 0:
                            raise _Damage('chunks of more than a file of this size holds')
                        if len(_contents(body, head, whole=True)) != head.size:
                            raise _Damage('a chunk whose size is wrong')
                        found.add((at, head.compression, head.packed_size, head.size))
                    at = file.seek(end)
            except (_Damage, struct.error, UnicodeDecodeError) as error:
                raise self._damaged(file, error) from None
        return found

    def _damaged(self, file: BinaryIO, error: Exception) -> DataError:
        return DataError(
            f'{self.path}: damaged or unfinished bag, a record before byte {file.tell()} '
            f'makes no sense ({error}); record it again'
        )

    def _top_level(self, file: BinaryIO, size: int) -> Iterator[tuple[int, memoryview]]:
        """Yield the records that count, those of chunks too."""
        while True:
            at = file.tell()
            head = file.read(_HEAD.size)
            self.left = size - at
            if len(head) < _HEAD.size:
                return
            opcode, length = _HEAD.unpack(head)
            if not 0 < opcode <= _DATA_END and opcode < 0x80:
                return
            room = size - file.tell()
            if opcode == _CHUNK:
                body = memoryview(file.read(_allowed(min(length, room), 'a chunk')))
                self.left -= yield from _chunk(body, length <= room)
                if length > room:
                    return
                continue
            if length > room:
                return
            if opcode in (_FOOTER, _DATA_END):
                self.whole, self.left = True, 0
                return
            if opcode in (_SCHEMA, _CHANNEL, _MESSAGE):
                yield opcode, memoryview(file.read(_allowed(length, 'a record')))
            else:
                file.seek(length, 1)


def _allowed(length: int, what: str) -> int:
    if length > LARGEST:
        raise _Damage(f'{what} of {length} bytes')
    return length


def _chunk(body: memoryview, whole: bool) -> Generator[tuple[int, memoryview], None, int]:
    """Yield the records of a chunk as far as they go, and return how many bytes they took."""
    try:
        head = _chunk_head(body)
    except (struct.error, _Damage):
        if whole:
            raise
        return 0  # not even the head of the last chunk is there
    raw = _contents(body, head, whole=whole)
    if whole and (len(raw) != head.size or (head.checksum and crc32(raw) != head.checksum)):
        raise _Damage('a chunk whose checksum or size is wrong')
    start = 0
    while start + _HEAD.size <= len(raw):
        opcode, length = _HEAD.unpack_from(raw, start)
        if length > len(raw) - start - _HEAD.size:
            break
        start += _HEAD.size
        yield opcode, raw[start : start + length]
        start += length
    if whole and start != len(raw):
        raise _Damage('a chunk that ends within a record')
    # bytes of a compressed chunk cannot be told apart
    return _HEAD.size + (len(body) if whole else head.at + start if not head.compression else 0)


class _ChunkHead(NamedTuple):
    """Size and checksum of what is in a chunk, how it is packed, how large, and where."""

    size: int
    checksum: int
    compression: str
    packed_size: int
    at: int


def _chunk_head(body: memoryview) -> _ChunkHead:
    _, _, size, checksum = _CHUNK_HEAD.unpack_from(body)
    compression, at = _text(body, _CHUNK_HEAD.size)
    (packed_size,) = _U64.unpack_from(body, at)
    return _ChunkHead(size, checksum, compression, packed_size, at + 8)


def _contents(body: memoryview, head: _ChunkHead, *, whole: bool) -> memoryview:
    packed = body[head.at : head.at + head.packed_size]
    if whole and len(packed) != head.packed_size:
        raise _Damage(f'a chunk that announces {head.packed_size} bytes')
    return _unpacked(packed, head.compression, _allowed(head.size, 'a chunk'), whole)


def _unpacked(packed: memoryview, compression: str, size: int, whole: bool) -> memoryview:
    """Return the contents of a chunk, never more than it says that it holds."""
    if not compression:
        return packed
    try:
        if compression == 'zstd':
            decompressor = _zstd.ZstdDecompressor()
            return memoryview(decompressor.decompress(packed, max_length=size + 1))
        if compression == 'lz4':
            # the frame's own size of content is what its library takes memory for
            flags = packed[4] if len(packed) > 14 else 0
            if flags & 0x08 and _U64.unpack_from(packed, 6)[0] != size:
                raise _Damage('a chunk with two sizes')
            # half a frame of lz4 gives nothing
            return memoryview(_lz4_decompress(bytes(packed)) if whole else b'')
    except _Damage:
        raise
    # each library has errors of its own, that share no base
    except Exception as error:  # noqa: BLE001
        raise _Damage(f'a chunk that does not unpack: {error}') from None
    raise _Damage(f'a chunk with compression {compression!r}')


def _text(body: memoryview, at: int) -> tuple[str, int]:
    """Return a length-prefixed text and where it ends."""
    (length,) = _U32.unpack_from(body, at)
    if length > len(body) - at - 4:
        raise _Damage(f'a text of {length} bytes')
    return str(body[at + 4 : at + 4 + length], 'utf-8'), at + 4 + length


def _entries(
    opcode: int, body: memoryview, schemas: dict[int, tuple[str, str, str]]
) -> Iterator[Channel | Message]:
    if opcode == _MESSAGE:
        channel, _, stamp, _ = _MESSAGE_HEAD.unpack_from(body)
        yield Message(channel, stamp, bytes(body[_MESSAGE_HEAD.size :]))
    elif opcode == _SCHEMA:
        (key,) = _U16.unpack_from(body)
        name, at = _text(body, 2)
        kind, at = _text(body, at)
        schemas[key] = (name, kind, _text(body, at)[0])
    elif opcode == _CHANNEL:
        (key,), (schema,) = _U16.unpack_from(body), _U16.unpack_from(body, 2)
        topic, at = _text(body, 4)
        encoding, at = _text(body, at)
        (length,) = _U32.unpack_from(body, at)
        at, end = at + 4, at + 4 + length
        metadata = {}
        while at < end:
            name, at = _text(body, at)
            metadata[name], at = _text(body, at)
        name, kind, definition = schemas.get(schema, ('', '', ''))
        qos = metadata.get('offered_qos_profiles', '')
        yield Channel(key, topic, name, definition, kind, encoding, qos)

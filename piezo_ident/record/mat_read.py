# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""
MATLAB 5 files, read without SciPy: numbers, text, and cells of text.

SciPy's reader takes memory for the shape that an array announces, follows cells within cells as
deep as they go, and ends the process on some damaged files.  So the few things that a record
needs are read here; every size is checked against the bytes that are there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import math
import struct
from typing import Any
import zlib

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.limits import unpacked

__all__ = ['read_variables']

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_CELL, _CHAR, _NUMERIC, _OPAQUE = 1, 4, range(6, 16), 17
_COMPLEX = 0x08
#: numbers, and characters, by the type of the data
_NUMBERS = {
    1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 9: 'f8', 12: 'i8', 13: 'u8',
}  # fmt: skip
_CODECS = {1: 'latin-1', 2: 'latin-1', 4: 'utf-16', 16: 'utf-8', 17: 'utf-16', 18: 'utf-32'}
#: enough of a packed variable to read its name
_BEGINNING = 4096


def read_variables(
    data: bytes, wanted: Callable[[str], bool]
) -> tuple[tuple[str, ...], dict[str, NDArray[Any]]]:
    """
    Read a MATLAB file.

    Parameters
    ----------
    data : bytes
        The whole file.
    wanted : callable
        Tells of a name whether the variable is wanted.

    Returns
    -------
    tuple of str
        The names of all variables.
    dict of str to ndarray
        The wanted ones: numbers in their shape; a text of m rows as m texts; cells as objects.

    Raises
    ------
    ValueError
        When a size does not fit, or a wanted variable is neither numbers, text nor texts.
    """
    order = {b'IM': '<', b'MI': '>'}.get(data[126:128])
    if order is None:
        raise ValueError('not a MATLAB 5 file')
    names: list[str] = []
    found = {}
    room = unpacked(len(data))
    for kind, body in _elements(memoryview(data)[_HEADER:], order):
        content = body
        if kind == _COMPRESSED:
            kind, content = _first(_inflated(body, _BEGINNING), order)
        if kind != _MATRIX:
            continue
        name = _name(content, order)
        names.append(name)
        if not wanted(name):
            continue
        if content is not body:
            whole = _inflated(body, room + 1)
            room -= len(whole)
            if room < 0:
                raise ValueError(f'{name} unpacks to more than a file of this size holds')
            content = next(_elements(whole, order))[1]
        found[name] = _array(content, order, name)
    return tuple(names), found


def _elements(data: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Yield type and content of each element; all of it must be there."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f'{order}II', data, at)
        start, at = at + 8, at + 8 + size + (0 if kind == _COMPRESSED else -size % 8)
        if kind >> 16:
            # up to four bytes stand in the tag itself
            kind, size, start, at = kind & 0xFFFF, kind >> 16, start - 4, start
            if size > 4:
                raise ValueError(f'a short element of {size} bytes')
        if start + size > len(data):
            raise ValueError(f'an element of {size} bytes where {len(data) - start} are')
        yield kind, data[start : start + size]


def _first(data: memoryview, order: str) -> tuple[int, memoryview]:
    """Return type and beginning of the one element of a packed variable."""
    if len(data) < 8:
        raise ValueError('a packed variable without contents')
    return int(struct.unpack_from(f'{order}I', data)[0]), data[8:]


def _inflated(body: memoryview, most: int) -> memoryview:
    return memoryview(zlib.decompressobj().decompress(body, most))


def _name(content: memoryview, order: str) -> str:
    parts = _elements(content, order)
    # what MATLAB calls opaque has no shape
    if _flags(next(parts, None), order) & 0xFF != _OPAQUE:
        next(parts, None)
    return str(next(parts, (0, b''))[1], 'latin-1')


def _flags(element: tuple[int, memoryview] | None, order: str) -> int:
    if element is None or len(element[1]) < 4:
        raise ValueError('an array without flags')
    return int(struct.unpack_from(f'{order}I', element[1])[0])


def _array(content: memoryview, order: str, name: str, *, inside: bool = False) -> NDArray[Any]:
    if inside and not len(content):
        return np.empty(0)  # an empty cell
    parts = list(_elements(content, order))
    if len(parts) < 3:
        raise ValueError(f'{name} is no array')
    flags, data = _flags(parts[0], order), parts[3:]
    shape = struct.unpack(f'{order}{len(parts[1][1]) // 4}i', parts[1][1])
    if any(n < 0 for n in shape):
        raise ValueError(f'{name} has a negative size')
    kind, size = flags & 0xFF, math.prod(shape)
    if kind == _CELL and not inside:
        _fits(name, len(data), size)
        cells = np.empty(size, dtype=object)
        for i, (_, inner) in enumerate(data):
            cells[i] = _array(inner, order, name, inside=True)
        return cells.reshape(shape, order='F')
    if kind == _CHAR:
        if not size:
            return np.array([''])
        _fits(name, len(data), 1)
        text = _text(*data[0], order)
        _fits(name, len(text), size)
        rows = np.array(list(text)).reshape(shape, order='F').reshape(-1, shape[-1])
        return np.array([''.join(row) for row in rows.tolist()])
    if kind in _NUMERIC:
        is_complex = bool(flags >> 8 & _COMPLEX)
        _fits(name, len(data), 2 if is_complex else 1)
        parts_of = [_numbers(mi, part, order, name, size) for mi, part in data]
        whole = parts_of[0] + 1j * parts_of[1] if is_complex else parts_of[0]
        return np.asarray(whole.reshape(shape, order='F'))
    raise ValueError(f'{name} holds something else than numbers or text')


def _fits(name: str, there: int, announced: int) -> None:
    if there != announced:
        raise ValueError(f'{name} holds {there} parts, and announces {announced}')


def _numbers(kind: int, data: memoryview, order: str, name: str, size: int) -> NDArray[Any]:
    if kind not in _NUMBERS:
        raise ValueError(f'{name} holds data of unknown type {kind}')
    dtype = np.dtype(order + _NUMBERS[kind])
    _fits(name, len(data), size * dtype.itemsize)
    return np.frombuffer(data, dtype=dtype)


def _text(kind: int, data: memoryview, order: str) -> str:
    codec = _CODECS.get(kind)
    if codec is None:
        raise ValueError(f'text of unknown type {kind}')
    wide = codec in ('utf-16', 'utf-32')
    return str(data, f'{codec}-{"le" if order == "<" else "be"}' if wide else codec)

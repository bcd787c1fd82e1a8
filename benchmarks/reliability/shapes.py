# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""Inputs that have the right structure and the wrong contents, as hypothesis strategies."""

from __future__ import annotations

from collections.abc import Callable
import copy
import io
import json
from pathlib import Path
import random
import struct
from typing import Any
import zipfile

from hypothesis import strategies as st
import numpy as np
from piezo_ident.effects import catalogue
from piezo_ident.excitation.catalogue import SIGNALS
from piezo_ident.model.files import parse_yaml
from reliability.targets import seeds
import scipy.io

__all__ = ['mutated', 'shapes']

MARKUP = '<script>alert(1)</script>'

NUMBERS = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.integers(-(2**70), 2**70),
    st.sampled_from([0, -1, 5e-324, 1e300, -1e308, 10**400, 2**31 - 1, True, '1e-5', '.nan']),
)
TEXTS = st.one_of(
    st.text(max_size=20),
    st.sampled_from([MARKUP, '../../etc/passwd', '\x1b[31m', '$\\frac', 'x' * 1000, '\ud800', '']),
)
SCALARS = st.one_of(NUMBERS, TEXTS, st.none(), st.booleans())
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(TEXTS, inner, max_size=3)
    ),
    max_leaves=8,
)


def _text(value: Any) -> bytes:
    return json.dumps(value, skipkeys=True).encode()


@st.composite
def _replaced(draw: Any, valid: Any) -> Any:
    """Return a copy of nested data with a few of its values replaced, renamed or gone."""
    data = copy.deepcopy(valid)
    for _ in range(draw(st.integers(1, 3))):
        node = data
        while True:
            keys = list(node) if isinstance(node, dict) else list(range(len(node)))
            if not keys:
                break
            key = draw(st.sampled_from(keys))
            if isinstance(node[key], (dict, list)) and node[key] and draw(st.integers(0, 3)):
                node = node[key]
                continue
            what = draw(st.integers(0, 5))
            if what == 0:
                del node[key]
            elif what == 1 and isinstance(node, dict):
                node[draw(TEXTS)] = node.pop(key)
            else:
                node[key] = draw(VALUES)
            break
    return data


def _yaml(name: str, folder: Path) -> st.SearchStrategy[bytes]:
    valid = [parse_yaml(text.decode(), name) for text in seeds(name, folder)]
    return st.sampled_from(valid).flatmap(_replaced).map(_text)


@st.composite
def _effect(draw: Any) -> bytes:
    number = draw(st.integers(0, len(catalogue()) - 1))
    kind = catalogue()[sorted(catalogue())[number]]
    values = {
        p.name: draw(
            st.one_of(
                VALUES,
                st.lists(NUMBERS, max_size=4) if p.vector else NUMBERS,
                st.floats(p.lower, p.upper) if p.kind == 'number' else TEXTS,
            )
        )
        for p in kind.parameters
        if draw(st.integers(0, 9))
    }
    if not draw(st.integers(0, 9)):
        values[draw(TEXTS)] = draw(VALUES)
    return bytes([number]) + _text(values)


@st.composite
def _programme(draw: Any) -> bytes:
    usual = st.one_of(st.floats(0.01, 10), st.integers(1, 10), NUMBERS)
    segments = []
    for _ in range(draw(st.integers(1, 3))):
        name = draw(st.sampled_from(sorted(SIGNALS)))
        item: dict[str, Any] = {'signal': name}
        for key, option in SIGNALS[name].options.items():
            if draw(st.integers(0, 7)):
                if option.choices:
                    item[key] = draw(st.one_of(st.sampled_from(option.choices), VALUES))
                else:
                    one = st.one_of(usual, VALUES)
                    many = st.lists(usual, min_size=1, max_size=3)
                    item[key] = draw(many if option.many else one)
        segments.append(item)
    head = {'limits': draw(st.one_of(st.just([-20, 20]), st.just([-1e308, 1e308]), VALUES))}
    for key in ('rest', 'slew', 'seed'):
        if not draw(st.integers(0, 4)):
            head[key] = draw(usual)
    return _text({**head, 'segments': segments})


@st.composite
def _wire(draw: Any) -> bytes:
    n = draw(st.integers(0, 5))
    near = st.integers(-(2**31), 2**31 - 1)
    sizes = [draw(st.one_of(st.just(right), st.just(right), near)) for right in (n, 2 * n, 2, 2)]
    offset = draw(st.one_of(st.just(0), st.integers(-128, 127)))
    label = draw(st.sampled_from(['sample:noise|t,voltage', 'sample:|t,x_a', f'{MARKUP}|', '|t,']))
    numbers = draw(st.lists(st.floats(), min_size=0, max_size=12))
    if draw(st.booleans()):
        numbers = (numbers + [0.0] * 2 * n)[: 2 * n]
    return (
        struct.pack('<iiiib', *sizes, offset)
        + label.encode().ljust(43, b' ')
        + np.array(numbers, dtype=np.float64).tobytes()
    )


@st.composite
def _csv(draw: Any) -> bytes:
    header = draw(
        st.one_of(
            st.permutations(['t', 'v', 'y', 'segment', 'x_a']),
            st.lists(st.one_of(TEXTS, st.sampled_from(['t', 'v', 'y'])), max_size=6),
        )
    )
    cell = st.one_of(NUMBERS.map(str), TEXTS, st.floats(-10, 10).map(repr))
    clocked = draw(st.booleans())
    lines = [','.join(header)]
    for i in range(draw(st.integers(0, 12))):
        row = [draw(cell) for _ in header]
        if clocked and 't' in header:
            row[header.index('t')] = repr(i / 10)
        lines.append(','.join(row))
    return draw(st.sampled_from(['\n', '\r\n', '\r'])).join(lines).encode('utf-8', 'replace')


_ARRAYS = st.one_of(
    st.lists(st.floats(), max_size=6).map(np.array),
    st.lists(st.integers(-5, 5), min_size=1, max_size=6).map(np.array),
    st.sampled_from(
        [
            np.arange(6.0),
            np.arange(6.0) / 10,
            np.arange(6, dtype='>f4'),
            np.ones((2, 3)),
            np.ones((6, 1, 1)),
            np.ones(6) * 1j,
            np.array(['a', MARKUP]),
            np.zeros((0, 5)),
            np.array(3.0),
            np.array(True),
            np.array([{}], dtype=object),
            np.array([(1, 2.0)], dtype=[('a', 'i4'), ('b', 'f8')]),
            np.array(['2020-01-01'], dtype='datetime64[D]'),
            np.full(6, 5e-324),
            np.array([0.0, 1e-12, 2e-12, 3e-12]),
            np.array([0.0, 1e17, 2e17]),
        ]
    ),
)
_NAMES = st.sampled_from(['t', 'v', 'y', 'x_a', 'segment_name', 'segment_start', 'other'])


@st.composite
def _tables(draw: Any) -> dict[str, Any]:
    n = 6
    table = {'t': np.arange(n) / 10, 'v': np.arange(n) / 3, 'y': 1e-6 * np.arange(n)}
    table.update(draw(st.dictionaries(_NAMES, _ARRAYS, max_size=4)))
    return table


@st.composite
def _npz(draw: Any) -> bytes:
    table = draw(_tables())
    out = io.BytesIO()
    packing = draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2]))
    with zipfile.ZipFile(out, 'w', packing) as archive:
        for name, x in table.items():
            member = io.BytesIO()
            np.save(member, x)
            raw = member.getvalue()
            if not draw(st.integers(0, 3)):
                shape = draw(
                    st.sampled_from(
                        [
                            '(6,)',
                            '(10**9,)',
                            '(999999999999,)',
                            '(-6,)',
                            '(2, -3)',
                            '(6.0,)',
                            '"x"',
                            '(0, 9223372036854775807)',
                            '()',
                        ]
                    )
                )
                kind = draw(
                    st.sampled_from(['<f8', '|O', 'V8', '<U99', '<f16', 'M8[s]', '(3,)f8'])
                )
                head = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n"
                version = draw(st.sampled_from([b'\x01\0', b'\x02\0', b'\x03\0', b'\x09\0']))
                size = struct.pack('<H' if version == b'\x01\0' else '<I', len(head))
                raw = b'\x93NUMPY' + version + size + head.encode() + raw[-48:]
            archive.writestr(f'{name}{draw(st.sampled_from([".npy", ".npy", ".npy", ""]))}', raw)
    return out.getvalue()


@st.composite
def _mat(draw: Any) -> bytes:
    table = {k: x for k, x in draw(_tables()).items() if np.asarray(x).dtype.kind not in 'MmV'}
    for name in draw(st.lists(_NAMES, max_size=2)):
        cells = np.empty(2, dtype=object)
        cells[:] = ['a', draw(st.sampled_from([1.0, MARKUP, '', np.array([cells], object)]))]
        table[name] = draw(
            st.sampled_from([cells, {'a': 1}, np.eye(3), scipy.sparse.eye(3).tocsc(), 'text'])
        )
    out: Any = io.BytesIO()
    try:
        scipy.io.savemat(out, table, do_compression=draw(st.booleans()), oned_as='column')
    except (TypeError, ValueError, RecursionError):
        return b''
    data = bytearray(out.getvalue())
    for _ in range(draw(st.integers(0, 2))):
        at = draw(st.integers(0, len(data) // 4 - 1)) * 4
        size = draw(st.sampled_from([0, 1, 9, 2**20, 2**31 - 1, 2**32 - 1, 14, 15]))
        data[at : at + 4] = struct.pack('<I', size)
    return bytes(data)


def mutated(valid: list[bytes]) -> st.SearchStrategy[bytes]:
    """Return bytes of valid inputs, changed here and there."""
    return st.builds(_mutate, st.sampled_from(valid), st.integers(0, 2**32))


def _mutate(data: bytes, seed: int) -> bytes:
    rng, out = random.Random(seed), bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(out) + 1)
        what = rng.randrange(5)
        if what == 0:
            out[at : at + 1] = bytes([rng.randrange(256)])
        elif what == 1:
            number = rng.choice([0, 1, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1])
            out[at : at + 8] = struct.pack('<Q', number)
        elif what == 2:
            del out[at : at + rng.randint(1, 16)]
        elif what == 3:
            begin = rng.randrange(len(out) + 1)
            out[at:at] = out[begin : begin + rng.randint(1, 64)]
        else:
            del out[at:]
    return bytes(out)


def shapes(name: str, folder: Path) -> st.SearchStrategy[bytes]:
    """Return the strategy of a target."""
    own: dict[str, Callable[[], st.SearchStrategy[bytes]]] = {
        'wire': _wire,
        'effect': _effect,
        'csv': _csv,
        'npz': _npz,
        'mat': _mat,
        'programme': _programme,
    }
    if name in own:
        return own[name]()
    if name in ('model', 'stage', 'metadata'):
        return _yaml(name, folder)
    return mutated(seeds(name, folder))

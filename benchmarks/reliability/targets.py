# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""
What reads files and messages from strangers, each as a function of bytes, with small valid inputs.

A target may raise the package's own errors, which it swallows; whatever else it raises is a
finding.  The readers get their bytes in a file of a folder that the caller gives.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
import io
import json
from pathlib import Path
import shutil
import struct
from typing import Any
from unittest import mock
import zipfile

import numpy as np
from piezo_ident.common.config import find_config
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.effects import catalogue, find_effect
from piezo_ident.excitation import signals as excitation
from piezo_ident.excitation.program import parse_program
from piezo_ident.model.files import model_from_dict, parse_yaml
from piezo_ident.model.simulated_stage import stage_from_dict
from piezo_ident.model.stage_model import EffectSetting
from piezo_ident.record.bags.read import MESSAGE_TYPE, typestore
from piezo_ident.record.blocks import decode, Dimension, encode, Samples
from piezo_ident.record.io import read_record, write_record
from piezo_ident.record.join import join
from piezo_ident.record.record import Piece, Record, Segment
from piezo_ident.record.stream import Stream

__all__ = ['TARGETS', 'attempt', 'example', 'seeds']

#: what a programme may be long while fuzzed: the limit itself is 400 MB of samples
SHORT = 20_000


def example(n: int = 40) -> Record:
    """Return a small record with segments and a further channel."""
    rng = np.random.default_rng(0)
    v = 5.0 + 4.0 * np.sin(np.arange(n) / 7.0)
    return Record(
        (
            Piece(
                v,
                7.5e-6 * v + 1e-9 * rng.standard_normal(n),
                1000.0,
                segments=(Segment('noise', 0, n // 2), Segment('sine:50Hz', n // 2, n)),
                channels={'temperature': 20.0 + 0.01 * rng.standard_normal(n)},
            ),
        )
    )


# --- targets --------------------------------------------------------------------------------


def wire(data: bytes, folder: Path | None = None) -> None:
    """Read a block whose layout and numbers are the bytes; what is one goes into a stream."""
    head = struct.unpack('<iiiib', data[:17].ljust(17, b'\0'))
    text, numbers = data[17:60], np.frombuffer(data[60 : 60 + (len(data) - 60) // 8 * 8])
    labels = text.decode('latin-1').split('|', 1)
    labels += [''] * (2 - len(labels))
    dims = (Dimension(labels[0], head[0], head[1]), Dimension(labels[1], head[2], head[3]))
    samples = decode(numbers, dims[: 2 + head[4] % 2], head[4])
    stream, other = Stream(), Stream()
    stream.append(samples, 0)
    other.append(samples, 1)
    join({'voltage': stream, 'displacement': other})


def message(data: bytes, folder: Path | None = None) -> None:
    """Read a serialised message as it stands in a bag."""
    try:
        found: Any = typestore().deserialize_cdr(data, MESSAGE_TYPE)
    # the reader of bags turns whatever this is into its own error
    except Exception:  # noqa: BLE001
        return
    decode(found.data, found.layout.dim, found.layout.data_offset)


def model(data: bytes, folder: Path | None = None) -> None:
    """Read a model file."""
    model_from_dict(parse_yaml(data.decode('utf-8', 'replace'), 'model'))


def stage(data: bytes, folder: Path | None = None) -> None:
    """Read the configuration of a simulated stage."""
    stage_from_dict(parse_yaml(data.decode('utf-8', 'replace'), 'stage'))


def programme(data: bytes, folder: Path | None = None) -> None:
    """Read a programme and play it at a low rate."""
    with mock.patch.object(excitation, 'MAX_SAMPLES', SHORT):
        parse_program(data.decode('utf-8', 'replace')).build(sample_rate=100.0)


def effect(data: bytes, folder: Path | None = None) -> None:
    """Put settings into an effect; the first byte says which."""
    names = sorted(catalogue())
    try:
        values = json.loads(data[1:] or b'{}')
    except (ValueError, RecursionError):
        return
    if isinstance(values, dict):
        setting = EffectSetting(names[(data[:1] or b'\0')[0] % len(names)], values)
        find_effect(setting.name)(20000.0, setting.parameters)


def _file(suffix: str, data: bytes, folder: Path | None) -> None:
    path = (folder or Path('.')) / f'in{suffix}'
    path.write_bytes(data)
    if suffix in ('.mcap', '.db3'):
        with suppress(PiezoIdentError):
            read_record(path)
    read_record(path, recover=True)


def csv(data: bytes, folder: Path | None = None) -> None:
    """Read a CSV file."""
    _file('.csv', data, folder)


def npz(data: bytes, folder: Path | None = None) -> None:
    """Read a NumPy archive."""
    _file('.npz', data, folder)


def mat(data: bytes, folder: Path | None = None) -> None:
    """Read a MATLAB file."""
    _file('.mat', data, folder)


def mcap(data: bytes, folder: Path | None = None) -> None:
    """Read an mcap file as a finished bag, and as one to recover."""
    _file('.mcap', data, folder)


def sqlite3(data: bytes, folder: Path | None = None) -> None:
    """Read an sqlite3 file as a finished bag, and as one to recover."""
    _file('.db3', data, folder)


def metadata(data: bytes, folder: Path | None = None) -> None:
    """Read a bag folder with the bytes as its metadata.yaml."""
    bag = (folder or Path('.')) / 'bag'
    if not bag.exists():
        write_record(example(), bag)
    (bag / 'metadata.yaml').write_bytes(data)
    read_record(bag, recover=True)


TARGETS: dict[str, Callable[[bytes, Path | None], None]] = {
    'wire': wire,
    'message': message,
    'effect': effect,
    'csv': csv,
    'npz': npz,
    'mat': mat,
    'mcap': mcap,
    'sqlite3': sqlite3,
    'metadata': metadata,
    'model': model,
    'stage': stage,
    'programme': programme,
}


def attempt(name: str, data: bytes, folder: Path | None = None) -> bool:
    """Return whether a target took the input; anything but the package's own errors is raised."""
    try:
        TARGETS[name](data, folder)
    except PiezoIdentError as error:
        if '\n' in str(error) or len(str(error)) > 4000 or not str(error).isprintable():
            raise AssertionError(f'{name}: no clear line: {str(error)[:200]!r}') from None
        return False
    return True


# --- valid inputs ---------------------------------------------------------------------------


def seeds(name: str, folder: Path) -> list[bytes]:
    """Return valid inputs of a target; files are made in a folder."""
    if name in ('csv', 'npz', 'mat', 'mcap', 'sqlite3'):
        path = folder / f'seed.{"db3" if name == "sqlite3" else name}'
        write_record(example(), path, overwrite=True)
        return [path.read_bytes(), *_more(name)]
    return _SEEDS[name](folder)


def _more(name: str) -> list[bytes]:
    if name == 'csv':
        return [b'# t, v, y\n0,1,2e-6\n0.1,2,3e-6\n0.2,3,4e-6\n', b't,v,y\n0;1;2\n']
    if name == 'npz':
        plain, packed = io.BytesIO(), io.BytesIO()
        columns = {'t': np.arange(9) / 10, 'v': np.arange(9.0), 'y': 1e-6 * np.arange(9.0)}
        np.savez(plain, **columns)
        with zipfile.ZipFile(packed, 'w', zipfile.ZIP_DEFLATED) as archive:
            for key, x in columns.items():
                with archive.open(f'{key}.npy', 'w') as member:
                    np.save(member, x)
        return [plain.getvalue(), packed.getvalue()]
    return []


def _wire(folder: Path) -> list[bytes]:
    found = []
    for n in (1, 3):
        numbers, dims = encode(Samples(np.arange(n) / 10, np.ones(n), 'sine:50Hz'))
        (a, b) = dims
        head = struct.pack('<iiiib', a.size, a.stride, b.size, b.stride, 0)
        found.append(head + f'{a.label}|{b.label}'.encode().ljust(43, b' ') + numbers.tobytes())
    return found


def _message(folder: Path) -> list[bytes]:
    types: Any = typestore().types
    numbers, dims = encode(Samples(np.arange(3) / 10, np.ones(3), 'noise', 'displacement'))
    layout = types['std_msgs/msg/MultiArrayLayout'](
        [types['std_msgs/msg/MultiArrayDimension'](*d) for d in dims], 0
    )
    filled = types[MESSAGE_TYPE](layout, numbers)
    return [bytes(typestore().serialize_cdr(filled, MESSAGE_TYPE))]


def _metadata(folder: Path) -> list[bytes]:
    # of changed metadata no bag can be told, and what is no bag is never replaced
    shutil.rmtree(folder / 'bag', ignore_errors=True)
    write_record(example(), folder / 'bag')
    return [(folder / 'bag' / 'metadata.yaml').read_bytes()]


def _effect(folder: Path) -> list[bytes]:
    found = []
    for i, (_, kind) in enumerate(sorted(catalogue().items())):
        values = {
            p.name: 'x' if p.kind == 'text' else [p.clip(1.0)] if p.vector else float(p.clip(1.0))
            for p in kind.parameters
        }
        found.append(bytes([i]) + json.dumps(values).encode())
    return found


def _stage(folder: Path) -> list[bytes]:
    return [find_config(x, 'stage').read_bytes() for x in ('stage_paper', 'effects')]


def _model(folder: Path) -> list[bytes]:
    found = []
    for text in _stage(folder):
        data = parse_yaml(text.decode(), 'seed')
        found.append(
            json.dumps({k: v for k, v in data.items() if k not in ('sensor', 'seed')}).encode()
        )
    return found


PROGRAMME = b"""\
limits: [0, 10]
seed: 1
segments:
  - {signal: idle, duration: 0.3}
  - {signal: hold, level: 4, duration: 0.2, name: at-4V}
  - {signal: step, bias: 5, size: 2, hold: 0.1, count: 3}
  - {signal: staircase, levels: [1, 2, 3], hold: 0.1}
  - {signal: settle, bias: 5, amplitude: 1, cycles: 3}
  - {signal: noise, bias: 5, amplitude: 1, cutoff: 20, duration: 1}
  - {signal: triangle, slope: 20}
  - {signal: triangle, preset: paper}
  - {signal: decaying_triangle, bias: 5, amplitude: 3, cycles: 2, slope: 40}
  - {signal: minor_loops, biases: [2, 5], amplitude: 0.5, cycles: 2, slope: 10}
  - {signal: sine, bias: 5, amplitude: 5, frequency: 10, duration: 0.5}
  - {signal: multisine, bias: 5, amplitude: 2, lowest: 1, highest: 9, period: 1, periods: 2}
"""


def _programme(folder: Path) -> list[bytes]:
    return [PROGRAMME, PROGRAMME.split(b'  - {signal: step')[0]]


_SEEDS: dict[str, Callable[[Path], list[bytes]]] = {
    'wire': _wire,
    'message': _message,
    'effect': _effect,
    'metadata': _metadata,
    'model': _model,
    'stage': _stage,
    'programme': _programme,
}

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Blocks of samples, and bags of them, for tests."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from piezo_ident.record.bags.read import MESSAGE_TYPE, typestore
from piezo_ident.record.bags.write import BagWriter
from piezo_ident.record.blocks import encode, Samples
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
import yaml


def blocks(n: int = 1000, size: int = 100, seed: int = 0) -> list[tuple[Samples, Samples]]:
    rng = np.random.default_rng(seed)
    t, v, y = np.arange(n) / 1000.0, rng.normal(size=n), 1e-6 * rng.normal(size=n)
    return [
        (
            Samples(t[i : i + size], v[i : i + size], 'noise', 'voltage'),
            Samples(t[i : i + size], y[i : i + size], 'noise', 'displacement'),
        )
        for i in range(0, n, size)
    ]


def write(
    path: Path,
    messages: Iterable[tuple[str, Samples]],
    edit=None,
    *,
    stamp=lambda i: 10**9 + i * 10**6,
    storage: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode | None = None,
) -> Path:
    """Write messages in the order given, one a millisecond, as a recorder would."""
    store = typestore()
    connections = {}
    writer = Writer(path, version=9, storage_plugin=storage)
    if compression is not None:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        for i, (topic, samples) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, MESSAGE_TYPE, typestore=store)
            data, dims = encode(samples)
            if edit is not None:
                data, dims = edit(i, data, dims)
            writer.write(connections[topic], stamp(i), serialized(data, dims))
    return path


def metadata(path: Path) -> dict:
    """Return what the metadata.yaml of a bag says."""
    return yaml.safe_load((path / 'metadata.yaml').read_text())['rosbag2_bagfile_information']


def serialized(data, dims) -> bytes:
    types = typestore().types
    dimension = types['std_msgs/msg/MultiArrayDimension']
    layout = types['std_msgs/msg/MultiArrayLayout']([dimension(*d) for d in dims], 0)
    return bytes(typestore().serialize_cdr(types[MESSAGE_TYPE](layout, data), MESSAGE_TYPE))


def raw(samples: Samples) -> bytes:
    return serialized(*encode(samples))


def raw_blocks(n: int = 10**9) -> Iterator[tuple[bytes, bytes]]:
    for k in range(n):
        t = np.arange(100 * k, 100 * k + 100) / 20000.0
        yield (
            raw(Samples(t, 5 + np.sin(t), 'noise', 'voltage')),
            raw(Samples(t, 1e-5 + 1e-6 * np.sin(t), 'noise', 'displacement')),
        )


def recording(path: Path, storage: str = 'mcap', n: int = 40, **options) -> BagWriter:
    """Write pairs of blocks 5 ms apart, and flush, but do not close."""
    writer = BagWriter(path, storage, **options)
    for topic in ('/voltage', '/displacement'):
        writer.add_topic(topic, MESSAGE_TYPE)
    for k, (voltage, displacement) in enumerate(raw_blocks(n)):
        writer.write('/voltage', 10**18 + k * 5_000_000, voltage)
        writer.write('/displacement', 10**18 + k * 5_000_000 + 100_000, displacement)
    writer.flush()
    return writer

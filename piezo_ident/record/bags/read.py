# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Records in rosbag2 folders, mcap or sqlite3, with or without ROS on the machine.

A bag is read message by message into flat buffers, so its length is limited by the samples
alone.  Topics are found by what their blocks say they carry, so remapped names are no obstacle.
The streams become a record by the way that a live capture takes, so that both are the same.
A bag whose recorder was killed is refused, or read as far as it goes when that is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from piezo_ident.common.errors import DataError
from piezo_ident.common.files import temporary_output
from piezo_ident.record.bags.samples import BagSamples, MESSAGE_TYPE, opened_samples, typestore
from piezo_ident.record.blocks import (
    BLOCK_SIZE,
    cut_blocks,
    encode,
    Samples,
)
from piezo_ident.record.capture import record_of_streams
from piezo_ident.record.record import Record
from piezo_ident.record.stream import Stream
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import StoragePlugin, Writer

__all__ = [
    'MESSAGE_TYPE',
    'SAMPLE_QOS',
    'read_bag',
    'record_in',
    'typestore',
    'write_bag',
]

_FOREVER = QosTime(9223372036, 854775807)
#: reliable, volatile, keep last 100: the contract of every topic that carries samples
SAMPLE_QOS = Qos(
    history=QosHistory.KEEP_LAST,
    depth=100,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.VOLATILE,
    deadline=_FOREVER,
    lifespan=_FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_FOREVER,
    avoid_ros_namespace_conventions=False,
)


def read_bag(
    path: str | Path,
    *,
    namespace: str | None = None,
    voltage_topic: str | None = None,
    displacement_topic: str | None = None,
    displacement_unit: str = 'm',
    voltage_limits: tuple[float, float] | None = None,
    recover: bool = False,
) -> Record:
    """
    Read a rosbag2 folder, or a single .mcap or .db3 file.

    Where the bag holds ``applied_voltage`` beside the voltage, samples that the amplifier's guard
    altered are cut out, as in a live capture.

    Parameters
    ----------
    path : path
        The folder or file.
    namespace : str, optional
        Take only topics below this namespace, for bags of several stages.
    voltage_topic, displacement_topic : str, optional
        Take these topics, whatever else the bag holds.
    displacement_unit, voltage_limits
        As for `piezo_ident.record.assemble.assemble`.
    recover : bool, optional
        Read a bag whose recorder was killed as far as it goes, with a fault that says so, instead
        of refusing it.

    Raises
    ------
    DataError
        For a damaged bag, for blocks whose layout does not fit, when no topic or more than one
        carries the voltage or the displacement, and for all that `assemble` refuses.
    """
    path = Path(path)
    with opened_samples(
        path,
        namespace=namespace,
        voltage_topic=voltage_topic,
        displacement_topic=displacement_topic,
        recover=recover,
    ) as source:
        streams = {quantity: Stream(spooled=True) for quantity in source.topics}
        for quantity, samples, stamp in source.blocks():
            streams[quantity].append(samples, stamp)
    return record_in(source, streams, displacement_unit, voltage_limits)


def record_in(
    source: BagSamples,
    streams: Mapping[str, Stream],
    displacement_unit: str = 'm',
    voltage_limits: tuple[float, float] | None = None,
) -> Record:
    """
    Return the record of all samples of a bag; parameters are those of `read_bag`.

    Raises
    ------
    DataError
    """
    return record_of_streams(
        streams,
        name=str(source.path),
        displacement_unit=displacement_unit,
        voltage_limits=voltage_limits,
        sample_rate=source.sample_rate,
        faults=source.faults,
    ).renamed(source.path.name)


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
    Write a record as a rosbag2 folder, or as a single file when `path` ends so.

    A block's log time is the time of its first sample.  Where the record starts before zero, or
    its clock restarts, log times are moved later by whole seconds, so that they stay positive
    and in the order of the messages; the samples keep their own times.

    Parameters
    ----------
    record : Record
        What to write.
    path : path
        The folder, or a file name that ends in .mcap or .db3.
    storage : {'mcap', 'sqlite3'}, optional
        Storage of a folder; mcap unless told.
    overwrite : bool
        Replace an existing bag.
    custom_data : mapping of str to str, optional
        For the bag's metadata beside ``sample_rate``: seed, programme.
    block_size : int
        Samples a block.

    Raises
    ------
    DataError
        When the place is taken or cannot be written to.
    """
    path = Path(path)
    plugins = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
    suffix = {'.mcap': 'mcap', '.db3': 'sqlite3'}.get(path.suffix.lower())
    if suffix and path.suffix != path.suffix.lower():
        raise DataError(f'{path}: no reader of bags takes {path.suffix}; write small letters')
    if storage is not None and (storage not in plugins or (suffix or storage) != storage):
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
        plugin = plugins[suffix or storage or 'mcap']
        with Writer(folder, version=9, storage_plugin=plugin) as writer:
            for key, value in custom.items():
                writer.set_custom_data(key, value)
            _write_pieces(writer, record, block_size)
        if suffix:
            next(f for f in folder.iterdir() if f.suffix == path.suffix).replace(target)


def _write_pieces(writer: Writer, record: Record, block_size: int) -> None:
    quantities = ['voltage', 'displacement']
    quantities += dict.fromkeys(f'x_{name}' for p in record for name in p.channels)
    senders = {q: _sender(writer, q) for q in quantities}
    shift, latest = 0, 0.0
    for piece in record:
        columns = {'voltage': piece.v, 'displacement': piece.y}
        columns |= {f'x_{name}': x for name, x in piece.channels.items()}
        first, last = (float(piece.time(k, k + 1)[0]) for k in (0, piece.n - 1))
        # later by whole seconds, until nothing is before what was written already
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
                senders[quantity](Samples(t, x[start:stop], label, quantity), stamp)


def _sender(writer: Writer, quantity: str) -> Callable[[Samples, int], None]:
    store = typestore()
    types: Any = store.types
    dimension = types['std_msgs/msg/MultiArrayDimension']
    layout, message = types['std_msgs/msg/MultiArrayLayout'], types[MESSAGE_TYPE]
    connection = writer.add_connection(
        f'/{quantity}', MESSAGE_TYPE, typestore=store, offered_qos_profiles=[SAMPLE_QOS]
    )

    def send(samples: Samples, stamp: int) -> None:
        data, dims = encode(samples)
        filled = message(layout([dimension(*d) for d in dims], 0), data)
        writer.write(connection, stamp, store.serialize_cdr(filled, MESSAGE_TYPE))

    return send

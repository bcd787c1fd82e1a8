# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Records in rosbag2 folders, mcap or sqlite3, with or without ROS on the machine.

A bag is read message by message into flat buffers, so its length is limited by the samples
alone.  Topics are found by what their blocks say they carry, so remapped names are no obstacle.
The streams become a record by the way that a live capture takes, so that both are the same.
A bag whose recorder was killed is refused, or read as far as it goes when that is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import functools
from pathlib import Path
from typing import Any

from piezo_ident.bag_check import rate_of
from piezo_ident.bag_recovery import Bag, damage_as_data_error, opened_bag
from piezo_ident.capture import APPLIED, record_of_streams
from piezo_ident.errors import DataError
from piezo_ident.output import temporary_output
from piezo_ident.record import Record
from piezo_ident.stream import Stream
from piezo_ident.wire_format import (
    BLOCK_SIZE,
    cut_blocks,
    decode,
    encode,
    quantity_of,
    Samples,
)
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
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore

__all__ = [
    'MESSAGE_TYPE',
    'SAMPLE_QOS',
    'carried_quantities',
    'read_bag',
    'typestore',
    'write_bag',
]

MESSAGE_TYPE = 'std_msgs/msg/Float64MultiArray'

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


@functools.cache
def typestore() -> Typestore:
    """Return the message types of Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


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
        As for `piezo_ident.sampling.assemble`.
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
    asked = {'voltage': voltage_topic, 'displacement': displacement_topic}
    with opened_bag(path) as bag:
        if bag.faults and not recover:
            raise DataError(
                f'{path}: {bag.faults[0].where}: the bag is unfinished or damaged; '
                f"'piezo_ident convert {path} OUT' saves what is whole of it"
            )
        carried = carried_quantities(bag)
        topics = _choose(carried, asked, namespace, path)
        streams = _collect(bag, topics, path)
        faults = bag.faults
    return record_of_streams(
        streams,
        name=str(path),
        displacement_unit=displacement_unit,
        voltage_limits=voltage_limits,
        sample_rate=rate_of(path) if path.is_dir() else rate_of(path.parent, path.name),
        faults=faults,
    ).renamed(path.name)


def _messages(bag: Bag, connections: list[Connection]) -> Iterator[tuple[str, int, Any]]:
    for connection, stamp, raw in bag.messages(connections):
        with damage_as_data_error(bag.path):
            message = typestore().deserialize_cdr(raw, connection.msgtype)
        yield connection.topic, stamp, message


def carried_quantities(bag: Bag) -> dict[str, str]:
    """
    Return what each topic carries, as its first message says.

    Raises
    ------
    DataError
        When no topic carries samples.
    """
    found = {}
    for connection in bag.connections:
        if connection.msgtype != MESSAGE_TYPE or connection.topic in found:
            continue
        for topic, _, message in _messages(bag, [connection]):
            base = topic.rpartition('/')[2]
            # a damaged layout must not hide a topic that is ours by name
            ours = base if base in ('voltage', 'displacement') else None
            quantity = quantity_of(message.layout.dim) or ours
            if quantity:
                found[topic] = quantity
            break
    if not found:
        topics = ', '.join(sorted({c.topic for c in bag.connections})) or 'none'
        raise DataError(
            f"{bag.path}: no topic carries blocks with layout 't,voltage' and 't,displacement' "
            f"(topics: {topics}); record the stage's voltage and displacement"
        )
    return found


def _choose(
    carried: Mapping[str, str],
    asked: Mapping[str, str | None],
    namespace: str | None,
    path: Path,
) -> dict[str, str]:
    """Return the topic of each quantity, and of the applied voltage where it is there."""
    prefix = '/' if namespace is None else f'/{namespace.strip("/")}/'.replace('//', '/')
    chosen = {}
    for quantity, wish in asked.items():
        if wish is not None:
            topic = f'/{wish.lstrip("/")}'
            if topic not in carried:
                raise DataError(
                    f'{path}: no samples on topic {topic}; topics with samples: '
                    + ', '.join(sorted(carried))
                )
            chosen[quantity] = topic
            continue
        there = [t for t, q in carried.items() if q == quantity and t.startswith(prefix)]
        # applied_voltage and prediction carry the same quantity under another name
        commanded = [t for t in there if t.rpartition('/')[2] != APPLIED] or there
        named = [t for t in commanded if t.rpartition('/')[2] == quantity]
        fit = named if len(commanded) > 1 and named else commanded
        if not fit:
            raise DataError(
                f"{path}: no topic carries 't,{quantity}'"
                f'{"" if namespace is None else f" below {prefix}"}; topics with samples: '
                + ', '.join(sorted(carried))
            )
        if len(fit) > 1:
            raise DataError(
                f'{path}: several topics carry {quantity}: {", ".join(sorted(fit))}; '
                'name the stage with a namespace, or the topics'
            )
        chosen[quantity] = fit[0]
    home = chosen['voltage'].rpartition('/')[0] + '/'
    applied = f'{home}{APPLIED}'
    if carried.get(applied) == 'voltage' and applied != chosen['voltage']:
        chosen[APPLIED] = applied
    for topic, quantity in sorted(carried.items(), key=lambda item: item[::-1]):
        if quantity.startswith('x_') and topic.startswith(home):
            if quantity in chosen:
                raise DataError(
                    f'{path}: {chosen[quantity]} and {topic} both carry {quantity}; '
                    'record only one of them'
                )
            chosen[quantity] = topic
    return chosen


def _collect(bag: Bag, topics: Mapping[str, str], path: Path) -> dict[str, Stream]:
    streams = {quantity: Stream() for quantity in topics}
    by_topic = {topic: streams[quantity] for quantity, topic in topics.items()}
    index = dict.fromkeys(by_topic, 0)
    wanted = [c for c in bag.connections if c.topic in by_topic and c.msgtype == MESSAGE_TYPE]
    for topic, stamp, message in _messages(bag, wanted):
        layout = message.layout
        try:
            samples = decode(message.data, layout.dim, layout.data_offset)
        except DataError as error:
            raise DataError(
                f'{path}: topic {topic}, message {index[topic]}: {error}; record it again with '
                'a publisher that keeps to the layout'
            ) from None
        by_topic[topic].append(samples, stamp)
        index[topic] += 1
    return streams


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
            next(f for f in folder.iterdir() if f.suffix == path.suffix.lower()).replace(target)


def _write_pieces(writer: Writer, record: Record, block_size: int) -> None:
    quantities = ['voltage', 'displacement']
    quantities += dict.fromkeys(f'x_{name}' for p in record for name in p.channels)
    senders = {q: _sender(writer, q) for q in quantities}
    shift, latest = 0, 0.0
    for piece in record:
        t = piece.t
        # later by whole seconds, until nothing is before what was written already
        while t[0] + shift < latest:
            shift += 1 + int(latest - t[0] - shift)
        latest = float(t[-1]) + shift
        columns = {'voltage': piece.v, 'displacement': piece.y}
        columns |= {f'x_{name}': x for name, x in piece.channels.items()}
        for start, stop, label in cut_blocks(piece.n, piece.segments, block_size):
            stamp = round(t[start] * 1e9) + shift * 1_000_000_000
            for quantity, x in columns.items():
                samples = Samples(t[start:stop], x[start:stop], label, quantity)
                senders[quantity](samples, stamp)


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

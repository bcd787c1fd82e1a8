# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Read records from rosbag2 folders and files, mcap or sqlite3, without ROS.

The quantity in the layout of its blocks selects a topic, so topics may be remapped.  Topics of the
model node do not count as measured.  Namespaces distinguish the stages of a bag.  A bag and a live
capture of the same blocks become the same record.  The bag of a killed recorder is refused, unless
`ReadOptions.recover` asks for its whole messages.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, ExitStack, suppress
from dataclasses import replace
import functools
import itertools
import math
from pathlib import Path
import re
from typing import Any, TypeVar

from piezo_ident.common.errors import ConfigError, DataError
from piezo_ident.record.bags.recover import (
    Bag,
    DAMAGED,
    is_unfinished,
    metadata,
    scanned_bag,
    storage_of,
    Stored,
    unpacked,
)
from piezo_ident.record.blocks import decode, quantity_of, Samples
from piezo_ident.record.channels import applied_key, channel_of_quantity, role_of
from piezo_ident.record.join import APPLIED, record_of_streams
from piezo_ident.record.options import ReadOptions
from piezo_ident.record.record import Fault, Record
from piezo_ident.record.stream import BlockStream
from piezo_ident.record.tables.arrays import damage_as_data_error
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore

MESSAGE_TYPE = 'std_msgs/msg/Float64MultiArray'
#: names of the topics of the model node, with the name of a further axis
_COMPUTED = re.compile(r'(prediction|prediction_band|residual|estimate)(_\w+)?', re.ASCII)

T = TypeVar('T')


@functools.cache
def typestore() -> Typestore:
    """Return the message types of Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


@contextmanager
def opened_bag(path: str | Path, *, in_file_order: bool = False) -> Iterator[Bag]:
    """
    Open a rosbag2 folder, or a single .mcap or .db3 file, as far as it was finished.

    The file may be compressed as a whole, or message by message.  `in_file_order` gives the
    messages as they were written, not by their log times.  Raises DataError if the path is no bag,
    or has other damage than a killed recorder leaves; the iteration over messages does so, too.
    """
    path = Path(path)
    try:
        path.stat()
    except OSError as error:
        raise DataError(f'{path}: cannot be read ({error.strerror or error})') from None
    if path.is_file() and not path.name.endswith((storage_of(path), '.zstd', '.zst')):
        raise DataError(f'{path}: a bag is known by .mcap or .db3 in small letters; rename it')
    if storage_of(path) == '.db3' and any(c in str(path) for c in '?#%'):
        raise DataError(f'{path}: rosbags cannot open names with ?, # or %; rename it')
    with ExitStack() as stack:
        with damage_as_data_error(path, *DAMAGED):
            is_packed = path.is_file() and path.suffix != storage_of(path)
            scan = is_unfinished(path) or is_packed or in_file_order
            bag = scanned_bag(path, stack) if scan else _finished(path, stack)
        yield bag


def _finished(path: Path, stack: ExitStack) -> Bag:
    if path.is_dir():
        metadata(path)
    reader = stack.enter_context(Reader(path))
    if not _has_index(reader):
        return scanned_bag(path, stack)
    empty = reader.message_count == 0
    start = 0 if empty else reader.start_time
    end = 0 if empty else reader.end_time - 1
    # rosbags takes over the contents of metadata.yaml unchecked
    texts = [text for c in reader.connections for text in (c.topic, c.msgtype)]
    numbers = [start, end, *(c.msgcount for c in reader.connections)]
    if not all(isinstance(x, str) for x in texts) or {type(x) for x in numbers} != {int}:
        raise DataError(f'{path}: damaged or unfinished bag (metadata of wrong types); mend it')

    def messages(connections: Collection[Connection]) -> Iterator[Stored]:
        if connections:  # rosbags takes an empty list for all connections
            with damage_as_data_error(path, *DAMAGED):
                stored = itertools.starmap(Stored, reader.messages([*connections]))
                yield from unpacked(stored, path)

    return Bag(path, reader.connections, messages, start, end)


def _has_index(reader: Reader) -> bool:
    """Return whether the index of an mcap file lists every message; rosbags reads no other."""
    storages: list[Any] = getattr(reader.storage, 'storages', [reader.storage])
    for storage in storages:
        chunks = getattr(storage, 'chunks', None)
        indexed = sum(sum(chunk.channel_count.values()) for chunk in chunks or ())
        # without statistics rosbags takes the count from the index, which may be empty
        if chunks is not None and indexed < max(storage.metadata.message_count, len(chunks[:1])):
            return False
    return True


def read_bag(path: str | Path, options: ReadOptions | None = None, **choices: Any) -> Record:
    """
    Read a rosbag2 folder, or a single .mcap or .db3 file; `choices` replace fields of the options.

    Blocks come in the order of their log times, or of the file if the log clock was set back.  If
    the bag holds ``applied_voltage``, samples that the amplifier's guard altered are cut out, as
    in a live capture.  Raises DataError if the bag is damaged, a block has a wrong layout, the
    voltage or the displacement is not on exactly one topic, or `assemble` refuses the columns.
    """
    path = Path(path)
    options = replace(options or ReadOptions(), **choices)
    topics: dict[str, str] = {}

    def read(bag: Bag) -> tuple[int, tuple[dict[str, BlockStream], LogClock]]:
        if bag.faults and not options.recover:
            raise DataError(
                f'{path}: {bag.faults[0].where}: the bag is unfinished or damaged; '
                f"'piezo_ident convert {path} OUT' saves what is whole of it"
            )
        asked = {'voltage': options.voltage_topic, 'displacement': options.displacement_topic}
        topics.update(topics or _choose(carried_quantities(bag), asked, options.namespace, path))
        streams, clock = {quantity: BlockStream(spooled=True) for quantity in topics}, LogClock()

        def kept() -> Iterator[tuple[str, Samples]]:
            for quantity, samples, stamp in blocks_in(bag, topics):
                streams[quantity].append(samples, clock.rising(quantity, stamp))
                yield quantity, samples

        return steps_back(kept()), (streams, clock)

    with ordered_bag(path, read) as (bag, (streams, clock)):
        return record_of_streams(
            streams,
            name=str(path),
            options=options,
            sample_rate=_sample_rate(path),
            faults=(*bag.faults, *clock.faults),
        ).renamed(path.name)


@contextmanager
def ordered_bag(path: str | Path, look: Callable[[Bag], tuple[int, T]]) -> Iterator[tuple[Bag, T]]:
    """
    Open a bag whose messages come in the order of its samples.

    The messages come by their log times, or in the order of the file if the log clock was set
    back.  `look` reads a bag, and returns the number of blocks that go back (`steps_back`) and a
    value.  The context yields the bag with the better order, and the value for this order.
    """
    with ExitStack() as stack:
        bag = stack.enter_context(opened_bag(path))
        back, value = look(bag)
        if back:
            with suppress(DataError):
                other = stack.enter_context(opened_bag(path, in_file_order=True))
                fewer, again = look(other)
                if fewer < back and not other.faults:
                    bag, value = other, again
        yield bag, value


class LogClock:
    """
    Log times that rise on every topic: after a step back of the clock, later times are shifted.

    >>> clock = LogClock()
    >>> [clock.rising('v', stamp) for stamp in (5, 6, 3, 4)], clock.steps
    ([5, 6, 6, 7], [3])
    """

    def __init__(self) -> None:
        self.steps: list[int] = []
        self._shift = 0
        self._last: dict[str, int] = {}

    def rising(self, topic: str, stamp: int) -> int:
        """Return the log time [ns] of the next message."""
        last = self._last.get(topic, stamp + self._shift)
        if stamp + self._shift < last:
            self.steps.append(last - self._shift - stamp)
            self._shift = max(self._last.values()) - stamp
        self._last[topic] = stamp + self._shift
        return self._last[topic]

    @property
    def faults(self) -> tuple[Fault, ...]:
        """One fault if the clock was set back, else empty."""
        where = f'by {max(self.steps, default=0) / 1e9:.3g} s from one block to the next'
        action = 'blocks taken in the order of the file'
        fault = Fault('log_time_step', where, len(self.steps), action)
        return (fault,) if self.steps else ()


def steps_back(blocks: Iterable[tuple[str, Samples]]) -> int:
    """Count the blocks that begin before the previous block of their quantity ends."""
    ends: dict[str, float] = {}
    back = 0
    for quantity, samples in blocks:
        if samples.t.size:
            back += bool(samples.t[0] <= ends.get(quantity, -math.inf))
            ends[quantity] = float(samples.t[-1])
    return back


def _sample_rate(path: Path) -> float | None:
    """Return the sampling rate [Hz] in the custom data of a bag; None unless it is positive."""
    try:
        info = metadata(path if path.is_dir() else path.parent)
        if path.is_file() and path.name not in info['relative_file_paths']:
            return None
        rate = float(info['custom_data']['sample_rate'])
    except (ConfigError, ValueError, TypeError, KeyError, OverflowError):
        return None  # the stamps tell the rate as well
    return rate if 0 < rate < float('inf') else None


def _messages(bag: Bag, connections: list[Connection]) -> Iterator[tuple[str, int, Any]]:
    for connection, stamp, raw in bag.messages(connections):
        if stamp >= 2**63:
            raise DataError(f'{bag.path}: damaged, a message on {connection.topic} has no time')
        with damage_as_data_error(bag.path, *DAMAGED):
            message = typestore().deserialize_cdr(raw, connection.msgtype)
        yield connection.topic, stamp, message


def carried_quantities(bag: Bag) -> dict[str, str]:
    """Return the quantity of each topic, by its first message; DataError without samples."""
    carried = {}
    for connection in bag.connections:
        if connection.msgtype != MESSAGE_TYPE or connection.topic in carried:
            continue
        for topic, _, message in _messages(bag, [connection]):
            base = topic.rpartition('/')[2]
            # the name of the topic replaces a damaged layout
            named = base if base in ('voltage', 'displacement') else None
            quantity = quantity_of(message.layout.dim) or named
            if quantity:
                carried[topic] = quantity
            break
    if not carried:
        topics = ', '.join(sorted({c.topic for c in bag.connections})) or 'none'
        raise DataError(
            f"{bag.path}: no topic carries blocks with layout 't,voltage' and 't,displacement' "
            f"(topics: {topics}); record the stage's voltage and displacement"
        )
    return carried


def is_computed(topic: str) -> bool:
    """
    Return whether a model computes the samples of a topic, of any axis.

    >>> [is_computed(x) for x in ('/s/prediction', '/estimate_b', '/displacement_b')]
    [True, True, False]
    """
    return bool(_COMPUTED.fullmatch(topic.rpartition('/')[2]))


def _choose(
    carried: Mapping[str, str], asked: Mapping[str, str | None], namespace: str | None, path: Path
) -> dict[str, str]:
    """Choose the topic of each quantity, and of the applied voltage if the bag has it."""
    chosen = {q: _topic_of(carried, q, topic, namespace, path) for q, topic in asked.items()}
    home = chosen['voltage'].rpartition('/')[0] + '/'
    applied = f'{home}{APPLIED}'
    if carried.get(applied) == 'voltage' and applied != chosen['voltage']:
        chosen[APPLIED] = applied
    for topic, quantity in sorted(carried.items(), key=lambda item: item[::-1]):
        channel = channel_of_quantity(quantity)
        if channel and topic.startswith(home) and not (role_of(channel) and is_computed(topic)):
            if topic == f'{home}{applied_key(quantity)}':
                chosen[applied_key(quantity)] = topic
                continue
            if quantity in chosen:
                raise DataError(
                    f'{path}: {chosen[quantity]} and {topic} both carry {quantity}; '
                    'record only one of them'
                )
            chosen[quantity] = topic
    return chosen


def _topic_of(
    carried: Mapping[str, str], quantity: str, asked: str | None, namespace: str | None, path: Path
) -> str:
    """Choose the requested topic, or the only measured topic below a namespace."""
    topics = ', '.join(f'{topic} ({carried[topic]})' for topic in sorted(carried))
    if asked is not None:
        topic = f'/{asked.lstrip("/")}'
        if carried.get(topic) != quantity:
            has = f'{topic} carries {carried.get(topic)}, not {quantity}'
            fault = has if topic in carried else f'no samples on topic {topic}'
            raise DataError(f'{path}: {fault}; topics with samples: {topics}')
        return topic
    prefix = '/' if namespace is None else f'/{namespace.strip("/")}/'.replace('//', '/')
    there = [t for t, q in carried.items() if q == quantity and t.startswith(prefix)]
    # a model fitted to the prediction of another would look perfect
    measured = [t for t in there if not is_computed(t)]
    if there and not measured:
        raise DataError(
            f'{path}: {", ".join(sorted(there))}: computed by a model, and no topic carries a '
            f'measured {quantity}; record a measured {quantity}, or name the topic to take'
        )
    # the quantity of applied_voltage is voltage, too
    commanded = [t for t in measured if t.rpartition('/')[2] != APPLIED] or measured
    named = [t for t in commanded if t.rpartition('/')[2] == quantity]
    fit = named if len(commanded) > 1 and named else commanded
    if not fit:
        below = '' if namespace is None else f' below {prefix}'
        raise DataError(
            f"{path}: no topic carries 't,{quantity}'{below}; topics with samples: {topics}"
        )
    if len(fit) > 1:
        raise DataError(
            f'{path}: several topics carry {quantity}: {", ".join(sorted(fit))}; '
            'name the stage with a namespace, or the topics'
        )
    return fit[0]


def blocks_in(bag: Bag, topics: Mapping[str, str]) -> Iterator[tuple[str, Samples, int]]:
    """Yield quantity, samples and log time [ns] of every block, in the order of the bag."""
    quantities = {topic: quantity for quantity, topic in topics.items()}
    index = dict.fromkeys(quantities, 0)
    wanted = [c for c in bag.connections if c.topic in quantities and c.msgtype == MESSAGE_TYPE]
    for topic, stamp, message in _messages(bag, wanted):
        layout = message.layout
        try:
            samples = decode(message.data, layout.dim, layout.data_offset)
        except DataError as error:
            raise DataError(
                f'{bag.path}: topic {topic}, message {index[topic]}: {error}; record it again '
                'with a publisher that keeps to the layout'
            ) from None
        index[topic] += 1
        yield quantities[topic], samples, stamp

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The blocks of samples that a bag holds, found by what they say they carry.

Remapped names are no obstacle, and a bag of several stages is told apart by their namespaces.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
import functools
from pathlib import Path
from typing import Any

from piezo_ident.common.errors import DataError
from piezo_ident.record.bags.check import rate_of
from piezo_ident.record.bags.recover import Bag, damage_as_data_error, opened_bag
from piezo_ident.record.blocks import decode, quantity_of, Samples
from piezo_ident.record.capture import APPLIED
from piezo_ident.record.record import Fault
from rosbags.interfaces import Connection
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore

__all__ = [
    'MESSAGE_TYPE',
    'BagSamples',
    'carried_quantities',
    'is_computed',
    'opened_samples',
    'typestore',
]

MESSAGE_TYPE = 'std_msgs/msg/Float64MultiArray'

#: blocks between two signs of progress
SHOWN = 2000


@functools.cache
def typestore() -> Typestore:
    """Return the message types of Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


@dataclass(frozen=True)
class BagSamples:
    """
    The samples in an open bag.

    Attributes
    ----------
    path : Path
    topics : dict of str to str
        The topic of each quantity: ``voltage``, ``displacement``, ``applied_voltage`` and
        ``x_<name>`` where they are there.
    sample_rate : float or None
        As the bag names it [Hz].
    faults : tuple of Fault
        What is wrong with the bag as a whole.
    blocks : callable
        Yields every block in the order of the bag: its quantity, samples, and log time [ns]; calls
        ``progress(share)`` now and then.
    """

    path: Path
    topics: dict[str, str]
    sample_rate: float | None
    faults: tuple[Fault, ...]
    blocks: Callable[..., Iterator[tuple[str, Samples, int]]]


@contextmanager
def opened_samples(
    path: Path,
    *,
    namespace: str | None = None,
    voltage_topic: str | None = None,
    displacement_topic: str | None = None,
    recover: bool = False,
) -> Iterator[BagSamples]:
    """
    Open a bag for the samples in it; parameters and errors are those of `read_bag`.

    Raises
    ------
    DataError
    """
    asked = {'voltage': voltage_topic, 'displacement': displacement_topic}
    with opened_bag(path) as bag:
        if bag.faults and not recover:
            raise DataError(
                f'{path}: {bag.faults[0].where}: the bag is unfinished or damaged; '
                f"'piezo_ident convert {path} OUT' saves what is whole of it"
            )
        carried = carried_quantities(bag)
        topics = _choose(carried, asked, namespace, path)
        rate = rate_of(path) if path.is_dir() else rate_of(path.parent, path.name)
        yield BagSamples(path, topics, rate, bag.faults, functools.partial(_blocks, bag, topics))


def _messages(bag: Bag, connections: list[Connection]) -> Iterator[tuple[str, int, Any]]:
    for connection, stamp, raw in bag.messages(connections):
        if stamp >= 2**63:
            raise DataError(f'{bag.path}: damaged, a message on {connection.topic} has no time')
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


def is_computed(topic: str) -> bool:
    """Return whether a topic is one of a model's, which nobody has measured."""
    return topic.rpartition('/')[2] in ('prediction', 'residual')


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
            if carried[topic] != quantity:
                fit = sorted(t for t, q in carried.items() if q == quantity)
                raise DataError(
                    f'{path}: {topic} carries {carried[topic]}, not {quantity}; topics with '
                    f'{quantity}: {", ".join(fit) or "none"}'
                )
            chosen[quantity] = topic
            continue
        there = [t for t, q in carried.items() if q == quantity and t.startswith(prefix)]
        # a model fitted to the prediction of another would look perfect
        measured = [t for t in there if not is_computed(t)]
        if there and not measured:
            raise DataError(
                f'{path}: {", ".join(sorted(there))}: computed by a model, and no topic carries a '
                f'measured {quantity}; record that, or name the topic to take'
            )
        # applied_voltage carries the same quantity under another name
        commanded = [t for t in measured if t.rpartition('/')[2] != APPLIED] or measured
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


def _blocks(
    bag: Bag, topics: Mapping[str, str], progress: Callable[[float], None] | None = None
) -> Iterator[tuple[str, Samples, int]]:
    quantities = {topic: quantity for quantity, topic in topics.items()}
    index = dict.fromkeys(quantities, 0)
    wanted = [c for c in bag.connections if c.topic in quantities and c.msgtype == MESSAGE_TYPE]
    total = max(1, sum(c.msgcount for c in wanted))
    for number, (topic, stamp, message) in enumerate(_messages(bag, wanted)):
        if progress is not None and number % SHOWN == 0:
            progress(min(1.0, number / total))
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

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Convert blocks of samples to std_msgs and back, and define the QoS of the topics."""

from __future__ import annotations

from array import array

from piezo_ident.common.errors import DataError
from piezo_ident.nodes.ending import ENDING
from piezo_ident.record.blocks import decode, encode, Samples, time_problem
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout

#: most samples of a block, and most characters of a label
MOST, LONGEST = 100_000, 200
#: name for a node that the middleware has not discovered yet
UNNAMED = 'a node without a name'


def qos_of(*, reliable: bool = True, latched: bool = False, depth: int = 1000) -> QoSProfile:
    """Make a QoS that keeps the last messages."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


#: samples: reliable, with the last five seconds of blocks on both sides, so that a reader that
#: stops for a moment loses no block
STREAM = qos_of()
#: messages that a late node must still receive: model, report, status
LATCHED = qos_of(latched=True, depth=1)
#: messages for people, and diagnostics
PREVIEW = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10)
#: services: responses go to all clients; with the default depth of 10 a slow client loses its own
SERVICE = STREAM


def to_message(samples: Samples) -> Float64MultiArray:
    """Convert a block to a message."""
    data, dims = encode(samples)
    # array('d', ndarray) goes through Python floats and takes 13 times as long
    return Float64MultiArray(
        layout=MultiArrayLayout(
            dim=[MultiArrayDimension(label=d.label, size=d.size, stride=d.stride) for d in dims],
            data_offset=0,
        ),
        data=array('d', data.tobytes()),
    )


def from_message(message: Float64MultiArray, *quantities: str) -> Samples:
    """
    Convert a message to a block, of one of the `quantities` if they are named.

    All nodes that take blocks call this function, so they refuse the same messages.  Values may be
    NaN or infinite; each node documents its answer.

    DataError for another layout or quantity, a layout that contradicts the data, a block above the
    largest size, and time stamps that are not consecutive.
    """
    dims, n = message.layout.dim, len(message.data)
    if n > 2 * MOST:
        raise DataError(f'{n} numbers in one message; a block has at most {MOST} samples')
    if len(dims) > 2:
        raise DataError(f"{len(dims)} dimensions are not ['sample:<segment>', 't,<quantity>']")
    if any(len(d.label) > LONGEST for d in dims):
        raise DataError(f'a label of more than {LONGEST} characters')
    samples = decode(message.data, message.layout.dim, message.layout.data_offset)
    if quantities and samples.quantity not in quantities:
        raise DataError(f'a block of {samples.quantity!r}, expected is {" or ".join(quantities)}')
    if problem := time_problem(samples.t):
        raise DataError(problem)
    return samples


def await_readers(publisher: Publisher) -> None:
    """Wait until the readers have the last message, for half of the time until the node ends."""
    publisher.wait_for_all_acked(Duration(seconds=ENDING.left / 2))


def publishers(node: Node, topic: str) -> dict[bytes, str]:
    """
    Map the gid of each publisher of a topic to the full name of its node.

    The middleware may discover a publisher before its node; the name is then `UNNAMED`.
    """
    return {
        bytes(info.endpoint_gid): UNNAMED
        if info.node_name == '_NODE_NAME_UNKNOWN_'
        else f'{info.node_namespace.rstrip("/")}/{info.node_name}'
        for info in node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    }


def publisher_ids(node: Node, subscription: Subscription) -> list[bytes]:
    """Return the gids of all publishers of the topic of a subscription."""
    gids = list(publishers(node, subscription.topic_name))
    # a matched publisher may not be listed yet
    return gids + [b'unlisted'] * max(0, subscription.get_publisher_count() - len(gids))

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Between messages and blocks of samples: `piezo_ident.record.blocks` on std_msgs, and the QoS."""

from __future__ import annotations

from array import array

from piezo_ident.common.errors import DataError
from piezo_ident.record.blocks import decode, encode, Samples, time_problem
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout

#: most samples of a block, and characters of a label
MOST, LONGEST = 100_000, 200
#: a node that the middleware has not told of yet
UNNAMED = 'a node without a name'

#: samples: reliable, the last five seconds of blocks, on both sides: a reader that gets no time
#: from the machine meanwhile misses none
STREAM = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
#: what a node that comes late must still hear: model, report, status
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
#: what people look at, and diagnostics
PREVIEW = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10)
#: services: responses go to all clients; with the default depth of 10 a slow client loses its own
SERVICE = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)


def to_message(samples: Samples) -> Float64MultiArray:
    """Return the message of a block."""
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
    Return the block in a message, of one of some quantities where they are named.

    All nodes take their blocks from here, so what one of them refuses, all refuse.  A value may
    be no number: each node says what it does then.

    Raises
    ------
    DataError
        When the layout is not that of a block, does not fit the data, or is larger than a block,
        the quantity is another, or the time stamps are not those of samples in a row.
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


def publishers(node: Node, topic: str) -> dict[bytes, str]:
    """
    Return the full name of the node of each publisher of a topic by the publisher's gid.

    The middleware may hear of a publisher before it hears of its node: that one is `UNNAMED`.
    """
    infos = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    return {
        bytes(info.endpoint_gid): UNNAMED
        if info.node_name == '_NODE_NAME_UNKNOWN_'
        else f'{info.node_namespace.rstrip("/")}/{info.node_name}'
        for info in infos
    }


def publisher_ids(node: Node, subscription: Subscription) -> list[bytes]:
    """Return the gids of all publishers of the topic of a subscription."""
    gids = list(publishers(node, subscription.topic_name))
    # one that is matched may not be listed yet
    return gids + [b'unlisted'] * max(0, subscription.get_publisher_count() - len(gids))

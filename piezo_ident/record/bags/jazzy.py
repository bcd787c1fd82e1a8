# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Bags as rosbag2 of Jazzy writes them.

rosbags writes its own name for the distribution, and no hash of the type into an mcap channel.
`JazzyWriter` adds both between rosbags and its storage.  The storage is an internal of rosbags:
`setup.py` bounds the version, and a test reads written bags.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from io import BytesIO
from typing import Any

from piezo_ident.common.files import write_text
from rosbags.interfaces import Connection
from rosbags.rosbag2 import storage_mcap, StoragePlugin, Writer

#: the message types belong to this distribution
DISTRIBUTION = 'jazzy'


class JazzyWriter(Writer):
    """Writer of bags with the distribution and the type hashes that rosbag2 of Jazzy writes."""

    def open(self) -> None:
        """Open the bag, and put the additions between it and its storage."""
        super().open()
        storage: Any = self.storage
        close = storage.close
        storage.close = lambda version, metadata: close(version, _named(metadata))
        if self.storage_plugin == StoragePlugin.MCAP:
            storage.add_connection = partial(_add_channel, storage, storage.add_connection)
        else:
            storage.conn.execute('UPDATE schema SET ros_distro = ?', (DISTRIBUTION,))

    def close(self) -> None:
        """Finish the bag, and name the distribution in its metadata."""
        super().close()
        write_text(self.metapath, _named(self.metapath.read_text('utf8')))


def _named(metadata: str) -> str:
    return metadata.replace('ros_distro: rosbags', f'ros_distro: {DISTRIBUTION}')


def _add_channel(
    storage: Any, add: Callable[[Connection, str], None], connection: Connection, qos: str
) -> None:
    """Add a channel whose metadata hold the hash of the type beside the QoS."""
    chunk, begin = storage.chunk.bio, storage.chunk.bio.tell()
    add(connection, qos)
    metadata = BytesIO()
    metadata.write(storage.channels[-1].metadata)
    for text in ('topic_type_hash', connection.digest):
        storage_mcap.write_string(metadata, text)
    storage.channels[-1] = storage.channels[-1]._replace(metadata=metadata.getvalue())
    # written once more, longer
    chunk.seek(begin)
    storage_mcap.write_channel(chunk, storage.channels[-1], storage.schemas)

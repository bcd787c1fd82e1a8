# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Bags as rosbag2 of Jazzy writes them.

rosbags gives its own name for the distribution, and leaves the hash of the type out of an mcap
channel.  Both are put in on the way to its storage, which is an internal of it: `setup.py` bounds
the version, and a test reads what was written.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from io import BytesIO
from typing import Any

from piezo_ident.common.files import write_text
from rosbags.interfaces import Connection
from rosbags.rosbag2 import storage_mcap, StoragePlugin, Writer

#: that the message types are of
DISTRIBUTION = 'jazzy'


class JazzyWriter(Writer):
    """Writer of bags with the distribution and the type hashes that rosbag2 of Jazzy writes."""

    def open(self) -> None:
        """Open the bag, and put the two additions between it and its storage."""
        super().open()
        storage: Any = self.storage
        close = storage.close
        storage.close = lambda version, metadata: close(version, _named(metadata))
        if self.storage_plugin == StoragePlugin.MCAP:
            storage.add_connection = partial(_add_channel, storage, storage.add_connection)
        else:
            storage.conn.execute('UPDATE schema SET ros_distro = ?', (DISTRIBUTION,))

    def close(self) -> None:
        """Finish the bag."""
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

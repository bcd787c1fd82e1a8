# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Collect the blocks of one topic, in buffers that copies share.

Samples of a long bag move to temporary files, and are read back as memory maps.  A record of an
hour then needs no memory of its own, and is an ordinary array to the rest of the package.
"""

from __future__ import annotations

from array import array
import copy
import tempfile
from typing import BinaryIO

import numpy as np
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.common.errors import DataError
from piezo_ident.record.blocks import Samples

#: samples in a chunk of a stream
CHUNK = 1 << 16
#: samples that a spooled stream keeps in memory
SPOOLED = 1 << 21


class BlockStream:
    """
    All `n` samples of one topic so far; added blocks never change, so copies share them.

    A `spooled` stream moves its samples to temporary files whenever there are more than `SPOOLED`.
    It cannot be copied, and cannot be shortened.  DataError if there is no room for these files.
    """

    def __init__(self, *, spooled: bool = False) -> None:
        self.n = 0
        self._spooled = spooled
        self._files: list[BinaryIO] = []
        # rows of (t, value): chunks of many blocks, and the newest blocks one by one
        self._chunks: list[Array] = []
        self._newest: list[Array] = []
        self._rows = 0  # in the newest blocks
        self._sizes, self._arrivals = array('q'), array('q')
        self._segments: list[str] = []

    def append(self, samples: Samples, arrival: int) -> None:
        """Add a block that arrived at a time [ns] of a clock that all streams share."""
        if not samples.t.size:
            return
        self._newest.append(np.column_stack([samples.t, samples.values]))
        self.n += samples.t.size
        self._sizes.append(samples.t.size)
        self._arrivals.append(arrival)
        # one string for all blocks of a segment, not one a block
        last = self._segments[-1] if self._segments else ''
        self._segments.append(last if last == samples.segment else samples.segment)
        self._rows += samples.t.size
        if self._rows >= CHUNK:
            self._chunks.append(np.concatenate(self._newest))
            self._newest, self._rows = [], 0
            if self._spooled and sum(map(len, self._chunks)) >= SPOOLED:
                self._spool()

    def copy(self) -> BlockStream:
        """Return the stream as it is now."""
        other = copy.copy(self)
        for name in ('_chunks', '_newest', '_sizes', '_arrivals', '_segments'):
            setattr(other, name, getattr(self, name)[:])
        return other

    def drop(self, n: int) -> int:
        """Forget the oldest blocks, at least `n` samples; return the number of samples."""
        ends = np.cumsum(np.array(self._sizes, dtype=np.int64))
        blocks = int(np.searchsorted(ends, n)) + 1 if n > 0 else 0
        gone = left = int(ends[:blocks].max(initial=0))
        parts = [*self._chunks, *self._newest]
        while parts and left >= len(parts[0]):
            left -= len(parts.pop(0))
        if left:
            parts[0] = parts[0][left:]
        self._chunks, self._newest, self._rows = parts, [], 0
        self.n -= gone
        del self._sizes[:blocks], self._arrivals[:blocks], self._segments[:blocks]
        return gone

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return len(self._sizes)

    @property
    def times(self) -> Array:
        """Time of each sample [s], shape (n,): a copy, or a memory map of a spooled stream."""
        return self._column(0)

    @property
    def values(self) -> Array:
        """Value of each sample, shape (n,): a copy, or a memory map of a spooled stream."""
        return self._column(1)

    def _spool(self) -> None:
        try:
            if not self._files:
                self._files = [tempfile.TemporaryFile(prefix='piezo_ident_') for _ in range(2)]
            for rows in (*self._chunks, *self._newest):
                for file, column in zip(self._files, rows.T, strict=True):
                    file.write(np.ascontiguousarray(column).data)
                    file.flush()
        except OSError as error:
            raise DataError(
                f'no room for a long record in {tempfile.gettempdir()} ({error.strerror}); make '
                'room, or set TMPDIR to a place with room'
            ) from None
        self._chunks, self._newest, self._rows = [], [], 0

    def _column(self, k: int) -> Array:
        if self._files:
            self._spool()
            # the map keeps the file, which has no name, until the column is gone
            return np.asarray(np.memmap(self._files[k], np.float64, 'r', shape=(self.n,)))
        parts = [rows[:, k] for rows in (*self._chunks, *self._newest)]
        return np.concatenate(parts) if parts else np.empty(0)

    @property
    def arrivals(self) -> Integers:
        """Time of arrival of each sample [ns]."""
        return np.repeat(np.array(self._arrivals, dtype=np.int64), self._sizes)

    def arrived(self, rows: Integers) -> Integers:
        """Return the times of arrival of some samples [ns]."""
        ends = np.cumsum(np.array(self._sizes, dtype=np.int64))
        block = np.searchsorted(ends, rows, 'right')
        return np.array(self._arrivals, dtype=np.int64)[block]

    def labels(self) -> tuple[list[str], Integers]:
        """Return the label and the first row of each stretch."""
        names: list[str] = []
        starts: list[int] = []
        row = 0
        # blocks have samples, and blocks of a segment share its label
        for label, size in zip(self._segments, self._sizes, strict=True):
            if not names or names[-1] != label:
                names.append(label)
                starts.append(row)
            row += size
        return names, np.array(starts, dtype=np.int64)


class LossCount:
    """
    Counts the lost messages of a topic, by their numbers.

    >>> losses = LossCount()
    >>> for number in (7, 8, 1, 9, 2, 5):
    ...     losses.note(number)
    >>> losses.lost
    2
    """

    #: a larger gap between numbers means another publisher that joined late
    GAP = 1000

    def __init__(self) -> None:
        self.lost = 0
        self._last: list[int] = []

    def note(self, number: int, *, alone: bool = False) -> None:
        """Note a number; `alone` if only one publisher exists, which gave the last number, too."""
        before = [n for n in self._last if n < number and (alone or number - n <= self.GAP)]
        if not before:
            self._last.append(number)
            return
        nearest = max(before)
        self.lost += number - nearest - 1
        self._last[self._last.index(nearest)] = number

    def restart(self) -> None:
        """Take the next number as the first."""
        self._last.clear()

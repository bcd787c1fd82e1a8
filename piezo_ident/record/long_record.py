# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A record whose samples stay in their file, and come part by part when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import DataError
from piezo_ident.record.clock import Clock, time_stamps
from piezo_ident.record.overall import Extent
from piezo_ident.record.record import Fault, Piece, Record, Segment

__all__ = ['LongRecord', 'NeedsWhole', 'Outline', 'Progress', 'parts_of']

#: called as ``progress(step, share)`` while something long goes on
Progress = Callable[[str, float], None]


class NeedsWhole(DataError):
    """Something that can only be met with the whole record at hand."""


@dataclass(frozen=True)
class Outline:
    """
    A uniformly sampled piece without its samples; see `piezo_ident.record.record.Piece`.

    Attributes
    ----------
    n : int
        Number of samples.
    sample_rate, start_time : float
        [Hz] and [s].
    segments : tuple of Segment
    channels : tuple of str
        Names of further signals.
    v, y : Extent
        Smallest and largest voltage [V] and displacement [m].
    """

    n: int
    sample_rate: float
    start_time: float
    segments: tuple[Segment, ...]
    channels: tuple[str, ...]
    v: Extent
    y: Extent

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.n / self.sample_rate

    def time(self, start: int, stop: int) -> NDArray[np.float64]:
        """Return the time of samples ``start`` to ``stop - 1`` [s]."""
        return time_stamps(Clock(self.sample_rate, self.start_time), start, min(stop, self.n))


@dataclass(frozen=True, eq=False)
class LongRecord:
    """
    One measurement that need not fit into memory; see `piezo_ident.record.record.Record`.

    Attributes
    ----------
    pieces : tuple of Outline
    name : str
    faults : tuple of Fault
    source : callable
        Returns, each time it is called, an iterator over all samples in order: pieces that add up
        to those above.
    """

    pieces: tuple[Outline, ...]
    name: str
    faults: tuple[Fault, ...]
    source: Callable[[Progress], Iterator[Piece]]

    def __iter__(self) -> Iterator[Outline]:
        """Iterate over the outlines of the pieces."""
        return iter(self.pieces)

    @property
    def n(self) -> int:
        """Number of samples in all pieces."""
        return sum(p.n for p in self.pieces)

    @property
    def duration(self) -> float:
        """Measured time in all pieces [s]."""
        return sum(p.duration for p in self.pieces)

    @property
    def stroke(self) -> float:
        """Largest minus smallest displacement [m]."""
        return max(p.y.high for p in self) - min(p.y.low for p in self)

    @property
    def voltage_range(self) -> tuple[float, float]:
        """Smallest and largest command voltage [V]."""
        return min(p.v.low for p in self), max(p.v.high for p in self)

    @property
    def labels(self) -> tuple[str, ...]:
        """Segment labels in order of first appearance."""
        return tuple(dict.fromkeys(s.label for p in self for s in p.segments))

    def parts(self, progress: Progress) -> Iterator[tuple[Outline, Iterator[Piece]]]:
        """
        Yield each piece as its outline and its parts, which must be taken before the next piece.

        Raises
        ------
        DataError
            When the file has changed since it was looked through.
        """
        source = self.source(progress)
        for outline in self:
            yield outline, self._of_one(outline, source)
        if next(source, None) is not None:
            raise self._changed()

    def _of_one(self, outline: Outline, source: Iterator[Piece]) -> Iterator[Piece]:
        left = outline.n
        while left:
            part = next(source, None)
            if part is None or part.n > left or part.sample_rate != outline.sample_rate:
                raise self._changed()
            left -= part.n
            yield part

    def _changed(self) -> DataError:
        return DataError(f'{self.name}: changed while it was read; run it again when it is whole')


def parts_of(
    record: Record | LongRecord, progress: Progress
) -> Iterator[tuple[Piece | Outline, Iterator[Piece]]]:
    """Yield each piece of a record and its parts; a record in memory has one part a piece."""
    if isinstance(record, LongRecord):
        yield from record.parts(progress)
        return
    for piece in record:
        yield piece, iter((piece,))

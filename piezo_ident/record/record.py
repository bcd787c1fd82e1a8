# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
A record: measured voltage, displacement, time and named segments.

A record is a list of uniformly sampled pieces.  A new piece begins where time jumps, the rate
changes or a sample is unusable, because the memory of the stage is then unknown.  If the
displacement alone is unusable, the new piece keeps the voltage of that time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
import itertools
from numbers import Real
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, frozen_array, Mask, robust_range
from piezo_ident.common.errors import DataError, expect
from piezo_ident.common.showable import Showable
from piezo_ident.record.clock import time_stamps

#: kinds of segments in programs; samples with other labels count as unlabelled
KINDS: tuple[str, ...] = ('step', 'settle', 'noise', 'triangle', 'sine', 'hold', 'staircase')
KINDS += ('multisine', 'ramp', 'idle')
#: advice on the form of further channels
NAMED = "give an array by name, as in {'v_b': array}"


@dataclass(frozen=True)
class Segment:
    """A named stretch of a piece: samples ``start`` to ``stop - 1``."""

    label: str
    start: int
    stop: int

    @property
    def kind(self) -> str:
        """The part of the label before the colon: ``sine`` of ``sine:50Hz``."""
        return self.label.partition(':')[0]

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.stop - self.start


@dataclass(frozen=True)
class Fault:
    """A fault of the data, and its treatment."""

    name: str
    where: str
    count: int
    action: str

    @property
    def is_note(self) -> bool:
        """Whether this is a note on the columns that were read, and no fault."""
        return self.name == 'columns'

    def __str__(self) -> str:
        """Return one line for people."""
        return f'{self.name} ({self.count}) {self.where}: {self.action}'


@dataclass(frozen=True, eq=False)
class Piece:
    """
    Uniformly sampled voltage and displacement.

    Parameters
    ----------
    v, y : array_like, shape (n,)
        Command voltage [V] and displacement [m].
    sample_rate : float
        Samples a second [Hz].
    start_time : float
        Time of the first sample [s].
    segments : tuple of Segment
        In order and without overlap; empty for unlabelled data.
    channels : mapping of str to array_like, shape (n,)
        Further measured signals, for example temperature or another axis's voltage.
    before : Piece, optional
        The samples right before this piece, whose displacement alone is unknown.
    sound : array_like of bool, shape (n,), optional
        False for a reading that was no displacement of the stage, and that a straight line
        replaces; see `piezo_ident.record.readings.faults.without_faults`.  None: not yet judged.

    Raises
    ------
    DataError
        If lengths differ, the piece is empty, or the rate is not positive.
    """

    v: Array
    y: Array
    sample_rate: float
    start_time: float = 0.0
    segments: tuple[Segment, ...] = ()
    channels: Mapping[str, Array] = field(default_factory=dict)
    before: Piece | None = None
    sound: Mask | None = None

    def __post_init__(self) -> None:
        v, y = frozen_array(self.v, 'v'), frozen_array(self.y, 'y')
        expect(self.channels, Mapping, 'channels', NAMED)
        channels = {k: frozen_array(x, f'channel {k!r}') for k, x in self.channels.items()}
        if v.ndim != 1 or v.size == 0:
            raise DataError('a piece needs at least one sample of voltage and displacement')
        lengths = {'v': v.size, 'y': y.size, **{k: x.size for k, x in channels.items()}}
        if self.sound is not None:
            lengths['sound'] = np.size(self.sound)
        if len(set(lengths.values())) > 1:
            raise DataError(f'channels differ in length: {lengths}; give one value a sample')
        if not (np.isfinite(self.sample_rate) and self.sample_rate > 0):
            raise DataError(f'sample rate must be positive, got {self.sample_rate} Hz')
        end = 0
        for s in self.segments:
            if s.start < end or s.stop <= s.start or s.stop > v.size:
                raise DataError(
                    f'segment {s.label!r} ({s.start}..{s.stop}) is empty, overlaps its '
                    f'neighbour or leaves the piece of {v.size} samples'
                )
            end = s.stop
        for name, value in {'v': v, 'y': y, 'channels': MappingProxyType(channels)}.items():
            object.__setattr__(self, name, value)

    @property
    def n(self) -> int:
        """Number of samples."""
        return int(self.v.size)

    @property
    def mask(self) -> Mask:
        """True for samples whose displacement counts, shape (n,)."""
        return np.ones(self.n, dtype=bool) if self.sound is None else self.sound

    @property
    def measured(self) -> Array:
        """The displacement [m], NaN for samples that do not count, shape (n,)."""
        return self.y if self.sound is None else np.where(self.sound, self.y, np.nan)

    @property
    def dt(self) -> float:
        """Sample period [s]."""
        return 1.0 / self.sample_rate

    @property
    def duration(self) -> float:
        """Length [s]."""
        return self.n / self.sample_rate

    @property
    def t(self) -> Array:
        """Time of each sample [s]; see `piezo_ident.record.clock.time_stamps`."""
        return self.time(0, self.n)

    def time(self, start: int, stop: int) -> Array:
        """Return the time of samples ``start`` to ``stop - 1`` [s], as in `t`."""
        return time_stamps(self.sample_rate, self.start_time, start, min(stop, self.n))

    def find(self, kind: str) -> list[Segment]:
        """Return the segments of a kind (``sine``) or with a full label (``sine:50Hz``)."""
        return [s for s in self.segments if kind in (s.kind, s.label)]

    def cut(self, start: int, stop: int) -> Piece:
        """Return samples ``start`` to ``stop - 1``, segments included; DataError for others."""
        if not 0 <= start < stop <= self.n:
            raise DataError(f'cannot cut samples {start}..{stop} out of a piece of {self.n}')
        segments = tuple(
            Segment(s.label, max(s.start, start) - start, min(s.stop, stop) - start)
            for s in self.segments
            if s.start < stop and s.stop > start
        )
        return Piece(
            v=self.v[start:stop],
            y=self.y[start:stop],
            sample_rate=self.sample_rate,
            start_time=float(self.time(start, start + 1)[0]) if start else self.start_time,
            segments=segments,
            channels={k: x[start:stop] for k, x in self.channels.items()},
            before=None if start else self.before,
            sound=None if self.sound is None else self.sound[start:stop],
        )

    def without(self, runs: Iterable[tuple[int, int]]) -> list[Piece]:
        """
        Return the parts between runs whose displacement, from start to stop - 1, is unusable.

        Each part keeps the voltage and channels of the run before it; a lone sample is no part.
        """
        marks = [0, *itertools.chain.from_iterable(runs), self.n]
        if len(marks) == 2:
            return [self]
        parts: list[Piece] = []
        end = 0
        for a, b in zip(marks[::2], marks[1::2], strict=True):
            if b - a < 2:
                continue
            part = self.cut(a, b)
            if parts:
                gap = self.cut(end, a)
                part = replace(part, before=replace(gap, y=np.full(gap.n, np.nan)))
            parts.append(part)
            end = b
        return parts


@dataclass(frozen=True, eq=False, repr=False)
class Record(Showable):
    """
    One measurement: pieces in order of time, one at least, and the faults of the data.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> record = pi.Record.from_arrays([0, 1, 2], [0, 1e-6, 2e-6], sample_rate=100)
    >>> record.n, record.duration
    (3, 0.03)
    """

    pieces: tuple[Piece, ...]
    name: str = 'record'
    faults: tuple[Fault, ...] = ()

    def __post_init__(self) -> None:
        if not self.pieces:
            raise DataError(f'{self.name}: no usable samples')

    def __iter__(self) -> Iterator[Piece]:
        """Iterate over the pieces."""
        return iter(self.pieces)

    @classmethod
    def from_arrays(
        cls,
        *arrays: ArrayLike,
        sample_rate: float | None = None,
        segments: tuple[Sequence[str], ArrayLike] | None = None,
        channels: Mapping[str, ArrayLike] | None = None,
        displacement_unit: str = 'm',
        voltage_limits: tuple[float, float] | None = None,
        name: str = 'record',
    ) -> Record:
        """
        Return the record of measured arrays, checked as the columns of a file are.

        Parameters
        ----------
        *arrays : array_like, shape (n,)
            ``t, v, y``, or ``v, y`` with a `sample_rate`: time [s], voltage [V], and displacement
            [`displacement_unit`].
        sample_rate : float, optional
            Samples a second [Hz]; stamps `t` must agree with it.
        segments : tuple of (names, starts), optional
            Label and first sample of each stretch; an empty label means none.
        channels : mapping of str to array_like, shape (n,), optional
            Further measured signals.
        displacement_unit : {'m', 'mm', 'um', 'nm'}
        voltage_limits : tuple of float, optional
            Smallest and largest voltage [V] that may occur.
        name : str

        Returns
        -------
        Record
            In SI units; its `faults` name every fault of the data, and its treatment.

        Raises
        ------
        DataError
            If the arrays cannot be used.

        Examples
        --------
        >>> import numpy as np
        >>> import piezo_ident as pi
        >>> v = 5 + 5 * np.sin(2 * np.pi * np.arange(20000) / 20000)
        >>> record = pi.Record.from_arrays(v, 7.5 * v, sample_rate=20e3, displacement_unit='um')
        >>> record.n, record.duration, round(1e6 * record.stroke)
        (20000, 1.0, 75)
        """
        from piezo_ident.record.assemble import assemble
        from piezo_ident.record.options import ReadOptions

        # numpy and MATLAB files hold a rate as an array without axes
        sample_rate = np.asarray(sample_rate).tolist()
        if sample_rate is not None:
            expect(sample_rate, Real, f'{name}: sample_rate', 'give the samples a second')
        if sample_rate is not None and not 0.0 < sample_rate < float('inf'):
            raise DataError(f'{name}: sample_rate must be positive, got {sample_rate} Hz')
        if sample_rate is not None and len(arrays) == 2:
            arrays = (np.arange(np.size(arrays[0])) / sample_rate, *arrays)
        if len(arrays) != 3:
            raise DataError(f'{name}: give t, v and y, or v and y with sample_rate')
        expect({} if channels is None else channels, Mapping, f'{name}: channels', NAMED)
        options = ReadOptions(displacement_unit, voltage_limits)
        t, v, y = arrays
        return assemble(
            t, v, y, segments, channels, name=name, options=options, sample_rate=sample_rate
        )

    @property
    def n(self) -> int:
        """Number of samples in all pieces."""
        return sum(p.n for p in self.pieces)

    @property
    def duration(self) -> float:
        """Measured time in all pieces [s]."""
        return sum(p.duration for p in self.pieces)

    @property
    def is_measured(self) -> bool:
        """Whether the displacement is known; it is NaN if a voltage alone was read."""
        return not np.isnan(self.pieces[0].y[0])

    def require_displacement(self) -> None:
        """Raise DataError for a record of voltage alone."""
        if not self.is_measured:
            raise DataError(
                f'{self.name}: holds a voltage and no displacement; only a prediction can use it'
            )

    @property
    def stroke(self) -> float:
        """Largest minus smallest displacement [m], single wild samples left out."""
        low, high = robust_range(p.y for p in self)
        return high - low

    @property
    def voltage_range(self) -> tuple[float, float]:
        """Smallest and largest command voltage [V]."""
        return float(min(p.v.min() for p in self)), float(max(p.v.max() for p in self))

    @property
    def labels(self) -> tuple[str, ...]:
        """Segment labels in order of first appearance."""
        return tuple(dict.fromkeys(s.label for p in self for s in p.segments))

    def find(self, kind: str) -> list[Piece]:
        """Return every segment of a kind, or of a full label, as a piece of its own."""
        return [p.cut(s.start, s.stop) for p in self for s in p.find(kind)]

    def first(self, n: int) -> Record:
        """Return the first n samples with a fault that says so; a shorter record as it is."""
        if self.n <= n:
            return self
        starts = itertools.accumulate((piece.n for piece in self), initial=0)
        pieces = (
            p.cut(0, min(n - start, p.n))
            for p, start in zip(self, starts, strict=False)
            if start < n
        )
        part = replace(self, pieces=tuple(pieces))
        where = f'{part.duration:.6g} of {self.duration:.6g} s are used'
        fault = Fault('part', where, self.n - n, 'what comes later is left out')
        return replace(part, faults=(*self.faults, fault))

    def renamed(self, name: str) -> Record:
        """Return the same record under another name."""
        return replace(self, name=name)


def named_apart(*groups: Iterable[Record]) -> Iterator[list[Record]]:
    """Yield the groups with a number in equal names, as strokes and zeros go by the name."""
    seen = Counter[str]()
    for group in groups:
        named = []
        for record in group:
            seen[record.name] += 1
            n = seen[record.name]
            named.append(record if n == 1 else replace(record, name=f'{record.name} ({n})'))
        yield named


def records_of(records: Record | Iterable[Record], where: str) -> list[Record]:
    """Return one record, or several, as a list; DataError for anything else."""
    single = isinstance(records, (Record, str)) or not isinstance(records, Iterable)
    several: list[Any] = [records] if single else list(records)
    for record in several:
        expect(record, Record, where, 'read a file with read')
    return several

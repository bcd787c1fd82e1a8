# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The outline of a long record, put together from the records of its windows."""

from __future__ import annotations

from dataclasses import dataclass, field

from piezo_ident.common.limits import PIECES
from piezo_ident.record.long_record import NeedsWhole, Outline
from piezo_ident.record.overall import Extent
from piezo_ident.record.record import Fault, Piece, Record, Segment

__all__ = ['Outlining']

#: the clock restarts where both runs have this many samples, and as many times in common
RUN = 300
#: faults by which a window does not tell the clock of the whole
CLOCK = frozenset({'sample_rate', 'timing_jitter', 'rate_change'})
#: places of a fault that are named
NAMED = 3
#: faults in the order in which a whole record meets them, behind those of single streams
ORDER = (
    'applied_unknown',
    'guarded_voltage',
    'not_finite',
    'restart',
    'repeated_rows',
    'lone_sample',
    'gap',
)


@dataclass
class _Growing:
    """A piece so far."""

    run: int
    first: int  # tick of the sample clock
    start_time: float
    sample_rate: float
    channels: tuple[str, ...]
    n: int = 0
    v: Extent = field(default_factory=Extent)
    y: Extent = field(default_factory=Extent)
    segments: list[Segment] = field(default_factory=list)

    def add(self, piece: Piece) -> None:
        for s in piece.segments:
            start, stop = s.start + self.n, s.stop + self.n
            last = self.segments[-1] if self.segments else None
            if last is not None and last.label == s.label and last.stop == start:
                start = self.segments.pop().start
            self.segments.append(Segment(s.label, start, stop))
        self.n += piece.n
        self.v, self.y = self.v.including(piece.v), self.y.including(piece.y)

    def outline(self) -> Outline:
        return Outline(
            self.n,
            self.sample_rate,
            self.start_time,
            tuple(self.segments),
            self.channels,
            self.v,
            self.y,
        )


@dataclass
class _Met:
    """A fault so far."""

    name: str
    action: str
    count: int = 0
    where: list[str] = field(default_factory=list)

    def fault(self) -> Fault:
        more = len(self.where) - NAMED
        where = '; '.join(self.where[:NAMED]) + (f'; and {more} times more' if more > 0 else '')
        return Fault(self.name, where, self.count, self.action)


class Outlining:
    """Puts windows together in their order."""

    def __init__(self) -> None:
        self._pieces: list[_Growing] = []
        self._met: dict[tuple[str, str, str], _Met] = {}
        self._run = 0

    def add(self, record: Record, run: int, rate: float) -> None:
        """
        Add the record of a window.

        Parameters
        ----------
        record : Record
        run : int
            Number of the run of the sample clock that it belongs to.
        rate : float
            Of the clock [Hz].

        Raises
        ------
        NeedsWhole
            When the clock, the way it restarts, or the number of pieces is not for windows.
        """
        for fault in record.faults:
            if fault.name in CLOCK:
                raise NeedsWhole(str(fault))
            self._meet(fault)
        for i, piece in enumerate(record.pieces):
            first = round(piece.start_time * rate)
            if piece.sample_rate != rate or first / rate != piece.start_time:
                raise NeedsWhole('another clock')
            last = self._pieces[-1] if self._pieces else None
            if last is not None and i == 0 and run != self._run:
                self._restart(last, piece, first)
            elif last is not None and i == 0:
                if last.first + last.n != first:
                    raise NeedsWhole('a break between two windows')
                last.add(piece)
                continue
            new = _Growing(run, first, piece.start_time, rate, tuple(piece.channels))
            new.add(piece)
            self._pieces.append(new)
        self._run = run
        if len(self._pieces) > PIECES:
            raise NeedsWhole('too many pieces')

    def _restart(self, last: _Growing, piece: Piece, first: int) -> None:
        before = next(p for p in self._pieces if p.run == last.run)
        if not (
            first <= before.first
            and first + RUN <= last.first + last.n
            and min(piece.n, last.n, before.n) >= RUN
        ):
            raise NeedsWhole('a restart that may be a repetition')
        end = last.start_time + (last.n - 1) / last.sample_rate
        where = f'from {end:.6g} s back to {piece.start_time:.6g} s'
        self._meet(Fault('restart', where, 1, 'record split there'))

    def _meet(self, fault: Fault) -> None:
        # what is met in a stream says so first
        head = fault.where.partition(',')[0] if fault.where.startswith('in ') else ''
        met = self._met.setdefault(
            (fault.name, fault.action, head), _Met(fault.name, fault.action)
        )
        met.count += fault.count
        met.where.append(fault.where)

    def pieces(self) -> tuple[Outline, ...]:
        """Return the outlines of the pieces so far."""
        return tuple(piece.outline() for piece in self._pieces)

    def faults(self) -> tuple[Fault, ...]:
        """Return what was met so far, each kind once."""

        def stage(key: tuple[str, str, str]) -> int:
            name, _, stream = key
            return -1 if stream else ORDER.index(name) if name in ORDER else len(ORDER)

        return tuple(self._met[key].fault() for key in sorted(self._met, key=stage))

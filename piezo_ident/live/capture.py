# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Keep incoming blocks for a record, within bounds of time and memory.

`piezo_ident.record.join` and `piezo_ident.record.assemble` make the record and deal with faulty
samples, as for a bag.  A capture also reports unreadable messages, and the time that it dropped to
stay within the bounds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import itertools

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import DataError
from piezo_ident.live.sample_clock import BlockClock
from piezo_ident.record.blocks import RAMPED, Samples
from piezo_ident.record.channels import channel_of_quantity
from piezo_ident.record.join import APPLIED, MAX_MISSING, record_of_streams
from piezo_ident.record.record import Fault, Piece, Record
from piezo_ident.record.stream import BlockStream

#: kinds of segments that the three steps of the identification need
NEEDED = ('step', 'noise', 'triangle')
#: most kept samples and blocks of a topic, and most counted labels
MOST_SAMPLES, MOST_BLOCKS, MOST_LABELS = 50_000_000, 2_000_000, 500


def refuse_incomplete(record: Record, sent: Mapping[str, float] | None = None) -> None:
    """
    Raise DataError if a record lost too much of a segment that the three steps need.

    Time missing between two pieces counts for the segments on both sides.  The time `sent` [s] of
    each kind of segment in the voltage reveals missing samples at the ends of the record.
    """
    present = {kind: sum(p.duration for p in record.find(kind)) for kind in NEEDED}
    missing = dict.fromkeys(NEEDED, 0.0)
    for one, other in itertools.pairwise(record.pieces):
        gap = other.start_time - (one.start_time + one.duration)
        if gap <= 0.0:
            continue  # another run
        sides = [s[i].kind for s, i in ((one.segments, -1), (other.segments, 0)) if s]
        for kind in set(sides) & set(NEEDED):
            missing[kind] += gap
    for kind in NEEDED:
        missing[kind] = max(missing[kind], (sent or {}).get(kind, 0.0) - present[kind])
        whole = present[kind] + missing[kind]
        if missing[kind] > MAX_MISSING * whole:
            causes = {f.name: f.where for f in record.faults}
            cure = 'find what loses samples, and run the program again'
            if 'guarded_voltage' in causes:
                cure = (
                    'the stage did not apply what was commanded, '
                    f'{causes["guarded_voltage"]}; look at its limits and its slew'
                )
            elif 'not_finite' in causes:
                where = causes['not_finite']
                cure = f'NaN or infinite {where}; look at the sensor, and run the program again'
            raise DataError(
                f'{record.name}: {missing[kind]:.3g} s of {whole:.3g} s of the {kind} segments '
                f'are missing or not usable; {cure}'
            )


def refuse_missing(record: Record, axes: Sequence[str]) -> None:
    """Raise DataError for a record without voltage or displacement of a further axis."""
    topics = [f'{what}_{axis}' for axis in axes for what in ('voltage', 'displacement')]
    missing = [
        topic
        for topic in topics
        if any(channel_of_quantity(topic) not in piece.channels for piece in record)
    ]
    if missing:
        raise DataError(
            f'{record.name}: nothing of {", ".join(missing)} has been captured; does the '
            "excitation have the same 'axes', and the stage such an axis?"
        )


def records_of_runs(record: Record) -> list[Record]:
    """
    Split a record into one record for each run of the sample clock.

    An unknown time passes between two runs, so everything that depends on time starts again.
    """
    runs: list[list[Piece]] = []
    for piece in record:
        if runs and piece.start_time > runs[-1][-1].start_time:
            runs[-1].append(piece)
        else:
            runs.append([piece])
    if len(runs) == 1:
        return [record]
    return [Record(tuple(pieces), f'{record.name} {i}') for i, pieces in enumerate(runs, 1)]


class _Topic:
    """Kept blocks of one topic, its clock, and the number of dropped samples."""

    def __init__(self) -> None:
        self.stream, self.clock = BlockStream(), BlockClock()
        # number of samples before each restart of the clock
        self._runs: list[int] = []
        self.dropped = self._newest = self.not_finite = 0
        # samples of ramps to rest between commands, and of a ramp since the last command
        self.ramped = self._ramp = 0

    def add(self, samples: Samples, arrival: int) -> None:
        """Take a block; the record will report impossible times."""
        t, restarts = samples.t, self.clock.restarts
        if samples.segment == RAMPED:
            self._ramp += t.size
        elif t.size and np.isfinite(t).all():
            self.clock.judge(t)
            if self.clock.restarts > restarts:
                self._runs.append(self.total)
            else:
                self.ramped += self._ramp
            self._ramp = 0
        self.not_finite += samples.not_finite
        self.stream.append(samples, arrival)
        self._newest = t.size

    @property
    def total(self) -> int:
        """Samples so far, with the dropped ones."""
        return self.dropped + self.stream.n

    def seconds(self, n: int) -> float:
        """Convert a number of samples to a time [s]; zero before the period is known."""
        return n * self.clock.period if np.isfinite(self.clock.period) else 0.0

    def make_room(self, limit: float) -> float:
        """Drop the oldest run, or a tenth of a single run; return the dropped time [s]."""
        n = next((run - self.dropped for run in self._runs if run > self.dropped), 0)
        if not n:
            share = 0.1 * limit / self.clock.period if self.seconds(self.stream.n) > limit else 0
            n = round(share) or self.stream.n // 10
        # the newest block stays, however long it is
        n = self.stream.drop(min(n, self.stream.n - self._newest))
        self.dropped += n
        return self.seconds(n)


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A copy of a capture at one moment; another thread may make its record later."""

    streams: Mapping[str, BlockStream]
    faults: tuple[Fault, ...] = ()

    def record(self, name: str = 'capture') -> Record:
        """Make the record; DataError without voltage or displacement, or for unusable data."""
        for key, cure in (
            ('voltage', 'start the excitation, or replay a bag'),
            ('displacement', 'is the stage running, and does it publish on this topic?'),
        ):
            if key not in self.streams or not self.streams[key].n:
                raise DataError(f'{name}: no {key} has been captured; {cure}')
        order = ('voltage', 'displacement', *sorted(self.streams))
        streams = {key: self.streams[key] for key in dict.fromkeys(order)}
        heard = {k: s for k, s in streams.items() if s.n or not k.startswith(APPLIED)}
        return record_of_streams(heard, name=name, faults=self.faults)

    def sent(self) -> dict[str, float]:
        """Return the time [s] of each kind of segment in the voltage, without repeats."""
        stream = self.streams['voltage']
        t = stream.times
        names, starts = stream.labels()
        times: dict[str, list[NDArray[np.float64]]] = {}
        for name, start, stop in zip(names, starts, [*starts[1:], t.size], strict=True):
            times.setdefault(name.partition(':')[0], []).append(t[start:stop])
        step = np.diff(t)
        period = float(np.median(step[step > 0.0])) if np.any(step > 0.0) else 0.0
        return {kind: period * np.unique(np.concatenate(x)).size for kind, x in times.items()}


class Capture:
    """
    All blocks of all topics so far.

    Parameters
    ----------
    limit : float, optional
        Longest kept time [s].  A longer capture drops the oldest run of the sample clock, or the
        oldest tenth of a single run.
    """

    def __init__(self, limit: float = 600.0) -> None:
        self.limit = limit
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._topics: dict[str, _Topic] = {}
        self._segments: dict[str, int] = {}
        self._unreadable: dict[str, tuple[int, str]] = {}
        self._forgotten = 0.0
        self.segment = ''

    def add(self, key: str, samples: Samples, arrival: int) -> None:
        """
        Take a block that arrived at a time `arrival` [ns] of a clock that all topics share.

        The `key` is ``voltage``, ``displacement`` or ``applied_voltage``, with the suffix
        ``_<name>`` for a further axis, or ``x_<name>``.
        """
        topic = self._topics.setdefault(key, _Topic())
        topic.add(samples, arrival)
        if key == 'voltage':
            self.segment = samples.segment
            label = samples.segment or 'unlabelled'
            if len(self._segments) >= MOST_LABELS and label not in self._segments:
                label = 'others'
            self._segments[label] = self._segments.get(label, 0) + samples.t.size
        n, blocks = topic.stream.n, topic.stream.blocks
        if topic.seconds(n) > self.limit or n > MOST_SAMPLES or blocks > MOST_BLOCKS:
            forgotten = topic.make_room(self.limit)
            self._forgotten += forgotten if key == 'voltage' else 0.0

    def unreadable(self, key: str, reason: str) -> None:
        """Count a message that does not hold a block."""
        self._unreadable[key] = (self._unreadable.get(key, (0, ''))[0] + 1, reason)

    def mark(self) -> dict[str, int]:
        """Mark this moment for `seconds_since` and `snapshot`; `clear` makes marks invalid."""
        return {key: topic.total for key, topic in self._topics.items()}

    def seconds_since(self, mark: Mapping[str, int], key: str = 'voltage') -> float:
        """Return the kept time of a topic after a mark [s]."""
        topic = self._topics.get(key, _Topic())
        return topic.seconds(min(topic.stream.n, topic.total - mark.get(key, 0)))

    def snapshot(self, since: Mapping[str, int] | None = None) -> Snapshot:
        """Copy the capture from the mark `since` on, without copying samples."""
        faults = [
            Fault('unreadable_block', f'on {key}, last: {reason}', count, 'dropped')
            for key, (count, reason) in self._unreadable.items()
        ]
        if self._forgotten:
            where = f'the oldest {self._forgotten:.3g} s'
            action = f'forgotten, {self.limit:g} s are kept'
            faults.append(Fault('capture_limit', where, 1, action))
        streams = {key: topic.stream.copy() for key, topic in self._topics.items()}
        for key, stream in streams.items():
            stream.drop((since or {}).get(key, 0) - self._topics[key].dropped)
        return Snapshot(streams, tuple(faults))

    def record(self, name: str = 'capture') -> Record:
        """Make a record of the capture; see `Snapshot.record`."""
        return self.snapshot().record(name)

    @property
    def keys(self) -> tuple[str, ...]:
        """Keys of the topics, in order of appearance."""
        return tuple(self._topics)

    @property
    def n(self) -> int:
        """Number of kept samples of the voltage."""
        return self._topics['voltage'].stream.n if 'voltage' in self._topics else 0

    def last_time(self, key: str) -> float:
        """Return the time of the newest sample of a topic [s]; NaN before the first."""
        return self._topics[key].clock.last if key in self._topics else float('nan')

    @property
    def seconds(self) -> float:
        """Kept time of the voltage [s]."""
        return self.seconds_since({})

    @property
    def segments(self) -> Mapping[str, int]:
        """Samples of each label so far, in order of appearance."""
        return dict(self._segments)

    @property
    def lost(self) -> Mapping[str, int]:
        """Number of missing samples of each topic, by its sample clock."""
        return {key: topic.clock.lost for key, topic in self._topics.items()}

    @property
    def problems(self) -> tuple[str, ...]:
        """Faults of the capture so far, a sentence for each kind and topic."""
        problems = []
        for key, topic in self._topics.items():
            if topic.clock.lost:
                problems.append(f'{topic.clock.lost} samples of {key} are missing')
            if topic.clock.late:
                problems.append(f'{topic.clock.late} samples of {key} came twice or out of turn')
            if topic.not_finite:
                problems.append(f'{topic.not_finite} samples of {key} are NaN or infinite')
            if topic.ramped:
                problems.append(f'{topic.ramped} samples of {key} are a ramp to rest in silence')
        for key, (count, reason) in self._unreadable.items():
            problems.append(f'{count} messages on {key} are no blocks ({reason})')
        return tuple(problems)

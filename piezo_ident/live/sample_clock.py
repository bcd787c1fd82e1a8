# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Follow a stream of blocks by its time stamps, and by its publisher.

`BlockClock` follows a stream of any rate, from any publisher.  `SampleClock` follows a stream of a
known rate, from one publisher.

A node that drives an amplifier must know how a block relates to its stream (see `Kind`), and which
publisher sent the block.  rclpy gives the sequence number of a message, but not its publisher;
each publisher counts its own messages.  rclpy also gives the ids of all publishers of the topic.
The rules are:

- While the topic has a single publisher, every message belongs to this followed publisher.
- Amid several publishers a message with the next number belongs to the followed publisher, unless
  another publisher is known to be at that number.  If numbers are missing, the time decides.
- Two publishers that start together are at the same number and time.  Their messages cannot be
  told apart and are refused.
- After a silence the followed publisher may come back.  Another publisher is followed once the
  first has gone, or after `SampleClock.end`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Hashable
from dataclasses import dataclass
import enum

import numpy as np
from numpy.typing import NDArray
from piezo_ident.record.blocks import Samples, time_problem
from piezo_ident.record.clock import has_restarted

#: returns the ids of all publishers of a topic
Publishers = Callable[[], Collection[Hashable]]

#: number of blocks whose repetition is recognised, of gaps that late blocks may belong to, and of
#: other publishers whose count is remembered
MEMORY = 8
#: largest distance of a time stamp from its tick [samples]
SLACK = 1e-3
#: a clock that jumps ahead by more has restarted: a day, the longest capture [s]
LONGEST_GAP = 86_400.0


class Kind(enum.Enum):
    """Relation of a block to its stream."""

    NEXT = 'next'  # The block goes on where the last block ended.
    START = 'start'  # The block begins a new stream, or the stream starts over.
    GAP = 'gap'  # The block belongs to the stream, after missing samples.
    REPEAT = 'repeat'  # The same block came before.
    LATE = 'late'  # The time of the block has passed.
    SECOND = 'second'  # Another publisher sent the block, while the followed stream is alive.
    MALFORMED = 'malformed'  # The time stamps are not consecutive ticks.


@dataclass(frozen=True)
class Verdict:
    """Relation of a block, its first tick, samples missing before it, and a reason for people."""

    kind: Kind
    tick: int = 0
    missing: int = 0
    reason: str = ''

    @property
    def is_taken(self) -> bool:
        """Whether the block belongs to the followed stream."""
        return self.kind in (Kind.NEXT, Kind.START, Kind.GAP)


class SampleClock:
    """
    Tracks the sample clock of one stream.

    Parameters
    ----------
    sample_rate : float
        [Hz]
    longest_gap : float
        Longest gap within a stream; a longer gap begins a new stream [s].

    Attributes
    ----------
    head : int or None
        Next expected tick; None before a stream begins and while it is silent.

    Examples
    --------
    >>> clock = SampleClock(1000.0, longest_gap=0.1)
    >>> t = np.arange(100) / 1000.0
    >>> clock.judge(Samples(t, t)).kind.value, clock.judge(Samples(t + 0.1, t)).kind.value
    ('start', 'next')
    >>> clock.judge(Samples(t + 0.25, t)).missing
    50
    """

    def __init__(self, sample_rate: float, longest_gap: float) -> None:
        self.sample_rate = sample_rate
        self.longest_gap = longest_gap
        self._sequence: int | None = None
        self._is_silent = False
        #: the next numbers of the other publishers, the latest last
        self._others: deque[int] = deque(maxlen=MEMORY)
        self.end()

    def pause(self) -> None:
        """Note a silence; while the followed publisher exists, it alone may go on."""
        self._is_silent = self._is_silent or self.head is not None
        self._forget()

    def end(self) -> None:
        """Stop following the stream: the next block of any publisher begins a stream."""
        self._is_silent = False
        self._owner: Hashable = None
        self._is_alone = True
        self._forget()

    def _forget(self) -> None:
        self.head: int | None = None
        self._begin = 0
        self._again: int | None = None
        self._seen: deque[tuple[int, bytes]] = deque(maxlen=MEMORY)
        self._holes: deque[tuple[int, int]] = deque(maxlen=MEMORY)
        #: next number and tick of other publishers that have sent during this stream
        self._rivals: deque[tuple[int, int]] = deque(maxlen=MEMORY)

    def skip(self, sequence: int | None) -> None:
        """Count a message without a readable block."""
        if sequence is None or self._is_next(sequence):
            self._sequence = sequence
        else:
            self._note_other(sequence)

    def judge(
        self, samples: Samples, sequence: int | None = None, publishers: Publishers = tuple
    ) -> Verdict:
        """
        Decide how the next block relates to the stream.

        Parameters
        ----------
        samples : Samples
        sequence : int, optional
            Sequence number of the message by its publisher; None if the middleware lacks it.
        publishers : callable, optional
            Returns the ids (gids) of all publishers of the topic; no ids mean one publisher.
            Called only if a block does not go on, or if others were present at the start.
        """
        ticks, reason = self._ticks(samples.t)
        if reason:
            self.skip(sequence)
            return Verdict(Kind.MALFORMED, reason=reason)
        tick, n = int(ticks[0]), samples.t.size
        if self._is_foreign(tick, sequence, publishers):
            self._note_other(sequence)
            if sequence is not None:
                self._rivals.append((sequence + 1, tick + n))
            return Verdict(
                Kind.SECOND,
                tick,
                reason=f'second publisher: its block {self._at(tick)} is not of the stream that '
                'is followed',
            )
        verdict = self._judge(tick, samples)
        if verdict.kind is Kind.START:
            self._start(tick, sequence, publishers)
        self._sequence = sequence
        if verdict.is_taken:
            if verdict.kind is Kind.GAP:
                self._holes.append((tick - verdict.missing, tick))
            self.head = tick + n
            self._seen.append((tick, samples.values.tobytes()))
            self._again = None
        elif verdict.kind is Kind.REPEAT:
            self._again = tick + n
        return verdict

    def _ticks(self, t: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
        if problem := time_problem(t):
            return t, problem
        position = t * self.sample_rate
        ticks = np.rint(position)
        if np.abs(position - ticks).max() <= SLACK and np.all(np.diff(ticks) == 1):
            return ticks, ''
        step = float(np.median(np.diff(t))) if t.size > 1 else 0.0
        if step > 0 and abs(step * self.sample_rate - 1) > SLACK:
            return t, (
                f'it is sampled at {1 / step:.6g} Hz, expected are {self.sample_rate:g} Hz; '
                'set sample_rate of the excitation'
            )
        return t, f'its time stamps are not ticks of {self.sample_rate:g} Hz in a row'

    def _is_next(self, sequence: int) -> bool:
        """Return whether a number is next for the followed publisher and for no other."""
        return self._sequence is None or (
            sequence == self._sequence + 1 and sequence not in self._others
        )

    def _note_other(self, sequence: int | None) -> None:
        if sequence is not None:
            # a number that both may have sent stays in the list of the others
            if sequence in self._others and sequence - 1 != self._sequence:
                self._others.remove(sequence)
            self._others.append(sequence + 1)

    def _is_foreign(self, tick: int, sequence: int | None, publishers: Publishers) -> bool:
        """Return whether another publisher sent a block, or may have sent it."""
        if self.head is None and not self._is_silent:
            return False  # any publisher is followed
        numbered = sequence is not None and self._sequence is not None
        goes_on = tick == self.head and (not numbered or sequence == (self._sequence or 0) + 1)
        if goes_on and self._is_alone:
            return False
        ids = publishers()
        if goes_on:
            if len(ids) == 1:
                # the others have gone
                (self._owner,) = ids
                self._is_alone = True
            return not self._is_alone and (sequence, tick) in self._rivals
        if self._is_alone and (not ids or set(ids) == {self._owner}):
            return False
        if self._owner is not None and ids and self._owner not in ids:
            # the followed publisher has gone; its last blocks may still arrive
            return not self._is_silent
        return not numbered or sequence is None or not self._is_next(sequence)

    def _start(self, tick: int, sequence: int | None, publishers: Publishers) -> None:
        """Begin a stream of the followed publisher or of a new publisher."""
        if self.head is None:
            ids = publishers()
            is_same = self._is_silent and (not ids or self._owner is None or self._owner in ids)
            if not is_same:
                before = self._sequence
                if before is not None and sequence != before + 1:
                    self._note_other(before)
                if sequence in self._others:
                    self._others.remove(sequence or 0)
                self._is_alone = len(ids) < 2
                self._owner = next(iter(ids)) if len(ids) == 1 else None
        self._is_silent = False
        self._forget()
        self._begin = tick

    def _at(self, tick: int) -> str:
        return f'at t = {tick / self.sample_rate:.6g} s'

    def _judge(self, tick: int, samples: Samples) -> Verdict:
        n, at = samples.t.size, self._at(tick)
        if self.head is None:
            return Verdict(Kind.START, tick, reason=f'a stream begins {at}')
        missing = tick - self.head
        if missing == 0:
            return Verdict(Kind.NEXT, tick)
        if missing > 0:
            kind = Kind.GAP if missing <= self.longest_gap * self.sample_rate else Kind.START
            return Verdict(kind, tick, missing, f'{missing} samples are missing {at}')
        # two consecutive blocks that came before mean that the stream starts over
        if tick != self._again:
            if (tick, samples.values.tobytes()) in self._seen:
                return Verdict(Kind.REPEAT, tick, reason=f'the block {at} came twice')
            in_a_gap = any(start <= tick and tick + n <= stop for start, stop in self._holes)
            if in_a_gap or not has_restarted(tick, self.head - 1, self._begin, 1.0):
                return Verdict(Kind.LATE, tick, reason=f'the block {at} came too late')
        return Verdict(Kind.START, tick, reason=f'the stream starts over {at}')


class BlockClock:
    """
    Clock of a stream: tells whether a block goes on, skips samples, came before, or starts over.

    Attributes
    ----------
    begin, last : float
        Time of the first sample since the last restart, and of the newest one [s].
    period : float
        Sampling period [s].
    lost, late, restarts : int
        Samples that never came, samples that came again or out of turn, restarts of the clock.

    Examples
    --------
    >>> clock, t = BlockClock(), np.arange(100) / 1000.0
    >>> [clock.judge(x)[0].value for x in (t, t + 0.1, t + 0.3, t + 0.3, t)]
    ['start', 'next', 'gap', 'late', 'start']
    >>> clock.lost, clock.late, clock.restarts
    (100, 100, 1)
    """

    def __init__(self) -> None:
        self.begin = self.last = self.period = float('nan')
        self.lost = self.late = self.restarts = 0

    def judge(self, t: NDArray[np.float64]) -> tuple[Kind, int]:
        """
        Take note of the next block, by the time stamps [s] of its samples, shape (n,).

        Returns `Kind.START`, `Kind.NEXT`, `Kind.GAP` or `Kind.LATE`, and the number of samples
        that are missing before the block (`Kind.GAP`), or that came before, at its beginning
        (`Kind.LATE`).
        """
        first, last, before = float(t[0]), float(t[-1]), self.last
        if last > first:
            self.period = (last - first) / (t.size - 1)
        elif np.isnan(self.period) and first > before:
            # a stream of single samples
            self.period = first - before
        if np.isnan(before):
            self.begin, self.last = first, last
            return Kind.START, 0
        # a repeated first block ends at the end of the stream; the clock did not restart
        is_back = last < before and has_restarted(first, before, self.begin, self.period)
        if is_back or first - before > LONGEST_GAP:
            self.restarts += 1
            self.begin, self.last = first, last
            return Kind.START, 0
        self.last = max(last, before)
        step = first - before
        if step > 1.5 * self.period:
            missing = round(step / self.period) - 1
            self.lost += missing
            return Kind.GAP, missing
        half = 0.0 if np.isnan(self.period) else 0.5 * self.period
        if step > half:
            return Kind.NEXT, 0
        late = int(np.count_nonzero(t <= before + half))
        self.late += late
        return Kind.LATE, late

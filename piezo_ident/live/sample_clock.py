# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""
Follows one stream of blocks by its time stamps, and tells what became of it.

Whoever drives an amplifier from blocks must know whether a block goes on where the last one
ended, starts over, comes twice or too late, or belongs to somebody else's stream.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
import enum

import numpy as np
from numpy.typing import NDArray
from piezo_ident.record.blocks import Samples

__all__ = ['Follower', 'Kind', 'Verdict']

#: blocks whose repetition is recognised, and gaps into which a late block may belong
MEMORY = 8
#: how far a stamp may lie off its tick, in samples
SLACK = 1e-3


class Kind(enum.Enum):
    """What a block is to a stream."""

    NEXT = 'next'  # goes on where the last one ended
    START = 'start'  # a new stream, or one that starts over
    GAP = 'gap'  # the same stream, after samples that are missing
    REPEAT = 'repeat'  # came before
    LATE = 'late'  # its time has passed: a gap was made of it
    SECOND = 'second'  # of another publisher, while the followed stream is alive
    MALFORMED = 'malformed'  # its time stamps are not those of a block


@dataclass(frozen=True)
class Verdict:
    """
    What a block is.

    Attributes
    ----------
    kind : Kind
    tick : int
        Of its first sample.
    missing : int
        Samples between the last block and this one.
    reason : str
        For people; empty for `Kind.NEXT`.
    """

    kind: Kind
    tick: int = 0
    missing: int = 0
    reason: str = ''

    @property
    def is_taken(self) -> bool:
        """Whether the block belongs to what is followed."""
        return self.kind in (Kind.NEXT, Kind.START, Kind.GAP)


class Follower:
    """
    Follows a stream.

    Parameters
    ----------
    sample_rate : float
        [Hz]
    longest_gap : float
        A stream that misses more than this is a new one [s].

    Attributes
    ----------
    head : int or None
        The tick expected next; None when no stream is followed.
    """

    def __init__(self, sample_rate: float, longest_gap: float) -> None:
        self.sample_rate = sample_rate
        self.longest_gap = longest_gap
        self.head: int | None = None
        self._sequence: int | None = None
        self._seen: deque[tuple[int, bytes]] = deque(maxlen=MEMORY)
        self._holes: deque[tuple[int, int]] = deque(maxlen=MEMORY)
        self._again: int | None = None

    def lose(self) -> None:
        """Forget the stream: it has fallen silent, and whatever comes next is a new one."""
        self.head = None
        self._again = None
        self._seen.clear()
        self._holes.clear()

    def skip(self, sequence: int | None) -> None:
        """Count a message that holds no block."""
        if self._is_own(sequence):
            self._sequence = sequence

    def judge(self, samples: Samples, sequence: int | None = None, publishers: int = 1) -> Verdict:
        """
        Say what the next block is.

        Parameters
        ----------
        samples : Samples
        sequence : int, optional
            Number that its publisher gave the message, where the middleware tells.
        publishers : int, optional
            How many publishers the topic has.
        """
        ticks, reason = self._ticks(samples.t)
        if reason:
            self.skip(sequence)
            return Verdict(Kind.MALFORMED, reason=reason)
        verdict = self._judge(int(ticks[0]), samples, sequence, publishers)
        if verdict.kind is not Kind.SECOND:
            self._sequence = sequence
        if verdict.is_taken:
            if verdict.kind is Kind.START:
                self.lose()
            elif verdict.kind is Kind.GAP:
                self._holes.append((verdict.tick - verdict.missing, verdict.tick))
            self.head = verdict.tick + samples.t.size
            self._seen.append((verdict.tick, samples.values.tobytes()))
            self._again = None
        elif verdict.kind is Kind.REPEAT:
            self._again = verdict.tick + samples.t.size
        return verdict

    def _ticks(self, t: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
        if not t.size:
            return t, 'an empty block'
        position = t * self.sample_rate
        if not (np.isfinite(position).all() and np.abs(position).max() < 2**53):
            return t, 'its time stamps are not finite'
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

    def _is_own(self, sequence: int | None) -> bool:
        """Return whether a message may be the next of the followed publisher."""
        return sequence is None or self._sequence is None or sequence == self._sequence + 1

    def _is_foreign(self, tick: int, size: int, sequence: int | None, publishers: int) -> bool:
        """Return whether a block is another publisher's, as far as one can tell."""
        if publishers < 2 or self.head is None:
            return False
        if sequence is None or self._sequence is None:
            return tick != self.head
        # blocks that the middleware lost are missing from the count and from the time alike
        lost = sequence - self._sequence - 1
        return lost != 0 and not (lost > 0 and 0 < tick - self.head <= (lost + 1) * 2 * size)

    def _judge(
        self, tick: int, samples: Samples, sequence: int | None, publishers: int
    ) -> Verdict:
        n = samples.t.size
        at = f'at t = {tick / self.sample_rate:.6g} s'
        if self.head is None:
            return Verdict(Kind.START, tick, reason=f'a stream begins {at}')
        if self._is_foreign(tick, n, sequence, publishers):
            return Verdict(
                Kind.SECOND,
                tick,
                reason=f'second publisher: its block {at} is not of the stream that is followed',
            )
        missing = tick - self.head
        if missing == 0:
            return Verdict(Kind.NEXT, tick)
        if missing > 0:
            kind = Kind.GAP if missing <= self.longest_gap * self.sample_rate else Kind.START
            return Verdict(kind, tick, missing, f'{missing} samples are missing {at}')
        # two in a row that were there before are no repetition but the stream once more
        if tick != self._again:
            if (tick, samples.values.tobytes()) in self._seen:
                return Verdict(Kind.REPEAT, tick, reason=f'the block {at} came twice')
            if any(start <= tick and tick + n <= stop for start, stop in self._holes):
                return Verdict(Kind.LATE, tick, reason=f'the block {at} came too late')
        return Verdict(Kind.START, tick, reason=f'the stream starts over {at}')

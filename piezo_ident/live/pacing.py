# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""
When each block is due, and when it came, whoever sets the clock of the machine.

The schedule is counted from its start, so that it cannot drift.
"""

from __future__ import annotations

from collections.abc import Callable
import time

__all__ = ['BlockClock', 'LogClock']

#: a block this much behind its time is not caught up with: readers keep only so many blocks [s]
SLIP = 0.25
#: the clock was set when it moved by more, which is less than a block [ns]
STEP = 500_000


class BlockClock:
    """
    The schedule of a stream.

    Parameters
    ----------
    speed : float
        Samples a second; 0: everything is due at once.
    start : float
        Time of the first sample, on any monotonic clock [s].

    Attributes
    ----------
    sent, late : int
        Blocks, and how many of them were sent after the next one was due.
    worst : float
        Largest delay of a block [s].
    slipped : float
        By how much the schedule was moved after long delays [s].

    Examples
    --------
    >>> clock = BlockClock(20000.0, start=10.0)
    >>> clock.due(100)
    10.005
    """

    def __init__(self, speed: float, start: float) -> None:
        self.speed = speed
        self.start = start
        self.sent = 0
        self.late = 0
        self.worst = 0.0
        self.slipped = 0.0

    def due(self, tick: int) -> float:
        """Return when a sample is due."""
        return self.start + tick / self.speed if self.speed else self.start

    def note(self, tick: int, size: int, now: float) -> None:
        """Take note that a block was sent."""
        self.sent += 1
        if not self.speed:
            return
        delay = now - self.due(tick)
        self.worst = max(self.worst, delay)
        if delay > size / self.speed:
            self.late += 1
        if delay > SLIP:
            self.start += delay
            self.slipped += delay


class LogClock:
    """
    Times of arrival that go on evenly when somebody sets the clock of the machine.

    A bag is read in the order of its log times: a clock that was set back would mix what came
    after with what came before.

    Parameters
    ----------
    wall, steady : callable, optional
        The clock that may be set, in which arrivals are told, and one that cannot be [ns].

    Attributes
    ----------
    set_by : int
        By how much the clock was set since the beginning [ns].
    """

    def __init__(
        self,
        wall: Callable[[], int] = time.time_ns,
        steady: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._wall, self._steady = wall, steady
        self._offset = self._measured()
        self.set_by = self._before = 0
        self._now = 0

    def look(self) -> None:
        """Look whether the clock was set; to be called before what has come is stamped."""
        moved = self._measured() - self._offset
        self._before = self.set_by
        if abs(moved - self.set_by) > STEP:
            self.set_by = moved
        self._now = self._steady() + self._offset

    def _measured(self) -> int:
        found = []
        # a pause between the readings would look like a step
        for _ in range(5):
            before, wall, after = self._steady(), self._wall(), self._steady()
            found.append((after - before, wall - (before + after) // 2))
        return min(found)[1]

    def stamp(self, arrival: int) -> int:
        """Return the log time of an arrival since the last look but one [ns]."""
        # what came before the step was told by the clock as it was; nothing comes from the future
        ways = (arrival - self.set_by, arrival - self._before)
        now = self._now
        return min(ways, key=lambda stamp: (stamp - now > 4 * STEP, abs(stamp - now)))

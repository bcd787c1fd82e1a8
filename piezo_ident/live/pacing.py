# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""When each block is due, and when it arrived, whatever happens to the clock of the machine."""

from __future__ import annotations

from collections.abc import Callable
import time

#: a block this much behind its time is not caught up with: readers keep only so many blocks [s]
SLIP = 0.25
#: the clock was set when it moved by more, which is less than a block [ns]
STEP = 500_000


class Schedule:
    """
    The schedule of a stream, counted from its start so that it cannot drift.

    Parameters
    ----------
    speed : float
        Progress in a second: samples, or seconds of a recording.
    start : float
        When position 0 is due, on a monotonic clock [s].
    slip : float, optional
        Delay from which on the rest of the schedule moves instead of being caught up with [s].

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
    >>> schedule = Schedule(20000.0, start=10.0)
    >>> schedule.due(100)
    10.005
    """

    def __init__(self, speed: float, start: float, slip: float = SLIP) -> None:
        self.speed = speed
        self.start = start
        self.slip = slip
        self.sent = self.late = 0
        self.worst = self.slipped = 0.0

    def due(self, position: float) -> float:
        """Return when a position is due."""
        return self.start + position / self.speed

    def note(self, position: float, size: float, now: float) -> None:
        """Take note that a block of this position and size is sent now."""
        self.sent += 1
        delay = now - self.due(position)
        self.worst = max(self.worst, delay)
        self.late += delay > size / self.speed
        if delay > self.slip:
            self.start += delay
            self.slipped += delay

    def change_speed(self, speed: float, position: float, now: float) -> None:
        """Go on at another speed, with this position due now."""
        self.speed, self.start = speed, now - position / speed


class Pace:
    """
    How many samples are due in real time, from one look to the next.

    After a pause of the process the stream goes on where it was.

    Parameters
    ----------
    rate : float
        Samples a second.
    longest : float
        Time that is caught up with at most [s].
    """

    def __init__(self, rate: float, longest: float) -> None:
        self._rate, self._most = rate, max(1, round(longest * rate))
        self._begin, self._seen = time.monotonic(), 0

    def due(self) -> int:
        """Return the samples that are due since the last look."""
        now = round((time.monotonic() - self._begin) * self._rate)
        due, self._seen = min(now - self._seen, self._most), now
        return due


class Looks:
    """
    Regular looks of a process at what it waits for.

    A process that gets no time from the machine hears nothing meanwhile, and what was sent still
    waits for it.  A wait is therefore over only where an earlier look fell into its second half.
    """

    def __init__(self) -> None:
        self._before = self._now = time.monotonic()

    def look(self) -> None:
        """Look now."""
        self._before, self._now = self._now, time.monotonic()

    def is_over(self, since: float, limit: float) -> bool:
        """Return whether nothing came for longer than a limit [s], on time.monotonic."""
        return self._now - since > limit and self._before - since > 0.5 * limit


class ArrivalClock:
    """
    Times of arrival that go on evenly when somebody sets the clock of the machine.

    A bag is read in the order of its log times: a clock that was set back would mix what came
    after with what came before.

    Parameters
    ----------
    wall, steady : callable, optional
        The clock that may be set, by which arrivals are stamped, and one that cannot be [ns].

    Attributes
    ----------
    set_by : int
        By how much the clock was set since the beginning [ns].
    """

    def __init__(
        self, wall: Callable[[], int] = time.time_ns, steady: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._wall, self._steady = wall, steady
        self._offset = self._measured()
        self.set_by = self._before = 0
        self._now = 0

    def look(self) -> None:
        """Look whether the clock was set; to be called before arrivals are stamped."""
        moved = self._measured() - self._offset
        self._before = self.set_by
        if abs(moved - self.set_by) > STEP:
            self.set_by = moved
        self._now = self._steady() + self._offset

    def _measured(self) -> int:
        readings = []
        # a pause between the readings would look like a step
        for _ in range(5):
            before, wall, after = self._steady(), self._wall(), self._steady()
            readings.append((after - before, wall - (before + after) // 2))
        return min(readings)[1]

    def stamp(self, arrival: int) -> int:
        """Return the log time of an arrival since the last look but one [ns]."""
        # before the step the old clock was in force; nothing comes from the future
        ways = (arrival - self.set_by, arrival - self._before)
        now = self._now
        return min(ways, key=lambda stamp: (stamp - now > 4 * STEP, abs(stamp - now)))


class Rate:
    """How fast a count grows, from one look to the next."""

    def __init__(self) -> None:
        self._at, self._count = time.monotonic(), 0.0

    def of(self, count: float) -> float:
        """Return the growth a second since the last look; 0 where it started over."""
        now = time.monotonic()
        rate = max(0.0, count - self._count) / max(now - self._at, 1e-3)
        self._at, self._count = now, count
        return rate

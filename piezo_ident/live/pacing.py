# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Time the sending and the arrival of blocks, independent of changes of the machine's clock."""

from __future__ import annotations

from collections.abc import Callable
import time

#: largest delay that is made up, since readers keep only so many blocks [s]
SLIP = 0.25
#: smallest jump of a clock that was set; less than the time of a block [ns]
STEP = 500_000


class Schedule:
    """
    Schedule of a stream, counted from its start so that it cannot drift.

    Parameters
    ----------
    speed : float
        Progress per second: samples, or seconds of a recording.
    start : float
        When position 0 is due, on a monotonic clock [s].
    slip : float, optional
        Largest delay that is made up; a larger one moves the rest of the schedule [s].

    Attributes
    ----------
    sent, late : int
        Number of blocks, and number of blocks sent after the next block was due.
    worst : float
        Largest delay of a block [s].
    slipped : float
        Time by which long delays have moved the schedule [s].

    Examples
    --------
    >>> schedule = Schedule(20000.0, start=10.0)
    >>> schedule.due(100)
    10.005
    """

    def __init__(self, speed: float, start: float, slip: float = SLIP) -> None:
        self.speed, self.start, self.slip = speed, start, slip
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
    Counts the samples due in real time since the last look.

    The stream has `rate` samples a second.  A look makes up for at most the time `longest` [s]:
    after a long pause of the process the stream goes on where it was.
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
    Time-outs of a process that looks regularly for messages.

    A busy machine may stop the process, and messages sent meanwhile wait unread.  A wait is
    therefore over only if the look before the last one, too, came after half of the limit.
    """

    def __init__(self) -> None:
        self._before = self._now = time.monotonic()

    def look(self) -> None:
        """Look now."""
        self._before, self._now = self._now, time.monotonic()

    def is_over(self, since: float, limit: float) -> bool:
        """Return whether a wait since a time (time.monotonic) has exceeded a limit [s]."""
        return self._now - since > limit and self._before - since > 0.5 * limit


class ArrivalClock:
    """
    Times of arrival that go on evenly when somebody sets the clock of the machine.

    A bag is read in the order of its log times.  Times from a clock that was set back would
    interleave later messages with earlier messages.  The clock `wall` [ns] stamps arrivals and may
    be set; the clock `steady` [ns] cannot be set.  `set_by` is the total change of `wall` [ns].
    """

    def __init__(
        self, wall: Callable[[], int] = time.time_ns, steady: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._wall, self._steady = wall, steady
        self._offset = self._measured()
        self.set_by = self._before = 0
        self._now = 0

    def look(self) -> None:
        """Detect whether the clock was set; call it before arrivals are stamped."""
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
        # an arrival before the jump has the old time; no arrival lies in the future
        ways = (arrival - self.set_by, arrival - self._before)
        now = self._now
        return min(ways, key=lambda stamp: (stamp - now > 4 * STEP, abs(stamp - now)))


class Rate:
    """Growth of a count per second, from one look to the next."""

    def __init__(self) -> None:
        self._at, self._count = time.monotonic(), 0.0

    def of(self, count: float) -> float:
        """Return the growth per second since the last look; 0 if the count started over."""
        now = time.monotonic()
        rate = max(0.0, count - self._count) / max(now - self._at, 1e-3)
        self._at, self._count = now, count
        return rate

# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.


"""When each block is due: a schedule that is counted from its start, so that it cannot drift."""

from __future__ import annotations

__all__ = ['BlockClock']

#: a block this much behind its time is not caught up with: readers keep only so many blocks [s]
SLIP = 0.25


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

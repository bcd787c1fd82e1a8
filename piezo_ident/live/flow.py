# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""How far a sender of blocks is ahead of those who listen, so that nobody's queue overruns."""

from __future__ import annotations

from collections import deque
import math

__all__ = ['FlowControl']

#: blocks among which an answer is looked for; more than any sender may be ahead
MEMORY = 256


class FlowControl:
    """
    Counts the blocks that are on their way.

    An answer is the time of the last sample that a listener has dealt with, as the blocks on its
    topic carry it; the answers in between may be missing.  A listener counts from its first answer
    on: a model node without a model gives none.

    Parameters
    ----------
    *required : str
        Listeners that count from the beginning.

    Attributes
    ----------
    count : int
        Blocks sent.

    Examples
    --------
    >>> flow = FlowControl('displacement')
    >>> for k in range(5):
    ...     flow.sent(k, k + 0.9)
    >>> flow.ahead
    5
    >>> flow.heard('displacement', 3.9)
    >>> flow.ahead
    1
    >>> flow.heard('prediction', 0.9)
    >>> flow.ahead, flow.slowest
    (4, 'prediction')
    """

    def __init__(self, *required: str) -> None:
        self._blocks: deque[tuple[float, float]] = deque(maxlen=MEMORY)
        self.count = 0
        self._answered = dict.fromkeys(required, 0)
        self._times: dict[str, float] = {}

    @property
    def ahead(self) -> int:
        """Blocks that the slowest listener has not answered; 0 where nobody counts."""
        return self.count - min(self._answered.values(), default=self.count)

    @property
    def slowest(self) -> str:
        """The listener that is waited for; empty where nobody counts."""
        return min(self._answered, key=self._answered.__getitem__, default='')

    @property
    def answering(self) -> tuple[str, ...]:
        """Those who have answered."""
        return tuple(self._times)

    def last_time(self, listener: str) -> float:
        """Return the time of a listener's last answer [s]; NaN before the first."""
        return self._times.get(listener, math.nan)

    def sent(self, first: float, last: float) -> None:
        """Take note of a block, by the times of its first and last sample [s]."""
        self._blocks.append((first, last))
        self.count += 1

    def expect(self, listener: str) -> None:
        """Wait for a listener from now on, although it has not answered yet."""
        self._answered.setdefault(listener, self.count)

    def leave(self, listener: str) -> None:
        """Wait for a listener no more."""
        self._answered.pop(listener, None)
        self._times.pop(listener, None)

    def heard(self, listener: str, t: float) -> None:
        """Take note of an answer; one to nothing that is on its way is none."""
        oldest = self.count - len(self._blocks)
        begin = max(self._answered.get(listener, 0), oldest)
        # where the clock of a bag starts over a time comes twice: then the earlier one is meant,
        # as nobody can be ahead of what was sent
        for number in range(begin, self.count):
            first, last = block = self._blocks[number - oldest]
            if first <= t <= last:
                answered = number + (t >= last)
                # a block that was sent twice in a row
                while answered > number and answered < self.count:
                    if self._blocks[answered - oldest] != block:
                        break
                    answered += 1
                self._answered[listener] = answered
                self._times[listener] = t
                return

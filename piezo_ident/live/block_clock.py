# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Follow the sample clock of a stream by its time stamps, at any rate and from any publisher."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.live.sample_clock import Kind
from piezo_ident.record.clock import has_restarted

#: a clock that jumps ahead by more is another clock: a day, the longest capture [s]
LONGEST_GAP = 86_400.0


class BlockClock:
    """
    Clock of a stream; it says if a block goes on, skips samples, came before, or starts over.

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
        Take note of the next block.

        Parameters
        ----------
        t : ndarray, shape (n,)
            Time stamps [s] of consecutive samples.

        Returns
        -------
        Kind
            `Kind.START`, `Kind.NEXT`, `Kind.GAP` or `Kind.LATE`.
        int
            Samples missing before the block (`Kind.GAP`), or samples at its beginning that came
            before (`Kind.LATE`).
        """
        first, last, before = float(t[0]), float(t[-1]), self.last
        if last > first:
            self.period = (last - first) / (t.size - 1)
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

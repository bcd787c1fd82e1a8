# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Keep the part of a voltage on which the state of a new model depends.

A new model takes over in the state of a run from the start.  Its plays remember extremes of the
voltage since the start of the run.  A loop inside a later stroke leaves no trace in the plays (the
wiping-out property), so few turning points matter.  The history keeps these turning points, the
samples just before each, and the last seconds in full.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import line_between
from piezo_ident.common.kernel import kernel
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import Stream
from piezo_ident.record.blocks import Samples

if TYPE_CHECKING:
    from piezo_ident.control.live_inverse import LiveInverse

#: time over which the voltage is kept sample by sample, for G of a new model [s]
RECENT = 5.0
#: length of the kept samples before each turning point [s]
APPROACH = 0.05
#: most blocks of the last seconds
MOST_BLOCKS = 100_000


@kernel
def _turns(v: NDArray[np.float64], out: NDArray[np.int64]) -> int:
    # writes the indices of first and last sample and of each change of direction
    n, before = 0, 0.0
    for k in range(v.size):
        after = np.sign(v[k + 1] - v[k]) if k + 1 < v.size else np.nan
        if k == 0 or after != before:
            out[n] = k
            n += 1
        before = after
    return n


class TurningPoints:
    """
    Turning points of a voltage that determine the memory of any play operator.

    Four turning points in a row lose the inner two if these lie between the outer two.  The first
    point always stays.

    Examples
    --------
    >>> points = TurningPoints()
    >>> points.add(np.arange(6.0), np.array([0.0, 4.0, 1.0, 3.0, 2.0, 5.0]))
    >>> points.values.tolist()
    [0.0, 5.0]
    """

    def __init__(self) -> None:
        # value of each point, and the samples that lead to it
        self._points: list[tuple[float, Samples]] = []
        self._tail = Samples(np.empty(0), np.empty(0))

    def __len__(self) -> int:
        return len(self._points)

    def add(self, t: NDArray[np.float64], v: NDArray[np.float64]) -> None:
        """Add the next samples: time [s] and voltage [V]."""
        # most samples of a block lie between two turning points
        turns = np.empty(v.size, dtype=np.int64)
        turns = turns[: _turns(np.array(v, dtype=np.float64), turns)]
        before = self._tail.t.size
        t, v = np.concatenate([self._tail.t, t]), np.concatenate([self._tail.values, v])
        first = np.searchsorted(t, t - APPROACH)
        points = self._points
        for k in (before + turns).tolist():
            x, lead = float(v[k]), Samples(t[first[k] : k + 1], v[first[k] : k + 1])
            if points and x == points[-1][0]:
                continue
            if len(points) > 1 and (points[-1][0] - points[-2][0]) * (x - points[-1][0]) > 0.0:
                points.pop()
            points.append((x, lead))
            while len(points) > 3:
                a, b, c, d = (value for value, _ in points[-4:])
                if not min(a, d) <= min(b, c) <= max(b, c) <= max(a, d):
                    break
                del points[-3:-1]
        self._tail = Samples(t[first[-1] :], v[first[-1] :])

    def copy(self) -> TurningPoints:
        """Return an independent copy."""
        other = TurningPoints()
        other._points, other._tail = self._points.copy(), self._tail
        return other

    @property
    def values(self) -> NDArray[np.float64]:
        """Voltage at the start, at the turning points and at the last sample [V]."""
        return np.array([x for x, _ in self._points])

    def path(self, period: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """
        Return time [s] and voltage [V], every `period` [s], of a path through the turning points.

        Operators that depend on the speed need it.  The path holds the recorded samples before
        each point, connected by short straight lines.
        """
        parts_t: list[NDArray[np.float64]] = []
        parts_v: list[NDArray[np.float64]] = []
        for _, lead in self._points:
            t, v = lead.t, lead.values
            if parts_t:
                end, level = float(parts_t[-1][-1]), float(parts_v[-1][-1])
                t, v = t[t > end], v[t > end]
                missing = min(float(t[0]) - end, APPROACH) / period
                if missing > 1.5:
                    n = round(missing) - 1
                    parts_t.append(line_between(end, float(t[0]), n))
                    parts_v.append(line_between(level, float(v[0]), n))
            parts_t.append(t)
            parts_v.append(v)
        return np.concatenate(parts_t), np.concatenate(parts_v)


class History:
    """
    Voltage since the start of a run: its turning points, and its last seconds in full.

    Attributes
    ----------
    count : int
        Samples so far.
    """

    def __init__(self) -> None:
        self._old = TurningPoints()
        self._recent: deque[tuple[NDArray[np.float64], NDArray[np.float64]]] = deque()
        self.count = 0

    def __len__(self) -> int:
        return self.count

    @property
    def last(self) -> float:
        """The voltage now [V]."""
        return float(self._recent[-1][1][-1])

    def add(self, t: NDArray[np.float64], v: NDArray[np.float64]) -> None:
        """Add the next samples, at least one: time [s] and voltage [V]."""
        self.count += v.size
        recent = self._recent
        recent.append((t, v))
        while t[-1] - recent[0][0][-1] > RECENT or len(recent) > MOST_BLOCKS:
            self._old.add(*recent.popleft())

    def snapshot(self) -> History:
        """Copy the history for another thread."""
        copy = History()
        copy._old, copy._recent = self._old.copy(), self._recent.copy()
        copy.count = self.count
        return copy

    def recall(
        self, run: LiveInverse | Stream, model: StageModel, period: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """
        Set a fresh run by the old part of the voltage, and return the recent part.

        The caller has to run through the recent part: time [s] and voltage [V].
        """
        # without an old part the recent part is the whole run
        if len(self._old):
            if model.effects_in('input') or model.effects_in('hysteresis'):
                t, v = self._old.path(period)
            else:
                # plays alone do not depend on time
                v = self._old.values
                t = np.zeros(v.size)
            run.recall(v, t)
        t, v = (np.concatenate(x) for x in zip(*self._recent, strict=True))
        return t, v

    def since(self, count: int) -> NDArray[np.float64]:
        """Return the voltage after the first `count` samples [V], at most the last seconds."""
        missing, parts = self.count - count, [np.empty(0)]
        for _, v in reversed(self._recent):
            if missing <= 0:
                break
            parts.append(v[-missing:])
            missing -= v.size
        return np.concatenate(parts[::-1])

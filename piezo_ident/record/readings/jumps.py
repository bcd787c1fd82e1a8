# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Find readings that jump away from a signal and come back.

Jumps are steps far larger than the steps around them, and cut the signal into parts.  The choice
of the parts to leave out has least cost.  A sample left out costs 1.  A kept jump costs `JUMP`, or
0 if the voltage explains it.  A part that goes on at the end of the last kept part costs 0.
"""

from __future__ import annotations

from dataclasses import dataclass
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, CHUNK, Integers, interpolated, Mask, true_runs
from piezo_ident.common.kernel import kernel
from scipy.ndimage import maximum_filter1d, uniform_filter1d

#: least size of a jump, as a share of the stroke
LEAST = 2e-3
#: least size of a jump in usual steps of so many samples on either side (taste: white noise
#: reaches 6.7 times its median step)
FAR, AROUND = 8.0, 16
WIDTH = 2 * AROUND + 1
#: least size of a jump in codes of a converter: noise turns two
CODES = 3.0
#: quantile of the steps, sound if half of them are jumps; ratio of the median to it without jumps
QUANTILE = 0.3, 1.75
#: rms of second over first differences of steps without memory (white noise: 1.73, a sine of five
#: samples a period: 1.18)
ROUGH = 1.3
#: least size of large steps, as a share of the stroke (taste)
LARGE = 0.1
#: cost of a jump [samples]: two jumps enclose up to nine wild readings in a row
JUMP = 5
#: longest excursion between two jumps, as a share of a signal
LONGEST = 0.1
#: number of parts before a part at whose ends it may go on
PARTS = 256
#: the voltage explains a jump if a step of the voltage asks for this share of the jump
STEPS = 0.3
#: largest path of a stage over the path that the voltage asks for
OVER = 1.5
#: longest answer of a stage to a step [samples]
RINGS = 30


def least_step(y: Array) -> float:
    """Return the least step between neighbouring readings [m], infinite without a step."""
    steps = np.abs(np.diff(y))
    return float(steps[steps > 0.0].min(initial=np.inf))


def least_jump(y: Array, stroke: float) -> float:
    """Return the least error of a wild reading [m], by the stroke and the usual step."""
    steps = np.abs(np.diff(y[:CHUNK]))
    moved = steps[steps > 0.0]
    return max(LEAST * stroke, FAR * float(np.median(moved)) if moved.size else 0.0)


def wild_readings(
    error: Array, stroke: float, step: float = np.inf, measured: Array | None = None
) -> Mask:
    """
    Mark the wild readings in the error, measured minus predicted displacement [m].

    The prediction has the motion by the voltage; `step` is the `least_step` of the `measured`
    displacement.  Only a jump of the measured displacement is a wild reading, since a goal out of
    reach may jump, too.

    >>> error = np.array([0.0] * 9 + [1.0] + [0.0] * 9)
    >>> wild_readings(error, stroke=10.0).nonzero()[0]
    array([9])
    >>> bool(wild_readings(error, stroke=10.0, measured=np.zeros(19)).any())
    False
    """
    if error.size < 2:
        return np.zeros(error.size, dtype=bool)
    # without noise every step would be wild
    noise = float(np.median(np.abs(np.diff(error))))
    codes = CODES * step if np.isfinite(step) else 0.0
    floor = max(LEAST * stroke, FAR * noise, codes)
    wild = Jumps.of(error, np.zeros(error.size), floor, stroke).left_out()
    if measured is None or not wild.any():
        return wild
    off, jumped = (np.abs(x - interpolated(x, wild)) for x in (error, measured))
    for a, b in true_runs(wild):
        wild[a:b] = jumped[a:b].max() > 0.5 * off[a:b].max()
    return wild


@dataclass(frozen=True, eq=False)
class Jumps:
    """
    A signal y cut at its jumps.

    `start` are the first sample of each part and the end of the signal.  `height` is the step into
    each part, `least` the least size of a jump there, and `cost` the cost of keeping the jump.
    `path` is the path that the voltage asked for since the first sample [m]; the voltage may be
    `delay` samples ahead.
    """

    y: Array
    start: Integers
    height: Array
    least: Array
    cost: Integers
    path: Array
    delay: int

    @classmethod
    def of(cls, y: Array, asked: Array, floor: float, stroke: float, delay: int = 0) -> Jumps:
        """Cut a signal; `asked` is the step that the voltage asks for at each sample [m]."""
        step = np.diff(y, prepend=y[:1])
        size = np.abs(step)
        # two readings cannot tell which of them is wild
        at = np.flatnonzero(size > floor) if y.size > 2 else np.empty(0, np.int64)
        usual = _usual(size[1:], at)
        # mean squares of first and second differences
        run, bend = (uniform_filter1d(d * d, WIDTH)[at] for d in (step, np.diff(step, append=0.0)))
        answered = maximum_filter1d(asked, 2 * RINGS + 1)[at] >= STEPS * usual
        # a motion has memory: large steps without memory or voltage are wild
        wild = (usual > LARGE * stroke) & (bend > ROUGH**2 * run) & ~answered
        usual = np.where(wild, 0.0, usual)
        far = size[at] > FAR * usual
        at = at[far]
        least = np.maximum(floor, FAR * usual[far])
        # a stage answers a step of the voltage by a rise of several samples, and ringing
        rings = np.where(asked > FAR * uniform_filter1d(asked, WIDTH), asked, 0.0)
        behind = np.maximum(_before(asked, delay), _before(rings, RINGS))[at]
        explained = behind >= STEPS * size[at]
        return cls(
            y=y,
            start=np.concatenate([[0], at, [y.size]]).astype(np.int64),
            height=np.concatenate([[0.0], step[at]]),
            least=np.concatenate([[0.0], least]),
            cost=np.concatenate([[0], np.where(explained, 0, JUMP)]).astype(np.int64),
            path=np.cumsum(asked),
            delay=delay,
        )

    def left_out(self) -> Mask:
        """Return a mask of the samples to leave out."""
        out = np.zeros(self.y.size, dtype=bool)
        if self.height.size == 1:
            return out
        before = _cheapest(
            self.y, self.start, self.least, self.cost, self.path, self.delay, OVER, PARTS
        )
        kept = []
        # the last entry is the end of the signal
        part = int(before[-1])
        while part >= 0:
            kept.append(part)
            part = int(before[part])
        out[:] = True
        for part in kept:
            out[self.start[part] : self.start[part + 1]] = False
        # long excursions between two jumps that the voltage cannot have made
        paid = [i for j, i in itertools.pairwise(kept[::-1]) if i == j + 1 and self.cost[i]]
        end = -1
        for i, j in itertools.pairwise(paid):
            a, b = int(self.start[i]), int(self.start[j])
            # the stretch behind an excursion is sound
            if b - a > LONGEST * self.y.size or a <= end:
                continue
            way = OVER * float(self.path[b] - self.path[max(0, a - 1 - self.delay)])
            least = float(max(self.least[i], self.least[j]))
            height = min(abs(self.height[i]), abs(self.height[j]))
            comes_back = abs(self.y[b] - self.y[a - 1]) <= least + way
            if self.height[i] * self.height[j] < 0.0 and comes_back and height > 2.0 * way + least:
                out[a:b], end = True, b
        return out


def _usual(x: Array, at: Integers) -> Array:
    """Return the median of normal x >= 0 around places; half of x may be jumps."""
    if not at.size:
        return np.empty(0)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(x, AROUND, 'symmetric'), WIDTH)
    place = int(QUANTILE[0] * WIDTH)
    return np.asarray(
        QUANTILE[1] * np.partition(around[np.minimum(at - 1, x.size - 1)], place)[:, place]
    )


def _before(x: Array, most: int) -> Array:
    """Return the largest x of each sample and of `most` samples before it."""
    return np.asarray(maximum_filter1d(x, most + 1, origin=most // 2, mode='nearest'))


@kernel
def _cheapest(
    y: Array,
    start: Integers,
    least: Array,
    cost: Integers,
    path: Array,
    delay: int,
    over: float,
    most: int,
) -> Integers:
    # before[j]: the part kept before part j, -1 for none; the last entry stands for the end
    n = start.size - 1
    total, before = np.empty(n + 1), np.full(n + 1, -1)
    for j in range(n + 1):
        total[j] = start[j]
        for i in range(max(0, j - most), j):
            gap = start[j] - start[i + 1]
            if total[i] + gap >= total[j]:
                continue
            if j < n and i == j - 1:
                now = total[i] + cost[j]
            else:
                now = total[i] + gap
                if j < n:
                    last = start[i + 1] - 1
                    way = over * (path[start[j]] - path[max(0, last - delay)])
                    if abs(y[start[j]] - y[last]) > max(least[i + 1], least[j]) + way:
                        continue
            if now < total[j]:
                total[j], before[j] = now, i
    return before

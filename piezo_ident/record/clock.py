# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Find the sampling clock of a column of time stamps.

Stamps are rounded: to the decimals or digits that a file prints, to single precision, or to the
last bit.  A stamp is therefore an interval.  A stretch of stamps is uniform if one rate passes
through all its intervals.  The rate with the fewest digits is taken: a sampling clock is 5000 Hz,
not 4999.9999999997 Hz, and a written record reads the same.

A computer that stamps samples as they arrive is sometimes late.  A late stamp makes a long step,
which looks like a gap, and then a short step: the stamps scatter about one clock.  No short step
follows a lost sample.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array, CHUNK, Integers, Mask, true_runs

#: a clock that goes back by more samples than this (ten blocks) has restarted
JUMP_BACK = 1000
#: fewer steps than this between two finer runs are gaps, not a slower sampling rate
_SHORT = 8
#: negligible deviation from the uniform grid [samples]
_NEGLIGIBLE = 0.01
#: least stamps that distinguish scatter from a change of rate
_LEAST = 16
#: steps on either side of an average of time, which removes scatter and keeps a lost sample
_AROUND = 8


class Clock(NamedTuple):
    """Time ``start_time + k / sample_rate`` [s], and how far stamps stray from it [samples]."""

    sample_rate: float
    start_time: float
    jitter: float = 0.0


@dataclass(frozen=True)
class Resolution:
    """Rounding of a column of stamps; None means the resolution of a float64."""

    decimals: int | None = None
    digits: int | None = None
    single: bool = False

    @classmethod
    def of(cls, t: Array) -> Resolution:
        """Return the coarsest rounding that all stamps have."""
        # whole stretches, because every fifth stamp of 5 kHz has a decimal fewer than the rest
        blocks = np.linspace(0, max(t.size - 500, 0), 8).astype(int)
        x = np.abs(t if t.size <= 4000 else np.concatenate([t[b : b + 500] for b in blocks]))
        x = x[np.isfinite(x) & (x > 1e-9)]
        if not x.size:
            return cls()
        top = int(np.floor(np.log10(x.max())))
        place = np.floor(np.log10(x)).astype(int)
        # 13 digits leave a float64 three to tell a rounded number from any other
        decimals = (d for d in range(13 - top) if _rounded_to(x, np.full(x.shape, d)))
        digits = (s for s in range(1, 13) if _rounded_to(x, s - 1 - place))
        with np.errstate(over='ignore'):
            single = bool(np.all(x.astype(np.float32).astype(np.float64) == x))
        return cls(next(decimals, None), next(digits, None), single)

    def error(self, t: Array, dt: float) -> Array:
        """Return how far each stamp may lie from the true time of its sample, `dt` apart [s]."""
        half = np.zeros(t.shape)
        if self.decimals is not None:
            half += 0.5 * 10.0**-self.decimals
        if self.digits is not None:
            place = np.floor(np.log10(np.maximum(np.abs(t), 1e-12)))
            half = np.maximum(half, 0.5 * 10.0 ** (place - self.digits + 1))
        if self.single:
            half = np.maximum(half, 0.5 * np.spacing(np.abs(t).astype(np.float32)))
        # steps of one or two units of the last decimal are exact more often than rounded
        return np.asarray(np.minimum(half, 0.2 * dt) + 8 * np.spacing(np.abs(t)))


def _rounded_to(x: Array, decimals: NDArray[np.int_]) -> bool:
    scale = 10.0 ** np.abs(decimals)
    rounded = np.where(decimals >= 0, np.rint(x * scale) / scale, np.rint(x / scale) * scale)
    return bool(np.all(np.abs(rounded - x) <= 2 * np.spacing(x)))


def time_stamps(sample_rate: float, start_time: float, start: int, stop: int) -> Array:
    """
    Return the times of samples `start` to ``stop - 1`` [s].

    The times are ``k / sample_rate`` in one division if the first sample lies on a tick of the
    sample clock.  Two streams of one clock then have equal numbers, and join.
    """
    first = round(start_time * sample_rate)
    t = np.arange(start, stop, dtype=np.float64)
    # in place: an hour has 72 million samples
    if first / sample_rate == start_time:
        t += first
        t /= sample_rate
    else:
        t /= sample_rate
        t += start_time
    return t


def split_uniform(t: Array, resolution: Resolution) -> list[tuple[int, int]]:
    """
    Split strictly increasing stamps [s] at interruptions and at changes of the sampling rate.

    Returns (start, stop) of each stretch in order; a stretch may be a single sample.
    """
    cuts = _without_scatter(t, np.flatnonzero(_breaks(t)) + 1)
    todo = list(itertools.pairwise([0, *cuts.tolist(), t.size]))[::-1]
    if cuts.size > t.size // _SHORT + 10:
        return todo[::-1]  # too many cuts for any uniform stretch
    done: list[tuple[int, int]] = []
    while todo:
        start, stop = todo.pop()
        inner = [start + c for c in _inner_cuts(t[start:stop], resolution)]
        if inner:
            todo.extend(list(itertools.pairwise([start, *inner, stop]))[::-1])
        else:
            done.append((start, stop))
    return done


def _steps(t: Array, overlap: int) -> Iterator[tuple[int, Array]]:
    """Yield the steps of `t` chunk by chunk, and the sample before the first of them."""
    for i in range(0, t.size - overlap, CHUNK):
        yield i, np.diff(t[i : i + CHUNK + overlap])


def _breaks(t: Array) -> Mask:
    """
    Return for each step between neighbours whether it lies outside every uniform stretch.

    Steps of like size form runs.  A short run of coarse steps beside a finer run is a gap.  The
    rate changes between two longer runs, and the sample between them goes to the later run.
    """
    n = t.size - 1
    runs: list[int] = [0]
    for i, step in _steps(t, 2):
        change = np.abs(np.diff(step)) > 0.6 * np.minimum(step[1:], step[:-1])
        runs += (np.flatnonzero(change) + (i + 1)).tolist()
    if len(runs) == 1:
        return np.zeros(max(n, 0), dtype=np.bool_)
    first = np.array(runs)
    length = np.diff(np.append(first, n))
    level = (t[first + length] - t[first]) / length
    before, after = np.append(np.inf, level[:-1]), np.append(level[1:], np.inf)
    gap = (length < _SHORT) & (level > 1.5 * np.minimum(before, after))
    breaks = np.repeat(gap, length)
    breaks[first[1:][~gap[1:] & ~gap[:-1]] - 1] = True
    return breaks


def _inner_cuts(t: Array, resolution: Resolution) -> list[int]:
    """Return the cuts of a stretch without coarse breaks; empty for a uniform stretch."""
    n = t.size
    if n < 3:
        return []
    dt = (t[-1] - t[0]) / (n - 1)
    # rounding to a few decimals can hide a missing sample between neighbours
    wide: list[int] = []
    for i, step in _steps(t, 1):
        wide += (np.flatnonzero(step > 1.5 * dt) + (i + 1)).tolist()
    if wide and not _scatters(t):
        return wide
    low, high = rate_bounds(t, lambda x: resolution.error(x, dt))
    if low <= high:
        return []
    residual = _line_residual(t)
    if np.abs(residual).max() <= _NEGLIGIBLE * dt or n < 4 * _SHORT or _scatters(t):
        return []
    # a change of rate is a kink, a jump of the clock a step: both peak at the cut
    step = np.diff(t)
    k = int(np.argmax(np.abs(t - (t[0] + np.arange(n) * dt))))
    if 0 < k < n - 1 and abs(step[k] - dt) > abs(step[k - 1] - dt) + 0.1 * dt:
        k += 1
    if not _SHORT <= k <= n - _SHORT:
        return []
    rms = float(np.std(residual))
    parts = sorted(float(np.std(_line_residual(part))) for part in (t[:k], t[k:]))
    # at a true cut at least one side is clean; a cut does not reduce jitter
    return [k] if parts[0] < 0.5 * rms and parts[1] < 1.1 * rms else []


def _line_residual(t: Array) -> Array:
    """Return the distance of the stamps from their least-squares line [s]."""
    k = np.arange(t.size) - 0.5 * (t.size - 1)
    x = t - t[0]
    x -= x.mean()
    return np.asarray(x - k * (np.dot(k, x) / np.dot(k, k)))


def _scatters(t: Array) -> bool:
    """
    Return whether increasing stamps [s] scatter about one uniform clock.

    Stamps scatter if a line errs by less than half a sample everywhere, errors of neighbours are
    independent, and time that jumps forward comes back.

    >>> t = np.arange(100.0)
    >>> _scatters(t + 0.3 * np.sin(t**2)), _scatters(np.delete(t, 50))
    (True, False)
    """
    if t.size < _LEAST:
        return False
    residual = _line_residual(t)
    if 2 * np.abs(residual).max() >= (t[-1] - t[0]) / (t.size - 1):
        return False
    step = np.diff(residual)
    # white noise has twice its power in its steps, a change of rate next to none
    is_white = np.dot(step, step) > np.dot(residual, residual)
    return bool(is_white and -step.min() > 0.6 * step.max())


def _without_scatter(t: Array, cuts: Integers) -> Integers:
    """Return the cuts of increasing stamps [s] that scatter does not explain."""
    if not cuts.size:
        return cuts
    marks = np.array([0, *_jumps(t), t.size], dtype=np.int64)
    inside = np.searchsorted(cuts, marks[:-1], 'right') < np.searchsorted(cuts, marks[1:])
    for i in np.flatnonzero(inside & (np.diff(marks) >= _LEAST)):
        start, stop = marks[i], marks[i + 1]
        if _scatters(t[start:stop]):
            cuts = cuts[(cuts <= start) | (cuts >= stop)]
            cuts = np.union1d(cuts, marks[i : i + 2])
    return cuts[(cuts > 0) & (cuts < t.size)]


def _jumps(t: Array) -> Iterator[int]:
    """Yield the samples before which time jumps by more than half a step, and stays there."""
    dt = float(np.median(np.diff(t[:CHUNK])))
    # mean time behind a sample less that before it, in terms of the steps between
    weights = 1 - np.abs(np.arange(1 - _AROUND, _AROUND)) / _AROUND
    for at in range(0, t.size - 1, CHUNK):
        first = max(at - 2 * _AROUND, 0)
        step = np.diff(t[first : at + CHUNK + 2 * _AROUND]) - dt
        ahead = np.convolve(step, weights)[_AROUND - 1 : 1 - _AROUND] > 0.5 * dt
        for start, stop in true_runs(ahead):
            k = first + int(start + np.argmax(step[start:stop])) + 1
            if at < k <= at + CHUNK:
                yield k


def fit_clock(t: Array, resolution: Resolution, known: Iterable[float] = ()) -> Clock:
    """
    Fit a uniform clock to increasing stamps [s], two at least, of one uniform stretch.

    The rate is the possible rate of fewest digits, at the resolution of the whole file.  A `known`
    rate [Hz] that the stamps allow goes before: a long stretch of a file shows the rate better
    than a short stretch.
    """
    dt = float(t[-1] - t[0]) / (t.size - 1)
    low, high = rate_bounds(t, lambda x: resolution.error(x, dt))
    jitter, start = 0.0, float(t[0])
    if low > high:
        residual = _line_residual(t)
        deviation = float(np.abs(residual).max())
        jitter, start = deviation / dt, float(t[0] - residual[0])
        slack = 2 * deviation / float(t[-1] - t[0])
        low, high = (1 - slack) / dt, (1 + slack) / dt
    rate = next((r for r in known if low <= r <= high), None)
    if rate is not None:
        return Clock(rate, _start(start, rate, resolution), jitter)
    if not jitter:
        # stamps may be far better than their last decimal: 0.0001 s steps at four decimals
        for half in (_last_bit, lambda x: 8 * np.spacing(np.abs(x))):
            tight = rate_bounds(t, half)
            if tight[0] <= tight[1]:
                low, high = tight
                break
    clocks = [Clock(r, _start(start, r, resolution), jitter) for r in nice_rates(low, high)]
    exact = next((c for c in clocks if not jitter and _reproduces(c, t)), None)
    return exact or _settled(clocks[0], t.size)


def _settled(clock: Clock, n: int) -> Clock:
    """Return the clock that its own stamps show, so that a written file reads the same."""
    for _ in range(5):
        t = time_stamps(clock.sample_rate, clock.start_time, 0, n)
        resolution = Resolution.of(t)
        low, high = rate_bounds(t, _last_bit)
        if not low <= high:
            return clock
        start = float(t[0])
        again = [
            Clock(r, _start(start, r, resolution), clock.jitter) for r in nice_rates(low, high)
        ]
        exact = next((c for c in again if _reproduces(c, t)), again[0])
        if exact == clock:
            return clock
        clock = exact
    return clock


def _last_bit(t: Array) -> Array:
    # half a bit for the stamp, a quarter for its difference from the first one
    return 0.75 * np.spacing(np.abs(t))


def rate_bounds(t: Array, half: Callable[[Array], Array]) -> tuple[float, float]:
    """Return the smallest and largest rate through all stamps +- `half`; crossed for no rate."""
    low, high = 0.0, np.inf
    first = float(half(t[:1])[0])
    for i in range(1, t.size, CHUNK):
        part = t[i : i + CHUNK]
        k = np.arange(i, i + part.size, dtype=np.float64)
        elapsed, error = part - t[0], half(part) + first
        low = max(low, float(np.max(k / (elapsed + error))))
        inside = elapsed > error
        if inside.any():
            high = min(high, float(np.min(k[inside] / (elapsed - error)[inside])))
    return low, high


def nice_rates(low: float, high: float) -> Iterator[float]:
    """Yield rates between two bounds; rates or periods with few digits come first."""
    middle = 0.5 * (low + high)
    for digits in range(15):
        for rate in (float(f'{middle:.{digits}e}'), 1 / float(f'{1 / middle:.{digits}e}')):
            if low <= rate <= high:
                yield rate
    yield float(f'{middle:.11e}')


def _start(t0: float, rate: float, resolution: Resolution) -> float:
    """Return the tick of the sample clock at a first stamp, or the stamp itself."""
    tick = round(t0 * rate) / rate
    slack = float(resolution.error(np.array([t0]), 1 / rate)[0])
    return tick if abs(tick - t0) <= slack else t0


def _reproduces(clock: Clock, t: Array) -> bool:
    parts = (slice(i, min(i + CHUNK, t.size)) for i in range(0, t.size, CHUNK))
    return all(np.array_equal(time_stamps(*clock[:2], p.start, p.stop), t[p]) for p in parts)


def has_restarted(first: float, last: float, begin: float, period: float) -> bool:
    """
    Return whether time that jumps back is a restart of the sample clock.

    The clock has restarted if the new stretch starts at or before the start of the old stretch, or
    more than `JUMP_BACK` samples before its end.  Otherwise the samples came again or out of turn.
    `first` is the time of the first new sample, `last` of the newest sample before, `begin` of the
    first sample since the last restart; `period` is the sampling period [s].

    >>> has_restarted(0.0, last=0.02, begin=0.0, period=5e-5)
    True
    >>> has_restarted(0.01, last=0.02, begin=0.0, period=5e-5)
    False
    >>> has_restarted(1.01, last=2.02, begin=0.0, period=5e-5)
    True
    """
    if first > last:
        return False
    return first <= begin or last - first > JUMP_BACK * period

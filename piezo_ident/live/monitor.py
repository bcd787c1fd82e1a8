# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Join measured and predicted blocks on time, bin signals for display, and take live errors."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.live.sample_clock import BlockClock, Kind
from piezo_ident.model.metrics import percent
from piezo_ident.record.blocks import Samples
from piezo_ident.record.readings.faults import MAX_WILD
from piezo_ident.record.readings.jumps import AROUND, least_step, wild_readings

#: time for which a block waits for its partner [s]
WAIT = 2.0
#: length of a stream without a pair beyond which both streams count as one run of the clock [s]
CATCH_UP = 1.0
#: largest number of waiting blocks
MOST = 500
#: number of bins by which a late quantity may hold up the others
LAG = 25
#: samples on either side that a judgement of a reading needs
EDGE = AROUND + 4


@dataclass(frozen=True, eq=False)
class Matched:
    """Measured and predicted displacement of the same samples [m]."""

    t: NDArray[np.float64]
    y: NDArray[np.float64]
    y_hat: NDArray[np.float64]
    segment: str

    @property
    def residual(self) -> Samples:
        """The residual as a block [m]."""
        return Samples(self.t, self.y - self.y_hat, self.segment, 'displacement')


class _Side:
    """
    One of two streams: its clock, its waiting blocks, and the number of the clock's run.

    `alone` is the time by the clock, less twice the time in pairs, and at least zero [s].
    """

    def __init__(self) -> None:
        self.clock = BlockClock()
        self.waiting: list[Samples] = []
        self.run, self.alone = 0, 0.0

    def met(self, count: int) -> None:
        """Note the number of samples of a pair."""
        # fmax: without a period a pair ends the time alone
        self.alone = float(np.fmax(self.alone - 2.0 * count * self.clock.period, 0.0))

    def forget(self) -> int:
        """Drop blocks that have waited too long; return their number of samples."""
        kept = [s for s in self.waiting if self.clock.last - s.t[-1] <= WAIT][-MOST:]
        n = sum(s.t.size for s in self.waiting) - sum(s.t.size for s in kept)
        self.waiting = kept
        return n


class Matcher:
    """
    Joins two streams of blocks on time, in any order and with blocks of any size.

    A restarted clock repeats the times of the old run.  A block after a restart therefore waits
    until the other stream has restarted, too.

    Attributes
    ----------
    unmatched : int
        Measured samples without a prediction in time.
    unmeasured : int
        Predicted samples without a measured one in time.
    """

    def __init__(self) -> None:
        self.unmatched = self.unmeasured = 0
        self._predicted, self._measured = _Side(), _Side()

    @property
    def late(self) -> int:
        """Number of measured samples that are repeated or late."""
        return self._measured.clock.late

    @property
    def is_waiting(self) -> bool:
        """Whether predicted blocks wait for measured ones."""
        return bool(self._predicted.waiting)

    def predicted(self, samples: Samples) -> list[Matched]:
        """Take a predicted block; return the pairs that it completes."""
        pairs = self._match(samples, self._predicted, self._measured)
        return [Matched(a.t, b.values, a.values, a.segment) for a, b in pairs]

    def measured(self, samples: Samples) -> list[Matched]:
        """Take a measured block; return the pairs that it completes."""
        pairs = self._match(samples, self._measured, self._predicted)
        return [Matched(a.t, a.values, b.values, b.segment) for a, b in pairs]

    def _match(self, new: Samples, own: _Side, other: _Side) -> list[tuple[Samples, Samples]]:
        before = own.clock.last
        kind, _ = own.clock.judge(new.t)
        own.alone += np.fmax(own.clock.last - before, 0.0)
        if kind is Kind.START:
            own.waiting.clear()
            if not own.clock.restarts or other.run > own.run:
                # the other stream has started or restarted before
                own.run = other.run
            else:
                own.run += 1
        pairs, rest = [], new
        if own.run != other.run and own.alone > CATCH_UP:
            # one stream was silent at a restart, or two publishers were taken for a restart
            own.run = other.run = max(own.run, other.run)
        for one in list(other.waiting) if own.run == other.run else ():
            if not rest.t.size:
                break
            if one.t[-1] < rest.t[0] or one.t[0] > rest.t[-1]:
                continue
            other.waiting.remove(one)
            _, i, j = np.intersect1d(rest.t, one.t, return_indices=True)
            if i.size:
                pairs.append((_rows(rest, i), _rows(one, j)))
                own.met(i.size)
                other.met(i.size)
            left, rest = _without(one, j), _without(rest, i)
            if left.t.size:
                other.waiting.append(left)
        if rest.t.size:
            own.waiting.append(rest)
        self.unmeasured += self._predicted.forget()
        self.unmatched += self._measured.forget()
        return sorted(pairs, key=lambda pair: float(pair[0].t[0]))


def _rows(samples: Samples, rows: NDArray[np.generic]) -> Samples:
    return replace(samples, t=samples.t[rows], values=samples.values[rows])


def _without(samples: Samples, rows: NDArray[np.intp]) -> Samples:
    keep = np.ones(samples.t.size, dtype=bool)
    keep[rows] = False
    return _rows(samples, keep)


@dataclass(frozen=True)
class PreviewBin:
    """Mean, smallest and largest of each quantity over a stretch that begins at `t` [s]."""

    t: float
    values: dict[str, tuple[float, float, float]]


class Preview:
    """Bins of sample time, `rate` a second; a bin is complete when all quantities are past it."""

    def __init__(self, rate: float = 50.0) -> None:
        self.rate = rate
        self._newest: dict[str, int] = {}
        self._clocks: dict[str, BlockClock] = {}
        self._bins: dict[int, dict[str, tuple[int, float, float, float]]] = {}

    def add(self, name: str, t: NDArray[np.float64], x: NDArray[np.float64]) -> list[PreviewBin]:
        """
        Take samples of a quantity; return the bins that are complete now, in order.

        NaN and infinite numbers are left out.
        """
        finite = np.isfinite(x) & np.isfinite(t)
        if not finite.all():
            t, x = t[finite], x[finite]
        if not t.size:
            return []
        kind, late = self._clocks.setdefault(name, BlockClock()).judge(t)
        if kind is Kind.LATE:
            t, x = t[late:], x[late:]
            if not t.size:
                return []
        # rounding may put a sample just before its bin
        k = np.floor(t * self.rate + 1e-6).astype(np.int64)
        done: list[PreviewBin] = []
        # the first quantity that restarts ends the bins of all
        if kind is Kind.START and name in self._newest:
            done = self._take(sorted(self._bins))
            self._newest.clear()
        starts = np.concatenate([[0], np.flatnonzero(np.diff(k)) + 1])
        count = np.diff(np.append(starts, k.size))
        total, low, high = (f.reduceat(x, starts) for f in (np.add, np.minimum, np.maximum))
        for i, start in enumerate(starts):
            here = self._bins.setdefault(int(k[start]), {})
            n, s, a, b = here.get(name, (0, 0.0, np.inf, -np.inf))
            here[name] = (
                n + int(count[i]),
                s + float(total[i]),
                min(a, float(low[i])),
                max(b, float(high[i])),
            )
        self._newest[name] = int(k[-1])
        end = max(min(self._newest.values()), max(self._newest.values()) - LAG)
        return done + self._take(sorted(b for b in self._bins if b < end))

    def _take(self, bins: list[int]) -> list[PreviewBin]:
        taken = []
        for b in bins:
            values = {name: (s / n, a, z) for name, (n, s, a, z) in self._bins.pop(b).items()}
            taken.append(PreviewBin(b / self.rate, values))
        return taken


class TrackingError:
    """
    Wanted minus measured displacement, block by block.

    `live` has the rms over a time `window` [s], and `quantity` is the name of the error in its
    blocks.  Wanted blocks wait in the `matcher` for their measured displacement.
    """

    def __init__(self, window: float, quantity: str = 'tracking_error') -> None:
        self.matcher, self.live, self._quantity = Matcher(), LiveError(window), quantity
        self._low, self._high = np.inf, -np.inf

    def wanted(self, samples: Samples) -> list[Samples]:
        """Take a block of wanted displacement; return the errors that it completes."""
        if not samples.t.size:
            return []
        self._low = min(self._low, float(samples.values.min()))
        self._high = max(self._high, float(samples.values.max()))
        return self._errors(self.matcher.predicted(samples))

    def measured(self, samples: Samples) -> list[Samples]:
        """Take a block of displacement; return the errors that it completes."""
        return self._errors(self.matcher.measured(samples))

    @property
    def percent(self) -> float | None:
        """Rms of the error [% of the span of the wanted motion]; None before the first error."""
        return percent(self.live.rms, self._high - self._low) if self.live.seconds else None

    def _errors(self, pairs: list[Matched]) -> list[Samples]:
        errors = []
        for pair in pairs:
            e = pair.y_hat - pair.y
            errors.append(Samples(pair.t, e, pair.segment, self._quantity))
            self.live.add(pair.t, e, self._high - self._low, pair.y)
        return errors


class TrackingErrors:
    """
    Wanted minus measured displacement of each axis.

    `tails` are the suffixes of the topics of all axes, `each` has the error by suffix.  The rms is
    taken over a time `window` [s].  `percents` has the rms of each axis at the last `look` [% of
    the span of the wanted motion].
    """

    def __init__(self, tails: Sequence[str], window: float) -> None:
        self.each = {tail: TrackingError(window, f'tracking_error{tail}') for tail in tails}
        self.percents: dict[str, float] = {}

    def clear(self) -> None:
        """Forget the errors so far."""
        for one in self.each.values():
            one.live.clear()

    def wanted(self, t: Array, rows: Array, segment: str) -> list[Samples]:
        """Take the wanted motion of all axes, a row each; return the errors that it completes."""
        return [
            error
            for one, row in zip(self.each.values(), np.atleast_2d(rows), strict=True)
            for error in one.wanted(Samples(t, row, segment, 'reference'))
        ]

    @property
    def outliers(self) -> int:
        """Number of readings that the errors leave out."""
        return sum(one.live.outliers for one in self.each.values())

    def look(self) -> None:
        """Update `percents`."""
        percents = {tail: one.percent for tail, one in self.each.items()}
        self.percents = {tail: x for tail, x in percents.items() if x is not None}

    def figures(self) -> dict[str, str]:
        """List the errors of the last `look`, for /diagnostics."""
        figures = {}
        for tail, of_span in self.percents.items():
            figures[f'tracking_rms{tail}'] = f'{self.each[tail].live.rms:.6g}'
            figures[f'tracking_percent{tail}'] = f'{of_span:.4g}'
        return figures


class LiveError:
    """
    Mean and rms of the residual over a window of sample time [s].

    Wild readings are left out if they are few, by the rule for records.
    """

    def __init__(self, window: float) -> None:
        self.window = window
        self._clock = BlockClock()
        self.clear()

    def clear(self) -> None:
        """Forget all samples."""
        # begin and end of each block, its sums of kept readings, and its sums of wild readings
        self._parts: deque[tuple[float, float, Array, Array]] = deque()
        self._step = np.inf
        self._forget_last()

    def _forget_last(self) -> None:
        # the newest errors and measured displacements; the number of judged ones
        self._last, self._judged = np.empty((2, 0)), 0

    def add(
        self, t: Array, residual: Array, stroke: float = np.inf, measured: Array | None = None
    ) -> None:
        """
        Take the residual [m] of the next samples; `stroke` is that of the stage [m].

        The `measured` displacement [m] reveals the step of a coarse sensor.
        """
        finite = np.isfinite(residual)
        e = residual[finite]
        if not e.size:
            return
        y = e if measured is None else measured[finite]
        kind, _ = self._clock.judge(t)
        if kind is Kind.LATE:
            return
        if kind is Kind.START:
            self.clear()
        elif kind is Kind.GAP:
            self._forget_last()
        if measured is not None:
            self._step = min(self._step, least_step(y))
        self._parts.append((float(t[0]), float(t[-1]), *self._sorted(np.stack([e, y]), stroke)))
        while len(self._parts) > 1 and self._parts[-1][1] - self._parts[0][0] > self.window:
            self._parts.popleft()

    def _sorted(self, new: Array, stroke: float) -> tuple[Array, Array]:
        """Sum kept and wild readings of the samples with enough neighbours for a judgement."""
        e, y = new
        wild = np.zeros(e.size, dtype=bool)
        if np.isfinite(stroke):
            e, y = x = np.concatenate([self._last, new], axis=1)
            begin, end = self._judged, max(self._judged, e.size - EDGE)
            wild = wild_readings(e, stroke, self._step, y)[begin:end]
            first = max(0, end - EDGE)
            self._last, self._judged = x[:, first:], end - first
            e = e[begin:end]
        # numbers of errors, and sums of them and of their squares
        kept, out = (np.array([x.size, x.sum(), x @ x]) for x in (e[~wild], e[wild]))
        return kept, out

    def _sums(self) -> tuple[Array, int]:
        sums = np.array([part[2:] for part in self._parts]).reshape(-1, 2, 3).sum(axis=0)
        kept, out = sums[0], sums[1]
        # frequent wild readings are real motion of the stage
        if out[0] > MAX_WILD * (kept[0] + out[0]):
            return kept + out, 0
        return kept, int(out[0])

    @property
    def seconds(self) -> float:
        """Length of the filled part of the window [s]."""
        return self._parts[-1][1] - self._parts[0][0] if self._parts else 0.0

    @property
    def outliers(self) -> int:
        """Number of wild readings of the window."""
        return self._sums()[1]

    @property
    def mean(self) -> float:
        """Mean [m]; NaN before the first sample."""
        (n, total, _), _ = self._sums()
        return float(total / n) if n else float('nan')

    @property
    def rms(self) -> float:
        """Root mean square [m]; NaN before the first sample."""
        (n, _, square), _ = self._sums()
        return float(np.sqrt(square / n)) if n else float('nan')

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Cut a residual with its record into rests, repeating stretches and other motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array, closed, interpolated, Mask, true_runs
from piezo_ident.common.errors import DataError
from piezo_ident.model.metrics import strokes
from piezo_ident.record.readings.gaps import FEW
from piezo_ident.record.record import Piece, Segment
from scipy import fft
from scipy.ndimage import binary_dilation, maximum_filter1d, minimum_filter1d, uniform_filter1d

#: shortest rest [s], [samples]: a shorter rest belongs to the motion around it
REST_TIME, REST_SAMPLES = 0.05, 200
#: least share of the differences of a measured voltage that change their sign, at rest
TREMBLE = 0.3
#: a voltage that repeats comes back within this share of its range
COMES_BACK = 2e-3
#: closer repeats count as exact, and the shorter period is taken
EXACT = 1e-4
#: fewest periods behind the first period, which may still be settling
PERIODS = 2
#: share of a period that may be missing, as a rest may have taken a sample of the period
SLACK = 0.02
#: tried candidates for the period in every octave
CANDIDATES = 3
#: longest stretch whose autocorrelation is computed [samples]
LONGEST = 2**20


@dataclass(frozen=True, eq=False)
class ResidualPart:
    """
    Residual of one piece of a record.

    `e` is measured minus simulated displacement, free run [m], shape (n,).  `sound` is False for
    bridged and lost samples, and while the memory of the start matters.  `e` is a straight line
    over a few samples in a row that are not sound.  Raises DataError if the lengths differ, or a
    sound residual is not finite.
    """

    record: str
    piece: Piece
    e: Array
    sound: Mask | None = None

    def __post_init__(self) -> None:
        e = np.asarray(self.e, dtype=np.float64)
        sound = np.ones(e.size, bool) if self.sound is None else np.asarray(self.sound, bool)
        if e.shape != (self.piece.n,) or sound.shape != e.shape:
            raise DataError(
                f'{self.record}: residual {e.shape} and mask {sound.shape} must have one value '
                f'for each of the {self.piece.n} samples'
            )
        if not np.isfinite(e[sound]).all():
            raise DataError(
                f'{self.record}: the residual is not finite everywhere; did the model diverge?'
            )
        if not sound.all():
            e = interpolated(e, closed(sound, FEW) & ~sound, sound)
        object.__setattr__(self, 'e', e)
        object.__setattr__(self, 'sound', sound)

    @property
    def mask(self) -> Mask:
        """True for samples that count, shape (n,)."""
        return np.ones(self.piece.n, bool) if self.sound is None else self.sound

    @property
    def y_hat(self) -> Array:
        """Simulated displacement [m], shape (n,)."""
        return np.asarray(self.piece.y - self.e)

    def with_residual(self, e: Array) -> ResidualPart:
        """Replace the residual of the part."""
        return ResidualPart(self.record, self.piece, e, self.sound)

    @property
    def joined(self) -> Mask:
        """True for samples that count, and for a few samples in a row between them."""
        return closed(self.mask, FEW)

    def runs(self) -> list[tuple[int, int]]:
        """Find start and stop of the runs of `joined` samples."""
        return true_runs(self.joined)


@dataclass(frozen=True)
class DriveStretch:
    """
    A 'rest', 'repeat' or 'motion' of one part, from sample `start` to before `stop`.

    A repeat has a `period` in samples, a rest the `step` of v [V] that led into it.
    """

    part: int
    start: int
    stop: int
    kind: str
    period: int = 0
    step: float = 0.0

    @property
    def n(self) -> int:
        """Number of samples."""
        return self.stop - self.start


def strokes_of(parts: Sequence[ResidualPart]) -> dict[str, float]:
    """Compute ``max y - min y`` of each record over all its parts [m]."""
    return strokes((part.record, part.piece.y) for part in parts)


def block_means(x: Array, m: int) -> Array:
    """Compute the means of whole blocks of m samples, shape (n // m,)."""
    if m == 1:
        return x
    n = x.size // m
    # a product with a vector is several times faster than a mean along a short axis
    return np.asarray(x[: n * m].reshape(n, m) @ np.full(m, 1.0 / m))


def all_stretches(parts: Sequence[ResidualPart]) -> list[DriveStretch]:
    """Cut all parts into stretches, with the numbers of their parts."""
    return [s for i, part in enumerate(parts) for s in stretches_of(part, i)]


def stretches_of(part: ResidualPart, number: int = 0) -> list[DriveStretch]:
    """Cut part `number` at rests, repeats and segments of its voltage, in order of time."""
    piece = part.piece
    v = piece.v
    shortest = _shortest(piece.sample_rate)
    still = [(a, b) for a, b in rests(v, piece.sample_rate) if b - a + 1 >= shortest]
    found: list[DriveStretch] = []
    for first, last in part.runs():
        for s in piece.segments or (Segment('', 0, piece.n),):
            start, stop = max(s.start, first), min(s.stop, last)
            edge = start
            for a, b in still:
                a, b = max(a, start), min(b, stop)
                # a rest begins one sample before the first repeated sample
                a -= a > start
                if b - a < shortest:
                    continue
                found += _motion(v, number, edge, a, shortest)
                step = float(v[a] - v[max(a - shortest, 0)])
                found.append(DriveStretch(number, a, b, 'rest', step=step))
                edge = b
            found += _motion(v, number, edge, stop, shortest)
    return found


def _shortest(rate: float) -> int:
    return max(REST_SAMPLES, round(REST_TIME * rate))


def rests(v: Array, rate: float) -> list[tuple[int, int]]:
    """
    Find the first repeated sample and the end of each rest of a voltage.

    A voltage at rest is constant but for the noise of its measurement; `rate` is in Hz.

    >>> rests(np.array([0.0, 1.0, 1.0, 1.0, 2.0]), 1000.0)
    [(2, 4)]
    """
    span, window = float(np.ptp(v)), _shortest(rate)
    d = np.concatenate([[0.0], np.diff(v)])
    still = np.abs(d) <= 1e-9 * span
    still[0] = False
    if span > 0.0 and v.size >= 2 * window and still.mean() <= 0.01:
        turns = np.concatenate([[False], d[1:] * d[:-1] < 0.0])
        trembling = uniform_filter1d(turns.astype(np.float64), window) > TREMBLE
        narrow = maximum_filter1d(v, window) - minimum_filter1d(v, window) < COMES_BACK * span
        # a window within a rest covers half its width to either side of its middle
        inside = binary_dilation(trembling & narrow, iterations=window // 2)
        still = inside & (np.abs(d) < COMES_BACK * span)
    return true_runs(still)


def _motion(v: Array, number: int, start: int, stop: int, shortest: int) -> list[DriveStretch]:
    """Cut a motion into repeating stretches, and the stretches between them."""
    if stop - start < shortest:
        return []
    found, edge = [], start
    for a, b, period in find_repeats(v[start:stop]):
        if start + a - edge >= shortest:
            found.append(DriveStretch(number, edge, start + a, 'motion'))
        found.append(DriveStretch(number, start + a, start + b, 'repeat', period))
        edge = start + b
    if stop - edge >= shortest:
        found.append(DriveStretch(number, edge, stop, 'motion'))
    return found


def find_repeats(v: Array, halvings: int = 3) -> list[tuple[int, int, int]]:
    """
    Find the repeats of a signal in order: (start, stop, period) [samples].

    A candidate is a minimum of the mean square difference between the signal and the shifted
    signal, behind the first maximum of this difference: de Cheveigne and Kawahara (2002), J.
    Acoust. Soc. Am. 111, 1917-1930, doi:10.1121/1.1458024.  Each candidate is then compared sample
    by sample, so that motion before and after does not hide it.  A repeat has three periods or
    more.  Motions of several periods hide each other: without a repeat, both halves are searched.
    """
    span = float(np.ptp(v))
    if v.size < 3 * 8 or span == 0.0:
        return []
    tolerance = COMES_BACK * span
    tried: list[tuple[float, int, list[tuple[int, int]]]] = []
    for period in _candidates(v[:LONGEST]):
        difference = v[period:] - v[:-period]
        matching = [
            (a, b)
            for a, b in true_runs(np.abs(difference) <= tolerance)
            if b - a >= (PERIODS - SLACK) * period
            and np.ptp(v[a : a + period]) >= 20.0 * tolerance
        ]
        if matching:
            miss = max(float(np.sqrt(np.mean(difference[a:b] ** 2))) for a, b in matching)
            tried.append((miss / span, period, matching))
    # the best repeat first; of about equal repeats, the shortest period first
    least = max(EXACT, 1.5 * min((miss for miss, _, _ in tried), default=0.0))
    tried.sort(key=lambda one: (max(one[0], least), one[1]))
    taken = np.zeros(v.size, dtype=bool)
    found = []
    for _, period, matching in tried:
        for a, b in matching:
            for i, j in true_runs(~taken[a : b + period]):
                if j - i >= (PERIODS + 1 - SLACK) * period:
                    found.append((a + i, a + j, period))
                    taken[a + i : a + j] = True
    if not found and halvings:
        middle = v.size // 2
        later = find_repeats(v[middle:], halvings - 1)
        found = find_repeats(v[:middle], halvings - 1)
        found += [(middle + a, middle + b, period) for a, b, period in later]
    return sorted(found)


def _candidates(v: Array) -> list[int]:
    n, x = v.size, v - v.mean()
    # two more lags, so that the longest period is an inner minimum
    longest = n // (PERIODS + 1) + 2
    size = fft.next_fast_len(n + longest + 1, real=True)
    spectrum = fft.rfft(x, size)
    products = fft.irfft(np.abs(spectrum) ** 2, size)[: longest + 1]
    squares = np.concatenate([[0.0], np.cumsum(x * x)])
    lags = np.arange(longest + 1)
    d = squares[n - lags] + squares[n] - squares[lags] - 2.0 * products
    d /= n - lags
    top = float(d.max(initial=0.0))
    if top <= 0.0:
        return []
    behind = int(np.argmax(d > 0.2 * top))
    minima = np.flatnonzero((d[1:-1] <= d[:-2]) & (d[1:-1] < d[2:])) + 1
    minima = minima[(minima > behind) & (d[minima] < 0.8 * top)]
    # a period between two numbers of samples repeats exactly at its multiples only.  A signal may
    # also have two periods in turn.  The best minima of every octave are therefore tried
    octave = np.floor(np.log2(np.maximum(minima, 1)))
    chosen: set[int] = set()
    for k in np.unique(octave):
        own = minima[octave == k]
        chosen.update(int(lag) for lag in own[np.argsort(d[own])][:CANDIDATES])
    return sorted(chosen)

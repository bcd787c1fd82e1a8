# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""On what a residual depends: its mean over voltage, speed, and time since a step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.residual.stretches import block_means, ResidualPart, Stretch

#: samples after averaging, bins of a curve, bins a decade of time or speed
SAMPLES, BINS, PER_DECADE = 2**16, 24, 6
#: stretches of time that count as independent: so many, but none shorter than this [s]
CHUNKS, CHUNK_TIME = 120, 0.05
#: fewest samples and chunks of a bin that is shown
FEWEST, VISITS = 8, 3


@dataclass(frozen=True, eq=False)
class Curve:
    """
    Mean residual over bins of one quantity.

    Attributes
    ----------
    against : {'v', 'dv/dt', 'time since the step'}
    branch : {'up', 'down', 'both'}
        Direction of the drive.  'both': the residual is multiplied by the step as a share of the
        largest step, so that upward and downward steps add up.
    x : ndarray, shape (m,)
        Mean of the quantity in each bin.
    mean, std : ndarray, shape (m,)
        Mean residual and its standard deviation [m]; whole stretches of time count as one
        observation, so correlated samples do not make it look better known than it is.
    """

    against: str
    branch: str
    x: Array
    mean: Array
    std: Array


@dataclass(frozen=True, eq=False)
class _Motion:
    """Averaged samples of the motions."""

    e: Array
    v: Array
    speed: Array
    direction: Array
    chunk: Integers


#: of a hold: bins of time, mean residual in each, step as a share of the largest
_Hold = tuple[Integers, Array, float]


def curves_of(parts: Sequence[ResidualPart], stretches: Sequence[Stretch]) -> tuple[Curve, ...]:
    """
    Return the mean residual over v, dv/dt, and the time since the last step.

    Quantities without data have no curve.
    """
    found: list[Curve] = []
    motion = _motions(parts, stretches)
    if motion is not None:
        found += _against_v(motion)
        found += _against_speed(motion)
    found += _since_step(parts, stretches)
    return tuple(found)


def _motions(parts: Sequence[ResidualPart], stretches: Sequence[Stretch]) -> _Motion | None:
    moving = [s for s in stretches if s.kind != 'rest']
    total = sum(s.n for s in moving)
    if total == 0:
        return None
    m = max(1, -(-total // SAMPLES))
    columns: list[list[Array]] = [[] for _ in range(4)]
    chunks: list[Integers] = []
    seconds = sum(s.n / parts[s.part].piece.sample_rate for s in moving)
    chunk_time = max(CHUNK_TIME, seconds / CHUNKS)
    number = 0
    for s in moving:
        piece, rate = parts[s.part].piece, parts[s.part].piece.sample_rate
        v = piece.v[s.start : s.stop]
        speed = np.gradient(v) * rate
        averaged = [block_means(x, m) for x in (parts[s.part].e[s.start : s.stop], v, speed)]
        direction = np.sign(averaged[2])
        for column, x in zip(columns, (*averaged, direction), strict=True):
            column.append(x)
        chunk = np.arange(averaged[0].size) * m / rate // chunk_time
        chunks.append(number + chunk.astype(np.int64))
        number = int(chunks[-1][-1]) + 1 if chunk.size else number
    e, v, speed, direction = (np.concatenate(column) for column in columns)
    return _Motion(e, v, speed, direction, np.concatenate(chunks))


def _against_v(motion: _Motion) -> list[Curve]:
    ends = np.linspace(motion.v.min(), motion.v.max() + 1e-12, BINS + 1)
    bins = np.clip(np.searchsorted(ends, motion.v, side='right') - 1, 0, BINS - 1)
    bins = bins + BINS * (motion.direction < 0.0)
    return [
        _curve('v', branch, motion.v, motion.e, bins, motion.chunk, own)
        for branch, own in (('up', motion.direction > 0.0), ('down', motion.direction < 0.0))
    ]


def _against_speed(motion: _Motion) -> list[Curve]:
    # speeds span decades, and a triangle has only one
    moving = np.abs(motion.speed) > 1e-6 * np.abs(motion.speed).max()
    if moving.sum() < 4 * BINS:
        return []
    bins = np.zeros(motion.speed.size, dtype=np.int64)
    bins[moving] = _decades(np.abs(motion.speed[moving]))
    bins = 2 * bins + (motion.speed < 0.0)
    return [
        _curve('dv/dt', branch, motion.speed, motion.e, bins, motion.chunk, own)
        for branch, own in (
            ('up', moving & (motion.speed > 0.0)),
            ('down', moving & (motion.speed < 0.0)),
        )
    ]


def _decades(t: Array) -> Integers:
    k = np.floor(PER_DECADE * np.log10(t)).astype(np.int64)
    return np.asarray(k - k.min())


def _curve(
    against: str, branch: str, x: Array, e: Array, bins: Integers, chunk: Integers, own: Mask
) -> Curve:
    bins, x, e, chunk = bins[own], x[own], e[own], chunk[own]
    size = int(bins.max(initial=0)) + 1
    count = np.bincount(bins, minlength=size)
    filled = np.maximum(count, 1)
    centre = np.bincount(bins, x, size) / filled
    mean = np.bincount(bins, e, size) / filled
    # a stretch of time enters with the sum of what it brings to a bin
    pair, visit = np.unique(bins * (int(chunk.max(initial=0)) + 1) + chunk, return_inverse=True)
    sums = np.bincount(visit, e - mean[bins])
    home = pair // (int(chunk.max(initial=0)) + 1)
    visits = np.bincount(home, minlength=size)
    spread = np.bincount(home, sums * sums, size)
    correction = visits / np.maximum(visits - 1, 1)
    std = np.sqrt(spread * correction) / filled
    shown = np.flatnonzero((count >= FEWEST) & (visits >= VISITS))
    shown = shown[np.argsort(centre[shown])]
    return Curve(against, branch, centre[shown], mean[shown], std[shown])


def _since_step(parts: Sequence[ResidualPart], stretches: Sequence[Stretch]) -> list[Curve]:
    """Return the residual of the holds over lg t, each hold with an offset of its own."""
    holds = [s for s in stretches if s.kind == 'rest' and s.step != 0.0]
    if len(holds) < 2:
        return []
    largest = max(abs(s.step) for s in holds)
    rows: list[_Hold] = []
    first = min(2.0 / parts[s.part].piece.sample_rate for s in holds)
    for s in holds:
        t = (np.arange(s.n) + 0.5) / parts[s.part].piece.sample_rate
        k = np.maximum(np.floor(PER_DECADE * np.log10(t / first)), 0).astype(np.int64)
        count, sums = np.bincount(k), np.bincount(k, parts[s.part].e[s.start : s.stop])
        used = np.flatnonzero(count)
        rows.append((used, sums[used] / count[used], s.step / largest))
    size = max(int(used[-1]) for used, _, _ in rows) + 1
    curve = _common(rows, size)
    x = first * 10.0 ** ((np.arange(size) + 0.5) / PER_DECADE)
    top, bottom, visits = np.zeros((3, size))
    for k, e, weight in rows:
        rest = e - weight * curve[k]
        top[k] += (weight * (rest - rest.mean())) ** 2
        bottom[k] += weight**2
        visits[k] += 1
    shown = visits >= 2
    if shown.sum() < 2:
        return []
    std = np.sqrt(top * visits / np.maximum(visits - 1, 1)) / np.maximum(bottom, 1e-300)
    mean = curve[shown] - curve[shown][0]
    return [Curve('time since the step', 'both', x[shown], mean, std[shown])]


def _common(rows: Sequence[_Hold], size: int) -> Array:
    """Return the curve g that fits e = offset of the hold + weight g(bin) best."""
    n = sum(k.size for k, _, _ in rows)
    A, b = np.zeros((n, size + len(rows))), np.zeros(n)
    at = 0
    for i, (k, e, weight) in enumerate(rows):
        places = np.arange(at, at + k.size)
        A[places, k] = weight
        A[places, size + i] = 1.0
        b[places] = e
        at += k.size
    return np.asarray(np.linalg.lstsq(A, b, rcond=1e-9)[0][:size])

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Find faults of the data in a residual: jitter, outliers, clipping, coarse steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from piezo_ident.common.arrays import Array, Mask, true_runs
from piezo_ident.model.metrics import percent
from piezo_ident.record.readings.faults import (
    end_of_rest,
    MAX_WILD,
    MOVED,
    quantum_of,
    STUCK,
    white_noise,
    WINDOW,
)
from piezo_ident.record.readings.jumps import FAR
from piezo_ident.record.record import Fault
from piezo_ident.residual.stretches import ResidualPart, strokes_of
from scipy.ndimage import binary_dilation, maximum_filter1d

#: least step of readings that is a fault, in multiples of the other noise and as share of stroke
COARSE, COARSE_SHARE = 2.0, 1e-4
#: largest deviation of a sample around an outlier from a line, as a share of the outlier
QUIET = 0.35
#: fewest clipped samples in a row, and least motion of the model in them, in rms of the noise
FLAT, LEFT = 5, 6.0
#: jitter: least slope in its deviations, least growth of the variance, samples in a block
SURE, GROWTH, CHUNK = 5.0, 1.4, 64
#: anticorrelation of neighbouring third differences that counts as white noise, which has 3/4
WHITE = (0.5, 1.0)
#: largest power of the third differences of the motion, over that of the noise, to read jitter
SMOOTH = 1.0


@dataclass(frozen=True, eq=False)
class FaultSearch:
    """Faults, the samples to leave out of each part, and the step of the readings [m] or 0."""

    faults: tuple[Fault, ...]
    bad: tuple[Mask, ...]
    quantum: float


def find_faults(parts: Sequence[ResidualPart]) -> FaultSearch:
    """
    Look for outliers, clipping, coarse steps and jitter: one fault for each part and kind.

    `piezo_ident.record.readings.faults` has left out the faults that the readings alone show.
    """
    faults: list[Fault] = []
    found: list[Mask] = []
    quantum = 0.0
    strokes = strokes_of(parts)
    for part in parts:
        stroke = strokes[part.record]
        bad = np.zeros(part.piece.n, dtype=bool)
        if part.piece.n >= 100 and stroke > 0.0:
            noise = _noise_of(part)
            quantum = max(quantum, noise.quantum)
            clipped = _clipped(part, noise)
            outliers = _outliers(part, noise, clipped)
            jitter, growth = _jitter(part, noise, clipped | outliers)
            if jitter > 0.0 and outliers.any():
                # most outliers may be readings at the wrong moment
                outliers = _outliers(part, noise, clipped, jitter)
            many = float(outliers.mean()) > MAX_WILD
            faults += _masked(part, outliers, clipped, many)
            faults += _of_all(part, stroke, noise, jitter, growth)
            bad = clipped if many else outliers | clipped
        found.append(bad)
    return FaultSearch(tuple(faults), tuple(found), quantum)


def _masked(part: ResidualPart, outliers: Mask, clipped: Mask, many: bool) -> list[Fault]:
    action = 'left in, as they are the way of the data' if many else 'left out'
    end = 'at the end of their range while the model moves; left out'
    faults = []
    for name, mask, what in (
        ('outliers', outliers, f'isolated jumps; {action}'),
        ('clipping', clipped, end),
    ):
        if mask.any():
            first = float(part.piece.t[int(np.argmax(mask))])
            where = f'in {part.record}, first at {first:.6g} s'
            faults.append(Fault(name, where, int(mask.sum()), what))
    return faults


def _of_all(
    part: ResidualPart, stroke: float, noise: _Noise, jitter: float, growth: float
) -> list[Fault]:
    where, n, faults = f'in {part.record}', part.piece.n, []
    if noise.quantum > COARSE * noise.rest and noise.quantum > COARSE_SHARE * stroke:
        what = (
            f'readings are multiples of {1e9 * noise.quantum:.4g} nm, '
            f'{percent(noise.quantum, stroke):.2g} % of the stroke and more than twice the rest '
            'of the noise'
        )
        faults.append(Fault('quantisation', where, n, what))
    if jitter > 0.0:
        what = (
            f'sampling instants scatter by {1e6 * jitter:.3g} us rms: the variance of the '
            f'residual grows {growth:.3g} times with (dy/dt)^2'
        )
        faults.append(Fault('timing_jitter', where, n, what))
    return faults


class _Noise(NamedTuple):
    """Fast noise of readings: rms, their step q (0 for none), rms without q / sqrt(12) [m]."""

    rms: float
    quantum: float
    rest: float


def _noise_of(part: ResidualPart) -> _Noise:
    """Estimate the fast noise of a part; the error of a model is too slow to matter."""
    quantum = quantum_of(part.piece.y)
    rms = white_noise(np.diff(part.e, 3)[part.mask[3:]], quantum)
    rest = float(np.sqrt(max(rms * rms - quantum * quantum / 12.0, 0.0)))
    return _Noise(rms, quantum, rest)


def _outliers(part: ResidualPart, noise: _Noise, known: Mask, jitter: float = 0.0) -> Mask:
    """Mark single readings far from both neighbours, which agree with each other."""
    e = part.e
    height = np.zeros(e.size)
    height[1:-1] = e[1:-1] - 0.5 * (e[:-2] + e[2:])
    size = np.abs(height)
    # the scatter changes along jittered or driven data: take the largest median of three blocks
    blocks = max(1, size.size // WINDOW)
    medians = np.median(size[: blocks * WINDOW].reshape(blocks, -1), axis=1)
    medians = maximum_filter1d(medians, 3, mode='nearest')
    local = 1.4826 * medians[np.minimum(np.arange(size.size) // WINDOW, blocks - 1)]
    level = np.maximum(local, np.sqrt(1.5) * noise.rms)
    level = np.maximum(level, 1e-6 * float(np.ptp(part.piece.y)))
    if jitter > 0.0:
        slope = np.gradient(part.y_hat) * part.piece.sample_rate
        level = np.hypot(level, np.sqrt(1.5) * jitter * slope)
    # a model whose G answers at once may jump while the reading does not
    jumps = np.zeros(e.size)
    jumps[1:-1] = np.abs(part.y_hat[1:-1] - 0.5 * (part.y_hat[:-2] + part.y_hat[2:]))
    high = (size > FAR * level) & (size > 3.5 * noise.quantum) & (jumps < 0.5 * size)
    candidates = np.flatnonzero(high & part.mask & ~known)
    found = np.zeros(e.size, dtype=bool)
    for k in candidates:
        if k < 8 or k >= e.size - 8:
            continue
        around = np.concatenate([e[k - 7 : k], e[k + 1 : k + 8]])
        # a spike leaves its surroundings as they are; ringing, a step or a kink does not
        places = np.concatenate([np.arange(-7, 0), np.arange(1, 8)])
        rest = around - np.polynomial.Polynomial.fit(places, around, 1)(places)
        found[k] = float(np.abs(rest).max()) < QUIET * size[k]
    return found


def _clipped(part: ResidualPart, noise: _Noise) -> Mask:
    """Mark readings that stay at the largest or smallest value while the model moves on."""
    y, y_hat, v = part.piece.y, part.y_hat, part.piece.v
    found = np.zeros(y.size, dtype=bool)
    span = float(np.ptp(v))
    stroke = float(np.ptp(y))
    for end in (float(y.max()), float(y.min())):
        at = np.abs(y - end) <= max(1e-9 * stroke, 0.25 * noise.quantum)
        for a, b in true_runs(at):
            if b - a < FLAT:
                continue
            late = end_of_rest(part.piece, a, b)
            moved, drive = float(np.ptp(y_hat[a:late])), float(np.ptp(v[a:late]))
            gone = moved > LEFT * (noise.rms + noise.quantum) and moved > 1e-4 * stroke
            if drive > 1e-4 * span and (gone or (drive > MOVED * span and b - a >= STUCK)):
                # all readings of this value are clipped
                found |= at
                break
    return found & part.mask


def _jitter(part: ResidualPart, noise: _Noise, known: Mask) -> tuple[float, float]:
    """
    Estimate the rms scatter of the sampling instants [s], and how much it raises the variance.

    A reading that is late by delta is off by dy/dt delta: the variance of the residual is
    sigma^2 + jitter^2 (dy/dt)^2.  Third differences remove the error of the model in smooth
    motion.  The rest of this error grows with the third differences of the motion, which are the
    second variable of the regression.  Blocks in which they are large are not used.
    """
    e, y_hat, rate = part.e, part.y_hat, part.piece.sample_rate
    third = np.zeros(e.size)
    third[2:-1] = np.diff(e, 3) / np.sqrt(20.0)
    motion = np.zeros(e.size)
    motion[2:-1] = np.abs(np.diff(y_hat, 3)) / np.sqrt(20.0)
    slope = np.gradient(y_hat) * rate
    unusable = known | ~part.mask
    unusable[:4] = unusable[-4:] = True
    unusable = binary_dilation(unusable, iterations=3)
    n = (e.size - 1) // CHUNK * CHUNK
    if n < 40 * CHUNK or noise.rms == 0.0:
        return 0.0, 1.0
    motion2 = np.mean(motion[:n].reshape(-1, CHUNK) ** 2, axis=1)
    smooth = motion2 < SMOOTH * noise.rms**2
    rows = smooth & ~unusable[:n].reshape(-1, CHUNK).any(axis=1)
    s2 = np.mean(slope[:n].reshape(-1, CHUNK)[rows] ** 2, axis=1)
    h2 = np.mean(third[:n].reshape(-1, CHUNK)[rows] ** 2, axis=1)
    neighbours = np.mean((third[:n] * third[1 : n + 1]).reshape(-1, CHUNK)[rows], axis=1)
    motion2 = motion2[rows]
    # readings that rest on one code have no scatter of their own to compare with
    moving = np.sqrt(s2) > noise.quantum * rate
    s2, h2, motion2, neighbours = (x[moving] for x in (s2, h2, motion2, neighbours))
    if s2.size < 40 or float(np.ptp(s2)) == 0.0:
        return 0.0, 1.0
    slope2, error = _slope(s2, motion2, h2)
    if slope2 <= SURE * error:
        return 0.0, 1.0
    # the error of a model is smooth; jitter changes from sample to sample
    anticorrelated = float(np.mean(neighbours)) < 0.0
    apart = _slope(s2, motion2, -neighbours)[0] / slope2 if anticorrelated else 0.0
    if not WHITE[0] < apart < WHITE[1]:
        return 0.0, 1.0
    base = max(float(np.mean(h2)) - slope2 * float(np.mean(s2)), 1e-3 * float(np.mean(h2)))
    base = max(base, (1e-6 * float(np.ptp(part.piece.y))) ** 2)
    if slope2 * float(np.quantile(s2, 0.98)) < 0.5 * noise.quantum**2:
        # steps of a converter scatter with the speed as well
        return 0.0, 1.0
    growth = 1.0 + slope2 * float(np.quantile(s2, 0.98)) / base
    # the noise of a converter saturates with speed, jitter does not
    fast = s2 > np.median(s2)
    again, error = _slope(s2[fast], motion2[fast], h2[fast])
    if growth < GROWTH or again <= 3.0 * error or not 0.3 < again / slope2 < 3.0:
        return 0.0, 1.0
    return float(np.sqrt(slope2)), growth


def _slope(x: Array, other: Array, y: Array) -> tuple[float, float]:
    """Fit the slope of y over x beside another variable; also return its robust deviation."""
    scale = max(float(other.max()), 1e-300)
    A = np.column_stack([x / float(x.max()), np.ones(x.size), other / scale])
    y_scale = max(float(np.mean(y)), 1e-300)
    target, weight = y / y_scale, np.ones(x.size)
    coefficients, errors = np.zeros(A.shape[1]), np.full(A.shape[1], np.inf)
    for _ in range(4):
        normal = A.T @ (weight[:, None] * A)
        inverse = np.linalg.pinv(normal)
        coefficients = inverse @ (A.T @ (weight * target))
        rest = target - A @ coefficients
        spread = A.T @ ((weight * rest)[:, None] ** 2 * A)
        errors = np.sqrt(np.maximum(np.diag(inverse @ spread @ inverse), 0.0))
        # a mean of squares scatters in proportion to itself
        weight = 1.0 / np.maximum(A @ coefficients, 0.05) ** 2
    unit = y_scale / float(x.max())
    return float(coefficients[0]) * unit, float(errors[0]) * unit

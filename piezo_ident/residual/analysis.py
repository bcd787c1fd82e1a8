# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Compute noise floor, lines, curves and coherence of a residual for its pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.common.errors import DataError
from piezo_ident.residual.coherence import Coherence, coherence
from piezo_ident.residual.faults import find_faults
from piezo_ident.residual.lines import find_lines, Line, without_lines
from piezo_ident.residual.noise_floor import NoiseFloor, residual_noise_floor
from piezo_ident.residual.stretches import all_stretches, block_means, DriveStretch, ResidualPart

#: most samples of a curve after averaging, bins of a curve, bins in a decade of time or speed
SAMPLES, BINS, PER_DECADE = 2**16, 24, 6
#: number of stretches of time that count as independent, and their least length [s]
CHUNKS, CHUNK_TIME = 120, 0.05
#: fewest samples and stretches of time in a bin of a curve
FEWEST, VISITS = 8, 3


@dataclass(frozen=True, eq=False)
class Curve:
    """
    Mean residual over bins of one quantity, 'v', 'dv/dt' or 'time since the step'.

    The branch is the direction of the drive, 'up', 'down' or 'both'.  In 'both' each residual is
    multiplied by its step as a share of the largest step, so that steps of both signs add up.  `x`
    holds the mean of the quantity in each bin, `mean` and `std` the mean residual and its standard
    deviation [m], shapes (m,).  A whole stretch of time is one observation, as its samples are
    correlated.
    """

    against: str
    branch: str
    x: Array
    mean: Array
    std: Array


@dataclass(frozen=True, eq=False)
class ResidualAnalysis:
    """Noise floor, lines, curves and coherence of the residual of some parts."""

    parts: tuple[ResidualPart, ...]
    floor: NoiseFloor
    lines: tuple[Line, ...]
    curves: tuple[Curve, ...]
    coherence: Coherence | None


def analyse(parts: Sequence[ResidualPart]) -> ResidualAnalysis:
    """
    Analyse the residual of a model without its outliers and clipped readings.

    Raises DataError if no sample is sound.
    """
    if not any(part.mask.any() for part in parts):
        raise DataError('no sample of the residual is sound; give a record with sound samples')
    faults = find_faults(parts)
    clean = [
        ResidualPart(p.record, p.piece, p.e, p.mask & ~bad)
        for p, bad in zip(parts, faults.bad, strict=True)
    ]
    stretches = all_stretches(clean)
    lines = find_lines(clean, stretches).lines
    # a line does not count as noise, because an effect can explain it
    quiet = [without_lines(part, lines) for part in clean]
    return ResidualAnalysis(
        parts=tuple(parts),
        floor=residual_noise_floor(quiet, stretches),
        lines=lines,
        curves=(*_of_motions(quiet, stretches), *_since_step(quiet, stretches)),
        coherence=coherence(clean),
    )


def _of_motions(parts: Sequence[ResidualPart], stretches: Sequence[DriveStretch]) -> list[Curve]:
    """Compute the mean residual over v and dv/dt, for both directions of the drive."""
    moving = [s for s in stretches if s.kind != 'rest']
    if not moving:
        return []
    m = max(1, -(-sum(s.n for s in moving) // SAMPLES))
    seconds = sum(s.n / parts[s.part].piece.sample_rate for s in moving)
    chunk_time = max(CHUNK_TIME, seconds / CHUNKS)
    columns: list[list[Array]] = []
    chunks: list[Integers] = []
    number = 0
    for s in moving:
        part, rate = parts[s.part], parts[s.part].piece.sample_rate
        v = part.piece.v[s.start : s.stop]
        signals = part.e[s.start : s.stop], v, np.gradient(v) * rate
        columns.append([block_means(x, m) for x in signals])
        chunk = np.arange(columns[-1][0].size) * m / rate // chunk_time
        chunks.append(number + chunk.astype(np.int64))
        number = int(chunks[-1][-1]) + 1 if chunk.size else number
    e, v, speed = (np.concatenate(column) for column in zip(*columns, strict=True))
    visits = np.concatenate(chunks)
    ends = np.linspace(v.min(), v.max() + 1e-12, BINS + 1)
    bins = np.clip(np.searchsorted(ends, v, side='right') - 1, 0, BINS - 1)
    ways = (('up', speed > 0.0), ('down', speed < 0.0))
    curves = [_curve('v', branch, v, e, bins, visits, own) for branch, own in ways]
    # speeds span decades, but a triangle has a single speed
    moves = np.abs(speed) > 1e-6 * np.abs(speed).max()
    if moves.sum() >= 4 * BINS:
        decades = np.full(speed.size, np.inf)
        decades[moves] = np.floor(PER_DECADE * np.log10(np.abs(speed[moves])))
        bins = np.where(moves, decades - decades.min(), 0.0).astype(np.int64)
        for branch, own in ways:
            curves.append(_curve('dv/dt', branch, speed, e, bins, visits, own & moves))
    return curves


def _curve(
    against: str, branch: str, x: Array, e: Array, bins: Integers, chunk: Integers, own: Mask
) -> Curve:
    bins, x, e, chunk = bins[own], x[own], e[own], chunk[own]
    size = int(bins.max(initial=0)) + 1
    count = np.bincount(bins, minlength=size)
    filled = np.maximum(count, 1)
    centre = np.bincount(bins, x, size) / filled
    mean = np.bincount(bins, e, size) / filled
    # all samples of a stretch of time in a bin are one observation, their sum
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


def _since_step(parts: Sequence[ResidualPart], stretches: Sequence[DriveStretch]) -> list[Curve]:
    """Compute the residual of the holds over lg t; each hold has its own offset."""
    holds = [s for s in stretches if s.kind == 'rest' and s.step != 0.0]
    if len(holds) < 2:
        return []
    largest = max(abs(s.step) for s in holds)
    # bins of time of a hold, mean residual in each bin, step as a share of the largest step
    rows: list[tuple[Integers, Array, float]] = []
    first = min(2.0 / parts[s.part].piece.sample_rate for s in holds)
    for s in holds:
        t = (np.arange(s.n) + 0.5) / parts[s.part].piece.sample_rate
        k = np.maximum(np.floor(PER_DECADE * np.log10(t / first)), 0).astype(np.int64)
        count, sums = np.bincount(k), np.bincount(k, parts[s.part].e[s.start : s.stop])
        used = np.flatnonzero(count)
        rows.append((used, sums[used] / count[used], s.step / largest))
    size = max(int(used[-1]) for used, _, _ in rows) + 1
    # the curve g that fits e = offset of the hold + weight g(bin) best
    A = np.zeros((sum(k.size for k, _, _ in rows), size + len(rows)))
    at = 0
    for i, (k, _, weight) in enumerate(rows):
        A[np.arange(at, at + k.size), k] = weight
        A[at : at + k.size, size + i] = 1.0
        at += k.size
    curve = np.linalg.lstsq(A, np.concatenate([e for _, e, _ in rows]), rcond=1e-9)[0][:size]
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

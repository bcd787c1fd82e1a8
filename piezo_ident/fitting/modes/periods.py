# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Cut whole periods of multisines out of records of several axes.

A stage in steady state under a periodic voltage repeats itself.  Two periods differ by noise, or
because the stage changed.  A record with a large difference counts less in a fit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import re

import numpy as np
from piezo_ident.common.arrays import Array, interpolated, Mask
from piezo_ident.record.channels import Axes
from piezo_ident.record.readings.faults import without_faults
from piezo_ident.record.record import Record

#: largest difference between periods of a sound record, in medians over all records.  Sound
#: records of the mirror differ by up to 2.4
SUSPICIOUS = 3.0
#: passes that find lost readings and the mean of a period from one another.  Each pass leaves the
#: lost share of the error
TURNS = 3
#: most periods of one segment (taste)
PERIODS = 64
#: shortest period [samples]: half as many lines are too few to find modes by
SHORTEST = 16
#: samples that refuse a period first (taste: time)
FEW = 1000
#: voltages are equal if they differ by less than this share of their range: measured ones differ
#: by 2e-4
EQUAL = 1e-3


@dataclass(frozen=True, eq=False)
class PeriodicRecord:
    """
    Whole periods of a stage in steady state.

    Parameters
    ----------
    name : str
        Name in messages.
    group : str
        Records of one amplitude share it.
    rate : float
        [Hz]
    u, y : ndarray, shape (periods, samples, inputs) and (periods, samples, outputs)
        Voltages and displacements.  The mean of each period is taken off y.  NaN in y marks a lost
        reading: readings of the other periods replace it, or a straight line.
    weight : float
        Weight in a fit.

    Attributes
    ----------
    sound : ndarray of bool, shape of y
        False for lost readings, which count in no error.
    """

    name: str
    group: str
    rate: float
    u: Array
    y: Array
    weight: float = 1.0
    sound: Mask = field(init=False)

    def __post_init__(self) -> None:
        u, y = (np.array(x, dtype=float) for x in (self.u, self.y))
        sound = ~np.isnan(y)
        y = _about_mean(y, sound)
        for name, value in {'u': u, 'y': y, 'sound': sound}.items():
            object.__setattr__(self, name, value)

    @property
    def mean_u(self) -> Array:
        """Voltages averaged over the periods, shape (samples, inputs)."""
        return np.asarray(self.u.mean(axis=0))

    @property
    def mean_y(self) -> Array:
        """Displacements averaged over the periods, shape (samples, outputs)."""
        return np.asarray(self.y.mean(axis=0))

    def error(self, answer: Array) -> Array:
        """Compute y - answer over the last period without its mean; NaN for lost readings."""
        e = np.where(self.sound[-1], self.y[-1] - answer, np.nan)
        return np.asarray(e - np.nanmean(e, axis=0))

    @property
    def noise(self) -> Array:
        """Noise of one period, estimated from the difference of the last two."""
        both = self.sound[-1] & self.sound[-2]
        # as much as if no reading had been lost
        share = np.maximum(both.mean(axis=0), 1 / len(both))
        return np.asarray(np.where(both, self.y[-1] - self.y[-2], 0.0) / np.sqrt(2 * share))


def _about_mean(y: Array, sound: Mask) -> Array:
    """Take the mean of each period off displacements, with lost readings replaced."""
    if sound.all():
        return np.asarray(y - y.mean(axis=1, keepdims=True))
    count = sound.sum(axis=0)
    y = y - np.nanmean(y, axis=1, keepdims=True)
    for _ in range(TURNS):
        usual = np.where(sound, y, 0.0).sum(axis=0) / np.maximum(count, 1)
        lines = [interpolated(x, n == 0) for x, n in zip(usual.T, count.T, strict=True)]
        y = np.where(sound, y, np.column_stack(lines))
        y -= y.mean(axis=1, keepdims=True)
    return y


def differences(records: Sequence[PeriodicRecord]) -> Array:
    """Compute the rms difference of the last two periods of each record, as a share of rms(y)."""
    return np.array([np.sqrt(2 * np.sum(r.noise**2) / np.sum(r.y[-1] ** 2)) for r in records])


def weighted(records: Sequence[PeriodicRecord]) -> list[PeriodicRecord]:
    """Give a record that does not repeat as the others do a smaller weight in a fit."""
    found = differences(records)
    usual = float(np.median(found))
    return [
        replace(r, y=np.where(r.sound, r.y, np.nan), weight=usual / x)
        if x > SUSPICIOUS * usual
        else r
        for r, x in zip(records, found, strict=True)
    ]


def groups(records: Sequence[PeriodicRecord]) -> dict[str, list[PeriodicRecord]]:
    """Sort records by group, in the order in which the groups appear."""
    found: dict[str, list[PeriodicRecord]] = {}
    for record in records:
        found.setdefault(record.group, []).append(record)
    return found


def percent_of(records: Sequence[PeriodicRecord], answers: Sequence[Array]) -> float:
    """Compute 100 rms(y - answer) / rms(y) over outputs; quadratic mean over the groups."""
    of_group: dict[str, list[tuple[float, float]]] = {}
    for record, answer in zip(records, answers, strict=True):
        error = float(np.sum(np.nanmean(record.error(answer) ** 2, axis=0)))
        power = float(np.sum(np.mean(record.y[-1] ** 2, axis=0)))
        of_group.setdefault(record.group, []).append((error, power))
    sums = [np.sum(pairs, axis=0) for pairs in of_group.values()]
    return 100 * float(np.sqrt(np.mean([error / power for error, power in sums])))


def periods_of(records: Sequence[Record]) -> tuple[tuple[PeriodicRecord, ...], Array]:
    """
    Find the periods in which all axes move at once.

    The stage settles in the first period, which is left out of three or more.  A piece
    without segments is one segment with the name of its record.  Segments named alike but for a
    number at the end are one group.  Periods of the most frequent length are taken.

    Returns
    -------
    tuple of PeriodicRecord
        Group of the smallest voltages first; the voltages are about `v0`.
    v0 : ndarray, shape (inputs,)
        Mean of the voltages [V].
    """
    records = [without_faults(record) for record in records]
    found, rate = [], records[0].pieces[0].sample_rate
    for name, piece in ((record.name, piece) for record in records for piece in record):
        axes = Axes.of(piece)
        parts = [(s.label, slice(s.start, s.stop)) for s in piece.segments]
        for label, part in parts or [(name, slice(piece.n))]:
            count = _periods(axes.inputs[part])
            u, y = (x[part].reshape(count, -1, x.shape[1]) for x in (axes.inputs, axes.outputs))
            if count > 1 and np.nanmin(np.nanstd(y, axis=1)) > 0.0:
                cut = slice(1 if count > 2 else 0, None)
                found.append((label, u[cut], y[cut]))
    if not found:
        return (), np.zeros(0)
    size = Counter(u.shape[1] for _, u, _ in found).most_common(1)[0][0]
    found = [(name, u, y) for name, u, y in found if u.shape[1] == size]
    v0 = np.mean([u.mean(axis=(0, 1)) for _, u, _ in found], axis=0)
    sizes = dict[str, float]()
    periods = [
        PeriodicRecord(name, re.sub(r'-?\d+$', '', name), rate, u - v0, y) for name, u, y in found
    ]
    for group, members in groups(periods).items():
        sizes[group] = float(np.mean([np.mean(r.u**2) for r in members]))
    return tuple(weighted(sorted(periods, key=lambda r: sizes[r.group]))), v0


def _periods(u: Array) -> int:
    """Count the periods of voltages; 1 if they do not repeat, or an axis rests."""
    n, span = len(u), np.ptp(u, axis=0)
    if not span.all():
        return 1
    for count in range(min(PERIODS, n // SHORTEST), 1, -1):
        if n % count == 0 and _repeats(u, n // count, EQUAL * span):
            return count
    return 1


def _repeats(u: Array, size: int, limit: Array) -> bool:
    """Tell whether voltages repeat after `size` samples; a few samples refuse most sizes."""
    now, before = u[size:], u[:-size]
    steps = max(1, len(now) // FEW), 1
    return all((np.abs(now[::k] - before[::k]).max(axis=0) < limit).all() for k in steps)

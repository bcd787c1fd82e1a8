# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Bring rows into the order of time: drop repeats, mark restarts, refuse disorder.

Time that jumps back is a restart between two stretches of at least ten samples.  The jump ends at
or before the first stamp of the first stretch, or goes back by more than a thousand samples (ten
blocks).  Rows that repeat earlier rows are dropped.  They stay if they start over from the
beginning and go on for more than two blocks: this is a simulation without noise, run again.

Time may be rounded to more than the sampling period.  At 5 kHz, five stamps in whole milliseconds
are equal.  Stamps of a long record still bound the sampling rate closely.  The rate of few digits
within these bounds is taken if there is only one.
"""

from __future__ import annotations

from dataclasses import dataclass
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.common.errors import DataError, OrderError
from piezo_ident.record.clock import (
    has_restarted,
    nice_rates,
    rate_bounds,
    Resolution,
    time_stamps,
)
from piezo_ident.record.record import Fault

#: least samples of the stretches on both sides of a restart
MIN_STRETCH = 10
#: largest chance that a rate of so few digits lies within the bounds of rounded stamps
CHANCE = 0.1
#: longest repeat from the beginning that is not another run [rows]
MAX_REPEAT = 200


@dataclass(frozen=True)
class OrderedRows:
    """Columns, the first row of each label, and the rows that lost their predecessor."""

    t: Array
    columns: dict[str, Array]
    names: tuple[str, ...]
    starts: Integers
    torn: Integers

    def take(self, rows: Integers) -> OrderedRows:
        """Return only these rows, which must be in order."""
        return OrderedRows(
            self.t[rows],
            {k: x[rows] for k, x in self.columns.items()},
            self.names,
            np.searchsorted(rows, self.starts),
            np.searchsorted(rows, self.torn),
        )


def in_order(table: OrderedRows, name: str, met: list[Fault]) -> tuple[OrderedRows, list[int]]:
    """
    Drop repeated rows, and return the rows at which the clock starts, 0 among them.

    The faults are added to `met`.  DataError if time is unsorted, or has two samples at once.
    """
    n = table.t.size
    # rows right behind their twins are dropped first, so that only real jumps are left
    twin = table.t[1:] == table.t[:-1]
    if twin.any():
        for x in table.columns.values():
            twin &= (x[1:] == x[:-1]) | (np.isnan(x[1:]) & np.isnan(x[:-1]))
    kept = table
    repeated = table.t[1:][twin]
    if twin.any():
        kept = table.take(np.flatnonzero(np.concatenate([[True], ~twin])))
    t = kept.t
    jumps = np.flatnonzero(t[1:] <= t[:-1]) + 1
    epochs = [0]
    if jumps.size:
        rows, epochs, again = _stretches(kept, jumps, name)
        repeated = np.concatenate([repeated, again])
        if rows is not None:
            kept = kept.take(rows)
        where = [f'from {kept.t[e - 1]:.6g} s back to {kept.t[e]:.6g} s' for e in epochs[1:4]]
        if where:
            count = len(epochs) - 1
            met.append(Fault('restart', ', '.join(where), count, 'record split there'))
    if kept.t.size < n:
        met.append(Fault('repeated_rows', at_times(repeated), n - kept.t.size, 'dropped'))
    return kept, epochs


def _stretches(
    table: OrderedRows, jumps: Integers, name: str
) -> tuple[Integers | None, list[int], Array]:
    """
    Sort stretches of rising time into repeats and restarts; refuse all others.

    Returns the rows that stay, None for all, the first row of each epoch, and times of repeats.
    """
    t = table.t
    # until a row is dropped, row numbers need no table
    rows: Integers | None = None
    known = t  # t[rows], so that a look-up copies nothing
    size, begin = 0, 0
    epochs, repeated = [0], []
    for first, stop in itertools.pairwise([0, *jumps.tolist(), t.size]):
        start = first
        if size:
            epoch = known[begin:size]
            overlap = start + int(np.searchsorted(t[start:stop], epoch[-1], 'right'))
            place = np.searchsorted(epoch, t[start:overlap])
            same_time = epoch[place] == t[start:overlap]
            old = begin + place if rows is None else rows[begin:size][place]
            again = bool(same_time.all()) and all(
                np.array_equal(x[old], x[start:overlap], equal_nan=True)
                for x in table.columns.values()
            )
            from_start = t[start] <= epoch[0]
            if again and not (from_start and overlap - start > MAX_REPEAT):
                repeated.append(t[start:overlap])
                start = overlap
            # counted in samples, so that gaps do not matter
            elif min(epoch.size, stop - start) >= MIN_STRETCH and has_restarted(
                float(place[0]), epoch.size, 0.0, 1.0
            ):
                epochs.append(begin := size)
            elif same_time.any():
                at = t[start:overlap][same_time][0]
                raise OrderError(
                    f'{name}: two different samples at t = {at:.9g} s',
                    'write t with more decimals, keep one of them, or give the exact rate: '
                    f'{_mean_rate(t)}',
                )
            else:
                raise OrderError(
                    f'{name}: time is unsorted, {t[start]:.9g} s follows {t[first - 1]:.9g} s',
                    'sort the rows by t',
                )
        if rows is None and start > first:
            rows, known = np.arange(t.size), t.copy()
        if rows is not None:
            rows[size : size + stop - start] = np.arange(start, stop)
            known[size : size + stop - start] = t[start:stop]
        size += stop - start
    return None if rows is None else rows[:size], epochs, np.concatenate([t[:0], *repeated])


def not_uniform(t: Array, breaks: int, name: str) -> DataError:
    """Return the error for times that do not belong to a sampling clock."""
    return DataError(
        f'{name}: time is not uniformly sampled ({breaks} breaks in {t.size} samples); name the '
        f'rate if no sample is missing, as in {_mean_rate(t)}; else write t with more decimals '
        'or on a uniform grid'
    )


def _mean_rate(t: Array) -> str:
    span = float(np.ptp(t))
    return f'--rate {(t.size - 1) / span:.6g}' if span > 0.0 else '--rate 20e3'


def at_times(times: Array) -> str:
    """Return a text with at most three of the times [s]."""
    if not times.size:
        return 'at unknown times'
    text = 'at ' + ', '.join(f'{x:.6g}' for x in times[:3]) + ' s'
    return text if times.size <= 3 else f'{text} and {times.size - 3} more'


def unrounded(table: OrderedRows, met: list[Fault]) -> Array:
    """
    Return uniform time in place of stamps that are rounded too coarsely; other stamps stay.

    The fault is added to `met`.  All stamps must agree with one rate, and rounding must make steps
    of two sizes common.  Other code handles repeated rows, lost samples and gaps.
    """
    t, n = table.t, table.t.size
    if n < 10 or not t[-1] > t[0] or not np.all(np.isfinite(t)):
        return t
    again, resolution = t[1:] == t[:-1], Resolution.of(t)
    came_twice = again.any() and all(
        np.array_equal(x[1:][again], x[:-1][again]) for x in table.columns.values()
    )
    if (t[1:] < t[:-1]).any() or came_twice or resolution.decimals is None:
        return t
    unit = 10.0**-resolution.decimals
    mean = (t[-1] - t[0]) / (n - 1) / unit
    # with about one step a sample, a repeated stamp is a fault and a longer step a lost sample
    if not (mean < 0.95 or (mean < 2.5 and abs(mean - round(mean)) > 0.05)):
        return t
    low, high = rate_bounds(t, lambda x: np.full(x.shape, 0.5 * unit) + 8 * np.spacing(np.abs(x)))
    if not low <= high:
        return t
    rate = next(nice_rates(low, high))
    # digits after the first digit, of the rate or of its period
    digits = next(
        (d for d in range(15) if any(float(f'{x:.{d}e}') == x for x in (rate, 1 / rate))), 15
    )
    if (high / low - 1.0) * 10.0**digits > CHANCE:
        return t
    where = f'to {unit:g} s, with {mean:.3g} of it between samples'
    met.append(Fault('rounded_time', where, n, f'read as uniformly sampled at {rate:.9g} Hz'))
    return time_stamps(rate, round(t[0] * rate) / rate, 0, n)

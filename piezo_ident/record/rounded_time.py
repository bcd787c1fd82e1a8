# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Time that a file rounds more coarsely than its samples follow each other.

At 5 kHz, stamps in whole milliseconds come five at a time.  They still bound the sampling rate,
the more closely the longer the record is; where only one rate of few digits is left, it is taken.
"""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.record.clock import nice_rates, rate_bounds, Resolution, time_stamps
from piezo_ident.record.ordering import OrderedRows
from piezo_ident.record.record import Fault

#: by chance, a rate of so few digits lies within the bounds this seldom
CHANCE = 0.1


def unrounded(table: OrderedRows, met: list[Fault]) -> Array:
    """
    Return uniform time where that of a table is rounded too coarsely, else its own.

    What is met is added to `met`.  Repeated rows, lost samples and gaps are left to others: the
    stamps must all agree with one rate, and be rounded so that steps of two sizes are common.
    """
    t = table.t
    n = t.size
    if n < 10 or not t[-1] > t[0] or not np.all(np.isfinite(t)):
        return t
    step = np.diff(t)
    if step.min() < 0:
        return t
    again = step == 0
    if again.any() and all(
        np.array_equal(x[1:][again], x[:-1][again]) for x in table.columns.values()
    ):
        return t  # rows that came twice
    resolution = Resolution.of(t)
    if resolution.decimals is None:
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
    # a rate may be nice by its period
    digits = min(_digits(rate), _digits(1 / rate))
    if (high / low - 1.0) * 10.0**digits > CHANCE:
        return t
    where = f'to {unit:g} s, with {mean:.3g} of it between samples'
    met.append(Fault('rounded_time', where, n, f'read as uniformly sampled at {rate:.9g} Hz'))
    return time_stamps(rate, round(t[0] * rate) / rate, 0, n)


def _digits(x: float) -> int:
    """Return how many digits behind the first one a number has."""
    return next((d for d in range(15) if float(f'{x:.{d}e}') == x), 15)

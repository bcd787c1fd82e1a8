# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Rows in the order of time: repeats go, restarts are found, disorder is refused.

Time that jumps back is a restart when both stretches hold at least ten samples and the jump ends
at or before the stamp where the first stretch began, or goes back by more than a thousand
samples (ten blocks).  Rows that merely repeat earlier ones are dropped, unless they start over
from the beginning and go on for more than two blocks: a simulation without noise, run again.
"""

from __future__ import annotations

from dataclasses import dataclass
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.common.errors import DataError, OrderError
from piezo_ident.record.clock import has_restarted
from piezo_ident.record.record import Fault

#: time may jump back in a record only between stretches of at least this many samples
MIN_STRETCH = 10
#: rows that start over and equal the old ones for longer than this are another run
MAX_REPEAT = 200


@dataclass(frozen=True)
class OrderedRows:
    """Columns, the row where each label begins, and the rows that lost their predecessor."""

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
    Drop repeated rows, and return the rows at which the clock restarts, with 0.

    What is met is added to `met`.  DataError when time is unsorted, or has two samples at once.
    """
    n = table.t.size
    # first what stands right behind its twin, so that the loop below only sees real jumps
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
    Sort stretches of rising time into repeats and restarts; refuse what is neither.

    Returns the rows that stay, None for all, where each epoch begins, and the times of repeats.
    """
    t = table.t
    # as long as nothing is dropped, rows are their own numbers and need no table
    rows: Integers | None = None
    known = t  # t[rows], so that a look-up copies nothing
    size, begin = 0, 0
    epochs, repeated = [0], []
    bounds = [0, *jumps.tolist(), t.size]
    for first, stop in itertools.pairwise(bounds):
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
            elif min(epoch.size, stop - start) >= MIN_STRETCH and (
                # told in samples, so that gaps do not count
                has_restarted(float(place[0]), epoch.size, 0.0, 1.0)
            ):
                epochs.append(size)
                begin = size
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
    return (
        None if rows is None else rows[:size],
        epochs,
        np.concatenate(repeated) if repeated else t[:0],
    )


def not_uniform(t: Array, breaks: int, name: str) -> DataError:
    """Return the error for times that do not belong to a sampling clock."""
    return DataError(
        f'{name}: time is not uniformly sampled ({breaks} breaks in {t.size} samples); if the '
        f'samples came at one rate and none is missing, name it, as in {_mean_rate(t)}, and t is '
        'not read; else write t with more decimals, or resample on a uniform grid'
    )


def _mean_rate(t: Array) -> str:
    span = float(np.ptp(t))
    return f'--rate {(t.size - 1) / span:.6g}' if span > 0.0 else '--rate 20e3'


def at_times(times: Array) -> str:
    """Return where something happened, for people: at most three times."""
    if not times.size:
        return 'at unknown times'
    text = 'at ' + ', '.join(f'{x:.6g}' for x in times[:3]) + ' s'
    return text if times.size <= 3 else f'{text} and {times.size - 3} more'

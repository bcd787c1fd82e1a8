# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What a record is judged by as a whole, gathered from all of it at once or part by part.

A stage may rest for minutes, and a sensor fail for a moment: stroke, voltage range and the share
of lost numbers say something about the whole record only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import DataError

__all__ = ['Extent', 'Overall']

#: strokes of piezo stages [m]; anything else is the wrong unit
STROKE = (1e-9, 10e-3)
#: spans of a voltage [V]; the squares of others leave what a float64 can hold
VOLTAGE = (1e-12, 1e12)
#: share of a motion that a float64 may lose to an offset
LOST = 1e-6
#: share of samples without a number that can be cut out
MAX_NOT_FINITE = 0.01
#: later times [s] are counted in another unit than seconds
MAX_TIME = 1e11

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Extent:
    """Smallest and largest of some numbers; before the first, the wrong way round."""

    low: float = float('inf')
    high: float = -float('inf')

    def including(self, x: Vector) -> Extent:
        """Return the extent with more numbers, NaN left out."""
        if not x.size:
            return self
        low, high = float(np.fmin.reduce(x)), float(np.fmax.reduce(x))
        return self if np.isnan(low) else Extent(min(self.low, low), max(self.high, high))

    @property
    def span(self) -> float:
        """How far apart they are."""
        return self.high - self.low

    @property
    def largest(self) -> float:
        """Largest size."""
        return max(self.high, -self.low)


@dataclass
class Overall:
    """
    Facts about the rows seen so far.

    Attributes
    ----------
    limits : tuple of float, optional
        Smallest and largest voltage [V] that may occur.
    rows, bad : int
        Samples, and those of them without a number.
    t, v, y : Extent
        Of the samples with numbers [s, V, m].
    command : Extent
        Of the commanded voltage before anything was cut out [V].
    is_guarded : bool
        Whether another voltage was applied than commanded, by however little.
    """

    limits: tuple[float, float] | None = None
    rows: int = 0
    bad: int = 0
    t: Extent = Extent()
    v: Extent = Extent()
    y: Extent = Extent()
    command: Extent = Extent()
    is_guarded: bool = False
    _outside: int = 0
    _worst: tuple[float, float, float] = (-1.0, 0.0, 0.0)  # distance, voltage, time

    def see_command(self, v: Vector, is_guarded: bool) -> None:
        """Take note of commanded voltages [V], and whether others were applied."""
        self.command = self.command.including(v[np.isfinite(v)])
        self.is_guarded |= is_guarded

    def see(self, t: Vector, v: Vector, y: Vector) -> None:
        """Take note of samples with numbers [s, V, m]."""
        self.t, self.v, self.y = self.t.including(t), self.v.including(v), self.y.including(y)
        if self.limits is None or not v.size:
            return
        low, high = self.limits
        if v.min() < low or v.max() > high:
            outside = np.flatnonzero((v < low) | (v > high))
            distance = np.abs(v[outside] - 0.5 * (low + high))
            k = int(np.argmax(distance))
            self._outside += outside.size
            if distance[k] > self._worst[0]:
                row = outside[k]
                self._worst = (float(distance[k]), float(v[row]), float(t[row]))

    def check_finite(self, name: str) -> None:
        """
        Refuse too many samples without a number.

        Raises
        ------
        DataError
        """
        if self.bad > MAX_NOT_FINITE * self.rows:
            raise DataError(
                f'{name}: {self.bad} of {self.rows} samples are NaN or infinite, more than 1 %; '
                'cut the bad stretch out of the file'
            )

    def check_ranges(self, name: str, unit: str) -> None:
        """
        Refuse times, voltages and strokes that no piezo stage has.

        Parameters
        ----------
        name : str
            What errors call the data.
        unit : str
            In which the displacement was read.

        Raises
        ------
        DataError
        """
        latest = self.t.largest
        if latest > MAX_TIME:
            raise DataError(f'{name}: t reaches {latest:.3g}; write t in seconds')
        if self.limits is not None and self._outside:
            _, worst, at = self._worst
            raise DataError(
                f'{name}: {self._outside} samples leave the voltage limits {self.limits[0]:g}..'
                f'{self.limits[1]:g} V, worst {worst:g} V at {at:.6g} s; '
                'check the limits or the unit of v'
            )
        stroke, span = self.y.span, self.v.span
        idle = span == 0.0  # a stage at rest has no stroke, whatever the unit
        if not (idle or VOLTAGE[0] <= span <= VOLTAGE[1]):
            raise DataError(f'{name}: v spans {span:.3g} V, which is no voltage; write v in volts')
        if stroke == 0.0 and not idle:
            raise DataError(f'{name}: the displacement never changes; is the sensor connected?')
        if stroke > STROKE[1] or (stroke < STROKE[0] and not idle):
            raise DataError(
                f'{name}: a stroke of {stroke:.3g} m, read in {unit}, is no piezo stage '
                '(1 nm .. 10 mm); name the unit of y with --displacement-unit m, mm, um or nm'
            )
        for key, extent, moved in (('v', self.v, span), ('y', self.y, stroke)):
            offset = extent.largest
            if moved and offset * np.finfo(np.float64).eps > LOST * moved:
                raise DataError(
                    f'{name}: {key} lies at {offset:.3g} and moves by {moved:.3g}: its digits are '
                    'used up by the offset; subtract it where the numbers are made'
                )

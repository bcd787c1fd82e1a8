# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Settings at which an effect is tried, and the properties of the data that they depend on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array


@dataclass(frozen=True, eq=False)
class View:
    """
    Properties of the data on which an effect is tried.

    Attributes
    ----------
    sample_rate : float
        Sampling rate [Hz].
    low, high : float
        Range of the normalised command u.
    speeds : ndarray, shape (n,)
        ``|du/dt|`` [1/s], ascending: quantiles 0.1 .. 0.999 of the speeds in motion.
    duration : float
        Length of the longest record [s].
    channels : mapping of str to (float, float)
        First value and standard deviation of each further channel, in its own unit.
    lines : tuple of float
        Frequencies [Hz] of the lines in the residual.
    modes : tuple of (float, float)
        Natural frequency [Hz] and damping ratio of each mode of G.
    max_frequency : float
        Highest frequency at which the command has power [Hz].
    thresholds : ndarray, shape (m,)
        Thresholds of H.
    judged : float
        Longest time from the first to the last sample that counts in a record [s].
    first : float
        Time of the first sample that counts, in the record with most samples that count [s].
    last : float or None
        End of the last record on the same clock [s]; None if it equals `duration`.
    is_fast : bool
        Whether dynamics matter in the data.
    """

    sample_rate: float
    low: float
    high: float
    speeds: Array
    duration: float
    channels: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    lines: tuple[float, ...] = ()
    modes: tuple[tuple[float, float], ...] = ()
    max_frequency: float = 100.0
    thresholds: Array = field(default_factory=lambda: np.empty(0))
    judged: float = np.inf
    first: float = 0.0
    last: float | None = None
    is_fast: bool = True

    @property
    def span(self) -> float:
        """Width of the range of u."""
        return self.high - self.low

    @property
    def speed(self) -> float:
        """A speed that is fast for these data [1/s], never zero."""
        moving = self.speeds[self.speeds > 0]
        return max(1e-6, float(np.quantile(moving, 0.75)) if moving.size else self.span)

    @property
    def nyquist(self) -> float:
        """Half the sampling rate [Hz]."""
        return self.sample_rate / 2.0


@dataclass(frozen=True, eq=False)
class Trial:
    """
    One way to try an effect: its values, and the amplitudes that are moved.

    Attributes
    ----------
    values : mapping
        One value for each parameter; amplitudes are neutral.
    moves : tuple of (str, int or None)
        Amplitudes that are moved, one column each: name and, in a list, index.  Empty for an
        effect without amplitudes, which `values` switch on: its column is the difference between
        on and off.
    steps : tuple of float
        Step of each moved amplitude.
    """

    values: Mapping[str, Any]
    moves: tuple[tuple[str, int | None], ...] = ()
    steps: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, 'values', MappingProxyType(dict(self.values)))

    def settings(self) -> list[dict[str, Any]]:
        """Make one complete set of parameters for each column."""
        if not self.moves:
            return [dict(self.values)]
        return [
            with_number(self.values, name, i, number_of(self.values, name, i) + step)
            for (name, i), step in zip(self.moves, self.steps, strict=True)
        ]


def number_of(values: Mapping[str, Any], name: str, index: int | None) -> float:
    """Read one number; the index is its place in a list."""
    return float(values[name] if index is None else values[name][index])


def with_number(
    values: Mapping[str, Any], name: str, index: int | None, number: float
) -> dict[str, Any]:
    """Replace one number in the values."""
    if index is None:
        return {**values, name: number}
    vector = np.array(values[name], dtype=np.float64)
    vector[index] = number
    return {**values, name: vector}


def ladder(low: float, high: float, count: int) -> list[float]:
    """Space `count` numbers from `low` to `high` in equal ratios."""
    return [float(x) for x in np.geomspace(low, max(low, high), count)]

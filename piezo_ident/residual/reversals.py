# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""How large a residual is over the way since the voltage last turned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import itertools

import numpy as np
from numpy.typing import NDArray

__all__ = ['EDGES', 'Way', 'turns_of', 'way_since_turn', 'ways']

Array = NDArray[np.float64]

#: edges of the stretches behind a turn, shares of the voltage range
EDGES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.01)
#: a change of direction counts from this share of the range: noise turns all the time
TURN = 0.01
#: residuals are means over this time, so that noise does not hide what is looked for [s]
MEAN = 0.002
#: fewest means of a way
FEWEST = 20


@dataclass(frozen=True)
class Way:
    """
    Residuals on a stretch of the way behind a turn.

    Attributes
    ----------
    start, stop : float
        Way since the turn, share of the voltage range.
    rms : tuple of float
        Of each residual [the residual's unit].
    n : int
        Means over 2 ms that it stands on.
    """

    start: float
    stop: float
    rms: tuple[float, ...]
    n: int


def turns_of(v: Array, least: float) -> NDArray[np.int64]:
    """
    Return where a voltage turns and then moves by `least` or more the other way.

    Parameters
    ----------
    v : ndarray, shape (n,)
        [V]
    least : float
        [V]

    Returns
    -------
    ndarray of int
        Index of each extreme, ascending.

    Examples
    --------
    >>> turns_of(np.array([0.0, 5.0, 4.9, 6.0, 1.0, 2.0]), 0.5)
    array([3, 4])
    """
    found: list[int] = []
    low = high = 0
    up: bool | None = None
    for i, x in enumerate(v.tolist()):
        if x > v[high]:
            high = i
        if x < v[low]:
            low = i
        if up is not False and x < v[high] - least:
            if up:
                found.append(high)
            up, low = False, i
        elif up is not True and x > v[low] + least:
            if up is False:
                found.append(low)
            up, high = True, i
    return np.array(found, dtype=np.int64)


def way_since_turn(v: Array, span: float) -> Array:
    """Return how far v has come since it last turned, share of its span; NaN before a turn."""
    turns = turns_of(v, TURN * span)
    way = np.full(v.size, np.nan)
    if turns.size:
        last = np.searchsorted(turns, np.arange(v.size), side='right') - 1
        way = np.where(last >= 0, np.abs(v - v[turns[np.maximum(last, 0)]]) / span, np.nan)
    return way


def ways(
    pieces: Sequence[tuple[Array, NDArray[np.bool_], float]],
    residuals: Sequence[Sequence[Array]],
) -> tuple[Way, ...]:
    """
    Return the rms of residuals by the way since the last turn.

    Parameters
    ----------
    pieces : sequence of (v, sound, sample_rate)
        Voltage [V], samples that count, and rate [Hz] of each piece.
    residuals : sequence of sequence of ndarray
        For each piece, one or more residuals.

    Returns
    -------
    tuple of Way
        Empty where the voltage never turns, or stands still.
    """
    span = max((float(np.ptp(v)) for v, _, _ in pieces), default=0.0)
    if span == 0.0:
        return ()
    found: list[Array] = []
    for (v, sound, rate), errors in zip(pieces, residuals, strict=True):
        m = max(1, round(MEAN * rate))
        n = v.size // m * m
        slow = v[:n].reshape(-1, m).mean(axis=1)
        keep = sound[:n].reshape(-1, m).all(axis=1)
        means = [e[:n].reshape(-1, m).mean(axis=1) for e in errors]
        found.append(np.stack([way_since_turn(slow, span), *means])[:, keep])
    table = np.concatenate(found, axis=1)
    rows = []
    for start, stop in itertools.pairwise(EDGES):
        here = table[1:, (table[0] >= start) & (table[0] < stop)]
        if here.shape[1] >= FEWEST:
            rms = tuple(float(x) for x in np.sqrt(np.mean(here**2, axis=1)))
            rows.append(Way(start, min(stop, 1.0), rms, here.shape[1]))
    return tuple(rows)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The size of a residual over the way since the last turn of the voltage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.residual.stretches import block_means

#: edges of the stretches behind a turn, shares of the voltage range
EDGES = (0.0, 0.02, 0.05, 0.1, 0.2, 0.5, 1.01)
#: least turn, as a share of the range: noise turns all the time
TURN = 0.01
#: residuals are means over this time against noise [s]
MEAN = 0.002
#: fewest means of a way
FEWEST = 20


@dataclass(frozen=True)
class Way:
    """Rms of each residual over a part of the way behind a turn, a share of the voltage range."""

    start: float
    stop: float
    rms: tuple[float, ...]
    n: int


def turns_of(v: Array, least: float) -> Integers:
    """
    Return the indices at which a voltage turns and then moves by `least` [V] the other way.

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


def ways(
    pieces: Sequence[tuple[Array, Mask, float]], residuals: Sequence[Sequence[Array]]
) -> tuple[Way, ...]:
    """
    Return the rms of residuals by the way since the last turn; nothing without a turn.

    Each piece is (voltage [V], samples that count, rate [Hz]), and has one or more residuals.
    """
    span = max((float(np.ptp(v)) for v, _, _ in pieces), default=0.0)
    if span == 0.0:
        return ()
    found: list[Array] = []
    for (v, sound, rate), errors in zip(pieces, residuals, strict=True):
        m = max(1, round(MEAN * rate))
        keep = sound[: v.size // m * m].reshape(-1, m).all(axis=1)
        means = block_means(v, m)
        turns = turns_of(means, TURN * span)
        way = np.full(means.size, np.nan)
        for a, b in itertools.pairwise([*turns.tolist(), means.size]):
            way[a:b] = np.abs(means[a:b] - means[a]) / span
        found.append(np.stack([way, *(block_means(e, m) for e in errors)])[:, keep])
    table = np.concatenate(found, axis=1)
    rows = []
    for start, stop in itertools.pairwise(EDGES):
        here = table[1:, (table[0] >= start) & (table[0] < stop)]
        if here.shape[1] >= FEWEST:
            rms = tuple(float(x) for x in np.sqrt(np.mean(here**2, axis=1)))
            rows.append(Way(start, min(stop, 1.0), rms, here.shape[1]))
    return tuple(rows)

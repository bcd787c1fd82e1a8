# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Knocks: short transients at random times, independent of the drive."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from piezo_ident.common.arrays import Array, interpolated, Mask
from piezo_ident.residual.reversals import TURN, turns_of
from piezo_ident.residual.stretches import block_means, ResidualPart, Stretch, stretches_of
from scipy import stats
from scipy.ndimage import median_filter, uniform_filter1d

#: time over which power is averaged, and time of the mean that is subtracted [s]
SHORT, SLOW = 0.004, 0.04
#: least power of a knock, as a multiple of the usual power
STANDS_OUT = 16.0
#: longest knock, and distance at which two are one [s]
LONGEST, TOGETHER = 0.25, 0.03
#: power before a knock, as a share of the power behind it; a jump has equal power on both sides
BEFORE = 0.6
#: fewest knocks, and chance below which they belong to the turns of the drive
FEWEST, CHANCE = 5, 0.02
#: shortest way between two turns that shows the place of a knock [blocks]
WAY = 8
#: share at the start of a rest that is left out, and least time of it [s]
SETTLING, SETTLING_TIME = 0.2, 0.1


class Transients(NamedTuple):
    """Times [s] of knocks in a part, their largest size and usual length [m], [s]."""

    times: tuple[float, ...] = ()
    size: float = 0.0
    length: float = 0.0


def transients_in(part: ResidualPart, known: Mask, least: float) -> Transients:
    """
    Return the knocks in rests and in motion that repeats.

    The median over the periods is subtracted from a motion that repeats: the error of a model
    repeats, too.  A knock stands out of the usual power, begins suddenly, is short, is larger than
    `least` [m], and comes anywhere between two turns of the drive.  Samples `known` to be faulty
    do not count.
    """
    e = interpolated(part.e, known, part.mask)
    found = [knock for s in stretches_of(part) for knock in _in_stretch(part, e, s, least)]
    if len(found) < FEWEST:
        return Transients()
    times, sizes, lengths = zip(*sorted(found), strict=True)
    return Transients(tuple(times), max(sizes), float(np.median(lengths)))


def _in_stretch(
    part: ResidualPart, e: Array, s: Stretch, least: float
) -> list[tuple[float, float, float]]:
    rate, p = part.piece.sample_rate, s.period
    if s.kind == 'rest':
        start = s.start + max(round(SETTLING * s.n), round(SETTLING_TIME * rate))
        x = e[start : s.stop]
    elif s.kind == 'repeat' and s.n >= 4 * p:
        # the first period may still be settling
        start = s.start + p
        rows = e[start : start + (s.stop - start) // p * p].reshape(-1, p)
        x = (rows - np.median(rows - rows.mean(axis=1, keepdims=True), axis=0)).ravel()
    else:
        return []
    m = max(1, round(SHORT * rate))
    if x.size < 4 * round(SLOW * rate):
        return []
    x = x - uniform_filter1d(x, round(SLOW * rate), mode='nearest')
    power = uniform_filter1d(x * x, m, mode='nearest')
    events = _events(x, power[::m], m, rate, least)
    if p and _follows_turns(part.piece.v[start : start + x.size], events, m):
        return []
    begin = part.piece.start_time + start / rate
    return [(begin + k / rate, size, length) for k, size, length in events]


def _follows_turns(v: Array, events: list[tuple[int, float, float]], m: int) -> bool:
    """Return whether events keep to one part of the way from a turn of the drive to the next."""
    means = block_means(v, m)
    turns = turns_of(means, TURN * float(np.ptp(v))) * m
    at = np.array([k for k, _, _ in events])
    inside = at[(at >= turns[:1].max(initial=0)) & (at < turns[-1:].max(initial=0))]
    if inside.size < 2:
        return False
    last = np.searchsorted(turns, inside, side='right') - 1
    way = turns[last + 1] - turns[last]
    # short ways do not show the place
    share = ((inside - turns[last]) / way)[way > WAY * m]
    if share.size < 2:
        return False
    # the end of one way and the beginning of the next are one place
    apart = [float(stats.kstest((share + x) % 1.0, 'uniform').pvalue) for x in (0.0, 0.5)]
    return min(apart) < CHANCE


def _events(
    x: Array, power: Array, m: int, rate: float, least: float
) -> list[tuple[int, float, float]]:
    """Return first sample, size and length of knocks; `power` is of every m-th sample."""
    step = m / rate
    usual = median_filter(power, size=2 * round(0.5 / step) + 1, mode='nearest')
    loud = np.flatnonzero(power > STANDS_OUT * np.maximum(usual, 1e-300))
    if loud.size == 0:
        return []
    found = []
    for group in np.split(loud, np.flatnonzero(np.diff(loud) * step > TOGETHER) + 1):
        first, last = int(group[0]), int(group[-1])
        peak = first + int(np.argmax(power[first : last + 1]))
        side = round(0.5 * SLOW / step)
        before = float(power[max(0, peak - 1 - side) : max(0, peak - 1)].sum())
        after = float(power[peak + 2 : peak + 2 + side].sum())
        at = slice(max(0, (first - 1) * m), (last + 2) * m)
        size, length = float(np.abs(x[at]).max()), (last - first + 1) * step
        sudden = before < BEFORE * after or before < 0.1 * float(power[peak])
        if size > least and length < LONGEST and sudden:
            found.append((first * m, size, length))
    return found

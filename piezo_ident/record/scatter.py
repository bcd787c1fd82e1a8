# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Stamps that scatter about one uniform clock.

A computer that stamps samples as they arrive is late by a little here and there.  Steps between
neighbours then look like gaps and changes of rate, but each of them is taken back by the next.
A lost sample is not.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from piezo_ident.common.arrays import Array, Integers, true_runs

#: fewer stamps tell no scatter from a change
_LEAST = 16
#: steps on either side over which time is averaged, so that scatter goes and a lost sample stays
_AROUND = 8
#: rows looked at together, so that temporaries stay small beside a long record
_CHUNK = 1 << 20


def residual_of(t: Array) -> Array:
    """Return what a least-squares line leaves of the stamps [s]."""
    k = np.arange(t.size) - 0.5 * (t.size - 1)
    x = t - t[0]
    x -= x.mean()
    residual: Array = x - k * (np.dot(k, x) / np.dot(k, k))
    return residual


def scatters(t: Array) -> bool:
    """
    Return whether increasing stamps [s] scatter about one uniform clock.

    They do where a line is off by less than half a sample everywhere, neighbours stray on their
    own, and what jumps forward comes back.

    >>> t = np.arange(100.0)
    >>> scatters(t + 0.3 * np.sin(t**2)), scatters(np.delete(t, 50))
    (True, False)
    """
    if t.size < _LEAST:
        return False
    residual = residual_of(t)
    if 2 * np.abs(residual).max() >= (t[-1] - t[0]) / (t.size - 1):
        return False
    step = np.diff(residual)
    # white noise has twice its power in its steps, a change of rate next to none
    is_white = np.dot(step, step) > np.dot(residual, residual)
    return bool(is_white and -step.min() > 0.6 * step.max())


def without_scatter(t: Array, cuts: Integers) -> Integers:
    """
    Return where to cut increasing stamps [s] when steps that scatter are no breaks.

    `cuts` are the first samples behind breaks, as steps between neighbours tell them.
    """
    if not cuts.size:
        return cuts
    marks = np.array([0, *_jumps(t), t.size], dtype=np.int64)
    inside = np.searchsorted(cuts, marks[:-1], 'right') < np.searchsorted(cuts, marks[1:])
    for i in np.flatnonzero(inside & (np.diff(marks) >= _LEAST)):
        start, stop = marks[i], marks[i + 1]
        if scatters(t[start:stop]):
            cuts = cuts[(cuts <= start) | (cuts >= stop)]
            cuts = np.union1d(cuts, marks[i : i + 2])
    return cuts[(cuts > 0) & (cuts < t.size)]


def _jumps(t: Array) -> Iterator[int]:
    """Yield the samples before which time jumps by more than half a step, and stays there."""
    dt = float(np.median(np.diff(t[:_CHUNK])))
    # mean time behind a sample less that before it, in terms of the steps between
    weights = 1 - np.abs(np.arange(1 - _AROUND, _AROUND)) / _AROUND
    for at in range(0, t.size - 1, _CHUNK):
        first = max(at - 2 * _AROUND, 0)
        step = np.diff(t[first : at + _CHUNK + 2 * _AROUND]) - dt
        ahead = np.convolve(step, weights)[_AROUND - 1 : 1 - _AROUND] > 0.5 * dt
        for start, stop in true_runs(ahead):
            k = first + int(start + np.argmax(step[start:stop])) + 1
            if at < k <= at + _CHUNK:
                yield k

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Find kinds of motion in a record without labels, from the voltage in each block.

The mean, the size (standard deviation) and the speed (rms change per sample) of its voltage
describe a block.  Ward clustering of these numbers gives `KINDS` kinds.  A kind is always fitted
if its mean, size or speed lies beyond all other blocks, as other kinds would extrapolate to it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.fitting.stretch import Stretch
from scipy.cluster.hierarchy import fcluster, linkage

#: number of kinds, and smallest number of kinds that can be held out in turn (taste)
KINDS, FEWEST = 6, 3
#: resolution of size and speed, as shares of the range and of the range per sample
FAINT = 1e-4


def interleaved(count: int, sets: int = 5) -> Integers:
    """
    Assign each block to a set; neighbours are in different sets, shape (count,).

    Examples
    --------
    >>> interleaved(7, 3).tolist()
    [0, 1, 2, 0, 1, 2, 0]
    """
    return np.arange(count) % sets


def motion_kinds(stretches: Sequence[Stretch], count: int) -> Integers | None:
    """
    Find the kind of motion of each of `count` blocks; -1 for blocks that are not held out.

    Returns None if fewer than `FEWEST` kinds can be held out.
    """
    described = np.full((count, 3), np.nan)
    for s in stretches:
        at = np.flatnonzero(s.use)
        if at.size:
            edges = np.flatnonzero(np.diff(s.block[at])) + 1
            for part in np.split(at, edges):
                described[s.block[part[0]]] = description(s.u[part[0] : part[-1] + 1])
    return kinds_of(described)


def kinds_of(described: Array) -> Integers | None:
    """
    Group blocks by their description; the kinds have shape (blocks,), with -1 for no kind.

    The description has shape (blocks, k); an unknown block is NaN.  The result may be None, see
    `motion_kinds`.
    """
    known = np.flatnonzero(np.isfinite(described).all(axis=1))
    if known.size < 2 * KINDS:
        return None
    x = described[known]
    spread = x.std(axis=0)
    x = (x - x.mean(axis=0)) / np.where(spread > 0.0, spread, 1.0)
    label = fcluster(linkage(x, 'ward'), KINDS, 'maxclust') - 1
    inside = [k for k in range(KINDS) if (label == k).any() and not _is_edge(x, label == k)]
    if len(inside) < FEWEST:
        return None
    kinds = np.full(described.shape[0], -1)
    kinds[known] = np.where(np.isin(label, inside), label, -1)
    return kinds


def description(u: Array) -> Array:
    """Compute the mean, and logarithms of the size and the speed, of a voltage; shape (3,)."""
    speed = float(np.sqrt(np.mean(np.diff(u) ** 2))) if u.size > 1 else 0.0
    return np.array([u.mean(), np.log(float(u.std()) + FAINT), np.log(speed + FAINT)])


def _is_edge(x: Array, own: Mask) -> bool:
    """Tell whether the mean of a kind lies beyond all other blocks in any property."""
    mean = x[own].mean(axis=0)
    rest = x[~own]
    if not rest.size:
        # all blocks belong to one kind
        return True
    return bool(np.any(mean < rest.min(axis=0)) or np.any(mean > rest.max(axis=0)))

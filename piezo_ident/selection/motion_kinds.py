# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Kinds of motion in a record without labels, from what the voltage does in each block.

A block is described by the mean, the size and the speed of its voltage.  Blocks that are alike
are one kind.  A kind at the edge of place, size or speed is never held out: a model that was
fitted without it would have to extrapolate.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.fitting.stretch import Stretch
from scipy.cluster.hierarchy import fcluster, linkage

#: kinds that are looked for, and the fewest that can be held out in turn (taste)
KINDS, FEWEST = 6, 3
#: least size and speed that are told apart, shares of the range and of the range per sample
FAINT = 1e-4


def interleaved(count: int, sets: int = 5) -> Integers:
    """
    Return the set of each block; neighbours are in different sets, shape (count,).

    Examples
    --------
    >>> interleaved(7, 3).tolist()
    [0, 1, 2, 0, 1, 2, 0]
    """
    return np.arange(count) % sets


def motion_kinds(stretches: Sequence[Stretch], count: int) -> Integers | None:
    """
    Return the kind of motion of each of `count` blocks, -1 for those that are not held out.

    None where fewer than `FEWEST` kinds can be held out.
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
    Return the kind of each block by its description, shape (blocks,), -1 for none.

    The description has shape (blocks, k), nan of a block without one.  None as of `motion_kinds`.
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
    """Return the mean, and logarithms of the size and the speed, of a voltage; shape (3,)."""
    speed = float(np.sqrt(np.mean(np.diff(u) ** 2))) if u.size > 1 else 0.0
    return np.array([u.mean(), np.log(float(u.std()) + FAINT), np.log(speed + FAINT)])


def _is_edge(x: Array, own: Mask) -> bool:
    """Return whether a kind holds the least or the largest of any property."""
    mean = x[own].mean(axis=0)
    rest = x[~own]
    if not rest.size:
        # all blocks move alike
        return True
    return bool(np.any(mean < rest.min(axis=0)) or np.any(mean > rest.max(axis=0)))

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Check an effect in the places where it alone acts.

If H fits poorly, nearly any effect lowers the residual a little.  Creep and drift must therefore
show at rest, where no hysteresis moves.  A drifting gain must show within single motions, where a
gain that depends on the kind of motion stays constant.  In these places the effect must have the
size that was fitted to all data.  The factor

    kappa = 1 + <c, e> / <c, c>

measures this.  Here c is the contribution of the effect and e is the residual with the effect in
the model.  Terms that may differ between rests, or between motions, are projected out of c and e.
kappa is 1 for the right effect, and any number for a wrong effect.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.diagnosis.criteria import SHOWS, STANDARD_ERRORS
from piezo_ident.diagnosis.joint_fit import Fitted
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.residual.stretches import block_means, rests
from scipy.ndimage import uniform_filter1d

#: transients of the dynamics have died away after this time at rest [s]
SETTLED = 0.05
#: smallest number of rows of a rest or a motion
FEWEST = 20
#: time over which the mean, size and speed of a motion are computed [s]
LOCAL = 0.25

#: rows, shape (k,), and columns to project out there, shape (k, p)
Place = tuple[Integers, Array]


def shows(simulator: Simulator, fitted: Fitted, noise: float) -> bool:
    """
    Return whether the last added effect shows in its own places; True if it has no such place.

    The values of the effect must also be plausible.  `noise` is the mean square of the noise of a
    row.
    """
    if fitted.name not in _PLACES:
        return True
    added = fitted.state.effects[-1]
    if not all(added.effect.is_plausible(values) for values in added.values):
        return False
    rows, state = simulator.rows, fitted.state
    y = simulator.run(state)
    c = y - simulator.run(replace(state, effects=state.effects[:-1]))
    products, sizes = np.zeros(rows.edges.size - 1), np.zeros(rows.edges.size - 1)
    for part, free in _PLACES[fitted.name](rows, y):
        Q = np.linalg.qr(free)[0]
        one, e = (x[part] - Q @ (Q.T @ x[part]) for x in (c, fitted.e))
        products += np.bincount(rows.block[part], one * e, products.size)
        sizes += np.bincount(rows.block[part], one * one, sizes.size)
    size = float(sizes.sum())
    if size <= STANDARD_ERRORS**2 * noise or size == 0.0:
        return False
    kappa = 1.0 + float(products.sum()) / size
    # each block is one observation
    spread = products - (kappa - 1.0) * sizes
    error = float(np.sqrt(spread @ spread)) / size
    low, high = SHOWS
    return low <= kappa <= high and kappa > STANDARD_ERRORS * error


def _at_rest(rows: Rows, y: Array) -> Iterator[Place]:
    """Yield the rows of each rest of the command, with a constant to project out."""
    first = 0
    for run, keep in zip(rows.runs, rows.keep, strict=True):
        number = np.cumsum(keep) - 1 + first
        rate = run.piece.sample_rate
        for start, stop in rests(run.piece.v, rate):
            part = slice(-(-(start + round(SETTLED * rate)) // rows.m), stop // rows.m)
            chosen = number[part][keep[part]]
            if chosen.size >= FEWEST:
                yield chosen, np.ones((chosen.size, 1))
        first += int(keep.sum())


def _in_motion(rows: Rows, y: Array) -> Iterator[Place]:
    """
    Yield the rows of each run, and the columns of a gain that depends on the motion.

    The columns are all quadratic functions of the local mean, size and speed of the command, and
    the same functions times the displacement y.
    """
    first = 0
    for run, keep in zip(rows.runs, rows.keep, strict=True):
        u = block_means(run.u, rows.m)
        width = max(3, round(LOCAL * run.piece.sample_rate / rows.m))
        mean = uniform_filter1d(u, width)
        size = np.sqrt(np.maximum(uniform_filter1d(u * u, width) - mean * mean, 0.0))
        speed = np.sqrt(np.maximum(uniform_filter1d(np.gradient(u) ** 2, width), 0.0))
        parts = [x[keep] / max(float(np.abs(x).max()), 1e-12) for x in (mean, size, speed)]
        parts.insert(0, np.ones(parts[0].size))
        chosen = np.arange(first, first + parts[0].size)
        squares = [a * b for i, a in enumerate(parts) for b in parts[i:]]
        if chosen.size >= FEWEST * len(squares):
            yield chosen, np.stack([*squares, *(x * y[chosen] for x in squares)], axis=1)
        first += parts[0].size


_PLACES: dict[str, Callable[[Rows, Array], Iterator[Place]]] = {
    'creep': _at_rest,
    'thermal_drift': _at_rest,
    'gain_drift': _in_motion,
}

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What an effect alone does, looked for where nothing else does it.

A hysteresis that the model does not fit leaves a residual that nearly any effect lowers a little.
So creep and drift must show at rest, where no hysteresis moves, and a drifting gain within single
motions, where a gain that depends on the kind of motion does not change.  There the effect, as
large as it was fitted to all data, has to be what the data show: the factor

    kappa = 1 + <c, e> / <c, c>

of its contribution c, e the residual with it in the model, both without what may differ from rest
to rest or from motion to motion, is 1 for the right effect and anything for a wrong one.
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

#: what dynamics leave behind a motion has died away after this time at rest [s]
SETTLED = 0.05
#: fewest rows of a rest or a motion
FEWEST = 20
#: time over which a motion has a mean, a size and a speed [s]
LOCAL = 0.25

#: rows, shape (k,), and columns of what may differ there, shape (k, p)
Place = tuple[Integers, Array]


def shows(simulator: Simulator, fitted: Fitted, noise: float) -> bool:
    """
    Return whether the effect added last shows where it should; True for one without such a place.

    So it has to with values that can be; `noise` is the mean square of the noise of a row.
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
    """Give the rows of each rest of the command, whose mean is free."""
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
    Give the rows of each run, and what a gain that depends on the motion may do.

    That is any square function of the local mean, size and speed of the command.
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

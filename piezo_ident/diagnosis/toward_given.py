# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What the H as given says of motion that the data do not hold.

Of records without labels, or of one kind, nothing tells how a refit of H does under other motion.
The given one came from motion of its own, so it counts as data, too:

    min  |e|^2 + n mean((h - h_0 - c)^2)

with h and h_0 the new and the given H under loops over the range of the model, n the number of
rows, and c the mean of the difference, which offsets make up for.  It is enough to keep terms that
these rows hardly tell from growing, which make up for one another here and nowhere else.  It does
not count where the data cover a part of the range alone: the refined model holds there only.
"""

from __future__ import annotations

from collections.abc import Callable
import itertools

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.diagnosis.cross_validation import Pull
from piezo_ident.diagnosis.joint_fit import base_at, fit_jointly, Fitted
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import State

#: samples of a sweep over the range
SWEEP = 60


def loops(low: float, high: float) -> Array:
    """Return a motion from `low` through loops that hang from both ends, and some between."""
    turns = [0.0]
    for level in np.arange(1, 7) / 6:
        turns += [level, 0.0]
    turns.append(1.0)
    for level in np.arange(1, 6) / 6:
        turns += [level, 1.0]
    turns.append(0.0)
    for level in (0.3, 0.6, 0.9):
        turns += [level, level - 0.15, level, level - 0.15]
    turns.append(0.0)
    sweeps = [
        np.linspace(a, b, max(2, round(SWEEP * abs(b - a))), endpoint=False)
        for a, b in itertools.pairwise(turns)
    ]
    return low + (high - low) * np.concatenate(sweeps)


def toward_given(
    simulator: Simulator,
    given: State,
    fitted: Fitted,
    tick: Callable[[], None] = lambda: None,
) -> Fitted:
    """Return a fit of rows without kinds of motion, drawn towards the H as given."""
    law, rows, scaling = fitted.state.law, simulator.rows, simulator.model.scaling
    if law is None or rows.kinds or not rows.covers(scaling.range):
        return fitted
    u = loops(*map(float, scaling.u(scaling.range)))
    P = np.stack(list(law.columns(u)), axis=1)
    P -= P.mean(axis=0)
    h = given.hysteresis(u)
    h = h - h.mean()
    P, h = (x / np.sqrt(u.size) for x in (P, h))
    # as much as the rows: a smaller weight gained more here, and lost more under other motion
    weight = float(rows.n)
    A = weight * (P.T @ P)

    def pull_at(state: State, size: int) -> Pull:
        k = law.size
        whole, right = np.zeros((size, size)), np.zeros(size)
        left = h - P @ state.coefficients
        whole[:k, :k], right[:k] = A, weight * (P.T @ left)
        return Pull(whole, right, weight * float(left @ left))

    state = fitted.state
    return fit_jointly(simulator, state, base_at(simulator, state), tick=tick, pull_at=pull_at)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Draw a refitted H to the given H under motion that the data do not hold.

Records without labels, or of one kind of motion, do not test a refitted H under other motion.  The
given H was identified on other motion, so it counts as data, too:

    min  |e|^2 + n mean((h - h_0 - c)^2)

Here h and h_0 are the new and the given H under loops over the range of the model.  n is the
number of rows.  c is the mean difference, which offsets compensate.  The given H keeps terms small
that these rows hardly determine.  Such terms compensate for one another on these rows, but not
elsewhere.  The given H does not count if the data cover only a part of the range: the refined
model then holds in this part only.
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

#: number of samples of a sweep over the range
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
    """Repeat a fit of rows without labelled kinds of motion, drawn to the given H."""
    law, rows, scaling = fitted.state.law, simulator.rows, simulator.model.scaling
    if law is None or rows.kinds or not rows.covers(scaling.range):
        return fitted
    u = loops(*map(float, scaling.u(scaling.range)))
    P = np.stack(list(law.columns(u)), axis=1)
    P -= P.mean(axis=0)
    h = given.hysteresis(u)
    h = h - h.mean()
    P, h = (x / np.sqrt(u.size) for x in (P, h))
    # equal weight of rows and given H: a smaller weight fitted these rows better and other motion
    # worse
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

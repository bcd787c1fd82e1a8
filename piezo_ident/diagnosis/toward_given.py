# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What the H and G as given say of motion that the data do not hold.

Of records without labels, or of one kind, nothing tells how a refit of H does under other motion,
nor how a G retuned along with it does where a mode answers to other frequencies.  The given ones
came from motion of their own, so they count as data, too:

    min  |e|^2 + n mean((h - h_0 - c)^2) + n mean((g - g_0)^2)

with h and h_0 the new and the given H under loops over the range of the model, n the number of
rows, c the mean of the difference, which offsets make up for, and g and g_0 what the new and the
given G make of white noise of 0.01 rms, normalised, up to the band of `Simulator`.  An effect of
the voltage that was there at the identification may have bent both.  Where a refit takes little of
what the effect leaves beside that H, H stays as it was given, and so does G where another one is
not clearly better.  Else both count less: by what the fit leaves of the squares that the given
model leaves.  It is enough to keep terms that these rows hardly tell from growing, which make up
for one another here and nowhere else.  They do not count where the data cover a part of the range
alone: the refined model holds there only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import itertools

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.cross_validation import Pull
from piezo_ident.diagnosis.forward_selection import TESTED
from piezo_ident.diagnosis.joint_fit import base_at, fit_jointly, Fitted, is_better
from piezo_ident.diagnosis.rows import centred
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
    *,
    set_in: bool = False,
) -> Fitted:
    """
    Return a fit of rows without kinds of motion, drawn towards the H as given, or with that H.

    Effects that `set_in` behind the identification have not bent that H.
    """
    law, rows, scaling = fitted.state.law, simulator.rows, simulator.model.scaling
    is_bent = not set_in and any(
        not added.effect.time_driven and added.name not in TESTED for added in fitted.state.effects
    )
    if law is None or rows.kinds or not rows.covers(scaling.range):
        return fitted
    if is_bent:
        known = replace(
            fitted.state,
            hysteresis=given.hysteresis,
            law=given.law,
            coefficients=given.coefficients,
        )
        # one that would leave more stays behind
        goal = fitted.mean_square / (1.0 - criteria.BENT_H)
        beside = fit_jointly(simulator, known, base_at(simulator, known), goal=goal, tick=tick)
        if beside.reached < goal:
            known = replace(beside.state, retuning=())
            plain = fit_jointly(simulator, known, beside.base, tick=tick)
            return beside if is_better(beside, plain) else plain
    u = loops(*map(float, scaling.u(scaling.range)))
    P = np.stack(list(law.columns(u)), axis=1)
    P -= P.mean(axis=0)
    h = given.hysteresis(u)
    h = h - h.mean()
    P, h = (x / np.sqrt(u.size) for x in (P, h))
    # as much as the rows: a smaller weight gained more here, and lost more under other motion
    weight = float(rows.n)
    if is_bent:
        # it is off by what the effect made of it then, and may be by what it leaves now
        e = centred(rows.x - simulator.run(given), rows.of_record)
        weight *= min(1.0, float(fitted.errors.sum()) / max(float(e @ e), 1e-300))
    A = weight * (P.T @ P)
    B = weight * criteria.NOISE_OF_G**2 * simulator.retuning_squares

    def pull_at(state: State, size: int) -> Pull:
        k, first = law.size, law.size + state.only_adds.size
        whole, right = np.zeros((size, size)), np.zeros(size)
        left = h - P @ state.coefficients
        whole[:k, :k], right[:k] = A, weight * (P.T @ left)
        loss = weight * float(left @ left)
        if state.retuning:
            c, of_G = np.array(state.retuning), slice(first, first + len(state.retuning))
            whole[of_G, of_G], right[of_G] = B, -B @ c
            loss += float(c @ B @ c)
        return Pull(whole, right, loss)

    state = fitted.state
    return fit_jointly(simulator, state, base_at(simulator, state), tick=tick, pull_at=pull_at)

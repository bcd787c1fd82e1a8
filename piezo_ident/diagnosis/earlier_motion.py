# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit creep that continues from motion before a record.

A stage creeps for minutes after a motion, so creep has rarely settled at the start of a record.
The remaining creep of element i adds ``A_i exp(-t / tau_i)`` to the displacement, with an
amplitude A_i for each record.  The prediction is linear in the A_i.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from piezo_ident.diagnosis.criteria import SMALLEST_EFFECT
from piezo_ident.diagnosis.equations import held_out_errors, normal_equations, with_columns
from piezo_ident.diagnosis.joint_fit import fit_jointly, Fitted, polished, tried
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import cost_of_decays, CREEP, State
from piezo_ident.effects.creep import AT_ONCE

#: share of the rms error of held-out blocks that may remain with earlier creep
EARLIER_LEAVES = 0.5


def with_earlier_motion(simulator: Simulator, fitted: Fitted) -> Fitted:
    """
    Add creep from earlier motion to a fit with creep, if that helps clearly.

    The earlier creep must lower the error on held-out blocks to `EARLIER_LEAVES` of it.  Its size
    must be possible after motion within the range.
    """
    state = fitted.state
    creep = _creep_of(simulator, state)
    if state.fading or not creep:
        return fitted
    times = tuple(map(float, creep['time_constant']))
    none = np.zeros((len(simulator.rows.names), len(times)))
    start = replace(state, fading=times, earlier=none)
    if not _may_help(simulator, fitted, start):
        return fitted
    rested, crept = (tried(_refitted, simulator, one) for one in (state, start))
    if rested is None or crept is None:
        # a fit fails, so the data do not hold this creep
        return fitted
    is_better = crept.mean_square <= EARLIER_LEAVES**2 * rested.mean_square
    return crept if is_better and _is_possible(simulator, crept.state) else rested


def _may_help(simulator: Simulator, fitted: Fitted, start: State) -> bool:
    """Return whether a first linear step gains at least half of the required gain."""
    rows, E, M = simulator.rows, fitted.e[:, None], fitted.J
    C = simulator.added_columns(start)[:, start.offsets.size :]
    both = with_columns(rows, normal_equations(rows, M, E), M, C, E)
    prior = np.append(fitted.prior[fitted.free], np.full(C.shape[1], cost_of_decays(rows)))
    left = float(held_out_errors(both, rows.fold, prior).sum())
    return left <= 0.5 * (1.0 + EARLIER_LEAVES**2) * float(fitted.errors.sum())


def _creep_of(simulator: Simulator, state: State) -> Mapping[str, Any]:
    """Return the parameters of creep in a state, or in its model; empty without creep."""
    found = [added.values[0] for added in state.effects if added.name == CREEP]
    found += [x.parameters for x in simulator.model.effects if x.name == CREEP]
    return found[0] if found else {}


def _is_possible(simulator: Simulator, state: State) -> bool:
    """Return whether creep can have caused the displacements at the start of each record."""
    # the earlier voltage stayed within the range: a record that begins at the lowest voltage can
    # only sink through creep, and a drift may rise
    rows, values = simulator.rows, _creep_of(simulator, state)
    gains, times = (np.asarray(values[name], np.float64) for name in ('gain', 'time_constant'))
    # faster elements compensate for dynamics
    gain = float(gains[times > AT_ONCE].sum())
    doubt = np.sqrt(rows.square(SMALLEST_EFFECT))
    starts = {k: run.u[0] for run, k in reversed([*zip(rows.runs, rows.record, strict=True)])}
    ends = gain * (np.array(rows.reach) - np.array([[starts[k]] for k in sorted(starts)]))
    left = state.earlier.sum(axis=1)
    return bool(np.all((ends.min(axis=1) - doubt <= left) & (left <= ends.max(axis=1) + doubt)))


def _refitted(simulator: Simulator, state: State) -> Fitted:
    """Fit a state, again and again with fresh columns of H, as long as the error falls."""
    fit = partial(fit_jointly, simulator)
    return polished(fit, fit(state))

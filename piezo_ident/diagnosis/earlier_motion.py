# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What creeps on from motion before a record.

A stage that has moved creeps for minutes, so the elements of creep are hardly at rest when a
record begins.  What each of them still has to go adds ``d_i exp(-t / tau_i)`` to the displacement:
a few numbers of each record, in which the prediction is linear.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from piezo_ident.common.errors import IdentificationError
from piezo_ident.diagnosis.criteria import SMALLEST_EFFECT
from piezo_ident.diagnosis.cross_validation import (
    held_out_errors,
    normal_equations,
    with_columns,
)
from piezo_ident.diagnosis.joint_fit import base_at, cost_of_decays, fit_jointly, Fitted
from piezo_ident.diagnosis.polishing import with_fresh_columns
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import CREEP, State
from piezo_ident.effects.creep import AT_ONCE

#: share of the rms error of held-out blocks that may be left with what creeps on from before
EARLIER_LEAVES = 0.5


def with_earlier_motion(
    simulator: Simulator, fitted: Fitted, tick: Callable[[], None] = lambda: None
) -> Fitted:
    """
    Return a fit in which creep goes on from before each record.

    Without creep, found or in the model, nothing does.  It must predict held-out blocks clearly
    better, and be no more than earlier motion can leave.  `tick` is called between the steps of a
    fit.
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
    try:
        fitted = _settled(simulator, state, tick)
        crept = _settled(simulator, start, tick)
    except IdentificationError:
        # what cannot be fitted is not there
        return fitted
    is_better = crept.mean_square <= EARLIER_LEAVES**2 * fitted.mean_square
    return crept if is_better and _is_possible(simulator, crept.state) else fitted


def _may_help(simulator: Simulator, fitted: Fitted, start: State) -> bool:
    """Return whether a first step towards decays gains half of what they must gain."""
    rows, E, M = simulator.rows, fitted.e[:, None], fitted.J
    C = simulator.added_columns(start)[:, start.offsets.size :]
    both = with_columns(rows, normal_equations(rows, M, E), M, C, E)
    prior = np.append(fitted.prior[fitted.free], np.full(C.shape[1], cost_of_decays(rows)))
    left = float(held_out_errors(both, rows.fold, prior).sum())
    return left <= 0.5 * (1.0 + EARLIER_LEAVES**2) * float(fitted.errors.sum())


def _creep_of(simulator: Simulator, state: State) -> Mapping[str, Any]:
    """Return the parameters of creep in a state or else in its model; nothing without creep."""
    found = [added.values[0] for added in state.effects if added.name == CREEP]
    found += [x.parameters for x in simulator.model.effects if x.name == CREEP]
    return found[0] if found else {}


def _is_possible(simulator: Simulator, state: State) -> bool:
    """
    Return whether creep can have left as much as a record begins with.

    Each element has followed voltages of the range.  A record that begins at the lowest one sinks
    at first; a drift may rise, and by more.
    """
    rows, values = simulator.rows, _creep_of(simulator, state)
    gains, times = (np.asarray(values[name], np.float64) for name in ('gain', 'time_constant'))
    # faster elements make up for dynamics
    gain = float(gains[times > AT_ONCE].sum())
    doubt = np.sqrt(rows.square(SMALLEST_EFFECT))
    starts = {k: run.u[0] for run, k in reversed([*zip(rows.runs, rows.record, strict=True)])}
    ends = gain * (np.array(rows.reach) - np.array([[starts[k]] for k in sorted(starts)]))
    left = state.earlier.sum(axis=1)
    return bool(np.all((ends.min(axis=1) - doubt <= left) & (left <= ends.max(axis=1) + doubt)))


def _settled(simulator: Simulator, state: State, tick: Callable[[], None]) -> Fitted:
    """Return a fit to its end."""
    fitted = fit_jointly(simulator, state, base_at(simulator, state), tick=tick)
    return with_fresh_columns(simulator, fitted, tick)

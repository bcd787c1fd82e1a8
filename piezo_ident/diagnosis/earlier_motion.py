# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What creeps on from motion before a record.

A stage that has moved creeps for minutes, so the elements of creep are hardly at rest when a
record begins.  What each of them still has to go adds ``d_i exp(-t / tau_i)`` to the displacement:
a few numbers of each record, in which the prediction is linear.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from piezo_ident.diagnosis import criteria
from piezo_ident.diagnosis.joint_fit import base_at, fit_jointly, Fitted
from piezo_ident.diagnosis.simulator import Simulator
from piezo_ident.diagnosis.state import State

__all__ = ['with_earlier_motion']

#: effect that goes on when the motion has ended
CREEP = 'creep'


def with_earlier_motion(
    simulator: Simulator, fitted: Fitted, tick: Callable[[], None] = lambda: None
) -> Fitted:
    """
    Return a fit in which creep goes on from before each record.

    Without creep nothing does.  It must predict clearly better, both blocks and kinds of motion
    held out.  `tick` is called between the steps of a fit.
    """
    state = fitted.state
    creeping = [added for added in state.effects if added.name == CREEP]
    if bool(creeping) == bool(state.fading):
        return fitted
    if not creeping:
        return _settled(simulator, replace(state, fading=(), earlier=np.empty(0)), tick)
    times = tuple(map(float, creeping[0].values[0]['time_constant']))
    none = np.zeros((len(simulator.rows.names), len(times)))
    fitted, again = (
        _settled(simulator, start, tick)
        for start in (state, replace(state, fading=times, earlier=none))
    )
    share = criteria.EARLIER_LEAVES**2
    is_better = (
        again.errors.sum() <= share * fitted.errors.sum()
        and again.transfer.sum() <= share * fitted.transfer.sum()
    )
    return again if is_better else fitted


def _settled(simulator: Simulator, state: State, tick: Callable[[], None]) -> Fitted:
    """Return a fit with fresh columns, as long as that gains."""
    fitted = fit_jointly(simulator, state, base_at(simulator, state), tick=tick)
    for _ in range(criteria.POLISHING):
        state = fitted.state
        again = fit_jointly(simulator, state, base_at(simulator, state), tick=tick)
        if again.mean_square > (1.0 - criteria.POLISH) * fitted.mean_square:
            break
        fitted = again
    return fitted

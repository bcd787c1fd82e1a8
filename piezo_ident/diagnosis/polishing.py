# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""When a fit ends: what a step has to gain, and fits with fresh columns of H."""

from __future__ import annotations

from collections.abc import Callable

from piezo_ident.diagnosis.criteria import SMALLEST_EFFECT
from piezo_ident.diagnosis.joint_fit import base_at, fit_jointly, Fitted
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.simulator import Simulator

#: a step that gains less ends a fit: share of the mean square of the noise, or of that of the
#: smallest effect if it is less
OF_LEAST = 0.01
#: size of a difference that means nothing, rms in % of stroke: no weights of H describe a stage to
#: better than that
INDISTINCT = 0.01
#: passes with fresh columns at the end, at most, and the gain that makes another worth it
POLISHING, POLISH = 6, 0.02


def least_gain(rows: Rows, noise: float) -> float:
    """Return the gain that a step of a fit has to bring, beside a noise; both mean squares."""
    return OF_LEAST * min(noise, rows.square(SMALLEST_EFFECT))


def good_enough(rows: Rows, noise: float) -> float:
    """Return below which mean square nothing is left to tell from a noise."""
    return noise + rows.square(INDISTINCT)


def with_fresh_columns(
    simulator: Simulator, fitted: Fitted, tick: Callable[[], None], *, enough: float = 0.0
) -> Fitted:
    """Fit again with the columns of H in the state reached, as long as that gains."""
    for _ in range(POLISHING):
        state = fitted.state
        fresh = fit_jointly(simulator, state, base_at(simulator, state), enough=enough, tick=tick)
        if fresh.mean_square > (1.0 - POLISH) * fitted.mean_square:
            break
        fitted = fresh
    return fitted

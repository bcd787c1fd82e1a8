# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Decide when a fit ends, and repeat fits with fresh columns of H."""

from __future__ import annotations

from collections.abc import Callable

from piezo_ident.diagnosis.criteria import SMALLEST_EFFECT
from piezo_ident.diagnosis.joint_fit import base_at, fit_jointly, Fitted
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.simulator import Simulator

#: a fit ends after a step that gains less than this share of the mean square of the noise, or of
#: the smallest effect if that is smaller
OF_LEAST = 0.01
#: size of a meaningless difference, rms in % of stroke: weights of H never describe a stage more
#: exactly
INDISTINCT = 0.01
#: most repetitions with fresh columns, and the smallest gain that justifies another one
POLISHING, POLISH = 6, 0.02


def least_gain(rows: Rows, noise: float) -> float:
    """Return the smallest useful gain of a step for a given noise; both are mean squares."""
    return OF_LEAST * min(noise, rows.square(SMALLEST_EFFECT))


def good_enough(rows: Rows, noise: float) -> float:
    """Return the mean square below which a residual cannot be separated from the noise."""
    return noise + rows.square(INDISTINCT)


def with_fresh_columns(
    simulator: Simulator, fitted: Fitted, tick: Callable[[], None], *, enough: float = 0.0
) -> Fitted:
    """Repeat a fit with columns of H in the state reached, as long as the error falls."""
    for _ in range(POLISHING):
        state = fitted.state
        fresh = fit_jointly(simulator, state, base_at(simulator, state), enough=enough, tick=tick)
        if fresh.mean_square > (1.0 - POLISH) * fitted.mean_square:
            break
        fitted = fresh
    return fitted

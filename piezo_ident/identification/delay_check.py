# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Check a delay by free runs over noise.

Steps and the ARX loss give too large a delay if the displacement starts slowly or the noise is not
white.  A free run shows this: G can make up for a delay that is too small, but not for a delay
that is too large.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.identification.results import DelayResult
from piezo_ident.identification.step2_dynamics import (
    arx_factor,
    free_run_error,
    instrumental_variables,
)

Signals = tuple[Array, Array]

#: orders (n, n) that are tried, and delays [samples] that are tried below the delays in question
ORDERS = (4, 8, 12)
DELAYS = (0, 2, 4, 6, 8, 10, 13, 16, 20, 25, 30)
#: errors within this share of the smallest error count as equal to it
SLACK = 0.05
#: largest error of the best free run, as a share of the motion, at which it may decide the delay
#: that neither steps nor scan tell
FOLLOWS = 0.5


def checked_delay(result: DelayResult, fitted: Signals, held: Signals) -> DelayResult:
    """
    Choose the delay of steps or of the scan that the free run supports, else another delay.

    A delay holds if its free run errs no more than the best.  The smaller of two delays that hold
    is chosen.  If neither holds, half of the largest delay that holds is chosen.  A result without
    source stays unchanged if the largest delay holds, and either a delay of 0 does not or no
    model follows the noise.  `fitted` is input and output of noise, `held` the noise right behind
    it that judges.
    """
    # a result without source holds only the largest delay of the scan
    told = result.samples if result.source != 'none' else None
    asked = [d for d in (told, result.scan) if d is not None]
    most = max(asked, default=result.samples)
    tried = sorted({*asked, most, *(d for d in DELAYS if d < most)})
    u, y = fitted
    factor = arx_factor(u, y, max(ORDERS), max(ORDERS) + tried[-1])
    # judge behind the fitted noise, so that long ringing has died away
    v, x = (np.concatenate(pair) for pair in zip(fitted, held, strict=True))
    errors = []
    for d in tried:
        models = [factor.dynamics(n, n, d) for n in ORDERS]
        models += [instrumental_variables(u, y, model, d) for model in models]
        errors.append(min(free_run_error(model, d, v, x, u.size) for model in models))
    least = min(errors)
    hold = [d for d, left in zip(tried, errors, strict=True) if left <= (1.0 + SLACK) * least]
    if told is None and most in hold and (0 not in hold or least > FOLLOWS * held[1].std()):
        # the delay may be larger, or no model follows the noise
        return result
    samples = min((d for d in asked if d in hold), default=hold[-1] // 2)
    if samples == told:
        return result
    if samples == result.scan:
        # the loss was scanned in whole samples
        return replace(result, samples=samples, std=0.5, source='scan')
    std = max(hold[-1], 1) / np.sqrt(12.0)
    return replace(result, samples=samples, std=std, source='free run')

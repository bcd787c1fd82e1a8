# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Whether a delay holds in a free run over noise.

An answer that starts slowly, or noise that is not white, makes steps and the ARX loss tell too
large a delay.  G makes up for a delay that is too small, and never for one that is too large.
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

#: orders (n, n), and delays below those that are asked about [samples], that are tried
ORDERS = (4, 8, 12)
DELAYS = (0, 2, 4, 6, 8, 10, 13, 16, 20, 25, 30)
#: share of the least error within which another one is no larger
SLACK = 0.05
#: share of the motion that the best free run may err where a delay is taken that nothing tells
FOLLOWS = 0.5


def upheld(found: DelayResult, fitted: Signals, held: Signals) -> DelayResult:
    """
    Return the delay of steps or of the scan that a free run upholds, else one that it allows.

    Of two that hold the smaller goes; where none does, half of the largest that does.  What has no
    source stays so where the largest that is tried holds and none at all does not, or where that
    holds and no model follows the noise.  `fitted` and `held` are input and output of noise, to
    fit and right behind that to judge by.
    """
    # a delay of no source is but the largest that is tried
    told = found.samples if found.source != 'none' else None
    asked = [d for d in (told, found.scan) if d is not None]
    most = max(asked, default=found.samples)
    tried = sorted({*asked, most, *(d for d in DELAYS if d < most)})
    u, y = fitted
    factor = arx_factor(u, y, max(ORDERS), max(ORDERS) + tried[-1])
    # what rings for long has died away where it is judged
    v, x = (np.concatenate(pair) for pair in zip(fitted, held, strict=True))
    errors = []
    for d in tried:
        models = [factor.dynamics(n, n, d) for n in ORDERS]
        models += [instrumental_variables(u, y, model, d) for model in models]
        errors.append(min(free_run_error(model, d, v, x, u.size) for model in models))
    least = min(errors)
    hold = [d for d, left in zip(tried, errors, strict=True) if left <= (1.0 + SLACK) * least]
    if told is None and most in hold and (0 not in hold or least > FOLLOWS * held[1].std()):
        # it may well be larger, or nothing follows the noise at all
        return found
    samples = min((d for d in asked if d in hold), default=hold[-1] // 2)
    if samples == told:
        return found
    if samples == found.scan:
        # the loss was scanned in whole samples
        return replace(found, samples=samples, std=0.5, source='scan')
    std = max(hold[-1], 1) / np.sqrt(12.0)
    return replace(found, samples=samples, std=std, source='free run')

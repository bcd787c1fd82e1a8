# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Whether a delay holds in a free run: over noise, or behind H over slow motion.

An answer that starts slowly, or noise that is not white, makes steps and the ARX loss tell too
large a delay.  G makes up for a delay that is too small, and never for one that is too large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.identification.prepare import Excerpt
from piezo_ident.identification.results import DelayResult
from piezo_ident.identification.step2_dynamics import (
    arx_factor,
    free_run_error,
    instrumental_variables,
)
from piezo_ident.identification.step3_hysteresis import factorise, fit_hysteresis
from piezo_ident.operators.dynamics import Delay, Dynamics

Signals = tuple[Array, Array]

#: orders (n, n), and delays below those that are asked about [samples], that are tried
ORDERS = (4, 8, 12)
DELAYS = (0, 2, 4, 6, 8, 10, 13, 16, 20, 25, 30)
#: share of the least error within which another one is no larger
SLACK = 0.05
#: share of the motion that the best free run may err where a delay is taken that nothing tells
FOLLOWS = 0.5
#: share of the error without a delay that one may leave behind H, as creep and other lags take a
#: part of it, too; a matter of taste
LEAVES = 0.5
#: share of its rms by which a voltage may move in half the largest delay for its error to have one
#: broad minimum over the delay
SLOW = 0.3


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


def delay_behind(
    fitted: Sequence[Excerpt], judged: Sequence[Excerpt], thresholds: Array
) -> DelayResult | str:
    """
    Return the delay that a free run of H alone shows in any motion, or why it shows none.

    `fitted` and `judged` are the same runs in the same order with the samples to fit and to judge
    by.  A hysteresis has a lag of its own, but one that does not change with the speed, nor with
    the size of a loop as that of a delay does.
    """
    n = max(1, int(sum(e.use.sum() for e in judged)))
    errors: dict[int, float] = {}

    def error(d: int) -> float:
        if d not in errors:
            fit, left = (
                factorise(part, thresholds, Dynamics.unit(), Delay(d)) for part in (fitted, judged)
            )
            errors[d] = 100.0 * np.sqrt(fit_hysteresis(fit, thresholds).left(left) / n)
        return errors[d]

    most = DELAYS[-1]
    half = most // 2
    moved = [np.std(e.u[half:] - e.u[:-half]) / e.u.std() for e in judged if e.u.size > most]
    is_slow = bool(max(moved, default=0.0) < SLOW)
    few = sorted(map(error, (0, half, most)))
    # of fast motion one delay may do alone
    if is_slow and few[-1] <= (1.0 + SLACK) * few[0]:
        return (
            f'delays of 0 to {most} samples predict the data held out alike, to {few[0]:.3g} .. '
            f'{few[-1]:.3g} % of stroke'
        )
    best = min(DELAYS if is_slow else range(most + 1), key=error)
    while better := [d for d in (best - 1, best + 1) if 0 <= d < most and error(d) < error(best)]:
        best = min(better, key=error)
    like = sorted(d for d in errors if errors[d] <= (1.0 + SLACK) * errors[best])
    told = f'from {errors[0]:.3g} to {errors[best]:.3g} % of stroke'
    if best == 0 and errors[0] <= LEAVES * error(1):
        return DelayResult(0, 1.0 / np.sqrt(12.0), 'free run')
    if like[0] == 0:
        return (
            f'{like[-1] + 1} samples of delay move the error on the data held out from '
            f'{errors[0]:.3g} to {error(like[-1] + 1):.3g} % of stroke'
        )
    if best == most:
        return f'the error falls up to the largest delay that is tried, {most} samples, {told}'
    if errors[best] > LEAVES * errors[0]:
        return (
            f'no delay halves the error on the data held out; {best} samples bring it {told}, '
            'and may stand for a lag of another kind'
        )
    return DelayResult(best, (1.0 + like[-1] - like[0]) / np.sqrt(12.0), 'free run')

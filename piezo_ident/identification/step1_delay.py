# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Step 1: find the pure delay from steps, and check it by a scan of the ARX loss.

The step responses are divided by the signed height of their steps and averaged.  The delay is the
first of two samples at which the average exceeds five standard deviations of its noise.  The scan
fits ARX models to the steps, else to the noise, and takes the largest delay of about the least
loss.  If steps and scan differ, or the scan fails, free runs over the noise decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.common.arrays import Array, Integers, interpolated
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.prepare import Run
from piezo_ident.identification.settings import Progress, Settings
from piezo_ident.identification.solvers.arx import (
    arx_factor,
    factor_of,
    free_run_error,
    instrumental_variables,
)
from piezo_ident.identification.spectra import band_of, longest_noise, noise_segment
from piezo_ident.record.record import Piece

#: the average response counts as risen at this many standard deviations of its noise
THRESHOLD = 5.0
#: losses within this share of the smallest loss count as equal to it
EQUAL = 0.02
#: number of delays [samples] that the scan tries, and the orders na = nb of its models
MAX_DELAY, SCAN_ORDER = 30, 8

#: orders (n, n) that are tried, and delays [samples] that are tried below the proposed delays
CHECK_ORDERS = (4, 8, 12)
CHECK_DELAYS = (0, 2, 4, 6, 8, 10, 13, 16, 20, 25, 30)
#: errors within this share of the smallest error count as equal to it
SLACK = 0.05
#: largest error of the best free run, as a share of the motion.  Up to this error the free run may
#: decide if steps and scan both fail
FOLLOWS = 0.5

Signals = tuple[Array, Array]


@dataclass(frozen=True, eq=False)
class StepDelay:
    """
    Delay read from steps.

    Attributes
    ----------
    samples : int or None
        Delay d; None if all responses stay within the noise.
    std : float
        Standard deviation over repeats [samples], by leaving out each repeat once (jackknife).
        The resolution of the sampling clock, 1/sqrt(12), is its smallest value.
    repeats : int
        Number of steps averaged.
    noise : float
        Standard deviation of the averaged response before the step [m/V].
    threshold : float
        Level at which the response counts as risen [m/V].
    lag, response : ndarray, shape (n,)
        Samples after the step, and the averaged response there [m/V].
    """

    samples: int | None
    std: float
    repeats: int
    noise: float
    threshold: float
    lag: Integers
    response: Array


@dataclass(frozen=True, eq=False)
class DelayResult:
    """
    Result of step 1.

    Attributes
    ----------
    samples : int
    std : float
        Standard deviation [samples]; infinite if it is unknown.
    source : {'steps', 'scan', 'free run', 'given', 'none'}
    step : StepDelay or None
    loss : ndarray or None
        One-step ARX loss for d = 0, 1, ...
    scan : int or None
        Delay from this loss [samples].
    """

    samples: int
    std: float
    source: str
    step: StepDelay | None = None
    loss: Array | None = None
    scan: int | None = None

    @property
    def agree(self) -> bool | None:
        """Whether steps and scan agree within a sample; None if one of them is missing."""
        if self.step is None or self.step.samples is None or self.scan is None:
            return None
        return abs(self.step.samples - self.scan) <= 1

    @property
    def unknown(self) -> DelayResult:
        """Same steps and scan with a delay of 0, for a model that errs less without a delay."""
        return replace(self, samples=0, std=float('inf'), source='none')


def find_jumps(v: Array, before: int, after: int) -> Integers:
    """
    Find the samples at which v jumps after a quiet stretch.

    A jump is a difference of neighbouring samples.  It exceeds a quarter of the largest
    difference, and twenty times every difference within the `before` samples ahead of it.  The
    result holds the first sample behind each jump with `before` samples ahead and `after` behind.

    Examples
    --------
    >>> find_jumps(np.repeat([0.0, 1.0, 0.0], 50), before=20, after=20)
    array([ 50, 100])
    """
    dv = np.abs(np.diff(v))
    if dv.size == 0 or dv.max() == 0.0:
        return np.empty(0, dtype=np.int64)
    large = np.flatnonzero(dv > 0.25 * dv.max()) + 1
    large = large[(large >= before) & (large + after <= v.size)]
    if large.size == 0 or before < 2:
        return np.asarray(large, dtype=np.int64)
    # ahead[k - before] is the largest difference between the samples k - before .. k - 1
    ahead = np.lib.stride_tricks.sliding_window_view(dv, before - 1).max(axis=1)
    quiet = ahead[large - before] < 0.05 * dv[large - 1]
    return np.asarray(large[quiet], dtype=np.int64)


def step_responses(
    pieces: Sequence[Piece], before: int = 100, after: int = 60
) -> tuple[Array, Array]:
    """
    Cut out the step responses [m/V], one a row, and the height of each step [V].

    A response reaches from `before` samples ahead of its step to `after` samples behind it.  The
    shapes are (repeats, before + after) and (repeats,).  A lost reading is NaN.
    """
    rows, heights = [], []
    for piece in pieces:
        for k in find_jumps(piece.v, before, after):
            height = piece.v[k] - piece.v[k - 1]
            near = slice(k - before, k + after)
            y = np.where(piece.mask[near], piece.y[near], np.nan)
            rest = np.flatnonzero(np.isfinite(y[:before]))
            if rest.size < 3:
                continue
            # a stage that still settles before the step goes on settling under the response
            line = np.polynomial.Polynomial.fit(rest, y[rest], 1, domain=[0, before - 1])
            rows.append((y - line(np.arange(before + after))) / height)
            heights.append(abs(height))
    return np.array(rows).reshape(-1, before + after), np.array(heights)


def _mean(responses: Array, weight: Array) -> Array:
    """Average step responses at each lag with weights, over the known readings."""
    known = np.isfinite(responses)
    total = weight @ known
    sums = weight @ np.where(known, responses, 0.0)
    return interpolated(sums / np.where(total > 0.0, total, 1.0), total == 0.0)


def _first_rise(mean: Array, before: int, rounding: float) -> tuple[int | None, float, float]:
    noise = float(np.std(mean[:before], ddof=2))
    # a quantised, noise-free record still has the rounding of its last digit
    threshold = THRESHOLD * max(noise, rounding, 1e-6 * float(np.abs(mean[before:]).max()))
    sign = np.sign(mean[before:].sum())
    risen = sign * mean[before:] > threshold
    # one sample above the threshold may be chance, two in a row are not
    both = np.flatnonzero(risen[:-1] & risen[1:])
    return (int(both[0]) if both.size else None), noise, threshold


def delay_from_steps(pieces: Sequence[Piece], before: int = 100, after: int = 60) -> StepDelay:
    """
    Find the pure delay from the steps in some pieces, with samples before and after each.

    Examples
    --------
    >>> v = np.repeat([0.0, 1.0], 200)
    >>> delay_from_steps([Piece(v, np.roll(v, 3), 1000.0)]).samples
    3
    """
    responses, heights = step_responses(pieces, before, after)
    lag = np.arange(-before, after)
    n = heights.size
    # a line fits two samples exactly, so their noise would be zero
    if n == 0 or before < 3:
        empty = np.zeros(before + after)
        return StepDelay(None, float('inf'), 0, float('nan'), float('nan'), lag, empty)
    # the noise of a response in m/V falls with the height of its step, so the weight is its square
    weight = heights**2 / np.sum(heights**2)
    mean = _mean(responses, weight)
    # a constant displacement minus its line leaves rounding
    largest = max(float(np.abs(piece.y).max()) for piece in pieces)
    rounding = 1e-12 * largest / float(heights.max())
    samples, noise, threshold = _first_rise(mean, before, rounding)
    std = 1.0 / np.sqrt(12.0)
    if samples is None:
        std = float('inf')
    elif n > 2:
        rest = (_mean(np.delete(responses, i, 0), np.delete(weight, i)) for i in range(n))
        left_out = [_first_rise(mean_of_rest, before, rounding)[0] for mean_of_rest in rest]
        delays = np.array([after if s is None else s for s in left_out], dtype=float)
        jackknife = np.sqrt((n - 1) / n * np.sum((delays - delays.mean()) ** 2))
        std = max(std, float(jackknife))
    return StepDelay(samples, std, n, noise, threshold, lag, mean)


def no_step(step: StepDelay | None) -> str:
    """Say why the steps do not tell the delay: they are absent, or stay within the noise."""
    if step is None or not step.repeats:
        return 'there are no steps out of a rest'
    return f'no step rises above the sensor noise within {step.lag[-1] + 1} samples'


def delay_from_loss(loss: Array) -> int | None:
    """
    Read the delay from a scan of the ARX loss.

    A model with too small a delay contains the true model if it has enough numerator
    coefficients.  The loss for d = 0, 1, ... therefore stays low up to the true delay and rises
    behind it.  The result is None if the loss is still low at the largest delay.

    Examples
    --------
    >>> delay_from_loss(np.array([1.0, 1.0, 1.01, 3.0, 9.0]))
    2
    """
    low = np.flatnonzero(loss <= (1.0 + EQUAL) * loss.min())
    return int(low[-1]) if low[-1] < loss.size - 1 else None


def checked_delay(result: DelayResult, fitted: Signals, held: Signals) -> DelayResult:
    """
    Check the delays of steps and scan by free runs over noise; replace them if both fail.

    Steps and scan give too large a delay if the displacement starts slowly or the noise is not
    white.  G can make up for too small a delay, but not for too large a delay.  A delay holds if
    the error of its free run is within `SLACK` of the smallest error.  The rule has three cases:

    - The delay of steps or scan holds: choose it, and the smaller delay if both hold.
    - The delays of steps and scan fail: choose half of the largest delay that holds.
    - Steps and scan fail to give a delay (source 'none'): keep the result if the largest delay
      holds and the delay 0 fails, as the true delay may be larger.  Also keep it if the largest
      delay holds, and the best free run errs by more than `FOLLOWS` of the motion.  Otherwise
      choose half of the largest delay that holds.

    `fitted` holds input and output of noise.  The noise right behind it, `held`, gives the errors.
    """
    # a result without source holds only the largest delay of the scan
    told = result.samples if result.source != 'none' else None
    proposed = [d for d in (told, result.scan) if d is not None]
    most = max(proposed, default=result.samples)
    tried = sorted({*proposed, most, *(d for d in CHECK_DELAYS if d < most)})
    u, y = fitted
    factor = arx_factor(u, y, max(CHECK_ORDERS), max(CHECK_ORDERS) + tried[-1])
    # judge behind the fitted noise, so that long ringing has died away
    v, x = (np.concatenate(pair) for pair in zip(fitted, held, strict=True))
    errors = []
    for d in tried:
        models = [factor.dynamics(n, n, d) for n in CHECK_ORDERS]
        models += [instrumental_variables(u, y, model, d) for model in models]
        errors.append(min(free_run_error(model, d, v, x, u.size) for model in models))
    least = min(errors)
    hold = [d for d, left in zip(tried, errors, strict=True) if left <= (1.0 + SLACK) * least]
    if told is None and most in hold and (0 not in hold or least > FOLLOWS * held[1].std()):
        # the true delay may be larger, or the models do not follow the noise
        return result
    samples = min((d for d in proposed if d in hold), default=hold[-1] // 2)
    if samples == told:
        return result
    if samples == result.scan:
        # the loss was scanned in whole samples
        return replace(result, samples=samples, std=0.5, source='scan')
    std = max(hold[-1], 1) / np.sqrt(12.0)
    return replace(result, samples=samples, std=std, source='free run')


def first_step(runs: Sequence[Run], settings: Settings, progress: Progress) -> DelayResult:
    """
    Find the delay from the steps; if the steps do not tell it, find it by a scan of the ARX loss.

    Free runs over the noise decide if steps and scan differ by more than a sample, or if the scan
    fails.  Raises IdentificationError if no method tells the delay.
    """
    progress('delay', 0.0)
    if settings.delay is not None:
        return DelayResult(settings.delay, float('inf'), 'given')
    pieces = [run.piece.cut(s.start, s.stop) for run in runs for s in run.piece.find('step')]
    step = delay_from_steps(pieces) if pieces else None
    # scan the steps first: they have power at all frequencies, while noise up to f leaves an
    # uncertainty of half a period of f
    loss = _scan(runs, 'step') if pieces else None
    if loss is None:
        loss = _scan(runs, 'noise')
    scan = None if loss is None else delay_from_loss(loss)
    progress('delay', 1.0)
    has_noise = any(run.piece.find('noise') for run in runs)
    if step is not None and step.samples is not None:
        result = DelayResult(step.samples, step.std, 'steps', step, loss, scan)
        return _checked_delay(result, runs) if has_noise and not result.agree else result
    if scan is None:
        result = DelayResult(MAX_DELAY, float('inf'), 'none', step, loss)
        if loss is not None and has_noise:
            result = _checked_delay(result, runs)
        if result.source != 'none':
            return result
        what = 'too short to scan' if loss is None else f'that hides it below {MAX_DELAY} samples'
        raise IdentificationError(
            f'delay: {no_step(step)}, and a drive {what}; add larger steps, or set --delay'
        )
    run, start, stop = longest_noise(runs)
    std = 0.5 * run.piece.sample_rate / band_of(run, start, stop)
    result = DelayResult(scan, std, 'scan', step, loss, scan)
    # periodic steps have the same loss at a delay that is longer by the time between two steps
    return _checked_delay(result, runs) if has_noise and pieces else result


def _checked_delay(result: DelayResult, runs: Sequence[Run]) -> DelayResult:
    run, start, stop = longest_noise(runs)
    noise = noise_segment(run, run.u, start, stop)
    return checked_delay(result, noise.fitted, noise.held)


def _scan(runs: Sequence[Run], kind: str) -> Array | None:
    """Compute the one-step loss for each delay, from all segments of a kind."""
    lags, parts = SCAN_ORDER + MAX_DELAY, []
    for run in runs:
        for s in run.piece.find(kind):
            if s.n >= 4 * (SCAN_ORDER + lags + 1):
                u, y = run.u[s.start : s.stop], run.x[s.start : s.stop]
                parts.append((u - u[0], y - y[:20].mean()))
    return factor_of(parts, SCAN_ORDER, lags).losses(SCAN_ORDER, MAX_DELAY) if parts else None

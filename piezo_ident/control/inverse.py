# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Invert a model: find the voltage that moves it along a wanted displacement.

The inverse of G (`linear_inverse`) and the inverse of H (`hysteresis_inverse`) give a first
voltage.  Effects such as creep or a nonlinear sensor leave an error, which a fixed-point iteration
removes,

    w <- w + Q (y_wanted - y(u)),        u = H^-1 w,

where Q is the inverse of G and y(u) is the free run of the whole model.  After a pass that hardly
reduces a large error, the step is halved.  The iteration converges if the effects are small beside
the stage.  An amplifier lag before H is inverted with H, and so are plays that widen with speed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import DataError
from piezo_ident.common.showable import Showable
from piezo_ident.control.expectation import expect
from piezo_ident.control.hysteresis_inverse import HysteresisInverse, with_rising_hysteresis
from piezo_ident.control.inputs import (
    check_rate,
    checked_limits,
    checked_motion,
    extrapolated,
    faint,
    padded,
    rest_at,
    shifted,
    tolerance,
)
from piezo_ident.control.linear_inverse import linear_inverse, LinearInverse, lowest_mode
from piezo_ident.control.rate_inverse import RateInverse
from piezo_ident.effects.amplifier_lag import AmplifierLag
from piezo_ident.effects.rate_dependent_hysteresis import RateDependentHysteresis
from piezo_ident.model.metrics import percent, percent_of_stroke
from piezo_ident.model.stage_model import StageModel
from scipy.ndimage import maximum_filter1d

#: most passes of the iteration
PASSES = 30
#: rms error [of the span of the wanted motion] at which the iteration ends
EXACT = 1e-5
#: a pass that leaves more than this share of the error halves the step, or ends the iteration if
#: the error is below `MATTERS`
PASS_LEAVES = 0.9
#: the iteration ends when the share of a step falls below
SHORTEST = 0.2
#: A larger error than `MATTERS`, as a share of the span of the motion, counts as a miss.  A span
#: above `LARGE` [spans of the model] counts as `LARGE`
MATTERS, LARGE = 1e-3, 0.1
#: span of a constant motion, normalised
STANDS = 1e-9
#: difference of two neighbouring samples that is a jump [of the span of the motion]
JUMPS = 0.05
#: The lead is cut off while the voltage changes by less than a number of `STILL` [of the span of
#: the model], tried in this order.  The cut may move the motion by at most `RESTS` [of its span]
STILL, RESTS = (1e-5, 1e-6, 1e-7, 1e-8), 1e-4


@dataclass(frozen=True, eq=False, repr=False)
class Inverse(Showable):
    """
    A voltage, and the displacement of the model under this voltage.

    Attributes
    ----------
    model : StageModel
        The inverted model.
    t, v : ndarray, shape (n,)
        Time [s] and voltage [V].  The wanted motion begins at 0; the voltage may begin earlier.
    wanted, predicted : ndarray, shape (n,)
        Wanted displacement, and displacement of the model under v [m].
    lead : int
        Samples by which the voltage begins before the wanted motion.
    clipped : ndarray of bool, shape (n,)
        Samples at which a limit keeps the model from the wanted motion.
    passes : int
        Free runs of the model that the iteration took.
    error : float
        100 rms(wanted - predicted) / (max wanted - min wanted), without the lead: the error of the
        inversion alone.  For a constant motion the span of the model replaces the denominator.
    expected : float or None
        Expected error of the stage about its mean [% as `error`]; None if the error of the model
        is unknown.  The squares of three parts add up: the error of the model on its worst kind
        of motion (from its diagnosis or identification), the motion above the lowest mode, and
        late creep.
    expected_rms : float or None
        The same in metres.
    expected_offset : float or None
        Mean error of the stage through late creep, if it waits for one second at the beginning
        [m]; None if the model lacks creep.
    warnings : tuple of str

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> model = pi.SimulatedStage.load('paper').model
    >>> drive = model.inverse(np.linspace(20e-6, 30e-6, 500))
    >>> bool(drive.t[drive.lead] == 0.0), bool(drive.clipped.any())
    (True, False)
    """

    model: StageModel
    t: Array
    v: Array
    wanted: Array
    predicted: Array
    lead: int
    clipped: Mask
    passes: int
    error: float
    expected: float | None
    expected_rms: float | None
    expected_offset: float | None
    warnings: tuple[str, ...]

    @property
    def errors(self) -> Mapping[str, float | None]:
        """Error of the inversion alone, and expected error of the stage."""
        return {'inversion': self.error, 'expected': self.expected}


def invert(
    model: StageModel,
    wanted: ArrayLike,
    *,
    limits: tuple[float, float] | None = None,
    slew: float = np.inf,
    clip: bool = False,
    channels: Mapping[str, ArrayLike] | None = None,
    sample_rate: float | None = None,
    like: Inverse | None = None,
) -> Inverse:
    """
    Find the voltage under which a model of one axis moves as wanted; see `piezo_ident.invert`.

    Parameters
    ----------
    limits : tuple of float, optional
        Lowest and highest voltage [V].  Default: the identified range.
    slew : float, optional
        Largest speed of the voltage [V/s].
    clip : bool, optional
        Come as near as the limits allow, instead of refusing.
    sample_rate : float, optional
        Sampling rate of the wanted motion [Hz], to be checked against the rate of the model.
    like : Inverse, optional
        Inverse of a similar motion.  The search begins there if plays widen with speed.

    Returns
    -------
    Inverse

    Raises
    ------
    DataError
        When the wanted motion is out of reach, or is not a vector of finite numbers.
    ModelError
        When the model has no inverse.
    """
    y = checked_motion(wanted)
    check_rate(model.sample_rate, sample_rate)
    task = _task(model, y, checked_limits(model, limits, slew), clip, channels or {})
    if like is not None and isinstance(task.H, RateInverse):
        around = task.Q.ahead - like.lead, task.Q.behind
        task.H.begin_at(np.pad(model.scaling.u(like.v), around, mode='edge'))
    return _described(task, *_iterate(task))


def _described(task: _Task, best: _Pass, passes: int) -> Inverse:
    """Cut and judge the best pass; raise DataError if the limits do not reach the motion."""
    model, s, y = task.model, task.model.scaling, task.wanted
    used, v, predicted = _without_rest(task, best)
    lead, warnings = task.Q.ahead - used.start, list(task.warnings)
    largest = maximum_filter1d(np.abs(best.error), task.near)[used]
    missed = best.missed[used] & (largest > task.small)
    if missed.any():
        most = abs(s.Y) * float(largest[missed].max())
        warnings.append(_out_of_reach(task, best, used, missed, most))
        if not task.clip and most > tolerance(model, y):
            raise DataError('; '.join([*warnings, *faint(model, y)]), options='--clip')
    error = best.error[used][~maximum_filter1d(missed, task.near)]
    left = float(np.sqrt(np.mean(error**2))) / task.span if error.size else 0.0
    expected = expect(model, v, y)
    relative = 0.0 if expected.rms is None else expected.rms / abs(s.Y) / task.span
    if left > max(MATTERS, relative):
        warnings.append(
            f'the drive misses {100 * left:.2g} % of the wanted motion within all limits: the '
            'motion is faster than the stage, or jumps, or no voltage makes up for an effect or a '
            'line'
        )
    span = task.span * abs(s.Y)
    return Inverse(
        model=model,
        t=task.t[used],
        v=v,
        wanted=np.pad(y, (lead, 0), mode='edge'),
        predicted=predicted,
        lead=lead,
        clipped=missed,
        passes=passes,
        error=percent_of_stroke(y, predicted[lead:], span),
        expected=None if expected.rms is None else percent(expected.rms, span),
        expected_rms=expected.rms,
        expected_offset=expected.offset,
        warnings=(*warnings, *extrapolated(model, v, y), *expected.warnings),
    )


@dataclass(frozen=True, eq=False)
class _Task:
    """
    A motion `wanted` [m] with rest before and after it, in which the voltage may already move.

    `bounds` are lowest and highest voltage [V], and slew [V/s].  The motion with the rest around
    it, `x`, its `span`, the error that counts as a miss, `small`, and the voltage at which the
    motion begins, `rest`, are normalised.  `warnings` say if H differs from that of the model.
    """

    model: StageModel
    wanted: Array
    bounds: tuple[float, float, float]
    clip: bool
    H: HysteresisInverse | RateInverse
    Q: LinearInverse
    rest: float
    x: Array
    t: Array
    channels: Mapping[str, Array]
    span: float
    small: float
    warnings: tuple[str, ...]

    @property
    def near(self) -> int:
        """Width of the neighbourhood in which Q spreads an error [samples]."""
        return 2 * self.Q.reach + 1


class _Pass(NamedTuple):
    """Voltage of a pass, error of the model, samples with H out of reach, and H; normalised."""

    u: Array
    error: Array
    missed: Mask
    reached: Array


def _task(
    model: StageModel,
    y: Array,
    bounds: tuple[float, float, float],
    clip: bool,
    channels: Mapping[str, ArrayLike],
) -> _Task:
    """Prepare the inversion within bounds (lowest, highest voltage, slew)."""
    s, (low, high, slew) = model.scaling, bounds
    inverted, warnings = with_rising_hysteresis(model)
    ends = float(s.u(low)), float(s.u(high))
    H, linear = _of_hysteresis(inverted, ends, slew / s.V / model.sample_rate)
    Q = linear_inverse(linear, iterated=True)
    if not s.v(H.limits[0]) < s.v(H.limits[1]):
        raise DataError(
            f'invert: the limits lie outside {s.range[0]:g} .. {s.range[1]:g} V, for which the '
            'model holds; give others'
        )
    rest, around = rest_at(model, y, H.limits, clip), (Q.ahead, Q.behind)
    x = np.pad(s.x(y), around, mode='edge')
    span = float(np.ptp(x)) if np.ptp(x) > STANDS else 1.0
    return _Task(
        model,
        y,
        bounds,
        clip,
        H,
        Q,
        rest,
        x,
        (np.arange(x.size) - Q.ahead) / model.sample_rate,
        padded(channels, y.size, around),
        span,
        MATTERS * min(span, LARGE),
        warnings,
    )


def _iterate(task: _Task) -> tuple[_Pass, int]:
    """Iterate while the error falls enough; return the best pass and the number of passes."""
    s = task.model.scaling
    counts = np.ones(task.x.size, dtype=np.bool_)
    w = task.H.reset(task.rest) + task.Q(task.x - task.x[0])
    least, passes, share = np.inf, 0, 1.0
    while passes < PASSES:
        task.H.reset(task.rest)
        u, reached = task.H.process(w)
        y = task.model.stream().process(s.v0 + s.V * u, task.t, task.channels)
        now = _Pass(u, task.x - s.x(y), np.abs(w - reached) > task.small, reached)
        if passes == 0 and not now.missed.all():
            # a part out of reach must not hide the convergence of the rest
            within = ~maximum_filter1d(now.missed, task.near)
            counts = within if within.any() else counts
        passes += 1
        rms = float(np.sqrt(np.mean(now.error[counts] ** 2))) / task.span
        falls_enough = rms < PASS_LEAVES * least
        if rms < least:
            least, best = rms, now
        if rms < EXACT:
            break
        if not falls_enough:
            # a large error that grows comes from a step that was too long
            share *= 0.5
            if least < MATTERS or share < SHORTEST:
                break
        w = best.reached + share * task.Q(best.error)
    return best, passes


def _without_rest(task: _Task, best: _Pass) -> tuple[slice, Array, Array]:
    """Cut off the tail and the lead at rest; return samples, voltage and displacement."""
    s, lead = task.model.scaling, task.Q.ahead
    for still in (*STILL, 0.0):
        moves = np.flatnonzero(np.abs(best.u - task.rest) > still * min(task.span, 1.0))
        first = min(lead, int(moves[0]) - 1 if moves.size else lead)
        used = slice(max(first, 0), lead + task.wanted.size)
        # rounding must not cross a limit
        v = np.clip(s.v0 + s.V * best.u[used], *task.bounds[:2])
        channels = {name: z[used] for name, z in task.channels.items()}
        predicted = task.model.stream().process(v, task.t[used], channels)
        moved = task.x[used] - best.error[used] - s.x(predicted)
        if np.abs(moved).max() < RESTS * task.span:
            break
    return used, v, predicted


def _out_of_reach(task: _Task, best: _Pass, used: slice, missed: Mask, most: float) -> str:
    """Describe the samples out of reach, their largest error `most` [m], and a remedy."""
    s, (low, high), slew = task.model.scaling, task.H.limits, task.bounds[2]
    x, t = task.x[used], task.t[used][missed]
    at_top = best.u[used][missed] > 0.5 * (low + high)
    jumps = maximum_filter1d(np.abs(np.diff(x, append=x[-1])), task.near)[missed]
    remedy = ''
    if jumps.max() > JUMPS * task.span:
        mode = lowest_mode(task.model)
        ways = 'slow it down', f'round it over two periods of the lowest mode, {mode:.4g} Hz'
        remedy = f'; the motion jumps there: {ways[bool(np.isfinite(mode))]}'
    elif np.isinf(slew) and (at_top.all() or not at_top.any()):
        ends = [float(task.model.chain().reset(u, u)) for u in (low, high)]
        size, reach = (abs(s.Y) * float(np.ptp(of)) for of in (x, ends))
        remedy = f'; {shifted(-most if at_top[0] == (s.Y > 0.0) else most, size, reach)}'
    speed = '' if np.isinf(slew) else f' and at {slew:g} V/s'
    return (
        f'{t.size} samples of the wanted motion, between {t[0]:.4g} and {t[-1]:.4g} s, are out of '
        f'reach within {s.v(low):g} .. {s.v(high):g} V{speed}: by up to {1e6 * most:.3g} um'
        f'{remedy}'
    )


def _of_hysteresis(
    model: StageModel, ends: tuple[float, float], step: float
) -> tuple[HysteresisInverse | RateInverse, StageModel]:
    """Invert H with plays that widen or an amplifier lag; return the other parts as a model."""
    h, rate, pole, linear = model.hysteresis, model.sample_rate, 0.0, model
    wide = [s for s in model.effects if s.name == RateDependentHysteresis.name]
    lag = [s for s in model.effects_in('input') if s.name == AmplifierLag.name]
    if h.relaxations is not None:
        wide = []
    if lag and not wide:
        pole = AmplifierLag(rate, lag[0].parameters).pole
        linear = replace(model, effects=tuple(s for s in model.effects if s is not lag[0]))
    if wide:
        return RateInverse(h, wide[0].parameters, rate, ends, step), linear
    return HysteresisInverse(h, ends, step, pole), linear

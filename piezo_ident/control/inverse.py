# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The voltage under which a model moves as wanted.

The inverse of G and of H come one after the other; what effects and the edges of a filter leave is
then made up for by a fixed-point iteration,

    w <- w + Q (y_wanted - y(u)),        u = H^-1 w,

with y(u) the whole model in free run, and shorter steps where one leads away.  It converges as
long as what is left out is small beside the stage, which creep, rate dependence and a bent sensor
are; the result says how far it came.  The lag of an amplifier has an inverse of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import DataError
from piezo_ident.common.showable import Showable
from piezo_ident.control.expectation import expect, known_rms
from piezo_ident.control.hysteresis_inverse import HysteresisInverse, with_rising_hysteresis
from piezo_ident.control.inputs import checked_limits, checked_motion, padded
from piezo_ident.control.linear_inverse import linear_inverse
from piezo_ident.control.rate_inverse import RateInverse
from piezo_ident.effects.amplifier_lag import AmplifierLag
from piezo_ident.effects.rate_dependent_hysteresis import RateDependentHysteresis
from piezo_ident.model.metrics import percent, percent_of_stroke
from piezo_ident.model.stage_model import StageModel
from scipy.ndimage import maximum_filter1d
from scipy.optimize import brentq

#: passes of the iteration, at most
PASSES = 30
#: error [of the span of the wanted motion, rms] below which it ends
EXACT = 1e-5
#: share of the error that a pass must leave at most for another one
WORTH = 0.9
#: least share of a step that is tried
SHORTEST = 0.2
#: difference from the wanted motion that counts as a miss, as a share of its span, and the largest
#: span of which it is a share, in spans of the model
MATTERS, LARGE = 1e-3, 0.1
#: span of a motion that stands still, normalised
STANDS = 1e-9
#: difference from what is wanted at rest, normalised, from which it is out of reach
SHORT = 1e-4
#: the same, of its span, of a model that errs by more elsewhere
SLIGHT = 1e-2
#: step of a motion from one sample to the next that is a jump [of its span]
JUMPS = 0.05
#: changes of the voltage [of the span of the model] below which the lead may be cut off, the
#: largest first, and how far that may move the motion [of its span]
STILL, RESTS = (1e-5, 1e-6, 1e-7, 1e-8), 1e-4
#: spans of the model beyond which, and below which, a wrong unit is likelier than a motion
FAR, FAINT = 30.0, 2e-3


@dataclass(frozen=True, eq=False, repr=False)
class Inverse(Showable):
    """
    A voltage, and where it takes the model.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Time [s] of the samples; below the start of the wanted motion where the voltage has to
        begin before it.
    v : ndarray, shape (n,)
        Voltage [V].
    wanted, predicted : ndarray, shape (n,)
        Wanted displacement, and that of the model under v [m].
    lead : int
        Samples by which the voltage begins before the wanted motion.
    clipped : ndarray of bool, shape (n,)
        Where the voltage stands at a limit and the wanted motion is not reached.
    passes : int
        Runs of the model that were needed.
    error : float
        100 rms(wanted - predicted) / (max wanted - min wanted), without the lead: what the
        inversion leaves; of the span of the model where the motion stands still.
    expected : float or None
        What the stage will err by without the mean [%, as `error`], if that of the model is known,
        as of its diagnosis or its identification: as many metres as on the kind of motion that
        the model knows least, however small this one is; what lies above the lowest mode; and
        what creeps on.
    expected_rms : float or None
        The same [m].
    expected_offset : float or None
        The mean of what the stage will err by [m], where it waits for a second at the beginning
        and goes on creeping; None for a model without creep.
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
    Return the voltage under which a model of one axis moves as wanted; see `piezo_ident.invert`.

    Parameters
    ----------
    limits : tuple of float, optional
        Lowest and highest voltage [V]; the identified range when absent.
    slew : float, optional
        Largest speed of the voltage [V/s].
    clip : bool, optional
        Come as near as the limits allow, instead of refusing.
    sample_rate : float, optional
        Of the wanted motion [Hz], where that is known: another one than the model's is refused.
    like : Inverse, optional
        Of nearly the same motion, to begin with where plays widen with speed.
    """
    y = checked_motion(wanted)
    if sample_rate is not None and not np.isclose(sample_rate, model.sample_rate, rtol=1e-6):
        raise DataError(
            f'the wanted motion is sampled at {sample_rate:g} Hz, the model at '
            f'{model.sample_rate:g} Hz; give the motion at that rate'
        )
    s = model.scaling
    low, high, slew = given = checked_limits(model, limits, slew)
    ends = float(s.u(low)), float(s.u(high))
    inverted, warnings_of_h = with_rising_hysteresis(model)
    H, linear = _of_hysteresis(inverted, ends, slew / s.V / model.sample_rate)
    Q = linear_inverse(linear, iterated=True)
    low, high = map(s.v, H.limits)
    if not low < high:
        raise DataError(
            f'invert: the limits lie beyond what the model holds for, {s.range[0]:g} .. '
            f'{s.range[1]:g} V; give others'
        )
    u0 = _rest(model, y, H.limits, clip)
    # the voltage moves before and after the motion
    lead, tail = Q.ahead, Q.behind
    x = np.pad(s.x(y), (lead, tail), mode='edge')
    more = padded(channels or {}, y.size, (lead, tail))
    if like is not None and isinstance(H, RateInverse):
        H.begin_at(np.pad(s.u(like.v), (lead - like.lead, tail), mode='edge'))
    t = (np.arange(x.size) - lead) / model.sample_rate
    span = float(np.ptp(x))
    span = span if span > STANDS else 1.0
    small, near = MATTERS * min(span, LARGE), 2 * Q.reach + 1
    free = np.ones(x.size, dtype=np.bool_)
    w = H.reset(u0) + Q(x - x[0])
    least, passes, share = np.inf, 0, 1.0
    while passes < PASSES:
        H.reset(u0)
        u, reached = H.process(w)
        e = x - s.x(model.stream().process(s.v0 + s.V * u, t, more))
        short = np.abs(w - reached) > small
        if passes == 0 and not short.all():
            # what is out of reach must not hide whether the rest converges
            within = ~maximum_filter1d(short, near)
            free = within if within.any() else free
        passes += 1
        rms = float(np.sqrt(np.mean(e[free] ** 2))) / span
        is_worth = rms < WORTH * least
        if rms < least:
            least, best = rms, (u, e, short, reached)
        if rms < EXACT:
            break
        if not is_worth:
            # a step that led away was too long, where much is left
            share *= 0.5
            if least < MATTERS or share < SHORTEST:
                break
        w = best[3] + share * Q(best[1])
    u, e, short, _ = best
    miss = maximum_filter1d(np.abs(e), near)
    short &= miss > small
    # what of the lead and the tail is at rest goes
    for still in (*STILL, 0.0):
        moves = np.flatnonzero(np.abs(u - u0) > still * min(span, 1.0))
        first = min(lead, int(moves[0]) - 1 if moves.size else lead)
        used = slice(max(first, 0), lead + y.size)
        # nor by the last digit
        v = np.clip(s.v0 + s.V * u[used], *given[:2])
        beside = {name: z[used] for name, z in more.items()}
        predicted = model.stream().process(v, t[used], beside)
        if np.abs(x[used] - e[used] - s.x(predicted)).max() < RESTS * span:
            break
    e, t, short, miss = e[used], t[used], short[used], miss[used]
    warnings = list(warnings_of_h)
    if short.any():
        most = abs(s.Y) * float(miss[short].max())
        at_top = u[used][short] > 0.5 * sum(H.limits)
        jumps = maximum_filter1d(np.abs(np.diff(x[used], append=x[-1])), near)[short]
        remedy = ''
        if jumps.max() > JUMPS * span:
            remedy = '; the motion jumps there: round it over two periods of the lowest mode'
        elif np.isinf(slew) and (at_top.all() or not at_top.any()):
            remedy = f'; {_shifted(-most if at_top[0] == (s.Y > 0.0) else most)}'
        text = _unreached(t[short], most, low, high, slew)
        warnings.append(f'{text}{remedy}')
        if not clip and most > _tolerance(model, y):
            raise DataError('; '.join([*warnings, *_faint(model, y)]), options='--clip')
    e = e[~maximum_filter1d(short, near)]
    left = float(np.sqrt(np.mean(e**2))) / span if e.size else 0.0
    expected = expect(model, v, y)
    relative = 0.0 if expected.rms is None else expected.rms / abs(s.Y) / span
    if left > max(MATTERS, relative):
        warnings.append(
            f'the drive misses {100 * left:.2g} % of the wanted motion within all limits: the '
            'motion is faster than the stage, or jumps, or no voltage makes up for an effect or a '
            'line'
        )
    warnings += _extrapolated(model, v, y)
    goal = np.pad(y, (lead, 0), mode='edge')[used]
    lead -= used.start
    return Inverse(
        t=t,
        v=v,
        wanted=goal,
        predicted=predicted,
        lead=lead,
        clipped=short,
        passes=passes,
        error=percent_of_stroke(y, predicted[lead:], span * abs(s.Y)),
        expected=None if expected.rms is None else percent(expected.rms, span * abs(s.Y)),
        expected_rms=expected.rms,
        expected_offset=expected.offset,
        warnings=(*warnings, *expected.warnings),
    )


def _of_hysteresis(
    model: StageModel, ends: tuple[float, float], step: float
) -> tuple[HysteresisInverse | RateInverse, StageModel]:
    """Return the inverse of H, with what is done along with it, and the model of the rest."""
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


def _rest(model: StageModel, y: Array, bounds: tuple[float, float], clip: bool) -> float:
    """Return the normalised voltage at which the model rests where a motion begins."""
    s = model.scaling
    x0 = float(s.x(y[0]))

    def miss(u: float) -> float:
        return float(model.chain().reset(u, u)) - x0

    below, above = miss(bounds[0]), miss(bounds[1])
    near = max(SHORT, _tolerance(model, y) / abs(s.Y))
    if (below > near or above < -near) and not (clip and max(below, -above) < FAR):
        ends = sorted(1e6 * float(s.y(x0 + d)) for d in (below, above))
        is_far, missed = max(below, -above) > FAR, s.Y * (below if below > 0.0 else above)
        raise DataError(
            f'the wanted motion starts at {1e6 * y[0]:.4g} um; between {s.v(bounds[0]):g} and '
            f'{s.v(bounds[1]):g} V the stage rests at {ends[0]:.4g} .. {ends[1]:.4g} um'
            + ('; is the motion in metres?' if is_far else f'; {_shifted(missed)}'),
            options='' if is_far else '--clip',
        )
    if below >= 0.0 or above <= 0.0:
        return bounds[0] if below >= 0.0 else bounds[1]
    return float(brentq(miss, *bounds, xtol=1e-14))


def _tolerance(model: StageModel, y: Array) -> float:
    """Return by how much a motion may leave the limits: less than the stage errs by [m]."""
    return min(known_rms(model) or 0.0, SLIGHT * float(np.ptp(y)))


def _extrapolated(model: StageModel, v: Array, y: Array) -> list[str]:
    """Return a warning where the model is asked for what it was not identified for."""
    s = model.scaling
    (low, high), warnings = s.range, []
    outside = np.mean((v < low - SHORT * s.V) | (v > high + SHORT * s.V))
    if outside:
        warnings.append(
            f'{outside:.1%} of the voltage, {v.min():.4g} .. {v.max():.4g} V, lie outside the '
            f'identified range {low:g} .. {high:g} V, where the model is an extrapolation'
        )
    return [*warnings, *_faint(model, y)]


def _faint(model: StageModel, y: Array) -> list[str]:
    """Return a warning where a motion is so small that its unit is in doubt."""
    s = model.scaling
    if not 0.0 < np.abs(y - s.y0).max() < FAINT * abs(s.Y):
        return []
    return [
        f'the wanted motion stays within {1e6 * np.abs(y - s.y0).max():.2g} um of zero, of '
        f'{1e6 * abs(s.Y):.3g} um; is it in metres?'
    ]


def _shifted(by: float) -> str:
    return f'{"raise" if by > 0.0 else "lower"} the motion by {1e6 * abs(by):.3g} um'


def _unreached(t: Array, miss: float, low: float, high: float, slew: float) -> str:
    """Return how much of a motion the limits do not reach, and where."""
    speed = '' if np.isinf(slew) else f' and at {slew:g} V/s'
    return (
        f'{t.size} samples of the wanted motion, between {t[0]:.4g} and {t[-1]:.4g} s, are out of '
        f'reach within {low:g} .. {high:g} V{speed}: by up to {1e6 * miss:.3g} um'
    )

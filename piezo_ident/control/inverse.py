# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The voltage under which a model goes where it is told.

The inverse of G and of H come one after the other; what effects and the edges of a filter leave is
then made up for by a fixed-point iteration,

    w <- w + Q (y_wanted - y(u)),        u = H^-1 w,

with y(u) the whole model in free run.  It converges as long as what is left out is small beside
the stage, which creep, lag, rate dependence and a bent sensor are; how far it came is told.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.errors import DataError
from piezo_ident.common.showable import Showable
from piezo_ident.control.hysteresis_inverse import HysteresisInverse
from piezo_ident.control.linear_inverse import linear_inverse
from piezo_ident.model.metrics import expected_error, percent_of_stroke
from piezo_ident.model.stage_model import StageModel
from scipy.optimize import brentq

__all__ = ['Inverse', 'invert']

Array = NDArray[np.float64]

#: passes of the iteration, at most
PASSES = 30
#: error [of the span of the wanted motion, rms] below which it ends
EXACT = 1e-5
#: share of the error that a pass must leave at most for another one
WORTH = 0.9
#: difference of H from what is wanted, normalised, from which a motion is out of reach
SHORT = 1e-4
#: change of the voltage [of the span of the model] that is none
STILL = 1e-5


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
        100 rms(wanted - predicted) / (max wanted - min wanted): what the inversion leaves.
    expected : float or None
        The error of the model [% of stroke], as of its diagnosis or its identification, if it is
        known: the stage will err by about as much.
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
    clipped: NDArray[np.bool_]
    passes: int
    error: float
    expected: float | None
    warnings: tuple[str, ...]


def invert(
    model: StageModel,
    wanted: ArrayLike,
    *,
    limits: tuple[float, float] | None = None,
    slew: float = np.inf,
    clip: bool = False,
    channels: Mapping[str, ArrayLike] | None = None,
) -> Inverse:
    """
    Return the voltage under which a model moves as wanted.

    Parameters
    ----------
    model : StageModel
    wanted : array_like, shape (n,)
        Displacement [m], sampled at the rate of the model; before and after it the stage rests.
    limits : tuple of float, optional
        Lowest and highest voltage [V]; the identified range when absent.
    slew : float, optional
        Largest speed of the voltage [V/s].
    clip : bool, optional
        Come as near as the limits allow, instead of refusing.
    channels : mapping of str to array_like, shape (n,), optional
        Further signals that effects of the model depend on.

    Returns
    -------
    Inverse

    Raises
    ------
    DataError
        When the wanted motion is no vector of finite numbers, or the limits do not reach it.
    ModelError
        When the model has no inverse.

    Examples
    --------
    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> model = pi.SimulatedStage.load('paper').model
    >>> t = np.arange(4000) / model.sample_rate
    >>> wanted = 30e-6 * (1 - np.cos(2 * np.pi * 10 * t)) + 5e-6
    >>> drive = pi.invert(model, wanted)
    >>> drive.error < 0.01, bool(0 <= drive.v.min() and drive.v.max() <= 10)
    (True, True)
    """
    y = _checked(wanted)
    low, high = model.scaling.range if limits is None else limits
    if not (low < high and slew > 0.0):
        raise DataError('invert: give limits as (lowest, highest) voltage, and a slew above zero')
    s = model.scaling
    bounds = float(s.u(low)), float(s.u(high))
    Q = linear_inverse(model)
    H = HysteresisInverse(model.hysteresis, bounds, slew / s.V / model.sample_rate)
    u0 = _rest(model, float(s.x(y[0])), bounds, clip=clip)
    # the voltage moves before and after the motion
    lead, tail = Q.ahead, Q.behind
    x = np.pad(s.x(y), (lead, tail), mode='edge')
    more = {
        name: np.pad(np.asarray(z, np.float64), (lead, tail), mode='edge')
        for name, z in (channels or {}).items()
    }
    t = (np.arange(x.size) - lead) / model.sample_rate
    span = max(float(np.ptp(x)), 1e-300)
    w = H.reset(u0) + Q(x - x[0])
    least, passes = np.inf, 0
    while passes < PASSES:
        H.reset(u0)
        u, reached = H.process(w)
        e = x - s.x(model.stream().process(s.v0 + s.V * u, t, more))
        passes += 1
        rms = float(np.sqrt(np.mean(e * e))) / span
        is_worth = rms < WORTH * least
        if rms < least:
            least, best = rms, (u, e, np.abs(w - reached) > SHORT)
        if rms < EXACT or not is_worth:
            break
        w = reached + Q(e)
    u, e, short = best
    # what of the lead and the tail is at rest goes
    moves = np.flatnonzero(np.abs(u - u0) > STILL)
    first = min(lead, int(moves[0]) - 1 if moves.size else lead)
    used = slice(max(first, 0), lead + y.size)
    u, e, t, short = u[used], e[used], t[used], short[used]
    warnings: tuple[str, ...] = ()
    if short.any():
        warnings = (_unreached(t[short], s.Y * e[short], (low, high), slew),)
        if not clip:
            raise DataError(*warnings, options='--clip')
    goal = np.pad(y, (lead, 0), mode='edge')[used]
    predicted = s.y(x[used] - e)
    return Inverse(
        t=t,
        v=s.v0 + s.V * u,
        wanted=goal,
        predicted=predicted,
        lead=lead - used.start,
        clipped=short,
        passes=passes,
        error=percent_of_stroke(goal, predicted),
        expected=expected_error(model),
        warnings=warnings,
    )


def _checked(wanted: ArrayLike) -> Array:
    try:
        y = np.asarray(wanted, dtype=np.float64)
    except (TypeError, ValueError):
        y = np.array(np.nan)
    if y.ndim != 1 or y.size < 2 or not np.all(np.isfinite(y)):
        raise DataError('invert: the wanted motion must be a vector of finite numbers, in metres')
    return y


def _rest(model: StageModel, x0: float, bounds: tuple[float, float], *, clip: bool) -> float:
    """Return the normalised voltage at which the model rests at a displacement."""

    def miss(u: float) -> float:
        return float(model.chain().reset(u, u)) - x0

    below, above = miss(bounds[0]), miss(bounds[1])
    if not clip and (below > SHORT or above < -SHORT):
        s = model.scaling
        ends = sorted(1e6 * float(s.y(x0 + d)) for d in (below, above))
        raise DataError(
            f'the wanted motion starts at {1e6 * float(s.y(x0)):.4g} um; between '
            f'{s.v(bounds[0]):g} and {s.v(bounds[1]):g} V the stage rests at {ends[0]:.4g} .. '
            f'{ends[1]:.4g} um',
            options='--clip',
        )
    if below >= 0.0 or above <= 0.0:
        return bounds[0] if below >= 0.0 else bounds[1]
    return float(brentq(miss, *bounds, xtol=1e-14))


def _unreached(t: Array, e: Array, limits: tuple[float, float], slew: float) -> str:
    """Return how much of a motion the limits do not reach, and where."""
    speed = '' if np.isinf(slew) else f' and at {slew:g} V/s'
    return (
        f'{t.size} samples of the wanted motion, between {t[0]:.4g} and {t[-1]:.4g} s, are out of '
        f'reach within {limits[0]:g} .. {limits[1]:g} V{speed}: by up to '
        f'{1e6 * float(np.abs(e).max()):.3g} um'
    )

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The laws of the effects, none of them in the form that the package fits.  Parts of the span.

Each law has up to three forms, of which a stage has one.
"""

from __future__ import annotations

import math

from numba import njit
import numpy as np
from scipy.special import expit, ndtr

from .cores import Array
from .linear import band, lag, RATE

Rng = np.random.Generator


@njit(cache=True, nogil=True)
def _charged(u: Array, tau: float, growth: float, step: float, out: Array) -> None:
    x = u[0]
    for k in range(u.size):
        x += (u[k] - x) * (1.0 - math.exp(-step / (tau * (1.0 + growth * x))))
        out[k] = x


def charged(u: Array, tau: float, variant: int, rate: float = RATE) -> Array:
    """Return the voltage on a capacitance that grows with it, or behind two lags."""
    if variant == 2:
        first = lag(u, 1.0 / (2 * math.pi * 0.8 * tau), rate=rate)
        return lag(first, 1.0 / (2 * math.pi * 0.2 * tau), rate=rate)
    if variant == 1:
        return lag(u, 1.0 / (np.pi * tau), order=2, rate=rate)
    out = np.empty(u.size)
    _charged(np.ascontiguousarray(u), tau, 0.3, 1.0 / rate, out)
    return out


@njit(cache=True, nogil=True)
def _current_limited(u: Array, slew: float, tau: float, step: float, out: Array) -> None:
    x, e0, decay = u[0], slew * tau, math.exp(-step / tau)
    for k in range(u.size):
        z = (u[k] - x) / e0
        size = abs(z)
        # sinh(z) decays exponentially; beyond 30 the distance shrinks at the full rate
        if size > 30.0 + step / tau:
            left = size - step / tau
        elif size > 30.0:
            left = math.asinh(0.5 * math.exp(size - step / tau))
        else:
            left = math.asinh(math.sinh(size) * decay)
        x = u[k] - math.copysign(left, z) * e0
        out[k] = x


def current_limited(u: Array, slew: float, variant: int, rate: float = RATE) -> Array:
    """
    Return the voltage behind an amplifier whose current saturates softly.

    dx/dt = S tanh((u - x) / (S tau)), solved exactly for a held u; tau is 20 or 40 us, which is
    its lag far below the limit.
    """
    out = np.empty(u.size)
    tau = (20e-6, 40e-6)[variant]
    if not math.isfinite(slew):
        return lag(u, 1.0 / (2 * np.pi * tau), rate=rate)
    _current_limited(np.ascontiguousarray(u), slew, tau, 1.0 / rate, out)
    return out


def limited(u: Array, depth: float, variant: int) -> Array:
    """Return u, `depth` of it lost at 1: by an algebraic limiter, a Gaussian knee, a parabola."""
    if variant == 2:
        return np.asarray(u - depth * (np.maximum(u - 0.75, 0.0) / 0.25) ** 2)
    if variant == 0:
        # (1 + s^-16)^(-1/16) = 1 - depth fixes the level s at which it saturates
        level = ((1.0 - depth) ** -16 - 1.0) ** (-1 / 16)
        return np.asarray(u / (1.0 + (u / level) ** 16) ** (1 / 16))
    # the slope falls to a tenth, as the integral of an error function, from a knee on
    z = (u - 1.0 + depth / 0.9) / 0.02
    lost = z * ndtr(z) + np.exp(-0.5 * z * z) / math.sqrt(2 * np.pi)
    return np.asarray(u - 0.9 * 0.02 * lost)


def bent(u: Array, amount: float, variant: int) -> Array:
    """Return an even bend: |u - c|^1.7, a hyperbolic cosine, or half a sine."""
    # with a straight line each, which is the base's business, so that the curve keeps rising
    if variant == 0:
        shape = np.abs(u - 0.45) ** 1.7 - 0.45**1.7 + 0.7 * u
    elif variant == 1:
        shape = np.cosh(3.5 * (u - 0.5)) - math.cosh(1.75) + 7.0 * u
    else:
        shape = 2.1 * u - np.sin(np.pi * u)
    return np.asarray(amount * shape)


def hinge(u: Array, amount: float, variant: int) -> Array:
    """Return the stroke lost to a contact that opens: soft, of Hertz's law, or a square."""
    if variant == 2:
        return np.asarray(-amount * np.maximum(0.45 - u, 0.0) ** 2)
    at, soft = (0.3, 0.02) if variant == 0 else (0.35, 0.0)
    if variant == 0:
        return np.asarray(-amount * soft * np.logaddexp(0.0, (at - u) / soft))
    return np.asarray(-amount * np.maximum(at - u, 0.0) ** 1.5)


def velocity(u: Array, corner: float = 400.0, rate: float = RATE) -> Array:
    """Return the smoothed velocity of u in spans a second."""
    return lag(np.diff(u, prepend=u[0]) * rate, corner, rate=rate)


def spent_on_speed(u: Array, amount: float, variant: int, rate: float) -> Array:
    """
    Return the part of the drive that speed takes, `amount` of the span at 100 spans/s.

    Variant 0 is the excess loss of magnetic cores, amount sqrt(speed) (Bertotti, IEEE Trans.
    Magn. 24 (1988) 621); variant 1 grows as the logarithm, as thermally activated walls do.
    """
    # well below this one [spans/s] the speed counts as slow
    slow = 2.0
    speed = velocity(u, 600.0, rate)
    size = np.abs(speed)
    way = speed / (size + 0.1 * slow)
    grown = (
        np.sqrt(size / 100.0) if variant == 0 else np.log1p(size / slow) / np.log1p(100.0 / slow)
    )
    return np.asarray(amount * way * grown)


def drift(t: Array, amount: float, variant: int, rng: Rng) -> Array:
    """Return a thermal drift that is zero at t = 0: diffusion, air conditioning, warming up."""
    t = np.maximum(t, 0.0)
    if variant == 0:
        age = rng.uniform(1.0, 4.0)
        shape = (np.sqrt(t + age) - math.sqrt(age)) / 2.5
    elif variant == 1:
        period = rng.uniform(120.0, 240.0)
        phase = rng.uniform(-0.6, 0.6)
        shape = 3.0 * (np.sin(2 * np.pi * t / period + phase) - math.sin(phase))
    else:
        shape = -np.expm1(-t / rng.uniform(6.0, 40.0))
    return np.asarray(amount * shape)


def hum(t: Array, amount: float, variant: int, rng: Rng) -> Array:
    """Return mains hum: a clipped sine near 50 Hz, a rounded triangle near 60 Hz, harmonics."""
    if variant == 2:
        total = np.zeros(t.size)
        for order, share in ((1, 1.0), (2, 0.3), (3, 0.5), (5, 0.2)):
            total += share * np.sin(2 * np.pi * 49.98 * order * t + rng.uniform(0, 2 * np.pi))
        return np.asarray(amount * total)
    frequency = 50.03 if variant == 0 else 59.96
    phase = rng.uniform(0, 2 * np.pi)
    s = np.sin(2 * np.pi * frequency * t + phase)
    return np.asarray(amount * (np.tanh(2.5 * s) if variant == 0 else np.arcsin(0.98 * s)))


@njit(cache=True, nogil=True)
def _friction(y: Array, reach: float, stribeck: float, rate: float, out: Array) -> None:
    # Dahl: dz = (1 - z sgn(dy)) dy / reach; LuGre's level falls with the speed
    z, last = 0.0, y[0]
    for k in range(y.size):
        dy = y[k] - last
        last = y[k]
        level = 1.0 + stribeck * math.exp(-abs(dy) * rate / 2.0)
        if dy != 0.0:
            end = math.copysign(level, dy)
            z = end + (z - end) * math.exp(-abs(dy) / (reach * level))
        out[k] = z


def friction(y: Array, amount: float, variant: int, rate: float = RATE) -> Array:
    """Return what a guide takes from the motion: Dahl's law, LuGre's, two bristles of Dahl's."""
    if variant == 2:
        both = friction(y, amount, 0, rate) + friction(2.5 * y, amount, 0, rate)
        return np.asarray(0.5 * both)
    out = np.empty(y.size)
    reach, stribeck = (0.004, 0.008)[variant], (0.0, 0.15)[variant]
    _friction(np.ascontiguousarray(y), reach, stribeck, rate, out)
    return np.asarray(-amount * out)


def bridge(y: Array, amount: float, variant: int) -> Array:
    """Return a sensor's reading: of a Wheatstone bridge, an inverse tangent, or an LVDT."""
    if variant == 2:
        return np.asarray(y - amount * np.abs(y - 0.3) ** 2.5 * np.sign(y - 0.3))
    if variant == 0:
        return np.asarray(y * (1.0 + amount) / (1.0 + amount * y))
    x = y - 0.35
    return np.asarray(y + np.arctan(amount * x) / amount - x)


def fed_through(u: Array, amount: float, variant: int, rate: float = RATE) -> Array:
    """Return the drive's own voltage in the reading: through a capacitance, and a resistance."""
    if variant == 2:
        return np.asarray(amount * (4.0 * (u - lag(u, 800.0, rate=rate)) + 0.05 * u))
    corner = (3000.0, 1500.0)[variant]
    coupled = u - lag(u, corner, rate=rate)
    return np.asarray(amount * (8.0 * coupled + (0.1, 0.02)[variant] * u))


def wander(t: Array, amount: float, variant: int, rng: Rng) -> Array:
    """Return a gain that wanders from zero at t = 0: 1/f^2 lines, bounded ones, warming up."""
    if variant == 2:
        return np.asarray(amount * -np.expm1(-t / rng.uniform(3.0, 20.0)))
    period = rng.uniform(0.9, 1.1, 16) * np.geomspace(4.0, 80.0, 16)
    size = rng.standard_normal(16) * (period if variant == 0 else np.sqrt(period))
    phase = rng.uniform(0, 2 * np.pi, 16)
    angle = 2 * np.pi * t[:, None] / period + phase
    walk = np.sin(angle) @ size - np.sin(phase) @ size
    spread = math.sqrt(float(np.mean((walk - walk.mean()) ** 2)))
    return np.asarray(amount * walk / max(spread, 1e-12))


def jumps(u: Array, amount: float, rng: Rng) -> Array:
    """Return Barkhausen-like jumps: at random distances travelled, of random size, for good."""
    travelled = np.cumsum(np.abs(np.diff(u, prepend=u[0])))
    # slow travel counts, fast travel averages out: at most about two jumps a second
    clock = np.cumsum(np.minimum(np.diff(travelled, prepend=0.0), 2.0 / RATE))
    at = np.cumsum(rng.exponential(0.4, 400))
    size = rng.standard_normal(400)
    walk = np.concatenate([[0.0], size])
    position = np.searchsorted(at, clock)
    # a pinned wall comes back: the walk forgets
    level = np.zeros(401)
    for i in range(1, 401):
        level[i] = 0.8 * level[i - 1] + walk[i]
    return np.asarray(amount * level[np.minimum(position, 400)])


def vibration(n: int, amount: float, rng: Rng) -> Array:
    """Return a floor that shakes in bursts: 8 .. 25 Hz noise under a random envelope."""
    envelope = expit(4.0 * band(rng, n, 0.2, 1.0) - 1.0) if n > 40000 else np.ones(n)
    return np.asarray(amount * envelope * band(rng, n, 8.0, 25.0))


def ripple(t: Array, u: Array, amount: float, rng: Rng) -> Array:
    """Return a 37 Hz ripple of the supply that vanishes, and turns over, at half the span."""
    phase = rng.uniform(0, 2 * np.pi)
    return np.asarray(amount * (2 * u - 1.0) * np.sin(2 * np.pi * 37.0 * t + phase))

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Further forms of the effects' laws, for all sets but that of the tuning.  Parts of the span."""

from __future__ import annotations

import math

import numpy as np
from truths import laws
from truths.linear import lag

from .cores import Array, Rng

#: the number of the further form of each effect that has one
FURTHER = {
    'saturation': 2,
    'amplifier_lag': 2,
    'noncongruent_minor_loops': 1,
    'preload_loss': 2,
    'changed_dynamics': 2,
    'backlash': 2,
    'gain_drift': 2,
    'periodic_disturbance': 2,
    'sensor_nonlinearity': 2,
    'input_feedthrough': 2,
}


def limited(u: Array, depth: float, form: int) -> Array:
    """Return u behind a limiter; the further one bends on as a parabola from three quarters."""
    if form < 2:
        return laws.limited(u, depth, form)
    return np.asarray(u - depth * (np.maximum(u - 0.75, 0.0) / 0.25) ** 2)


def lagging(u: Array, tau: float, form: int, rate: float) -> Array:
    """Return the voltage behind an amplifier; the further one is two unequal lags."""
    if form < 2:
        return laws.charged(u, tau, form, rate)
    first = lag(u, 1.0 / (2 * math.pi * 0.8 * tau), rate=rate)
    return lag(first, 1.0 / (2 * math.pi * 0.2 * tau), rate=rate)


def hinge(u: Array, amount: float, form: int) -> Array:
    """Return the stroke lost to a contact; the further one opens as a square, below 0.45."""
    if form < 2:
        return laws.hinge(u, amount, form)
    return np.asarray(-amount * np.maximum(0.45 - u, 0.0) ** 2)


def friction(y: Array, amount: float, form: int, rate: float) -> Array:
    """Return what a guide takes; the further one has two bristles of their own reach."""
    if form < 2:
        return laws.friction(y, amount, form, rate)
    both = laws.friction(y, amount, 0, rate) + laws.friction(2.5 * y, amount, 0, rate)
    return np.asarray(0.5 * both)


def wander(t: Array, amount: float, form: int, rng: Rng) -> Array:
    """Return a gain that wanders; the further one warms up."""
    if form < 2:
        return laws.wander(t, amount, form, rng)
    return np.asarray(amount * -np.expm1(-t / rng.uniform(3.0, 20.0)))


def hum(t: Array, amount: float, form: int, rng: Rng) -> Array:
    """Return mains hum; the further one is its harmonics 1, 2, 3 and 5."""
    if form < 2:
        return laws.hum(t, amount, form, rng)
    total = np.zeros(t.size)
    for order, share in ((1, 1.0), (2, 0.3), (3, 0.5), (5, 0.2)):
        total += share * np.sin(2 * np.pi * 49.98 * order * t + rng.uniform(0, 2 * np.pi))
    return np.asarray(amount * total)


def bent(y: Array, amount: float, form: int) -> Array:
    """Return a sensor's reading; the further one runs short at its far end, as an LVDT."""
    if form < 2:
        return laws.bridge(y, amount, form)
    return np.asarray(y - amount * np.abs(y - 0.3) ** 2.5 * np.sign(y - 0.3))


def fed(u: Array, amount: float, form: int, rate: float) -> Array:
    """Return the drive in the reading; the further one has a slower path."""
    if form < 2:
        return laws.fed_through(u, amount, form, rate)
    return np.asarray(amount * (4.0 * (u - lag(u, 800.0, rate=rate)) + 0.05 * u))

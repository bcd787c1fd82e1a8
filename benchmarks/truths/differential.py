# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Hysteresis by differential laws, over 0 .. 1.

- Bouc and Wen (Wen, J. Eng. Mech. 102 (1976) 249), also with a term for each way (Wang, Wen,
  J. Eng. Mech. 126 (2000) 1092).
- Duhem's equation in the form of Coleman and Hodgdon (Int. J. Eng. Sci. 24 (1986) 897).
- Jiles and Atherton (J. Magn. Magn. Mater. 61 (1986) 48).
- Dahl, with an exponent and a stiffness that goes with the bias (AIAA J. 14 (1976) 1675).
"""

from __future__ import annotations

import math

from numba import njit

from .cores import Array, Law, law_of, Rng, STEP


@njit(cache=True, nogil=True)
def _bouc_wen(
    u: Array, rate: float, beta: float, gamma: float, power: float, skew: float, out: Array
) -> None:
    # dz = rate du (1 - |z|^power (gamma + beta sgn(z du) + skew sgn(du))), by midpoints
    z, last = 0.0, u[0]
    for k in range(u.size):
        du = u[k] - last
        last = u[k]
        if du != 0.0:
            parts = int(abs(du) / STEP) + 1
            d = rate * du / parts
            way = 1.0 if du > 0.0 else -1.0
            for _ in range(parts):
                half = z + 0.5 * d * _slope(z, way, beta, gamma, power, skew)
                z += d * _slope(half, way, beta, gamma, power, skew)
        out[k] = z


@njit(cache=True, nogil=True)
def _slope(z: float, way: float, beta: float, gamma: float, power: float, skew: float) -> float:
    size = abs(z)
    sign = way if z >= 0.0 else -way
    level = size if power == 1.0 else size**power
    return 1.0 - level * (gamma + beta * sign + skew * way)


def bouc_wen_of(rate: float, beta: float, gamma: float, power: float, skew: float = 0.0) -> Law:
    """Return the law of Bouc and Wen, with a term for each way."""
    force = law_of(_bouc_wen, rate, beta, gamma, power, skew)
    # what the restoring force takes away: a piezo's branches begin flat and grow steep
    return lambda u: -force(u)


def bouc_wen(rng: Rng) -> Law:
    """Draw the law of Bouc and Wen."""
    rate, power = rng.uniform(1.0, 6.0), float(rng.choice([1.0, 1.0, 1.5, 2.0]))
    beta = rng.uniform(0.55, 1.0)
    return bouc_wen_of(rate, beta, 1.0 - beta, power)


@njit(cache=True, nogil=True)
def _coleman_hodgdon(u: Array, rate: float, bend: float, give: float, out: Array) -> None:
    # dz = rate |du| (f(u) - z) + g(u) du, exact for f and g held over a part of the step
    last = u[0]
    z = 0.0
    for k in range(u.size):
        du = u[k] - last
        if du != 0.0:
            parts = int(abs(du) / STEP) + 1
            d = du / parts
            for i in range(parts):
                x = last + (i + 0.5) * d
                c = 2.0 * x - 1.0
                f = c + bend * (1.0 - c * c)
                g = give * (1.0 + bend * c)
                end = f + g * (1.0 if d > 0.0 else -1.0) / rate
                z = end + (z - end) * math.exp(-rate * abs(d))
        last = u[k]
        out[k] = z


def coleman_hodgdon(rng: Rng) -> Law:
    """Draw Duhem's equation, dz = a |du| (f(u) - z) + g(u) du."""
    rate, bend, give = rng.uniform(1.5, 5.0), rng.uniform(-0.12, 0.12), rng.uniform(0.2, 0.8)
    return law_of(_coleman_hodgdon, rate, bend, give)


def skewed_bouc_wen(rng: Rng) -> Law:
    """Draw the law of Bouc and Wen, its rises unlike its falls."""
    skew = rng.uniform(0.05, 0.2) * rng.choice([-1.0, 1.0])
    beta = rng.uniform(0.6, 1.0)
    return bouc_wen_of(rng.uniform(1.5, 6.0), beta, 1.0 - beta, rng.uniform(1.0, 1.8), skew)


@njit(cache=True, nogil=True)
def _langevin(x: float) -> float:
    return x / 3.0 if abs(x) < 1e-3 else 1.0 / math.tanh(x) - 1.0 / x


@njit(cache=True, nogil=True)
def _jiles_atherton(
    u: Array, a: float, pinning: float, coupling: float, give: float, out: Array
) -> None:
    # dM_irr/dH = (M_an - M_irr) / (k delta - alpha (M_an - M_irr)), never against the field
    irreversible, m, last = 0.0, 0.0, u[0]
    for k in range(u.size):
        du = u[k] - last
        parts = int(abs(du) / STEP) + 1
        d = 2.0 * du / parts
        way = 1.0 if du > 0.0 else -1.0
        for i in range(parts if du != 0.0 else 0):
            field = 2.0 * (last + (i + 0.5) * du / parts) - 1.0
            ideal = _langevin((field + coupling * m) / a)
            gap = ideal - irreversible
            if gap * way > 0.0:
                irreversible += d * gap / (way * pinning - coupling * gap)
            m = give * ideal + (1.0 - give) * irreversible
        last = u[k]
        out[k] = m


def jiles_atherton(rng: Rng) -> Law:
    """Draw the law of Jiles and Atherton, far from saturation."""
    a, pinning = rng.uniform(0.6, 1.5), rng.uniform(0.3, 0.9)
    coupling, give = rng.uniform(0.0, 0.1), rng.uniform(0.1, 0.4)
    return law_of(_jiles_atherton, a, pinning, coupling, give)


@njit(cache=True, nogil=True)
def _dahl(u: Array, rate: float, power: float, lean: float, out: Array) -> None:
    z, last = 0.0, u[0]
    for k in range(u.size):
        du = u[k] - last
        if du != 0.0:
            parts = int(abs(du) / STEP) + 1
            d, way = du / parts, 1.0 if du > 0.0 else -1.0
            for i in range(parts):
                x = last + (i + 0.5) * d
                stiff = rate * (1.0 + lean * (2.0 * x - 1.0))
                z += d * stiff * max(1.0 - z * way, 0.0) ** power
        last = u[k]
        out[k] = -z


def dahl(rng: Rng) -> Law:
    """Draw Dahl's law, stiffer at one end."""
    rate, power, lean = rng.uniform(1.0, 5.0), rng.uniform(0.8, 2.2), rng.uniform(-0.4, 0.4)
    return law_of(_dahl, rate, power, lean)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Laws of the known set, which the diagnosis may be tuned on.

- Preisach operators whose relays lie in Gaussian and Lorentzian hills,
- a few Krasnosel'skii-Pokrovskii kernels (Systems with Hysteresis, Springer 1989),
- Jiles and Atherton's law (J. Magn. Magn. Mater. 61 (1986) 48),
- the law of Bouc and Wen with a term for each way (Wang, Wen, J. Eng. Mech. 126 (2000) 1092),
- Dahl's law with an exponent and a stiffness that goes with the bias (Dahl, AIAA J. 14 (1976)
  1675), a form of Duhem's equation,
- curves from each turning point to the one before, bent by their length (after Bashash, Jalili,
  J. Appl. Phys. 100 (2006) 014103).
"""

from __future__ import annotations

import math

from numba import njit
import numpy as np

from .cores import Array, bouc_wen_of, DEPTH, Law, law_of, preisach, Rng, STEP

#: Krasnosel'skii-Pokrovskii kernels on each axis
KERNELS = 7


def hills(rng: Rng) -> Law:
    """Draw a Preisach operator whose relays lie in hills, over a floor."""
    count = int(rng.integers(2, 5))
    width = rng.exponential(0.12, count)
    place = rng.uniform(0.2, 0.8, count)
    along, across = rng.uniform(0.2, 0.6, count), rng.uniform(0.06, 0.25, count)
    weight = rng.uniform(0.3, 1.0, count)
    lorentzian = rng.random(count) < 0.5
    floor = rng.uniform(0.02, 0.15)

    def density(a: Array, b: Array) -> Array:
        total = np.full(a.shape, floor)
        for w, m, s, c, q, wide in zip(
            width, place, along, across, weight, lorentzian, strict=True
        ):
            z = ((0.5 * (a + b) - m) / s) ** 2 + ((a - b - w) / c) ** 2
            total = total + q * (1.0 / (1.0 + z) if wide else np.exp(-0.5 * z))
        return np.asarray(total)

    return preisach(density)


@njit(cache=True, nogil=True)
def _kernels(u: Array, up: Array, down: Array, ramp: float, weight: Array, out: Array) -> None:
    # a kernel follows a ramp that starts at `up` when rising, and one that starts at `down`
    state = np.zeros(up.size)
    for k in range(u.size):
        x, total = u[k], 0.0
        for i in range(up.size):
            least = min(max((x - up[i]) / ramp, 0.0), 1.0)
            most = min(max((x - down[i]) / ramp, 0.0), 1.0)
            state[i] = min(max(state[i], least), most)
            total += weight[i] * state[i]
        out[k] = total


def krasnoselskii_pokrovskii(rng: Rng) -> Law:
    """Draw kernels on a coarse grid of thresholds, more of them narrow and to one side."""
    # as long as three steps of the grid, or the branches would be jagged
    ramp = 3.0 / (KERNELS - 1)
    grid = np.linspace(-0.5 * ramp, 1.0 - 0.5 * ramp, KERNELS)
    a, b = np.meshgrid(grid, grid, indexing='ij')
    up, down = a[a >= b], b[a >= b]
    reach, lean = rng.uniform(0.15, 0.4), rng.uniform(-0.6, 0.6)
    weight = np.exp(-(up - down) / reach) * (1.0 + lean * (up + down - 1.0))
    weight *= rng.uniform(0.85, 1.15, up.size)
    return law_of(_kernels, up, down, ramp, weight)


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


def skewed_bouc_wen(rng: Rng) -> Law:
    """Draw the law of Bouc and Wen, its rises unlike its falls."""
    skew = rng.uniform(0.05, 0.2) * rng.choice([-1.0, 1.0])
    beta = rng.uniform(0.6, 1.0)
    return bouc_wen_of(rng.uniform(1.5, 6.0), beta, 1.0 - beta, rng.uniform(1.0, 1.8), skew)


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


@njit(cache=True, nogil=True)
def _turning(u: Array, bow: float, power: float, lean: float, out: Array) -> None:
    # turning points in turn, the first two the ends of the range
    at, value = np.empty(DEPTH), np.empty(DEPTH)
    at[0], value[0], at[1], value[1] = 1.0, 1.0, 0.0, 0.0
    n, x, h = 2, 0.0, 0.0
    for k in range(u.size):
        new = min(max(u[k], 0.0), 1.0)
        if new != x:
            rising = new > x
            # the last turning point is where the motion came from; the one before is its aim
            if rising != (at[n - 1] < at[n - 2]) and x != at[n - 1]:
                if n == DEPTH:
                    n -= 2
                at[n], value[n] = x, h
                n += 1
            while n > 2 and (new - at[n - 2]) * (1.0 if rising else -1.0) >= 0.0:
                n -= 2
            if n < 2 or rising != (at[n - 1] < at[n - 2]):
                # an end of the range is reached, and the next branch is a whole one
                n = 2
                if rising:
                    at[0], value[0], at[1], value[1] = 1.0, 1.0, 0.0, 0.0
                else:
                    at[0], value[0], at[1], value[1] = 0.0, 0.0, 1.0, 1.0
            start, end = at[n - 1], at[n - 2]
            s = (new - start) / (end - start)
            curve = bow * abs(end - start) ** power * (1.0 + lean * (start + end - 1.0))
            curve *= 1.0 + (0.5 * lean if rising else -0.5 * lean)
            h = value[n - 1] + (value[n - 2] - value[n - 1]) * s * (1.0 - curve * (1.0 - s))
            x = new
        out[k] = h


def turning_curves(rng: Rng) -> Law:
    """Draw curves from each turning point to the one before, the longer the more bent."""
    bow, power, lean = rng.uniform(0.5, 0.85), rng.uniform(0.6, 1.1), rng.uniform(-0.5, 0.5)
    return law_of(_turning, bow, power, lean)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Hysteresis by the extremes that it remembers, over 0 .. 1.

- The Preisach operator with an uneven density of its relays, or with hills of them, exact through
  its Everett function (Mayergoyz, Mathematical Models of Hysteresis, Springer 1991, chapter 1).
- A few Krasnosel'skii-Pokrovskii kernels (Systems with Hysteresis, Springer 1989).
- Curves from each turning point to the one before, bent by their length (after Bashash, Jalili,
  J. Appl. Phys. 100 (2006) 014103).
"""

from __future__ import annotations

from collections.abc import Callable

from numba import njit
import numpy as np

from .cores import Array, DEPTH, extremes_left, Law, law_of, Rng

#: cells of the relay plane on each axis; the density is even within a cell
CELLS = 400
#: Krasnosel'skii-Pokrovskii kernels on each axis
KERNELS = 7


def everett_table(density: Callable[[Array, Array], Array]) -> tuple[Array, Array]:
    """
    Return the Everett function on the corners of `CELLS` x `CELLS` cells, and their densities.

    `density`: of the relays that rise at a and fall at b <= a, both 0 .. 1.
    """
    middle = (np.arange(CELLS) + 0.5) / CELLS
    a, b = np.meshgrid(middle, middle, indexing='ij')
    mu = np.where(a >= b, np.maximum(density(a, b), 0.0), 0.0)
    cell = mu / CELLS**2
    cell[np.diag_indices(CELLS)] *= 0.5
    table = np.zeros((CELLS + 1, CELLS + 1))
    # E(a, b): all relays with b <= their b and their a <= a
    table[1:, :-1] = np.cumsum(np.cumsum(cell, axis=0)[:, ::-1], axis=1)[:, ::-1]
    return np.ascontiguousarray(table), np.ascontiguousarray(np.diag(mu))


@njit(cache=True, nogil=True)
def _everett(a: float, b: float, table: Array, diagonal: Array) -> float:
    """Return the Everett function, exact for a density that is even in each cell."""
    cells = diagonal.size
    x, y = a * cells, b * cells
    i, j = min(int(x), cells - 1), min(int(y), cells - 1)
    if i == j:
        return 0.5 * diagonal[i] * (a - b) * (a - b)
    s, t = x - i, y - j
    low = table[i, j] + (table[i, j + 1] - table[i, j]) * t
    high = table[i + 1, j] + (table[i + 1, j + 1] - table[i + 1, j]) * t
    # the cells that the diagonal cuts bend the edges of all cells in their row and column
    bent = diagonal[i] * s * (1.0 - s) + diagonal[j] * t * (1.0 - t)
    return low + (high - low) * s - 0.5 * bent / (cells * cells)


@njit(cache=True, nogil=True)
def _preisach(u: Array, table: Array, diagonal: Array, out: Array) -> None:
    extreme, value = np.empty(DEPTH), np.empty(DEPTH)
    extreme[0], value[0] = 0.0, 0.0
    n, x, h = 1, 0.0, 0.0
    for k in range(u.size):
        new = min(max(u[k], 0.0), 1.0)
        if new != x:
            n = extremes_left(new, x, h, n, extreme, value)
            last = extreme[n - 1]
            if new > last:
                h = value[n - 1] + _everett(new, last, table, diagonal)
            else:
                h = value[n - 1] - _everett(last, new, table, diagonal)
            x = new
        out[k] = h


def preisach(density: Callable[[Array, Array], Array]) -> Law:
    """Return the Preisach operator of a density of relays, from all relays down."""
    table, diagonal = everett_table(density)
    return law_of(_preisach, table, diagonal)


def uneven(rng: Rng) -> Law:
    """Draw a Preisach operator whose density falls with the width, and leans with the bias."""
    reach = rng.uniform(0.08, 0.35)
    lean, bow = rng.uniform(0.15, 0.5) * rng.choice([-1.0, 1.0]), rng.uniform(-0.5, 0.5)
    spot, at, broad = rng.uniform(0.0, 1.0), rng.uniform(0.25, 0.75), rng.uniform(0.1, 0.25)

    def density(a: Array, b: Array) -> Array:
        width, bias = a - b, a + b - 1.0
        fall = np.exp(-width / reach)
        hill = np.exp(-((0.5 * (a + b) - at) ** 2 + 0.5 * (width - 0.15) ** 2) / broad**2)
        return np.asarray(fall * (1.0 + lean * bias + bow * bias**2) + spot * 0.3 * hill)

    return preisach(density)


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

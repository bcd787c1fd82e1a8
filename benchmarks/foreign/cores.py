# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Rate-independent hysteresis that is no sum of plays.

A core is ``line u + share z(u)``, scaled so that its steady loop over 0 .. 1 goes from 0 to 1; z
is one of

- a Preisach operator with an uneven density of its relays, exact through its Everett function over
  the staircase of remembered extremes (Mayergoyz, Mathematical Models of Hysteresis, Springer
  1991, chapter 1),
- the law of Bouc and Wen (Wen, J. Eng. Mech. 102 (1976) 249),
- Duhem's equation in the form of Coleman and Hodgdon (Int. J. Eng. Sci. 24 (1986) 897).

Further laws are in `more_cores` and `sealed_cores`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
import math

from numba import njit
import numpy as np
from truths.cores import Array, extremes_left

Rng = np.random.Generator
Law = Callable[[Array], Array]

#: cells of the relay plane on each axis; the density is even within a cell
CELLS = 400
#: remembered extremes before the smallest loops are forgotten
DEPTH = 4096
#: longest step of a differential law; longer ones are divided
STEP = 2e-3
#: loop widths of piezos, in parts of the stroke
WIDTHS = (0.08, 0.18)
#: the smallest slope of a steady loop over its mean slope
SLOPE = 0.25
#: how far repeated minor loops may move on, in parts of the stroke: piezos' hardly do
SETTLED = 0.01
#: how far ten plays may be off, in parts of the stroke: for measured piezos it is 0.2 to 1 %
UNLIKE = 0.01
#: a loop that is steady, one sample in so many parts of the range
LOOP = 2000


@dataclass(frozen=True)
class Core:
    """``line u + share z(u) + level`` of a law z, from 0 to 1 on its steady loop over 0 .. 1."""

    name: str
    law: Law
    line: float
    share: float
    level: float

    def __call__(self, u: Array) -> Array:
        """Return the output, shape (n,), from the state in which the law begins."""
        return np.asarray(self.line * u + self.share * self.law(u) + self.level)


def steady_loop(law: Law) -> tuple[Array, Array, Array]:
    """Return u of a rise and z on the rise and on the fall (at the same u) of a steady loop."""
    up = np.linspace(0.0, 1.0, LOOP + 1)
    cycle = np.concatenate([up, up[-2:0:-1]])
    z = law(np.concatenate([*[cycle] * 4, [0.0]]))
    last = z[-2 * LOOP - 1 :]
    return up, last[: LOOP + 1], last[: LOOP - 1 : -1]


def core_of(name: str, law: Law, width: float) -> Core | None:
    """
    Return the core with a loop so wide, or None where it would be no piezo's.

    Parameters
    ----------
    width : float
        Largest distance of the branches, in parts of the stroke.
    """
    u, rise, fall = steady_loop(law)
    widest, reach = float(np.max(fall - rise)), float(rise[-1] - rise[0])
    if widest <= 1.2 * width * reach:
        return None
    # share widest / (1 + share reach) = width
    share = width / (widest - width * reach)
    whole = 1.0 + share * reach
    if whole < 0.2:
        return None
    line, share = 1.0 / whole, share / whole
    slopes = line + share * np.diff(np.stack([rise, fall])) / np.diff(u)
    if slopes.min() < SLOPE or slopes.max() > 3.0:
        return None
    core = Core(name, law, line, share, -share * float(rise[0]))
    return core if accommodation(core) <= SETTLED and unlike_plays(core) <= UNLIKE else None


@njit(cache=True, nogil=True)
def play(u: Array, r: float) -> Array:
    """Return a play of width r, from its upper end at u[0]."""
    out, state = np.empty(u.size), u[0]
    for k in range(u.size):
        state = min(max(state, u[k] - r), u[k])
        out[k] = state
    return out


def unlike_plays(core: Core) -> float:
    """Return by how much ten plays, fitted to growing triangles, miss a tour of turns [rms]."""
    turns = np.random.default_rng(2).uniform(0.0, 1.0, 24)
    weights: Array = np.zeros(0)
    for levels in ([0.0, 1.0, 0.0, 0.3, 0.0, 0.6, 0.0, 0.9, 0.0, 1.0], [0.0, 1.0, 0.0, *turns]):
        u = np.concatenate([np.linspace(a, b, 150) for a, b in pairwise(levels)])
        X = np.stack([np.ones(u.size), *(play(u, r) for r in np.arange(10) / 10)], axis=1)
        h = core(u)
        # the first cycle is from a state in which no piezo is found
        if not weights.size:
            weights = np.linalg.lstsq(X[300:], h[300:], rcond=1e-4)[0]
    return float(np.std((h - X @ weights)[300:]))


def accommodation(core: Core) -> float:
    """Return how far minor loops at three biases move on from their second to their 20th round."""
    way, furthest = np.linspace(0.0, 1.0, 500), 0.0
    for bias in (0.25, 0.5, 0.75):
        loops = bias + 0.14 * np.sin(2 * np.pi * np.arange(20 * 200) / 200)
        for past in ([way, way[::-1]], [way, way[::-1], way]):
            move = np.linspace(past[-1][-1], bias, 200)
            h = core(np.concatenate([*past, move, loops]))[-loops.size :]
            middles = h.reshape(20, -1).mean(axis=1)
            furthest = max(furthest, abs(float(middles[-1] - middles[1])))
    return furthest


def everett_table(density: Callable[[Array, Array], Array]) -> tuple[Array, Array]:
    """
    Return the Everett function on the corners of `CELLS` x `CELLS` cells, and their densities.

    Parameters
    ----------
    density : callable
        Of the relays that rise at a and fall at b <= a, both 0 .. 1.
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


def law_of(kernel: Callable[..., None], *parameters: float | Array) -> Law:
    """Return a law that a compiled loop computes, kernel(u, *parameters, out)."""

    def law(u: Array) -> Array:
        out = np.empty(u.size)
        kernel(np.ascontiguousarray(u), *parameters, out)
        return out

    return law


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

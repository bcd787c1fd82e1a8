# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Rate-independent hysteresis with a continuous density of thresholds, and its departures.

Two independent realisations of the same family: a Preisach operator by its Everett function over
the staircase of remembered extremes (exact, no thresholds at all), and a dense row of plays.  A
one-sided play of width r answers the first rise to w with max(w - r, 0), so a density p(r) has
the Everett function g(w) = int_0^w p(r) (w - r) dr.  See Brokate and Sprekels, Hysteresis and
Phase Transitions, Springer 1996, sections 2.3 to 2.5; Visintin, Differential Models of Hysteresis,
Springer 1994, chapter IV.  Everything is in parts of the span.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

from numba import njit
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Rng = np.random.Generator
Law = Callable[[Array], Array]

#: thresholds of a dense row of plays
PLAYS = 240
#: remembered extremes before the smallest loops are forgotten
DEPTH = 8192
#: longest step of a differential law, in parts of the range; longer ones are divided
STEP = 2e-3


def law_of(kernel: Callable[..., None], *parameters: float | Array) -> Law:
    """Return a law that a compiled loop computes, kernel(u, *parameters, out)."""

    def law(u: Array) -> Array:
        out = np.empty(u.size)
        kernel(np.ascontiguousarray(u), *parameters, out)
        return out

    return law


@njit(cache=True, nogil=True)
def _g(w: float, amount: Array, order: Array, scale: Array) -> float:
    """Return int_0^w p(r) (w - r) dr of a sum of Erlang densities."""
    total = 0.0
    for i in range(amount.size):
        x = w / scale[i]
        k = int(order[i])
        e = math.exp(-x)
        term, partial = 1.0, 0.0
        for j in range(k):
            partial += term
            term *= x / (j + 1)
        lower = 1.0 - e * partial
        upper = lower - e * term
        total += amount[i] * (w * lower - k * scale[i] * upper)
    return total


@dataclass(frozen=True)
class Density:
    """
    Density of play thresholds p(r), a sum of Erlang densities.

    `amount`, `order`, `scale`: weight, shape number k (1 .. 3) and scale of each term.
    """

    amount: Array
    order: Array
    scale: Array

    def everett(self, w: float) -> float:
        """Return g(w)."""
        return float(_g(float(w), self.amount, self.order, self.scale))

    def row(self, n: int = PLAYS) -> tuple[Array, Array]:
        """Return n thresholds in the middles of equal intervals of 0 .. 1, and their weights."""
        edges = np.linspace(0.0, 1.0, n + 1)
        r = 0.5 * (edges[1:] + edges[:-1])
        weight = np.zeros(n)
        for amount, order, scale in zip(self.amount, self.order, self.scale, strict=True):
            x = edges / scale
            terms = [x**j / math.factorial(j) for j in range(int(order))]
            weight += amount * np.diff(1.0 - np.exp(-x) * np.sum(terms, axis=0))
        return r, weight

    def scaled(self, factor: float) -> Density:
        """Return the same shape with all weights multiplied."""
        return Density(self.amount * factor, self.order, self.scale)

    def width(self) -> float:
        """Return the largest width of the loop over 0 .. 1."""
        return max(
            self.everett(1.0) - self.everett(1.0 - u) - self.everett(u)
            for u in np.linspace(0.05, 0.95, 37)
        )


@dataclass(frozen=True)
class Row:
    """A few plays: thresholds r and weights q, shape (m,) each."""

    r: Array
    q: Array

    def row(self) -> tuple[Array, Array]:
        """Return thresholds and weights."""
        return self.r, self.q


@njit(cache=True, nogil=True)
def extremes_left(new: float, x: float, h: float, n: int, extreme: Array, value: Array) -> int:
    """
    Return how many extremes a Preisach operator remembers where its input goes from x to new.

    They are a minimum, a maximum, a minimum, ..., and `value` is the output when each was reached;
    h is that at x.  Of more than there is room for, the smallest loops are forgotten.
    """
    rising = new > x
    if rising != (n % 2 == 1):
        if n == extreme.size:
            n -= 2
        else:
            extreme[n], value[n] = x, h
            n += 1
    if rising:
        while n >= 3 and new >= extreme[n - 2]:
            n -= 2
    else:
        while n >= 2 and new <= extreme[n - 2]:
            n -= 2
    return max(n, 1)


@njit(cache=True, nogil=True)
def _everett(
    u: Array, amount: Array, order: Array, scale: Array, kappa: float, out: Array
) -> None:
    extreme, value = np.empty(DEPTH), np.empty(DEPTH)
    extreme[0], value[0] = 0.0, 0.0
    n, x, h = 1, 0.0, 0.0
    for k in range(u.size):
        new = max(u[k], 0.0)
        if new != x:
            n = extremes_left(new, x, h, n, extreme, value)
            last = extreme[n - 1]
            g = _g(abs(new - last), amount, order, scale)
            g *= 1.0 + kappa * (new + last - 1.0)
            h = value[n - 1] + (g if new > last else -g)
            x = new
        out[k] = h


def everett(u: Array, density: Density, kappa: float = 0.0) -> Array:
    """
    Return the Preisach operator of a density, from the virgin state at u = 0.

    `kappa`: the Everett function is g(a - b) (1 + kappa (a + b - 1)): the density of switches at
    (a, b) then varies with a + b, and equal loops differ with their bias.
    """
    out = np.empty(u.size)
    d = density
    _everett(np.ascontiguousarray(u), d.amount, d.order, d.scale, kappa, out)
    return out


@njit(cache=True, nogil=True)
def _plays(
    u: Array,
    r: Array,
    q: Array,
    low: Array,
    high: Array,
    additive: bool,
    follow: float,
    forget: float,
    curve: float,
    out: Array,
) -> None:
    # low, high: how far each edge of every play moves outwards at each sample
    state = np.zeros(r.size)
    for k in range(u.size):
        x, total = u[k], 0.0
        for i in range(r.size):
            f = state[i]
            unit = 1.0 if additive else r[i]
            target = min(max(f, x - r[i] - unit * low[k]), x + unit * high[k])
            f += follow * (target - f)
            f += forget * (x - 0.5 * r[i] - f)
            state[i] = f
            total += q[i] * f
            if curve != 0.0:
                total += q[i] * curve * (math.expm1(2.0 * f) / 6.38905609893065 - f)
        out[k] = total


def plays(
    u: Array,
    density: Density | Row,
    low: Array | None = None,
    high: Array | None = None,
    additive: bool = False,
    follow: float = 1.0,
    forget: float = 0.0,
    curve: float = 0.0,
) -> Array:
    """
    Return a dense row of one-sided plays, from the virgin state at u = 0.

    `low`, `high`: how far the lower and the upper edge of every play move outwards, in parts of
    its width; `additive`: those are parts of the span instead, the same for every play; `follow`:
    share of the way to its place that a play moves in one sample; 1 is a stiff play; `forget`:
    share of the way to the middle of its band that a play relaxes in one sample; `curve`: k of the
    envelopes F + k ((exp(2 F) - 1) / (exp(2) - 1) - F): generalised plays.
    """
    r, q = density.row()
    still = np.zeros(u.size)
    out = np.empty(u.size)
    _plays(
        np.ascontiguousarray(u),
        r,
        q,
        still if low is None else low,
        still if high is None else high,
        additive,
        follow,
        forget,
        curve,
        out,
    )
    return out

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Laws of the past set, which the diagnosis was judged on and may be looked at since.

- a balance of energies, whose irreversible part every turn begins anew (Hauser, J. Appl. Phys. 96
  (2004) 2753),
- a branch that comes nearer to its limiting loop the farther the last turn is away (de Almeida,
  Deep, Lima, Neff, Opt. Eng. 41 (2002) 2582),
- an elastic line that hops from pin to pin, its neighbours with it (Middleton, Phys. Rev. Lett. 68
  (1992) 670),
- plastic strain that goes the faster the nearer a bounding line is, beside where the last turn was
  (Dafalias, Popov, Acta Mech. 21 (1975) 173), without an elastic domain, elements in series.
"""

from __future__ import annotations

import math

from numba import njit
import numpy as np
from numpy.typing import NDArray

from .cores import Law, law_of

Array = NDArray[np.float64]
Rng = np.random.Generator

#: how many sites of the line, pins of each, and elements in series
SITES, PINS, ELEMENTS = 1200, 100, 4
#: sites that are looked at together
NEAR = 12
#: most steps of a search for a root, which is found when so little is missing
ROOTS, EXACT = 60, 1e-12
#: a balance of energies is never nearer to saturation, and its turns have so much left at least
SATURATED, LEFT = 1.0 - 1e-9, 1e-9


@njit(cache=True, nogil=True)
def _balance(m: float, way: float, turn: float, left: float, p: Array) -> tuple[float, float]:
    """
    Return the field of a moment on a branch, and its slope.

    Parameters
    ----------
    m, way : float
        Moment, -1 to 1, and where it goes.
    turn, left : float
        Moment at the last turn, and how much the loss is less there than it comes to.
    p : ndarray
        Field of the moment itself; of what turns reversibly, and its power; of the pins, how it
        grows with the reversible one, and how fast it is there over the moment.
    """
    opposing, reversible, power, pinning, more, rate = p[0], p[1], p[2], p[3], p[4], p[5]
    up, down = math.log(1.0 + m), math.log(1.0 - m)
    grown = math.exp(0.5 * power * ((1.0 + m) * up + (1.0 - m) * down))
    side = 1.0 if m >= 0.0 else -1.0
    field = side * reversible * (grown - 1.0)
    slope = side * reversible * grown * 0.5 * power * (up - down)
    gone = left * math.exp(-rate / left * abs(m - turn))
    loss = pinning + more * side * field
    slope += way * more * side * slope * (1.0 - gone) + loss * rate / left * gone
    return opposing * m + field + way * loss * (1.0 - gone), opposing + slope


@njit(cache=True, nogil=True)
def _energy_balance(u: Array, middle: float, p: Array, out: Array) -> None:
    # from the moment 0, on the initial curve; the branches of a turn meet there
    m, way, turn, left, last = 0.0, 0.0, 0.0, 1.0, middle
    for k in range(u.size):
        if u[k] != last:
            on = 1.0 if u[k] > last else -1.0
            if on != way and way != 0.0:
                left = max(2.0 - left * math.exp(-p[5] / left * abs(m - turn)), LEFT)
                turn = m
            way, last = on, u[k]
            # from where it is to saturation, by Newton, or by halves where that leads out
            low, high = (m, SATURATED) if on > 0.0 else (-SATURATED, m)
            for _ in range(ROOTS):
                field, slope = _balance(m, way, turn, left, p)
                missing = u[k] - middle - field
                if missing > 0.0:
                    low = m
                else:
                    high = m
                if abs(missing) < EXACT or high - low < EXACT:
                    break
                trial = m + missing / slope if slope > 0.0 else low
                m = trial if low < trial < high else 0.5 * (low + high)
        out[k] = m


def energy_balance(rng: Rng) -> Law:
    """Draw a balance of energies, around the middle of the range."""
    low, high = np.array([[0.6, 0.02, 3.0, 0.06, 0.0, 18.0], [1.3, 0.1, 7.0, 0.12, 0.5, 45.0]])
    return law_of(_energy_balance, rng.uniform(0.4, 0.6), rng.uniform(low, high))


@njit(cache=True, nogil=True)
def _limiting_loops(
    u: Array, at: float, apart: float, steep: float, near: float, out: Array
) -> None:
    # a branch is its limiting one at another input, which is `ahead` of u at the turn; so much of
    # its slope is missing there as `near` says
    way, turn, ahead, last = 1.0, u[0], 0.0, u[0]
    place = last - at - 0.5 * apart
    for k in range(u.size):
        x = u[k]
        if x != last:
            on = 1.0 if x > last else -1.0
            if on != way:
                # so far is the other limiting branch from where this one came to
                turn, ahead = last, place - (last - at - on * 0.5 * apart)
                way = on
            last = x
            place = x - at - on * 0.5 * apart
            if ahead * on > 0.0:
                far = (x - turn) / ahead
                cut = 1.0 + math.tanh(math.pi * (math.pi - 2.0 * far))
                place += ahead * 0.5 * (1.0 - math.sin(near * far)) * cut
        out[k] = math.tanh(steep * place)


def limiting_loops(rng: Rng) -> Law:
    """Draw a limiting loop that is wider than the range."""
    return law_of(
        _limiting_loops,
        rng.uniform(0.0, 1.0),
        rng.uniform(0.12, 0.24),
        rng.uniform(0.5, 1.6),
        rng.uniform(0.7, 0.95),
    )


@njit(cache=True, nogil=True)
def _rest(i: int, pin: NDArray[np.int64], at: Array, tension: float) -> float:
    """Return the input that draws a site neither way."""
    after = (i + 1) % pin.size
    x = at[i, pin[i]]
    return x + tension * (2.0 * x - at[i - 1, pin[i - 1]] - at[after, pin[after]])


@njit(cache=True, nogil=True)
def _hops(
    g: int,
    pin: NDArray[np.int64],
    at: Array,
    strength: Array,
    tension: float,
    least: Array,
    most: Array,
) -> None:
    """Set where the first site of a group hops back, and where the first hops on."""
    least[g], most[g] = -math.inf, math.inf
    for i in range(g * NEAR, min((g + 1) * NEAR, pin.size)):
        rest, held = _rest(i, pin, at, tension), strength[i, pin[i]]
        least[g] = max(least[g], rest - held if pin[i] > 0 else -math.inf)
        most[g] = min(most[g], rest + held if pin[i] < at.shape[1] - 1 else math.inf)


@njit(cache=True, nogil=True)
def _pinned_line(u: Array, at: Array, strength: Array, tension: float, out: Array) -> None:
    # a site that hops draws its neighbours along, so that all come to rest in the same state in
    # whatever order they are taken
    count, last = at.shape[0], at.shape[1] - 1
    groups = (count + NEAR - 1) // NEAR
    pin = np.zeros(count, np.int64)
    least, most, whole = np.empty(groups), np.empty(groups), 0.0
    for i in range(count):
        while pin[i] < last and at[i, pin[i]] < u[0]:
            pin[i] += 1
        whole += at[i, pin[i]]
    for g in range(groups):
        _hops(g, pin, at, strength, tension, least, most)
    lowest, highest = least.max(), most.min()
    for k in range(u.size):
        while lowest > u[k] or highest < u[k]:
            on = highest < u[k]
            g = int(np.argmin(most)) if on else int(np.argmax(least))
            first, end = g * NEAR, min((g + 1) * NEAR, count)
            for i in range(first, end):
                j, rest = pin[i], _rest(i, pin, at, tension)
                if on and j < last and rest + strength[i, j] < u[k]:
                    pin[i] += 1
                elif not on and j > 0 and rest - strength[i, j] > u[k]:
                    pin[i] -= 1
                else:
                    continue
                whole += at[i, pin[i]] - at[i, j]
                if i == first:
                    _hops((g - 1) % groups, pin, at, strength, tension, least, most)
                if i == end - 1:
                    _hops((g + 1) % groups, pin, at, strength, tension, least, most)
            _hops(g, pin, at, strength, tension, least, most)
            lowest, highest = least.max(), most.min()
        out[k] = whole / count


def pinned_line_of(at: Array, strength: Array, tension: float) -> Law:
    """
    Return the mean place of a closed line that u draws.

    Parameters
    ----------
    at, strength : ndarray, shape (n, m)
        Places of the pins of each site, rising, and how much each holds.
    tension : float
        How much a site is drawn to each of its neighbours, beside how much to u.
    """
    # or a site would hop back at once
    gap = (0.5 + tension) * np.diff(at, axis=1)
    least = np.maximum(np.pad(gap, ((0, 0), (1, 0))), np.pad(gap, ((0, 0), (0, 1))))
    return law_of(_pinned_line, at, np.maximum(strength, least), tension)


def pinned_line(rng: Rng) -> Law:
    """Draw a line over pins that hold more at one end."""
    at = -0.5 + np.cumsum(rng.uniform(0.4, 1.6, (SITES, PINS)) * 2.0 / PINS, axis=1)
    strength = rng.uniform(0.04, 0.1) * rng.exponential(1.0, at.shape)
    lean, tension = rng.uniform(-0.6, 0.6), rng.uniform(0.1, 0.3)
    return pinned_line_of(at, strength * np.exp(lean * (2.0 * at - 1.0)), tension)


@njit(cache=True, nogil=True)
def _bounding_lines(
    u: Array, middle: float, bound: Array, hard: Array, weight: Array, out: Array
) -> None:
    # bound: how far the lines of each element are from their middle; hard: how slowly it comes to
    # them, 1 or more.  Strain over u has the slope 1 / (1 + hard gap / (first - gap)), of the gap
    # to the line and the first one at the turn: u goes with log(first / gap), for a step of any
    # length
    strain, first, gone = np.zeros(bound.size), bound.copy(), np.zeros(bound.size)
    way, turn, last = 0.0, middle, middle
    for k in range(u.size):
        if u[k] != last:
            on = 1.0 if u[k] > last else -1.0
            if on != way:
                for i in range(bound.size):
                    # a strain may stand on its line, by rounding
                    first[i] = max(bound[i] + on * (strain[i] - (last - middle)), EXACT)
                    gone[i] = 0.0
                way, turn = on, last
            last = u[k]
            for i in range(bound.size):
                aim = hard[i] * abs(last - turn) / first[i]
                # concave: Newton's steps come to the root from one side
                for _ in range(ROOTS):
                    left = math.exp(-gone[i])
                    missing = aim - gone[i] - (hard[i] - 1.0) * (1.0 - left)
                    if abs(missing) < EXACT:
                        break
                    gone[i] += missing / (1.0 + (hard[i] - 1.0) * left)
                gap = first[i] * math.exp(-gone[i])
                strain[i] = last - middle + on * (gap - bound[i])
        total = 0.0
        for i in range(bound.size):
            total += weight[i] * strain[i]
        out[k] = total


def bounding_lines(rng: Rng) -> Law:
    """Draw elements in series, the weaker ones longer."""
    bound = (np.arange(ELEMENTS) + rng.uniform(0.2, 1.0, ELEMENTS)) / ELEMENTS
    bound *= rng.uniform(0.15, 0.28)
    weight = np.exp(-bound / rng.uniform(0.08, 0.25)) * rng.uniform(0.7, 1.3, ELEMENTS)
    hard = np.exp(rng.uniform(math.log(2.0), math.log(12.0), ELEMENTS))
    return law_of(_bounding_lines, rng.uniform(0.25, 0.75), bound, hard, weight)

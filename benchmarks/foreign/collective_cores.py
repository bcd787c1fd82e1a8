# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Laws of many members: the past set, which the diagnosis was judged on and may be looked at since.

- relays with lognormal coercive and normal interaction fields (Smith, Seelecke, Dapino, Ounaies,
  J. Mech. Phys. Solids 54 (2006) 46) in a field that goes with the output, the moving Preisach
  model (Della Torre, IEEE Trans. Audio Electroacoust. 14 (1966) 86),
- contacts whose load goes with the output that they hold (Yang, Chu, Menq, J. Sound Vib. 210
  (1998) 461), beside a hardening spring,
- cells of two dimensions with dry friction (Bergqvist, Physica B 233 (1997) 342) in a field that
  turns as it grows,
- walls in rugged potentials (Prandtl, Z. Angew. Math. Mech. 8 (1928) 85) whose wells give way
  unequally,
- bistable dipoles in random fields (Sethna et al., Phys. Rev. Lett. 70 (1993) 3347) with bonds of
  both signs, which need not come back to where they turned (Deutsch, Dhar, Narayan, Phys. Rev.
  Lett. 92 (2004) 227203).
"""

from __future__ import annotations

import math

from numba import njit
import numpy as np
from numpy.typing import NDArray

from .cores import DEPTH, everett_table, Law, law_of, preisach_step, STEP

__all__ = [
    'contacts_of',
    'dipoles_of',
    'frustrated_dipoles',
    'loaded_contacts',
    'moving_of',
    'moving_preisach',
    'rugged_walls',
    'turning_friction',
    'turning_friction_of',
    'walls_of',
]

Array = NDArray[np.float64]
Rng = np.random.Generator

#: how many contacts, cells with friction, walls, wells of each, and dipoles
CONTACTS, CELLS, WALLS, WELLS, DIPOLES = 24, 20, 2000, 32, 8000
#: walls or dipoles that are looked at together
GROUP = 25
#: most steps of a search for a root, which is found when so little is missing
ROOTS, EXACT = 60, 1e-13


@njit(cache=True, nogil=True)
def _moving(u: Array, feedback: float, table: Array, diagonal: Array, out: Array) -> None:
    # x = (u + feedback h(x)) / (1 + feedback), by false position, halving the end that stays
    extreme, value = np.empty(DEPTH), np.empty(DEPTH)
    extreme[0], value[0] = 0.0, 0.0
    n, x, h, last = 1, 0.0, 0.0, 0.0
    for k in range(u.size):
        new = min(max(u[k], 0.0), 1.0)
        here = (1.0 + feedback) * x - feedback * h - new
        # at rest a root that is known is not sought again
        if new != last and abs(here) > EXACT:
            a, fa, b = x, here, 1.0 if here < 0.0 else 0.0
            # all relays are up at 1 and down at 0
            fb = 1.0 - new if b == 1.0 else -new
            root = b
            for _ in range(ROOTS):
                if fb == 0.0 or abs(b - a) < EXACT:
                    break
                root = b - fb * (b - a) / (fb - fa)
                # a trial writes beyond the extremes in use alone
                _, there = preisach_step(root, x, h, n, extreme, value, table, diagonal)
                f = (1.0 + feedback) * root - feedback * there - new
                if abs(f) < EXACT:
                    break
                if (f < 0.0) == (fb < 0.0):
                    fa *= 0.5
                else:
                    a, fa = b, fb
                b, fb = root, f
            n, h = preisach_step(root, x, h, n, extreme, value, table, diagonal)
            x = root
        last = new
        out[k] = h


def moving_of(feedback: float, table: Array, diagonal: Array) -> Law:
    """Return relays of an Everett function from 0 to 1, in a field that goes with their sum."""
    return law_of(_moving, feedback, table, diagonal)


def moving_preisach(rng: Rng) -> Law:
    """Draw relays in a field that goes with the output."""
    coercive, spread = rng.uniform(0.08, 0.2), rng.uniform(0.5, 0.9)
    at, broad = rng.uniform(0.35, 0.65), rng.uniform(0.22, 0.4)
    feedback = rng.uniform(0.25, 0.6) * rng.choice([-1.0, 1.0])

    def density(a: Array, b: Array) -> Array:
        half = np.maximum(0.5 * (a - b), 1e-6)
        own = np.exp(-0.5 * (np.log(half / coercive) / spread) ** 2) / half
        return np.asarray(own * np.exp(-0.5 * ((0.5 * (a + b) - at) / broad) ** 2))

    table, diagonal = everett_table(density)
    whole = float(table[-1, 0])
    return moving_of(feedback, table / whole, diagonal / whole)


@njit(cache=True, nogil=True)
def _contacts(u: Array, stiff: Array, limit: Array, load: Array, p: Array, out: Array) -> None:
    # u - x = spring(x) + sum of what contacts hold, in units of the stiffness through which u
    # pushes; exact for any step, since a contact that slides on one way stays at its limit
    soft, hardening, middle = p[0], p[1], p[2]
    held, x = np.zeros(stiff.size), 0.0
    for k in range(u.size):
        new = x
        for _ in range(ROOTS):
            at = new - middle
            rest = u[k] - new - soft * (new + hardening * (at**3 + middle**3) / 3.0)
            slope = 1.0 + soft * (1.0 + hardening * at * at)
            for j in range(held.size):
                force, most = held[j] + stiff[j] * (new - x), limit[j] * (1.0 + load[j] * new)
                if abs(force) <= most:
                    rest -= force
                    slope += stiff[j]
                else:
                    way = 1.0 if force > 0.0 else -1.0
                    rest -= way * most
                    slope += way * limit[j] * load[j]
            new += rest / slope
            if abs(rest) < EXACT:
                break
        for j in range(held.size):
            most = limit[j] * (1.0 + load[j] * new)
            held[j] = min(max(held[j] + stiff[j] * (new - x), -most), most)
        x = new
        out[k] = x


def contacts_of(
    stiff: Array, limit: Array, load: Array, soft: float, hardening: float, middle: float
) -> Law:
    """
    Return an output that a spring and contacts hold.

    Parameters
    ----------
    stiff, limit, load : ndarray
        Of each contact: stiffness, where it slides at 0, and by what part that grows up to 1.
    soft, hardening, middle : float
        Stiffness of the spring, least at the middle, and how it grows from there.
    """
    spring = np.array([soft, hardening, middle])
    return law_of(_contacts, stiff, limit, load, spring)


def loaded_contacts(rng: Rng) -> Law:
    """Draw contacts, some pressed on and some relieved by the output, beside a spring."""
    reach = (np.arange(CONTACTS) + rng.uniform(0.2, 1.0)) / CONTACTS * rng.uniform(0.15, 0.35)
    stiff = np.exp(-reach / rng.uniform(0.05, 0.2)) * rng.uniform(0.7, 1.3, CONTACTS)
    load = rng.uniform(-0.8, 0.8, CONTACTS) + rng.uniform(1.5, 4.0) * reach / reach[-1]
    limit = reach * stiff / (1.0 + 0.5 * load)
    limit *= rng.uniform(0.2, 0.4) / np.sum(limit * (1.0 + 0.5 * load))
    return contacts_of(
        limit / reach,
        limit,
        load,
        soft=rng.uniform(0.3, 1.0),
        hardening=rng.uniform(0.5, 3.0),
        middle=rng.uniform(0.0, 0.4),
    )


@njit(cache=True, nogil=True)
def _turning_friction(
    u: Array, bow: float, reach: Array, weight: Array, soft: float, out: Array
) -> None:
    # each cell is drawn along as on a leash by a field that goes through an arc of chords
    p, q = np.zeros(reach.size), np.zeros(reach.size)
    x = u[0]
    y = 4.0 * bow * x * (1.0 - x)
    for k in range(u.size):
        begin = x
        parts = int(abs(u[k] - begin) / STEP) + 1 if u[k] != begin else 0
        for i in range(1, parts + 1):
            to = begin + i * (u[k] - begin) / parts
            up = 4.0 * bow * to * (1.0 - to)
            far = math.hypot(to - x, up - y)
            tx, ty = (to - x) / far, (up - y) / far
            for j in range(reach.size):
                r = reach[j]
                if (to - p[j]) ** 2 + (up - q[j]) ** 2 > r * r:
                    # taut from here on; then the leash turns into the way as a tractrix does
                    along = (x - p[j]) * tx + (y - q[j]) * ty
                    beside = (x - p[j]) * ty - (y - q[j]) * tx
                    taut = math.sqrt(max(r * r - beside * beside, 0.0))
                    pulled = min(max(far + along - taut, 0.0), far)
                    half = beside / (r + taut) * math.exp(-pulled / r)
                    whole = r / (1.0 + half * half)
                    ahead, aside = whole * (1.0 - half * half), 2.0 * whole * half
                    p[j] = to - ahead * tx - aside * ty
                    q[j] = up - ahead * ty + aside * tx
            x, y = to, up
        x = u[k]
        total = 0.0
        for j in range(reach.size):
            # along the first axis, from the middle of the arc's ends, less the farther it is
            a = p[j] - 0.5
            total += weight[j] * a / math.sqrt(1.0 + (a * a + q[j] * q[j]) / (soft * soft))
        out[k] = total


def turning_friction_of(bow: float, reach: Array, weight: Array, soft: float) -> Law:
    """Return cells with friction in a field along an arc that is so high."""
    return law_of(_turning_friction, bow, reach, weight, soft)


def turning_friction(rng: Rng) -> Law:
    """Draw cells with friction, in a field that turns."""
    reach = (np.arange(CELLS) + rng.uniform(0.0, 1.0)) / CELLS
    weight = np.exp(-reach / rng.uniform(0.15, 0.4)) * rng.uniform(0.8, 1.2, CELLS)
    return turning_friction_of(rng.uniform(0.25, 0.7), reach, weight, rng.uniform(0.5, 1.5))


@njit(cache=True, nogil=True)
def _walls(u: Array, edges: Array, stiff: Array, out: Array) -> None:
    # a wall is drawn to u and to the middle c of its well: x = (u + stiff c) / (1 + stiff), until
    # it comes to an edge and falls into the next; edges (m, wells + 1), stiff (m, wells)
    count, wells = stiff.shape
    well = np.zeros(count, np.int64)
    level, slope = np.zeros(count), np.zeros(count)
    # where the first of each group falls, so that most need not be looked at
    groups = (count + GROUP - 1) // GROUP
    least, most = np.full(groups, math.inf), np.full(groups, -math.inf)
    whole_level, whole_slope = 0.0, 0.0
    for k in range(u.size):
        x = u[k]
        for g in range(groups):
            if least[g] <= x <= most[g]:
                continue
            least[g], most[g] = -math.inf, math.inf
            for i in range(g * GROUP, min((g + 1) * GROUP, count)):
                j = well[i]
                while j < wells - 1 and x > _up(edges[i, j], edges[i, j + 1], stiff[i, j]):
                    j += 1
                while j > 0 and x < _up(edges[i, j + 1], edges[i, j], stiff[i, j]):
                    j -= 1
                well[i] = j
                most[g] = min(most[g], _up(edges[i, j], edges[i, j + 1], stiff[i, j]))
                least[g] = max(least[g], _up(edges[i, j + 1], edges[i, j], stiff[i, j]))
                give = 1.0 / (1.0 + stiff[i, j])
                fixed = (1.0 - give) * 0.5 * (edges[i, j] + edges[i, j + 1])
                whole_slope += give - slope[i]
                whole_level += fixed - level[i]
                slope[i], level[i] = give, fixed
        out[k] = (whole_level + whole_slope * x) / count


@njit(cache=True, nogil=True)
def _up(near: float, far: float, stiff: float) -> float:
    """Return the input that draws a wall to the far edge of its well."""
    return far + 0.5 * stiff * (far - near)


def walls_of(edges: Array, stiff: Array) -> Law:
    """Return the mean of walls in wells between edges (m, wells + 1), of stiffness (m, wells)."""
    return law_of(_walls, edges, stiff)


def rugged_walls(rng: Rng) -> Law:
    """Draw walls in rugged potentials, the wells stiffer at one end."""
    width = rng.uniform(0.05, 0.1) * (0.3 + rng.exponential(1.0, (WALLS, WELLS)))
    start = -0.7 - rng.uniform(0.0, 0.2, (WALLS, 1))
    edges = np.concatenate([start, start + np.cumsum(width, axis=1)], axis=1)
    middle = 0.5 * (edges[:, 1:] + edges[:, :-1])
    spread, lean = rng.uniform(0.5, 1.2), rng.uniform(-0.6, 0.6)
    stiff = rng.uniform(2.0, 5.0) * np.exp(spread * rng.standard_normal(width.shape))
    return walls_of(edges, stiff * np.exp(lean * (2.0 * middle - 1.0)))


@njit(cache=True, nogil=True)
def _looked_at(
    g: int, up: Array, centre: Array, coercive: Array, least: Array, most: Array
) -> None:
    """Set where the first dipole of a group falls, and where the first rises."""
    least[g], most[g] = -math.inf, math.inf
    for i in range(g * GROUP, min((g + 1) * GROUP, up.size)):
        if up[i] > 0.0:
            least[g] = max(least[g], centre[i] - coercive[i])
        else:
            most[g] = min(most[g], centre[i] + coercive[i])


@njit(cache=True, nogil=True)
def _dipoles(
    u: Array, field: Array, coercive: Array, bonds: Array, strides: Array, out: Array
) -> None:
    # one flips after another, the most unstable first, each moving its neighbours' fields; a bond
    # (m, i) is that of i with i + strides[m]
    count = field.size
    groups = (count + GROUP - 1) // GROUP
    centre, up = field.copy(), np.zeros(count)
    least, most = np.empty(groups), np.empty(groups)
    for g in range(groups):
        _looked_at(g, up, centre, coercive, least, most)
    lowest, highest, risen, x = least.max(), most.min(), 0.0, u[0]
    for k in range(u.size):
        while lowest >= x or highest <= x or x != u[k]:
            if lowest < x < highest:
                # all rest; on to where the next one flips, whatever the step
                x = min(max(u[k], lowest), highest)
                continue
            falls = lowest - x > x - highest
            g = int(np.argmax(least)) if falls else int(np.argmin(most))
            for i in range(g * GROUP, min((g + 1) * GROUP, count)):
                if falls and up[i] > 0.0 and centre[i] - coercive[i] == lowest:
                    break
                if not falls and up[i] == 0.0 and centre[i] + coercive[i] == highest:
                    break
            change = -1.0 if falls else 1.0
            up[i] += change
            risen += change
            _looked_at(g, up, centre, coercive, least, most)
            for m in range(strides.size):
                after, before = (i + strides[m]) % count, (i - strides[m]) % count
                centre[after] -= change * bonds[m, i]
                centre[before] -= change * bonds[m, before]
                _looked_at(after // GROUP, up, centre, coercive, least, most)
                _looked_at(before // GROUP, up, centre, coercive, least, most)
            lowest, highest = least.max(), most.min()
        out[k] = risen / count


def dipoles_of(field: Array, coercive: Array, bonds: Array, strides: Array) -> Law:
    """
    Return the share of dipoles that are up.

    Parameters
    ----------
    field, coercive : ndarray, shape (n,)
        A dipole rises beyond field + coercive and falls below field - coercive.
    bonds : ndarray, shape (m, n)
        How far a dipole that is up moves that which is so many strides on, and the reverse.
    strides : ndarray of int, shape (m,)
    """
    return law_of(_dipoles, field, coercive, bonds, strides)


def frustrated_dipoles(rng: Rng) -> Law:
    """Draw dipoles of which some hold and some hinder one another."""
    field = rng.normal(rng.uniform(0.2, 0.8), rng.uniform(0.4, 0.7), DIPOLES)
    coercive = np.exp(rng.uniform(0.3, 0.7) * rng.standard_normal(DIPOLES))
    coercive *= rng.uniform(0.1, 0.25)
    strides = np.array([1, 71])
    bonds = rng.uniform(0.2, 0.5) * rng.standard_normal((2, DIPOLES))
    return dipoles_of(field, coercive, bonds, strides)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Laws of the final set, which nothing is tuned on.

- moments in a plane that a field drags behind it against friction (Bergqvist, Physica B 233 (1997)
  342), where the field turns as it grows,
- spins with friction and bonds of both signs, so that one may go back while the field rises (after
  Pazmandi, Zarand, Zimanyi, Phys. Rev. Lett. 83 (1999) 1034, where all are bound to all),
- Maxwell's sliders between charge and voltage (Goldfarb, Celanovic, IEEE Control Syst. Mag. 17
  (1997) 69), whose limits go with the charge, beside a capacitor that is not linear,
- a branch whose slope is that of its limiting branch, by the share of the gap between the limiting
  branches that lies ahead (Tellinen, IEEE Trans. Magn. 34 (1998) 2200).
"""

from __future__ import annotations

import math

from numba import njit
import numpy as np
from numpy.typing import NDArray

from .cores import Array, Law, law_of, Rng, STEP

#: how many moments, spins, bonds to either side of each, and sliders
MOMENTS, SPINS, BONDS, SLIDERS = 6, 12000, 4, 14
#: spins that are looked at together
NEAR = 40
#: most steps of a search for a root, which is found when so little is missing
ROOTS, EXACT = 60, 1e-13
#: the least slope of the voltage over the charge
SOFTEST = 0.1


@njit(cache=True, nogil=True)
def _dragged(
    u: Array, middle: float, tether: Array, bow: Array, weight: Array, full: float, out: Array
) -> None:
    # the field goes straight over a part of a step.  A moment rests until its tether is tight, and
    # then follows it on a tractrix: tan(half the angle to the way) goes with exp(-way / tether)
    last = u[0]
    x, y = np.full(tether.size, last - middle), bow * (last - middle) ** 2
    for k in range(u.size):
        parts = int(abs(u[k] - last) / STEP) + 1 if u[k] != last else 0
        for j in range(parts):
            start = last + (u[k] - last) * j / parts - middle
            end = last + (u[k] - last) * (j + 1) / parts - middle
            for i in range(tether.size):
                along, across = end - start, bow[i] * (end - start) * (end + start)
                way = math.sqrt(along * along + across * across)
                if way == 0.0:
                    continue
                along, across = along / way, across / way
                # from the moment to the field, on the way and to its left
                dx, dy = start - x[i], bow[i] * start * start - y[i]
                ahead, aside = dx * along + dy * across, dy * along - dx * across
                r = tether[i]
                # so far until the tether is tight
                free = math.sqrt(max(r * r - aside * aside, 0.0)) - ahead
                if free >= way:
                    continue
                ahead += max(free, 0.0)
                half = aside / (r + ahead) * math.exp(-(way - max(free, 0.0)) / r)
                ahead = r * (1.0 - half * half) / (1.0 + half * half)
                aside = 2.0 * r * half / (1.0 + half * half)
                x[i] = end - (ahead * along - aside * across)
                y[i] = bow[i] * end * end - (ahead * across + aside * along)
        last = u[k]
        total = 0.0
        for i in range(tether.size):
            total += weight[i] * x[i] / math.sqrt(1.0 + (x[i] * x[i] + y[i] * y[i]) / full**2)
        out[k] = total


def dragged_moments_of(
    middle: float, tether: Array, bow: Array, weight: Array, full: float
) -> Law:
    """
    Return a sum of moments along the axis that u changes.

    `middle`: where the field has no component along the axis; `tether`, `bow`, `weight`: of each
    moment: how far the field leaves it behind, the field across the axis over the square of the
    one along it, and its share; `full`: size to which a moment saturates.
    """
    return law_of(_dragged, middle, tether, bow, weight, full)


def dragged_moments(rng: Rng) -> Law:
    """Draw moments whose fields turn to both sides, the freer ones larger."""
    tether = (np.arange(MOMENTS) + rng.uniform(0.2, 1.0, MOMENTS)) / MOMENTS
    tether *= rng.uniform(0.15, 0.4)
    return dragged_moments_of(
        rng.uniform(0.25, 0.75),
        tether,
        rng.uniform(0.5, 2.5, MOMENTS) * rng.choice([-1.0, 1.0], MOMENTS),
        np.exp(-tether / rng.uniform(0.1, 0.4)) * rng.uniform(0.7, 1.3, MOMENTS),
        rng.uniform(0.6, 2.0),
    )


@njit(cache=True, nogil=True)
def _ready(
    g: int, up: NDArray[np.bool_], own: Array, friction: Array, least: Array, most: Array
) -> None:
    """Set where the first spin of a group goes down, and where the first goes up."""
    least[g], most[g] = -math.inf, math.inf
    for i in range(g * NEAR, min((g + 1) * NEAR, up.size)):
        if up[i]:
            least[g] = max(least[g], -own[i] - friction[i])
        else:
            most[g] = min(most[g], friction[i] - own[i])


@njit(cache=True, nogil=True)
def _bonds(u: Array, bias: Array, friction: Array, bond: Array, out: Array) -> None:
    # one spin after another, the one that is farthest from rest first; each lowers the energy, so
    # that all come to rest.  The field goes from one that gives way to the next, whatever the step
    count, near = bond.shape
    groups = (count + NEAR - 1) // NEAR
    up, own = np.zeros(count, np.bool_), bias.copy()
    for i in range(count):
        for d in range(near):
            own[i] -= bond[i, d] + bond[i - d - 1, d]
    least, most = np.empty(groups), np.empty(groups)
    for g in range(groups):
        _ready(g, up, own, friction, least, most)
    field, risen = u[0], 0
    lowest, highest = least.max(), most.min()
    for k in range(u.size):
        while True:
            if lowest < field < highest:
                if field == u[k]:
                    break
                field = min(max(u[k], lowest), highest)
                continue
            rises = field - highest >= lowest - field
            g = int(np.argmin(most)) if rises else int(np.argmax(least))
            i = g * NEAR
            while up[i] == rises or (
                friction[i] - own[i] != highest if rises else -own[i] - friction[i] != lowest
            ):
                i += 1
            up[i] = rises
            risen += 1 if rises else -1
            change = 2.0 if rises else -2.0
            for d in range(near):
                own[(i + d + 1) % count] += change * bond[i, d]
                own[i - d - 1] += change * bond[i - d - 1, d]
            first, end = (i - near) // NEAR, (i + near) // NEAR
            for h in range(first, end + 1):
                _ready(h % groups, up, own, friction, least, most)
            lowest, highest = least.max(), most.min()
        out[k] = risen / count


def random_bonds_of(bias: Array, friction: Array, bond: Array) -> Law:
    """
    Return the share of spins on a ring that are up, from none.

    `bias`, `friction`: residual field of each spin, and how far the field must be against it;
    `bond`: field of each spin at the next m, and of those at it; m is small beside n, and n a
    multiple of `NEAR`.
    """
    return law_of(_bonds, bias, friction, bond)


def random_bonds(rng: Rng) -> Law:
    """Draw spins over more than the range, with bonds of both signs."""
    spread = rng.uniform(0.05, 0.14)
    friction = rng.uniform(0.04, 0.12) * np.exp(rng.uniform(0.3, 0.8) * rng.standard_normal(SPINS))
    middle, half = rng.uniform(0.3, 0.7), rng.uniform(0.7, 1.1)
    bias = -middle - half * rng.uniform(-1.0, 1.0, SPINS)
    return random_bonds_of(bias, friction, spread * rng.standard_normal((SPINS, BONDS)))


@njit(cache=True, nogil=True)
def _sliders(
    u: Array, stiff: Array, limit: Array, lean: float, bend: float, force: Array, out: Array
) -> None:
    # u = x + bend (x^2 - x) + forces, each within limit (1 + lean (2 x - 1)): as none follows its
    # limit the faster, what the end of a step allows is what a step of any length comes to
    x, fresh = 0.0, force.copy()
    force = force.copy()
    for k in range(u.size):
        trial, low, high = x, -math.inf, math.inf
        for n in range(ROOTS):
            load, turn = max(1.0 + lean * (2.0 * trial - 1.0), 0.0), 2.0 * lean
            missing = u[k] - trial - bend * (trial * trial - trial)
            slope = 1.0 + bend * (2.0 * trial - 1.0)
            for i in range(stiff.size):
                fresh[i] = force[i] + stiff[i] * (trial - x)
                if abs(fresh[i]) < limit[i] * load:
                    slope += stiff[i]
                else:
                    side = 1.0 if fresh[i] > 0.0 else -1.0
                    fresh[i] = side * limit[i] * load
                    slope += side * limit[i] * turn
                missing -= fresh[i]
            if abs(missing) < EXACT or high - low < EXACT:
                break
            if n == 0:
                low = trial + min(missing, 0.0) / SOFTEST
                high = trial + max(missing, 0.0) / SOFTEST
            elif missing > 0.0:
                low = trial
            else:
                high = trial
            ahead = trial + missing / slope
            trial = ahead if low < ahead < high else 0.5 * (low + high)
        x = trial
        force[:] = fresh
        out[k] = x


def loaded_sliders_of(stiff: Array, limit: Array, lean: float, bend: float) -> Law:
    """
    Return the charge behind sliders and a capacitor.

    `stiff`, `limit`: of each slider: its spring, and where it slips at half the charge; `lean`,
    `bend`: how much the limits, and the stiffness of the capacitor, grow up to the full charge,
    less than 1.
    """
    return law_of(_sliders, stiff, limit, lean, bend, np.zeros(stiff.size))


def loaded_sliders(rng: Rng) -> Law:
    """Draw sliders that slip one after another, under a load that grows or falls."""
    # where each slips
    reach = (np.arange(SLIDERS) + rng.uniform(0.2, 1.0, SLIDERS)) / SLIDERS * rng.uniform(0.3, 0.8)
    limit = rng.uniform(0.3, 1.7, SLIDERS) * np.exp(-reach / rng.uniform(0.2, 0.6))
    limit *= rng.uniform(0.08, 0.25) / limit.sum()
    lean = rng.uniform(0.2, 0.6) * rng.choice([-1.0, 1.0])
    # or a slider would follow its limit
    reach = np.minimum(reach, 0.4 / abs(lean))
    return loaded_sliders_of(limit / reach, limit, lean, rng.uniform(-0.3, 0.3))


@njit(cache=True, nogil=True)
def _gap_shares(u: Array, at: float, apart: float, broad: float, wider: float, out: Array) -> None:
    # limiting branches x / sqrt(1 + x^2) that are `apart`, the falling one so much `wider`, and
    # do not cross in the range; dz = slope (aim - z) / (aim - other) du, exact for a rate and an
    # aim held over a part of the step
    z, last = 0.0, u[0]
    for k in range(u.size):
        du = u[k] - last
        parts = int(2.0 * abs(du) / STEP) + 1 if du != 0.0 else 0
        for j in range(parts):
            x = last + du * (j + 0.5) / parts
            rise, fall = (x - at - 0.5 * apart) / broad, (x - at + 0.5 * apart) / (broad * wider)
            rise_one, fall_one = 1.0 + rise * rise, 1.0 + fall * fall
            lower, upper = rise / math.sqrt(rise_one), fall / math.sqrt(fall_one)
            if du > 0.0:
                slope, aim = 1.0 / (broad * rise_one * math.sqrt(rise_one)), upper
            else:
                slope, aim = 1.0 / (broad * wider * fall_one * math.sqrt(fall_one)), lower
            gone = slope * abs(du) / parts / (upper - lower)
            z = aim + (z - aim) * math.exp(-gone)
        last = u[k]
        out[k] = z


def gap_shares(rng: Rng) -> Law:
    """Draw limiting branches that are farther apart than those of the range."""
    return law_of(
        _gap_shares,
        rng.uniform(0.2, 0.8),
        rng.uniform(0.15, 0.5),
        rng.uniform(0.5, 1.5),
        rng.uniform(0.9, 1.1),
    )

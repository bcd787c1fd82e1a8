# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Laws of the former set, which the diagnosis was judged on before those of the past one.

- plastic strain under stress, with back-stresses that fade (Armstrong, Frederick, CEGB report
  RD/B/N731, 1966; Chaboche, Int. J. Plast. 2 (1986) 149), elements in series,
- domains that begin at few places and grow from there past pins (after Ishibashi, Takagi, J. Phys.
  Soc. Jpn. 31 (1971) 506),
- fractions of phases that every turn scales anew (Ivshin, Pence, Int. J. Eng. Sci. 32 (1994) 681),
- grains whose moments turn, and jump at the astroid (Stoner, Wohlfarth, Phil. Trans. R. Soc. A 240
  (1948) 599),
- tetragonal grains that switch by 90 and 180 degrees where the work is enough (Hwang, Lynch,
  McMeeking, Acta Metall. Mater. 43 (1995) 2073), under residual stresses and in a field that their
  polarization opposes.
"""

from __future__ import annotations

import math

from numba import njit
import numpy as np
from numpy.typing import NDArray

from .cores import Law, law_of

Array = NDArray[np.float64]
Rng = np.random.Generator

#: how many elements, back-stresses of each, cells, phases, grains that turn and that switch
ELEMENTS, BACK, CELLS, PHASES, GRAINS, TETRAGONAL = 6, 2, 10000, 48, 4000, 12000
#: nodes between which the moment of a grain is a straight line
NODES = 257
#: whose multiples are spread evenly, their whole parts aside
GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
#: cells or grains that are looked at together
GROUP = 40
#: most steps of a search for a root, which is found when so little is missing
ROOTS, EXACT = 60, 1e-13


@njit(cache=True, nogil=True)
def _back_stresses(
    u: Array,
    middle: float,
    limit: Array,
    linear: Array,
    most: Array,
    fading: Array,
    weight: Array,
    out: Array,
) -> None:
    # dX = fading (most dp - X |dp|) and linear dp; p moves where u - middle - X is at the limit.
    # X is exponential in p on one way, so that a step of any length is exact
    strain, whole = np.zeros(limit.size), np.zeros(limit.size)
    back = np.zeros(most.shape)
    for k in range(u.size):
        total = 0.0
        for i in range(limit.size):
            rest = u[k] - middle - whole[i]
            if abs(rest) > limit[i]:
                way = 1.0 if rest > 0.0 else -1.0
                # concave in the move: Newton's steps come to the root from one side
                aim, move = abs(rest) - limit[i], 0.0
                for _ in range(ROOTS):
                    missing, slope = aim - linear[i] * move, linear[i]
                    for j in range(most.shape[1]):
                        gap = most[i, j] - way * back[i, j]
                        left = math.exp(-fading[i, j] * move)
                        missing -= gap * (1.0 - left)
                        slope += gap * fading[i, j] * left
                    if abs(missing) < EXACT:
                        break
                    move += missing / slope
                strain[i] += way * move
                whole[i] = linear[i] * strain[i]
                for j in range(most.shape[1]):
                    gap = most[i, j] - way * back[i, j]
                    back[i, j] = way * (most[i, j] - gap * math.exp(-fading[i, j] * move))
                    whole[i] += back[i, j]
            total += weight[i] * strain[i]
        out[k] = total


def back_stresses_of(
    middle: float, limit: Array, linear: Array, most: Array, fading: Array, weight: Array
) -> Law:
    """
    Return the plastic strain of elements in series.

    Parameters
    ----------
    middle : float
        Where there is no stress.
    limit, linear, weight : ndarray, shape (n,)
        Of each element: half its elastic domain, the back-stress that does not fade over strain,
        and its share of the length.
    most, fading : ndarray, shape (n, m)
        Of each back-stress: where it ends, and how fast over strain.
    """
    return law_of(_back_stresses, middle, limit, linear, most, fading, weight)


def back_stresses(rng: Rng) -> Law:
    """Draw elements in series, the weaker ones longer."""
    limit = (np.arange(ELEMENTS) + rng.uniform(0.2, 1.0, ELEMENTS)) / ELEMENTS
    limit *= rng.uniform(0.1, 0.25)
    return back_stresses_of(
        rng.uniform(0.25, 0.75),
        limit,
        rng.uniform(1.0, 3.0) * rng.uniform(0.6, 1.4, ELEMENTS),
        rng.uniform(0.02, 0.06) * rng.uniform(0.3, 1.7, (ELEMENTS, BACK)),
        np.exp(rng.uniform(math.log(15.0), math.log(60.0), (ELEMENTS, BACK))),
        np.exp(-limit / rng.uniform(0.1, 0.3)) * rng.uniform(0.7, 1.3, ELEMENTS),
    )


@njit(cache=True, nogil=True)
def _sides(
    g: int, up: NDArray[np.bool_], grow: Array, alone: Array, least: Array, most: Array
) -> None:
    """Set where the first cell of a group falls, and where the first rises."""
    count = up.size
    least[g], most[g] = -math.inf, math.inf
    for i in range(g * GROUP, min((g + 1) * GROUP, count)):
        # beside a cell that is already there a wall only has to come on
        other = up[i - 1] != up[i] or up[(i + 1) % count] != up[i]
        if up[i]:
            least[g] = max(least[g], grow[1, i] if other else alone[1, i])
        else:
            most[g] = min(most[g], grow[0, i] if other else alone[0, i])


@njit(cache=True, nogil=True)
def _growing(u: Array, grow: Array, alone: Array, out: Array) -> None:
    # a cell that rises makes its neighbours rise the sooner and fall the later, so that all come
    # to rest in the same state in whatever order they are taken
    count = grow.shape[1]
    groups = (count + GROUP - 1) // GROUP
    up = np.zeros(count, np.bool_)
    least, most = np.empty(groups), np.empty(groups)
    for g in range(groups):
        _sides(g, up, grow, alone, least, most)
    lowest, highest, risen = least.max(), most.min(), 0
    for k in range(u.size):
        x = u[k]
        while lowest >= x or highest <= x:
            rises = highest <= x
            g = int(np.argmin(most)) if rises else int(np.argmax(least))
            for i in range(g * GROUP, min((g + 1) * GROUP, count)):
                if up[i] == rises:
                    continue
                other = up[i - 1] == rises or up[(i + 1) % count] == rises
                at = (grow if other else alone)[0 if rises else 1, i]
                if (at <= x) if rises else (at >= x):
                    up[i] = rises
                    risen += 1 if rises else -1
                    if i == g * GROUP:
                        _sides((g - 1) % groups, up, grow, alone, least, most)
                    if i == min((g + 1) * GROUP, count) - 1:
                        _sides((g + 1) % groups, up, grow, alone, least, most)
            _sides(g, up, grow, alone, least, most)
            lowest, highest = least.max(), most.min()
        out[k] = risen / count


def growing_domains_of(grow: Array, alone: Array) -> Law:
    """
    Return the share of cells on a ring that are up.

    Parameters
    ----------
    grow, alone : ndarray, shape (2, n)
        Where a cell rises, and where it falls: beside one that has, and where none has.
    """
    return law_of(_growing, grow, alone)


def growing_domains(rng: Rng) -> Law:
    """Draw cells in which domains begin at few places, and grow past pins."""
    middle = rng.normal(rng.uniform(0.3, 0.7), rng.uniform(0.4, 0.7), CELLS)
    half = rng.uniform(0.04, 0.12) * np.exp(rng.uniform(0.3, 0.8) * rng.standard_normal(CELLS))
    more = rng.exponential(rng.uniform(0.1, 0.5), (2, CELLS))
    grow = np.stack([middle + half, middle - half])
    return growing_domains_of(grow, grow + np.array([[1.0], [-1.0]]) * more)


@njit(cache=True, nogil=True)
def _phase_fractions(u: Array, at: Array, broad: Array, weight: Array, out: Array) -> None:
    # on a rise what is missing shrinks as it does on the outer one, on a fall what is there
    there, last, begun = np.zeros(weight.size), u[0], np.exp(u[0] / broad)
    rise, fall = np.exp(-at[0] / broad), np.exp(-at[1] / broad)
    for k in range(u.size):
        x, total = u[k], 0.0
        for i in range(weight.size if x != last else 0):
            now = math.exp(x / broad[i])
            if x > last:
                there[i] = 1.0 - (1.0 - there[i]) * (1.0 + rise[i] * begun[i]) / (
                    1.0 + rise[i] * now
                )
            else:
                # of the outer fall 1 / (1 + 1 / z) is left
                z, before = fall[i] * now, fall[i] * begun[i]
                there[i] *= z / before * (1.0 + before) / (1.0 + z)
            begun[i] = now
        last = x
        for i in range(weight.size):
            total += weight[i] * there[i]
        out[k] = total


def phase_fractions_of(at: Array, broad: Array, weight: Array) -> Law:
    """
    Return a sum of fractions, from none.

    Parameters
    ----------
    at : ndarray, shape (2, n)
        Middles of the outer rise and of the outer fall, both logistic.
    broad, weight : ndarray, shape (n,)
    """
    return law_of(_phase_fractions, at, broad, weight)


def phase_fractions(rng: Rng) -> Law:
    """Draw phases that come and go over the whole range."""
    # as evenly as can be over middles and widths
    order = np.arange(PHASES)
    middle = -0.2 + 1.4 * ((rng.random() + order / PHASES) % 1.0)
    apart = -rng.uniform(0.14, 0.2) * np.log1p(-0.98 * ((rng.random() + order * GOLDEN) % 1.0))
    broad = rng.uniform(0.04, 0.1) * rng.uniform(0.7, 1.3, PHASES)
    return phase_fractions_of(
        np.stack([middle + 0.5 * apart, middle - 0.5 * apart]),
        broad,
        rng.uniform(0.7, 1.3, PHASES),
    )


@njit(cache=True, nogil=True)
def _moments(field: Array, axis: Array, fold: Array, out: Array) -> None:
    # cos(angle to the field) on the upper branch, (m, nodes) from the highest node down; a minimum
    # of sin^2(angle - axis) / 2 - field cos(angle), by Newton from the node before
    for i in range(axis.size):
        angle, last = axis[i], axis[i] + math.atan(math.tan(axis[i]) ** (1.0 / 3.0))
        for k in range(field.shape[1] - 1, -1, -1):
            h = field[i, k]
            # from where the field draws it to where it must go on
            low, high = (0.0, axis[i]) if h >= 0.0 else (axis[i], last)
            angle = min(max(angle, low), high)
            for _ in range(ROOTS if h > -fold[i] else 0):
                pull = 0.5 * math.sin(2.0 * (angle - axis[i])) + h * math.sin(angle)
                slope = math.cos(2.0 * (angle - axis[i])) + h * math.cos(angle)
                if pull > 0.0:
                    high = angle
                else:
                    low = angle
                if abs(pull) < EXACT or high - low < EXACT:
                    break
                trial = angle - pull / slope if slope > 0.0 else low
                angle = trial if low < trial < high else 0.5 * (low + high)
            # behind the fold no grain is on this branch
            out[i, k] = math.cos(angle)


@njit(cache=True, nogil=True)
def _rotating(
    u: Array,
    lower: Array,
    over: Array,
    rise: Array,
    fall: Array,
    low: float,
    high: float,
    out: Array,
) -> None:
    # the sum of the branches that the grains are on, kept on the nodes
    count, nodes = over.shape
    groups = (count + GROUP - 1) // GROUP
    least, most = np.full(groups, math.inf), np.full(groups, -math.inf)
    up, whole = np.zeros(count, np.bool_), lower.copy()
    for k in range(u.size):
        x = min(max(u[k], low), high)
        for g in range(groups):
            if least[g] < x < most[g]:
                continue
            least[g], most[g] = -math.inf, math.inf
            for i in range(g * GROUP, min((g + 1) * GROUP, count)):
                if up[i] and x <= fall[i]:
                    up[i] = False
                    whole -= over[i]
                elif not up[i] and x >= rise[i]:
                    up[i] = True
                    whole += over[i]
                if up[i]:
                    least[g] = max(least[g], fall[i])
                else:
                    most[g] = min(most[g], rise[i])
        place = (x - low) / (high - low) * (nodes - 1)
        j = min(int(place), nodes - 2)
        out[k] = (whole[j] + (whole[j + 1] - whole[j]) * (place - j)) / count


def rotating_grains_of(axis: Array, stiff: Array, own: Array, reach: tuple[float, float]) -> Law:
    """
    Return the mean moment of grains along the field, -1 to 1.

    Parameters
    ----------
    axis, stiff, own : ndarray, shape (n,)
        Of each grain: angle of its easy axis, anisotropy field, and residual field.
    reach : tuple of float
        Range of u, which ends there.
    """
    # of the field in which a grain jumps: it turns back in its opposite
    fold = (np.cos(axis) ** (2 / 3) + np.sin(axis) ** (2 / 3)) ** -1.5
    nodes = np.linspace(*reach, NODES)
    field = (nodes + own[:, None]) / stiff[:, None]
    upper, lower = np.empty(field.shape), np.empty(field.shape)
    _moments(field, axis, fold, upper)
    _moments(np.ascontiguousarray(-field[:, ::-1]), axis, fold, lower)
    lower = -lower[:, ::-1]
    over = np.ascontiguousarray(upper - lower)
    rise, fall = stiff * fold - own, -stiff * fold - own
    return law_of(_rotating, lower.sum(axis=0), over, rise, fall, *reach)


def rotating_grains(rng: Rng) -> Law:
    """Draw grains with easy axes all around, more or less aligned, in residual fields."""
    # of an even distribution over the sphere the cosines are even
    axis = np.arccos(rng.random(GRAINS) ** rng.uniform(0.4, 1.0))
    stiff = rng.uniform(0.2, 0.5) * np.exp(rng.uniform(0.2, 0.5) * rng.standard_normal(GRAINS))
    own = -rng.normal(rng.uniform(0.2, 0.8), rng.uniform(0.3, 0.6), GRAINS)
    return rotating_grains_of(axis, stiff, own, (0.0, 1.0))


@njit(cache=True, nogil=True)
def _first(
    g: int, state: NDArray[np.int64], rise: Array, fall: Array, least: Array, most: Array
) -> None:
    """Set where the first grain of a group switches down, and where the first switches up."""
    least[g], most[g] = -math.inf, math.inf
    for i in range(g * GROUP, min((g + 1) * GROUP, state.size)):
        least[g] = max(least[g], fall[i, state[i]])
        most[g] = min(most[g], rise[i, state[i]])


@njit(cache=True, nogil=True)
def _tetragonal(
    u: Array,
    along: Array,
    rise: Array,
    fall: Array,
    above: Array,
    below: Array,
    opposing: float,
    give: float,
    out: Array,
) -> None:
    # one grain switches after another, each where the field comes to it whatever the step
    count = along.shape[0]
    groups = (count + GROUP - 1) // GROUP
    state = np.zeros(count, np.int64)
    least, most = np.empty(groups), np.empty(groups)
    for g in range(groups):
        _first(g, state, rise, fall, least, most)
    lowest, highest = least.max(), most.min()
    moment, strain = along[:, 0].sum(), (along[:, 0] ** 2).sum()
    field = u[0] - opposing * moment / count
    for k in range(u.size):
        aim = u[k] - opposing * moment / count
        while field != aim or field <= lowest or field >= highest:
            if lowest < field < highest:
                field = min(max(aim, lowest), highest)
                continue
            rises = field >= highest
            g = int(np.argmin(most)) if rises else int(np.argmax(least))
            for i in range(g * GROUP, min((g + 1) * GROUP, count)):
                s = state[i]
                if (rises and rise[i, s] == highest) or (not rises and fall[i, s] == lowest):
                    break
            state[i] = above[i, s] if rises else below[i, s]
            change = along[i, state[i]] - along[i, s]
            moment += change
            strain += along[i, state[i]] ** 2 - along[i, s] ** 2
            field -= opposing * change / count
            aim = u[k] - opposing * moment / count
            _first(g, state, rise, fall, least, most)
            lowest, highest = least.max(), most.min()
        out[k] = (strain + give * field * moment) / count


def tetragonal_grains_of(
    along: Array,
    stress: Array,
    own: Array,
    work: tuple[float, float],
    opposing: float = 0.0,
    give: float = 0.0,
) -> Law:
    """
    Return the strain of grains along the field.

    Parameters
    ----------
    along : ndarray, shape (n, 3)
        Cosines of the axes of each grain with the field.
    stress, own : ndarray, shape (n,)
        Residual stress and field of each grain.
    work : tuple of float
        To switch by 90 and by 180 degrees.
    opposing, give : float
        Field of the mean polarization, and piezoelectric constant of a domain along the field.
    """
    states = np.concatenate([along, -along], axis=1)
    order = np.argsort(states, axis=1)
    states = np.take_along_axis(states, order, axis=1)
    # [i, s, t] of a switch from s to t: (field + own) change + stress longer >= work
    opposite = (order[:, :, None] % 3) == (order[:, None, :] % 3)
    change = states[:, None, :] - states[:, :, None]
    longer = states[:, None, :] ** 2 - states[:, :, None] ** 2
    need = np.where(opposite, work[1], work[0]) - stress[:, None, None] * longer
    with np.errstate(divide='ignore', invalid='ignore'):
        field = need / change - own[:, None, None]
    up, down = np.where(change > 0.0, field, np.inf), np.where(change < 0.0, field, -np.inf)
    return law_of(
        _tetragonal,
        states,
        up.min(axis=2),
        down.max(axis=2),
        up.argmin(axis=2),
        down.argmax(axis=2),
        opposing,
        give,
    )


def tetragonal_grains(rng: Rng) -> Law:
    """Draw grains of any orientation that residual stresses turn back by 90 degrees."""
    axes = rng.standard_normal((TETRAGONAL, 3))
    work = rng.uniform(0.08, 0.15)
    return tetragonal_grains_of(
        axes / np.linalg.norm(axes, axis=1, keepdims=True),
        -rng.uniform(0.3, 1.0) * np.abs(rng.standard_normal(TETRAGONAL)),
        rng.normal(rng.uniform(0.0, 0.6), rng.uniform(0.1, 0.4), TETRAGONAL),
        (work, work * rng.uniform(1.0, 2.0)),
        rng.uniform(0.1, 0.5),
        rng.uniform(0.0, 0.4),
    )

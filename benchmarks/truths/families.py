# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Piezos whose hysteresis is no sum of plays: line u + share z(u) + level, from 0 to 1."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from numba import njit
import numpy as np

from .cores import Array, Law, Rng
from .differential import bouc_wen, coleman_hodgdon, dahl, jiles_atherton, skewed_bouc_wen
from .preisach import hills, krasnoselskii_pokrovskii, turning_curves, uneven
from .sealed import dragged_moments, gap_shares, loaded_sliders, random_bonds

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

LAWS = {
    'preisach': uneven,
    'bouc-wen': bouc_wen,
    'duhem': coleman_hodgdon,
    'hills': hills,
    'kp-kernels': krasnoselskii_pokrovskii,
    'jiles-atherton': jiles_atherton,
    'skewed-bouc-wen': skewed_bouc_wen,
    'dahl': dahl,
    'turning-curves': turning_curves,
    'dragged-moments': dragged_moments,
    'gap-shares': gap_shares,
    'loaded-sliders': loaded_sliders,
    'random-bonds': random_bonds,
}
#: the laws that nothing is tuned on
SEALED = ('dragged-moments', 'gap-shares', 'loaded-sliders', 'random-bonds')


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

    `width`: largest distance of the branches, in parts of the stroke.
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


def make_core(name: str, rng: Rng) -> Core:
    """Draw a core of a family until its slopes are those of a piezo."""
    width = rng.uniform(*WIDTHS)
    for _ in range(200):
        core = core_of(name, LAWS[name](rng), width)
        if core is not None:
            return core
        width = rng.uniform(*WIDTHS)
    raise ValueError(f'no core of {name} has the slopes of a piezo')

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Compare fits by their prediction of held-out data.

The error of a candidate is the geometric mean of two mean squares.  One mean square holds out
interleaved blocks, the other whole kinds of motion.  Blocks alone would prefer an H that follows
known motion and errs on other motion; kinds alone are too few.  Among the errors within `ALIKE` of
the least, the candidate with the fewest parameters wins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Integers
from piezo_ident.common.choice import simplest
from piezo_ident.fitting.free_run import Fit

#: mean squares within this factor count as alike; it is 5 % of an rms (taste)
ALIKE = 1.1
#: an effect must lower the mean square to at most this share of its value without the effect
EFFECT = 0.4
#: smallest mean square that differs from zero: the square of 1e-10 of the stroke.  A step of a
#: 24-bit converter is hundreds of times larger.  Rounding decides between smaller errors
RESOLVED = 1e-20


@dataclass(frozen=True, eq=False)
class RatedFit:
    """
    Fit with a name and its errors on held-out data.

    Attributes
    ----------
    name : str
    fit : Fit
    blocks, kinds : float
        Mean squares, normalised; `kinds` equals `blocks` if no kinds can be held out.
    effects : int
        Number of effects beyond H, G and the delay.
    """

    name: str
    fit: Fit
    blocks: float
    kinds: float
    effects: int = 0

    @property
    def error(self) -> float:
        """Geometric mean of the two mean squares, at least `RESOLVED`."""
        return max(float(np.sqrt(self.blocks * self.kinds)), RESOLVED)

    @property
    def price(self) -> float:
        """Error over ``EFFECT**effects``: each effect must lower the error to `EFFECT` of it."""
        return float(self.error / EFFECT**self.effects)


def rated(
    name: str, fit: Fit, sets: Integers, kinds: Integers | None, effects: int = 0
) -> RatedFit:
    """Rate a fit; `sets` and `kinds` give the set of each block, -1 for blocks without a set."""
    blocks = float(fit.held_out(sets).sum() / fit.n)
    if kinds is None:
        return RatedFit(name, fit, blocks, blocks, effects)
    out = kinds >= 0
    left = fit.held_out(kinds)
    # only blocks of a kind were held out, so only their errors count
    return RatedFit(name, fit, blocks, float(left[out].sum() / fit.rows[out].sum()), effects)


def best_of(candidates: Sequence[RatedFit]) -> RatedFit:
    """
    Choose the candidate with the lowest price; of alike prices, the fewest parameters.

    The lower price decides between equal numbers of parameters.  The first candidate wins
    if no error is resolved, because rounding decides which of the weights are zero.
    """
    best = min(candidates, key=lambda c: c.price)
    if best.price <= RESOLVED:
        return best
    return simplest(candidates, lambda c: c.price, lambda c: c.fit.stage.size, ALIKE)


def shown_effect(candidates: Sequence[RatedFit], chosen: RatedFit) -> RatedFit | None:
    """Find the best candidate with more effects than `chosen`; None if it errs about as much."""
    more = [c for c in candidates if c.effects > chosen.effects]
    best = min(more, key=lambda c: c.error, default=None)
    return best if best is not None and ALIKE * best.error < chosen.error else None

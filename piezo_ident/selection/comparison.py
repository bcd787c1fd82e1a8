# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The comparison: which of several fits predicts best what it was not fitted to.

The error of a candidate is the geometric mean of two mean squares: with interleaved blocks held
out, and with whole kinds of motion held out.  Blocks alone would choose an H that follows what it
has seen and errs elsewhere; kinds alone are few.  Of candidates that err alike the one with the
fewest parameters is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Integers
from piezo_ident.fitting.free_run import Fit

#: mean squares within this factor are alike, 5 % of an rms (taste)
ALIKE = 1.1
#: share of the mean square that each effect may leave at most: it takes most of what is left
EFFECT = 0.4


@dataclass(frozen=True, eq=False)
class Candidate:
    """
    A fit under a name, and what it leaves of data that were held out.

    Attributes
    ----------
    name : str
    fit : Fit
    blocks, kinds : float
        Mean squares, normalised; `kinds` is that of the blocks where no kinds can be held out.
    effects : int
        Effects beyond H, G and the delay.
    """

    name: str
    fit: Fit
    blocks: float
    kinds: float
    effects: int = 0

    @property
    def error(self) -> float:
        """Geometric mean of both mean squares."""
        return float(np.sqrt(self.blocks * self.kinds))

    @property
    def price(self) -> float:
        """The error, larger by what each effect must take."""
        return float(self.error / EFFECT**self.effects)


def candidate(
    name: str, fit: Fit, sets: Integers, kinds: Integers | None, effects: int = 0
) -> Candidate:
    """Return a fit as a candidate; `sets` and `kinds` give the set of each block, -1 for none."""
    rows = fit.equations.rows
    blocks = float(fit.held_out(sets).sum() / rows.sum())
    if kinds is None:
        return Candidate(name, fit, blocks, blocks, effects)
    out = kinds >= 0
    left = fit.held_out(kinds)
    # what is in no kind was fitted, and tells nothing
    return Candidate(name, fit, blocks, float(left[out].sum() / rows[out].sum()), effects)


def best_of(candidates: Sequence[Candidate]) -> Candidate:
    """
    Return the candidate of the least price; of those alike, the one with fewest parameters.

    Of as many parameters the lower price is taken.
    """
    least = min(c.price for c in candidates)
    alike = [c for c in candidates if c.price <= ALIKE * least]
    return min(alike, key=lambda c: (c.fit.stage.size, c.price))


def shown_effect(candidates: Sequence[Candidate], chosen: Candidate) -> Candidate | None:
    """Return what errs least of those with more effects than the chosen one, if it errs less."""
    more = [c for c in candidates if c.effects > chosen.effects]
    best = min(more, key=lambda c: c.error, default=None)
    return best if best is not None and ALIKE * best.error < chosen.error else None

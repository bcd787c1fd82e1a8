# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrate a prediction band on the errors of whole kinds of motion, each of them held out in turn.

The coefficients of the scale q are fitted to the rms errors of blocks, with equal weight for every
kind.  Then the coefficients of the other kinds predict each kind.  Leaving out single samples
would test nothing, because errors of neighbours are alike: D. R. Roberts et al., "Cross-validation
strategies for data with temporal, spatial, hierarchical, or phylogenetic structure", Ecography
40(8), 2017, doi:10.1111/ecog.02881.

H errs more on loops between the fitted loops.  A kind with fitted samples therefore counts with
the larger of its own error and the error that kinds without fitted samples give for its motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from piezo_ident.common.arrays import Array, Integers, Mask
from piezo_ident.diagnosis.held_out import held_out_kinds, stretches
from piezo_ident.model.stage_model import StageModel
from piezo_ident.selection.judged import JudgedRun
from piezo_ident.uncertainty.band import PredictionBand
from piezo_ident.uncertainty.motion import Motion
from scipy.optimize import least_squares

#: number of blocks of all records together, and fewest samples of a block (taste)
BLOCKS, SHORTEST = 80, 20
#: smallest scale of the error in spans: a tenth of a bit of a 16 bit converter
LEAST = 1.5e-6
#: weight of the prior against one block (taste).  The prior is the error of all blocks over the
#: largest value of the motion, and decides only coefficients that the blocks leave open
PRIOR = 1e-3


@dataclass(frozen=True, eq=False)
class Blocks:
    """
    Errors of blocks, and their motion.

    Attributes
    ----------
    square : ndarray, shape (blocks,)
        Mean squared error, normalised.
    motion : ndarray, shape (blocks, 4)
        Mean squares of 1, swing, speed and nesting.
    kind, fitted : ndarray of int, of bool, shape (blocks,)
        Number of the kind, and whether a fit used samples of it.
    weight : ndarray, shape (blocks,)
        Number of samples.
    speed : float
        Highest speed of all samples [spans/s].
    """

    square: Array
    motion: Array
    kind: Integers
    fitted: Mask
    weight: Integers
    speed: float

    @property
    def kinds(self) -> int:
        """Number of kinds."""
        return int(self.kind.max()) + 1

    def of_kinds(self, values: Array) -> Array:
        """Average values of blocks by samples over each kind, shape (kinds,)."""
        total = np.bincount(self.kind, self.weight * values, self.kinds)
        return np.asarray(total / np.bincount(self.kind, self.weight, self.kinds))


def blocks_of(
    model: StageModel, runs: Sequence[JudgedRun], excess: Mapping[str, float] | None = None
) -> Blocks | None:
    """
    Cut judged runs into blocks by the segments of their records; None with too few samples.

    `excess` is added to the mean squared errors, by the label of a segment [m^2].
    """
    size = max(SHORTEST, sum(int(run.use.sum()) for run in runs) // BLOCKS)
    Y, highest = abs(model.scaling.Y), 0.0
    rows = list[tuple[str, Array, float, Array, int, bool]]()
    for run in runs:
        u, x = model.scaling.u(run.piece.v), model.scaling.x(run.predicted)
        stream, e = Motion(model), run.error
        for label, start, stop in stretches(run.record, run.piece):
            motion, use = stream.follow(u[start:stop], x[start:stop]), run.use[start:stop]
            highest = max(highest, float(motion[1].max(initial=0.0, where=use)))
            factor = _unfitted(e[start:stop] ** 2, use, run.held[start:stop])
            for part in np.array_split(np.arange(stop - start), max(1, round(use.size / size))):
                own = part[use[part]]
                if own.size >= SHORTEST:
                    square = factor * float(np.mean(e[start + own] ** 2))
                    square = (square + (excess or {}).get(label, 0.0)) / Y**2
                    squares = np.append(1.0, np.mean(motion[:, own] ** 2, axis=1))
                    was_fitted = not run.held[start + own].all()
                    rows.append((label, u[start + part], square, squares, own.size, was_fitted))
    # a model that diverges has no band
    if len(rows) < 2 or not np.isfinite([row[2] for row in rows]).all():
        return None
    labels, commands, errors, motions, weights, fitted = zip(*rows, strict=True)
    kind = np.unique(held_out_kinds(labels, commands)[0], return_inverse=True)[1]
    square = np.maximum(np.array(errors), LEAST**2)
    used = np.bincount(kind, fitted)[kind] > 0
    return Blocks(square, np.array(motions), kind, used, np.array(weights), highest)


def _unfitted(e2: Array, use: Mask, held: Mask) -> float:
    """Compute the ratio of mean squared errors, held-out samples over all samples; at least 1."""
    own = use & held
    if min(own.sum(), (use & ~held).sum()) < SHORTEST or not e2[use].any():
        return 1.0
    return max(1.0, float(e2[own].mean() / e2[use].mean()))


def calibrated(blocks: Blocks) -> PredictionBand:
    """Fit a band to blocks, and predict each kind from the others."""
    every, ratios = np.ones(blocks.kind.size, dtype=bool), list[float]()
    whole = _coefficients(_raised(blocks, every), every)
    for k in range(blocks.kinds):
        own = blocks.kind == k
        rest = every if own.all() else ~own
        raised = _raised(blocks, rest)
        ratio = raised.square[own] / _square(_coefficients(raised, rest), blocks.motion[own])
        ratios.append(float(np.average(ratio, weights=blocks.weight[own])))
    return PredictionBand(whole, np.sqrt(ratios), blocks.speed)


def _raised(blocks: Blocks, chosen: Mask) -> Blocks:
    """Raise errors of fitted kinds to the errors that the chosen kinds without fits expect."""
    if not np.any(unfitted := chosen & ~blocks.fitted):
        return blocks
    expected = _square(_coefficients(blocks, unfitted), blocks.motion)
    larger = np.maximum(blocks.square, np.where(blocks.fitted, expected, 0.0))
    return replace(blocks, square=larger)


def _square(c: Array, motion: Array) -> Array:
    return np.asarray(np.maximum(motion @ c**2, LEAST**2))


def _coefficients(blocks: Blocks, chosen: Mask) -> Array:
    """Fit c_0, c_S, c_D and c_N to the rms errors of the chosen blocks."""
    motion, square, kind = blocks.motion[chosen], blocks.square[chosen], blocks.kind[chosen]
    count = np.bincount(kind, minlength=blocks.kinds)
    weight = np.sqrt(1.0 / count[kind])
    level = 0.5 * float(np.average(np.log(square), weights=weight**2))
    largest = np.sqrt(np.maximum(motion.max(axis=0), 1e-12))
    start = level - np.log(largest) - 0.5 * math.log(largest.size)

    def missed(logs: Array) -> Array:
        q, e = (np.sqrt(x) * math.exp(-level) for x in (_square(np.exp(logs), motion), square))
        return np.concatenate([weight * (q - e), PRIOR**0.5 * (logs - start)])

    return np.asarray(np.exp(least_squares(missed, start).x))

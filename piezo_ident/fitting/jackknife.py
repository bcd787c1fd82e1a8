# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Replicate a linearised fit without each of its blocks in turn.

A residual that is correlated in time, or an error of the model, stays within its block, and so
counts as one observation: H. R. Kuensch, "The jackknife and the bootstrap for general stationary
observations", Annals of Statistics 17(3), 1989, doi:10.1214/aos/1176347265.  All parameters are in
one set of equations, so the dependence between them is in each replicate.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import ModelError
from piezo_ident.fitting.free_run import Fit
from piezo_ident.fitting.stage import Stage

#: share of a step that a replicate takes, so that its quantities are linear in the step
SHARE = 0.1
#: share of the energy of a column that is added to the diagonal.  Combinations of columns with
#: less information in the data stay fixed in all replicates
RIDGE = 1e-10


@dataclass(frozen=True, eq=False)
class Linearised:
    """
    Linearised equations ``A_k theta = b_k`` of blocks k at a stage.

    A and b have shapes (blocks, p, p) and (blocks, p); `prior` is the information before the fit,
    shape (p, p).
    """

    stage: Stage
    A: Array
    b: Array
    prior: Array

    @classmethod
    def of(cls, fit: Fit) -> Linearised:
        """Take the equations of a fit of all parameters together."""
        return cls(fit.stage, fit.equations.A, fit.equations.b, fit.prior_weight())

    def in_steps(self, of_G: Mask) -> Linearised:
        """
        Fit G and offsets to the blocks `of_G` with H held, then H and offsets to the others.

        An error of G moves H, and no error of H moves G.  A thus is not symmetric any more.
        """
        stage = self.stage
        G = np.zeros(stage.values.size, dtype=bool)
        own, offsets = stage.places
        G[own] = True
        other = ~G
        other[offsets] = False
        A, b = self.A.copy(), self.b.copy()
        for block, unused in ((of_G, other), (~of_G, G)):
            A[np.ix_(block, unused)], b[np.ix_(block, unused)] = 0.0, 0.0
        A[of_G] *= ~other
        return replace(self, A=A, b=b)

    def replicates(self) -> Iterator[Stage]:
        """Yield the stage at `SHARE` of the way to the solution without each block in turn."""
        values, A, b = self.stage.values, self.A.sum(axis=0) + self.prior, self.b.sum(axis=0)
        free = self.stage.free(values) & (np.diag(A) > 0.0)
        whole = _solved(A, b, free)
        for A_k, b_k in zip(self.A, self.b, strict=True):
            if not A_k.any():
                continue
            step = np.zeros(values.size)
            step[free] = _solved(A - A_k, b - b_k, free) - whole
            try:
                yield self.stage.moved(values + SHARE * step)
            except ModelError:
                # the linear equations do not hold so far away
                continue


def _solved(A: Array, b: Array, free: Mask) -> Array:
    own = A[np.ix_(free, free)]
    size = np.sqrt(np.maximum(np.abs(np.diag(own)), np.finfo(float).tiny))
    scaled = own / np.outer(size, size)
    scaled[np.diag_indices_from(scaled)] += RIDGE
    return np.asarray(np.linalg.solve(scaled, b[free] / size) / size)


def deviations(values: Array, at: Array) -> Array:
    """
    Compute the deviations of the jackknife, shape (k,), from quantities of replicates.

    The quantities have shape (blocks, k); `at` holds the quantities of the fit itself, shape (k,).
    """
    count = values.shape[0]
    if count < 2:
        return np.full(at.size, np.inf)
    moved = (values - at) / SHARE
    spread = np.sum((moved - moved.mean(axis=0)) ** 2, axis=0)
    return np.asarray(np.sqrt((count - 1) / count * spread))

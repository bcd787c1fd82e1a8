# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Replicate a linearised fit without each of its blocks in turn.

A residual that is correlated in time, or an error of the model, stays within its block, and so
counts as one observation: H. R. Kuensch, "The jackknife and the bootstrap for general stationary
observations", Annals of Statistics 17(3), 1989, doi:10.1214/aos/1176347265.  All parameters are in
one set of equations, so the dependence between them is in each replicate.  Steps that follow each
other use the equations of their own blocks only, with the values of the steps before them:
W. K. Newey, "A method of moments interpretation of sequential estimators", Economics Letters
14(2-3), 1984, doi:10.1016/0165-1765(84)90083-1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import ModelError
from piezo_ident.fitting.free_run import Fit
from piezo_ident.fitting.stage import Stage

#: share of a step that a replicate takes: quantities are linearised, as the equations are
SHARE = 0.1
#: share of the energy of a column that is added to the diagonal: combinations of columns that the
#: data tell less about do not move, in no replicate
RIDGE = 1e-10


@dataclass(frozen=True, eq=False)
class Linearised:
    """
    Linearised equations ``A_k theta = b_k`` of blocks k at a stage.

    A and b have shapes (blocks, p, p) and (blocks, p); `prior` is the information before the fit,
    shape (p, p).  `steps` are the blocks, shape (blocks,), and the values, shape (p,), of the
    steps of the fit, in their order.
    """

    stage: Stage
    A: Array
    b: Array
    prior: Array
    steps: Sequence[tuple[Mask, Mask]]

    @classmethod
    def of(cls, fit: Fit, steps: Sequence[tuple[Mask, Mask]] = ()) -> Linearised:
        """Take the equations of a fit; without steps it fitted all parameters together."""
        A, b = fit.equations.A, fit.equations.b
        every = np.ones(len(A), dtype=bool), np.ones(b.shape[1], dtype=bool)
        return cls(fit.stage, A, b, fit.prior_weight(), steps or (every,))

    def replicates(self) -> Iterator[Stage]:
        """Yield the stage at `SHARE` of the way to the solution without each block in turn."""
        values, every = self.stage.values, np.ones(len(self.A), dtype=bool)
        whole = self._solution(every)
        for k in np.flatnonzero(self.A.any(axis=(1, 2))):
            step = self._solution(every & (np.arange(every.size) != k)) - whole
            try:
                yield self.stage.moved(values + SHARE * step)
            except ModelError:
                # this far the linear equations do not reach
                continue

    def _solution(self, kept: Mask) -> Array:
        """Solve the equations of the kept blocks, step by step, shape (p,)."""
        free, step = self.stage.free(self.stage.values), np.zeros(self.b.shape[1])
        for blocks, values in self.steps:
            A = self.A[blocks & kept].sum(axis=0) + self.prior
            own = values & free & (np.diag(A) > 0.0)
            step[own] += _solved(A, self.b[blocks & kept].sum(axis=0) - A @ step, own)
        return step


def _solved(A: Array, b: Array, free: Mask) -> Array:
    own = A[np.ix_(free, free)]
    size = np.sqrt(np.maximum(np.abs(np.diag(own)), np.finfo(float).tiny))
    scaled = own / np.outer(size, size)
    scaled[np.diag_indices_from(scaled)] += RIDGE
    return np.asarray(np.linalg.solve(scaled, b[free] / size) / size)


def deviations(values: Array, at: Array) -> Array:
    """
    Compute the deviations of the jackknife, shape (k,), from quantities of replicates.

    The quantities have shape (blocks, k), and those of the fit itself, `at`, (k,).
    """
    count = values.shape[0]
    if count < 2:
        return np.full(at.size, np.inf)
    moved = (values - at) / SHARE
    spread = np.sum((moved - moved.mean(axis=0)) ** 2, axis=0)
    return np.asarray(np.sqrt((count - 1) / count * spread))

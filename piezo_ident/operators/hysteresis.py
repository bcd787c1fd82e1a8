# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
H, the modified Prandtl-Ishlinskii operator.

    w(t) = p1 v(t)^3 + p2 v(t) + sum_i q_i F_ri[v](t),      q_i >= 0                    (eqs. 3, 6)

of Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868, in normalised units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.arrays import frozen_array
from piezo_ident.common.errors import ModelError
from piezo_ident.operators.chain import Block
from piezo_ident.operators.play import initial_memory, weighted_plays

__all__ = ['Hysteresis', 'HysteresisOperator']


@dataclass(frozen=True, eq=False)
class Hysteresis:
    """
    Parameters of H, in normalised units.

    Since ``F_0[v] = v``, a weight at threshold 0 and `p2` are one parameter: such a weight is
    folded into `p2`.

    Parameters
    ----------
    thresholds, weights : array_like, shape (m,)
        Thresholds r_i > 0, ascending, and weights q_i >= 0.
    p1, p2 : float
        Cubic and linear coefficient.

    Raises
    ------
    ModelError
        When lengths differ, a weight is negative, or thresholds are negative or not ascending.
    """

    thresholds: NDArray[np.float64]
    weights: NDArray[np.float64]
    p1: float
    p2: float

    def __post_init__(self) -> None:
        r, q = frozen_array(self.thresholds), frozen_array(self.weights)
        if r.ndim != 1 or r.shape != q.shape:
            raise ModelError(
                f'hysteresis: {r.size} thresholds and {q.size} weights; give one weight each'
            )
        if not (np.all(np.isfinite(r)) and np.all(np.isfinite(q))):
            raise ModelError('hysteresis: thresholds and weights must be finite numbers')
        if np.any(q < 0):
            raise ModelError('hysteresis: weights q_i must not be negative')
        if np.any(r < 0) or np.any(np.diff(r) <= 0):
            raise ModelError('hysteresis: thresholds r_i must ascend and not be negative')
        p2 = float(self.p2)
        if r.size and r[0] == 0.0:
            p2 += float(q[0])
            r, q = frozen_array(r[1:].copy()), frozen_array(q[1:].copy())
        if not (np.isfinite(self.p1) and np.isfinite(p2)):
            raise ModelError('hysteresis: p1 and p2 must be finite numbers')
        object.__setattr__(self, 'thresholds', r)
        object.__setattr__(self, 'weights', q)
        object.__setattr__(self, 'p1', float(self.p1))
        object.__setattr__(self, 'p2', p2)

    def initial_memory(self, v0: float) -> NDArray[np.float64]:
        """Return the play outputs at `v0` of a stage that last came down to zero."""
        return initial_memory(v0, self.thresholds)

    def __call__(self, v: ArrayLike, memory: ArrayLike | None = None) -> NDArray[np.float64]:
        """
        Return w for an input v.

        Parameters
        ----------
        v : array_like, shape (n,)
            Normalised input.
        memory : array_like, shape (m,), optional
            Play outputs before the first sample.

        Returns
        -------
        ndarray, shape (n,)
        """
        x = np.asarray(v, dtype=np.float64)
        start = self.initial_memory(float(x[0])) if memory is None else np.asarray(memory, float)
        return weighted_plays(x, self.thresholds, self.weights, self.p1, self.p2, start)[0]

    def slope(self, v: float, excursion: float = 0.0) -> float:
        """
        Return the small-signal gain dw/dv around a settled bias.

        Plays wider than the excursion stand still; narrower ones move by the part of the
        excursion that exceeds their width.

        Parameters
        ----------
        v : float
            Bias, normalised.
        excursion : float, optional
            Peak-to-peak size of the small signal, normalised.
        """
        gain = self.p2 + 3.0 * self.p1 * v * v
        if excursion > 0.0:
            moved = np.maximum(0.0, 1.0 - self.thresholds / excursion)
            gain += float(self.weights @ moved)
        return gain


class HysteresisOperator:
    """H as an operator, with its memory."""

    def __init__(self, hysteresis: Hysteresis, memory: ArrayLike | None = None) -> None:
        self.hysteresis = hysteresis
        self._given = None if memory is None else np.array(memory, np.float64)
        if self._given is not None and self._given.shape != hysteresis.thresholds.shape:
            raise ModelError(
                f'hysteresis: {self._given.size} play outputs at the start for '
                f'{hysteresis.thresholds.size} thresholds; give one each'
            )
        self.memory = hysteresis.initial_memory(0.0)

    def reset(self, v0: float, x0: float) -> float:
        """Take the given memory, or the one of a stage that last came down to zero."""
        start = self.hysteresis.initial_memory(x0) if self._given is None else self._given
        w, self.memory = self._evaluate(np.array([x0]), start)
        return float(w[0])

    def process(self, block: Block) -> Block:
        """Return the block with H applied to its signal."""
        w, self.memory = self._evaluate(block.x, self.memory)
        return block.with_signal(w)

    def _evaluate(
        self, x: NDArray[np.float64], memory: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        h = self.hysteresis
        return weighted_plays(x, h.thresholds, h.weights, h.p1, h.p2, memory)

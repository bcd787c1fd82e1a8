# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
A stage of several axes with softening and hysteresis inside the loop of its mechanics.

    x(k+1) = A x(k) + B u(k) + E p(k)
    y(k)   = C x(k) + D u(k) + H p(k)
    z(k)   = F x(k) + G u(k),    p = softening and plays of z

Each signal z_j is a mixture of motion and voltage, such as the extension of an actuator.  The
first `levels` of them soften: p_j = z_j (s - 1), where s, 1 at the level of the fit, follows the
rms of these signals with the time constant `memory`.  The others are hysteretic: p_j is a sum of
plays of few, shared thresholds.  p acts on the stage as one more voltage, so stiffness, damping
and gain change with the motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.axes.loop_kernels import trajectory
from piezo_ident.axes.modal import Modal
from piezo_ident.axes.periodic import PeriodicRecord
from piezo_ident.common.errors import DataError, ModelError


@dataclass(frozen=True, eq=False)
class Passage:
    """What passes in the loop: states, signals, pushes, plays, gates, squared level, outputs."""

    x: NDArray[np.float64]
    z: NDArray[np.float64]
    p: NDArray[np.float64]
    plays: NDArray[np.float64]
    gates: NDArray[np.uint8]
    level: NDArray[np.float64]
    y: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LoopModel:
    """
    The equations above.

    Attributes
    ----------
    linear : Modal
        A, B, C, D: the stage at the level s = 1 without its plays.
    e, h, f, g : ndarray, shapes (n, q), (outputs, q), (q, n), (q, inputs)
        How the q signals push, and what they are.
    levels : int
        The first so many signals soften.
    mu : ndarray, shape (q, thresholds)
        Weights of the plays, zero for signals that soften.
    r : ndarray, shape (thresholds,)
        Thresholds in units of z.
    memory : float
        Time constant of the level in samples.
    range : tuple of float
        Between these s softens the stage; beyond them it stays as it is there.
    """

    linear: Modal
    e: NDArray[np.float64]
    h: NDArray[np.float64]
    f: NDArray[np.float64]
    g: NDArray[np.float64]
    levels: int
    mu: NDArray[np.float64]
    r: NDArray[np.float64]
    memory: float = 300.0
    range: tuple[float, float] = (0.3, 2.0)

    @classmethod
    def of(cls, linear: Modal) -> LoopModel:
        """Return a linear stage as a model without signals."""
        order, (outputs, inputs) = linear.order, linear.d.shape
        return cls(
            linear,
            np.zeros((order, 0)),
            np.zeros((outputs, 0)),
            np.zeros((0, order)),
            np.zeros((0, inputs)),
            0,
            np.zeros((0, 1)),
            np.ones(1),
        )

    @property
    def signals(self) -> int:
        """Number of signals z."""
        return len(self.f)

    @property
    def kappa(self) -> float:
        """What the level keeps from one sample to the next."""
        return float(np.exp(-1 / self.memory))

    def a_at(self, s: float) -> NDArray[np.float64]:
        """Return A at a level s, the plays at rest."""
        soft = slice(0, self.levels)
        s = float(np.clip(s, *self.range))
        return np.asarray(self.linear.a + (s - 1) * self.e[:, soft] @ self.f[soft])

    @property
    def radius(self) -> float:
        """Outermost pole over the range of levels, the plays at rest; below 1 it is stable."""
        levels = (self.range[0], 1.0, self.range[1]) if self.levels else (1.0,)
        return max(float(np.abs(np.linalg.eigvals(self.a_at(s))).max()) for s in levels)

    def simulate(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """
        Return the displacements under one period of voltages, in free run and about their mean.

        The period, shape (samples, inputs), is run through once before.
        """
        y = self.run(np.concatenate([u, u])).y[len(u) :]
        return np.asarray(y - y.mean(axis=0))

    def run(self, u: NDArray[np.float64]) -> Passage:
        """Return what passes in the loop under voltages u from rest."""
        return LoopStream(self).run(u)

    def stream(self) -> LoopStream:
        """Return this model at rest, to be run block by block."""
        return LoopStream(self)

    def error(self, record: PeriodicRecord) -> NDArray[np.float64]:
        """Return the error over the last period of a record, in steady state and free run."""
        return record.error(self.simulate(record.u[-1]))


class LoopStream:
    """A model that runs block by block, with the memory of what came before."""

    def __init__(self, model: LoopModel) -> None:
        self.model = model
        self._x = np.zeros(model.linear.order)
        self._memory = np.zeros(model.mu.shape)
        self._level = np.ones(1)

    def run(self, u: NDArray[np.float64]) -> Passage:
        """Return what passes in the loop under the next voltages."""
        model = self.model
        u = np.ascontiguousarray(u, dtype=float)
        if u.ndim != 2 or u.shape[1] != model.linear.b.shape[1]:
            raise DataError(
                f'voltages of shape {u.shape} do not fit {model.linear.b.shape[1]} inputs; '
                'give (samples, inputs)'
            )
        n, q, k = len(u), *model.mu.shape
        run = Passage(
            np.zeros((n, model.linear.order)),
            np.zeros((n, q)),
            np.zeros((n, q)),
            np.zeros((n, q, k)),
            np.zeros((n, q, k), np.uint8),
            np.zeros(n),
            np.zeros((n, len(model.h))),
        )
        whole = np.ascontiguousarray
        done = trajectory(
            u,
            whole(model.linear.blocks),
            whole(model.linear.b),
            whole(model.e),
            whole(model.f),
            whole(model.g),
            whole(model.linear.c),
            whole(model.linear.d),
            whole(model.h),
            whole(model.mu),
            model.r,
            model.levels,
            *model.range,
            model.kappa,
            self._x,
            self._memory,
            self._level,
            run.x,
            run.z,
            run.p,
            run.plays,
            run.gates,
            run.level,
            run.y,
        )
        if done < n:
            raise ModelError(f'the model runs away at sample {done} of {n}')
        return run

    def simulate(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements under the next voltages."""
        return self.run(u).y

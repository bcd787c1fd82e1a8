# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Everything in a loop model fitted at once by its error in free run.

Levenberg-Marquardt on the steady state of periodic records of all amplitudes together, with the
sensitivities of `piezo_ident.axes.loop_kernels`.  The error of each output of each record is
divided by its rms, so small amplitudes count as much as large ones, and an axis of a short stroke
as much as one of a long one.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.axes.linear_fit import moved_blocks
from piezo_ident.axes.loop_kernels import CHUNK, KINDS, sensitivities
from piezo_ident.axes.loop_model import LoopModel, Passage
from piezo_ident.axes.modal import Modal, narrowest, RADIUS
from piezo_ident.axes.periodic import PeriodicRecord
from piezo_ident.common.errors import ModelError

#: a real pole has died away to this part after the warm-up
FADED = 0.01
#: the softening follows the level but for this part of the time at either end
RARE = 0.05
#: the fit ends after so many steps in turn that gain less than this part of the error
SLOW = 3e-3
SLOW_STEPS = 3
#: threads
WORKERS = 2

#: voltages with those before, displacements, and a factor for the error of each of them
Target = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class Parameters:
    """
    Which numbers of a model are fitted besides C, D and H, which always are.

    Attributes
    ----------
    kinds, rows, columns : ndarray of int
        Place of each of them: a number of `KINDS`, row and column.
    """

    kinds: NDArray[np.intp]
    rows: NDArray[np.intp]
    columns: NDArray[np.intp]

    @classmethod
    def of(
        cls, model: LoopModel, *, hold: Collection[str] = (), still: Collection[int] = ()
    ) -> Parameters:
        """
        Choose the parameters of a model.

        Parameters
        ----------
        hold : collection of str
            Kinds that are not fitted.
        still : collection of int
            Signals whose mixture of motion and voltage, F and G, is not fitted.
        """
        shapes = {
            'poles': (len(model.linear.blocks), 2),
            'b': model.linear.b.shape,
            'e': model.e.shape,
            'f': model.f.shape,
            'g': model.g.shape,
            'mu': model.mu.shape,
        }
        places = [
            (number, row, column)
            for number, kind in enumerate(KINDS)
            if kind not in hold
            for row, column in np.ndindex(shapes[kind])
            if not (kind == 'mu' and row < model.levels)
            and not (kind in ('f', 'g') and row in still)
        ]
        table = np.array(places, dtype=np.intp).reshape(-1, 3)
        return cls(*(np.ascontiguousarray(column) for column in table.T))

    def __len__(self) -> int:
        return len(self.kinds)

    def moved(self, model: LoopModel, step: NDArray[np.float64], limit: float = 1.0) -> LoopModel:
        """
        Return the model with these parameters, then C, D and H by output, moved by `step`.

        Poles of modes stay within `limit` of the origin.
        """
        linear = model.linear
        parts = {
            'poles': np.zeros((len(linear.blocks), 2)),
            'b': linear.b.copy(),
            'e': model.e.copy(),
            'f': model.f.copy(),
            'g': model.g.copy(),
            'mu': model.mu.copy(),
        }
        for number, kind in enumerate(KINDS):
            chosen = self.kinds == number
            parts[kind][self.rows[chosen], self.columns[chosen]] += step[: len(self)][chosen]
        order, inputs = linear.b.shape
        rest = step[len(self) :].reshape(len(linear.c), -1)
        c, d, h = np.split(rest, [order, order + inputs], axis=1)
        blocks = moved_blocks(linear.blocks, parts['poles'].ravel(), limit)
        return replace(
            model,
            linear=Modal(blocks, parts['b'], linear.c + c, linear.d + d),
            h=model.h + h,
            e=parts['e'],
            f=parts['f'],
            g=parts['g'],
            mu=parts['mu'],
        )


def output_sensitivities(
    model: LoopModel, parameters: Parameters, u: NDArray[np.float64], run: Passage, skip: int = 0
) -> NDArray[np.float32]:
    """
    Return dy/dtheta of `parameters`, shape (samples - skip, outputs, parameters).

    `run` is what passed in the loop under u.
    """
    linear = model.linear
    out = np.zeros((len(u) - skip, len(linear.c), len(parameters)), np.float32)
    whole = np.ascontiguousarray
    for at in range(0, len(parameters), CHUNK):
        part = slice(at, at + CHUNK)
        kinds = parameters.kinds[part]
        answer = np.zeros((*out.shape[:2], len(kinds)), np.float32)
        sensitivities(
            kinds,
            parameters.rows[part],
            parameters.columns[part],
            whole(u),
            whole(linear.blocks),
            whole(model.e),
            whole(model.f),
            whole(model.mu),
            whole(linear.c),
            whole(model.h),
            model.levels,
            *model.range,
            model.kappa,
            run.x,
            run.z,
            run.p,
            run.plays,
            run.gates,
            run.level,
            skip,
            answer,
        )
        out[:, :, part] = answer
    return out


def loop_fit(
    model: LoopModel,
    records: Sequence[PeriodicRecord],
    *,
    weights: Sequence[float] | None = None,
    hold: Collection[str] = (),
    still: Collection[int] = (),
    iterations: int = 10,
    warm_up: int = 1024,
) -> LoopModel:
    """
    Lower the error of a model in free run over periodic records.

    Parameters
    ----------
    weights : sequence of float, optional
        One a record (`piezo_ident.axes.periodic.Periodicity.weight`).
    hold, still : collections
        What is not fitted, see `Parameters.of`.
    warm_up : int
        Samples of the period that run before it, so that the stage forgets its rest.

    Returns
    -------
    LoopModel
        Whose modes are stable over its range of levels, which is what the records often reach.
        One that runs away under a record is returned as it is.
    """
    weights = [1.0] * len(records) if weights is None else weights
    model = _ranged(model, records)
    problem = _Problem(model, records, weights, hold, still, warm_up)
    damping, slow = 1e-3, 0
    with ThreadPoolExecutor(WORKERS) as pool:
        cost = problem.cost(model, pool)
        # from a model that runs away no step is known
        for _ in range(iterations if np.isfinite(cost) else 0):
            hessian, gradient = problem.normal_equations(model, pool)
            before = cost
            for _ in range(8):
                tried = problem.step(model, hessian, gradient, damping)
                tried_cost = problem.cost(tried, pool)
                if tried_cost < cost:
                    model, cost = tried, tried_cost
                    break
                damping *= 6
            else:
                break
            damping = max(damping / 6, 1e-9)
            slow = slow + 1 if before - cost < SLOW * before else 0
            if slow == SLOW_STEPS:
                break
    return _ranged(model, records)


def _ranged(model: LoopModel, records: Sequence[PeriodicRecord]) -> LoopModel:
    """Let the softening follow the level as far as the records often take it."""
    if not model.levels:
        return model
    free = replace(model, range=(0.0, np.inf))
    low, high = np.inf, 0.0
    for record in records:
        u = record.mean_u
        try:
            level = np.sqrt(free.run(np.concatenate([u, u])).level[len(u) :])
        except ModelError:  # what keeps it from running away is its range
            return model
        reached = np.quantile(level, (RARE, 1 - RARE))
        low, high = min(low, float(reached[0])), max(high, float(reached[1]))
    ranged = replace(model, range=(low, high))
    return ranged if ranged.radius < RADIUS else model


class _Problem:
    """Records, weights and parameters of one fit."""

    def __init__(
        self,
        model: LoopModel,
        records: Sequence[PeriodicRecord],
        weights: Sequence[float],
        hold: Collection[str],
        still: Collection[int],
        warm_up: int,
    ) -> None:
        self.parameters = Parameters.of(model, hold=hold, still=still)
        self.targets: list[Target] = []
        self.warm_up = min(warm_up, records[0].u.shape[1])
        self.slowest = FADED ** (1 / self.warm_up)
        self.limit = narrowest(records[0].u.shape[1])
        for record, weight in zip(records, weights, strict=True):
            u, y = record.mean_u, record.mean_y
            before = u[len(u) - self.warm_up :]
            # a phase at which no period was read does not count
            scale = record.sound.any(axis=0) * (weight / np.sqrt(np.mean(y**2, axis=0)))
            self.targets.append((np.concatenate([before, u]), y, scale))

    def cost(self, model: LoopModel, pool: ThreadPoolExecutor) -> float:
        """Sum of the squared, weighted errors; infinite where the model is not stable."""
        if not model.radius < RADIUS:
            return float('inf')

        def one(target: Target) -> float:
            try:
                error, _ = self._error(model, target)
            except ModelError:  # ran away
                return float('inf')
            return float(np.sum(error**2))

        return sum(pool.map(one, self.targets))

    def _error(self, model: LoopModel, target: Target) -> tuple[NDArray[np.float64], Passage]:
        u, y, scale = target
        run = model.run(u)
        left = run.y[self.warm_up :] - y
        return (left - np.average(left, axis=0, weights=scale)) * scale, run

    def normal_equations(
        self, model: LoopModel, pool: ThreadPoolExecutor
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return J'J and J'e summed over records, scaled apart later."""
        outputs = len(model.linear.c)
        many = len(self.parameters)
        each = model.linear.order + model.linear.b.shape[1] + model.signals
        total = many + outputs * each

        def one(target: Target) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            u, _, scale = target
            error, run = self._error(model, target)
            skip = self.warm_up
            inner = output_sensitivities(model, self.parameters, u, run, skip)
            plain = np.hstack([run.x[skip:], u[skip:], run.p[skip:]]).astype(np.float32)
            hessian, gradient = np.zeros((total, total)), np.zeros(total)
            for o in range(outputs):
                columns = np.hstack([inner[:, o], plain])
                weight = scale[:, o].astype(np.float32)
                columns -= weight @ columns / weight.sum()
                columns *= weight[:, None]
                at = np.r_[:many, many + o * each : many + (o + 1) * each]
                hessian[np.ix_(at, at)] += columns.T @ columns
                gradient[at] += columns.T @ error[:, o].astype(np.float32)
            return hessian, gradient

        hessian, gradient = np.zeros((total, total)), np.zeros(total)
        for part, slope in pool.map(one, self.targets):
            hessian += part
            gradient += slope
        return hessian, gradient

    def step(
        self,
        model: LoopModel,
        hessian: NDArray[np.float64],
        gradient: NDArray[np.float64],
        damping: float,
    ) -> LoopModel:
        """Return the model one damped step on; real poles that would get too slow stay."""
        size = np.sqrt(np.diag(hessian))
        size = np.where(size > 0, size, 1)
        size = np.maximum(size, 1e-9 * size.max())
        scaled = hessian / np.outer(size, size) + damping * np.eye(len(size))
        free = np.ones(len(size), bool)
        reals = self._real_poles(model)
        step = np.zeros(len(size))
        for _ in range(5):
            at = np.flatnonzero(free)
            step[:] = 0
            step[at] = -np.linalg.solve(scaled[np.ix_(at, at)], gradient[at] / size[at])
            step /= size
            poles = reals + step[: len(reals)]
            beyond = free[: len(reals)] & (np.abs(poles) > self.slowest) & (reals != 0)
            if not beyond.any():
                break
            free[: len(reals)][beyond] = False
        return self.parameters.moved(model, step, self.limit)

    def _real_poles(self, model: LoopModel) -> NDArray[np.float64]:
        """Return the pole of each parameter that is a real pole, 0 for the others."""
        chosen = self.parameters.kinds == KINDS.index('poles')
        rows, columns = self.parameters.rows[chosen], self.parameters.columns[chosen]
        poles = model.linear.blocks[rows, columns, columns]
        return np.where(model.linear.oscillates[rows], 0.0, poles)

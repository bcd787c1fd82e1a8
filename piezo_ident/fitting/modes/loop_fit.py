# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit all parameters of a loop model at once by its error in free run.

Levenberg-Marquardt on the steady state of periodic records of all amplitudes together, with the
sensitivities of `piezo_ident.model.modes.kernels`.  The error of each output of each record is
divided by its rms.  Small and large amplitudes therefore count alike, and so do short and long
strokes.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.fitting.damped import descend
from piezo_ident.fitting.modes.linear_fit import moved_blocks, SCHEDULE
from piezo_ident.fitting.modes.periods import PeriodicRecord
from piezo_ident.model.modes.kernels import CHUNK, KINDS, Passage, sensitivities
from piezo_ident.model.modes.modal import Modal, narrowest, RADIUS
from piezo_ident.model.modes.shared_modes import SharedModes

#: samples of the period that run before it, so that the stage forgets its rest (taste: time)
WARM_UP = 1024
#: share of a real pole that is left after the warm-up (taste)
FADED = 0.01
#: the softening follows the level but for this part of the time at either end
RARE = 0.05
#: threads
WORKERS = 2

#: voltages with those before, displacements, and a factor for the error of each of them
Target = tuple[Array, Array, Array]


@dataclass(frozen=True, eq=False)
class FreeNumbers:
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
        cls, model: SharedModes, *, hold: Collection[str] = (), still: Collection[int] = ()
    ) -> FreeNumbers:
        """
        Choose the parameters of a model.

        Parameters
        ----------
        hold : collection of str
            Kinds that are not fitted.
        still : collection of int
            Signals whose mixture of motion and voltage, F and G, is not fitted.
        """
        arrays = _arrays(model)
        places = [
            (number, row, column)
            for number, kind in enumerate(KINDS)
            if kind not in hold
            for row, column in np.ndindex(arrays[kind].shape)
            if not (kind == 'mu' and row < model.levels)
            and not (kind in ('f', 'g') and row in still)
        ]
        table = np.array(places, dtype=np.intp).reshape(-1, 3)
        return cls(*(np.ascontiguousarray(column) for column in table.T))

    def __len__(self) -> int:
        return len(self.kinds)

    def moved(self, model: SharedModes, step: Array, limit: float = 1.0) -> SharedModes:
        """
        Return the model with these parameters, then C, D and H by output, moved by `step`.

        Poles of modes stay within `limit` of the origin.
        """
        linear, parts = model.linear, _arrays(model)
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


def _arrays(model: SharedModes) -> dict[str, Array]:
    """Copy the arrays of each kind of parameter; of the poles their steps, zero."""
    poles = np.zeros((len(model.linear.blocks), 2))
    own = {kind: getattr(model, kind).copy() for kind in KINDS[2:]}
    return {'poles': poles, 'b': model.linear.b.copy(), **own}


def output_sensitivities(
    model: SharedModes, parameters: FreeNumbers, run: Passage, skip: int = 0
) -> NDArray[np.float32]:
    """
    Return dy/dtheta of `parameters`, shape (samples - skip, outputs, parameters).

    `run` holds the signals of the loop.
    """
    out = np.zeros((len(run.u) - skip, len(model.h), len(parameters)), np.float32)
    kinds, rows, columns = parameters.kinds, parameters.rows, parameters.columns
    loop = model.loop
    for at in range(0, len(parameters), CHUNK):
        part = slice(at, at + CHUNK)
        answer = np.zeros((*out.shape[:2], len(kinds[part])), np.float32)
        sensitivities(kinds[part], rows[part], columns[part], loop, run, skip, answer)
        out[:, :, part] = answer
    return out


def loop_fit(
    model: SharedModes,
    records: Sequence[PeriodicRecord],
    *,
    hold: Collection[str] = (),
    still: Collection[int] = (),
    iterations: int = 10,
) -> SharedModes:
    """
    Lower the error of a model in free run over periodic records.

    Parameters
    ----------
    hold, still : collections
        Parameters that are not fitted, see `FreeNumbers.of`.

    Returns
    -------
    SharedModes
        Its modes are stable over its range of levels, which the records often reach.
    """
    model = _ranged(model, records)
    with ThreadPoolExecutor(WORKERS) as pool:
        problem = _Problem(model, records, FreeNumbers.of(model, hold=hold, still=still), pool)
        model = descend(model, problem.cost, problem.equations, problem.step, SCHEDULE, iterations)
    return _ranged(model, records)


def _ranged(model: SharedModes, records: Sequence[PeriodicRecord]) -> SharedModes:
    """Let the softening follow the level as far as the records often take it."""
    if not model.levels:
        return model
    free = replace(model, range=(0.0, np.inf))
    low, high = np.inf, 0.0
    for record in records:
        u = record.mean_u
        try:
            level = np.sqrt(free.run(np.concatenate([u, u])).level[len(u) :])
        except ModelError:  # the range alone keeps it from running away
            return model
        reached = np.quantile(level, (RARE, 1 - RARE))
        low, high = min(low, float(reached[0])), max(high, float(reached[1]))
    ranged = replace(model, range=(low, high))
    return ranged if ranged.radius < RADIUS else model


class _Problem:
    """Records, weights and parameters of one fit."""

    def __init__(
        self,
        model: SharedModes,
        records: Sequence[PeriodicRecord],
        parameters: FreeNumbers,
        pool: ThreadPoolExecutor,
    ) -> None:
        self.parameters, self.pool = parameters, pool
        self.targets: list[Target] = []
        self.warm_up = min(WARM_UP, records[0].u.shape[1])
        self.slowest = FADED ** (1 / self.warm_up)
        self.limit = narrowest(records[0].u.shape[1])
        for record in records:
            u, y = record.mean_u, record.mean_y
            before = u[len(u) - self.warm_up :]
            # a phase counts if one period at least was read there
            scale = record.sound.any(axis=0) * (record.weight / np.sqrt(np.mean(y**2, axis=0)))
            self.targets.append((np.concatenate([before, u]), y, scale))

    def cost(self, model: SharedModes) -> float:
        """Sum of the squared, weighted errors; infinite where the model is not stable."""
        if not model.radius < RADIUS:
            return float('inf')

        def one(target: Target) -> float:
            try:
                error, _ = self._error(model, target)
            except ModelError:  # ran away
                return float('inf')
            return float(np.sum(error**2))

        return sum(self.pool.map(one, self.targets))

    def _error(self, model: SharedModes, target: Target) -> tuple[Array, Passage]:
        u, y, scale = target
        run = model.run(u)
        left = run.y[self.warm_up :] - y
        return (left - np.average(left, axis=0, weights=scale)) * scale, run

    def equations(self, model: SharedModes) -> tuple[Array, Array]:
        """Return J'J and J'e summed over records, scaled apart later."""
        outputs = len(model.linear.c)
        many = len(self.parameters)
        each = model.linear.order + model.linear.b.shape[1] + model.signals
        total = many + outputs * each

        def one(target: Target) -> tuple[Array, Array]:
            *_, scale = target
            error, run = self._error(model, target)
            skip = self.warm_up
            inner = output_sensitivities(model, self.parameters, run, skip)
            plain = np.hstack([run.x[skip:], run.u[skip:], run.p[skip:]]).astype(np.float32)
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
        for part, slope in self.pool.map(one, self.targets):
            hessian += part
            gradient += slope
        return hessian, gradient

    def step(
        self, model: SharedModes, equations: tuple[Array, Array], damping: float
    ) -> SharedModes:
        """Return the model one damped step on; real poles that would get too slow stay."""
        hessian, gradient = equations
        size = np.sqrt(np.diag(hessian))
        size = np.where(size > 0, size, 1)
        size = np.maximum(size, 1e-9 * size.max())
        scaled = hessian / np.outer(size, size) + damping * np.eye(len(size))
        free, reals = np.ones(len(size), bool), self._real_poles(model)
        for _ in range(5):
            at, step = np.flatnonzero(free), np.zeros(len(size))
            step[at] = -np.linalg.solve(scaled[np.ix_(at, at)], gradient[at] / size[at])
            step /= size
            poles = reals + step[: len(reals)]
            beyond = free[: len(reals)] & (np.abs(poles) > self.slowest) & (reals != 0)
            if not beyond.any():
                break
            free[: len(reals)][beyond] = False
        return self.parameters.moved(model, step, self.limit)

    def _real_poles(self, model: SharedModes) -> Array:
        """Return the pole of each parameter that is a real pole, 0 for the others."""
        chosen = self.parameters.kinds == KINDS.index('poles')
        rows, columns = self.parameters.rows[chosen], self.parameters.columns[chosen]
        poles = model.linear.blocks[rows, columns, columns]
        return np.where(model.linear.oscillates[rows], 0.0, poles)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The joint fit: weights of H, offsets and effects together, by free-run error (Gauss-Newton).

G and the delay stay: they came from records of their own, and a change in them is a candidate of
its own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.errors import ModelError
from piezo_ident.diagnosis.gain import gram_of, held_out_errors
from piezo_ident.diagnosis.handles import Handle, handles_of
from piezo_ident.diagnosis.rows import Rows
from piezo_ident.diagnosis.simulator import Simulator, State
from piezo_ident.operators.hysteresis import Hysteresis
from scipy.optimize import lsq_linear

__all__ = [
    'BaseColumns',
    'Fitted',
    'base_at',
    'base_thresholds',
    'fit_base',
    'fit_jointly',
]

#: how far a weight of H may be expected to move, normalised: what keeps collinear plays quiet
WEIGHT_SPREAD = 0.1
ITERATIONS, ATTEMPTS, TOLERANCE = 20, 5, 1e-3
#: finite difference of a weight of H, normalised
WEIGHT_STEP = 1e-3


@dataclass(frozen=True, eq=False)
class BaseColumns:
    """
    What a refit of the base model can do.

    Attributes
    ----------
    columns : ndarray, shape (n, m + 2 + records)
        Filtered plays, v^3, v and the offset of each record.
    total : ndarray, shape (m + 2 + records, m + 2 + records)
        Their products.
    """

    columns: NDArray[np.float64]
    total: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Fitted:
    """
    Result of a joint fit.

    Attributes
    ----------
    state : State
    base : BaseColumns
        That were used for H.
    e : ndarray, shape (n,)
        Residual of the rows, measured minus predicted, normalised.
    J : ndarray, shape (n, p)
        Derivatives of the prediction: weights, p1, p2, offsets, then the handles.
    free : ndarray of bool, shape (p,)
        Columns that are not on a bound.
    handles : tuple of Handle
    prior : ndarray, shape (p,)
    errors, transfer : ndarray, shape (blocks,)
        Sum of squares of each block, held out in spread sets and in whole kinds.
    """

    state: State
    base: BaseColumns
    e: NDArray[np.float64]
    J: NDArray[np.float64]
    free: NDArray[np.bool_]
    handles: tuple[Handle, ...]
    prior: NDArray[np.float64]
    errors: NDArray[np.float64]
    transfer: NDArray[np.float64]

    @property
    def mean_square(self) -> float:
        """Mean square error of the blocks held out in spread sets, normalised."""
        return float(self.errors.sum() / self.e.size)

    @property
    def transfer_mean_square(self) -> float:
        """Mean square error of whole kinds held out."""
        return float(self.transfer.sum() / self.e.size)


def base_thresholds(swing: float) -> NDArray[np.float64]:
    """Return twenty even thresholds over the swing, and four fine ones near zero."""
    fine = np.array([0.005, 0.012, 0.025, 0.037])
    return swing * np.concatenate([fine, np.arange(1, 20) / 20.0])


def fit_base(
    simulator: Simulator, state: State, thresholds: NDArray[np.float64]
) -> tuple[State, BaseColumns]:
    """
    Return H refitted on other thresholds by bounded least squares, and the columns used.

    Parameters
    ----------
    simulator : Simulator
    state : State
        Its effects are kept as they are.
    thresholds : ndarray, shape (m,)
    """
    rows, m = simulator.rows, thresholds.size
    columns = np.hstack([simulator.base_columns(thresholds), _offset_columns(rows)])
    base = BaseColumns(columns, columns.T @ columns)
    own = simulator.base_columns(state.hysteresis.thresholds)
    h = state.hysteresis
    linear = own @ np.concatenate([h.weights, [h.p1, h.p2]])
    target = rows.x - (simulator.run(state) - state.offsets[rows.of_record] - linear)
    lower, upper = np.full(columns.shape[1], -np.inf), np.full(columns.shape[1], np.inf)
    lower[:m] = 0.0
    normal = _Normal(base, np.empty((rows.n, 0)), target, np.zeros(columns.shape[1]))
    theta = normal.solve(lower, upper)
    new = Hysteresis(thresholds, theta[:m], float(theta[m]), float(theta[m + 1]))
    return replace(state, hysteresis=new, offsets=theta[m + 2 :]), base


def base_at(simulator: Simulator, state: State) -> BaseColumns:
    """
    Return what a refit of H can do in a state, its effects and a retuned G included.

    Parameters
    ----------
    simulator : Simulator
    state : State
    """
    h = state.hysteresis
    prediction = simulator.run(state)
    columns = []
    for j in range(h.thresholds.size + 2):
        weights, p1, p2 = h.weights.copy(), h.p1, h.p2
        if j < h.thresholds.size:
            weights[j] += WEIGHT_STEP
        p1 += WEIGHT_STEP * (j == h.thresholds.size)
        p2 += WEIGHT_STEP * (j == h.thresholds.size + 1)
        moved = replace(state, hysteresis=Hysteresis(h.thresholds, weights, p1, p2))
        columns.append((simulator.run(moved) - prediction) / WEIGHT_STEP)
    whole = np.hstack([np.stack(columns, axis=1), _offset_columns(simulator.rows)])
    return BaseColumns(whole, whole.T @ whole)


def fit_jointly(
    simulator: Simulator,
    state: State,
    base: BaseColumns,
    *,
    iterations: int = ITERATIONS,
    tick: Callable[[], None] = lambda: None,
) -> Fitted:
    """
    Fit everything that a state holds by the free-run error (Levenberg-Marquardt).

    Parameters
    ----------
    simulator : Simulator
    state : State
        Where to start; its thresholds stay.
    base : BaseColumns
        Of its thresholds.
    iterations : int, optional
    tick : callable, optional
        Called between the steps; may raise `piezo_ident.common.errors.Cancelled`.
    """
    rows = simulator.rows
    handles = handles_of(state, len(rows.names))
    m = state.hysteresis.thresholds.size
    p = base.columns.shape[1] + len(handles)
    damping = 1e-4
    prediction = simulator.remember(state)
    e = rows.x - prediction
    moving = _derivatives(simulator, state, handles, prediction, tick)
    for _ in range(iterations):
        before = float(e @ e)
        lower, upper = _room(state, handles, p)
        normal = _Normal(base, moving, e, _prior(rows, e, p, m))
        found = None
        for _ in range(ATTEMPTS):
            tick()
            step = normal.solve(lower, upper, damping)
            try:
                trial = _moved(state, handles, step)
                left = rows.x - simulator.run(trial)
            except ModelError:
                damping *= 10.0
                continue
            after = float(left @ left)
            if np.isfinite(after) and after < before:
                found = trial
                break
            damping *= 10.0
        if found is None:
            break
        damping = max(damping / 10.0, 1e-8)
        state = found
        prediction = simulator.remember(state)
        e = rows.x - prediction
        moving = _derivatives(simulator, state, handles, prediction, tick)
        if after > (1.0 - TOLERANCE) * before:
            break
    lower, upper = _room(state, handles, p)
    J = np.hstack([base.columns, moving])
    alive = np.concatenate([np.diag(base.total), np.sum(moving**2, axis=0)]) > 0.0
    free = (lower < -1e-12) & (upper > 1e-12) & alive
    prior = _prior(rows, e, p, m)
    gram = gram_of(rows, J[:, free], e)
    return Fitted(
        state=state,
        base=base,
        e=e,
        J=J,
        free=free,
        handles=handles,
        prior=prior,
        errors=held_out_errors(gram, rows.fold, prior[free]),
        transfer=held_out_errors(gram, rows.group, prior[free]),
    )


def _offset_columns(rows: Rows) -> NDArray[np.float64]:
    of = rows.of_record[:, None] == np.arange(len(rows.names))
    return np.asarray(of, dtype=np.float64)


def _prior(rows: Rows, e: NDArray[np.float64], p: int, m: int) -> NDArray[np.float64]:
    prior = np.zeros(p)
    # neighbouring residuals are alike: a block counts as a few observations, not as thousands
    count = e.size / max(1.0, 0.2 * e.size / (rows.edges.size - 1))
    prior[: m + 2] = float(e @ e) / count / WEIGHT_SPREAD**2
    return prior


def _derivatives(
    simulator: Simulator,
    state: State,
    handles: tuple[Handle, ...],
    prediction: NDArray[np.float64],
    tick: Callable[[], None],
) -> NDArray[np.float64]:
    columns = np.zeros((prediction.size, len(handles)))
    for j, handle in enumerate(handles):
        tick()
        value = handle.get(state)
        step = handle.step
        top = handle.upper / value if handle.logarithmic else handle.upper - value
        if (handle.logarithmic and top < np.exp(step)) or (not handle.logarithmic and top < step):
            step = -step
        try:
            moved = handle.moved(state, step)
            effect = None if handle.effect is None else state.effects[handle.effect].effect
            columns[:, j] = (simulator.varied(moved, effect) - prediction) / step
        except ModelError:
            # a bound that depends on other parameters: this one stays
            continue
    return columns


def _room(
    state: State, handles: tuple[Handle, ...], p: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    lower, upper = np.full(p, -np.inf), np.full(p, np.inf)
    m = state.hysteresis.thresholds.size
    lower[:m] = -state.hysteresis.weights
    for j, handle in enumerate(handles, start=p - len(handles)):
        value = handle.get(state)
        if handle.logarithmic:
            lower[j] = max(-1.0, np.log(max(handle.lower, 1e-300) / value))
            upper[j] = min(1.0, np.log(handle.upper / value))
        else:
            lower[j], upper[j] = handle.lower - value, handle.upper - value
    return np.minimum(lower, 0.0), np.maximum(upper, 0.0)


def _moved(state: State, handles: tuple[Handle, ...], step: NDArray[np.float64]) -> State:
    h = state.hysteresis
    m, k = h.thresholds.size, state.offsets.size
    new = replace(
        state,
        hysteresis=Hysteresis(
            h.thresholds,
            np.maximum(h.weights + step[:m], 0.0),
            h.p1 + float(step[m]),
            h.p2 + float(step[m + 1]),
        ),
        offsets=state.offsets + step[m + 2 : m + 2 + k],
    )
    for handle, delta in zip(handles, step[m + 2 + k :], strict=True):
        new = handle.moved(new, float(delta))
    return new


class _Normal:
    """Normal equations of a step, scaled to columns of length one."""

    def __init__(
        self,
        base: BaseColumns,
        moving: NDArray[np.float64],
        e: NDArray[np.float64],
        prior: NDArray[np.float64],
    ) -> None:
        mixed = base.columns.T @ moving
        A = np.block([[base.total, mixed], [mixed.T, moving.T @ moving]])
        size = np.sqrt(np.diag(A))
        self._size = np.where(size > 0.0, size, 1.0)
        self._A = A / np.outer(self._size, self._size)
        self._A[np.diag_indices_from(self._A)] += 1e-10 + prior / self._size**2
        # a column of zeros stays where it is
        self._A[np.diag_indices_from(self._A)] += np.where(size > 0.0, 0.0, 1.0)
        self._b = np.concatenate([base.columns.T @ e, moving.T @ e]) / self._size

    def solve(
        self, lower: NDArray[np.float64], upper: NDArray[np.float64], damping: float = 0.0
    ) -> NDArray[np.float64]:
        """Return the bounded step; damping is a share of each column's own energy."""
        A = self._A.copy()
        A[np.diag_indices_from(A)] += damping
        wide = upper > lower
        L = np.linalg.cholesky(A)
        # what stays where it is adds nothing to the right-hand side
        target = np.linalg.solve(L, self._b)
        x = np.zeros(self._size.size)
        bounds = ((lower * self._size)[wide], (upper * self._size)[wide])
        x[wide] = lsq_linear(L.T[:, wide], target, bounds, method='bvls').x
        return np.clip(x / self._size, lower, upper)

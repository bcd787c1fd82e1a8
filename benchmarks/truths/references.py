# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What models that are linear in their weights reach, each with the stage's own linear part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular
from scipy.ndimage import maximum_filter1d, minimum_filter1d
from scipy.optimize import lsq_linear

from .cores import Array
from .families import play
from .family_stage import FamilyStage

#: rows that are fitted at most
ROWS = 30_000
#: over which the voltage must sweep far for a sample to tell of the hysteresis [s]
WINDOW = 0.6
#: ten plays, forty plays, and on each a form of the hysteresis
FORMS = ('ten plays', 'forty plays', 'and a square', 'weighted by the bias', 'relay plane')


def _columns(u: Array, form: str) -> tuple[list[Array], int]:
    """Return the columns of a form before the linear part; the first so many are >= 0."""
    count = 40 if form in ('forty plays', 'and a square') else 10
    plays = [play(u, float(r)) for r in np.arange(count) / count]
    if form == 'weighted by the bias':
        # without the first: v times itself is a square
        return [*plays, u**3, *(u * F for F in plays)], count
    if form == 'relay plane':
        # a relay density cubic in the bias: each play through a curve of its own
        return [*(F**k for F in plays for k in (1, 2, 3, 4))], 0
    return [*plays, u**3, *([u**2] if form == 'and a square' else [])], count


def basis(stage: FamilyStage, v: Array, name: str, form: str) -> tuple[Array, int]:
    """
    Return the columns of a form behind the stage's linear part, with an offset, thinned.

    `v`: [V]; `name`: of the record: the past of the plays is the stage's own; `form`: one of
    `FORMS`.
    """
    low, high = stage.limits
    u = (v - low) / (high - low)
    before = stage.before(float(u[0]), name)
    columns, positive = _columns(np.concatenate([before, u]), form)
    stride = max(1, v.size // ROWS)
    parts = [stage.linear(c, stage.rate)[before.size :: stride] for c in columns]
    return np.stack([*parts, np.ones(parts[0].size)], axis=1), positive


def _fitted(X: Array, y: Array, positive: int) -> Array:
    scale = np.maximum(np.sqrt(np.mean(X**2, axis=0)), 1e-9)
    # a touch of ridge, since neighbouring plays are nearly the same
    rows = np.vstack([X / scale, 1e-4 * np.sqrt(y.size) * np.eye(X.shape[1])])
    Q, R = qr(rows, mode='economic')
    target = Q.T @ np.concatenate([y, np.zeros(X.shape[1])])
    if not positive:
        return np.asarray(solve_triangular(R, target) / scale)
    least = np.full(X.shape[1], -np.inf)
    least[:positive] = 0.0
    return np.asarray(lsq_linear(R, target, (least, np.inf), method='bvls').x / scale)


def _error(X: Array, y: Array, weights: Array) -> float:
    e = y - X @ weights
    return float(100.0 * e.std() / np.ptp(y))


def references(
    stage: FamilyStage,
    records: Mapping[str, tuple[Array, Array]],
    forms: tuple[str, ...] = FORMS,
    sweeps: Sequence[tuple[int, int]] = (),
) -> dict[str, float]:
    """
    Return the error of each form on the unseen record, % of stroke, its mean removed.

    Fitted on the identification: on all of it, where the stage moves far, and on its sweeps, since
    a stage that is no sum of plays creeps away in the steps and the noise; the one that predicts
    better is kept.

    `records`: identification and unseen: command [V], and displacement in parts of the stroke;
    `sweeps`: samples of the identification that follow its triangles.
    """
    found = {}
    for form in forms:
        thinned = {}
        for name, (v, y) in records.items():
            X, positive = basis(stage, v, name, form)
            thinned[name] = X, y[:: max(1, v.size // ROWS)]
        X, y = thinned['identification']
        v = records['identification'][0]
        at = np.arange(0, v.size, max(1, v.size // ROWS))
        swept = [(a <= at) & (at < b) for a, b in sweeps]
        found[form] = min(
            _error(*thinned['unseen'], _fitted(X[rows], y[rows], positive))
            for rows in (np.ones(y.size, dtype=bool), _moved(stage, v), *swept)
        )
    return found


def _moved(stage: FamilyStage, v: Array) -> NDArray[np.bool_]:
    """Return the thinned samples about which the voltage sweeps a third of its range."""
    stride = max(1, v.size // ROWS)
    v, around = v[::stride], round(WINDOW * stage.rate / stride)
    swept = maximum_filter1d(v, around) - minimum_filter1d(v, around)
    return np.asarray(swept > np.ptp(stage.limits) / 3.0)


def remainder(X: Array, change: Array) -> float:
    """Return the rms of what a refit of columns leaves of a change."""
    Q, _ = np.linalg.qr(X)
    return float(np.sqrt(np.mean((change - Q @ (Q.T @ change)) ** 2)))

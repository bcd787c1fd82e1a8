# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Attribute the error of a running model to its gain, its loop width or its dynamics.

Least squares fit the error of the free run by the responses to small changes of the model.  A
change of the gain adds the free run itself.  Wider plays stand for the loop.  Slower poles and
the velocity stand for the dynamics.  A changed model runs for wider plays, and another for slower
poles.  Effects, G and delay then act on these changes as they act on the stage.  A high-pass
removes offset, drift and creep of earlier motion, which an observer corrects.  Old samples fade.

The best part alone must explain most of the error.  A second part is named if the best two parts
leave much less than the best part, and a third part likewise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from piezo_ident.common.arrays import Array, interpolated, Mask
from piezo_ident.fitting.adaptation import grown, Recalled, SLOW
from piezo_ident.model.metrics import expected_error
from piezo_ident.model.observer import PATH
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.dynamics import Dynamics
from piezo_ident.operators.sections import run_sections
from piezo_ident.record.readings.faults import MAX_WILD

#: time constant with which old samples fade [s] (taste: some periods of a slow scan)
FADE = 5.0
#: relative change of the speed of the poles, whose response counts as a derivative: far below the
#: damping of a mode
SLOWER = 1e-3
#: share of the squared error that one part must explain alone (taste)
EXPLAINED = 0.5
#: factor by which one more part must reduce the squared error (taste)
NEEDED = 2.0
#: samples are taken together over this time, which costs less than block by block [s]
BATCH = 0.1
#: smallest change of gain or loop that is named, in standard deviations (taste)
SURE = 3.0
#: least reduction of the squared error by one more part, as a share of the whole (taste)
FAINT = 2e-3
#: largest distance of an error from the median of its block, in median deviations.  An error
#: beyond is left out.  18 are twelve standard deviations of a normal law (taste)
WILD = 18.0

#: rows of the regression by part; the last row is the error
PARTS = {'gain': (0,), 'loop': (1,), 'dynamics': (2, 3)}
ERROR = 4


@dataclass(frozen=True)
class Cause:
    """
    A part of the stage that changed.

    Attributes
    ----------
    part : {'gain', 'loop', 'dynamics'}
    value, std : float
        Relative change of the gain or of the loop width, and its standard deviation.  For dynamics
        the rms error by their change, in spans: positive for a slower stage.
    """

    part: str
    value: float
    std: float

    def __str__(self) -> str:
        if self.part == 'dynamics':
            return 'slower dynamics' if self.value > 0.0 else 'faster dynamics'
        name = 'hysteresis: loop width' if self.part == 'loop' else 'gain'
        return f'{name} {percent_change(self.value, self.std)}'


def percent_change(value: float, std: float) -> str:
    """Format a relative change with its standard deviation, to a tenth of a percent."""
    return f'{100.0 * value:+.1f} +- {max(100.0 * std, 0.05):.1f} %'


def slower(model: StageModel) -> StageModel | None:
    """Slow the poles of G by `SLOWER`; return None if all poles are real and at most zero."""
    G = model.dynamics
    poles = G.poles
    # a pole on the negative real axis has no frequency
    moved = (np.abs(poles) > 0.0) & ((poles.imag != 0.0) | (poles.real > 0.0))
    if not moved.any():
        return None
    poles[moved] = poles[moved] ** (1.0 / (1.0 + SLOWER))
    a = np.atleast_1d(np.real(np.poly(poles)))
    size = a.sum() / (1.0 + G.a.sum())
    return replace(model, dynamics=Dynamics(a[1:], G.b * size))


class Attribution:
    """
    Finds the changed parts of a stage from displacement that comes a horizon later.

    Parameters
    ----------
    model : StageModel
    horizon : int
        Samples by which displacement is older than the free run.
    recalled : callable, optional
        See `Recalled`; at rest when absent.  With None, only gain and delay can be changed parts.
    """

    def __init__(
        self, model: StageModel, horizon: int, recalled: Recalled = StageModel.stream
    ) -> None:
        h = model.hysteresis
        wider = replace(model, hysteresis=grown(h, np.ones(h.thresholds.size)))
        changed = (wider if h.weights.any() else None, slower(model))
        self._model, self._rate = model, model.sample_rate
        self._error = (expected_error(model) or 0.0) / 100.0
        self._runs = [None if m is None or recalled is None else recalled(m) for m in changed]
        self._past = np.full((3, horizon), np.nan)
        self._batch: list[tuple[Array, Array, Array, Array]] = []
        # state of the high-pass
        self._fast: Array | None = None
        # sums over samples: products of the rows; number, free run and its square
        self._products, self._sums = np.zeros((ERROR + 1, ERROR + 1)), np.zeros(3)

    def process(self, v: Array, t: Array, free: Array, measured: Array) -> None:
        """
        Take the next samples; all shapes (n,).

        Parameters
        ----------
        v, t : ndarray
            Voltage [V] and its time [s].
        free : ndarray
            Free run of the model [m].
        measured : ndarray
            Displacement a horizon before [m]; NaN if it is missing.
        """
        self._batch.append((v, t, free, measured))
        if sum(part[0].size for part in self._batch) >= BATCH * self._rate:
            self._take(*(np.concatenate(x) for x in zip(*self._batch, strict=True)))
            self._batch.clear()

    def _take(self, v: Array, t: Array, free: Array, measured: Array) -> None:
        Y, s = self._model.scaling.Y, self._model.scaling
        responses = [
            np.zeros(v.size) if run is None else (run.process(v, t) - free) / (Y * unit)
            for run, unit in zip(self._runs, (1.0, SLOWER), strict=True)
        ]
        whole = np.concatenate([self._past, np.stack([s.x(free), *responses])], axis=1)
        before, self._past = whole[:, : v.size], whole[:, v.size :]
        x, e = before[0], s.x(measured) - before[0]
        counts = np.isfinite(e)
        if not counts.any() or x.size < 2 or not np.isfinite(x).all():
            self._fast = None
            return
        far = np.abs(e - np.median(e[counts]))
        wild = far > WILD * np.median(far[counts])
        # many wild samples are real motion of the stage
        if np.count_nonzero(wild) <= MAX_WILD * x.size:
            counts &= ~wild
        rows = [x, *before[1:], self._rate * np.gradient(x), interpolated(e, ~counts)]
        self._add(np.stack(rows), counts)

    def _add(self, rows: Array, counts: Mask) -> None:
        """Add the rows of a block, behind the high-pass, to the fading sums."""
        keep = np.exp(-1.0 / (SLOW * self._rate))
        if self._fast is None:
            # the output of the high-pass begins at zero
            self._fast = np.stack([-keep * rows[:, :1], np.zeros((len(rows), 1))], axis=-1)
        fast, section = np.empty_like(rows), np.array([[keep, -keep, 0.0, -keep, 0.0]])
        for row, state, out in zip(rows, self._fast, fast, strict=True):
            run_sections(row, section, state, out)
        fast, x = fast[:, counts], rows[0, counts]
        left = np.exp(-rows.shape[1] / (FADE * self._rate))
        self._products = left * self._products + fast @ fast.T
        self._sums = left * self._sums + [x.size, x.sum(), x @ x]

    @property
    def causes(self) -> list[Cause]:
        """Parts that changed, each with its size; empty if the parts do not explain the error."""
        n, total, square = self._sums.tolist()
        # swing of a uniform motion of this variance, in correlation lengths of the error
        swing = np.sqrt(12.0 * max(square / n - (total / n) ** 2, 0.0)) / PATH if n else 0.0
        if swing < 1.0:
            return []
        whole, chosen = float(self._products[ERROR, ERROR] / n), tuple[str, ...]()
        left, most = whole, (1.0 - EXPLAINED) * whole
        for count in range(1, len(PARTS) + 1):
            by = {parts: self._fitted(parts)[0] for parts in combinations(PARTS, count)}
            best = min(by, key=by.__getitem__)
            if by[best] > min(most, left - FAINT * whole):
                break
            chosen, left, most = best, by[best], by[best] / NEEDED
        if not chosen:
            return []
        _, values, spread = self._fitted(chosen)
        # A repeated motion repeats the error of the model.  Each branch of a loop holds one
        # independent error for two correlation lengths.
        std = np.sqrt(max(left, self._error**2) * spread / swing)
        size = np.where(np.arange(ERROR) < 2, 1.0, np.sqrt(np.diag(self._products)[:ERROR] / n))
        # a delay adds a negative multiple of the velocity
        value, std = values * size * [1.0, 1.0, 1.0, -1.0], std * size
        causes = [
            Cause(part, float(value[list(at)].sum()), float(np.hypot.reduce(std[list(at)])))
            for part, at in PARTS.items()
            if part in chosen
        ]
        return [c for c in causes if c.part == 'dynamics' or abs(c.value) > SURE * c.std]

    def _fitted(self, parts: Sequence[str]) -> tuple[float, Array, Array]:
        """Fit parts; return the mean square left, the values, and the inverse diagonal of A."""
        n, rows = self._sums[0], [j for part in parts for j in PARTS[part]]
        A, b = self._products[np.ix_(rows, rows)] / n, self._products[rows, ERROR] / n
        scale = np.sqrt(np.maximum(np.diag(A), 1e-30))
        inverse = np.linalg.pinv(A / np.outer(scale, scale), rcond=1e-9) / np.outer(scale, scale)
        values, spread = np.zeros(ERROR), np.zeros(ERROR)
        values[rows], spread[rows] = inverse @ b, np.diag(inverse)
        left = float(self._products[ERROR, ERROR] / n - b @ values[rows])
        return max(left, 0.0), values, spread

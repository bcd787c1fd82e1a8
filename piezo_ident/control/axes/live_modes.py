# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Invert modes that several axes share, block by block while the wanted motions come in.

    u <- u + Q (y_wanted - y(u)),        u = u_rest before the first pass

y(u) is the free run of the modes about their `v0`.  Q inverts a linear model of them by filters
that look ahead, see `axes_inverse`.  As in `piezo_ident.control.live_inverse`, each pass runs
behind the pass before it, and handles every sample once.

The linear model leaves out softening and plays, or it has the gain of each signal in a trial run
over the range.  The linear model with the smaller error on the trial is taken.  The next pass
leaves out an axis whose voltage is at a limit, because a move of the others does not help it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.control.axes.axes_inverse import AxesFilter, inverse_filters, static_gain
from piezo_ident.control.axes.modes_inverse import equivalent, Limited, signal_gains
from piezo_ident.control.inputs import checked_limits, SHORT
from piezo_ident.control.linear_inverse import least_gain
from piezo_ident.control.live_inverse import (
    Driven,
    PASS_LEAVES,
    PREVIEW,
    preview_warnings,
    trial_motion,
)
from piezo_ident.model.metrics import percent_of_stroke
from piezo_ident.model.modes.shared_modes import SharedModes
from piezo_ident.model.modes.stream import ModesRun, ModesStream
from piezo_ident.model.multi_axis import alone, MultiAxisModel

#: most passes: plays and softening leave a tenth to a third of the error to the next one
MOST_PASSES = 6
#: periods of the trial motion grow by this share from axis to axis, so that no two move as one
APART = 0.3


@dataclass(frozen=True, eq=False)
class _Bounds:
    """
    Voltages about `v0`: the lowest, the highest, and those of rest [V].

    A voltage that is off its goal by more than `short` misses it [V].
    """

    low: Array
    high: Array
    rest: Array
    short: Array


class LiveModesInverse:
    """
    The inverse of shared modes, block by block; arrays have a row for each axis.

    Before the first block the stage rests under the voltage `rest`, and the wanted motions rest at
    `position`.  Each sample of the wanted motions gives one sample of the voltages.  The stage
    reaches the wanted displacements `preview` samples later.

    Parameters
    ----------
    model : MultiAxisModel
        With shared modes.
    axes : sequence of str
        Order of the rows, by the names of the displacements.
    limits, slew, preview, rest
        As for `LiveInverse`, for each axis.

    Attributes
    ----------
    preview, passes, error, warnings
        As of `LiveInverse`; the error is that of the worst axis on a trial of all axes at once.
    position : ndarray, shape (k,)
        Displacements of the stage at rest [m].
    models : list of StageModel
        Models of the axes beside the modes, with scaling and known errors.

    Raises
    ------
    DataError
        When the limits are crossed, or rest lies outside of them.
    ModelError
        When the modes have no inverse, or run away on the trial motion.
    """

    def __init__(
        self,
        model: MultiAxisModel,
        axes: Sequence[str],
        *,
        limits: tuple[float, float] | None = None,
        slew: float = np.inf,
        preview: int = PREVIEW,
        rest: float | None = None,
    ) -> None:
        if model.modes is None:
            raise ModelError(
                f'live inverse: the axes {", ".join(axes)} share no modes; make a LiveInverse of '
                'each axis'
            )
        if preview < 1:
            raise ModelError(f'a preview of {preview} samples does not look ahead; make it longer')
        # rows of the axes, and columns of the modes in alphabetical order
        self._order = np.argsort(axes)
        self._rows = np.argsort(self._order)
        self._modes, self.preview = model.modes, int(preview)
        each = [alone(model)[axis] for axis in sorted(axes)]
        self.models, self._axes = [alone(model)[axis] for axis in axes], tuple(axes)
        low, high, speeds = np.array([checked_limits(x, limits, slew) for x in each]).T
        rests = low if rest is None else np.full(len(each), float(rest))
        if not np.all((low <= rests) & (rests <= high)):
            raise DataError(f'rest, {rest:g} V, lies outside of {low[0]:g} .. {high[0]:g} V')
        v0, self._limits = self._modes.v0, (low, high)
        self._rate, self._whole = model.sample_rate, np.array([abs(x.scaling.Y) for x in each])
        short = SHORT / np.abs(static_gain(self._modes.linear, self._whole)).max(axis=0)
        self._bounds = _Bounds(low - v0, high - v0, rests - v0, short)
        self.error, Q, self.passes = self._tried(max(map(least_gain, each)))
        self._passes = self._built(Q, self.passes, float(speeds[0]))
        self.warnings = preview_warnings(preview, self.passes, self.error)
        self.reset()

    def _built(self, Q: AxesFilter, passes: int, slew: float) -> list[_Pass]:
        """Build passes that share the preview."""
        Q, one = Q.shortened(self.preview // passes), self._bounds
        waits = [self.preview - passes * Q.ahead] + [0] * (passes - 1)
        return [
            _Pass(self._modes, Q, wait, Limited(one.low, one.high, slew, self._rate), one, k == 0)
            for k, wait in zip(reversed(range(passes)), waits, strict=True)
        ]

    def _tried(self, least: float) -> tuple[float, AxesFilter, int]:
        """Choose Q and the number of passes on a trial motion; return error, Q and number."""
        modes, one = self._modes, self._bounds
        shapes = [trial_motion(1.0 + APART * k) for k in range(len(one.low))]
        fade, motion = (np.column_stack(rows) for rows in zip(*shapes, strict=True))
        middle = 0.5 * (one.low + one.high)
        u = one.rest + fade * (middle - one.rest + (one.high - one.low) * motion)
        wanted = ModesStream(modes).process(u + modes.v0)
        tried = list[tuple[float, AxesFilter, int]]()
        for gains in (np.zeros(modes.signals), signal_gains(modes, u)):
            Q, _ = inverse_filters(equivalent(modes, gains), self._whole, least)
            before = np.inf
            for passes in range(1, min(MOST_PASSES, self.preview) + 1):
                error = self._missed(self._built(Q, passes, np.inf), wanted)
                tried.append((error, Q, passes))
                if not error < PASS_LEAVES * before:
                    break
                before = error
        best = min(tried, key=lambda one: one[0])
        if not np.isfinite(best[0]):
            (low, *_), (high, *_) = self._limits
            raise ModelError(
                'live inverse: the shared modes run away on a trial motion within '
                f'{low:g} .. {high:g} V; give narrower limits, or diagnose again'
            )
        return best

    def _missed(self, passes: list[_Pass], wanted: Array) -> float:
        """Compute the largest error of an axis on a motion from rest [% of its span]."""
        known = np.pad(wanted, ((0, self.preview), (0, 0)), mode='edge')
        try:
            u, _ = _through(passes, known)
            reached = ModesStream(self._modes).process(u + self._modes.v0)[self.preview :]
        except ModelError:  # ran away
            return np.inf
        return max(percent_of_stroke(*both) for both in zip(wanted.T, reached.T, strict=True))

    def reset(self) -> None:
        """Come to rest."""
        for p in self._passes:
            p.reset()
        self.position = self._passes[0].position[self._rows]
        self._run: ModesRun | None = ModesRun(self._modes, self._axes)

    def goals(self, wanted: Array) -> Array:
        """Leave the wanted motions as they are: the modes are inverted with all axes."""
        return wanted

    def moved(self, v: Array, own: Array) -> tuple[Array, Array]:
        """See `LiveChains.moved`; the modes do not tell what an axis feels of the others."""
        try:
            y = own if self._run is None else self._run.process(v)
        except ModelError:  # ran away, and so does the inverse
            y, self._run = own, None
        return y, np.zeros(y.shape)

    def process(self, wanted: Array) -> Driven:
        """
        Compute the voltages for the next samples of the wanted motions.

        Parameters
        ----------
        wanted : ndarray, shape (k, n)
            Displacements [m].

        Returns
        -------
        Driven
            As many samples.

        Raises
        ------
        DataError
            When the wanted motions are no finite numbers.
        ModelError
            When the modes run away.
        """
        fits = wanted.ndim == 2 and len(wanted) == self._rows.size and wanted.size
        if not fits or not np.isfinite(wanted).all():
            raise DataError(
                f'live inverse: the wanted motions must be {self._rows.size} rows of finite '
                'numbers, in metres'
            )
        u, missed = _through(self._passes, wanted[self._order].T)
        v = np.clip(u + self._modes.v0, *self._limits)
        return Driven(np.ascontiguousarray(v.T[self._rows]), missed.T[self._rows])


class _Pass:
    """
    One pass of the iteration with its own filter and run, behind the pass before it.

    The pass waits for `wait` samples more than it needs.
    """

    def __init__(
        self,
        modes: SharedModes,
        Q: AxesFilter,
        wait: int,
        limited: Limited,
        bounds: _Bounds,
        is_last: bool,
    ) -> None:
        self._modes, self._limited, self._bounds = modes, limited, bounds
        self._taps = np.ascontiguousarray(Q.taps[::-1].transpose(1, 2, 0))
        self._ahead, self._behind, self._is_last = Q.ahead + wait, Q.behind, is_last
        self.reset()

    def reset(self) -> None:
        """Come to rest."""
        self.rest = rest = self._bounds.rest[None]
        self._limited.reset(rest[0])
        self._stream = ModesStream(self._modes)
        (self.position,) = self._stream.process(rest + self._modes.v0)
        self._x, self._goal = (np.repeat(z[None], self._ahead, 0) for z in (self.position, *rest))
        self._d = np.zeros((self._behind + self._ahead, rest.size))

    def process(self, x: Array, d: Array, goal: Array) -> tuple[Array, Array, Array, Array, Mask]:
        """
        Process the samples that are known far enough ahead, and return the input of the next pass.

        x, d and goal, shape (n, k), are wanted motion and error [m], and voltages about `v0` that
        the limits may not allow [V].  The result is x, d and goal after this pass, the voltages
        within the limits, and a mask of the samples at which they miss the goal; all of shape
        (n, k).
        """
        x, d, goal = (np.concatenate(z) for z in ((self._x, x), (self._d, d), (self._goal, goal)))
        n = len(x) - self._ahead
        self._x, self._d, self._goal = x[n:], d[n:], goal[n:]
        x, d = x[:n], d[: n + self._taps.shape[-1] - 1]
        goal = goal[:n] + np.column_stack(
            [
                sum(np.correlate(z, h, 'valid') for z, h in zip(d.T, row, strict=True))
                for row in self._taps
            ]
        )
        u = self._limited.process(goal)
        missed = np.abs(goal - u) > self._bounds.short
        if not self._is_last:
            # the goal must not run away from a voltage at its limit
            d = np.where(missed, 0.0, x - self._stream.process(u + self._modes.v0))
        return x, d, goal, u, missed


def _through(passes: list[_Pass], x: Array) -> tuple[Array, Mask]:
    """Pass wanted motions [m] through all passes; voltages about `v0` [V], and where they miss."""
    d, u = x - passes[0].position, np.repeat(passes[0].rest, len(x), axis=0)
    goal, missed = u, np.zeros(u.shape, dtype=bool)
    for p in passes:
        x, d, goal, u, missed = p.process(x, d, goal)
    return u, missed

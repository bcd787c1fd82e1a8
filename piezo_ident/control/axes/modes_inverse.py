# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Invert modes that several axes share: find voltages that move all axes along wanted motions.

    m <- m + P (y_wanted - y(u)),        u = u_0 + Q m

y(u) is the free run of the modes.  Q inverts a linear model of them by filters that look ahead,
see `axes_inverse`.  P = G Q is nearly one where the stage moves, and small above its modes.  The
iteration therefore leaves alone the motion that is too fast for the stage.

A linear model lacks softening and plays.  The first pass inverts the linear model without them,
and runs the modes under this voltage.  Each signal z then gets the gain k for which k z is nearest
to its push p in this run.  The other passes invert the linear model with these gains.  The gains
are the statistical linearisation of A. Gelb and W. E. Vander Velde, Multiple-Input Describing
Functions and Nonlinear System Design, 1968.

The passes are combined by the acceleration of D. G. Anderson, "Iterative procedures for nonlinear
integral equations", J. ACM 12(4), 1965, doi:10.1145/321296.321305.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.control.axes.axes_inverse import AxesFilter, inverse_filters, static_gain
from piezo_ident.control.expectation import expect
from piezo_ident.control.inputs import check_rate, checked_limits, extrapolated, tolerance
from piezo_ident.control.inverse import EXACT, Inverse, LARGE, MATTERS, RESTS, STANDS, STILL
from piezo_ident.control.linear_inverse import least_gain
from piezo_ident.effects.slew_limit import SlewLimit
from piezo_ident.model.metrics import percent, percent_of_stroke
from piezo_ident.model.modes.modal import Modal, to_modal
from piezo_ident.model.modes.shared_modes import SharedModes
from piezo_ident.model.modes.stream import ModesStream
from piezo_ident.model.multi_axis import alone, MultiAxisModel
from piezo_ident.operators.chain import Block
from scipy.ndimage import maximum_filter1d

#: most passes, and most passes in turn without a better one (taste)
PASSES, STALLS = 40, 6
#: earlier passes that a step combines (taste: more find nothing in noise of 1e-6)
DEPTH = 8
#: smallest singular value of the changes from pass to pass that counts, over the largest (taste)
COUNTS = 1e-8
#: most steps to the voltages of rest, and their accuracy [of the span of the model]
STEPS, AT_REST = 50, 1e-9
#: the iteration contracts if it leaves at most this share of the error of the linear inverse
CONTRACTS = 0.5
#: share of the time in which the level may exceed its range (taste)
RARE = 0.1


def equivalent(modes: SharedModes, gains: Array) -> Modal:
    """Make the linear model in which each signal z pushes by its gain times z."""
    one, e, h = modes.linear, modes.e * gains, modes.h * gains
    return to_modal(
        one.a + e @ modes.f, one.b + e @ modes.g, one.c + h @ modes.f, one.d + h @ modes.g
    )


def invert_modes(
    model: MultiAxisModel,
    modes: SharedModes,
    wanted: Mapping[str, Array],
    *,
    limits: tuple[float, float] | None = None,
    slew: float = np.inf,
    clip: bool = False,
    sample_rate: float | None = None,
    like: object = None,
) -> dict[str, Inverse]:
    """
    Find the voltages under which shared modes move all axes as wanted; see `piezo_ident.invert`.

    Parameters
    ----------
    model : MultiAxisModel
    modes : SharedModes
        Shared modes of the model.
    wanted : mapping of str to ndarray, shape (n,)
        Displacement by axis [m].
    limits, slew, clip, sample_rate
        As for `piezo_ident.control.inverse.invert`, for each axis.
    like : object, optional
        Not used.

    Returns
    -------
    dict of str to Inverse
        All begin with the same sample.

    Raises
    ------
    DataError
        When the limits do not reach the wanted motion.
    ModelError
        When the modes lack an inverse, or the iteration does not contract.
    """
    check_rate(model.sample_rate, sample_rate)
    task = _Task(model, modes, wanted, limits, slew, clip)
    return _results(task, *_iterated(task), clip)


class Limited:
    """Keeps voltages about v0 within limits [V] and slew [V/s]; begin with `reset`."""

    def __init__(self, low: Array, high: Array, slew: float, sample_rate: float) -> None:
        self._low, self._high = low, high
        self._guards = [SlewLimit(sample_rate, {'limit': slew}) for _ in low]

    def reset(self, u: Array) -> None:
        """Come to rest under voltages, shape (k,)."""
        for guard, x in zip(self._guards, np.clip(u, self._low, self._high).tolist(), strict=True):
            guard.reset(x, x)

    def process(self, u: Array) -> Array:
        """Limit the next voltages, shape (n, k)."""
        columns, t = [], np.zeros(len(u))
        for guard, x in zip(self._guards, np.clip(u, self._low, self._high).T, strict=True):
            columns.append(guard.process(Block(t=t, v=x, x=np.ascontiguousarray(x))).x)
        return np.column_stack(columns)


class _Pass(NamedTuple):
    """Voltages about v0, error, samples out of reach, rms error of the rest [spans], passes."""

    u: Array
    error: Array
    missed: Mask
    left: float
    passes: int


class _Task:
    """Wanted motions of all axes in alphabetical order, with rest before and after them."""

    def __init__(
        self,
        model: MultiAxisModel,
        modes: SharedModes,
        wanted: Mapping[str, Array],
        limits: tuple[float, float] | None,
        slew: float,
        clip: bool,
    ) -> None:
        self.model, self.modes, self.axes = model, modes, sorted(model.axes)
        self.models = alone(model)
        each = [self.models[a] for a in self.axes]
        self.least = max(map(least_gain, each))
        self.whole = np.array([abs(x.scaling.Y) for x in each])
        bounds = np.array([checked_limits(x, limits, slew) for x in each])
        self.low, self.high = (bounds[:, :2] - self.modes.v0[:, None]).T
        self.step = float(bounds[0, 2])
        self.static = self.whole[:, None] * static_gain(modes.linear, self.whole)
        size = max(x.size for x in wanted.values())
        # an axis without a wanted motion rests under its voltage of the fit
        columns = [wanted.get(a, np.full(size, np.nan)) for a in self.axes]
        self.rest, first = self._rest(np.array([x[0] for x in columns]))
        self.y = np.where(np.isnan(columns), first[:, None], columns).T
        moved = np.ptp(self.y, axis=0)
        # an axis at rest gets the span of the axis that moves most
        moves = moved > STANDS * self.whole
        self.spans = np.where(moves, moved, moved.max() if moves.any() else self.whole)
        self.small = MATTERS * np.minimum(self.spans, LARGE * self.whole)
        self._keep_rest(clip)

    def _rest(self, goal: Array) -> tuple[Array, Array]:
        """
        Find the voltages about v0 under which the modes rest at a goal, and where they rest.

        Axes with the goal NaN keep the voltage of the fit.
        """
        u, free = np.zeros(len(goal)), ~np.isnan(goal)
        for _ in range(STEPS):
            y = ModesStream(self.modes).process((u + self.modes.v0)[None])[0]
            e = (goal - y)[free]
            if np.abs(e / self.whole[free]).max() < AT_REST:
                break
            u[free] += np.linalg.solve(self.static[np.ix_(free, free)], e)
        return u, y

    def _keep_rest(self, clip: bool) -> None:
        """Keep the voltages of rest within the limits; raise DataError if they are far beyond."""
        kept = np.clip(self.rest, self.low, self.high)
        over = np.abs(self.static @ (self.rest - kept))
        far = over > [max(t, s) for t, s in zip(self.tolerances, self.small, strict=True)]
        if far.any() and not clip:
            j = int(np.argmax(over / self.whole))
            low, v, high = (x[j] + self.modes.v0[j] for x in (self.low, self.rest, self.high))
            raise DataError(
                f'the wanted motion of {self.axes[j]} starts at {1e6 * self.y[0, j]:.4g} um, '
                f'which needs {v:.4g} V; the limits are {low:g} .. {high:g} V',
                options='--clip',
            )
        self.rest = kept

    @property
    def tolerances(self) -> list[float]:
        """Excess over the limits that is accepted on each axis [m]."""
        columns = zip(self.axes, self.y.T, strict=True)
        return [tolerance(self.models[a], y) for a, y in columns]

    def limited(self, u: Array) -> Array:
        """Keep voltages about v0 within limits and slew."""
        limited = Limited(self.low, self.high, self.step, self.model.sample_rate)
        limited.reset(u[0])
        return limited.process(u)

    def motion(self, u: Array) -> Array:
        """Simulate the displacements under voltages about v0 [m]."""
        return ModesStream(self.modes).process(u + self.modes.v0)


@dataclass(frozen=True, eq=False)
class _Filters:
    """Filters Q and P of a pass, and the wanted motion with the rest that Q needs."""

    Q: AxesFilter
    P: AxesFilter
    x: Array

    @classmethod
    def of(cls, task: _Task, gains: Array) -> _Filters:
        Q, P = inverse_filters(equivalent(task.modes, gains), task.whole, task.least)
        return cls(Q, P, np.pad(task.y, ((Q.ahead, Q.behind), (0, 0)), mode='edge'))

    def tried(self, task: _Task, m: Array, passes: int) -> _Pass:
        """Run the modes under the voltages for motions m."""
        free = task.rest + self.Q(m - self.x[0])
        u = task.limited(free)
        short = np.abs((free - u) @ task.static.T) > task.small
        near = maximum_filter1d(short.any(axis=1), 2 * self.Q.reach + 1)
        try:
            error = self.x - task.motion(u)
        except ModelError:  # ran away
            return _Pass(u, np.full(u.shape, np.inf), short, np.inf, passes)
        counted = np.where(near[:, None], 0.0, error) if not near.all() else error
        within = self.P(counted) / task.spans
        return _Pass(u, error, short, float(np.sqrt(np.mean(within**2))), passes)

    def correction(self, now: _Pass) -> Array:
        """Compute the step of the iteration [m]: filter the error within reach by P."""
        near = maximum_filter1d(now.missed.any(axis=1), 2 * self.Q.reach + 1)
        return self.P(np.where(near[:, None], 0.0, now.error))


def _iterated(task: _Task) -> tuple[_Pass, _Filters]:
    """Iterate until the error stops falling; raise ModelError if it hardly falls."""
    first = _Filters.of(task, np.zeros(task.modes.signals))
    begun = first.tried(task, first.x, 1)
    filters, best = first, begun
    if np.isfinite(begun.left) and task.modes.signals:
        filters = _Filters.of(task, signal_gains(task.modes, begun.u))
    m, steps, stalls = filters.x, _Anderson(), 0
    for passes in range(2, PASSES + 1):
        now = filters.tried(task, m, passes)
        stalls = 0 if now.left < best.left else stalls + 1
        if now.left < best.left or best is begun:
            best, at = now, m
        if best.left < EXACT or stalls > STALLS or not np.isfinite(best.left):
            break
        if not np.isfinite(now.left):
            m, steps = 0.5 * (m + at), _Anderson()
            continue
        m = steps.next(m, filters.correction(now), task.spans)
    if not (np.isfinite(best.left) and best.left <= max(CONTRACTS * begun.left, MATTERS)):
        raise ModelError(
            'invert: the iteration with the shared modes does not contract: '
            f'{100 * best.left:.2g} % of the motion remain after {passes} passes, '
            f'{100 * begun.left:.2g} % by the inverse of the linear modes; make the motion '
            'smaller or slower'
        )
    return best, filters


def signal_gains(modes: SharedModes, u: Array) -> Array:
    """Compute the gain of each signal for which gain times z is nearest to p."""
    run = modes.run(u)
    z, p = (x - x.mean(axis=0) for x in (run.z, run.p))
    size = np.sum(z**2, axis=0)
    return np.where(size > 0.0, np.sum(z * p, axis=0) / np.where(size > 0.0, size, 1.0), 0.0)


class _Anderson:
    """Combine earlier steps such that the remaining error is smallest."""

    def __init__(self) -> None:
        self._points, self._steps = list[Array](), list[Array]()

    def next(self, m: Array, step: Array, spans: Array) -> Array:
        """Choose the next point after m, whose step is known; errors count in spans."""
        self._points, self._steps = [*self._points, m][-DEPTH:], [*self._steps, step][-DEPTH:]
        if not self._points[1:]:
            return m + step
        moved, changed = np.diff(self._points, axis=0), np.diff(self._steps, axis=0)
        columns = (changed / spans).reshape(len(changed), -1).T
        shares = np.linalg.lstsq(columns, (step / spans).ravel(), rcond=COUNTS)[0]
        return np.asarray(m + step - np.tensordot(shares, moved + changed, axes=1))


def _results(task: _Task, best: _Pass, filters: _Filters, clip: bool) -> dict[str, Inverse]:
    """Cut off the lead and tail at rest, and describe the drive of each axis."""
    ahead = filters.Q.ahead
    for still in (*STILL, 0.0):
        away = np.abs((best.u - task.rest) @ task.static.T) > still * task.whole
        moves = np.flatnonzero(away.any(axis=1))
        first = max(min(ahead, int(moves[0]) - 1 if moves.size else ahead), 0)
        used = slice(first, ahead + len(task.y))
        predicted = task.motion(best.u[used])
        if np.all(np.abs(filters.x[used] - best.error[used] - predicted) < RESTS * task.spans):
            break
    near = maximum_filter1d(best.missed[used].any(axis=1), 2 * filters.Q.reach + 1)
    drive = _Drive(best.u[used], filters.x[used], predicted, ahead - first, near, best.passes)
    late = _level_warnings(task, drive.u)
    return {axis: _of_axis(task, j, drive, late, clip) for j, axis in enumerate(task.axes)}


class _Drive(NamedTuple):
    """Voltages about v0, wanted and predicted motions, lead, samples near missed ones, passes."""

    u: Array
    wanted: Array
    predicted: Array
    lead: int
    near: Mask
    passes: int


def _of_axis(task: _Task, j: int, drive: _Drive, late: list[str], clip: bool) -> Inverse:
    """Describe the drive of an axis; raise DataError if the limits do not reach its motion."""
    axis, y, span = task.axes[j], task.y[:, j], float(task.spans[j])
    model, v = task.models[axis], drive.u[:, j] + task.modes.v0[j]
    error = drive.wanted[:, j] - drive.predicted[:, j]
    clipped, warnings = drive.near & (np.abs(error) > task.small[j]), list(late)
    if clipped.any():
        most = float(np.abs(error[clipped]).max())
        low, high = (ends[j] + task.modes.v0[j] for ends in (task.low, task.high))
        speed = '' if np.isinf(task.step) else f' and at {task.step:g} V/s'
        warnings.append(
            f'{np.count_nonzero(clipped)} samples of the wanted motion of {axis} are out of reach '
            f'within {low:g} .. {high:g} V{speed}: by up to {1e6 * most:.3g} um'
        )
        if not clip and most > task.tolerances[j]:
            raise DataError(warnings[-1], options='--clip')
    expected, reached = expect(model, v, y), error[~drive.near]
    left = float(np.sqrt(np.mean(reached**2))) / span if reached.size else 0.0
    if left > max(MATTERS, 0.0 if expected.rms is None else expected.rms / span):
        warnings.append(
            f'the drive misses {100 * left:.2g} % of the wanted motion of {axis} within all '
            'limits: the motion is faster than the stage, or jumps'
        )
    return Inverse(
        model=task.model.axes[axis],
        t=(np.arange(v.size) - drive.lead) / task.model.sample_rate,
        v=v,
        wanted=drive.wanted[:, j],
        predicted=drive.predicted[:, j],
        lead=drive.lead,
        clipped=clipped,
        passes=drive.passes,
        error=percent_of_stroke(y, drive.predicted[drive.lead :, j], span),
        expected=None if expected.rms is None else percent(expected.rms, span),
        expected_rms=expected.rms,
        expected_offset=None,
        warnings=(*warnings, *extrapolated(model, v, y), *expected.warnings),
    )


def _level_warnings(task: _Task, u: Array) -> list[str]:
    """Warn of larger motion than in the fit, because its softening is unknown."""
    if not task.modes.levels:
        return []
    high, level = task.modes.range[1], np.sqrt(task.modes.run(u).level)
    beyond = float(np.mean(level > high))
    if beyond <= RARE:
        return []
    return [
        f'for {beyond:.0%} of the time the motion is larger than in the fit: its level is up to '
        f'{level.max():.2g}, and the modes hold up to {high:.2g}'
    ]

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Turn the references of several axes into their voltages, block by block.

Each axis has a `Tracker` for its motion by its own voltage.  The goal of this motion is the wanted
motion less what the paths from the other axes add.  The motion of the other axes is the wanted one
at first, then the goal of the round before, as in `piezo_ident.invert`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.control.live_inverse import PREVIEW
from piezo_ident.effects import find_effect
from piezo_ident.live.axes.run import check_axes
from piezo_ident.live.guard import GuardSettings
from piezo_ident.live.tracker import Drive, Successor, Tracker
from piezo_ident.model.multi_axis import models_of, MOTION, motion_of, MultiAxisModel
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.chain import Block

#: rounds over the paths: each leaves a share of the error that is the size of a path, 0.5 .. 3 %
ROUNDS = 3


class AxesTracker:
    """
    Follows the references of several axes with a model; all arrays have a row for each axis.

    Parameters
    ----------
    model : MultiAxisModel
    axes : sequence of str
        Order of the rows, by the names of the displacements.
    settings : GuardSettings
        Limits and slew of each axis, at the rate of the model.
    preview : int, optional
        Samples by which the stage follows the references later.

    Raises
    ------
    DataError, ModelError
        When an axis has no inverse within these limits; see `LiveInverse`.
    """

    follow, follower = 'off', None

    def __init__(
        self,
        model: MultiAxisModel,
        axes: Sequence[str],
        settings: GuardSettings,
        preview: int = PREVIEW,
    ) -> None:
        self.settings, self.preview = settings, preview
        self._paths = [_Paths(model, axes) for _ in range(ROUNDS)]
        self._each = [Tracker(model.own(axis), settings, preview) for axis in axes]
        rest = np.array([[one.inverse.position] for one in self._each])
        for one, shift in zip(self._each, self._paths[0].process(rest)[:, 0], strict=True):
            one.rest_shift = float(shift)
        self.reset()

    def reset(self) -> None:
        """Begin at rest, with the clock of the voltages at zero."""
        for one in self._each:
            one.reset()
        for paths in self._paths:
            paths.reset()

    @property
    def rest(self) -> list[float]:
        """Displacements at rest [m]."""
        return [one.last_reference for one in self._each]

    @property
    def passes(self) -> int:
        """Largest number of passes of the inverses."""
        return max(one.inverse.passes for one in self._each)

    @property
    def expected(self) -> float:
        """Largest error that the finite preview leaves [% of stroke]."""
        return max(one.inverse.error for one in self._each)

    @property
    def tick(self) -> int:
        """Samples sent so far."""
        return self._each[0].tick

    @property
    def is_at_rest(self) -> bool:
        """Whether the voltage of rest was sent last on every axis."""
        return all(one.is_at_rest for one in self._each)

    def process(self, references: Array, restarted: bool = False) -> Drive:
        """Make the voltages for the next samples of the references; see `Tracker.process`."""
        wanted = np.stack(
            [one.joined(row, restarted) for one, row in zip(self._each, references, strict=True)]
        )
        goals = wanted
        for paths in self._paths:
            goals = wanted - paths.process(goals)
        drives = [one.drive(*x) for one, *x in zip(self._each, wanted, goals, strict=True)]
        v, now = (np.stack([getattr(drive, x) for drive in drives]) for x in ('v', 'wanted'))
        return Drive(drives[0].t, v, now, sum(drive.clipped for drive in drives))

    def finish(self) -> Drive:
        """Make the voltages for the rest of the references, whose last samples are repeated."""
        last = np.array([[one.last_reference] for one in self._each])
        return self.process(np.repeat(last, self.preview, axis=1))

    def idle(self, n: int, longest: float = np.inf) -> tuple[Array, Array]:
        """Send n samples of a ramp to rest on every axis; return time and voltages."""
        ramps = [one.idle(n, longest) for one in self._each]
        return ramps[0][0], np.stack([v for _, v in ramps])

    def hurry(self) -> None:
        """Begin the ramps to rest anew, so that `idle` can shorten them."""
        for one in self._each:
            one.hurry()


#: a model with its tracker, or with what takes over from the tracker at work
Prepared: TypeAlias = tuple[StageModel | MultiAxisModel, Tracker | AxesTracker | Successor]


def prepared(
    model: StageModel | MultiAxisModel,
    axes: Sequence[str],
    settings: GuardSettings,
    preview: int,
    follow: str,
    now: Tracker | AxesTracker | None,
) -> Prepared:
    """
    Prepare another model for the axes of a node; any thread may call this.

    Parameters
    ----------
    model : StageModel or MultiAxisModel
    axes, settings, preview, follow
        As for `AxesTracker` and `Tracker`.
    now : Tracker, AxesTracker or None
        The tracker at work.

    Returns
    -------
    model : StageModel or MultiAxisModel
    tracker : Tracker, AxesTracker or Successor
        A successor of `now` if it tracks one axis with the same settings.

    Raises
    ------
    ModelError
        When the model has other axes.
    """
    check_axes(model, axes)
    if len(axes) > 1 and isinstance(model, MultiAxisModel):
        return model, AxesTracker(model, axes, settings, preview)
    (one,) = models_of(model).values()
    if isinstance(now, Tracker) and (now.settings, now.follow) == (settings, follow):
        return one, now.successor(one, now.past())
    return one, Tracker(one, settings, preview, follow)


class _Paths:
    """What each axis feels of the motions of the others by their own voltages [m]."""

    def __init__(self, model: MultiAxisModel, axes: Sequence[str]) -> None:
        self._model, self._axes = model, tuple(axes)
        self.reset()

    def reset(self) -> None:
        """Come to rest under the next sample."""
        models = [self._model.axes[axis] for axis in self._axes]
        self._operators = [
            [
                find_effect(e.name)(x.sample_rate, e.parameters)
                for e in x.effects
                if e.channel.startswith(MOTION)
            ]
            for x in models
        ]
        self._spans = [x.scaling.Y for x in models]
        for operator in (one for row in self._operators for one in row):
            operator.reset(0.0, 0.0)

    def process(self, moved: Array) -> Array:
        """Pass the next motions [m] through the paths; shapes (k, n)."""
        channels = {motion_of(a): row for a, row in zip(self._axes, moved, strict=True)}
        still = np.zeros(moved.shape[1])
        felt = []
        for operators, span in zip(self._operators, self._spans, strict=True):
            block = Block(t=still, v=still, x=still, channels=channels)
            for operator in operators:
                block = operator.process(block)
            felt.append(span * block.x)
        return np.stack(felt)

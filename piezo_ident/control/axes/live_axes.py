# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Invert the chains of all axes block by block, and make up for the paths between the axes.

The goal of each axis is its wanted motion minus the motion that the paths from the other axes add.
The other axes move along their wanted motions in the first round, along the goals of the round
before in each later round, as in `piezo_ident.invert`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.control.live_inverse import Driven, LiveInverse
from piezo_ident.effects import find_effect
from piezo_ident.model.axis_records import MOTION, motion_of
from piezo_ident.model.multi_axis import MultiAxisModel
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.chain import Block

#: rounds over the paths: each leaves a share of the error that is the size of a path, 0.5 .. 3 %
ROUNDS = 3


class LiveChains:
    """
    Inverses of the chains of all axes; arrays have a row for each axis.

    Parameters
    ----------
    each : list of LiveInverse
        Inverse of each axis.  An inverse may be replaced.
    model : StageModel or MultiAxisModel
        The model with the paths.
    axes : sequence of str
        Order of the rows, by the names of the displacements.
    """

    def __init__(
        self, each: list[LiveInverse], model: StageModel | MultiAxisModel, axes: Sequence[str]
    ) -> None:
        self.each, self._rounds = each, list[LivePaths]()
        self._felt: LivePaths | None = None
        self._shift = np.zeros(len(each))
        if isinstance(model, MultiAxisModel):
            *self._rounds, self._felt = (LivePaths(model, axes) for _ in range(ROUNDS + 1))
            at_rest = np.array([[one.position] for one in each])
            self._shift = self._rounds[0].process(at_rest)[:, 0]

    def reset(self) -> None:
        """Come to rest."""
        for one in self.each:
            one.reset()
        for paths in (*self._rounds, self._felt):
            if paths is not None:
                paths.reset()

    @property
    def position(self) -> Array:
        """Displacements of the stage at rest [m]; after `reset`."""
        return np.array([one.position for one in self.each]) + self._shift

    @property
    def models(self) -> list[StageModel]:
        """Models that are inverted."""
        return [one.model for one in self.each]

    @property
    def passes(self) -> int:
        """Largest number of passes."""
        return max(one.passes for one in self.each)

    @property
    def error(self) -> float:
        """Largest error that the finite preview leaves [% of stroke]."""
        return max(one.error for one in self.each)

    def goals(self, wanted: Array) -> Array:
        """Subtract the motions that the paths will add from the wanted motions [m]."""
        goals = wanted
        for paths in self._rounds:
            goals = wanted - paths.process(goals)
        return goals

    def process(self, goals: Array) -> Driven:
        """Compute the voltages for the next goals [m]; see `LiveInverse.process`."""
        driven = [one.process(goal) for one, goal in zip(self.each, goals, strict=True)]
        return Driven(*(np.stack(rows) for rows in zip(*driven, strict=True)))

    def moved(self, v: Array, own: Array) -> tuple[Array, Array]:
        """
        Give the motions under the next voltages that are sent, and those added by the paths [m].

        `own` are the motions of the chains under these voltages.
        """
        return own, np.zeros(own.shape) if self._felt is None else self._felt.process(own)


class LivePaths:
    """Motion of each axis that paths add, from the motions of the others by their voltages [m]."""

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

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Run a model of one axis or of several block by block: volts in, metres out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.live.history import History
from piezo_ident.model.multi_axis import alone, models_of, MOTION, motion_of, MultiAxisModel
from piezo_ident.model.stage_model import StageModel


class AxesRun:
    """
    Run of a model, with a row of voltages and of displacements for each axis.

    A coupled axis runs twice: alone, which gives the motion that other axes feel, and with the
    motions of the others.

    Parameters
    ----------
    model : StageModel or MultiAxisModel
    axes : sequence of str
        Order of the rows, by the names of the displacements; all axes of the model.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> one = pi.SimulatedStage.load('paper').model
    >>> run = AxesRun(pi.MultiAxisModel({'y': one, 'y_b': one}), ('y', 'y_b'))
    >>> y = run.process(np.ones((2, 300)), np.arange(300) / 20e3)
    >>> y.shape, bool((y[0] == y[1]).all())
    ((2, 300), True)
    """

    def __init__(self, model: StageModel | MultiAxisModel, axes: Sequence[str]) -> None:
        whole = {axis: models_of(model)[axis] for axis in axes}
        single = alone(model)
        self._alone = {axis: single[axis].stream() for axis in axes}
        self._coupled = {
            axis: x.stream() for axis, x in whole.items() if x.effects != single[axis].effects
        }

    def recall(self, pasts: Sequence[History], period: float) -> None:
        """Come into the state after the voltages so far; `pasts` has one history a row."""
        t, rows = np.empty(0), []
        for axis, past in zip(self._alone, pasts, strict=True):
            for run in filter(None, (self._coupled.get(axis), self._alone[axis])):
                t, v = past.recall(run, run.model, period)
            rows.append(v)
        self.process(np.stack(rows), t)

    def process(self, v: Array, t: Array) -> Array:
        """Compute the displacements [m] of the next voltages [V], shapes (k, n); t is in s."""
        y = [run.process(row, t) for run, row in zip(self._alone.values(), v, strict=True)]
        if not self._coupled:
            return y[0][np.newaxis] if len(y) == 1 else np.stack(y)
        moved = {motion_of(axis): row for axis, row in zip(self._alone, y, strict=True)}
        return np.stack(
            [
                self._coupled[axis].process(v[k], t, moved) if axis in self._coupled else y[k]
                for k, axis in enumerate(self._alone)
            ]
        )


def check_axes(model: StageModel | MultiAxisModel, axes: Sequence[str]) -> None:
    """Refuse a model of other axes than those of a node with a ModelError."""
    held = models_of(model)
    if set(held) != set(axes):
        raise ModelError(
            f'the model holds for {", ".join(held)}, and this node for {", ".join(axes)}: start '
            "the node with the parameter 'axes' of the stage"
        )


def channels_of(model: StageModel | MultiAxisModel) -> list[tuple[str, str]]:
    """List the effects that need a measured channel, each with the channel."""
    several = isinstance(model, MultiAxisModel)
    return [
        (effect.name, effect.channel)
        for x in models_of(model).values()
        for effect in x.effects
        if effect.channel and not (several and effect.channel.startswith(MOTION))
    ]

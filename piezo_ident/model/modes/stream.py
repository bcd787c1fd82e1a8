# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Run modes that several axes share, block by block: volts in, metres out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.model.modes.kernels import LoopState
from piezo_ident.model.modes.shared_modes import SharedModes
from piezo_ident.model.stream import CHUNK


class ModesStream:
    """
    Run of shared modes.  The stage is at rest under the first sample.

    Parameters
    ----------
    modes : SharedModes
    side : {-1, 0, 1}, optional
        Outputs of the plays at the start.  -1 and 1 are the lower and upper end of all outputs
        that are possible at rest; 0 is a stage that comes from the middle voltage of the fit.
    """

    def __init__(self, modes: SharedModes, side: int = 0) -> None:
        self.modes, self._side = modes, side
        self._state: LoopState | None = None
        self.forget()

    def forget(self) -> None:
        """Take the outputs of the plays as unknown from now on."""
        self._low, self._high = np.full((2, self.modes.signals), [[np.inf], [-np.inf]])

    @property
    def is_swept(self) -> bool:
        """
        Whether the motion so far determines the plays.

        A sweep of a signal over twice the largest threshold of its plays determines them.
        """
        held = self.modes.mu != 0
        widest = np.max(held * self.modes.r, axis=1, initial=0.0)
        return bool((self._high - self._low >= 2 * widest)[held.any(axis=1)].all())

    def process(self, v: Array) -> Array:
        """Compute the next displacements [m] of voltages [V], shapes (n, outputs), (n, inputs)."""
        modes = self.modes
        modes.check_inputs(v)
        u, y = v - modes.v0, np.empty((len(v), len(modes.y0)))
        if self._state is None and len(u):
            self._state = self._settled(np.repeat(u[:1], modes.settling, axis=0))
        for start in range(0, len(u), CHUNK):
            run = modes.run(u[start : start + CHUNK], self._state)
            y[start : start + CHUNK] = run.y + modes.y0
            self._low = np.minimum(self._low, run.z.min(axis=0))
            self._high = np.maximum(self._high, run.z.max(axis=0))
        return y

    def _settled(self, rest: Array) -> LoopState:
        """Settle under resting voltages about `v0`, all creep at rest."""
        modes, state = self.modes, LoopState.at_zero(self.modes.loop)
        state.creep[:] = rest[0][:, None]
        run = modes.run(rest, state)
        if self._side:
            state.memory[:] = run.z[-1][:, None] + self._side * modes.r
            # other plays move the modes
            modes.run(rest, state)
        return state


class MemorySpread:
    """Largest change of a displacement by plays whose outputs at the beginning are unknown."""

    def __init__(self, modes: SharedModes) -> None:
        self._sides = [ModesStream(modes, side) for side in (-1, 1)]

    def follow(self, v: Array, y: Array) -> Array:
        """Compute that change for voltages [V] and displacements of a run [m], shapes (n, k)."""
        try:
            ends = [side.process(v) - y for side in self._sides]
        except ModelError:  # ran away
            return np.full(y.shape, np.inf)
        return np.asarray(np.max(np.abs(ends), axis=0))


class Past(Protocol):
    """Voltage of an axis so far, in `count` samples."""

    count: int

    def since(self, count: int) -> Array:
        """Return the voltage after the first `count` samples [V], as far as it is kept."""


class ModesRun:
    """
    Run of shared modes with a row of voltages and of displacements for each axis.

    Parameters
    ----------
    modes : SharedModes
    axes : sequence of str
        Order of the rows, by the names of the displacements.
    doubts : bool, optional
        Whether to follow the effect of unknown plays.

    Attributes
    ----------
    stream : ModesStream
    is_partial : bool
        Whether the run lacks older voltages, on which its plays may depend.
    felt : ndarray, shape (k, n)
        Zero: shared modes do not tell the parts of the axes apart.
    spread : ndarray, shape (k, n)
        Largest effect of unknown plays on the last displacements [m]; zero without `doubts`.
    """

    def __init__(self, modes: SharedModes, axes: Sequence[str], *, doubts: bool = False) -> None:
        self.stream, self._doubts = ModesStream(modes), doubts
        self._memory = MemorySpread(modes) if doubts else None
        self._order = np.argsort(axes)
        self._rows = np.argsort(self._order)
        self.is_partial = False
        self.felt = self.spread = np.zeros((len(axes), 0))

    def forget(self) -> None:
        """Take the outputs of the plays as unknown from now on."""
        self.stream.forget()
        self._memory = MemorySpread(self.stream.modes) if self._doubts else None

    def recall(self, pasts: Sequence[Past], period: float) -> None:
        """Run through the voltages that `pasts` still keep, one past a row."""
        v = np.stack([past.since(0) for past in pasts])
        self.is_partial = v.shape[1] < pasts[0].count
        self.process(v)

    def process(self, v: Array, t: Array | None = None) -> Array:
        """Compute the next displacements [m] of voltages [V], shapes (k, n); t is not used."""
        self.felt = self.spread = np.zeros(v.shape)
        columns = v[self._order].T
        y = self.stream.process(columns)
        if self._memory is not None:
            self.spread = self._memory.follow(columns, y).T[self._rows]
        return np.ascontiguousarray(y.T[self._rows])

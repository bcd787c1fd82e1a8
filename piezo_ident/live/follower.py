# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Correct a wanted motion by the measured error of a running stage.

A stage differs from its model by an offset, creep and a gain.  The follower removes them from the
wanted motion before the inverse of the model makes the voltage.  Each axis has a follower of its
motion by its own voltage.

Corrections change at knots, at fixed ticks of the voltage.  A knot uses the state of the observer
`LATE` before the newest voltage.  Therefore the size of blocks and the delay of the displacement
make no difference below `LATE`.  Later displacement counts from the next knot on.
"""

from __future__ import annotations

from collections import deque
import itertools
from typing import NamedTuple

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.live.corrector import Corrector, Estimated
from piezo_ident.model.initial_memory import creep_elements
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import Stream
from piezo_ident.record.blocks import Samples

#: time between two knots [s]: a usual block
KNOT = 5e-3
#: age of the state of the observer: a block and the way to the stage and back, with reserve [s]
LATE = 0.05
#: time constant with which a wanted motion takes over a correction; a step would excite the modes
#: of a stage [s] (taste)
FADE = 0.01
#: largest correction of a wanted motion, as a share of the span: a sensor may be at fault (taste)
MOST = 0.1


class _Known(NamedTuple):
    """State of the observer before a tick: offset and creep by element [m], and gain."""

    tick: int
    offset: float
    creep: Array
    gain: float


class Follower:
    """
    Corrects a wanted motion by the measured error of the stage.

    Parameters
    ----------
    model : StageModel
    gain : bool
        Whether the gain is corrected, too.
    step : float
        Largest change of the correction from one sample to the next [m].
    stream, tick : Stream, int
        A run of the model up to now, and the next tick of the voltage.
    known : bool
        Whether that run has the memory of the plays.

    Attributes
    ----------
    corrector : Corrector
    is_limited : bool
        Whether the last correction was as large as it may be.
    """

    def __init__(
        self,
        model: StageModel,
        gain: bool,
        step: float,
        stream: Stream,
        tick: int,
        known: bool,
    ) -> None:
        self.corrector, self._model, self._known = Corrector(gain=gain), model, known
        self.corrector.set_model(model)
        self._stream, self._next = stream, tick
        rate = model.sample_rate
        self._knot, self._late = (max(1, round(time * rate)) for time in (KNOT, LATE))
        self._left = np.exp(-1.0 / (rate * creep_elements(model)[1]))
        self._share = 1.0 - np.exp(-self._knot / (FADE * rate))
        # largest change of offset [m] and gain from knot to knot
        self._most = self._knot * step * np.array([1.0, 1.0 / abs(model.scaling.Y)])
        nothing = _Known(0, 0.0, np.zeros(self._left.size), 0.0)
        self._states = deque([nothing])
        # the newest knot, and offset [m] and gain at it and at the knot before
        self._at, self._values = -1, np.zeros((2, 2))
        self.is_limited = False

    def moved(self, t: Array, v: Array) -> Array:
        """Return the motion by the next voltage [V] that was sent, at the times t [s]."""
        return self._stream.process(v, t)

    def drove(self, t: Array, v: Array, moved: Array, felt: Array) -> None:
        """
        Take the voltage [V] that was sent, at the times t [s]; at least one sample.

        `moved` is the motion by this voltage, `felt` the motion by other axes [m].
        """
        y, ticks = moved + felt, self._next + np.arange(v.size)
        self._next += v.size
        cuts = [0, *(np.flatnonzero(ticks[1:] % self._knot == 0) + 1).tolist(), v.size]
        for cut in (slice(*ends) for ends in itertools.pairwise(cuts)):
            both = Samples(t[cut], y[cut]), Samples(t[cut], v[cut])
            self._note(self.corrector.predicted(*both, self._known, felt[cut]))

    def measured(self, samples: Samples) -> None:
        """Take a block of displacement; NaN and samples ahead of the voltage are ignored."""
        newest = (self._next - 0.5) / self._model.sample_rate
        usable = np.isfinite(samples.values) & (samples.t < newest)
        if usable.any():
            self._note(self.corrector.measured(samples.t[usable], samples.values[usable]))

    def _note(self, several: list[Estimated]) -> None:
        for one in several:
            tick = round(float(one.samples.t[-1]) * self._model.sample_rate) + 1
            # a block that ends between two knots depends on how the stream is cut
            if tick % self._knot == 0:
                seen = one.seen
                offset, gain = float(seen.offset[-1]), float(seen.gain[-1])
                self._states.append(_Known(tick, offset, seen.fading, gain))

    def process(self, wanted: Array, lead: int) -> Array:
        """
        Correct the next samples of a wanted motion [m]; shapes (n,).

        The first sample is wanted `lead` samples after the last voltage.
        """
        s = self._model.scaling
        ticks = self._next - 1 + lead + np.arange(wanted.size)
        knots = ticks // self._knot
        add, gains = np.empty((2, wanted.size))
        for knot in np.unique(knots).tolist():
            self._reach(knot + 1, lead)
            here = knots == knot
            part = (ticks[here] - knot * self._knot) / self._knot
            before, after = self._values[:, :, None]
            add[here], gains[here] = before + (after - before) * part
        change = (wanted - s.y0 - add) / (1.0 + gains) + s.y0 - wanted
        limit = MOST * abs(s.Y)
        self.is_limited = bool(np.abs(change).max() > limit)
        return wanted + np.clip(change, -limit, limit)

    def _reach(self, knot: int, lead: int) -> None:
        """Go on to a knot; the corrections stay while no motion is wanted."""
        if knot == self._at:
            return
        self._at, tick = knot, knot * self._knot
        while len(self._states) > 1 and self._states[1].tick <= tick - lead - self._late:
            self._states.popleft()
        known = self._states[0]
        offset = known.offset + float(known.creep @ self._left ** (tick - known.tick + 1))
        goal = np.array([offset, np.clip(known.gain, -MOST, MOST)])
        now = self._values[1]
        new = now + np.clip(self._share * (goal - now), -self._most, self._most)
        self._values = np.stack([now, new])

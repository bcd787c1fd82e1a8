# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Learn a repeated motion on a running stage: voltage, measurement and next voltage."""

from __future__ import annotations

import math

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.control.learning import Learning
from piezo_ident.live.guard import GuardSettings
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.blocks import Samples

#: wait at the first voltage before a repetition begins [s]
SETTLE = 0.05


class LiveLearning:
    """
    Repetitions of one reference.

    Parameters
    ----------
    model : StageModel
    reference : ndarray, shape (n,)
        [m]
    settings : GuardSettings
        At the rate of the model.

    Attributes
    ----------
    model : StageModel
    reference : ndarray
    voltage : ndarray, shape (m,)
        Voltage of the next repetition [V].  The guard makes the ramp from rest to its first value.
    wanted : ndarray, shape (m,)
        Wanted displacement at the same samples [m]; NaN before the motion.

    Raises
    ------
    DataError
        When the reference is out of reach.
    """

    def __init__(self, model: StageModel, reference: Array, settings: GuardSettings) -> None:
        self.model, self.reference, self._settings = model, reference, settings
        self._learning = Learning(
            model, reference, limits=(settings.low, settings.high), slew=settings.slew
        )
        self.again()

    def again(self) -> None:
        """Plan a repetition."""
        s, drive = self._settings, self._learning.drive
        way = math.ceil(2.0 * abs(drive.v[0] - s.rest) / s.ramp_step)
        self._first = way + round(SETTLE * s.sample_rate)
        self.voltage = np.append(np.full(self._first, drive.v[0]), drive.v)
        # the reference itself: the motion of the drive holds the learnt correction
        wanted = np.pad(self.reference, (drive.lead, 0), mode='edge')
        self.wanted = np.append(np.full(self._first, np.nan), wanted)
        self._measured = np.full(drive.v.size, np.nan)

    def measured(self, samples: Samples, tick: int) -> None:
        """Take a block of displacement; `tick` is the first sample of the repetition."""
        k = np.rint(samples.t * self._settings.sample_rate).astype(np.int64) - tick - self._first
        inside = (k >= 0) & (k < self._measured.size)
        self._measured[k[inside]] = samples.values[inside]

    @property
    def is_complete(self) -> bool:
        """Whether all of the repetition was measured."""
        return bool(np.isfinite(self._measured).all())

    @property
    def errors(self) -> list[float]:
        """The error of each repetition so far [% of stroke]."""
        return [r.error for r in self._learning.repetitions]

    @property
    def is_done(self) -> bool:
        """Whether the error has stopped falling."""
        return self._learning.is_done

    def take(self) -> None:
        """Learn from the measured displacement, and plan the next repetition."""
        self._learning.take(self._measured)
        self.again()

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Learn a repeated motion: correct each run by the measured error of the best run so far.

    r <- r + s F (y_wanted - y),        u = inverse model of r

F is a low-pass without phase.  F protects the stage above the lowest mode that rings, where the
model is uncertain and a correction may do harm.  The repeatable error falls from run to run; noise
stays.  Learning therefore keeps the best run, and ends when the error stops falling.  A worse run
halves the step s.  A run in which the mean alone is worse keeps the step, because creep moves the
mean from run to run.  If the error falls slowly, it lies above the corner of F, and the corner
grows until a run becomes worse.
D. A. Bristow, M. Tharayil and A. G. Alleyne, "A survey of iterative learning control", IEEE
Control Systems Magazine 26(3), 2006, doi:10.1109/MCS.2006.1636313.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
import math

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, interpolated, real_array
from piezo_ident.common.errors import DataError
from piezo_ident.control.inputs import FAR
from piezo_ident.control.inverse import Inverse, invert
from piezo_ident.control.linear_inverse import lowest_mode, smoothed
from piezo_ident.model.metrics import doubts, percent, REVERSED, runs_against
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.readings.faults import MAX_WILD
from piezo_ident.record.readings.jumps import least_step, wild_readings

#: learning goes on while a run leaves at most this share of the error
RUN_LEAVES = 0.95
#: smallest step that is tried after a worse run
SMALLEST = 0.2
#: lowest correlation of measured and predicted displacement at which they count as one stage
WITH = 0.5
#: corner of F, as shares of the lowest mode that rings and of the sampling rate
OF_MODE, OF_RATE = 0.7, 0.1
#: a run that leaves more than this share is limited by the corner, which grows by this factor
SLOW, WIDER = 0.5, 2.0


@dataclass(frozen=True, eq=False)
class Repetition:
    """
    One run of a motion.

    `measured` is the displacement under `drive` [m], shape (n,).  `error` is 100 rms(wanted -
    measured) / (max wanted - min wanted) over the samples that the limits reach.
    """

    drive: Inverse
    measured: Array
    error: float


class Learning:
    """
    A repeated motion, learned from run to run.

    Parameters
    ----------
    model : StageModel
    wanted : array_like, shape (n,)
        Displacement [m].
    limits : tuple of float, optional
        Lowest and highest voltage [V].  Default: the identified range.
    slew : float, optional
        Largest speed of the voltage [V/s].
    clip : bool, optional
        Come as near to the motion as the limits allow, instead of refusing it.  Corrections and
        errors leave out the samples out of reach.
    channels : mapping of str to array_like, shape (n,), optional
        Further signals that effects of the model depend on.
    corner : float, optional
        Corner of F [Hz].  Default: it begins below the lowest mode of the model and grows while
        the error falls slowly.

    Attributes
    ----------
    drive : Inverse
        The next voltage to play; its `wanted` is the corrected motion.
    reference : ndarray, shape (n,)
        The corrected motion without the lead [m].
    repetitions : list of Repetition
        Runs so far.

    Raises
    ------
    DataError
        When the motion is out of reach and is not to be clipped, see `piezo_ident.invert`.

    Examples
    --------
    A stage that creeps, which its model does not know:

    >>> import numpy as np
    >>> import piezo_ident as pi
    >>> stage = pi.SimulatedStage.load('effects').model
    >>> model = pi.SimulatedStage.load('paper').model
    >>> t = np.arange(4000) / model.sample_rate
    >>> learning = pi.Learning(model, 35e-6 - 20e-6 * np.cos(2 * np.pi * 20 * t))
    >>> for _ in range(3):
    ...     error = learning.take(stage.simulate(learning.drive.v))
    >>> learning.best.error < 0.1 * learning.repetitions[0].error
    True
    """

    def __init__(
        self,
        model: StageModel,
        wanted: ArrayLike,
        *,
        limits: tuple[float, float] | None = None,
        slew: float = np.inf,
        clip: bool = False,
        channels: Mapping[str, ArrayLike] | None = None,
        corner: float | None = None,
    ) -> None:
        # a correction may go beyond a limit although the motion does not
        self._invert = partial(
            invert, model, limits=limits, slew=slew, clip=True, channels=channels
        )
        self._begin(model, self._invert(wanted, clip=clip), corner)

    def _begin(self, model: StageModel, drive: Inverse, corner: float | None) -> None:
        self.drive = self._best_drive = drive
        self._wanted = self.reference = self._best_reference = drive.wanted[drive.lead :]
        reached = ~drive.clipped[drive.lead :]
        self._counts = reached if reached.any() else ~reached
        self._model_span = abs(model.scaling.Y)
        self._span = float(np.ptp(self._wanted)) or self._model_span
        self.repetitions: list[Repetition] = []
        self._shapes: list[float] = []
        self._step, self._missed = 1.0, np.zeros_like(self._wanted)
        own = min(OF_MODE * lowest_mode(model), OF_RATE * model.sample_rate)
        self.corner = own if corner is None else corner
        if not 0.0 < self.corner < math.inf:
            raise DataError(f'learning: a corner of {corner} Hz; give one above zero')
        self._rate = model.sample_rate
        self._may_widen, self._is_wider = corner is None, False

    @property
    def best(self) -> Repetition:
        """The repetition with the smallest error."""
        if not self.repetitions:
            raise DataError('learning: nothing was measured yet')
        return min(self.repetitions, key=lambda r: r.error)

    @property
    def is_done(self) -> bool:
        """Whether the error has stopped falling."""
        errors, shapes = [r.error for r in self.repetitions], self._shapes
        if len(errors) < 2 or errors[-1] <= RUN_LEAVES * min(errors[:-1]):
            return False
        harms = errors[-1] > min(errors[:-1]) / RUN_LEAVES
        # after a worse run a smaller step may help; a moving mean does not end learning
        falls = shapes[-1] <= RUN_LEAVES * min(shapes[:-1]) and shapes[-1] > 0.0
        return not (harms or falls) or self._step < SMALLEST

    def take(self, measured: ArrayLike) -> float:
        """
        Learn from the displacement measured under `drive`, and plan the next drive.

        The result is the error of the displacement [% of stroke].  A straight line bridges a few
        wild readings.

        Parameters
        ----------
        measured : array_like, shape (n,)
            Displacement [m], a sample for each of `drive.v`.

        Raises
        ------
        DataError
            When the number of samples is wrong, a sample is not finite, or the displacement is
            far off or moves unlike the model.
        """
        error = self.learn(measured)
        # another voltage of the same motion would err elsewhere
        self.drive = self._invert(self.reference, like=self._best_drive)
        return error

    def learn(self, measured: ArrayLike) -> float:
        """Correct the reference as `take` does; the drive stays."""
        drive = self.drive
        y = real_array(measured, 'learning, measured')
        if y.shape != drive.v.shape or not np.all(np.isfinite(y)):
            raise DataError(
                f'learning: {y.size} measured samples for {drive.v.size} of voltage; give one '
                'finite number each'
            )
        e = _bridged(self._wanted - y[drive.lead :], self._model_span, y[drive.lead :])
        if np.abs(e).max() > FAR * self._model_span:
            raise DataError(
                f'learning: the stage is {1e6 * np.abs(e).max():.4g} um off the wanted motion; is '
                'it measured in metres?'
            )
        for doubt in self._doubts(np.concatenate([y[: drive.lead], self._wanted - e])):
            raise DataError(f'learning: {doubt}')
        error = percent(float(np.sqrt(np.mean(e[self._counts] ** 2))), self._span)
        self.repetitions.append(Repetition(drive, y, error))
        # judge the shape, too: creep, not the correction, moves the mean from run to run
        shape, before = percent(float(np.std(e[self._counts])), self._span), self._shapes
        self._shapes = [*before, shape]
        if error <= self.best.error or shape <= min(before):
            # an error out of reach would grow from run to run
            self._missed = np.where(self._counts & ~drive.clipped[drive.lead :], e, 0.0)
            self._best_reference, self._best_drive = self.reference, drive
            self._is_wider = self._may_widen and bool(before) and shape > SLOW * min(before)
            self._is_wider &= WIDER * self.corner <= OF_RATE * self._rate
            if self._is_wider:
                # the remaining error lies above the corner
                self.corner *= WIDER
        elif self._is_wider:
            self.corner /= WIDER
            self._may_widen = self._is_wider = False
        else:
            self._step *= 0.5
        correction = smoothed(self._missed, self.corner, self._rate)
        self.reference = self._best_reference + self._step * correction
        return error

    def _doubts(self, y: Array) -> Iterator[str]:
        """Yield reasons why a displacement was not measured on this stage under the drive."""
        if not np.ptp(y) and np.ptp(self.drive.v):
            yield f'the displacement stands still at {1e6 * y[0]:.4g} um; is the sensor connected?'
        if self.repetitions:
            # a learned drive moves the model away from the stage
            return
        pieces = [(y, self.drive.predicted)]
        yield from doubts(pieces, self._model_span)
        # the displacement of another axis hardly correlates with the model
        if runs_against(pieces, self._model_span, below=WITH):
            yield REVERSED


class SharedLearning(Learning):
    """
    A repeated motion of an axis, whose drives come from an inverse of all axes.

    Parameters
    ----------
    model : StageModel
        Model of the axis, with scaling and modes.
    drive : Inverse
        First drive.  After each `learn` the caller sets the next one.
    """

    def __init__(self, model: StageModel, drive: Inverse) -> None:
        self._begin(model, drive, None)


def _bridged(e: Array, stroke: float, y: Array) -> Array:
    """Remove wild readings from an error, since the next run would play them."""
    wild = wild_readings(e, stroke, least_step(y), y)
    return e if wild.mean() > MAX_WILD else interpolated(e, wild)

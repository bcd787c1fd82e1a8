# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Drive one axis along a reference, block by block, through new references and new models.

For each block of the reference `piezo_ident.live.tracker` calls

1. `AxisDrive.joined`, which joins a new reference along a raised cosine in metres, from the
   position of the stage;
2. `AxisDrive.corrected`, which corrects the goal of the inverse by the measured error;
3. the inverse of the axis, or of all axes, which makes the voltage;
4. `AxisDrive.drive`, which limits the voltage by a guard.

A new model takes over in the state of a run from the start.  The axis then joins the reference
from the position that the new model predicts, so the voltage does not jump.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
import threading

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.control.live_inverse import LiveInverse
from piezo_ident.live.follower import Follower
from piezo_ident.live.guard import Guard, GuardSettings
from piezo_ident.live.history import History
from piezo_ident.live.join import held
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import Stream


@dataclass(frozen=True, eq=False)
class Drive:
    """
    Voltage for a block of a reference; several axes have a row each.

    Attributes
    ----------
    t, v, wanted : ndarray, shape (n,)
        Time on the clock of the voltage [s], voltage [V], and wanted displacement at this time
        [m].
    clipped : int
        Number of samples at which a limit keeps the stage from the wanted displacement.
    """

    t: Array
    v: Array
    wanted: Array
    clipped: int


@dataclass(frozen=True, eq=False)
class Successor:
    """
    A new model in the state after `count` samples of the voltage `past`, inverse and free run.

    The free run serves the follower; it is None while `follow` is ``'off'``.
    """

    inverse: LiveInverse
    count: int
    past: History
    run: Stream | None = None


def check_rate(model: StageModel, settings: GuardSettings) -> None:
    """Raise ModelError for a model whose rate is not the rate of the reference."""
    if abs(model.sample_rate / settings.sample_rate - 1.0) > 1e-6:
        raise ModelError(
            f'the reference is sampled at {settings.sample_rate:g} Hz, the model holds for '
            f'{model.sample_rate:g} Hz; identify a model at the rate of the reference'
        )


def inverse_of(model: StageModel, s: GuardSettings, preview: int) -> LiveInverse:
    """Invert the model of an axis within the limits."""
    check_rate(model, s)
    return LiveInverse(model, limits=(s.low, s.high), slew=s.slew, preview=preview, rest=s.rest)


class AxisDrive:
    """
    Drives one axis by the voltage of an inverse; parameters and errors as for `Tracker`.

    Begin with `reset`.

    Attributes
    ----------
    follower : Follower or None
        Corrects the goal by the measured error; None if `follow` is ``'off'``.
    """

    def __init__(
        self, model: StageModel, settings: GuardSettings, preview: int, follow: str
    ) -> None:
        self._model = model
        self._settings, self._preview, self._follow = settings, preview, follow
        self._lock = threading.Lock()

    def reset(self, start: float) -> None:
        """Begin at rest at a displacement [m], with the clock of the voltage at zero."""
        self._guard, self._past = Guard(self._settings), History()
        self._start = start
        self._raw = self._wanted = np.full(self._preview, start)
        self._join = _Join(start, self._step())
        self.follower = self._new_follower()

    def _new_follower(self, stream: Stream | None = None) -> Follower | None:
        if self._follow == 'off':
            return None
        before = None if stream is None else self.follower
        known = before is not None and before.corrector.knows_memory
        run, gain = stream or self._model.stream(), self._follow == 'gain'
        return Follower(self._model, gain, self._step(), run, self.tick, known)

    @property
    def last_reference(self) -> float:
        """The last sample of the reference [m]."""
        return float(self._raw[-1])

    @property
    def tick(self) -> int:
        """Samples sent so far."""
        return self._past.count

    @property
    def is_at_rest(self) -> bool:
        """Whether the voltage of rest was sent last."""
        return self._guard.is_at_rest

    def _step(self) -> float:
        """Return the largest change from one sample of a ramp to the next [m]."""
        scaling = self._model.scaling
        return self._settings.ramp_step * abs(scaling.Y / scaling.V)

    def joined(self, reference: ArrayLike, restarted: bool) -> Array:
        """Join the next samples of a reference to a wanted motion [m]."""
        raw = np.asarray(reference, dtype=np.float64)
        if raw.ndim != 1 or not raw.size:
            raise DataError(
                f'a block of a reference has the shape {raw.shape}; give a vector of at least one '
                'number'
            )
        if restarted:
            self._join = _Join(self._join.last, self._step())
        self._raw = np.append(self._raw, raw)[-self._preview :]
        return self._join.process(raw)

    def corrected(self, wanted: Array, goal: Array) -> Array:
        """Return the corrected goal of the inverse [m]; keep the wanted motion [m] for `drive`."""
        self._wanted = np.append(self._wanted, wanted)
        return goal if self.follower is None else self.follower.process(goal, self._preview + 1)

    def drive(self, v: Array, clipped: Mask) -> Drive:
        """Send the next voltage [V] of the inverse; `clipped` marks samples at a limit."""
        t, v = self.play(v)
        now, self._wanted = self._wanted[: v.size], self._wanted[v.size :]
        # an axis without a reference stays at the start, and misses no motion
        missed = int(np.count_nonzero(clipped & (now != self._start)))
        return Drive(t, v, now, missed)

    def play(self, v: Array) -> tuple[Array, Array]:
        """Send a given voltage, joined softly and limited; return its time and voltage."""
        return self._sent(self._guard.process(v).voltage)

    def idle(self, n: int, longest: float) -> tuple[Array, Array]:
        """Send n samples of a ramp to rest; return time and voltage.  See `Guard.idle`."""
        return self._sent(self._guard.idle(n, longest))

    def hurry(self) -> None:
        """Begin a ramp to rest anew, so that `idle` can shorten it."""
        self._guard = Guard(self._settings, self._guard.applied)

    def _sent(self, v: Array) -> tuple[Array, Array]:
        t = np.arange(self.tick, self.tick + v.size) / self._settings.sample_rate
        if v.size:
            with self._lock:
                self._past.add(t, v)
        return t, v

    # another model

    def successor(self, model: StageModel) -> Successor:
        """Bring a model into the state after the voltage so far; any thread may call this."""
        with self._lock:
            own, past = self._past, self._past.snapshot()
        inverse, run = inverse_of(model, self._settings, self._preview), None
        if past:
            period = 1.0 / self._settings.sample_rate
            _, v = past.recall(inverse, model, period)
            inverse.follow(v, past.count - v.size)
            if self._follow != 'off':
                run = inverse.model.stream()
                run.process(*past.recall(run, inverse.model, period)[::-1])
        return Successor(inverse, past.count, own, run)

    def remembers(self, successor: Successor) -> bool:
        """Return whether each sample of the voltage since a successor was made is still kept."""
        if successor.past is not self._past:
            # it was made in an earlier drive; every drive begins at rest
            return not self.tick
        return self._past.since(successor.count).size >= self.tick - successor.count

    def take_over(self, successor: Successor) -> None:
        """Go on with another model, from the position that it predicts."""
        inverse, run = successor.inverse, successor.run
        self._model = inverse.model
        if not self.tick:
            inverse.reset()
            self.reset(inverse.position)
            return
        if self.tick > successor.count:
            v = self._past.since(successor.count)
            inverse.follow(v, successor.count)
            if run is not None:
                t = np.arange(successor.count, self.tick) / self._settings.sample_rate
                run.process(v, t)
        self.follower = self._new_follower(run)
        # the voltage is moving, so the joined motion must move from its first sample
        self._join = _Join(inverse.position, self._step(), moves=True)
        self._wanted = self._join.process(self._raw)
        inverse.process(self._wanted)


class _Join:
    """
    Joins a reference along a raised cosine, from the position `start` of the stage [m].

    The cosine changes by at most `step` from one sample to the next [m].  If the stage already
    moves along the reference, the distance between them fades out.  From rest the reference fades
    in instead, so the sum never leaves the range of both.  `last` is the last sample [m].
    """

    def __init__(self, start: float, step: float, moves: bool = False) -> None:
        self.last = self._start = start
        # no sample of the reference is known yet
        self._command = math.nan
        self._step, self._moves = step, moves
        self._length, self._done = -1, 0
        self._distance = 0.0

    def process(self, x: Array) -> Array:
        """Join the next samples; a sample that is NaN or infinite repeats the last sample."""
        x = held(x, self._command)
        self._command = float(x[-1])
        if not math.isfinite(self._command):
            return np.full(x.size, self.last)
        if self._length < 0:
            before = 2.0 * x[0] - x[1] if self._moves and x.size > 1 else x[0]
            self._distance = self._start - float(before)
            self._length = math.ceil(2.0 * abs(self._distance) / self._step)
        if self._done < self._length:
            tau = np.minimum((self._done + np.arange(x.size)) / self._length, 1.0)
            left = 1.0 - tau + np.sin(2.0 * np.pi * tau) / (2.0 * np.pi)
            self._done += x.size
            x = x + (self._distance if self._moves else self._start - x) * left
        self.last = float(x[-1])
        return x

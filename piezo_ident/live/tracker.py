# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Turn a reference into a voltage, block by block, through new references and new models.

The tracker joins a new reference along a raised cosine in metres, from the position of the stage.
A new model takes over in the state that it would have if it had run from the start.  The tracker
then joins the reference from the position that the new model predicts, so the voltage does not
jump.  A guard limits the voltage in the end.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
import threading

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import DataError, ModelError
from piezo_ident.control.inputs import FAR
from piezo_ident.control.live_inverse import LiveInverse, PREVIEW
from piezo_ident.live.axes.join import held
from piezo_ident.live.follower import Follower
from piezo_ident.live.guard import Guard, GuardSettings
from piezo_ident.live.history import History
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import Stream
from piezo_ident.record.blocks import Samples


@dataclass(frozen=True, eq=False)
class Drive:
    """
    Voltage for a block of a reference.

    Attributes
    ----------
    t, v, wanted : ndarray, shape (n,)
        Time on the clock of the voltage [s], voltage [V], and wanted displacement then [m].
    clipped : int
        Number of samples at which a limit keeps the stage from the wanted displacement.
    """

    t: Array
    v: Array
    wanted: Array
    clipped: int


@dataclass(frozen=True, eq=False)
class Successor:
    """Inverse of a new model after `count` samples of voltage, and a free run of the model."""

    inverse: LiveInverse
    count: int
    run: Stream | None = None


class Tracker:
    """
    Follows a reference with a model.

    The stage is at rest before the first block.

    Parameters
    ----------
    model : StageModel
    settings : GuardSettings
        At the rate of the model.
    preview : int, optional
        Samples by which the stage follows the reference later.
    follow : {'off', 'offset', 'gain'}, optional
        Corrections by measured displacement: none, offset and creep from earlier motion, or these
        and the gain of the stage.

    Attributes
    ----------
    follower : Follower or None
        Corrects the wanted motion; None if `follow` is ``'off'``.

    Raises
    ------
    DataError, ModelError
        When the model has no inverse within these limits; see `LiveInverse`.

    Examples
    --------
    >>> import piezo_ident as pi
    >>> model = pi.SimulatedStage.load('paper').model
    >>> tracker = Tracker(model, GuardSettings(0, 10, 40e3, 20, 0, model.sample_rate))
    >>> drive = tracker.process(np.full(20000, 30e-6))
    >>> y = model.simulate(drive.v)
    >>> bool(np.abs(y - drive.wanted).max() < 1e-8), float((1e6 * y[-1]).round(3))
    (True, 30.0)
    """

    def __init__(
        self,
        model: StageModel,
        settings: GuardSettings,
        preview: int = PREVIEW,
        follow: str = 'off',
    ) -> None:
        self.settings, self.preview, self.follow = settings, preview, follow
        self._inverse = self._built(model)
        # what other axes move of this axis at rest [m]
        self.rest_shift = 0.0
        self._lock = threading.Lock()
        self.reset()

    def reset(self) -> None:
        """Begin at rest, with the clock of the voltage at zero."""
        self._guard, self._past = Guard(self.settings), History()
        self._inverse.reset()
        start = self._inverse.position + self.rest_shift
        self._raw = self._wanted = np.full(self.preview, start)
        self._join = _Join(start, self._step())
        self.follower = self._new_follower()

    def _new_follower(self, stream: Stream | None = None) -> Follower | None:
        if self.follow == 'off':
            return None
        before = None if stream is None else self.follower
        known = before is not None and before.corrector.knows_memory
        gain, model = self.follow == 'gain', self._inverse.model
        return Follower(model, gain, self._step(), (stream or model.stream(), self.tick), known)

    @property
    def inverse(self) -> LiveInverse:
        """The inverse of the model that is followed."""
        return self._inverse

    @property
    def passes(self) -> int:
        """Number of passes of the inverse."""
        return self._inverse.passes

    @property
    def expected(self) -> float:
        """Error that the finite preview leaves [% of stroke]."""
        return self._inverse.error

    @property
    def last_reference(self) -> float:
        """The last sample of the reference [m]."""
        return float(self._raw[-1])

    @property
    def rest(self) -> list[float]:
        """Displacement at rest, as `AxesTracker` lists those of its axes [m]; after `reset`."""
        return [self.last_reference]

    @property
    def tick(self) -> int:
        """Samples sent so far."""
        return self._past.count

    @property
    def is_at_rest(self) -> bool:
        """Whether the voltage of rest was sent last."""
        return self._guard.is_at_rest

    def _built(self, model: StageModel) -> LiveInverse:
        s = self.settings
        if abs(model.sample_rate / s.sample_rate - 1.0) > 1e-6:
            raise ModelError(
                f'the reference is sampled at {s.sample_rate:g} Hz, the model holds for '
                f'{model.sample_rate:g} Hz; identify a model at the rate of the reference'
            )
        return LiveInverse(
            model, limits=(s.low, s.high), slew=s.slew, preview=self.preview, rest=s.rest
        )

    def _step(self) -> float:
        """Return the largest change from one sample of a ramp to the next [m]."""
        scaling = self._inverse.model.scaling
        return self.settings.ramp_step * abs(scaling.Y / scaling.V)

    def process(self, reference: ArrayLike, restarted: bool = False) -> Drive:
        """
        Make the voltage for the next samples of a reference.

        A sample that is NaN or infinite repeats the last sample.

        Parameters
        ----------
        reference : array_like, shape (n,)
            [m]
        restarted : bool, optional
            Whether a new stream begins here, which has to be joined.

        Returns
        -------
        Drive
            As many samples of voltage; each belongs to the reference `preview` samples before.
        """
        wanted = self.joined(reference, restarted)
        return self.drive(wanted, self._corrected(wanted))

    def joined(self, reference: ArrayLike, restarted: bool = False) -> Array:
        """Join the next samples of a reference, as `process` does, to a wanted motion [m]."""
        raw = np.asarray(reference, dtype=np.float64)
        if raw.ndim != 1 or not raw.size:
            raise DataError('a block of a reference is a vector of at least one number')
        if restarted:
            self._join = _Join(self._join.last, self._step())
        self._raw = np.append(self._raw, raw)[-self.preview :]
        return self._join.process(raw)

    def drive(self, wanted: Array, goal: Array) -> Drive:
        """Drive the model along a goal [m], which moves the stage along the wanted motion [m]."""
        self._wanted = np.append(self._wanted, wanted)
        driven = self._inverse.process(goal)
        v = self._guard.process(driven.v).voltage
        now, self._wanted = self._wanted[: v.size], self._wanted[v.size :]
        return Drive(self._sent(v), v, now, int(np.count_nonzero(driven.clipped)))

    def _corrected(self, wanted: Array) -> Array:
        """Correct a wanted motion by the measured error of the stage."""
        if self.follower is None:
            return wanted
        return self.follower.process(wanted, self.preview + 1)

    def measured(self, samples: Samples) -> None:
        """Take a block of displacement [m], on the clock of the voltage."""
        if self.follower is not None:
            self.follower.measured(samples)

    def finish(self) -> Drive:
        """Make the voltage for the rest of the reference, whose last sample is repeated."""
        return self.process(np.full(self.preview, self.last_reference))

    def play(self, v: Array) -> tuple[Array, Array]:
        """Send a given voltage, joined softly and limited; return its time and voltage."""
        v = self._guard.process(v).voltage
        return self._sent(v), v

    def idle(self, n: int, longest: float = np.inf) -> tuple[Array, Array]:
        """Send n samples of a ramp to rest; return time and voltage.  See `Guard.idle`."""
        v = self._guard.idle(n, longest)
        return self._sent(v), v

    def hurry(self) -> None:
        """Begin a ramp to rest anew, so that `idle` can shorten it."""
        self._guard = Guard(self.settings, self._guard.applied)

    def _sent(self, v: Array) -> Array:
        t = np.arange(self.tick, self.tick + v.size) / self.settings.sample_rate
        if v.size:
            with self._lock:
                self._past.add(t, v)
            if self.follower is not None:
                self.follower.drove(t, v)
        return t

    # another model

    def successor(self, model: StageModel, past: History) -> Successor:
        """
        Bring a model into the state after the voltage so far; any thread may call this.

        Parameters
        ----------
        model : StageModel
        past : History
            A snapshot, see `past`.
        """
        inverse, run = self._built(model), None
        if past:
            period = 1.0 / self.settings.sample_rate
            _, v = past.recall(inverse, model, period)
            inverse.follow(v, past.count - v.size)
            if self.follow != 'off':
                run = inverse.model.stream()
                run.process(*past.recall(run, inverse.model, period)[::-1])
        return Successor(inverse, past.count, run)

    def past(self) -> History:
        """Return a snapshot of the voltage so far; any thread may call this."""
        with self._lock:
            return self._past.snapshot()

    def take_over(self, successor: Successor) -> None:
        """Go on with another model, from the position that it predicts."""
        self._inverse = successor.inverse
        if not self.tick:
            self.reset()
            return
        run = successor.run
        if self.tick > successor.count:
            v = self._past.since(successor.count)
            self._inverse.follow(v, successor.count)
            if run is not None:
                t = np.arange(successor.count, self.tick) / self.settings.sample_rate
                run.process(v, t)
        self.follower = self._new_follower(run)
        # the voltage is moving, so the joined motion must move from its first sample
        self._join = _Join(self._inverse.position, self._step(), moves=True)
        self._wanted = self._join.process(self._raw)
        self._inverse.process(self._wanted)


def check_unit(model: StageModel, x: Array) -> None:
    """Refuse a block of a reference that lies far beyond the stage, with a DataError."""
    s = model.scaling
    least = float(np.nanmin(np.abs(x - s.y0), initial=np.inf))
    if FAR * abs(s.Y) < least < np.inf:
        raise DataError(
            f'it wants the stage {1e6 * least:.3g} um away, which moves by '
            f'{1e6 * abs(s.Y):.3g} um; is the reference in metres?'
        )


class _Join:
    """
    Joins a reference along a raised cosine.

    Parameters
    ----------
    start : float
        Position of the stage [m].
    step : float
        Largest change by the cosine from one sample to the next [m].
    moves : bool, optional
        Whether the stage already moves along the reference.  The distance between them then fades
        out.  From rest the reference fades in instead, so the sum never leaves the range of both.

    Attributes
    ----------
    last : float
        The last sample [m].
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

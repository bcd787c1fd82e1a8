# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Learn a repeated motion on a running stage; arrays have a row for each axis.

`LiveLearning` plans a repetition, takes its measurement, and plans the next one.  `Learner` plays
the repetitions in real time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
import threading
import time

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ConfigError, PiezoIdentError
from piezo_ident.live.guard import GuardSettings
from piezo_ident.live.pacing import Pace, SLIP
from piezo_ident.live.tracker import Tracker
from piezo_ident.model.multi_axis import MultiAxisModel
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.blocks import BLOCK_SIZE, Samples
from piezo_ident.verbs.learn_motion import AxesLearning

#: wait at the first voltage before a repetition begins [s]
SETTLE = 0.05
#: longest wait for the next displacement after a repetition was sent in full [s].  The middleware
#: sends a lost block again after up to 3 s.
PATIENCE = 5.0


class LiveLearning:
    """
    Plans the repetitions of one reference [m]; DataError when the reference is out of reach.

    Attributes
    ----------
    settings : GuardSettings
        Limits for which the repetitions are planned.
    each : dict of str to Learning
        By the names of the axes.
    voltage : ndarray, shape (k, m)
        Voltage of the next repetition [V].  The guard makes the ramp from rest to its first value.
    wanted : ndarray, shape (k, m)
        Wanted displacement at the same samples [m]; NaN before the motion.
    """

    def __init__(
        self,
        model: StageModel | MultiAxisModel,
        reference: Array,
        settings: GuardSettings,
        axes: Sequence[str] = ('y',),
    ) -> None:
        self.model, self.reference, self.settings = model, reference, settings
        limits, rows = (settings.low, settings.high), dict(zip(axes, reference, strict=True))
        self._learning = AxesLearning(model, rows, limits=limits, slew=settings.slew)
        self.each = {axis: self._learning.each[axis] for axis in axes}
        self._lock = threading.Lock()
        self._plan()

    def again(self) -> LiveLearning:
        """Plan the repetition anew, when a thread that plans it is done; return itself."""
        with self._lock:
            self._plan()
        return self

    def _plan(self) -> None:
        s, drives = self.settings, [one.drive for one in self.each.values()]
        lead = max(drive.lead for drive in drives)
        v = np.stack([np.pad(x.v, (lead - x.lead, 0), mode='edge') for x in drives])
        way = math.ceil(2.0 * np.abs(v[:, 0] - s.rest).max() / s.ramp_step)
        self._first = way + round(SETTLE * s.sample_rate)
        before = (0, 0), (self._first, 0)
        self.voltage = np.pad(v, before, mode='edge')
        # the reference itself: the motion of the drive holds the learnt correction
        wanted = np.pad(self.reference, ((0, 0), (lead, 0)), mode='edge')
        self.wanted = np.pad(wanted, before, constant_values=np.nan)
        self._measured: Array = np.full(v.shape, np.nan)

    def measured(self, samples: Samples, tick: int, axis: int = 0) -> None:
        """Take a block of displacement of an axis; the repetition began at the sample `tick`."""
        k = np.rint(samples.t * self.settings.sample_rate).astype(np.int64) - tick - self._first
        inside = (k >= 0) & (k < self._measured.shape[1])
        self._measured[axis, k[inside]] = samples.values[inside]

    @property
    def is_complete(self) -> bool:
        """Whether all of the repetition was measured."""
        return bool(np.isfinite(self._measured).all())

    @property
    def errors(self) -> list[float]:
        """The error of each repetition so far, of the worst axis [% of stroke]."""
        each = [[r.error for r in one.repetitions] for one in self.each.values()]
        return [max(errors) for errors in zip(*each, strict=False)]

    @property
    def is_done(self) -> bool:
        """Whether the error has stopped falling on every axis."""
        return all(one.is_done for one in self.each.values())

    def take(self) -> None:
        """Learn from the measured displacement, and plan the next repetition."""
        with self._lock:
            try:
                self._learning.take(dict(zip(self.each, self._measured, strict=True)))
            finally:
                # the plan of the axes that have learnt has changed
                self._plan()


class Learner:
    """
    Plays at most `most` repetitions of a `LiveLearning`, each planned in a thread.

    The first thread calls `make` for the `LiveLearning`.  `play` gets a block of voltage and a
    block of wanted displacement.

    Attributes
    ----------
    learning : LiveLearning or None
        None until it is made.
    text : str
        Progress, for people.
    is_over : bool
    """

    def __init__(
        self, make: Callable[[], LiveLearning], most: int, play: Callable[[Samples, Samples], None]
    ) -> None:
        self.learning: LiveLearning | None = None
        self.text, self.is_over = 'inverts the reference', False
        self._most, self._play = most, play
        self._count, self._sent, self._tick = 0, 0, 0
        # set during a repetition
        self._pace: Pace | None = None
        self._resting = 0.0
        self._failure = ''
        self._thread = self._started(lambda: setattr(self, 'learning', make()))

    def _started(self, work: Callable[[], None]) -> threading.Thread:
        def safely() -> None:
            try:
                work()
            except PiezoIdentError as error:
                self._failure = str(error)
            # the node has to report any failure of this thread
            except Exception as error:  # noqa: BLE001
                self._failure = f'{type(error).__name__}: {error}'

        thread = threading.Thread(target=safely, name='learn', daemon=True)
        thread.start()
        return thread

    @property
    def progress(self) -> float:
        """Share of the repetitions that was played [%]."""
        return 100.0 * self._count / self._most

    def measured(self, samples: Samples, axis: int = 0) -> None:
        """Take a block of displacement of an axis."""
        if self.learning is not None and self._pace:
            self.learning.measured(samples, self._tick, axis)
            # the wait for a slow stage begins anew with each of its answers
            self._resting = time.monotonic()

    def step(self, tracker: Tracker) -> None:
        """
        Send the due samples, and learn between two repetitions.

        ConfigError when learning failed, or displacement is missing.
        """
        if self._thread.is_alive():
            return
        if self._failure or self.learning is None:
            raise ConfigError(self._failure)
        learning, now = self.learning, time.monotonic()
        if self._pace is None:
            if self._count:
                self._judge(learning)
            if not self.is_over:
                self._pace = Pace(tracker.settings.sample_rate, SLIP)
                self._sent, self._tick = 0, tracker.tick
                self._resting = 0.0
                done = ', '.join(f'{e:.3g}' for e in learning.errors[-5:])
                self.text = f'repetition {self._count + 1}' + (f' after {done} %' if done else '')
        elif self._sent < learning.voltage.shape[1]:
            self._send(tracker, learning, self._pace.due())
            self._resting = now
        elif learning.is_complete and tracker.is_at_rest:
            self._count += 1
            self._pace = None
            self._thread = self._started(learning.take)
        elif tracker.is_at_rest and now - self._resting > PATIENCE:
            raise ConfigError(
                f'the displacement of repetition {self._count + 1} did not come in full; is '
                'there a stage, and does it lose blocks or read what is no number?'
            )

    @property
    def is_played(self) -> bool:
        """Whether a repetition was sent in full, so that the stage has to go to rest."""
        learning = self.learning
        return bool(self._pace and learning and self._sent >= learning.voltage.shape[1])

    def _judge(self, learning: LiveLearning) -> None:
        errors = learning.errors
        if learning.is_done or self._count >= self._most:
            self.is_over = True
            first = len(errors) - self._count
            self.text = (
                f'{min(errors):.3g} % of stroke after {len(errors)} repetitions, '
                f'{errors[first]:.3g} % in the first'
            )

    def _send(self, tracker: Tracker, learning: LiveLearning, due: int) -> None:
        due = min(self._sent + due, learning.voltage.shape[1])
        segment = f'learn:{len(learning.errors) + 1}'
        while self._sent < due:
            cut = slice(self._sent, min(due, self._sent + 10 * BLOCK_SIZE))
            t, v = tracker.play(learning.voltage[:, cut])
            wanted = learning.wanted[:, cut]
            known = np.isfinite(wanted[0])
            goal = Samples(t[known], wanted[:, known], segment, 'reference')
            self._play(Samples(t, v, segment), goal)
            self._sent = cut.stop

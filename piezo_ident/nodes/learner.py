# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Repetitions in real time: played, measured and learned from, one after the other."""

from __future__ import annotations

from collections.abc import Callable
import threading
import time

import numpy as np
from piezo_ident.common.errors import ConfigError, PiezoIdentError
from piezo_ident.live.pacing import Pace, SLIP
from piezo_ident.live.rehearsal import Rehearsal
from piezo_ident.live.tracker import Tracker
from piezo_ident.record.blocks import BLOCK_SIZE, Samples

__all__ = ['Learner']

#: how long to wait for the last displacement of a repetition [s]
PATIENCE = 2.0


class Learner:
    """
    Plays the repetitions of a rehearsal.

    Parameters
    ----------
    make : callable
        Returns the rehearsal; called by a thread.
    most : int
        Repetitions, at most.
    play : callable
        Gets time, voltage, segment and wanted displacement of the next samples.

    Attributes
    ----------
    rehearsal : Rehearsal or None
        None until it is made.
    text : str
        How far it is.
    is_over : bool
    """

    def __init__(
        self,
        make: Callable[[], Rehearsal],
        most: int,
        play: Callable[[Samples, Samples], None],
    ) -> None:
        self.rehearsal: Rehearsal | None = None
        self.text, self.is_over = 'inverts the reference', False
        self._most, self._play = most, play
        self._count, self._sent, self._tick = 0, 0, 0
        # while a repetition is on its way
        self._pace: Pace | None = None
        self._resting = 0.0
        self._failure = ''
        self._thread = self._started(lambda: setattr(self, 'rehearsal', make()))

    def _started(self, work: Callable[[], None]) -> threading.Thread:
        def safely() -> None:
            try:
                work()
            except PiezoIdentError as error:
                self._failure = str(error)
            # what fails here must be told by the node, not end its thread silently
            except Exception as error:  # noqa: BLE001
                self._failure = f'{type(error).__name__}: {error}'

        thread = threading.Thread(target=safely, name='learn', daemon=True)
        thread.start()
        return thread

    @property
    def progress(self) -> float:
        """How much of all repetitions was played [%]."""
        return 100.0 * self._count / self._most

    def measured(self, samples: Samples) -> None:
        """Take a block of displacement."""
        if self.rehearsal is not None and self._pace:
            self.rehearsal.measured(samples, self._tick)

    def step(self, tracker: Tracker) -> None:
        """
        Send what is due.

        Raises
        ------
        ConfigError
            When nothing can be learned.
        """
        if self._thread.is_alive():
            return
        if self._failure or self.rehearsal is None:
            raise ConfigError(self._failure)
        rehearsal, now = self.rehearsal, time.monotonic()
        if self._pace is None:
            if self._count:
                self._judge(rehearsal)
            if not self.is_over:
                self._pace = Pace(tracker.settings.sample_rate, SLIP)
                self._sent, self._tick = 0, tracker.tick
                self._resting = 0.0
                done = ', '.join(f'{e:.3g}' for e in rehearsal.errors[-5:])
                self.text = f'repetition {self._count + 1}' + (f' after {done} %' if done else '')
        elif self._sent < rehearsal.voltage.size:
            self._send(tracker, rehearsal, self._pace.due())
            self._resting = now
        elif rehearsal.is_complete and tracker.is_at_rest:
            self._count += 1
            self._pace = None
            self._thread = self._started(rehearsal.take)
        elif tracker.is_at_rest and now - self._resting > PATIENCE:
            raise ConfigError(
                f'the displacement of repetition {self._count + 1} did not come in full; is '
                'there a stage, and did it lose blocks?'
            )

    @property
    def is_played(self) -> bool:
        """Whether a repetition was sent in full, and the stage is to go to rest."""
        rehearsal = self.rehearsal
        return bool(self._pace and rehearsal and self._sent >= rehearsal.voltage.size)

    def _judge(self, rehearsal: Rehearsal) -> None:
        errors = rehearsal.errors
        if rehearsal.is_done or self._count >= self._most:
            self.is_over = True
            first = len(errors) - self._count
            self.text = (
                f'{min(errors):.3g} % of stroke after {len(errors)} repetitions, '
                f'{errors[first]:.3g} % in the first'
            )

    def _send(self, tracker: Tracker, rehearsal: Rehearsal, due: int) -> None:
        due = min(self._sent + due, rehearsal.voltage.size)
        segment = f'learn:{len(rehearsal.errors) + 1}'
        while self._sent < due:
            cut = slice(self._sent, min(due, self._sent + 10 * BLOCK_SIZE))
            t, v = tracker.play(rehearsal.voltage[cut])
            wanted = rehearsal.wanted[cut]
            known = np.isfinite(wanted)
            goal = Samples(t[known], wanted[known], segment, 'reference')
            self._play(Samples(t, v, segment), goal)
            self._sent = cut.stop

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""One job at a time in a thread of its own, which gives way to others and can be cancelled."""

from __future__ import annotations

from collections.abc import Callable
import os
import threading
import time
from typing import Any

from piezo_ident.common.errors import Cancelled, PiezoIdentError

__all__ = ['Worker']

#: called as often as a job likes; raises `Cancelled` when it shall end
Tick = Callable[[str, float], None]
#: time between two reports of progress [s]
EVERY = 0.1


class Worker:
    """
    Runs jobs, one at a time.

    Parameters
    ----------
    nice : int, optional
        By how much the thread gives way; where threads have no priority of their own, nothing
        happens.
    """

    def __init__(self, nice: int = 0) -> None:
        self.nice = nice
        self._thread: threading.Thread | None = None
        self._cancel = threading.Event()

    @property
    def busy(self) -> bool:
        """Whether a job is at work."""
        return self._thread is not None and self._thread.is_alive()

    def start(
        self,
        job: Callable[[Tick], Any],
        *,
        progress: Callable[[str, float], None],
        ended: Callable[[Any, Exception | None], None],
    ) -> None:
        """
        Start a job.

        Parameters
        ----------
        job : callable
            Gets a function that it calls with the name of the step and its share done, as often
            as it can: that is where it is cancelled.
        progress : callable
            Gets the same, some times a second; called in the thread of the job.
        ended : callable
            Gets the result and None, or None and the error; called in the thread of the job.

        Raises
        ------
        PiezoIdentError
            When another job is at work.
        """
        if self.busy:
            raise PiezoIdentError('another job is at work; wait for its end or cancel it')
        self._cancel.clear()

        def work() -> None:
            self._give_way()
            said = 0.0

            def tick(step: str, share: float) -> None:
                nonlocal said
                if self._cancel.is_set():
                    raise Cancelled('cancelled')
                now = time.monotonic()
                if now - said >= EVERY:
                    said = now
                    progress(step, share)

            result: Any = None
            error: Exception | None = None
            try:
                result = job(tick)
                if self._cancel.is_set():
                    result, error = None, Cancelled('cancelled')
            # whatever a job dies of is its owner's to report; the thread has nobody else to tell
            except Exception as problem:  # noqa: BLE001
                result, error = None, problem
            ended(result, error)

        self._thread = threading.Thread(target=work, name='worker', daemon=True)
        self._thread.start()

    def _give_way(self) -> None:
        if self.nice and hasattr(os, 'setpriority'):
            try:
                # on Linux a thread has a priority of its own
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), self.nice)
            except OSError:
                pass  # gives way less, works all the same

    def cancel(self) -> None:
        """Ask the job to end; it does at its next tick."""
        self._cancel.set()

    def join(self, timeout: float) -> bool:
        """Wait for the end of the job; return whether it came within the time [s]."""
        if self._thread is not None:
            self._thread.join(timeout)
        return not self.busy

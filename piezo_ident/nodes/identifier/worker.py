# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Run one job at a time in another process, watched by a thread."""

from __future__ import annotations

from collections.abc import Callable
import threading
import time
from typing import Any

from piezo_ident.common.errors import Cancelled, PiezoIdentError
from piezo_ident.common.process import Job, Tick, WorkerProcess

#: callback at the end of a job: (result, None) or (None, error)
Ended = Callable[[Any, Exception | None], None]
#: time between two reports of progress [s]
EVERY = 0.1


class Worker:
    """
    Runs one job at a time in a process, without delaying the caller.

    Above 0 `nice` lowers the priority.  The process first calls `warm_up`, a function of a module.
    """

    def __init__(self, nice: int = 0, warm_up: Callable[[], object] | None = None) -> None:
        self._process = WorkerProcess(nice, warm_up)
        self._thread: threading.Thread | None = None
        self._cancel = threading.Event()

    @property
    def is_busy(self) -> bool:
        """Whether a job runs."""
        return self._thread is not None and self._thread.is_alive()

    def start(self, job: Job, *, progress: Tick, ended: Ended) -> None:
        """
        Start a job; see `piezo_ident.common.process.WorkerProcess.run`.

        A thread of the job calls `progress` with the step and its share done, at most every
        `EVERY`, and `ended` at the end.
        """
        if self.is_busy:
            raise PiezoIdentError('another job runs; wait for its end, or call ~/cancel')
        self._cancel.clear()
        self._thread = threading.Thread(
            target=self._run, args=(job, progress, ended), name='worker', daemon=True
        )
        self._thread.start()

    def _run(self, job: Job, progress: Tick, ended: Ended) -> None:
        last = 0.0

        def tick(step: str, share: float) -> None:
            nonlocal last
            if self._cancel.is_set():
                raise Cancelled('cancelled')
            now = time.monotonic()
            if now - last >= EVERY:
                last = now
                progress(step, share)

        try:
            result = self._process.run(job, tick)
            if self._cancel.is_set():
                raise Cancelled('cancelled')
        # the caller reports every error of the job
        except Exception as error:  # noqa: BLE001
            ended(None, error)
        else:
            ended(result, None)

    def cancel(self) -> None:
        """Cancel the job at its next tick, or else with its process; return at once."""
        self._cancel.set()

    def join(self, timeout: float) -> bool:
        """Wait for the end of the job; return whether it ended within the time [s]."""
        if self._thread is not None:
            self._thread.join(timeout)
        return not self.is_busy

    def close(self) -> None:
        """End the process, even during a job."""
        self._process.close()

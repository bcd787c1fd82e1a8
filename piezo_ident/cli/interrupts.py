# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Ctrl-C ends a command in one line, wherever it strikes, and never between two halves of an output.

An exception that a signal raises can be lost: in a destructor, or in compiled code that knows no
exceptions.  So it is also remembered, and asked for before anything is written.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import os
import signal
import threading
import time
from types import FrameType

__all__ = ['MESSAGE', 'STATUS', 'Interrupts', 'interrupts']

#: exit code, and what is said
STATUS = 130
MESSAGE = 'piezo_ident: interrupted; nothing was left half written\n'
#: a second one within this [s] is the same wish, and must not disturb the clearing up
SAME = 1.0


class Interrupts:
    """
    What becomes of SIGINT while a command runs.

    Attributes
    ----------
    met : bool
        Whether there was one.
    """

    def __init__(self) -> None:
        self._reset(is_process=False)

    def _reset(self, *, is_process: bool) -> None:
        self.met = False
        self._is_process = is_process
        self._quits = False
        self._waits = 0
        self._over = False
        self._last = -float('inf')

    @contextmanager
    def handled(self, *, is_process: bool) -> Iterator[None]:
        """
        Take the signal over, unless somebody else did or it is ignored.

        Parameters
        ----------
        is_process : bool
            Whether the process ends with the command: then the signal is ignored behind it, since
            all is written and the interpreter clears away for a moment.
        """
        self._reset(is_process=is_process)
        ours = (
            threading.current_thread() is threading.main_thread()
            and signal.getsignal(signal.SIGINT) is signal.default_int_handler
        )
        if ours:
            signal.signal(signal.SIGINT, self._strike)
        try:
            yield
        finally:
            if ours:
                after = signal.SIG_IGN if is_process else signal.default_int_handler
                signal.signal(signal.SIGINT, after)

    @contextmanager
    def quitting(self) -> Iterator[None]:
        """Have an interrupt end the process at once: while modules are imported."""
        self._quits = self._is_process
        try:
            yield
        finally:
            self._quits = False

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Have an interrupt wait until the outputs are whole; a second one does not wait."""
        self.check()
        self._waits += 1
        try:
            yield
        finally:
            self._waits -= 1
        self.check()

    def check(self) -> None:
        """
        Stop if there was an interrupt.

        Raises
        ------
        KeyboardInterrupt
        """
        if self.met:
            raise KeyboardInterrupt

    def finish(self) -> None:
        """
        Stop if there was an interrupt; later ones come too late.

        Raises
        ------
        KeyboardInterrupt
        """
        self.ignore()
        self.check()

    def ignore(self) -> None:
        """Pay no attention to interrupts any more."""
        self._over = True

    def _strike(self, number: int, frame: FrameType | None) -> None:
        if self._over:
            return
        if self._quits:
            # an exception would come out of half imported modules as anything, or not at all
            os.write(2, MESSAGE.encode())
            os._exit(STATUS)
        now = time.monotonic()
        again, self._last = now - self._last < SAME, now
        first, self.met = not self.met, True
        if again or (first and self._waits):
            return
        raise KeyboardInterrupt


#: of this process
interrupts = Interrupts()

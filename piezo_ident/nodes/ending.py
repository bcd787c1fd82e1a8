# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
End a process on SIGINT or SIGTERM, from the first line of its code on.

A Python signal handler waits for the main thread, which may be busy in a compiler.  The thread of
this module hears a signal at once, leaves the process the time `patience` to close, and ends it.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import ctypes
import math
import os
import signal
import struct
import sys
import threading
import time

#: longest time for the destructors of the middleware [s]
LAST = 2


class Ending:
    """
    The end of this process.

    A signal sets `is_wanted`; another thread then calls `on_wanted` once.  The process may take
    the time `patience` to close after a signal [s].  `unfinished` names the work that the end of
    the process would cut off; the exit code is then 1.
    """

    def __init__(self) -> None:
        self.is_wanted = threading.Event()
        self.patience = 0.0
        self.on_wanted: Callable[[], object] = _nothing
        self.unfinished = ''
        self._heard = math.inf

    @property
    def left(self) -> float:
        """Time until the end of the process [s]; before a signal, that after one."""
        now = time.monotonic()
        return max(0.0, min(self._heard, now) + self.patience - now)

    def listen(self) -> None:
        """Take over the two signals; only the main thread may call this."""
        if signal.getsignal(signal.SIGINT) is _nothing:
            return
        heard, told = os.pipe()
        os.set_blocking(told, False)
        # the handler in C writes to it at once
        signal.set_wakeup_fd(told, warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, _nothing)
        threading.Thread(target=self._watch, args=(heard,), name='signals', daemon=True).start()

    def _watch(self, heard: int) -> None:
        os.read(heard, 1)
        self._heard = time.monotonic()
        self.is_wanted.set()
        self.on_wanted()
        while self.left:
            # the patience may change meanwhile
            time.sleep(min(self.left, 0.05))
        if self.unfinished:
            sys.stderr.write(f'piezo_ident: error: ended before {self.unfinished}\n')
        self.leave(1 if self.unfinished else 0)

    @staticmethod
    def leave_within_last(code: int) -> None:
        """End the process after `LAST`, even if a call keeps the interpreter until then."""
        # Fast DDS 2.14 now and then spins in the destructor of a participant while another one
        # leaves: https://github.com/eProsima/Fast-DDS/issues/6513
        libc, timer = ctypes.CDLL(None), ctypes.c_void_p()
        if hasattr(libc, 'timer_create'):
            # struct sigevent: a thread (SIGEV_THREAD is 2) calls _exit with the code
            exit_of_c = ctypes.cast(libc._exit, ctypes.c_void_p).value
            event = struct.pack('PiiP40x', code, 0, 2, exit_of_c)
            libc.timer_create(time.CLOCK_MONOTONIC, event, ctypes.byref(timer))
            libc.timer_settime(timer, 0, struct.pack('4l', 0, 0, LAST, 0), None)

    @staticmethod
    def leave(code: int) -> None:
        """End the process without a shutdown of its interpreter, in which a signal kills it."""
        for stream in (sys.stdout, sys.stderr):
            # the stream may be closed, or its disk full
            with contextlib.suppress(AttributeError, OSError, ValueError):
                stream.flush()
        os._exit(code)


def _nothing(*_: object) -> None:
    """Do nothing."""


#: the only instance, as a process has one set of signal handlers
ENDING = Ending()

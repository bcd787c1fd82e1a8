# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
A process for long work: one job at a time, with progress, that can be cancelled and may die.

A thread that computes would share the interpreter lock with the thread that captures samples.
"""

from __future__ import annotations

from collections.abc import Callable
import contextlib
import copyreg
import multiprocessing
from multiprocessing.connection import Connection
import os
from pathlib import Path
import pickle
import queue
import signal
import threading
import time
from types import MappingProxyType
from typing import Any
import weakref

from piezo_ident.common.errors import Cancelled, PiezoIdentError

#: called with the name of a step and its share done; raises to cancel
Tick = Callable[[str, float], None]
Job = Callable[[Tick], Any]

#: time between two ticks, and time in which a cancelled job may end by itself [s]
EVERY, GRACE = 0.02, 0.8
#: time that a killed process may take to be gone [s]
LAST = 0.3


def _view(mapping: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(mapping)


# the class itself is pickled under a name that does not exist
copyreg.pickle(MappingProxyType, lambda x: (_view, (dict(x),)))


def _send(channel: Connection, value: Any) -> None:
    # samples go beside the pickle: the interpreter lock is free while they are written
    buffers: list[pickle.PickleBuffer] = []
    text = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    channel.send(len(buffers))
    channel.send_bytes(text)
    for buffer in buffers:
        channel.send_bytes(buffer.raw())


def _receive(channel: Connection) -> Any:
    count = channel.recv()
    text, *buffers = [channel.recv_bytes() for _ in range(count + 1)]
    return pickle.loads(text, buffers=buffers)


def _end(process: Any, channel: Connection) -> None:
    process.kill()
    # a process that gives way to all others waits for a processor even to die
    process.join(LAST)
    channel.close()


class WorkerProcess:
    """
    A process that does one job at a time and is started again when it has died.

    The process ends with its parent, however the parent ends.  `nice` is its priority below other
    processes, `warm_up` a function of a module that it calls first.
    """

    def __init__(self, nice: int = 0, warm_up: Callable[[], object] | None = None) -> None:
        self._options = nice, warm_up
        self._closed = False
        self._start()

    def _start(self) -> None:
        # a fork would copy locks that other threads hold
        context = multiprocessing.get_context('spawn')
        self._channel, theirs = context.Pipe()
        # no daemon: its jobs may need processes of their own
        self._process = context.Process(target=_serve, args=(theirs, *self._options))
        # Ctrl-C at a terminal reaches the process too, before it can say that it ignores it
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            self._process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        theirs.close()
        self._finish = weakref.finalize(self, _end, self._process, self._channel)

    @property
    def pid(self) -> int | None:
        """Number of the process."""
        return self._process.pid

    def close(self) -> None:
        """End the process, whatever it is doing."""
        self._closed = True
        self._finish()

    def _restart(self) -> None:
        self._finish()
        if not self._closed:
            self._start()

    def run(self, job: Job, tick: Tick = lambda step, share: None) -> Any:
        """
        Do a job in the process and return its result, or raise what the job raises.

        The job, a function of a module or a partial of one, and its result are picklable.  `tick`
        is called here with the latest step and share, many times a second; when it raises, the job
        is cancelled.  PiezoIdentError when the process dies.

        >>> import functools, operator
        >>> worker = WorkerProcess()
        >>> worker.run(functools.partial(operator.is_not, None))
        True
        >>> worker.close()
        """
        try:
            _send(self._channel, job)
        except (EOFError, OSError):
            # it died since the last job
            self._restart()
            _send(self._channel, job)
        step, share = 'preparing', 0.0
        while True:
            try:
                message = _receive(self._channel) if self._channel.poll(EVERY) else None
            except (EOFError, OSError):
                raise self._death() from None
            if message is not None:
                kind, value = message
                if kind == 'result':
                    return value
                if kind == 'error':
                    raise value
                step, share = value
            try:
                tick(step, share)
            except BaseException:
                self._cancel()
                raise

    def _death(self) -> PiezoIdentError:
        self._process.join(GRACE)
        code = self._process.exitcode
        self._restart()
        if self._closed:
            return Cancelled('cancelled')
        how = f'signal {-code}' if code is not None and code < 0 else f'exit code {code}'
        return PiezoIdentError(
            f'the process of this work ended by itself ({how}); is there enough memory?'
        )

    def _cancel(self) -> None:
        """Let the job end at its next tick; if it does not, end its process."""
        end = time.monotonic() + GRACE
        with contextlib.suppress(EOFError, OSError):
            _send(self._channel, None)
            while self._channel.poll(max(0.0, end - time.monotonic())):
                if _receive(self._channel)[0] != 'progress':
                    return
        self._restart()


def _serve(channel: Connection, nice: int, warm_up: Callable[[], object] | None) -> None:
    # Ctrl-C at a terminal reaches all processes; the parent decides
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
    jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
    cancelled = threading.Event()

    def listen() -> None:
        try:
            while True:
                job = _receive(channel)
                if job is None:
                    cancelled.set()
                else:
                    cancelled.clear()
                    jobs.put(job)
        # the parent has gone
        except BaseException:  # noqa: BLE001
            os._exit(0)

    _give_way(nice)
    threading.Thread(target=listen, daemon=True).start()
    if warm_up is not None:
        with contextlib.suppress(Exception):
            warm_up()
    with contextlib.suppress(EOFError, OSError):
        while True:
            _do(jobs.get(), channel, cancelled)


def _give_way(nice: int) -> None:
    if not nice:
        return
    with contextlib.suppress(OSError):
        os.nice(nice)
    if hasattr(os, 'SCHED_IDLE'):
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    with contextlib.suppress(OSError):
        # Linux shares the time among sessions before it looks at their processes
        os.setsid()
        Path('/proc/self/autogroup').write_text(f'{nice}', encoding='ascii')


def _do(job: Job, channel: Connection, cancelled: threading.Event) -> None:
    last = float('-inf')

    def tick(step: str, share: float) -> None:
        nonlocal last
        if cancelled.is_set():
            raise Cancelled('cancelled')
        now = time.monotonic()
        if now - last >= EVERY:
            last = now
            _send(channel, ('progress', (step, share)))

    try:
        message: tuple[str, Any] = ('result', job(tick))
    # the parent reports the errors of a job
    except Exception as error:  # noqa: BLE001
        message = ('error', error)
    try:
        _send(channel, message)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        name = type(message[1]).__name__
        _send(channel, ('error', PiezoIdentError(f'a {name} cannot be sent: {error}')))

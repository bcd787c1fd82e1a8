# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""
A process of its own for long work, so that it stands in nobody's way.

A thread that computes shares the interpreter's lock with the thread that captures, and where it
gives way to all others it may be put to sleep while it holds that lock.  A process does neither;
it can also be ended whatever it is doing.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
import contextlib
import functools
import io
import os
from pathlib import Path
import pickle
import queue
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from types import MappingProxyType
from typing import Any

import piezo_ident
from piezo_ident.common.errors import Cancelled, PiezoIdentError

__all__ = ['Helper', 'serve']

#: called as often as a job likes; raises `Cancelled` when it shall end
Tick = Callable[[str, float], None]
Job = Callable[[Tick], Any]

#: time between two reports of the process, and between two looks at it [s]
EVERY = 0.02
#: how long a job may go on after it was cancelled, before its process is ended [s]
GRACE = 0.8
#: of a large array so many bytes go at once, and then others have their turn for so long [s]
CHUNK, TURN = 1 << 20, 2e-3


class _GoneError(Exception):
    """The other end of a channel is not there any more."""


class _Pickler(pickle.Pickler):
    """Knows what pickle does not, and leaves the memory of arrays to `buffer_callback`."""

    def reducer_override(self, obj: Any) -> Any:
        if type(obj) is array:
            return _array, (obj.typecode, pickle.PickleBuffer(obj))
        if type(obj) is MappingProxyType:
            return _view, (dict(obj),)
        return NotImplemented


def _array(typecode: str, memory: memoryview) -> array[Any]:
    found = array(typecode)
    found.frombytes(memory)
    return found


def _view(mapping: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(mapping)


class _Channel:
    """
    Objects through a pair of pipes.

    Large arrays go beside the pickle: the interpreter is locked for none of their way.
    """

    def __init__(self, reading: int, writing: int) -> None:
        self._reading = io.FileIO(reading, 'r')
        self._writing = io.FileIO(writing, 'w')

    def send(self, *message: Any) -> None:
        """Send an object."""
        buffers: list[pickle.PickleBuffer] = []
        text = io.BytesIO()
        _Pickler(text, protocol=5, buffer_callback=buffers.append).dump(message)
        parts = [text.getbuffer(), *(b.raw() for b in buffers)]
        sizes = [part.nbytes for part in parts]
        head = struct.pack(f'<{len(sizes) + 1}Q', len(sizes), *sizes)
        for part in (memoryview(head), *parts):
            self._write(part)

    def receive(self) -> tuple[Any, ...]:
        """Wait for the next object."""
        (count,) = struct.unpack('<Q', self._read(8))
        text, *buffers = [
            self._read(n) for n in struct.unpack(f'<{count}Q', self._read(8 * count))
        ]
        # what was frozen stays so
        return tuple(pickle.loads(text, buffers=[b.toreadonly() for b in buffers]))

    def has_more(self, timeout: float) -> bool:
        """Return whether something comes within a time [s]; also where that is the end."""
        return bool(select.select([self._reading], [], [], timeout)[0])

    def _write(self, part: memoryview) -> None:
        while part.nbytes:
            try:
                part = part[self._writing.write(part[:CHUNK]) :]
            except BrokenPipeError:
                raise _GoneError from None
            if part.nbytes:
                # minutes of samples in one go would take a whole core from who must be in time
                time.sleep(TURN)

    def _read(self, size: int) -> memoryview:
        memory, done = memoryview(bytearray(size)), 0
        while done < size:
            n = self._reading.readinto(memory[done:])
            if not n:
                raise _GoneError
            done += n
        return memory


class _Child:
    """A process, and the way to it."""

    def __init__(self, nice: int, warm_up: Callable[[], object] | None) -> None:
        down, back = os.pipe(), os.pipe()
        # the same package as here, however it was found; not what lies in the working directory
        home = str(Path(piezo_ident.__file__).parents[1])
        code = (
            f'import sys; sys.path[0] = {home!r}; '
            f'from piezo_ident.nodes.helper import serve; serve({down[0]}, {back[1]})'
        )
        self.process = subprocess.Popen(
            [sys.executable, '-c', code],
            stdin=subprocess.DEVNULL,
            pass_fds=(down[0], back[1]),
        )
        os.close(down[0])
        os.close(back[1])
        self.channel = _Channel(back[0], down[1])
        with contextlib.suppress(_GoneError):
            self.channel.send(nice, warm_up)

    def end(self) -> int:
        """End the process and return its exit code."""
        self.process.kill()
        return self.process.wait()


class Helper:
    """
    A process that does one job at a time; it is there from the beginning, and again when it died.

    It ends with the process that made it, whatever ends that.

    Parameters
    ----------
    nice : int, optional
        By how much it gives way to all other processes.
    warm_up : callable, optional
        What it does first of all, in the background: a function of a module.
    """

    def __init__(self, nice: int = 0, warm_up: Callable[[], object] | None = None) -> None:
        self._new = functools.partial(_Child, nice, warm_up)
        self._child = self._new()
        self._closed = False

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._child.process.pid

    def close(self) -> None:
        """End the process, whatever it is doing."""
        self._closed = True
        self._child.end()

    def job(self, job: Job) -> Job:
        """Return a job that has another one done by the process; see `run`."""
        return functools.partial(self.run, job)

    def run(self, job: Job, tick: Tick) -> Any:
        """
        Have a job done, and return its result.

        Parameters
        ----------
        job : callable
            Picklable, as its result must be: a function of a module, or a partial of one.
        tick : callable
            Called here with the latest step and share, some fifty times a second whatever the
            job does; when it raises, the job is cancelled.

        Raises
        ------
        PiezoIdentError
            When the process dies over it.
        Exception
            Whatever the job, or `tick`, raises.
        """
        try:
            return self._follow(job, tick)
        except _GoneError:
            code = self._child.end()
            how = f'signal {-code}' if code < 0 else f'exit code {code}'
            raise PiezoIdentError(
                f'the process at work ended by itself ({how}); is there enough memory?'
            ) from None

    def _follow(self, job: Job, tick: Tick) -> Any:
        if self._child.process.poll() is not None and not self._closed:
            self._child = self._new()
        channel = self._child.channel
        channel.send(job)
        step, share = 'preparing', 0.0
        while True:
            if channel.has_more(EVERY):
                news, *found = channel.receive()
                if news == 'error':
                    raise found[0]
                if news == 'result':
                    return found[0]
                step, share = found
            try:
                tick(step, share)
            except BaseException:
                self._cancel(channel)
                raise

    def _cancel(self, channel: _Channel) -> None:
        """Let the job end where it likes to, and if it does not, with its process."""
        give_up = time.monotonic() + GRACE
        with contextlib.suppress(_GoneError):
            channel.send(None)
            while (left := give_up - time.monotonic()) > 0.0:
                if channel.has_more(left) and channel.receive()[0] != 'tick':
                    return
        self._child.end()
        if not self._closed:
            self._child = self._new()


def serve(reading: int, writing: int) -> None:
    """
    Do what a `Helper` asks for, until it is gone.

    Parameters
    ----------
    reading, writing : int
        File descriptors of the two pipes.
    """
    # Ctrl-C at a terminal is meant for the parent, which then ends this process
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = _Channel(reading, writing)
    jobs: queue.SimpleQueue[Job] = queue.SimpleQueue()
    cancelled = threading.Event()

    def listen() -> None:
        try:
            while True:
                (job,) = channel.receive()
                if job is None:
                    cancelled.set()
                else:
                    cancelled.clear()
                    jobs.put(job)
        # without a parent, or with one that cannot be understood, there is nothing to do
        except BaseException:  # noqa: BLE001
            os._exit(0)

    nice, warm_up = channel.receive()
    _give_way(nice)
    threading.Thread(target=listen, daemon=True).start()
    if warm_up is not None:
        # it only saves time
        with contextlib.suppress(Exception):
            warm_up()
    with contextlib.suppress(_GoneError):
        while True:
            _do(jobs.get(), channel, cancelled)


def _give_way(nice: int) -> None:
    # gives way less where it may not; works all the same
    with contextlib.suppress(OSError):
        os.nice(nice)
    if nice and hasattr(os, 'SCHED_IDLE'):
        # who wakes up takes the core at once, and a core that only idles along counts as free
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    with contextlib.suppress(OSError):
        # Linux shares the time among sessions before it looks at the processes in them
        os.setsid()
        Path('/proc/self/autogroup').write_text(f'{nice}', encoding='ascii')


def _do(job: Job, channel: _Channel, cancelled: threading.Event) -> None:
    said = float('-inf')

    def tick(step: str, share: float) -> None:
        nonlocal said
        if cancelled.is_set():
            raise Cancelled('cancelled')
        now = time.monotonic()
        if now - said >= EVERY:
            said = now
            channel.send('tick', step, share)

    message: tuple[str, Any]
    try:
        message = ('result', job(tick))
    # whatever a job dies of is for the parent to report
    except Exception as error:  # noqa: BLE001
        message = ('error', error)
    try:
        channel.send(*message)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        name = type(message[1]).__name__
        channel.send('error', PiezoIdentError(f'a {name} cannot be handed over: {error}'))

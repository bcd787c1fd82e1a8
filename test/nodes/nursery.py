# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
A process that has imported the numerics of nodes, and of which node processes are copies.

Their import and the loading of kernels take one to three seconds of processor time, and the tests
start hundreds of nodes.  A copy has a session, a log and an environment of its own, and runs the
same function.  A watcher, its parent, tells how it ended.  ROS is imported by each copy: its
libraries start threads, of which a copy would have none.

Each process dies with the one above it, so the tests leave none behind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import contextlib
import ctypes
import importlib
import json
import os
from pathlib import Path
import select
import signal
import socket
import subprocess
import sys

#: bytes of a number of a process or of an exit code
NUMBER = 8
MODULES = (
    'cli.main',
    'control.learning',
    'control.live_inverse',
    'diagnosis.diagnose',
    'identification.identify',
    'live.live_learning',
    'live.predictor',
    'record.bags.read',
    'record.bags.recover',
    'record.bags.write',
    'report.folder',
    'verbs.learn',
)
#: largest request: a command and an environment
REQUEST = 1 << 17


def can_copy() -> bool:
    """Return whether there are copies here: elsewhere nodes are started as anywhere."""
    return sys.platform == 'linux'


def die_with_parent() -> None:
    """End with the thread that started this process: only the main one may, outliving all."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)


class Copy:
    """A node process that is a copy: what `subprocess.Popen` offers of it."""

    def __init__(self, told: int) -> None:
        self.returncode: int | None = None
        self._told = told
        self.pid = self._next()

    def _next(self) -> int:
        text = os.read(self._told, NUMBER)
        if len(text) < NUMBER:
            raise RuntimeError('the nursery of the nodes has died')
        return int.from_bytes(text, 'little', signed=True)

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end and return its exit code, as `Popen.wait` does."""
        if self.returncode is None:
            if not select.select([self._told], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(f'node {self.pid}', timeout or 0.0)
            self.returncode = self._next()
            os.close(self._told)
        return self.returncode

    def poll(self) -> int | None:
        """Return its exit code, or None while it runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self.wait(0.0)
        return None

    def send_signal(self, number: int) -> None:
        """Send it a signal if it runs."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)


class Nursery:
    """The process of which nodes are copies, started when the first one is wanted."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def copy(self, command: Sequence[str], log: int, environment: Mapping[str, str]) -> Copy:
        """Start a copy that runs the function of a node: ``[python, '-c', code, *arguments]``."""
        if self._process is None:
            self._start(environment)
        heard, told = os.pipe()
        request = json.dumps([command[2:], dict(environment)]).encode()
        socket.send_fds(self._channel, [request], [log, told])
        os.close(told)
        return Copy(heard)

    def _start(self, environment: Mapping[str, str]) -> None:
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        code = f'from nursery import serve; serve({theirs.fileno()})'
        path = os.pathsep.join([str(Path(__file__).parent), environment['PYTHONPATH']])
        self._process = subprocess.Popen(
            [sys.executable, '-c', code],
            stdin=subprocess.DEVNULL,
            env={**environment, 'PYTHONPATH': path},
            pass_fds=[theirs.fileno()],
            start_new_session=True,
            preexec_fn=die_with_parent,
        )
        theirs.close()


def serve(channel: int) -> None:
    """Import, and start copies until the tests are over."""
    for name in MODULES:
        importlib.import_module(f'piezo_ident.{name}')
    from piezo_ident.live.predictor import warm_up
    from piezo_ident.report.figures import style

    warm_up()
    # what renders pictures has tests of its own
    style.png = lambda *_: bytes(33)
    # a copy has the thread that asks for it alone
    assert len(list(Path('/proc/self/task').iterdir())) == 1
    sys.path.remove(str(Path(__file__).parent))
    with socket.socket(fileno=channel) as asked:
        while True:
            request, (*files,), _, _ = socket.recv_fds(asked, REQUEST, 2)
            if not request:
                return
            with contextlib.suppress(ChildProcessError):
                while os.waitpid(-1, os.WNOHANG)[0]:
                    pass
            if not os.fork():
                asked.detach()
                _watch(*json.loads(request), channel, *files)
                return
            for file in files:
                os.close(file)


def _watch(
    command: list[str], environment: dict[str, str], channel: int, log: int, told: int
) -> None:
    die_with_parent()
    node = os.fork()
    if node:
        os.write(told, node.to_bytes(NUMBER, 'little', signed=True))
        code = os.waitstatus_to_exitcode(os.waitpid(node, 0)[1])
        os.write(told, code.to_bytes(NUMBER, 'little', signed=True))
        os._exit(0)
    die_with_parent()
    os.setsid()
    for stream in (1, 2):
        os.dup2(log, stream)
    for file in (channel, log, told):
        os.close(file)
    os.environ.clear()
    os.environ.update(environment)
    code, *arguments = command
    sys.argv = ['-c', *arguments]
    exec(code, {'__name__': '__main__'})

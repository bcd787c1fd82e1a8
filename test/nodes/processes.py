# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Node processes for tests: how they are started and ended, and what they may leave behind."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
import contextlib
import fcntl
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import tempfile
from typing import Any, IO

from nursery import can_copy, Copy, die_with_parent, Nursery

#: what has not happened within this time will not happen [s]; the machine may be busy
LIMIT = 60.0
#: the same for work that computes, as an identification or pictures: a share of a busy machine
WORK = 180.0
#: domains whose ports are clear of the system's own
DOMAINS = range(1, 100)
NURSERY = Nursery()


def set_middleware() -> None:
    """Keep all nodes to this machine, and have them meet and part quickly."""
    # this range adds shared memory, and FASTDDS_BUILTIN_TRANSPORTS has no say in it
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    profile = Path(__file__).with_name('prompt_discovery.xml')
    os.environ.setdefault('FASTRTPS_DEFAULT_PROFILES_FILE', str(profile))


def in_time(took: float, limit: float, what: str) -> None:
    """See that something took no longer than promised [s], and print how long it took."""
    print(f'{what}: {took:.3f} s of {limit:g} s')
    assert took < limit, f'{what}: {took:.3f} s, promised are {limit:g} s'


@contextlib.contextmanager
def crowd() -> Iterator[None]:
    """Make the machine three times slower: two programs on each processor that do nothing else."""
    idlers = [
        subprocess.Popen(
            [sys.executable, '-S', '-c', 'while True: pass'],
            preexec_fn=die_with_parent if can_copy() else None,
        )
        for _ in range(2 * (os.cpu_count() or 1))
    ]
    try:
        yield
    finally:
        for idler in idlers:
            idler.kill()
            idler.wait()


def listens(pid: int) -> bool:
    """Return whether a process takes SIGTERM itself."""
    fields = re.search(r'^SigCgt:\t(\w+)', Path(f'/proc/{pid}/status').read_text(), re.M)
    return bool(fields and int(fields[1], 16) >> (signal.SIGTERM - 1) & 1)


def alive(pid: int) -> bool:
    """Return whether a process is there and is no zombie."""
    try:
        return Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0] != 'Z'
    except OSError:
        return False


def take_domain() -> tuple[int, IO[str]]:
    """Return a domain that no other graph on this machine uses, and the lock that holds it."""
    for k in range(len(DOMAINS)):
        domain = DOMAINS[(os.getpid() + k) % len(DOMAINS)]
        lock = (Path(tempfile.gettempdir()) / f'piezo_ident_domain_{domain}.lock').open('a')
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        _clear_ports(domain)
        return domain, lock
    raise RuntimeError('all ROS domains are in use')


def _clear_ports(domain: int) -> None:
    """Remove what a node that was killed left locked: the next one on its port would hang."""
    first = 7400 + 250 * domain
    for path in Path('/dev/shm').glob('*fastrtps_port*'):
        if int(re.sub(r'\D', '', path.name)) in range(first, first + 250):
            path.unlink(missing_ok=True)


def _shared_memory(pid: int) -> list[Path]:
    """Return the shared memory of the middleware that a process owns, and would leave behind."""
    held = []
    with contextlib.suppress(OSError):
        held = [os.readlink(fd) for fd in Path(f'/proc/{pid}/fd').iterdir()]
    locks = [h for h in held if re.fullmatch(r'/dev/shm/fastrtps_[0-9a-f]{16}_el', h)]
    return [Path(name) for lock in locks for name in (lock, lock.removesuffix('_el'))]


class Handle:
    """A node process that a `Graph` started, as a copy or from its first line on."""

    def __init__(
        self,
        graph: Any,
        name: str,
        command: Sequence[str],
        log: Path,
        env: Mapping[str, str] | None = None,
        *,
        is_copy: bool = False,
    ) -> None:
        self.graph = graph
        self.name = name
        self.command = command
        self.env = env
        self.is_copy = is_copy
        #: whether its end is the test's doing
        self.is_ended = False
        self._log = log
        self._said = len(graph.statuses(name))
        environment = {**graph.environment, **(env or {})}
        self.process: Copy | subprocess.Popen[bytes]
        with log.open('wb') as out:
            if is_copy:
                self.process = NURSERY.copy(command, out.fileno(), environment)
            else:
                self.process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=subprocess.STDOUT,
                    env=environment,
                    start_new_session=True,
                    preexec_fn=die_with_parent if can_copy() else None,
                )

    @property
    def log(self) -> str:
        """What it wrote on its two outputs."""
        return self._log.read_text(encoding='utf-8', errors='replace')

    @property
    def complaints(self) -> str:
        """What it wrote beside the lines of its log that are no errors."""
        lines = self.log.splitlines()
        return '\n'.join(x for x in lines if not x.startswith(('[INFO]', '[WARN]')))

    @property
    def has_spoken(self) -> bool:
        """Whether its first status was heard."""
        return len(self.graph.statuses(self.name)) > self._said

    def status(self) -> dict[str, str]:
        """Return its latest status."""
        return self.graph.status(self.name)

    def send(self, number: int) -> None:
        """Send it a signal and do not wait."""
        self.is_ended |= number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
        self.process.send_signal(number)

    def stop(self, number: int = signal.SIGINT) -> int:
        """Send it a signal, wait for its end, and return the exit code."""
        if self.process.poll() is None:
            self.send(number)
        return self.process.wait(LIMIT)

    def children(self) -> set[int]:
        """Return the processes that it has started."""
        tasks = Path(f'/proc/{self.process.pid}/task')
        texts = [(task / 'children').read_text() for task in tasks.iterdir()]
        return {int(pid) for text in texts for pid in text.split()}

    def die(self) -> None:
        """End it outright, and nothing but it."""
        self.is_ended = True
        left = _shared_memory(self.process.pid)
        self.process.send_signal(signal.SIGKILL)
        self.process.wait(LIMIT)
        for path in left:
            path.unlink(missing_ok=True)

    def kill(self) -> None:
        """End it outright, with all that it started."""
        self.is_ended = True
        left = _shared_memory(self.process.pid)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(LIMIT)
        for path in left:
            path.unlink(missing_ok=True)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Starts the nodes as processes of their own, watches them, and takes all of them down.

For machines without ``ros2 launch``.  The children end with their starter, whatever ends it: even
when it is killed outright, the kernel sends them SIGTERM.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import ctypes
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from types import TracebackType
from typing import Any

from piezo_ident.common.errors import PiezoIdentError
import yaml

__all__ = ['Nodes', 'rclpy_is_there']

_PR_SET_PDEATHSIG = 1
#: nobody on another machine finds the graph, or gets at its drive, unless the user asks for that
HERE_ONLY = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
#: how long a node may take to end after each signal [s]
PATIENCE = 3.0


def _die_with_parent() -> None:
    # between fork and exec: the starter may end without a chance to clean up
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


def _command(executable: str) -> list[str]:
    """Return how to start a node: the installed script, or this interpreter without one."""
    beside = Path(sys.executable).with_name(executable)
    if beside.is_file():
        return [str(beside)]
    for prefix in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep):
        script = Path(prefix, 'lib', 'piezo_ident', executable)
        if prefix and script.is_file():
            return [str(script)]
    code = f'import sys; from piezo_ident.nodes.{executable} import main; sys.exit(main())'
    return [sys.executable, '-c', code]


class Nodes:
    """
    A set of node processes; use it in a ``with`` statement.

    Parameters
    ----------
    log : path
        Folder for what each node writes.
    environment : mapping of str to str, optional
        On top of this process's own, which discovery alone does not come from: it is kept to this
        machine where neither says otherwise.
    """

    def __init__(self, log: Path, environment: Mapping[str, str] | None = None) -> None:
        self.log = log
        self.environment = {**HERE_ONLY, **os.environ, **(environment or {})}
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(
        self,
        executable: str,
        *,
        namespace: str = '',
        parameters: Mapping[str, Any] | None = None,
        remaps: Mapping[str, str] | None = None,
        arguments: Sequence[str] = (),
    ) -> subprocess.Popen[bytes]:
        """
        Start a node.

        Parameters
        ----------
        executable : str
            ``stage``, ``model``, ...
        namespace : str, optional
        parameters : mapping, optional
        remaps : mapping of str to str, optional
        arguments : sequence of str, optional
            What stands before ``--ros-args``: the names for ``composed``.

        Raises
        ------
        PiezoIdentError
            When it is running already.
        """
        name = f'{namespace}/{executable}'.lstrip('/')
        if name in self.processes:
            raise PiezoIdentError(f'{name} is running already')
        self.log.mkdir(parents=True, exist_ok=True)
        command = [*_command(executable), *arguments, '--ros-args']
        if namespace:
            command += ['-r', f'__ns:=/{namespace.strip("/")}']
        for source, target in (remaps or {}).items():
            command += ['-r', f'{source}:={target}']
        for key, value in (parameters or {}).items():
            # as YAML, so that a text stays a text and a list a list
            text = yaml.safe_dump(value, default_flow_style=True, width=10**9).strip()
            command += ['-p', f'{key}:={text.removesuffix("...").strip()}']
        with (self.log / f'{name.replace("/", "_")}.log').open('wb') as log:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env=self.environment,
                start_new_session=True,
                preexec_fn=_die_with_parent if sys.platform == 'linux' else None,
            )
        self.processes[name] = process
        return process

    def check(self) -> None:
        """
        See that all nodes are running.

        Raises
        ------
        PiezoIdentError
            When one has ended, with the last line that it wrote.
        """
        for name, process in self.processes.items():
            code = process.poll()
            if code is not None:
                log = self.log / f'{name.replace("/", "_")}.log'
                lines = log.read_text(encoding='utf-8', errors='replace').strip().splitlines()
                last = lines[-1] if lines else 'nothing'
                raise PiezoIdentError(
                    f'node {name} ended with code {code}; it last wrote: {last} (all in {log})'
                )

    def stop(self) -> dict[str, int | None]:
        """End all nodes, the last started first, and return their exit codes."""
        running = dict(reversed(self.processes.items()))
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            alive = [p for p in running.values() if p.poll() is None]
            for process in alive:
                process.send_signal(number)
            deadline = time.monotonic() + PATIENCE
            for process in alive:
                try:
                    process.wait(max(0.0, deadline - time.monotonic()))
                except subprocess.TimeoutExpired:
                    continue
        codes = {name: process.returncode for name, process in running.items()}
        self.processes.clear()
        return codes

    def __enter__(self) -> Nodes:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.stop()


def rclpy_is_there() -> bool:
    """Return whether nodes can run here."""
    from importlib.util import find_spec

    return find_spec('rclpy') is not None

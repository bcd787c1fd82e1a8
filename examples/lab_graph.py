# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Start the nodes as processes and talk to them, on a machine without ``ros2 launch``.

    with Nodes(Path('log')) as nodes, Client() as client:
        client.follow('identifier')
        for name in ('stage', 'excitation', 'identifier', 'model'):
            nodes.start(name)
        client.call('identifier/run')
        client.wait(lambda: client.status('identifier').get('state') == 'done', 100.0,
                    'the model', nodes.check)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import ctypes
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import threading
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.nodes.wire import LATCHED, PREVIEW, SERVICE
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String
from std_srvs.srv import Trigger
import yaml

PR_SET_PDEATHSIG = 1
#: how long a node may take to end after each signal [s]
PATIENCE = 3.0
#: a service that may be called twice is called again after this time [s]
AGAIN = 5.0
#: a graph whose nodes, which publish diagnostics once a second, are silent for so long is dead [s]
SILENCE = 120.0
#: a graph in which no status changes for so long hangs [s]
STILL = 240.0


def own_domain() -> None:
    """Keep the graph to this machine and to a random ROS domain, where the user chose neither."""
    os.environ.setdefault('ROS_DOMAIN_ID', str(random.SystemRandom().randint(1, 101)))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')


def _end_with_parent() -> None:
    # the kernel sends SIGTERM to the node when its starter is killed
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


class Nodes:
    """
    Node processes, which end with the ``with`` statement.

    Parameters
    ----------
    log : path
        Folder for the output of each node.
    """

    def __init__(self, log: Path) -> None:
        self.log = log
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Nodes:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(
        self,
        executable: str,
        *,
        namespace: str = '',
        parameters: Mapping[str, Any] | None = None,
        arguments: Sequence[str] = (),
    ) -> None:
        """Start a node; `arguments` stand before ``--ros-args``."""
        name = f'{namespace}/{executable}'.lstrip('/')
        code = f'from piezo_ident.nodes.main import start; start({executable!r})'
        command = [sys.executable, '-c', code, *arguments, '--ros-args']
        if namespace:
            command += ['-r', f'__ns:=/{namespace.strip("/")}']
        for key, value in (parameters or {}).items():
            # YAML keeps a text a text and a list a list
            text = yaml.safe_dump(value, default_flow_style=True, width=10**9).strip()
            command += ['-p', f'{key}:={text.removesuffix("...").strip()}']
        self.log.mkdir(parents=True, exist_ok=True)
        with self._log_of(name).open('wb') as log:
            self.processes[name] = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                # other machines see the graph only where the user asks for it
                env={'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', **os.environ},
                # Ctrl-C reaches the starter alone, which then ends the nodes
                start_new_session=True,
                preexec_fn=_end_with_parent if sys.platform == 'linux' else None,
            )

    def _log_of(self, name: str) -> Path:
        return self.log / f'{name.replace("/", "_")}.log'

    def check(self) -> None:
        """
        Raise an error when a node has ended.

        Raises
        ------
        PiezoIdentError
            With the last line that the node wrote.
        """
        for name, process in self.processes.items():
            if process.poll() is not None:
                log = self._log_of(name)
                lines = log.read_text(encoding='utf-8', errors='replace').split('\n')
                last = next((line for line in reversed(lines) if line.strip()), 'nothing')
                raise PiezoIdentError(
                    f'node {name} ended with code {process.returncode}; its last line: {last} '
                    f'(see {log})'
                )

    def stop(self) -> dict[str, int]:
        """End all nodes, and return their exit codes."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            running = [p for p in self.processes.values() if p.poll() is None]
            for process in running:
                process.send_signal(number)
            deadline = time.monotonic() + PATIENCE
            while any(p.poll() is None for p in running) and time.monotonic() < deadline:
                time.sleep(0.02)
        codes = {name: process.wait() for name, process in self.processes.items()}
        self.processes.clear()
        return codes


class Client:
    """
    A node that calls services, sets parameters and follows status; its thread spins it.

    Attributes
    ----------
    changed : float
        When a status changed last, or whatever else shows that the graph goes on.
    """

    def __init__(self, name: str = 'lab_client') -> None:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node(name)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}
        self._status: dict[str, dict[str, str]] = {}
        self._states: dict[str, list[str]] = {}
        self._end = threading.Event()
        self._heard = self.changed = time.monotonic()
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_life, PREVIEW)
        self._thread = threading.Thread(target=self._spin, name='client', daemon=True)
        self._thread.start()

    def _on_life(self, _: DiagnosticArray) -> None:
        self._heard = time.monotonic()

    def _spin(self) -> None:
        while not self._end.is_set() and rclpy.ok():
            try:
                self._executor.spin_once(timeout_sec=0.1)
            except ExternalShutdownException:
                return

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join(timeout=2.0)
        self._executor.shutdown(timeout_sec=0.5)
        self.node.destroy_node()
        rclpy.try_shutdown()

    def call(self, service: str, timeout: float = SILENCE) -> tuple[bool, str]:
        """
        Call a Trigger service once, and return whether it accepted, and its message.

        Raises
        ------
        PiezoIdentError
            When there is no response in time.
        """
        response = self._ask(Trigger, service, Trigger.Request(), timeout, timeout)
        return bool(response.success), str(response.message)

    def set(self, node: str, name: str, value: Any, timeout: float = SILENCE) -> tuple[bool, str]:
        """
        Set a parameter of a node, and return whether it was accepted, and why not.

        Raises
        ------
        PiezoIdentError
            When there is no response in time.
        """
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]
        )
        response = self._ask(SetParameters, f'{node}/set_parameters', request, timeout, AGAIN)
        return bool(response.results[0].successful), str(response.results[0].reason)

    def _ask(self, kind: Any, service: str, request: Any, timeout: float, again: float) -> Any:
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, service, qos_profile=SERVICE)
        client = self._clients[service]
        deadline = time.monotonic() + timeout
        answered, futures = threading.Event(), []
        if client.wait_for_service(timeout_sec=timeout):
            while not answered.is_set() and time.monotonic() < deadline:
                futures.append(client.call_async(request))
                futures[-1].add_done_callback(lambda _: answered.set())
                answered.wait(min(again, max(0.0, deadline - time.monotonic())))
        for future in futures:
            client.remove_pending_request(future)
        done = [future for future in futures if future.done()]
        if not done:
            raise PiezoIdentError(f'{service}: no response within {timeout:g} s')
        return done[0].result()

    def follow(self, *nodes: str) -> None:
        """Keep the last status of nodes."""
        for node in nodes:

            def keep(message: DiagnosticStatus, node: str = node) -> None:
                values = {pair.key: pair.value for pair in message.values}
                status = {**values, 'message': message.message}
                # counts go on although nothing does
                before, told = self._status.get(node, {}), ('state', 'progress', 'text')
                if any(status.get(key) != before.get(key) for key in told):
                    self.changed = time.monotonic()
                self._states.setdefault(node, []).append(values.get('state', ''))
                self._status[node] = status

            self.node.create_subscription(DiagnosticStatus, f'{node}/status', keep, LATCHED)

    def status(self, node: str) -> dict[str, str]:
        """Return the last status of a node: state, progress, message, ..."""
        return self._status.get(node, {})

    def states(self, node: str) -> list[str]:
        """Return all states of a node since its status was forgotten."""
        return self._states.get(node, [])

    def forget(self, node: str) -> None:
        """Forget the last status of a node, so that the next one is a new one."""
        self._status.pop(node, None)
        self._states.pop(node, None)

    def listen(self, topic: str) -> list[str]:
        """Return the list into which the messages of a latched text topic go."""
        texts: list[str] = []
        self.node.create_subscription(String, topic, lambda m: texts.append(m.data), LATCHED)
        return texts

    def wait(
        self,
        condition: Callable[[], Any],
        timeout: float,
        what: str,
        look: Callable[[], None] = lambda: None,
    ) -> None:
        """
        Wait until a condition holds, calling `look` ten times a second.

        Raises
        ------
        PiezoIdentError
            When it does not hold in time, all nodes are silent, or nothing changes any more.
        """
        begin = self._heard = self.changed = time.monotonic()
        while not condition():
            look()
            now = time.monotonic()
            if now - begin > timeout or now - self._heard > SILENCE:
                raise PiezoIdentError(f'{what}: not within {now - begin:.0f} s')
            if now - self.changed > STILL:
                states = ', '.join(f'{k} {v.get("state")}' for k, v in self._status.items())
                raise PiezoIdentError(f'{what}: nothing has changed for {STILL:g} s: {states}')
            time.sleep(0.1)

# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.


"""
A graph of real node processes for tests, and a node in this process that looks at it.

    with Graph() as g:
        stage = g.start('stage', params={'seed': 3})
        g.start('excitation')
        seen = g.collect('displacement')
        assert g.call('excitation/start')[0]
        g.wait(lambda: g.status('excitation')['state'] == 'done', timeout=60, what='programme')

Every graph has a ROS domain of its own, so several may run at once; at the end nothing is left,
whatever happened.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import contextlib
import ctypes
import fcntl
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from typing import Any, IO

import pytest
import yaml

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from piezo_ident.nodes.wire import from_message, LATCHED, PREVIEW, STREAM, to_message
from piezo_ident.wire_format import Samples
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger

__all__ = ['Graph', 'Handle']

ROOT = Path(__file__).resolve().parents[2]
#: a node must be up and have said so within this time [s]; the machine may be busy
START_LIMIT = 40.0
#: domains whose ports are clear of the system's own
DOMAINS = range(1, 100)


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def _take_domain() -> tuple[int, IO[str]]:
    """Return a domain that no other graph on this machine uses, and the lock that holds it."""
    for k in range(len(DOMAINS)):
        domain = DOMAINS[(os.getpid() + k) % len(DOMAINS)]
        lock = (Path(tempfile.gettempdir()) / f'piezo_ident_domain_{domain}.lock').open('a')
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            continue
        return domain, lock
    raise RuntimeError('all ROS domains are in use')


class Handle:
    """A node process that a `Graph` started."""

    def __init__(
        self, graph: Graph, name: str, process: subprocess.Popen[bytes], log: Path
    ) -> None:
        self.graph = graph
        self.name = name
        self.process = process
        self._log = log
        #: whether its end is the test's doing
        self.is_ended = False

    @property
    def log(self) -> str:
        """What it wrote on its two outputs."""
        return self._log.read_text(encoding='utf-8', errors='replace')

    def status(self) -> dict[str, str]:
        """Return its latest status."""
        return self.graph.status(self.name)

    def send(self, number: int) -> None:
        """Send it a signal and do not wait."""
        self.is_ended = number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
        self.process.send_signal(number)

    def stop(self, number: int = signal.SIGINT, timeout: float = 10.0) -> int:
        """Send it a signal, wait for its end, and return the exit code."""
        if self.process.poll() is None:
            self.send(number)
        return self.process.wait(timeout)

    def kill(self) -> None:
        """End it outright, with all that it started."""
        self.is_ended = True
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait(5.0)


class Graph:
    """Node processes in a ROS domain of their own, and an observer."""

    def __init__(self) -> None:
        self.handles: list[Handle] = []
        self._clients: dict[str, Any] = {}
        self._statuses: dict[str, list[dict[str, str]]] = {}
        self._diagnostics: dict[str, list[dict[str, str]]] = {}
        self._messages: dict[str, list[Float64MultiArray]] = {}
        self._samples: dict[str, list[Samples]] = {}
        self._arrivals: dict[str, list[float]] = {}
        self._texts: dict[str, list[str]] = {}
        self._publishers: dict[str, Any] = {}
        self._end = threading.Event()

    def __enter__(self) -> Graph:
        self.domain, self._lock = _take_domain()
        self.folder = Path(tempfile.mkdtemp(prefix='piezo_ident_graph_'))
        os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
        self.environment = {
            **os.environ,
            'ROS_DOMAIN_ID': str(self.domain),
            'ROS_LOG_DIR': str(self.folder / 'log'),
            'PYTHONPATH': os.pathsep.join(
                filter(None, [str(ROOT), os.environ.get('PYTHONPATH', '')])
            ),
        }
        self.context = Context()
        rclpy.init(
            context=self.context,
            domain_id=self.domain,
            signal_handler_options=SignalHandlerOptions.NO,
        )
        self.node = Node('observer', context=self.context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.node.create_subscription(
            DiagnosticArray, '/diagnostics', self._keep_diagnostics, PREVIEW
        )
        self._thread = threading.Thread(target=self._spin, name='observer', daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        try:
            for handle in self.handles:
                handle.kill()
        finally:
            self._end.set()
            self._thread.join(5.0)
            self._executor.shutdown(timeout_sec=1.0)
            self.node.destroy_node()
            rclpy.shutdown(context=self.context)
            shutil.rmtree(self.folder, ignore_errors=True)
            self._lock.close()

    def _spin(self) -> None:
        while not self._end.is_set():
            try:
                self._executor.spin_once(timeout_sec=0.1)
            except ExternalShutdownException:
                return

    # processes

    def start(
        self,
        executable: str,
        params: Mapping[str, Any] | None = None,
        namespace: str = '',
        remaps: Mapping[str, str] | None = None,
        args: Sequence[str] = (),
        *,
        wait: bool = True,
        env: Mapping[str, str] | None = None,
    ) -> Handle:
        """
        Start a node and wait for its first status.

        Parameters
        ----------
        executable : str
            'stage', 'excitation', ...
        params : mapping, optional
            Its parameters; a number for a float parameter must be a float.
        namespace : str, optional
            Without slash in front.
        remaps : mapping of str to str, optional
            Also ``{'__node': 'other'}``.
        args : sequence of str, optional
            Further arguments behind ``--ros-args``.
        wait : bool, optional
            Whether to wait until it has said something.
        env : mapping, optional
            Environment on top of the graph's.
        """
        remaps = dict(remaps or {})
        number = len(self.handles)
        command = [
            sys.executable,
            '-c',
            f'import sys; from piezo_ident.nodes.{executable} import main; sys.exit(main())',
            '--ros-args',
        ]
        if namespace:
            command += ['-r', f'__ns:=/{namespace.strip("/")}']
        for source, target in remaps.items():
            command += ['-r', f'{source}:={target}']
        if params:
            file = self.folder / f'{number}.yaml'
            file.write_text(yaml.safe_dump({'/**': {'ros__parameters': dict(params)}}))
            command += ['--params-file', str(file)]
        command += list(args)
        name = '/'.join(filter(None, [namespace.strip('/'), remaps.get('__node', executable)]))
        log = self.folder / f'{number}_{name.replace("/", "_")}.log'
        self.follow(name)
        before = len(self._statuses[name])
        with log.open('wb') as out:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=subprocess.STDOUT,
                env={**self.environment, **(env or {})},
                start_new_session=True,
                preexec_fn=_die_with_parent if sys.platform == 'linux' else None,
            )
        handle = Handle(self, name, process, log)
        self.handles.append(handle)
        if wait:
            self.wait(
                lambda: len(self._statuses[name]) > before, START_LIMIT, f'first status of {name}'
            )
        else:
            # its end may be what is tested
            handle.is_ended = True
        return handle

    # looking

    def follow(self, name: str) -> None:
        """Follow the status of a node; `start` does it by itself."""
        if name in self._statuses:
            return
        heard = self._statuses[name] = []

        def keep(message: DiagnosticStatus) -> None:
            values = {pair.key: pair.value for pair in message.values}
            level = int.from_bytes(message.level, 'little')
            heard.append({**values, 'message': message.message, 'level': str(level)})

        self.node.create_subscription(DiagnosticStatus, f'/{name}/status', keep, LATCHED)

    def _keep_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            level = int.from_bytes(status.level, 'little')
            self._diagnostics.setdefault(status.name.strip('/'), []).append(
                {**values, 'message': status.message, 'level': str(level)}
            )

    def status(self, name: str) -> dict[str, str]:
        """Return the latest status of a node: state, progress, message, level, ..."""
        self.follow(name)
        heard = self._statuses[name]
        return heard[-1] if heard else {'state': '', 'progress': '', 'message': '', 'level': ''}

    def statuses(self, name: str) -> list[dict[str, str]]:
        """Return all that was heard of a node's status."""
        return self._statuses.get(name, [])

    def diagnostics(self, name: str) -> dict[str, str]:
        """Return the latest diagnostics of a node; empty when none came yet."""
        heard = self._diagnostics.get(name, [])
        return heard[-1] if heard else {}

    def collect(self, topic: str) -> list[Samples]:
        """Return the blocks of a topic so far; subscribes on first use."""
        if topic not in self._samples:
            samples = self._samples[topic] = []
            messages = self._messages[topic] = []
            arrivals = self._arrivals[topic] = []

            def keep(message: Float64MultiArray) -> None:
                arrivals.append(time.monotonic())
                messages.append(message)
                samples.append(from_message(message))

            self.node.create_subscription(Float64MultiArray, topic, keep, STREAM)
        return self._samples[topic]

    def messages(self, topic: str) -> list[Float64MultiArray]:
        """Return the messages of a topic that is collected."""
        self.collect(topic)
        return self._messages[topic]

    def arrivals(self, topic: str) -> list[float]:
        """Return when each block of a topic that is collected came, on time.monotonic."""
        self.collect(topic)
        return self._arrivals[topic]

    def texts(self, topic: str) -> list[str]:
        """Return the latched texts of a topic (model, report) so far; subscribes on first use."""
        if topic not in self._texts:
            texts = self._texts[topic] = []
            self.node.create_subscription(String, topic, lambda m: texts.append(m.data), LATCHED)
        return self._texts[topic]

    def matched(self, topic: str, publishers: int = 1, timeout: float = 10.0) -> None:
        """Wait until this many publishers of a collected topic are known."""
        self.collect(topic)
        self.wait(
            lambda: self.node.count_publishers(topic) >= publishers, timeout, f'publishers {topic}'
        )

    def wait(
        self,
        condition: Callable[[], object],
        timeout: float = 10.0,
        what: str = 'condition',
        period: float = 0.01,
    ) -> None:
        """Wait until a condition holds; `AssertionError` with the whole state when it does not."""
        deadline = time.monotonic() + timeout
        while not condition():
            died = [h for h in self.handles if not h.is_ended and h.process.poll() is not None]
            if died:
                codes = {h.name: (h.process.returncode, h.log) for h in died}
                raise AssertionError(f'{what}: nodes ended by themselves: {codes}')
            if time.monotonic() > deadline:
                states = {name: self.status(name) for name in self._statuses}
                logs = {h.name: h.log for h in self.handles if h.log}
                raise AssertionError(f'{what}: not within {timeout} s; {states}; logs: {logs}')
            time.sleep(period)

    # acting

    def _ask(self, kind: Any, service: str, request: Any, timeout: float) -> Any:
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, f'/{service.lstrip("/")}')
        client = self._clients[service]
        self.wait(client.service_is_ready, timeout, f'service {service}')
        done = threading.Event()
        future = client.call_async(request)
        future.add_done_callback(lambda _: done.set())
        if not done.wait(timeout):
            raise AssertionError(f'{service}: no answer within {timeout} s')
        return future.result()

    def call(self, service: str, timeout: float = 10.0) -> tuple[bool, str]:
        """Call a Trigger service and return (success, message)."""
        answer = self._ask(Trigger, service, Trigger.Request(), timeout)
        return bool(answer.success), str(answer.message)

    def set(self, node: str, name: str, value: Any, timeout: float = 10.0) -> tuple[bool, str]:
        """Set a parameter of a node and return (taken, reason)."""
        request = SetParameters.Request(
            parameters=[Parameter(name, value=value).to_parameter_msg()]
        )
        result = self._ask(SetParameters, f'{node}/set_parameters', request, timeout).results[0]
        return bool(result.successful), str(result.reason)

    def get(self, node: str, name: str, timeout: float = 10.0) -> Any:
        """Return the value of a parameter of a node."""
        request = GetParameters.Request(names=[name])
        values = self._ask(GetParameters, f'{node}/get_parameters', request, timeout).values
        return parameter_value_to_python(values[0])

    def parameters(self, node: str, timeout: float = 10.0) -> dict[str, Any]:
        """Return the descriptors of all parameters of a node by their names."""
        listed = self._ask(
            ListParameters, f'{node}/list_parameters', ListParameters.Request(), timeout
        ).result.names
        request = DescribeParameters.Request(names=listed)
        answer = self._ask(DescribeParameters, f'{node}/describe_parameters', request, timeout)
        return {d.name: d for d in answer.descriptors}

    def publish(
        self, topic: str, block: Samples | Float64MultiArray, timeout: float = 10.0
    ) -> None:
        """Publish a block; before the first one, wait for a subscriber."""
        if topic not in self._publishers:
            publisher = self.node.create_publisher(Float64MultiArray, topic, STREAM)
            self._publishers[topic] = publisher
            own = int(topic in self._samples)
            self.wait(
                lambda: publisher.get_subscription_count() > own, timeout, f'listeners to {topic}'
            )
        message = to_message(block) if isinstance(block, Samples) else block
        self._publishers[topic].publish(message)

    def publish_text(self, topic: str, text: str) -> None:
        """Publish a latched text."""
        if topic not in self._publishers:
            self._publishers[topic] = self.node.create_publisher(String, topic, LATCHED)
        self._publishers[topic].publish(String(data=text))

    def unpublish(self, topic: str) -> None:
        """Take back the publisher of a topic."""
        self.node.destroy_publisher(self._publishers.pop(topic))

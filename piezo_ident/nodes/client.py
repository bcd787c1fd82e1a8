# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Looks at a running graph from outside: calls services, sets parameters, follows status."""

from __future__ import annotations

from collections.abc import Callable
import threading
import time
from types import TracebackType
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.nodes.wire import LATCHED, PREVIEW, SERVICE
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter as PythonParameter
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String
from std_srvs.srv import Trigger

__all__ = ['Client']

#: after how long without an answer what may be asked twice is asked again [s]
AGAIN = 3.0


class Client:
    """
    A node that only looks and asks; use it in a ``with`` statement.

    Its executor runs in a thread of its own, so every method may be called from the main one.
    """

    def __init__(self, name: str = 'piezo_ident_client') -> None:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node(name)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._clients: dict[str, Any] = {}
        self._status: dict[str, dict[str, str]] = {}
        self._texts: dict[str, list[str]] = {}
        self._counts: dict[str, int] = {}
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._spin, name='client', daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        while not self._end.is_set() and rclpy.ok():
            try:
                self._executor.spin_once(timeout_sec=0.1)
            except ExternalShutdownException:
                return

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._end.set()
        self._thread.join(timeout=2.0)
        self._executor.shutdown(timeout_sec=0.5)
        self.node.destroy_node()
        rclpy.try_shutdown()

    def call(self, service: str, timeout: float = 10.0) -> tuple[bool, str]:
        """
        Call a Trigger service and return its answer.

        It is asked once: a second start would be refused, or begin a replay once more.

        Raises
        ------
        PiezoIdentError
            When nobody answers in time.
        """
        response = self._ask(Trigger, service, Trigger.Request(), timeout, timeout)
        return bool(response.success), str(response.message)

    def set(self, node: str, name: str, value: Any, timeout: float = 10.0) -> tuple[bool, str]:
        """
        Set a parameter of a node and return whether it was taken, and why not.

        Raises
        ------
        PiezoIdentError
            When nobody answers in time.
        """
        parameter: Parameter = PythonParameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[parameter])
        # a value that is set twice is the same
        answer = self._ask(SetParameters, f'{node}/set_parameters', request, timeout, AGAIN)
        result = answer.results[0]
        return bool(result.successful), str(result.reason)

    def _ask(self, kind: Any, service: str, request: Any, timeout: float, again: float) -> Any:
        """Return the first answer to a question that is asked every so many seconds."""
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, service, qos_profile=SERVICE)
        client = self._clients[service]
        deadline = time.monotonic() + timeout
        if not client.wait_for_service(timeout_sec=timeout):
            raise PiezoIdentError(f'{service}: no such service within {timeout:g} s')
        done, futures = threading.Event(), []
        while True:
            futures.append(client.call_async(request))
            futures[-1].add_done_callback(lambda _: done.set())
            if done.wait(min(again, max(0.0, deadline - time.monotonic()))):
                break
            if time.monotonic() >= deadline:
                break
        answered = [f for f in futures if f.done()]
        for future in futures:
            client.remove_pending_request(future)
        if not answered:
            raise PiezoIdentError(f'{service}: no answer within {timeout:g} s')
        return answered[0].result()

    def follow(self, node: str) -> None:
        """Follow the status of a node."""

        def keep(message: DiagnosticStatus) -> None:
            values = {pair.key: pair.value for pair in message.values}
            self._status[node] = {**values, 'message': message.message}

        self.node.create_subscription(DiagnosticStatus, f'{node}/status', keep, LATCHED)

    def status(self, node: str) -> dict[str, str]:
        """Return the last status of a node that is followed: state, progress, message, ..."""
        return self._status.get(node, {})

    def forget(self, node: str) -> None:
        """Forget the last status of a node, so that the next one is a new one."""
        self._status.pop(node, None)

    def listen(self, topic: str) -> list[str]:
        """Listen to a latched text topic, and return the list that its messages go into."""
        texts = self._texts.setdefault(topic, [])
        self.node.create_subscription(String, topic, lambda m: texts.append(m.data), LATCHED)
        return texts

    def count(self, node: str) -> int:
        """Return how many samples an identifier had captured when it last told, once a second."""
        if not self._counts:
            self.node.create_subscription(DiagnosticArray, '/diagnostics', self._keep, PREVIEW)
        return self._counts.setdefault(f'/{node}', 0)

    def _keep(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name in self._counts:
                self._counts[status.name] = int(values.get('samples', 0))

    def wait(
        self,
        condition: Callable[[], bool],
        timeout: float,
        what: str,
        look: Callable[[], None] | None = None,
    ) -> None:
        """
        Wait for a condition.

        Parameters
        ----------
        condition : callable
        timeout : float
            [s]
        what : str
            What is waited for, for the message.
        look : callable, optional
            Called ten times a second; may raise.

        Raises
        ------
        PiezoIdentError
            When it does not come true in time.
        """
        deadline = time.monotonic() + timeout
        while not condition():
            if time.monotonic() > deadline:
                raise PiezoIdentError(f'{what}: not within {timeout:g} s')
            if look is not None:
                look()
            time.sleep(0.1)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Base of all nodes: parameters, status, diagnostics, services that answer at once, a clean end.

The signal handlers of rclpy shut the context down before a node can ramp its drive to rest.
`piezo_ident.nodes.ending` therefore takes the signals.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import gc
import logging
import os
from pathlib import Path
import sys
import threading
import traceback
from typing import Any

# set before numpy is loaded: more threads slow down tall, narrow factorisations
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import piezo_ident
from piezo_ident.common.errors import PiezoIdentError, printable
from piezo_ident.live.guard import GuardSettings
from piezo_ident.nodes.ending import ENDING
from piezo_ident.nodes.journal import FromPackage, parameters_text, shortened
from piezo_ident.nodes.parameter_node import begin, ParameterNode, unknown_to
from piezo_ident.nodes.parameters import NODES
from piezo_ident.nodes.wire import await_readers, LATCHED, PREVIEW, SERVICE
import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from std_srvs.srv import Trigger

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR
#: longest time for which a thread keeps the interpreter from another thread [s]
SWITCH = 2e-4
#: longest time after a signal for finishing the start of a node, and for closing it [s]
STARTING, CLOSING = 1.0, 1.8
#: most characters of a message: ``ros2 topic echo`` cuts a text at 128
LONGEST = 100
#: number of consecutive failed callbacks after which a node gives up
MOST_FAILURES = 1000


def guard_settings(values: Mapping[str, Any], sample_rate: float) -> GuardSettings:
    """Make the settings of a guard from the parameters of a node that drives."""
    v = values
    return GuardSettings(
        v['voltage_low'], v['voltage_high'], v['slew'], v['ramp_slew'], v['rest'], sample_rate
    )


class LabNode(ParameterNode):
    """
    Node of the graph.

    A subclass names its executable, offers services with `offer`, reports with `report_status`,
    overrides `diagnose`, applies parameters in `apply`, and closes in `close`.
    """

    executable: str
    #: longest time for closing [s]
    patience = CLOSING

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(self.executable, **kwargs)
        self._status_lock = threading.Lock()
        self._last_status: tuple[Any, ...] = ()
        logging.getLogger('piezo_ident').addHandler(FromPackage(self.journal))
        # a timer of the ROS clock would stand still with use_sim_time
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._status = self.create_publisher(DiagnosticStatus, '~/status', LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', PREVIEW)
        self._declare_all(NODES[self.executable])
        self.create_timer(1.0, self._publish_diagnostics)
        self.report_status('idle', 0.0, 'ready')

    def create_timer(self, *args: Any, **kwargs: Any) -> Any:
        """Create a timer on the steady clock of the machine, independent of ROS time."""
        return super().create_timer(*args, **{'clock': self._steady, **kwargs})

    def tails(self) -> list[str]:
        """Return the suffix of the topics of each axis: '' of the first axis, ``_b`` of axis b."""
        return ['', *(f'_{name}' for name in self.values['axes'] if name)]

    def report_status(
        self,
        state: str,
        progress: float,
        text: str,
        level: bytes = OK,
        *,
        brief: str = '',
        problems: str = '',
        **values: object,
    ) -> None:
        """
        Publish the latched status: a `state` in one word, its progress [%] and a text for people.

        The message fits ``ros2 topic echo``: `brief` with a number first, by default the progress
        and the text.  A lasting warning logs `problems`, by default the text.  `values` are
        further numbers.
        """
        if not brief:
            # a program may be called 3peaks
            is_number = text.partition(' ')[0].replace('.', '', 1).isdigit()
            brief = text if is_number or not progress else f'{progress:.0f} %: {text}'
        key = (state, round(progress), text, level, brief, tuple(values.items()))
        with self._status_lock:
            if key == self._last_status:
                return
            before, self._last_status = self._last_status, key
            pairs = {'state': state, 'progress': f'{progress:.0f}', **values, 'text': text}
            self._status.publish(self._diagnostic(level, shortened(brief, LONGEST), pairs))
        if before and (state != before[0] or level > before[3]):
            known = '' if text.startswith(state) else f'{state}: '
            self.journal.tell(f'{known}{text}', level)
        elif level != OK:
            self.journal.warn(problems or text, level)

    def _diagnostic(
        self, level: bytes, message: str, values: Mapping[str, object]
    ) -> DiagnosticStatus:
        return DiagnosticStatus(
            level=level,
            name=self.get_fully_qualified_name(),
            message=message,
            hardware_id=self.get_namespace(),
            values=[KeyValue(key=k, value=printable(str(v))) for k, v in values.items()],
        )

    def _publish_diagnostics(self) -> None:
        level, message, values = self.diagnose()
        if level != OK:
            self.journal.warn(message, level)
        own = (self.get_name(), self.get_namespace())
        if self.get_node_names_and_namespaces().count(own) > 1:
            name = self.get_fully_qualified_name()
            twin = f'another node is called {name} too, or was until it was killed'
            self.journal.warn(twin)
            level, message = max(level, WARN), f'{message}; {twin}'
        array = DiagnosticArray(status=[self._diagnostic(level, message, values)])
        array.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(array)

    def diagnose(self) -> tuple[bytes, str, dict[str, object]]:
        """Return level, message and values for /diagnostics, once a second."""
        return OK, 'ready', {}

    def offer(self, name: str, handler: Callable[[], str]) -> None:
        """
        Offer a Trigger service ``~/name``.

        The handler starts the work and returns the answer; a `PiezoIdentError` refuses the call.
        """

        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.message, response.success = handler(), True
                self.journal.tell(f'~/{name}: {response.message}')
            except PiezoIdentError as error:
                response.message, response.success = str(error), False
                self.journal.tell(f'~/{name} refused: {error}', WARN)
            # the client gets an answer after any failure
            except Exception as error:  # noqa: BLE001
                _report(self, error)
                response.message, response.success = f'failed: {error!r}', False
            return response

        self.create_service(Trigger, f'~/{name}', answer, qos_profile=SERVICE)

    def reason(self, error: Exception) -> str:
        """Return the text of an error that ended a thread; log an unexpected error."""
        if isinstance(error, PiezoIdentError):
            return str(error)
        _report(self, error, 'its work ends')
        return repr(error)

    def introduce(self) -> None:
        """Log the version, the parameters that differ from their defaults, and unknown ones."""
        changed = {
            name: value
            for name, value in self.values.items()
            if (tuple(value) if isinstance(value, list) else value) != self._declared[name].default
        }
        said = f'; set: {parameters_text(changed)}' if changed else ''
        self.journal.tell(f'piezo_ident {piezo_ident.__version__} is up{said}')
        for line in unknown_to(self):
            self.journal.tell(line, WARN)

    def close(self) -> None:
        """Ramp to rest, close files, stop threads; `run` calls this once, before the end."""


def _report(node: LabNode, error: Exception, then: str = 'the node goes on') -> None:
    """Log the error of a callback."""
    where = traceback.extract_tb(error.__traceback__)[-1]
    place = f'{where.name}, {Path(where.filename).name} line {where.lineno}'
    node.get_logger().error(
        f'{type(error).__name__}: {str(error)[:200]} (in {place}); {then}',
        throttle_duration_sec=1.0,
    )


def run(make: Callable[[], LabNode]) -> int:
    """
    Run a node until SIGINT or SIGTERM, and close it before the context ends.

    Returns the exit code: 0 after a clean end, 1 when something failed at the end, 2 when the node
    could not start.
    """
    # another thread, such as a reader of YAML, must not delay the executor
    sys.setswitchinterval(SWITCH)
    ENDING.listen()
    ENDING.patience = STARTING
    try:
        begin()
    except PiezoIdentError as error:
        sys.stderr.write(f'piezo_ident: error: {error}\n')
        return 2
    executor = SingleThreadedExecutor()
    ENDING.on_wanted = executor.wake
    node, code = None, 0
    try:
        node = make()
        # a garbage collection of all imported objects would stop the node for tens of blocks
        gc.freeze()
        node.introduce()
        ENDING.unfinished, ENDING.patience = f'{node.get_name()} was closed', node.patience
        executor.add_node(node)
        _spin(executor, node)
    except (PiezoIdentError, ParameterException) as error:
        sys.stderr.write(f'piezo_ident: error: {error}\n')
        code = 2
    finally:
        if node is not None:
            try:
                node.journal.tell('ends')
                node.close()
                await_readers(node._status)
            except Exception as error:  # noqa: BLE001
                _report(node, error, 'it ends all the same')
                code = code or 1
            ENDING.unfinished = ''
            ENDING.leave_within_last(code)
            executor.remove_node(node)
            node.destroy_node()
        executor.shutdown(timeout_sec=0.5)
        rclpy.try_shutdown()
    return code


def _spin(executor: SingleThreadedExecutor, node: LabNode) -> None:
    failures = 0
    while rclpy.ok() and not ENDING.is_wanted.is_set():
        try:
            executor.spin_once(timeout_sec=0.2)
            failures = 0
        except ExternalShutdownException:
            return
        # a message from outside must not end a node that drives
        except Exception as error:
            failures += 1
            if failures > MOST_FAILURES:
                # every callback fails: end the node, which ramps to rest
                raise
            _report(node, error)

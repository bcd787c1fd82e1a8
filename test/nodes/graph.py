# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
A graph of real node processes for tests, and a node in this process that looks at it.

    with Graph() as g:
        g.start_all(('stage', {'seed': 3}), ('excitation', {}))
        seen = g.collect('displacement')
        assert g.call('excitation/start')[0]
        g.wait(lambda: g.status('excitation')['state'] == 'done', 'the end of the program')

Every graph has a ROS domain of its own, so several may run at once; at the end nothing is left,
whatever happened.

Tests wait for what they want to see, with a limit that only a failure meets.  Where a time is
itself what is promised, `in_time` judges it, and the test is marked `timed`: such tests run one
after the other on an idle machine.

What is sent before its reader is known to the sender is lost, so collect before the nodes start,
or wait with `matched`: both see to it that the nodes know of all readers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import gc
import os
from pathlib import Path
import shutil
import sys
import tempfile
import threading
from typing import Any, ClassVar

import pytest
import yaml

pytest.importorskip('rclpy', reason='rclpy cannot be imported: no ROS here')

from diagnostic_msgs.msg import DiagnosticArray
from nursery import can_copy
from observer import ENDS, Observer
from processes import (
    alive,
    crowd,
    Handle,
    in_time,
    LIMIT,
    listens,
    set_middleware,
    take_domain,
)
import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

__all__ = ['ENDS', 'Graph', 'Handle', 'alive', 'crowd', 'in_time', 'listens']

ROOT = Path(__file__).resolve().parents[2]


class Graph(Observer):
    """Node processes in a ROS domain of their own, and an observer."""

    #: what lives as long as this process: the middleware ends it now and then, where the last node
    #: of a context is destroyed.  Each keeps its domain, in which nobody else is
    kept: ClassVar[list[object]] = []

    def __enter__(self) -> Graph:
        self.domain, self._lock = take_domain()
        self.folder = Path(tempfile.mkdtemp(prefix='piezo_ident_graph_'))
        set_middleware()
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
        # this service is destroyed twice with its node, which now and then ends the process
        spared = Parameter('start_type_description_service', value=False)
        self.node = Node(
            'observer',
            context=self.context,
            start_parameter_services=False,
            enable_rosout=False,
            parameter_overrides=[spared],
        )
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.node.create_subscription(
            DiagnosticArray, '/diagnostics', self._keep_diagnostics, QoSProfile(depth=1000)
        )
        # a full collection stops this process for 0.2 s, and so the streams that tests send
        gc.freeze()
        self._thread = threading.Thread(target=self._spin, name='observer', daemon=True)
        self._thread.start()
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            for handle in self.handles:
                handle.kill()
        finally:
            self._end.set()
            # a node that is destroyed while the thread spins ends the process
            self._thread.join(60.0)
            # what is frozen keeps entities of the node
            gc.unfreeze()
            self._leave()
            shutil.rmtree(self.folder, ignore_errors=True)
        if kind is None:
            assert not self._unknown, f'states that no table knows: {self._unknown}'
            # what ros2 topic echo shows of a text ends at 128 characters
            assert not self._unfit, f'too long, or the prose is not the last value: {self._unfit}'

    def _leave(self) -> None:
        """Destroy what the observer heard and said with, and keep its node."""
        node = self.node
        self._executor.shutdown(timeout_sec=1.0)
        for entity in list(node.subscriptions):
            node.destroy_subscription(entity)
        for entity in list(node.publishers):
            node.destroy_publisher(entity)
        for entity in list(node.clients):
            node.destroy_client(entity)
        self.kept.append((node, self.context, self._lock))

    def _spin(self) -> None:
        while not self._end.is_set():
            try:
                self._executor.spin_once(timeout_sec=0.1)
            except ExternalShutdownException:
                return
            # said by whoever waits for what this thread can no longer hear
            except Exception as error:  # noqa: BLE001
                self._broken = error
                return

    # processes

    def start(
        self,
        executable: str,
        params: Mapping[str, Any] | None = None,
        namespace: str = '',
        remaps: Mapping[str, str] | None = None,
        *,
        wait: bool = True,
        env: Mapping[str, str] | None = None,
    ) -> Handle:
        """
        Start a node and wait for its first status, unless its start or end may be what is tested.

        One that is waited for is a copy of a process that has imported already (see `nursery`).
        A number for a float parameter must be a float; a remap may be ``{'__node': 'other'}``.
        """
        is_copy = wait and not env and can_copy()
        handle = self._begin(executable, params, namespace, remaps, env, is_copy=is_copy)
        if wait:
            self._heard([handle])
        else:
            handle.is_ended = True
        return handle

    def refused(self, executable: str, params: Mapping[str, Any]) -> str:
        """Start a node whose parameters have to end it with exit code 2, and return its log."""
        handle = self._begin(executable, params, is_copy=can_copy())
        handle.is_ended = True
        assert handle.process.wait(LIMIT) == 2, handle.log
        return handle.log

    def _begin(
        self,
        executable: str,
        params: Mapping[str, Any] | None = None,
        namespace: str = '',
        remaps: Mapping[str, str] | None = None,
        env: Mapping[str, str] | None = None,
        *,
        is_copy: bool,
    ) -> Handle:
        remaps = dict(remaps or {})
        command = [
            sys.executable,
            '-c',
            f'from piezo_ident.nodes.main import start; start({executable!r})',
            '--ros-args',
        ]
        if namespace:
            command += ['-r', f'__ns:=/{namespace.strip("/")}']
        for source, target in remaps.items():
            command += ['-r', f'{source}:={target}']
        if params:
            file = self.folder / f'{len(self.handles)}.yaml'
            file.write_text(yaml.safe_dump({'/**': {'ros__parameters': dict(params)}}))
            command += ['--params-file', str(file)]
        name = '/'.join(filter(None, [namespace.strip('/'), remaps.get('__node', executable)]))
        self.follow(name, executable)
        handle = Handle(self, name, command, self._log_of(name), env, is_copy=is_copy)
        self.handles.append(handle)
        return handle

    def start_all(self, *nodes: tuple[Any, ...]) -> list[Handle]:
        """Start nodes at once, each a tuple of the arguments of `start`; wait for all of them."""
        handles = [self._begin(*arguments, is_copy=can_copy()) for arguments in nodes]
        self._heard(handles)
        return handles

    def restart(self, handle: Handle, meanwhile: Callable[[], None] = lambda: None) -> Handle:
        """Start a node once more, and do something again and again until it has spoken."""
        log = self._log_of(handle.name)
        new = Handle(self, handle.name, handle.command, log, handle.env, is_copy=handle.is_copy)
        self.handles.append(new)
        self._heard([new], meanwhile)
        return new

    def load(self, node: str, values: Mapping[str, Any]) -> tuple[dict[str, str], dict[str, Any]]:
        """
        Load a file of parameters as ``ros2 param load`` does: all at once, each for itself.

        Return the reasons of what was refused, and what the node holds then.
        """
        path = self.folder / 'load.yaml'
        text = yaml.safe_dump({f'/{node}': {'ros__parameters': dict(values)}}, sort_keys=False)
        path.write_text(text)
        client = AsyncParameterClient(self.node, f'/{node}')
        self.wait(client.services_are_ready, f'the parameters of {node}')
        # a server drops the answer to one of whom it does not know
        self.known_to(node)
        future = client.load_parameter_file(str(path))
        self.wait(future.done, 'the answer')
        results = zip(values, future.result().results, strict=True)
        refused = {name: result.reason for name, result in results if not result.successful}
        return refused, {name: self.get(node, name) for name in values}

    def handle(self, name: str) -> Handle:
        """Return the process of a node, the latest one where none is left."""
        found = [h for h in reversed(self.handles) if h.name == name]
        return next((h for h in found if h.process.poll() is None), found[0])

    def _log_of(self, name: str) -> Path:
        return self.folder / f'{len(self.handles)}_{name.replace("/", "_")}.log'

    def _heard(
        self, handles: Sequence[Handle], meanwhile: Callable[[], None] = lambda: None
    ) -> None:
        for handle in handles:
            handle.is_ended = False
        for handle in handles:
            self.wait(
                lambda h=handle: h.has_spoken, f'{handle.name} to speak', meanwhile=meanwhile
            )
        for handle in handles:
            self.known_to(handle.name, meanwhile)

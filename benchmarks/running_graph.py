# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The whole graph as processes, and an observer of all its streams: for bench_live and soak."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import contextlib
from pathlib import Path
import sys
import threading
import time
from typing import Any

from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.record.bags.read import opened_bag, typestore

sys.path.append(str(Path(__file__).resolve().parents[1] / 'examples'))

RATE, BLOCK = 20_000, 100
STREAMS = ('voltage', 'displacement', 'applied_voltage', 'prediction', 'residual')
NODES = ('stage', 'identifier', 'model', 'recorder', 'excitation')
#: how often arrivals are fetched and states are looked at, and how long a node may take [s]
POLL, PATIENCE = 0.02, 120.0

#: topic, receipt by the middleware [ns], number of the first sample, samples
Take = Callable[[str, int, int, int], None]


class Observer:
    """Gives every block of every stream to `take`, in a thread of its own."""

    def __init__(self, client: Any, take: Take) -> None:
        from piezo_ident.nodes.subscriptions import message_class, RawSubscriptions
        from rclpy.serialization import deserialize_message

        self.take = take
        self._kind = message_class('std_msgs/msg/Float64MultiArray')
        self._read = deserialize_message
        self._inputs = RawSubscriptions(client.node, [f'/{topic}' for topic in STREAMS])
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        looked = 0.0
        while not self._end.wait(POLL):
            for stamp, topic, raw in self._inputs.arrived():
                data = self._read(raw, self._kind).data
                self.take(topic[1:], stamp, round(data[0] * RATE), len(data) // 2)
            if time.monotonic() - looked > 0.5:
                looked = time.monotonic()
                self._inputs.look()

    @property
    def lost(self) -> int:
        """Messages that were sent to this process and did not arrive."""
        return self._inputs.lost

    def close(self) -> None:
        """Fetch no more."""
        self._end.set()
        self._thread.join()
        self._inputs.close()


class RunningGraph:
    """
    Excitation, stage, identifier, model and recorder, each a process of its own.

    `folder`: for the recording, ``bag``, and the logs; `take`: given each block that is observed:
    topic, receipt [ns], number of its first sample, size; `parameters`: of the nodes.
    """

    def __init__(
        self, folder: Path, take: Take, parameters: Mapping[str, Mapping[str, Any]] | None = None
    ) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from lab_graph import Client, Nodes
        from piezo_ident.nodes.wire import PREVIEW

        self.folder = folder
        #: last diagnostics of each node
        self.diagnostics: dict[str, dict[str, str]] = {}
        self._stack = contextlib.ExitStack()
        self.nodes = self._stack.enter_context(Nodes(folder / 'log'))
        self.client = self._stack.enter_context(Client('observer'))
        self.client.node.create_subscription(DiagnosticArray, '/diagnostics', self._hear, PREVIEW)
        self.client.follow(*NODES)
        own: dict[str, dict[str, Any]] = {name: {} for name in NODES}
        own['recorder'] = {'output': str(folder / 'bag')}
        own['excitation'] = {'subscribers': 3}
        for name in NODES:
            self.nodes.start(name, parameters={**own[name], **(parameters or {}).get(name, {})})
        self.observer = Observer(self.client, take)

    def _hear(self, message: Any) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self.diagnostics[status.name.strip('/')] = values

    def __enter__(self) -> RunningGraph:
        # a node that runs for the first time compiles its kernels before it says anything
        for name in NODES:
            self.client.wait(lambda name=name: self.state(name), PATIENCE, name)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.observer.close()
        codes = self.nodes.stop()
        self._stack.close()
        logs = {name: self.nodes.log / f'{name}.log' for name, code in codes.items() if code}
        if logs and kind is None:
            said = '\n'.join(f'{name}: {path.read_text()[-3000:]}' for name, path in logs.items())
            raise PiezoIdentError(f'not ended cleanly: {codes}\n{said}')

    def ask(self, service: str) -> str:
        """Call a service that must not refuse, and return its answer."""
        done, answer = self.client.call(service, PATIENCE)
        if not done:
            raise PiezoIdentError(f'{service} was refused: {answer}')
        return answer

    def set(self, node: str, name: str, value: object) -> None:
        """Set a parameter that must be taken."""
        done, reason = self.client.set(node, name, value, PATIENCE)
        if not done:
            raise PiezoIdentError(f'{node}: {name} was refused: {reason}')

    def state(self, node: str) -> str:
        """Return the state of a node; one that has failed ends it all."""
        self.nodes.check()
        status = self.client.status(node)
        if status.get('state') == 'failed':
            raise PiezoIdentError(f'{node}: {status.get("message")}')
        return status.get('state', '')

    def wait(self, node: str, state: str, limit: float = PATIENCE) -> None:
        """Wait for a state."""
        self.client.wait(lambda: self.state(node) == state, limit, f'{node} {state}')

    def play(
        self, seconds: float, look: Callable[[float], None] = lambda elapsed: None
    ) -> tuple[int, float]:
        """Play a sine to its end, calling `look`; return its samples and the time taken [s]."""
        program = (
            f'limits: [0, 10]\nsample_rate: {RATE}\nsegments:\n'
            f'  - {{signal: sine, bias: 5, amplitude: 4.5, frequency: 7, duration: {seconds:g}}}\n'
        )
        self.set('excitation', 'program', program)
        self.client.forget('excitation')
        samples = int(self.ask('excitation/start').split()[-2])
        began = time.monotonic()
        while self.state('excitation') != 'done':
            elapsed = time.monotonic() - began
            if elapsed > 20 * seconds + PATIENCE:
                raise PiezoIdentError('the program does not end')
            look(elapsed)
            time.sleep(POLL)
        taken = time.monotonic() - began
        # diagnostics come once a second
        time.sleep(2.0)
        return samples, taken


def recorded_samples(parts: Sequence[Path]) -> dict[str, int]:
    """Return the samples of each stream in all parts of a recording together."""
    counts = dict.fromkeys(STREAMS, 0)
    for part in parts:
        with opened_bag(part) as bag:
            for connection, _, raw in bag.messages(bag.connections):
                topic = connection.topic[1:]
                if topic in counts:
                    message = typestore().deserialize_cdr(raw, connection.msgtype)
                    counts[topic] += message.layout.dim[0].size
    return counts

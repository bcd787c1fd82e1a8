# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The running graph under attack: nodes stay up, and the voltage keeps its contract.

    python benchmarks/reliability/attack.py --rounds 20 --seconds 20

Six nodes run as processes, and an attacker has all that the network gives: messages that are no
blocks, or too large, or of any number and any time; parameters of wrong types; services called by
four processes as fast as they can; a `model` topic with anything but a model.  After every attack
each node must be there and answer, and all of `applied_voltage` is judged by `safety.check`.
"""

from __future__ import annotations

import argparse
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping
import itertools
import math
import os
from pathlib import Path
import subprocess
import sys
import time
from typing import Any

import numpy as np

HERE = Path(__file__).resolve()
ROOT = HERE.parents[2]
sys.path[:0] = [str(HERE.parent), *(str(ROOT / x) for x in ('test', 'test/nodes', 'examples'))]

from piezo_ident.live.guard import GuardSettings
from piezo_ident.record.blocks import Samples
from safety import check

FS = 20_000.0
NODES = ('stage', 'excitation', 'identifier', 'model', 'recorder', 'player')
#: what four clients call, none of which starts work that is meant
CALLED = (
    *('identifier/clear', 'identifier/cancel', 'identifier/save', 'excitation/start'),
    *('excitation/stop', 'recorder/stop', 'player/start'),
)
#: how long an answer may take on a machine that has much to do [s]
ANSWERED = 60.0


def odd_messages(large: int = 5_000_000) -> Iterator[tuple[str, Any]]:
    """
    Yield what is sent, by name: messages that are no blocks, or bytes that are no message.

    `large`: samples of the largest one.
    """
    from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout

    def message(data: Any, *dims: tuple[str, int, int], offset: int = 0) -> Float64MultiArray:
        layout = MultiArrayLayout(
            dim=[MultiArrayDimension(label=a, size=n, stride=s) for a, n, s in dims],
            data_offset=offset,
        )
        return Float64MultiArray(layout=layout, data=array('d', data))

    rows = np.column_stack([np.arange(100) / FS, np.zeros(100)]).ravel().tobytes()
    usual, width = ('sample:x', 100, 200), ('t,voltage', 2, 2)
    most = 2**32 - 1
    long = 'x' * 1_000_000
    yield 'nothing', Float64MultiArray()
    for name, dims in (
        ('numbers without a layout', ()),
        ('one dimension', (usual,)),
        ('three dimensions', (usual, width, width)),
        ('10,000 dimensions', (usual,) * 10_000),
        ('a size that lies', (('sample:x', 101, 202), width)),
        ('a size of 2^32 - 1', (('sample:x', most, most), width)),
        ('strides of 0', (('sample:x', 100, 0), ('t,voltage', 2, 0))),
        ('three columns', (('sample:x', 100, 300), ('t,voltage', 3, 3))),
        ('another quantity', (usual, ('t,current', 2, 2))),
        ('no quantity', (usual, ('', 2, 2))),
        ('another first label', (('rows', 100, 200), width)),
        ('a label of 1 MB', ((f'sample:{long}', 100, 200), width)),
        ('a quantity of 1 MB', (usual, (f't,{long}', 2, 2))),
        ('markup in a label', (('sample:<script>\n\x1b[2J', 100, 200), width)),
    ):
        yield name, message(rows, *dims)
    yield 'an offset beyond the end', message(rows, usual, width, offset=most)
    yield 'an odd count', message(rows[:-8], usual, width)
    yield 'no samples', message(b'', ('sample:x', 0, 0), width)
    for name, raw in (
        ('no bytes', b''),
        ('a lone header', b'\0\1\0\0'),
        ('all ones', b'\0\1\0\0' + b'\xff' * 64),
        ('a length of 2^31', b'\0\1\0\0' + b'\0' * 8 + b'\xff\xff\xff\x7f'),
        ('random bytes', os.urandom(500)),
    ):
        yield f'{name} in place of a message', raw
    block = np.zeros(2 * large)
    block[0::2] = np.arange(large) / FS
    yield f'{2 * large:,} doubles', message(block.tobytes(), ('sample:x', large, 2 * large), width)


def odd_blocks(rng: np.random.Generator, count: int) -> Iterator[Samples]:
    """Yield blocks of any number at any time, whose layout is right."""
    from safety import _drawn_settings, _drawn_times, _drawn_values

    head, last = 0, 0.0
    for _ in range(count):
        n = int(rng.choice([1, 2, 7, 100, 1000]))
        settings = _drawn_settings(rng, FS)
        t = np.asarray(_drawn_times(rng, n, head, FS, 1000), dtype=np.float64)
        v = np.asarray(_drawn_values(rng, n, settings, last), dtype=np.float64)
        yield Samples(t, v, 'attack')
        head += n


def bad_parameters(node: str) -> Iterator[tuple[str, list[Any]]]:
    """Yield requests to set parameters that must be refused, by name."""
    from piezo_ident.nodes.parameters import NODES as DECLARED
    from rcl_interfaces.msg import Parameter, ParameterValue

    values = {
        'nothing': ParameterValue(type=0),
        'a bool': ParameterValue(type=1, bool_value=True),
        'a whole number': ParameterValue(type=2, integer_value=-(2**63)),
        'NaN': ParameterValue(type=3, double_value=math.nan),
        'infinity': ParameterValue(type=3, double_value=-math.inf),
        'a huge number': ParameterValue(type=3, double_value=1e308),
        'bytes': ParameterValue(type=5, byte_array_value=[b'x']),
        'numbers': ParameterValue(type=8, double_array_value=[1.0, 2.0]),
        'type 99': ParameterValue(type=99),
    }
    for declaration in DECLARED[node]:
        for name, value in values.items():
            right = {bool: 1, int: 2, float: 3}.get(type(declaration.default))
            if value.type != right or name in ('NaN', 'infinity', 'a huge number'):
                own = [Parameter(name=declaration.name, value=value)]
                yield f'{name} for {declaration.name}', own
    text = ParameterValue(type=4, string_value='x' * 1_000_000)
    yield 'an unknown name', [Parameter(name='nobody', value=text)]
    yield 'a name of 1 MB', [Parameter(name='x' * 1_000_000, value=text)]
    number = ParameterValue(type=3, double_value=1.0)
    many = [Parameter(name=f'x{k}', value=number) for k in range(1000)]
    yield '1000 unknown names at once', many


def contradiction() -> list[Any]:
    """Return two parameters of a stage that each fit what is there, and not each other."""
    from rcl_interfaces.msg import Parameter, ParameterValue

    return [
        Parameter(name='voltage_high', value=ParameterValue(type=3, double_value=4.0)),
        Parameter(name='rest', value=ParameterValue(type=3, double_value=8.0)),
    ]


def foreign_models(model: str) -> Iterator[tuple[str, str]]:
    """Yield texts that are no model for a stage at 20 kHz, by name; `model` is one."""
    yield 'nothing', ''
    yield 'no YAML', '\t:[{'
    yield 'a list', '[1, 2]'
    yield 'another mapping', 'a: 1'
    yield 'an object', '!!python/object/apply:os.system ["touch /tmp/piezo_ident_was_here"]'
    more = ''.join(f'a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n' for k in range(1, 60))
    yield 'aliases for 2^60 entries', f'a0: &a0 [x, x]\n{more}'
    more = ''.join(f'a{k}: &a{k} {{<<: [*a{k - 1}, *a{k - 1}]}}\n' for k in range(1, 40))
    yield 'merge keys for 2^40 entries', f'a0: &a0 {{x: 1}}\n{more}'
    yield 'a list in itself', 'a: &a [*a]'
    yield 'depth of 100,000', 'a: ' + '[' * 100_000
    yield 'a number of a million digits', 'a: ' + '9' * 1_000_000
    yield 'a number in base 60', 'a: 1' + ':59' * 100_000
    yield '4 MB of text', 'a: ' + 'x' * 4_000_000
    yield 'control characters', 'a: \x00\x1b[2J'
    for name, old, new in (
        ('a huge weight', '0.4777', '1.0e+308'),
        ('a weight that is no number', '0.4777', '.nan'),
        ('a negative weight', '0.4777', '-1.0'),
        ('a delay of 10^12', 'samples: 3', 'samples: 1000000000000'),
        ('an unstable pole', '-1.5157', '-99.0'),
        ('a rate of 1e300 Hz', 'sample_rate: 20000', 'sample_rate: 1.0e+300'),
        ('a rate of 0 Hz', 'sample_rate: 20000', 'sample_rate: 0'),
        ('a later schema', 'sample_rate:', 'schema_version: 99\nsample_rate:'),
        ('a part too many', 'sample_rate:', 'shell: rm\nsample_rate:'),
    ):
        if old in model:
            yield name, model.replace(old, new, 1)


class Attack:
    """
    An attack on a graph that runs.

    `g`: with the nodes of `NODES` that are attacked; see test/nodes/graph.py; `nodes`: those of
    them that run.
    """

    def __init__(self, g: Any, nodes: tuple[str, ...] = NODES) -> None:
        from piezo_ident.nodes.wire import LATCHED, STREAM
        from rcl_interfaces.srv import SetParameters, SetParametersAtomically
        from rclpy.qos import QoSProfile
        from std_msgs.msg import Float64MultiArray, String

        self.g, self.nodes = g, nodes
        self._array, self._stream = Float64MultiArray, STREAM
        self.applied: list[np.ndarray] = []
        self._numbers: list[int] = []
        g.node.create_subscription(
            Float64MultiArray, 'applied_voltage', self._keep, QoSProfile(depth=20_000)
        )
        self.publishers = {
            topic: g.node.create_publisher(Float64MultiArray, topic, STREAM)
            for topic in ('voltage', 'displacement')
        }
        self.model = g.node.create_publisher(String, 'model', LATCHED)
        self._set: Any = SetParameters
        self._atomically: Any = SetParametersAtomically
        self._text: Any = String
        #: how many things were sent, by attack
        self.counts: Counter[str] = Counter()

    def survived(self, what: str) -> None:
        """See that every node is there and answers, and that the voltage kept its contract."""
        for node in self.nodes:
            handle = self.g.handle(node)
            assert handle.process.poll() is None, (
                f'{node} ended under {what}: {handle.log[-2000:]}'
            )
            # whatever waits in its queues comes first
            self.g.parameters(node)
        self.is_safe(what)

    def _keep(self, message: Any, info: Mapping[str, Any]) -> None:
        self.applied.append(np.asarray(message.data)[1::2].copy())
        self._numbers.append(int(info['publication_sequence_number']))

    @property
    def lost(self) -> int:
        """Messages of applied voltage that did not get here."""
        numbers = list(self._numbers)
        return numbers[-1] - numbers[0] + 1 - len(numbers) if numbers else 0

    @property
    def samples(self) -> int:
        """Samples of applied voltage that were judged."""
        return sum(v.size for v in list(self.applied))

    def is_safe(self, what: str) -> None:
        """Judge all that was applied so far, message by message where one is missing."""
        settings = GuardSettings(0.0, 10.0, 40_000.0, 20.0, 0.0, FS)
        numbers = list(self._numbers)
        if not numbers:
            return
        torn = np.flatnonzero(np.diff(numbers) != 1) + 1
        for a, b in itertools.pairwise([0, *torn.tolist(), len(numbers)]):
            v = np.concatenate(self.applied[a:b])
            check(settings, float(v[0]), v, what)

    def send(self, topic: str, message: Any) -> None:
        """Send a message, or bytes in its place."""
        from piezo_ident.nodes.wire import to_message

        if isinstance(message, Samples):
            message = to_message(message)
        self.publishers[topic].publish(message)

    def _send_raw(self, topic: str, raw: bytes) -> None:
        from rclpy.duration import Duration

        # the publisher of an empty message sends nothing more, so each gets its own
        own = self.g.node.create_publisher(self._array, topic, self._stream)
        own.publish(raw)
        own.wait_for_all_acked(Duration(seconds=1.0))
        # by the thread that waits on it
        self.g._executor.create_task(self.g.node.destroy_publisher, own)

    def messages(self, large: int) -> None:
        """Send what is no block on both topics."""
        for topic in self.publishers:
            for name, message in odd_messages(large):
                if isinstance(message, bytes):
                    self._send_raw(topic, message)
                else:
                    self.send(topic, message)
                self.counts['messages that are no blocks'] += 1
                if large > 10**6 and 'doubles' in name:
                    time.sleep(1.0)
        self.survived('messages that are no blocks')

    def blocks(self, seed: int, count: int) -> None:
        """Send any number at any time."""
        rng = np.random.default_rng(seed)
        for k, block in enumerate(odd_blocks(rng, count)):
            for topic in self.publishers:
                self.send(topic, block)
            self.counts['blocks of any number at any time'] += 2
            if k % 20 == 19:
                time.sleep(0.02)
        self.survived('blocks of any number at any time')

    def set_raw(self, node: str, parameters: list[Any], *, at_once: bool = False) -> Any:
        """Ask for parameters as they are; None when the node does not answer such a request."""
        kind = self._atomically if at_once else self._set
        name = 'set_parameters_atomically' if at_once else 'set_parameters'
        client = self.g.client(kind, f'{node}/{name}')
        future = client.call_async(kind.Request(parameters=parameters))
        # a type that does not exist ends the callback: it is said on the log, and not answered
        patience = 0.3 if any(p.value.type > 9 for p in parameters) else ANSWERED
        deadline = time.monotonic() + patience
        while not future.done() and time.monotonic() < deadline:
            time.sleep(0.005)
        return future.result() if future.done() else None

    def parameters(self, node: str) -> None:
        """Set what must be refused."""
        for name, parameters in bad_parameters(node):
            answer = self.set_raw(node, parameters)
            self.counts['parameters of wrong type or value'] += len(parameters)
            taken = [r for r in answer.results if r.successful] if answer is not None else []
            assert not taken, f'{node} took {name}'
        self.survived('parameters of wrong type or value')

    def models(self, model: str) -> list[str]:
        """Publish what is no model; return what the model node said."""
        said = []
        for name, text in foreign_models(model):
            seen = len(self.g.statuses('model'))
            self.model.publish(self._text(data=text))
            self.counts['models that are none'] += 1
            self.g.wait(
                lambda seen=seen: (
                    any('model refused' in s['text'] for s in self.g.statuses('model')[seen:])
                    or 'model refused' in self.g.status('model')['text']
                ),
                f'the model node to refuse {name}',
            )
            said.append(self.g.status('model')['text'])
        self.survived('models that are none')
        return said

    def services(self, seconds: float) -> float:
        """Call services as fast as four processes can; return calls answered a second."""
        command = [sys.executable, str(HERE), '--client', str(seconds)]
        pipe, own = subprocess.PIPE, self.g.environment
        running = [
            subprocess.Popen(command, stdout=pipe, stderr=pipe, env=own, text=True)
            for _ in range(4)
        ]
        try:
            said = [p.communicate(timeout=seconds + 2 * ANSWERED) for p in running]
        finally:
            for process in running:
                process.kill()
                process.wait()
        failed = [error for (_, error), p in zip(said, running, strict=True) if p.returncode]
        assert not failed, f'a client ended under service calls: {failed[0][-2000:]}'
        counts = [int(out) for out, _ in said]
        self.counts['service calls'] += sum(counts)
        self.survived('service calls')
        return sum(counts) / seconds


def client(seconds: float) -> int:
    """Call services one after the other, and print how many answers came."""
    from lab_graph import Client

    count = 0
    with Client(f'attacker_{os.getpid()}') as c:
        for service in CALLED:
            c.call(service, ANSWERED)
        end = time.monotonic() + seconds
        for service in itertools.cycle(CALLED):
            if time.monotonic() > end:
                break
            c.call(service, ANSWERED)
            count += 1
    print(count)
    return 0


def start(g: Any, nodes: Mapping[str, Mapping[str, Any]]) -> Attack:
    """Start nodes, and an attack on them."""
    g.start_all(*nodes.items())
    attack = Attack(g, tuple(nodes))
    for topic, publisher in attack.publishers.items():
        listeners = 3 if topic == 'voltage' else 2
        g.wait(
            lambda p=publisher, n=listeners: p.get_subscription_count() >= n, f'listeners, {topic}'
        )
    g.wait(attack.model.get_subscription_count, 'listeners to model')
    for node in nodes:
        # who does not know a publisher yet hears nothing of it
        g.known_to(node)
    return attack


def main() -> int:
    """Attack, and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--rounds', type=int, default=20)
    parser.add_argument('--seconds', type=float, default=20.0, help='of service calls')
    parser.add_argument('--client', type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.client:
        return client(args.client)
    from course import paper
    from graph import Graph
    from rows import write_rows

    with Graph() as g:
        given = {'stage': {'seed': 3}, 'recorder': {'output': str(g.folder / 'out')}}
        attack = start(g, {node: given.get(node, {}) for node in NODES})
        for k in range(args.rounds):
            attack.blocks(k, 500)
            attack.messages(5_000_000 if k == 0 else 1000)
        for _ in range(max(1, args.rounds // 10)):
            for node in NODES:
                attack.parameters(node)
            attack.models(paper())
        answer = attack.set_raw('stage', contradiction(), at_once=True)
        assert not answer.result.successful
        rate = attack.services(args.seconds)
        samples, lost = attack.samples, attack.lost
        codes = {n: g.handle(n).stop() for n in NODES}
    assert not any(codes.values()), codes
    rows = []
    for what, n in attack.counts.items():
        result = 'all six nodes stay up, answer, and report what they refused'
        if what == 'service calls':
            result = f'the same, at {rate:.0f} calls a second by four clients'
        rows.append((f'graph under attack: {what}', f'{n:,}', result))
    what = 'graph under attack: `applied_voltage` under all of these'
    result = 'limits and slew kept in every one'
    result += f'; {lost} messages did not reach the observer' if lost else ''
    rows.append((what, f'{samples:,} samples', result))
    write_rows('attack', rows, f'python benchmarks/reliability/attack.py --rounds {args.rounds}')
    for row in rows:
        print(': '.join(row))
    return 0


if __name__ == '__main__':
    sys.exit(main())

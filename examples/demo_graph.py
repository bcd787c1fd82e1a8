# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The demo on the running graph: identify, record, diagnose, record again, replay."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import functools
import json
import math
from pathlib import Path
import shlex
import shutil
import time
from typing import Any, Protocol

from demo_page import Array, Motion, MOTIONS, pictures, Recorded, Session, STAGE
from lab_graph import Client, Nodes, own_domain
import numpy as np
import piezo_ident as pi
from piezo_ident.nodes.subscriptions import RawSubscriptions
from piezo_ident.record.bags.read import MESSAGE_TYPE, opened_bag, typestore
from piezo_ident.record.blocks import decode

#: what the recorder must have as it was on the wire, and what a model makes of it
MEASURED = ('/voltage', '/displacement', '/applied_voltage')
PREDICTION, REPLAYED = '/prediction', '/replay/prediction'
ESTIMATE = '/estimate'  # waits for displacement, so its end may be missing
#: of the states of the identifier, those that are a step of their own
STATES = {
    'exciting': 'excitation',
    'identifying': 'identification',
    'diagnosing': 'diagnosis',
    'saving': 'reports',
}
FAILED = ('failed', 'cancelled', 'refused', 'stopped')
AT_REST = ('idle', 'done', *FAILED)
#: of the sample clock and of the replay, in times real time; the next one is tried where samples
#: are lost
RATES = (2.0, 1.0, 0.25)
#: a stream that is silent for so long has ended [s]
QUIET = 10.0
#: no limit of the nodes is one that a slow machine meets [s]
PATIENT = 120.0

Blocks = Mapping[str, Sequence[bytes]]


class Steps(Protocol):
    """Shows how far it is."""

    def show(self, step: str, share: float) -> None:
        """Show how much of a step is done."""

    def say(self, text: str) -> None:
        """Print a line."""


def rows_of(blocks: Sequence[bytes]) -> Array:
    """Return the rows (t, value) of blocks as they stand on the wire, shape (n, 2)."""
    rows = [np.empty((0, 2))]
    for raw in blocks:
        message = typestore().deserialize_cdr(raw, MESSAGE_TYPE)
        samples = decode(message.data, message.layout.dim, message.layout.data_offset)
        rows.append(np.column_stack((samples.t, samples.values)))
    return np.concatenate(rows)


def blocks_in(bag: Path, topics: Sequence[str]) -> dict[str, list[bytes]]:
    """Return the blocks of topics in a bag, as they stand there."""
    blocks: dict[str, list[bytes]] = {topic: [] for topic in topics}
    with opened_bag(bag) as opened:
        for connection, _, raw in opened.messages(
            [c for c in opened.connections if c.topic in blocks]
        ):
            blocks[connection.topic].append(bytes(raw))
    return blocks


def together(*streams: Array) -> tuple[Array, list[Array]]:
    """Return the times that all streams of rows (t, value) have, and their values at these."""
    t = functools.reduce(np.intersect1d, (rows[:, 0] for rows in streams))
    return t, [rows[np.searchsorted(rows[:, 0], t), 1] for rows in streams]


def lacking(samples: Mapping[str, int], n: int) -> str:
    """Return which topics have less than n samples; empty for none."""
    few = {topic: n - count for topic, count in samples.items() if count < n}
    return ', '.join(f'{k} of {n} samples of {topic}' for topic, k in few.items())


class Wire:
    """The blocks of some topics as their bytes come; `take` them at least every few seconds."""

    def __init__(self, client: Client, topics: Sequence[str]) -> None:
        self._client, self._inputs = client, RawSubscriptions(client.node, topics)
        self.blocks: dict[str, list[bytes]] = {topic: [] for topic in topics}
        self._samples = dict.fromkeys(topics, 0)
        self._arrival = time.monotonic()

    def is_matched(self) -> bool:
        """Return whether whoever publishes the topics is heard."""
        return self._inputs.look()

    def clear(self) -> None:
        """Forget what has come."""
        self.take()
        for topic in self.blocks:
            self.blocks[topic], self._samples[topic] = [], 0
        self._arrival = time.monotonic()

    def take(self) -> None:
        """Take what has come since."""
        for _, topic, raw in self._inputs.arrived():
            self.blocks[topic].append(bytes(raw))
            self._samples[topic] += len(rows_of([raw]))
            self._arrival = self._client.changed = time.monotonic()

    def lacks(self, n: int) -> str:
        """Return which topics lack how many of n samples; empty for none."""
        return lacking(self._samples, n)

    def is_over(self, n: int) -> bool:
        """Return whether n samples of each topic have come, or nothing comes any more."""
        return time.monotonic() - self._arrival > QUIET or not self.lacks(n)


@dataclass(frozen=True, eq=False)
class Recording:
    """The motions in a bag, and which of its blocks are those on the wire."""

    bag: Path
    blocks: Blocks
    equal: Mapping[str, bool]
    motion: Motion
    lost: str


class Lab:
    """The running graph."""

    def __init__(self, nodes: Nodes, client: Client, out: Path, progress: Steps) -> None:
        self.nodes, self.client, self.out, self.progress = nodes, client, out, progress
        self.rates = [*RATES]
        #: what was asked of the nodes, as commands of ROS
        self.commands: list[str] = []
        self.reports = client.listen('report')
        self.wire = Wire(client, (*MEASURED, PREDICTION))
        #: all that is heard, and taken in whatever is waited for
        self.wires = [self.wire]

    def start(self) -> None:
        """Start the nodes; no limit is one that a slow machine meets."""
        self.start_nodes(
            {
                'stage': {'stage': STAGE, 'silence': 30.0},
                'identifier': {'output': str(self.out / 'reports'), 'excitation_limit': PATIENT},
                'model': {},
                'recorder': {},
                'excitation': {
                    'subscribers': 3,
                    'wait_limit': PATIENT,
                    'rate_factor': self.rates[0],
                },
            }
        )

    def start_nodes(self, nodes: Mapping[str, Mapping[str, Any]]) -> None:
        """Start nodes with parameters, and wait until they are there."""
        self.client.follow(*nodes)
        for name, parameters in nodes.items():
            self.nodes.start(name, parameters=parameters)
        for i, name in enumerate(nodes):
            self.progress.show('start', i / len(nodes))
            self.wait(lambda name=name: self.client.status(name), name)
        self.progress.say(f'{len(nodes)} nodes are running: {", ".join(nodes)}')

    def ask(self, service: str) -> None:
        """Call a service that must not refuse."""
        # what follows the call must not be mistaken for what was before
        self.client.forget(service.rpartition('/')[0])
        self.commands.append(f'ros2 service call /{service} std_srvs/srv/Trigger')
        accepted, message = self.client.call(service)
        if not accepted:
            raise pi.PiezoIdentError(f'{service}: {message}')

    def set(self, node: str, name: str, value: Any) -> None:
        """Set a parameter."""
        self.commands.append(f'ros2 param set /{node} {name} {shlex.quote(str(value))}')
        accepted, reason = self.client.set(node, name, value)
        if not accepted:
            raise pi.PiezoIdentError(f'{node}: {name}: {reason}')

    def wait(
        self, condition: Callable[[], Any], what: str, look: Callable[[], None] | None = None
    ) -> None:
        """Wait as long as the nodes live."""

        def each() -> None:
            self.nodes.check()
            for wire in self.wires:
                wire.take()
            if look is not None:
                look()

        self.client.wait(condition, math.inf, what, each)

    def call(self, service: str, step: str, state: str = 'done') -> None:
        """Call a service, and show the progress of its node until it is in a state."""
        node = service.rpartition('/')[0]
        self.ask(service)
        self.wait_for(node, step, lambda: self.client.status(node).get('state') == state)

    def wait_for(self, node: str, step: str, condition: Callable[[], Any]) -> None:
        """Show the progress of a node until a condition holds."""

        def look() -> None:
            status = self.client.status(node)
            now = status.get('state', '')
            if now in FAILED:
                raise pi.PiezoIdentError(f'{node}: {status["message"]}')
            if node != 'recorder':
                share = float(status.get('progress', 0)) / 100
                self.progress.show(STATES.get(now, step), share)

        self.wait(condition, step, look)

    def call_for_report(self, service: str, step: str) -> dict[str, Any]:
        """Call a service, and return the report that it ends with."""
        n = len(self.reports)
        self.call(service, step)
        self.wait(lambda: len(self.reports) > n, 'the report')
        return dict(json.loads(self.reports[-1]))

    def without_loss(self, step: Callable[[], tuple[Any, str]]) -> Any:
        """Do a step, and where samples are lost once more at a lower rate."""
        while True:
            try:
                result, lost = step()
            except pi.PiezoIdentError as error:
                self.nodes.check()
                if len(self.rates) == 1 or isinstance(error, pi.ConfigError):
                    raise
                lost = str(error)
            else:
                if lost and len(self.rates) == 1:
                    self.progress.say(f'still lost: {lost}')
                if not lost or len(self.rates) == 1:
                    return result
            rate = self.rates.pop(0)
            self.progress.say(f'this machine is too busy for {rate:g} times real time: {lost}')
            self.progress.say(f'once more at {self.rates[0]:g} times real time')
            if self.client.status('excitation').get('state') in ('waiting', 'running'):
                self.ask('excitation/stop')
            self.wait(
                lambda: self.client.status('excitation').get('state', 'idle') in AT_REST,
                'the end of the excitation',
            )
            if self.client.status('recorder').get('state') == 'recording':
                self.call('recorder/stop', 'start')
            self.set('excitation', 'rate_factor', self.rates[0])

    def identify(self) -> tuple[None, str]:
        """Have the identifier drive the stage and learn its model."""
        models = self.models()
        report = self.call_for_report('identifier/run', 'excitation')
        self.wait_for_model(models)
        message = self.client.status('identifier')['text'].partition(' (100')[0]
        self.progress.say(f'~/run identified the stage: {message}')
        return None, '; '.join(f'{x["name"]} {x["where"]}' for x in report['data_faults'])

    def diagnose(self) -> None:
        """Have the identifier find what the model lacks."""
        models = self.models()
        # they come up meanwhile
        self.start_replay()
        report = self.call_for_report('identifier/diagnose', 'diagnosis')
        self.progress.say(f'~/diagnose: {report["sentence"]}')
        if report['effects']:
            self.wait_for_model(models)

    def play(self, step: str, name: str, motions: Path = MOTIONS) -> tuple[Recording, str]:
        """Play motions while the recorder records; return the recording, and what was lost."""
        bag, n = self.out / 'bags' / name, pi.Program.load(motions).build().n
        shutil.rmtree(bag, ignore_errors=True)
        self.set('excitation', 'program', str(motions))
        self.set('recorder', 'output', str(bag))
        self.call('recorder/start', step, 'recording')
        self.wait(self.wire.is_matched, 'the topics')
        self.wire.clear()
        self.call('excitation/start', step)
        self.wait(lambda: self.wire.is_over(n), 'the prediction')
        # what has come here has come to the recorder once it reports the next time
        self.client.forget('recorder')
        self.wait(lambda: self.client.status('recorder'), 'the recorder')
        self.call('recorder/stop', step)
        recording = self._recording(bag, n)
        text, left = recording.motion.text, recording.motion.estimate_text
        self.progress.say(
            f'{step}: residual of the model {text}, of its estimate {left}; in {bag}'
        )
        return recording, recording.lost

    def play_to_diagnose(self) -> tuple[Recording, str]:
        """Play the motions, and have the identifier keep these alone."""
        self.ask('identifier/clear')
        return self.play('motions', 'before')

    def _recording(self, bag: Path, n: int) -> Recording:
        blocks = blocks_in(bag, (*MEASURED, PREDICTION, ESTIMATE))
        estimated = rows_of(blocks.pop(ESTIMATE))
        equal = {topic: blocks[topic] == self.wire.blocks[topic] for topic in MEASURED}
        topics = ('/voltage', '/displacement', PREDICTION)
        t, values = together(*(rows_of(blocks[topic]) for topic in topics))
        if not t.size:
            raise pi.DataError(f'{bag}: no samples that all of {", ".join(topics)} have')
        lost = self.wire.lacks(n) or lacking({k: len(rows_of(x)) for k, x in blocks.items()}, n)
        known = dict(estimated.tolist())
        estimate = np.array([known.get(at, np.nan) for at in t.tolist()])
        return Recording(bag, blocks, equal, Motion(t, *values, estimate), lost)

    # the replay

    def start_replay(self) -> None:
        """Start the nodes of the replay; `replay` waits for them."""
        self.client.follow('replay/model', 'replay/player')
        self.nodes.start('model', namespace='replay')
        self.nodes.start('player', namespace='replay', parameters={'wait_limit': PATIENT})

    def replay(self, recording: Recording, model: Path) -> Recorded:
        """Play a bag to a model node in another namespace, and compare its free run."""
        n = len(rows_of(recording.blocks['/voltage']))
        wire = Wire(self.client, [REPLAYED])
        self.wires.append(wire)
        for node in ('replay/model', 'replay/player'):
            self.wait(lambda node=node: self.client.status(node), node)
        self.set('replay/model', 'model', str(model))
        self.wait(
            lambda: self.client.status('replay/model').get('state') == 'predicting', 'the model'
        )
        self.set('replay/player', 'bag', str(recording.bag))
        self.wait(wire.is_matched, REPLAYED)
        for rate in RATES:
            self.set('replay/player', 'rate', rate)
            wire.clear()
            self.call('replay/player/start', 'replay')
            self.wait(lambda: wire.is_over(n), 'the replayed prediction')
            lost = wire.lacks(n)
            if not lost:
                break
            self.progress.say(f'replay {rate:g} times as fast: lost {lost}')
        recorded = Recorded(
            bag=recording.bag,
            model=model,
            blocks={
                topic: (len(blocks), len(rows_of(blocks)), recording.equal[topic])
                for topic, blocks in recording.blocks.items()
                if topic in MEASURED
            },
            differences=self._differences(recording, rows_of(wire.blocks[REPLAYED]), model),
            rate=rate,
            stroke=recording.motion.stroke,
            commands=tuple(self.commands),
            lost=recording.lost or lost,
        )
        self.progress.say(f'the free runs live, replayed and offline {recorded.verdict}')
        return recorded

    def _differences(self, recording: Recording, replayed: Array, model: Path) -> dict[str, float]:
        """Return the largest difference of two free runs, in strokes."""
        live = rows_of(recording.blocks[PREDICTION])
        offline = [
            np.column_stack((piece.t, pi.load(model).simulate(piece.v)))
            for piece in pi.read(recording.bag)
        ]

        def largest(a: Array, b: Array) -> float:
            _, (first, second) = together(a, b)
            if not len(a) == len(b) == first.size:
                return math.inf
            return float(np.max(np.abs(first - second))) / recording.motion.stroke

        return {
            'live and replayed': largest(live, replayed),
            'live and offline': largest(live, np.concatenate(offline)),
        }

    def models(self) -> int:
        """Return how many models the model node has taken."""
        return int(self.client.status('model').get('models', 0))

    def wait_for_model(self, before: int) -> None:
        """Wait until the model node has taken another model."""
        self.wait(lambda: self.models() > before, 'the model node taking the model')


def live(out: Path, progress: Steps) -> Session:
    """Do it on the running graph."""
    own_domain()
    with Nodes(out / 'log') as nodes, Client('demo') as client:
        lab = Lab(nodes, client, out, progress)
        lab.start()
        lab.without_loss(lab.identify)
        before = lab.without_loss(lab.play_to_diagnose)
        lab.diagnose()
        # the identifier draws meanwhile
        lab.ask('identifier/save')
        after = lab.without_loss(lambda: lab.play('the same motions', 'after'))
        pictures(before.motion, after.motion)  # kept for the page
        # it may have gone on to capture since
        ended = {'done', *FAILED}
        lab.wait_for('identifier', 'reports', lambda: ended & {*client.states('identifier')})
        recorded = lab.replay(after, out / 'reports' / 'diagnosis' / 'model.yaml')
        for name, code in nodes.stop().items():
            if code:
                raise pi.PiezoIdentError(f'node {name} ended with code {code}')
    return Session(before.motion, after.motion, recorded)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0


"""
The whole graph in real time: how late a prediction is, what is lost, and who takes how much CPU.

    .venv/bin/python benchmarks/bench_live.py --seconds 300 --out docs/live.md

Excitation, stage, identifier, model and recorder run as processes of their own; this process
observes.  First the stage is identified, so that there is a model.  Then a sine is played at
20 kHz in blocks of 5 ms; after two fifths of the time the identifier is asked to identify again
and again.  The delay of a prediction is that from the receipt of a block of voltage to the receipt
of the prediction with the same t, both by the middleware of this process.  Last, programs are
played faster than real time.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field
import itertools
import os
from pathlib import Path
import platform
import random
import shlex
import sys
import tempfile
import threading
import time

import numpy as np
import piezo_ident
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.record.bags.read import opened_bag, typestore

RATE, BLOCK = 20_000, 100
STREAMS = ('voltage', 'displacement', 'applied_voltage', 'prediction', 'residual')
NODES = ('stage', 'identifier', 'model', 'recorder', 'excitation')
#: how often arrivals are fetched and states are looked at [s]
POLL = 0.02
#: share of the time that passes before identifications begin
QUIET = 0.4
#: speeds that are tried
FACTORS = (1.5, 2.0, 3.0, 4.0)


@dataclass
class Seen:
    """What the observer has seen of one program."""

    arrivals: dict[str, dict[float, int]] = field(
        default_factory=lambda: {topic: {} for topic in STREAMS}
    )
    busy: list[tuple[int, int]] = field(default_factory=list)
    captured: int = 0


class Fetcher:
    """Fetches what arrives on some topics, in a thread of its own."""

    def __init__(self, client, topics: list[str]) -> None:
        from piezo_ident.nodes.subscriptions import message_class, RawSubscriptions
        from rclpy.serialization import deserialize_message

        self.client = client
        self._kind, self._deserialize = (
            message_class('std_msgs/msg/Float64MultiArray'),
            deserialize_message,
        )
        self._subscriptions = RawSubscriptions(client.node, topics)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    @property
    def lost(self) -> int:
        """Messages that were sent here and did not arrive."""
        return self._subscriptions.lost

    def data(self, raw: bytes):
        """Return the numbers of a message."""
        return self._deserialize(raw, self._kind).data

    def look(self) -> None:
        """Do what is to be done before each fetch."""

    def arrived(self, stamp: int, topic: str, raw: bytes) -> None:
        """Take a message."""
        raise NotImplementedError

    def _work(self) -> None:
        looked = 0.0
        while not self._end.wait(POLL):
            self.look()
            for message in self._subscriptions.arrived():
                self.arrived(*message)
            if time.monotonic() - looked > 0.5:
                looked = time.monotonic()
                self._subscriptions.look()

    def close(self) -> None:
        """Fetch no more."""
        self._end.set()
        self._thread.join()
        self._subscriptions.close()


class Observer(Fetcher):
    """Keeps when the blocks of the graph arrived, and when the identifier was at work."""

    def __init__(self, client) -> None:
        self.seen = Seen()
        self._working = False
        super().__init__(client, [f'/{t}' for t in STREAMS])

    def look(self) -> None:
        """See whether the identifier is at work."""
        now = time.time_ns()
        busy = self.seen.busy
        if self.client.status('identifier').get('state') != 'identifying':
            self._working = False
        elif self._working and busy:
            busy[-1] = (busy[-1][0], now)
        else:
            busy.append((now, now))
            self._working = True

    def arrived(self, stamp: int, topic: str, raw: bytes) -> None:
        """Keep when a block arrived, by its last t."""
        data = self.data(raw)
        self.seen.arrivals[topic[1:]][data[-2]] = stamp


def processes() -> dict[int, tuple[int, float]]:
    """Return the parent and the CPU time [s] of every process."""
    tick, found = os.sysconf('SC_CLK_TCK'), {}
    for path in Path('/proc').glob('[0-9]*/stat'):
        try:
            fields = path.read_text().rpartition(')')[2].split()
        except OSError:
            continue
        found[int(path.parent.name)] = (int(fields[1]), (int(fields[11]) + int(fields[12])) / tick)
    return found


class Shares:
    """CPU time of each node, and of what works for it, over a stretch of time."""

    def __init__(self, nodes) -> None:
        self._pids = {name: p.pid for name, p in nodes.processes.items()}
        self._begin, self._times = time.monotonic(), self._read()

    def _read(self) -> dict[str, float]:
        table, times = processes(), {}
        for name, pid in self._pids.items():
            times[name] = table.get(pid, (0, 0.0))[1]
            helpers = sum(seconds for parent, seconds in table.values() if parent == pid)
            if name == 'identifier':
                times['identifications'] = helpers
        times['observer'] = table[os.getpid()][1]
        return times

    def percent(self) -> dict[str, float]:
        """Return the share of one core that each has taken [%]."""
        elapsed, now = time.monotonic() - self._begin, self._read()
        return {name: 100 * (t - self._times.get(name, 0.0)) / elapsed for name, t in now.items()}


def delays(seen: Seen) -> dict[str, np.ndarray]:
    """Return how long each prediction took [ms], without and with an identification at work."""
    voltage, prediction = seen.arrivals['voltage'], seen.arrivals['prediction']
    both = [t for t in voltage if t in prediction]
    begin = np.array([voltage[t] for t in both], dtype=np.int64)
    late = 1e-6 * (np.array([prediction[t] for t in both], dtype=np.int64) - begin)
    busy = np.zeros(begin.size, dtype=bool)
    for first, last in seen.busy:
        busy |= (begin >= first) & (begin <= last)
    return {'streaming': late[~busy], 'while an identification runs': late[busy]}


def sine(seconds: float) -> str:
    """Return a program."""
    return (
        f'limits: [0, 10]\nsample_rate: {RATE}\nsegments:\n'
        f'  - {{signal: sine, bias: 5, amplitude: 4.5, frequency: 7, duration: {seconds:g}}}\n'
    )


@dataclass
class Played:
    """What came of a program: samples sent, time taken [s], CPU of each process [%], its bag."""

    seen: Seen
    samples: int
    seconds: float
    percent: dict[str, float]
    bag: Path

    def lost(self) -> dict[str, int]:
        """Return how many samples of each stream did not get to the observer."""
        blocks = len(self.seen.arrivals['voltage'])
        return {t: BLOCK * (blocks - len(self.seen.arrivals[t])) for t in STREAMS}

    def not_captured(self) -> int:
        """Return how many samples the identifier lacks."""
        return self.samples - self.seen.captured

    def not_recorded(self) -> dict[str, int]:
        """Return how many samples of each stream the bag lacks."""
        n = dict.fromkeys(STREAMS, self.samples)
        with opened_bag(self.bag) as bag:
            for connection, _, raw in bag.messages(bag.connections):
                topic = connection.topic[1:]
                if topic in n:
                    message = typestore().deserialize_cdr(raw, connection.msgtype)
                    n[topic] -= message.layout.dim[0].size
        return n


class Session:
    """The running graph, and what is asked of it."""

    def __init__(self, nodes, client, folder: Path) -> None:
        self.nodes, self.client, self.folder = nodes, client, folder
        for name in NODES:
            client.follow(name)
        client.count('identifier')
        nodes.start('stage')
        nodes.start('identifier')
        nodes.start('model')
        nodes.start('recorder', parameters={'output': str(folder / 'bag')})
        nodes.start('excitation', parameters={'subscribers': 3})
        self.observer = Observer(client)

    def ask(self, service: str) -> str:
        """Call a service that must not refuse, and return its answer."""
        done, answer = self.client.call(service, timeout=30.0)
        if not done:
            raise PiezoIdentError(f'{service} was refused: {answer}')
        return answer

    def set(self, node: str, name: str, value: object) -> None:
        """Set a parameter that must be taken."""
        done, reason = self.client.set(node, name, value, timeout=30.0)
        if not done:
            raise PiezoIdentError(f'{node}: {name} was refused: {reason}')

    def state(self, node: str) -> str:
        """Return the state of a node; one that has failed ends it all."""
        self.nodes.check()
        status = self.client.status(node)
        if status.get('state') == 'failed':
            raise PiezoIdentError(f'{node}: {status.get("message")}')
        return status.get('state', '')

    def wait(self, node: str, state: str, limit: float) -> None:
        """Wait for a state."""
        self.client.wait(lambda: self.state(node) == state, limit, f'{node} {state}')

    def play(
        self, seconds: float, factor: float, *, identify_after: float | None = None
    ) -> Played:
        """Play a sine to its end."""
        self.set('excitation', 'program', sine(seconds))
        self.set('excitation', 'rate_factor', factor)
        bag = self.folder / f'bag_{time.monotonic_ns()}'
        self.set('recorder', 'output', str(bag))
        self.ask('recorder/start')
        self.wait('recorder', 'recording', 10.0)
        # all of this program, and nothing of the one before
        captured = self.client.count('identifier')
        seen = self.observer.seen = Seen()
        samples = int(self.ask('excitation/start').split()[-2])
        self.wait('excitation', 'running', 10.0)
        began, shares = time.monotonic(), Shares(self.nodes)
        while self.state('excitation') == 'running':
            after = time.monotonic() - began
            if identify_after is not None and after > identify_after:
                if self.state('identifier') != 'identifying' and after < seconds - 2.0:
                    self.ask('identifier/identify')
            time.sleep(0.1)
        taken, percent = time.monotonic() - began, shares.percent()
        # the identifier tells its count once a second
        time.sleep(2.0)
        seen.captured = self.client.count('identifier') - captured
        self.ask('recorder/stop')
        self.wait('recorder', 'done', 10.0)
        return Played(seen, samples, taken, percent, bag)

    def identify(self) -> None:
        """Let the identifier drive the excitation, and make a model."""
        self.ask('identifier/run')
        self.wait('identifier', 'done', 180.0)
        self.wait('model', 'predicting', 10.0)


def machine() -> str:
    """Return what this was measured on."""
    name = platform.processor() or platform.machine()
    for line in Path('/proc/cpuinfo').read_text().splitlines():
        if line.startswith('model name'):
            name = line.partition(':')[2].strip()
            break
    return (
        f'{os.cpu_count()} cores of {name}, Linux {platform.release()}, '
        f'Python {platform.python_version()}, numpy {np.__version__}, '
        f'piezo_ident {piezo_ident.__version__}'
    )


def real_time(session: Session, seconds: float) -> Iterator[str]:
    """Play in real time, and yield the tables."""
    before = session.observer.lost
    played = session.play(seconds, 1.0, identify_after=QUIET * seconds)
    block = f'{1e3 * BLOCK / RATE:g} ms'
    yield f'## Real time: {RATE / 1000:g} kHz for {seconds:g} s, blocks of {block}'
    yield ''
    yield '| delay of the prediction | blocks | p50 | p99 | worst |'
    yield '|---|---|---|---|---|'
    for name, late in delays(played.seen).items():
        if late.size:
            p50, p99 = np.percentile(late, [50, 99])
            yield f'| {name} | {late.size} | {p50:.2f} ms | {p99:.2f} ms | {late.max():.2f} ms |'
    yield ''
    yield f'{len(played.seen.busy)} identifications were at work meanwhile.'
    yield ''
    yield f'| stream, {played.samples} samples | lost on the way here | lost in the bag |'
    yield '|---|---|---|'
    lost, not_recorded = played.lost(), played.not_recorded()
    for name in STREAMS:
        yield f'| {name} | {lost[name]} | {not_recorded[name]} |'
    yield ''
    unheard = session.observer.lost - before
    yield (
        f'The identifier lacks {played.not_captured()} samples; {unheard} messages did not reach '
        'the observer.'
    )
    yield ''
    yield '| process | CPU, % of one core |'
    yield '|---|---|'
    for name, share in played.percent.items():
        yield f'| {name} | {share:.0f} |'
    yield f'| all | {sum(played.percent.values()):.0f} |'


def faster(session: Session, seconds: float) -> Iterator[str]:
    """Play faster than real time, and yield the table."""
    yield '## Faster than real time'
    yield ''
    yield '| rate_factor | reached | samples lost | CPU, % of one core |'
    yield '|---|---|---|---|'
    for factor in FACTORS:
        played = session.play(seconds * factor, factor)
        most = max(*played.not_recorded().values(), played.not_captured())
        reached = played.samples / RATE / played.seconds
        yield f'| {factor:g} | {reached:.2f} | {most} | {sum(played.percent.values()):.0f} |'


def main() -> int:
    """Run everything, print and write the page."""
    parser = argparse.ArgumentParser(description='Measures the running graph.')
    parser.add_argument('--seconds', type=float, default=300.0, help='length in real time')
    parser.add_argument('--fast-seconds', type=float, default=15.0, help='of each faster run')
    parser.add_argument('--out', type=Path, help='page to write')
    args = parser.parse_args()
    os.environ['ROS_DOMAIN_ID'] = str(random.SystemRandom().randint(1, 101))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'examples'))
    from lab_graph import Client, Nodes

    lines = [
        '# The running graph, measured',
        '',
        f'    .venv/bin/python benchmarks/bench_live.py {shlex.join(sys.argv[1:])}',
        '',
        f'On {machine()}; load average before it {os.getloadavg()[0]:.1f}.',
        '',
        'Excitation, stage, identifier, model and recorder, each a process of its own, and an '
        'observer.',
        'A delay is that from the receipt of a block of voltage to the receipt of its prediction,',
        'matched by t, in the observer.',
        '',
    ]
    with tempfile.TemporaryDirectory() as folder, Nodes(Path(folder, 'log')) as nodes:
        with Client('observer') as client:
            session = Session(nodes, client, Path(folder))
            session.identify()
            parts = (real_time(session, args.seconds), faster(session, args.fast_seconds))
            for line in itertools.chain(parts[0], [''], parts[1]):
                print(line, flush=True)
                lines.append(line)
            session.observer.close()
        codes = nodes.stop()
    if any(codes.values()):
        print(f'not ended cleanly: {codes}')
        return 1
    if args.out:
        args.out.write_text('\n'.join(lines) + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The whole graph in real time for hours: memory, samples lost, and the sample clock.

    python benchmarks/reliability/soak.py --seconds 7200

Excitation, stage, identifier, model and recorder run at 20 kHz, with a model that predicts, a
recording that is cut into parts, and an observer that reads every stamp of every stream.  Printed
are the memory of each node and its slope after the first quarter, the samples that did not arrive
anywhere, the drift of the sample clock against the clock of the machine, and the parts of the bag.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, field
import itertools
import os
from pathlib import Path
import random
import shutil
import signal
import sys
import tempfile
import threading
import time
from typing import Any

import numpy as np

HERE = Path(__file__).resolve()
sys.path[:0] = [str(HERE.parent), str(HERE.parents[2] / 'examples')]

from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.record.bags.read import opened_bag
from rows import processors, shares, write_rows

__all__ = ['Observer', 'Soak', 'soak']

RATE, BLOCK = 20_000, 100
STREAMS = ('voltage', 'displacement', 'applied_voltage', 'prediction', 'residual')
NODES = ('stage', 'identifier', 'model', 'recorder', 'excitation')
#: how often arrivals are fetched, and memory is looked at [s]
POLL, LOOK = 0.05, 2.0
#: longest program: samples of one are bounded [s]
LONGEST = 600.0
#: stage of the paper as a model: what matters here is that it predicts
MODEL = HERE.parents[2] / 'config/stage_paper.yaml'


@dataclass
class Stream:
    """What passed of a topic: samples, those that are missing by their stamps, and restarts."""

    samples: int = 0
    missing: int = 0
    runs: int = 0
    last: int | None = None

    def take(self, first: int, n: int) -> None:
        """Take note of a block by its first tick."""
        if self.last is None or first <= self.last:
            self.runs += 1
            self.missing += first
        else:
            self.missing += first - self.last - 1
        self.samples += n
        self.last = first + n - 1


class Observer:
    """Reads the stamps of all streams in a thread, and when they came."""

    def __init__(self, client: Any) -> None:
        from piezo_ident.nodes.subscriptions import message_class, RawSubscriptions
        from rclpy.serialization import deserialize_message

        self._kind = message_class('std_msgs/msg/Float64MultiArray')
        self._read = deserialize_message
        self._inputs = RawSubscriptions(client.node, [f'/{t}' for t in STREAMS])
        self.streams = {topic: Stream() for topic in STREAMS}
        #: of each program: (time of the machine [s], time of the samples [s]) of its blocks
        self.clocks: list[list[tuple[float, float]]] = []
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def _work(self) -> None:
        looked = 0.0
        while not self._end.wait(POLL):
            for stamp, topic, raw in self._inputs.arrived():
                data = np.asarray(self._read(raw, self._kind).data)
                first, n = round(data[0] * RATE), data.size // 2
                stream, name = self.streams[topic[1:]], topic[1:]
                runs = stream.runs
                stream.take(first, n)
                if name != 'voltage':
                    continue
                if stream.runs > runs:
                    self.clocks.append([])
                # a few a second say enough
                if first % 4000 == 0:
                    self.clocks[-1].append((1e-9 * stamp, first / RATE))
            if time.monotonic() - looked > 0.5:
                looked = time.monotonic()
                self._inputs.look()

    @property
    def unheard(self) -> int:
        """Messages that were sent to this process and did not arrive."""
        return self._inputs.lost

    def close(self) -> None:
        """Read no more."""
        self._end.set()
        self._thread.join()
        self._inputs.close()


def memory(pid: int) -> float:
    """Return the resident memory of a process and of what it has started [MB]."""
    pids, total = [pid], 0.0
    for path in Path(f'/proc/{pid}/task').glob('*/children'):
        pids += [int(p) for p in path.read_text().split()]
    for one in pids:
        try:
            text = Path(f'/proc/{one}/status').read_text()
        except OSError:
            continue
        total += int(text.partition('VmRSS:')[2].split()[0]) / 1024
    return total


def slope(t: np.ndarray, x: np.ndarray) -> tuple[float, float]:
    """Return the slope of a line, and twice its standard error."""
    a = np.column_stack([t - t.mean(), np.ones(t.size)])
    (k, _), *_ = np.linalg.lstsq(a, x, rcond=None)
    rest = x - a @ np.array([k, x.mean()])
    # neighbours are alike: as many independent values as there are minutes, at least three
    n = max(3.0, min(t.size, (t[-1] - t[0]) / 60.0))
    error = np.sqrt((rest @ rest) / t.size / n) / max(float(np.std(t)), 1e-9)
    return float(k), float(2 * error)


@dataclass
class Soak:
    """
    What a long run gave.

    Attributes
    ----------
    seconds : float
        Of program.
    samples : int
        Of the programs.
    lost : dict of str to int
        Samples that are missing, by stream at the observer, and by where the graph counts.
    memory : dict of str to (first, last, slope, error)
        MB, MB, MB/h and MB/h, after the first quarter.
    drift : float
        Of the sample clock against that of the machine [s/s], and what it is known to.
    drift_error : float
    late : int
        Blocks that the excitation sent after the next was due.
    slipped : float
        By how much its schedule moved [s].
    parts : int
        Of the recording.
    recorded : dict of str to int
        Samples of each stream in all parts.
    """

    seconds: float
    samples: int
    lost: dict[str, int]
    memory: dict[str, tuple[float, float, float, float]]
    drift: float
    drift_error: float
    late: int
    slipped: float
    parts: int
    recorded: dict[str, int] = field(default_factory=dict)

    def lines(self) -> Iterator[str]:
        """Yield the story."""
        yield f'{self.seconds:g} s, {self.samples:,} samples'
        for name, (first, last, k, error) in self.memory.items():
            yield f'{name}: {first:.1f} -> {last:.1f} MB, {k:+.2f} +- {error:.2f} MB/h'
        yield f'lost: {self.lost}'
        yield f'sample clock: {1e6 * self.drift:+.2f} +- {1e6 * self.drift_error:.2f} us/s'
        yield f'late blocks: {self.late}, schedule moved by {self.slipped:g} s'
        yield f'recording: {self.parts} parts, {self.recorded}'


def sine(seconds: float) -> str:
    """Return a program."""
    return (
        f'limits: [0, 10]\nsample_rate: {RATE}\nsegments:\n'
        f'  - {{signal: sine, bias: 5, amplitude: 4.5, frequency: 7, duration: {seconds:g}}}\n'
    )


def soak(seconds: float, factor: float, part: int, folder: Path) -> Soak:
    """
    Run the graph.

    Parameters
    ----------
    seconds : float
        Length of all programs together.
    factor : float
        `rate_factor` of the excitation; 1 is real time.
    part : int
        Size of a part of the recording [bytes].
    folder : path
        For bags and logs.
    """
    from diagnostic_msgs.msg import DiagnosticArray
    from lab_graph import Client, Nodes
    from piezo_ident.nodes.wire import PREVIEW

    told: dict[str, dict[str, str]] = {}
    worst: dict[str, float] = {'late': 0, 'slipped': 0.0}

    def hear(message: DiagnosticArray) -> None:
        for status in message.status:
            told[status.name.strip('/')] = {p.key: p.value for p in status.values}

    with Nodes(folder / 'log') as nodes, Client('soak') as client:
        client.node.create_subscription(DiagnosticArray, '/diagnostics', hear, PREVIEW)
        for name in NODES:
            client.follow(name)
        model = folder / 'model.yaml'
        model.write_text(_model_text())
        nodes.start('stage', parameters={'silence': 5.0})
        nodes.start('identifier', parameters={'capture_limit': min(60.0, max(1.0, seconds / 4))})
        nodes.start('model', parameters={'model': str(model)})
        recorder = {'output': str(folder / 'bag'), 'max_bag_size': part}
        nodes.start('recorder', parameters=recorder)
        # the model and the observer of this process listen too
        nodes.start('excitation', parameters={'subscribers': 5, 'rate_factor': factor})
        observer = Observer(client)
        try:
            # a node that runs for the first time compiles its kernels before it says anything
            for name in NODES:
                client.wait(lambda name=name: client.status(name), 120.0, name, nodes.check)
            _ask(client, 'recorder/start')
            _until(nodes, client, 'recorder', ('recording',), 30.0)
            left, samples = seconds, 0
            times: list[float] = []
            sizes: dict[str, list[float]] = {name: [] for name in NODES}
            while left > 0:
                length = min(left, LONGEST)
                _set(client, 'excitation', 'program', sine(length))
                samples += int(_ask(client, 'excitation/start').split()[-2])
                client.forget('excitation')
                begin, looked = time.monotonic(), 0.0
                while client.status('excitation').get('state') != 'done':
                    nodes.check()
                    now = time.monotonic()
                    if client.status('excitation').get('state') == 'failed':
                        raise PiezoIdentError(str(client.status('excitation')))
                    if now - begin > 20 * length + 120:
                        raise PiezoIdentError('the program does not end')
                    if now - looked > LOOK:
                        looked = now
                        times.append(now)
                        for name in NODES:
                            sizes[name].append(memory(nodes.processes[name].pid))
                    time.sleep(0.1)
                time.sleep(1.5)
                worst['late'] += int(told['excitation'].get('late', '0'))
                worst['slipped'] += float(told['excitation'].get('slipped', '0'))
                left -= length
            _ask(client, 'recorder/stop')
            _until(nodes, client, 'recorder', ('done',), 60.0)
            time.sleep(1.5)
        finally:
            observer.close()
        lost = {f'{t} at the observer': samples - observer.streams[t].samples for t in STREAMS}
        lost['messages to the observer'] = observer.unheard
        for name, key in (('stage', 'lost'), ('identifier', 'lost'), ('model', 'lost')):
            lost[f'by the {name}'] = int(told[name][key])
        lost['messages to the recorder'] = int(told['recorder']['lost'])
        codes = nodes.stop()
    # a busy machine may need the second signal
    if any(code not in (0, -signal.SIGTERM) for code in codes.values()):
        raise PiezoIdentError(f'not ended cleanly: {codes}')
    parts = sorted(folder.glob('bag*'), key=lambda p: (len(p.name), p.name))
    recorded = recorded_samples(parts)
    for topic, n in recorded.items():
        lost[f'{topic} in the bag'] = samples - n
    t = (np.array(times) - times[0]) / 3600.0
    quarter = t >= 0.25 * t[-1]
    kept = {
        name: (x[0], x[-1], *slope(t[quarter] * 3600.0, np.array(x)[quarter] * 3600.0))
        for name, x in sizes.items()
    }
    drift, error = clock_drift(observer.clocks)
    return Soak(
        seconds,
        samples,
        {where: n for where, n in lost.items() if n},
        kept,
        drift,
        error,
        int(worst['late']),
        worst['slipped'],
        len(parts),
        recorded,
    )


def clock_drift(clocks: list[list[tuple[float, float]]]) -> tuple[float, float]:
    """Return by how much the sample clock runs faster than the machine's [s/s], and its error."""
    found, errors = [0.0], [0.0]
    for pairs in clocks:
        if len(pairs) < 20:
            continue
        machine, stream = np.array(pairs).T
        # a block comes late at times, never early: the earliest of each stretch tell the clock
        lag = (machine - machine[0]) - (stream - stream[0])
        parts = [np.argmin(p) + k for p, k in _stretches(lag, 10)]
        k, error = slope(stream[parts], lag[parts])
        found.append(-k)
        errors.append(error)
    return max(found, key=abs), max(errors)


def _stretches(x: np.ndarray, n: int) -> Iterator[tuple[np.ndarray, int]]:
    edges = np.linspace(0, x.size, n + 1).astype(int)
    for a, b in itertools.pairwise(edges):
        yield x[a:b], int(a)


def recorded_samples(parts: list[Path]) -> dict[str, int]:
    """Return the samples of each stream in all parts together."""
    from piezo_ident.record.bags.read import typestore

    counts = dict.fromkeys(STREAMS, 0)
    for part in parts:
        with opened_bag(part) as bag:
            for connection, _, raw in bag.messages(bag.connections):
                topic = connection.topic[1:]
                if topic in counts:
                    message = typestore().deserialize_cdr(raw, connection.msgtype)
                    counts[topic] += message.layout.dim[0].size
    return counts


def _model_text() -> str:
    import yaml

    data = yaml.safe_load(MODEL.read_text())
    for key in ('sensor', 'seed'):
        data.pop(key, None)
    return yaml.safe_dump(data)


def _ask(client: Any, service: str) -> str:
    done, answer = client.call(service, timeout=60.0)
    if not done:
        raise PiezoIdentError(f'{service} was refused: {answer}')
    return str(answer)


def _set(client: Any, node: str, name: str, value: object) -> None:
    done, reason = client.set(node, name, value, timeout=60.0)
    if not done:
        raise PiezoIdentError(f'{node}: {name} was refused: {reason}')


def _until(nodes, client: Any, node: str, states: tuple[str, ...], limit: float) -> None:
    client.wait(lambda: client.status(node).get('state') in states, limit, node, nodes.check)


def main() -> int:
    """Run it, and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--seconds', type=float, default=7200.0)
    parser.add_argument('--factor', type=float, default=1.0, help='rate_factor; 1 is real time')
    parser.add_argument('--part', type=int, default=500_000_000, help='bytes of a part of the bag')
    parser.add_argument('--folder', type=Path, help='for the bags; a temporary one when absent')
    args = parser.parse_args()
    os.environ.setdefault('ROS_DOMAIN_ID', str(random.SystemRandom().randint(1, 101)))
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    folder = Path(tempfile.mkdtemp(prefix='piezo_ident_soak_', dir=args.folder))
    before = processors()
    try:
        found = soak(args.seconds, args.factor, args.part, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    load = shares(before, processors())
    for line in found.lines():
        print(line)
    print(load)
    growth = ', '.join(
        f'{name} {k:+.1f} ± {error:.1f}' for name, (_, _, k, error) in found.memory.items()
    )
    lost = '; '.join(f'{n} {where}' for where, n in found.lost.items()) or 'no sample lost'
    pace = 'in real time' if args.factor == 1.0 else f'at rate_factor {args.factor:g}'
    write_rows(
        'soak',
        [
            {
                'what': f'the whole graph at 20 kHz for {found.seconds / 60:g} min {pace}, '
                'recording in parts',
                'how_often': f'1 run, {found.samples:,} samples, {load}',
                'result': f'{lost}; memory in MB/h: {growth}; sample clock '
                f'{1e6 * found.drift:+.1f} ± {1e6 * found.drift_error:.1f} µs/s against that of '
                f'the machine, of whose schedule {found.slipped:.1f} s were lost where blocks '
                f'came too late ({found.late}); {found.parts} parts',
                'command': f'python benchmarks/reliability/soak.py --seconds {found.seconds:g}'
                + (f' --factor {args.factor:g}' if args.factor != 1.0 else ''),
            }
        ],
    )
    return 0


if __name__ == '__main__':
    sys.exit(main())

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
import shlex
import sys
import tempfile
import time

import numpy as np
from running_graph import BLOCK, RATE, recorded_samples, RunningGraph, STREAMS
from side_by_side import machine, markdown

#: share of the time that passes before identifications begin
QUIET = 0.4
#: speeds that are tried
FACTORS = (1.5, 2.0, 3.0, 4.0)


@dataclass
class Seen:
    """What was seen of one program: receipts by the first sample, when it was identified [ns]."""

    arrivals: dict[str, dict[int, int]] = field(default_factory=lambda: {t: {} for t in STREAMS})
    busy: list[tuple[int, int]] = field(default_factory=list)

    def take(self, topic: str, stamp: int, first: int, n: int) -> None:
        """Keep when a block arrived."""
        self.arrivals[topic][first] = stamp

    def delays(self) -> dict[str, np.ndarray]:
        """Return how long each prediction took [ms], without and with an identification."""
        voltage, prediction = self.arrivals['voltage'], self.arrivals['prediction']
        both = [t for t in voltage if t in prediction]
        begin = np.array([voltage[t] for t in both], dtype=np.int64)
        late = 1e-6 * (np.array([prediction[t] for t in both], dtype=np.int64) - begin)
        busy = np.zeros(begin.size, dtype=bool)
        for first, last in self.busy:
            busy |= (begin >= first) & (begin <= last)
        return {'streaming': late[~busy], 'while an identification runs': late[busy]}


@dataclass
class Played:
    """What came of a program: samples sent, time taken [s], CPU of each process [%], losses."""

    seen: Seen
    samples: int
    seconds: float
    percent: dict[str, float]
    not_recorded: dict[str, int]
    not_captured: int


class Session:
    """The running graph, observed program by program."""

    def __init__(self, folder: Path) -> None:
        self.seen = Seen()
        self.graph = RunningGraph(folder, lambda *block: self.seen.take(*block))

    def play(self, seconds: float, factor: float, identify_after: float = np.inf) -> Played:
        """Play a sine to its end."""
        graph, working = self.graph, False
        graph.set('excitation', 'rate_factor', factor)
        bag = graph.folder / f'bag_{time.monotonic_ns()}'
        graph.set('recorder', 'output', str(bag))
        graph.ask('recorder/start')
        graph.wait('recorder', 'recording')
        lost = int(graph.diagnostics['identifier']['lost'])
        self.seen = seen = Seen()

        def look(elapsed: float) -> None:
            nonlocal working
            now, before = time.time_ns(), working
            working = graph.state('identifier') == 'identifying'
            if working and before:
                seen.busy[-1] = (seen.busy[-1][0], now)
            elif working:
                seen.busy.append((now, now))
            elif identify_after < elapsed < seconds - 2.0:
                graph.ask('identifier/identify')

        before = cpu_times(graph)
        samples, taken = graph.play(seconds, look)
        percent = {
            name: 100 * (t - before.get(name, 0.0)) / taken for name, t in cpu_times(graph).items()
        }
        graph.ask('recorder/stop')
        graph.wait('recorder', 'done')
        recorded = recorded_samples([bag])
        return Played(
            seen,
            samples,
            taken,
            percent,
            {topic: samples - n for topic, n in recorded.items()},
            int(graph.diagnostics['identifier']['lost']) - lost,
        )


def cpu_times(graph: RunningGraph) -> dict[str, float]:
    """Return the CPU time of each node, of what works for the identifier, and of this one [s]."""
    tick, table = os.sysconf('SC_CLK_TCK'), {}
    for path in Path('/proc').glob('[0-9]*/stat'):
        try:
            fields = path.read_text().rpartition(')')[2].split()
        except OSError:
            continue
        spent = (int(fields[11]) + int(fields[12])) / tick
        table[int(path.parent.name)] = (int(fields[1]), spent)
    times = {}
    for name, process in graph.nodes.processes.items():
        times[name] = table.get(process.pid, (0, 0.0))[1]
        if name == 'identifier':
            times['identifications'] = sum(t for p, t in table.values() if p == process.pid)
    times['observer'] = table[os.getpid()][1]
    return times


def real_time(session: Session, seconds: float) -> Iterator[str]:
    """Play in real time, and yield the tables."""
    observer = session.graph.observer
    before = observer.lost
    played = session.play(seconds, 1.0, QUIET * seconds)
    block = f'{1e3 * BLOCK / RATE:g} ms'
    yield f'## Real time: {RATE / 1000:g} kHz for {seconds:g} s, blocks of {block}'
    rows = [
        [name, late.size, *(f'{x:.2f} ms' for x in (*np.percentile(late, [50, 99]), late.max()))]
        for name, late in played.seen.delays().items()
        if late.size
    ]
    yield markdown(('delay of the prediction', 'blocks', 'p50', 'p99', 'worst'), rows)
    yield f'{len(played.seen.busy)} identifications were at work meanwhile.'
    arrived = {topic: len(blocks) for topic, blocks in played.seen.arrivals.items()}
    heads = (f'stream, {played.samples} samples', 'lost on the way here', 'lost in the bag')
    yield markdown(
        heads,
        [
            (topic, BLOCK * (arrived['voltage'] - arrived[topic]), played.not_recorded[topic])
            for topic in STREAMS
        ],
    )
    yield (
        f'The identifier lacks {played.not_captured} samples; {observer.lost - before} messages '
        'did not reach the observer.'
    )
    shares = {**played.percent, 'all': sum(played.percent.values())}
    yield markdown(('process', 'CPU, % of one core'), [(n, f'{x:.0f}') for n, x in shares.items()])


def faster(session: Session, seconds: float) -> Iterator[str]:
    """Play faster than real time, and yield the table."""
    yield '## Faster than real time'
    rows = []
    for factor in FACTORS:
        played = session.play(seconds * factor, factor)
        most = max(*played.not_recorded.values(), played.not_captured)
        reached = played.samples / RATE / played.seconds
        cpu = f'{sum(played.percent.values()):.0f}'
        rows.append((f'{factor:g}', f'{reached:.2f}', most, cpu))
    yield markdown(('rate_factor', 'reached', 'samples lost', 'CPU, % of one core'), rows)


def main() -> int:
    """Run everything, print and write the page."""
    parser = argparse.ArgumentParser(description='Measures the running graph.')
    parser.add_argument('--seconds', type=float, default=300.0, help='length in real time')
    parser.add_argument('--fast-seconds', type=float, default=15.0, help='of each faster run')
    parser.add_argument('--out', type=Path, help='page to write')
    args = parser.parse_args()
    from lab_graph import own_domain

    own_domain()
    parts = [
        '# The running graph, measured',
        'This page shows the delays and losses of the nodes on one machine, measured by',
        f'    .venv/bin/python benchmarks/bench_live.py {shlex.join(sys.argv[1:])}',
        f'On {machine()}; load average before it {os.getloadavg()[0]:.1f}.',
        'Excitation, stage, identifier, model and recorder, each a process of its own, and an '
        'observer.\nA delay is that from the receipt of a block of voltage to the receipt of its '
        'prediction,\nmatched by t, in the observer.',
    ]
    with tempfile.TemporaryDirectory() as folder:
        session = Session(Path(folder))
        with session.graph as graph:
            graph.ask('identifier/run')
            graph.wait('identifier', 'done', 180.0)
            graph.wait('model', 'predicting')
            for part in itertools.chain(
                real_time(session, args.seconds), faster(session, args.fast_seconds)
            ):
                print(part, end='\n\n', flush=True)
                parts.append(part)
    if args.out:
        args.out.write_text('\n\n'.join(parts) + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Blocks of all sizes, several stages at once, and how soon a node is there.

    .venv/bin/python benchmarks/bench_stages.py --out docs/live_stages.md

A delay is that from the receipt of a block of voltage to the receipt of its prediction, matched by
t, in one observing process; excitation, stage and model run in real time at 20 kHz.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import itertools
import os
from pathlib import Path
import random
import shlex
import sys
import tempfile
import time

from bench_live import Fetcher, machine, RATE, Shares, sine
import numpy as np
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.model.simulated_stage import SimulatedStage

SIZES = (20, 50, 100, 200, 500, 1000)
#: stages that are tried at most
MOST = 8
#: starts of each node
STARTS = 5
#: the nodes of a stage, and what each is told
NODES = ('stage', 'model', 'excitation')


class Watch(Fetcher):
    """Keeps when the blocks of some topics arrived, by their last t, or only counts them."""

    def __init__(self, client, topics: list[str], *, read: bool = True) -> None:
        self.arrivals: dict[str, dict[float, int]] = {topic: {} for topic in topics}
        self._read = read
        super().__init__(client, topics)

    def arrived(self, stamp: int, topic: str, raw: bytes) -> None:
        """Keep when a block arrived."""
        seen = self.arrivals[topic]
        seen[self.data(raw)[-2] if self._read else len(seen)] = stamp


class Bench:
    """Graphs of one or more stages, started for a measurement and ended behind it."""

    def __init__(self, client, folder: Path, seconds: float) -> None:
        self.client, self.folder, self.seconds = client, folder, seconds
        self.model = folder / 'model.yaml'
        SimulatedStage.load('paper').model.save(self.model)

    def play(
        self, spaces: list[str], size: int, *, read: bool = True
    ) -> tuple[Watch, dict[str, float], float]:
        """Play a sine to every stage, and return what was seen, CPU shares and the time taken."""
        from lab_graph import Nodes

        client = self.client
        with Nodes(self.folder / 'log') as nodes:
            told = {
                'stage': {},
                'model': {'model': str(self.model)},
                'excitation': {'subscribers': 2, 'block_size': size},
            }
            names = [f'{space}/{name}' for space in spaces for name in NODES]
            for name in names:
                client.follow(name)
                client.forget(name)
            for space in spaces:
                for name in NODES:
                    nodes.start(name, namespace=space, parameters=told[name])
            client.wait(
                lambda: all(client.status(name).get('state') for name in names), 60.0, 'the nodes'
            )
            topics = [f'/{s}/{t}' for s in spaces for t in ('voltage', 'prediction')]
            watch = Watch(client, topics, read=read)
            for space in spaces:
                node = f'{space}/excitation'
                done, reason = client.set(node, 'program', sine(self.seconds), timeout=30.0)
                if not done:
                    raise PiezoIdentError(reason)
            for space in spaces:
                done, reason = client.call(f'{space}/excitation/start', timeout=30.0)
                if not done:
                    raise PiezoIdentError(reason)
            drives = [f'{space}/excitation' for space in spaces]
            client.wait(
                lambda: all(client.status(d).get('state') == 'running' for d in drives),
                30.0,
                'all to run',
            )
            began, shares = time.monotonic(), Shares(nodes)
            client.wait(
                lambda: all(client.status(d).get('state') != 'running' for d in drives),
                10.0 * self.seconds,
                'the end of the programmes',
            )
            taken, percent = time.monotonic() - began, shares.percent()
            time.sleep(1.0)
            watch.close()
        return watch, percent, taken


def delays(watch: Watch, space: str) -> np.ndarray:
    """Return how long each prediction took [ms]."""
    voltage, prediction = (watch.arrivals[f'/{space}/{t}'] for t in ('voltage', 'prediction'))
    both = [t for t in voltage if t in prediction]
    return 1e-6 * np.array([prediction[t] - voltage[t] for t in both], dtype=float)


def missing(watch: Watch, space: str) -> int:
    """Return how many blocks have no prediction."""
    seen = [len(watch.arrivals[f'/{space}/{t}']) for t in ('voltage', 'prediction')]
    return seen[0] - seen[1]


def row(what: str, watch: Watch, space: str, percent: dict[str, float]) -> str:
    """Return a row of delays."""
    late = delays(watch, space)
    p50, p99 = np.percentile(late, [50, 99])
    cpu = sum(share for name, share in percent.items() if name != 'observer')
    return (
        f'| {what} | {late.size} | {p50:.2f} ms | {p99:.2f} ms | {late.max():.2f} ms | '
        f'{missing(watch, space)} | {cpu:.0f} |'
    )


HEAD = (
    '| | blocks | p50 | p99 | worst | blocks without | CPU, % of one core |',
    '|---|---|---|---|---|---|---|',
)


def blocks(bench: Bench) -> Iterator[str]:
    """Yield the table over sizes of blocks."""
    yield '## Samples in a block'
    yield ''
    yield from HEAD
    for size in SIZES:
        watch, percent, _ = bench.play(['a'], size)
        yield row(f'{size} ({1e3 * size / RATE:g} ms)', watch, 'a', percent)


def stages(bench: Bench) -> Iterator[str]:
    """Yield the table over stages, up to the first block that is lost."""
    yield '## Stages at once, each with excitation, stage and model, blocks of 100'
    yield ''
    yield '| stages | blocks sent | without prediction | programme took | CPU, % of one core |'
    yield '|---|---|---|---|---|'
    carried = 0
    for count in range(1, MOST + 1):
        spaces = [f's{k}' for k in range(count)]
        watch, percent, taken = bench.play(spaces, 100, read=False)
        sent = sum(len(watch.arrivals[f'/{s}/voltage']) for s in spaces)
        gone = sum(missing(watch, s) for s in spaces)
        yield (
            f'| {count} | {sent} | {gone} | {taken:.1f} s of {bench.seconds:g} s | '
            f'{sum(percent.values()):.0f} |'
        )
        # a programme that takes much longer is no real time any more
        if gone or watch.lost or taken > 1.1 * bench.seconds + 3.0:
            break
        carried = count
    yield ''
    yield f'Carried without a loss: {carried}.'


def starts(bench: Bench) -> Iterator[str]:
    """Yield the table of the time from the start of a process to its first status."""
    yield '## From the start of a node to its first status, the best and the median'
    yield ''
    yield '| node | best | median |'
    yield '|---|---|---|'
    from lab_graph import Nodes

    client = bench.client
    for name in ('excitation', 'stage', 'model', 'identifier', 'recorder', 'player'):
        times = []
        for k in range(STARTS):
            space = f'n{k}'
            client.follow(f'{space}/{name}')
            with Nodes(bench.folder / 'log') as nodes:
                parameters = {'model': str(bench.model)} if name == 'model' else {}
                began = time.monotonic()
                nodes.start(name, namespace=space, parameters=parameters)
                client.wait(
                    lambda n=f'{space}/{name}': client.status(n).get('state'), 60.0, 'a node'
                )
                times.append(time.monotonic() - began)
            client.forget(f'{space}/{name}')
        yield f'| {name} | {min(times):.2f} s | {np.median(times):.2f} s |'
    yield ''
    yield (
        'Kernels are compiled once and cached; a model node says that it predicts when its first '
        'block can be in time.'
    )


def main() -> int:
    """Run everything, print and write the page."""
    parser = argparse.ArgumentParser(description='Measures blocks, stages, starts.')
    parser.add_argument('--seconds', type=float, default=10.0, help='of each programme')
    parser.add_argument('--out', type=Path, help='page to write')
    args = parser.parse_args()
    os.environ['ROS_DOMAIN_ID'] = str(random.SystemRandom().randint(1, 101))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    sys.path.insert(0, str(Path(__file__).resolve().parents[1] / 'examples'))
    from lab_graph import Client

    lines = [
        '# Blocks, stages, starts',
        '',
        f'    .venv/bin/python benchmarks/bench_stages.py {shlex.join(sys.argv[1:])}',
        '',
        f'On {machine()}; load average before it {os.getloadavg()[0]:.1f}.',
        '',
    ]
    with tempfile.TemporaryDirectory() as folder, Client('observer') as client:
        bench = Bench(client, Path(folder), args.seconds)
        for line in itertools.chain(blocks(bench), [''], stages(bench), [''], starts(bench)):
            print(line, flush=True)
            lines.append(line)
    if args.out:
        args.out.write_text('\n'.join(lines) + '\n', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())

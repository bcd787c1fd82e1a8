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
from dataclasses import dataclass
import itertools
from pathlib import Path
import shutil
import sys
import tempfile
import time

import numpy as np

HERE = Path(__file__).resolve()
sys.path[:0] = [str(HERE.parent), str(HERE.parents[1])]

from rows import processors, shares, write_rows
from running_graph import BLOCK, NODES, RATE, recorded_samples, RunningGraph, STREAMS
import yaml

#: how often memory is looked at [s]
LOOK = 2.0
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


class Streams:
    """What passed of each topic; of each program (machine's time, samples' time) of blocks [s]."""

    def __init__(self) -> None:
        self.of = {topic: Stream() for topic in STREAMS}
        self.clocks: list[list[tuple[float, float]]] = []

    def take(self, topic: str, stamp: int, first: int, n: int) -> None:
        """Take note of a block."""
        stream = self.of[topic]
        runs = stream.runs
        stream.take(first, n)
        if topic == 'voltage':
            if stream.runs > runs:
                self.clocks.append([])
            # a few a second say enough
            if first % 4000 == 0:
                self.clocks[-1].append((1e-9 * stamp, first / RATE))


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

    `seconds`: of program; `samples`: of the programs; `lost`: samples that are missing, by stream
    at the observer, and by where the graph counts; `memory`: MB, MB, MB/h and MB/h, after the
    first quarter; `drift`: of the sample clock against that of the machine [s/s], and what it is
    known to; `late`: blocks that the excitation sent after the next was due; `slipped`: by how
    much its schedule moved [s]; `parts`: of the recording; `recorded`: samples of each stream in
    all parts.
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
    recorded: dict[str, int]

    def lines(self) -> Iterator[str]:
        """Yield what is printed."""
        yield f'{self.seconds:g} s, {self.samples:,} samples'
        for name, (first, last, k, error) in self.memory.items():
            yield f'{name}: {first:.1f} -> {last:.1f} MB, {k:+.2f} +- {error:.2f} MB/h'
        yield f'lost: {self.lost}'
        yield f'sample clock: {1e6 * self.drift:+.2f} +- {1e6 * self.drift_error:.2f} us/s'
        yield f'late blocks: {self.late}, schedule moved by {self.slipped:g} s'
        yield f'recording: {self.parts} parts, {self.recorded}'


def soak(seconds: float, factor: float, part: int, folder: Path, size: int = BLOCK) -> Soak:
    """
    Run the graph.

    `seconds`: length of all programs together; `factor`: `rate_factor` of the excitation; 1 is
    real time; `part`: size of a part of the recording [bytes]; `folder`: for bags and logs;
    `size`: samples in a block.
    """
    data = yaml.safe_load(MODEL.read_text())
    model = folder / 'model.yaml'
    model.write_text(yaml.safe_dump({k: data[k] for k in data if k not in ('sensor', 'seed')}))
    parameters = {
        'stage': {'silence': 5.0},
        'identifier': {'capture_limit': min(60.0, max(1.0, seconds / 4))},
        # of the preview, too, a topic keeps so many messages and no more
        'model': {'model': str(model), 'preview_rate': 50.0 * BLOCK / size},
        'recorder': {'max_bag_size': part},
        # the recorder and the observer listen too
        'excitation': {'subscribers': 5, 'rate_factor': factor, 'block_size': size},
    }
    streams, samples, late, slipped = Streams(), 0, 0, 0.0
    times: list[float] = []
    sizes: dict[str, list[float]] = {name: [] for name in NODES}

    with RunningGraph(folder, streams.take, parameters) as graph:

        def look(_: float) -> None:
            now = time.monotonic()
            if not times or now - times[-1] > LOOK:
                times.append(now)
                for name in NODES:
                    sizes[name].append(memory(graph.nodes.processes[name].pid))

        graph.ask('recorder/start')
        graph.wait('recorder', 'recording')
        for start in np.arange(0.0, seconds, LONGEST):
            samples += graph.play(min(LONGEST, seconds - start), look)[0]
            late += int(graph.diagnostics['excitation'].get('late', '0'))
            slipped += float(graph.diagnostics['excitation'].get('slipped', '0'))
        graph.ask('recorder/stop')
        graph.wait('recorder', 'done')
        time.sleep(1.5)
        told = graph.diagnostics
    parts = sorted(folder.glob('bag*'))
    recorded = recorded_samples(parts)
    lost = {f'{topic} at the observer': samples - streams.of[topic].samples for topic in STREAMS}
    lost['messages to the observer'] = graph.observer.lost
    lost |= {f'by the {name}': int(told[name]['lost']) for name in NODES[:3]}
    lost['messages to the recorder'] = int(told['recorder']['lost'])
    lost |= {f'{topic} in the bag': samples - n for topic, n in recorded.items()}
    t = (np.array(times) - times[0]) / 3600.0
    quarter = t >= 0.25 * t[-1]
    drift, error = clock_drift(streams.clocks)
    return Soak(
        seconds,
        samples,
        {where: n for where, n in lost.items() if n},
        {
            name: (x[0], x[-1], *slope(t[quarter] * 3600.0, np.array(x)[quarter] * 3600.0))
            for name, x in sizes.items()
        },
        drift,
        error,
        late,
        slipped,
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


def main() -> int:
    """Run it, and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--seconds', type=float, default=7200.0)
    parser.add_argument('--factor', type=float, default=1.0, help='rate_factor; 1 is real time')
    parser.add_argument('--part', type=int, default=500_000_000, help='bytes of a part of the bag')
    parser.add_argument('--folder', type=Path, help='for the bags; a temporary one when absent')
    args = parser.parse_args()
    from lab_graph import own_domain

    own_domain()
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
    what = f'the whole graph at 20 kHz for {found.seconds / 60:g} min {pace}, recording in parts'
    result = (
        f'{lost}; memory in MB/h: {growth}; sample clock {1e6 * found.drift:+.1f} ± '
        f'{1e6 * found.drift_error:.1f} µs/s against that of the machine, of whose schedule '
        f'{found.slipped:.1f} s were lost where blocks came too late ({found.late}); '
        f'{found.parts} parts'
    )
    command = f'python benchmarks/reliability/soak.py --seconds {found.seconds:g}'
    command += f' --factor {args.factor:g}' if args.factor != 1.0 else ''
    write_rows('soak', [(what, f'1 run, {found.samples:,} samples, {load}', result)], command)
    return 0


if __name__ == '__main__':
    sys.exit(main())

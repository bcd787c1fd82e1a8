# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
A folder of records identified on one process, on all cores, and on two workers of a cluster.

    .venv-bench/bin/python benchmarks/bench_many.py [--quick]

The whole command is timed, start-up included, since that is what one waits for.  The
records are short, so that 200 of them fit into a benchmark; one of them is damaged.  The scheduler
and the workers of dask.distributed run before the clock starts.
"""

from __future__ import annotations

from dataclasses import replace
import os
from pathlib import Path
import shutil
import subprocess
import sys
import tempfile

# before NumPy is loaded here, and in all that is started from here
for name in ('OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS', 'OMP_NUM_THREADS'):
    os.environ.setdefault(name, '1')

from distributed import LocalCluster
import numpy as np
import piezo_ident as pi
from piezo_ident.excitation.program import parse_program
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.simulated_stage import Sensor, SimulatedStage
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis
from side_by_side import markdown, ratio, show, take_turns

HOME = Path(__file__).resolve().parents[1]
#: turns, and records, of which one is damaged
RUNS, RECORDS = 5, 200
WORKERS = 2
RATE = 2000.0
PROGRAM = """\
limits: [0, 10]
seed: 1
segments:
  - {signal: idle, duration: 0.3}
  - {signal: step, bias: 5, size: 1, hold: 0.06, count: 8}
  - {signal: settle, bias: 5, amplitude: 0.48, cycles: 12, frequency: 20}
  - {signal: noise, bias: 5, amplitude: 0.4, cutoff: 600, duration: 3}
  - {signal: triangle, slope: 10}
  - {signal: sine, bias: 5, amplitude: 4, frequency: 20, duration: 1.5}
"""
OPTIONS = ('--max-order', '4', '--thresholds', '6', '--solver', 'least_squares')


def make_records(folder: Path, n: int) -> None:
    """Write n records of stages whose gain falls as their line ages; one file is damaged."""
    folder.mkdir()
    rng = np.random.default_rng(5)
    model = StageModel(
        sample_rate=RATE,
        scaling=Scaling(0.0, 10.0, 0.0, 75e-6, (0.0, 10.0)),
        hysteresis=Hysteresis([0.2, 0.4, 0.6], [0.3, 0.2, 0.1], p1=-0.2, p2=0.9),
        dynamics=Dynamics([-1.2, 0.5], [0.2, 0.1]),
        delay=Delay(2),
    )
    sequence = parse_program(PROGRAM).build(RATE)
    for i in range(n):
        gain = 1.0 + 0.006 * rng.standard_normal() - 0.04 * i / n
        scaling = replace(model.scaling, Y=model.scaling.Y * gain)
        stage = SimulatedStage(replace(model, scaling=scaling), Sensor(noise_rms=5e-9))
        pi.write(stage.play(sequence, rng), folder / f'stage_{i + 1:03d}.npz')
    broken = folder / f'stage_{2 * n // 3:03d}.npz'
    broken.write_bytes(broken.read_bytes()[:20_000])


def identify(records: Path, out: Path, *options: str) -> None:
    """Run the command as a user would."""
    shutil.rmtree(out, ignore_errors=True)
    command = [sys.executable, '-m', 'piezo_ident', 'identify', str(records), '--each', str(out)]
    # the same package as here, wherever a process starts
    paths = os.pathsep.join([str(HOME), os.environ.get('PYTHONPATH', '')])
    environment = os.environ | {'PYTHONPATH': paths}
    done = subprocess.run(
        [*command, *OPTIONS, *options], env=environment, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip() or f'exit code {done.returncode}')


def contents(out: Path) -> dict[str, bytes]:
    """Return what must not depend on where the work was done: the table and all models."""
    files = [out / 'records.csv', *sorted((out / 'models').iterdir())]
    return {str(path.relative_to(out)): path.read_bytes() for path in files}


def sections(quick: bool = False) -> list[tuple[str, str]]:
    """Return titles and texts; fail where the tables of the three places differ."""
    runs, n = (1, 12) if quick else (RUNS, RECORDS)
    cores = len(os.sched_getaffinity(0))
    many = max(2, cores)
    with tempfile.TemporaryDirectory(prefix='bench_many.') as name:
        folder = Path(name)
        records, few = folder / 'records', folder / 'few'
        make_records(records, n)
        few.mkdir()
        for path in sorted(records.iterdir())[: 2 * WORKERS]:
            shutil.copy(path, few)
        with LocalCluster(
            n_workers=WORKERS, threads_per_worker=1, dashboard_address=None
        ) as cluster:
            options = {
                'one process': ('--jobs', '1'),
                f'{many} processes': ('--jobs', str(many)),
                f'{WORKERS} dask workers': ('--scheduler', cluster.scheduler_address),
            }
            # kernels are compiled on their first call, and the workers import on theirs
            for chosen in options.values():
                identify(few, folder / 'warm', *chosen)
            works = {
                place: lambda k, p=place, o=chosen: identify(records, folder / p, *o)
                for place, chosen in options.items()
            }
            turns = take_turns(works, runs)
        first, *others = (contents(folder / place) for place in options)
        if any(other != first for other in others):
            raise RuntimeError('the tables of the three places differ')
    rows = first['records.csv'].decode().splitlines()[1:]
    failed = sum(',failed,' in row for row in rows)
    heads = ('where', 'whole command', 'records a second', 'speed-up')
    one = next(iter(turns.values()))
    table = [
        (place, f'{t.median:.1f} s', f'{n / t.median:.1f}', ratio(one.over(t)))
        for place, t in turns.items()
    ]
    seconds = len(parse_program(PROGRAM).build(RATE).v) / RATE
    text = [
        f'{n} records of {seconds:.1f} s at {RATE / 1000:g} kHz in a folder, one of them damaged: '
        f'`piezo_ident identify FOLDER --each OUT {" ".join(OPTIONS)}`, with `--jobs` or '
        f'`--scheduler`. Medians over {runs} turn{"s" if runs > 1 else ""}, on {cores} cores.',
        '',
        markdown(heads, table),
        '',
        f'The three tables ({len(rows)} rows, {failed} failed) and the {len(first) - 1} models '
        'are the same byte for byte.',
    ]
    return [('Many records', '\n'.join(text))]


if __name__ == '__main__':
    show(sections)

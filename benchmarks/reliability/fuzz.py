# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""
Hostile files and messages: every reader, a million inputs and more.

    .venv/bin/python benchmarks/reliability/fuzz.py                 all of it, about half an hour
    .venv/bin/python benchmarks/reliability/fuzz.py --scale 0.01    a look whether it runs

Each reader gets inputs of the right structure and the wrong contents from hypothesis, and bytes
that atheris (libFuzzer) derives from small valid files while it watches which lines of the readers
they reach.  Only the package's own errors may come out; an input that takes longer than ten
seconds, or more than 2 GB, is a finding too.
"""

from __future__ import annotations

import argparse
from importlib.util import find_spec
import json
import os
from pathlib import Path
import re
import subprocess
import sys
import tempfile
import time
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from reliability.rows import read_rows, write_rows

#: inputs of a whole study: from atheris, from hypothesis
COUNTS = {
    'wire': (450_000, 3_000),
    'message': (200_000, 2_000),
    'effect': (150_000, 3_000),
    'csv': (150_000, 3_000),
    'npz': (60_000, 3_000),
    'mat': (60_000, 3_000),
    'mcap': (8_000, 500),
    'sqlite3': (5_000, 500),
    'metadata': (5_000, 1_000),
    'model': (10_000, 1_000),
    'stage': (5_000, 1_000),
    'programme': (10_000, 2_000),
}
SECONDS, MEGABYTES, LONGEST = 10, 2048, 40_000
#: what atheris watches
WATCHED = [f'piezo_ident.{room}' for room in ('common', 'excitation', 'model', 'record')]


def with_atheris(name: str, count: int, folder: Path) -> None:
    """Run atheris in this process, which ends with it."""
    # what atheris has put its counters into cannot be compiled
    os.environ['NUMBA_DISABLE_JIT'] = '1'
    import atheris

    with atheris.instrument_imports(include=WATCHED):
        from reliability.targets import attempt, seeds

    corpus = folder / 'corpus'
    corpus.mkdir()
    for i, data in enumerate(seeds(name, folder)):
        (corpus / str(i)).write_bytes(data)
    atheris.Setup(
        [
            'fuzz',
            f'-runs={count}',
            f'-timeout={SECONDS}',
            f'-rss_limit_mb={MEGABYTES}',
            f'-max_len={LONGEST}',
            f'-artifact_prefix={folder}/',
            '-print_final_stats=1',
            '-verbosity=0',
            '-seed=1',
            str(corpus),
        ],
        lambda data: attempt(name, data, folder) and None,
    )
    atheris.Fuzz()


def with_hypothesis(name: str, count: int, folder: Path) -> None:
    """Run hypothesis in this process."""
    from hypothesis import given, HealthCheck, seed, settings
    from reliability.shapes import shapes
    from reliability.targets import attempt

    tried, slowest = 0, 0.0

    @seed(1)
    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=shapes(name, folder))
    def run(data: bytes) -> None:
        nonlocal tried, slowest
        start = time.process_time()
        tried += 1
        attempt(name, data, folder)
        slowest = max(slowest, time.process_time() - start)
        assert slowest < SECONDS

    run()
    print(f'stat::number_of_executed_units: {tried}')
    print(f'stat::slowest_unit_time_sec: {slowest:.1f}')


ENGINES = {'atheris': with_atheris, 'hypothesis': with_hypothesis}


def study(name: str, engine: str, count: int, keep: Path) -> dict[str, Any]:
    """Return what one engine found with one target, run in a process of its own."""
    start = time.perf_counter()
    # in memory where there is such a folder: every input is a file
    shm = Path('/dev/shm')
    with tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None) as place:
        done = subprocess.run(
            [sys.executable, __file__, '--one', engine, name, str(count), place],
            capture_output=True,
            text=True,
            errors='replace',
        )
        for artifact in Path(place).glob('*-*'):
            if artifact.is_file():
                keep.mkdir(parents=True, exist_ok=True)
                (keep / f'{name}-{artifact.name}').write_bytes(artifact.read_bytes())
    text = done.stdout + done.stderr

    def stat(key: str) -> float:
        found = re.findall(rf'stat::{key}:\s*([\d.]+)', text)
        return float(found[-1]) if found else 0.0

    return {
        'name': name,
        'engine': engine,
        'tried': int(stat('number_of_executed_units')),
        'slowest': stat('slowest_unit_time_sec'),
        'peak': int(stat('peak_rss_mb')),
        'seconds': time.perf_counter() - start,
        'failed': '' if done.returncode == 0 else text[-3000:],
    }


def refreshed(found: list[dict[str, Any]], before: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows of the table: those of earlier runs, with what was found now."""
    rows = {row['what']: row for row in before}
    for name in COUNTS:
        mine = [x for x in found if x['name'] == name]
        if not mine:
            continue
        failed = sum(bool(x['failed']) for x in mine)
        slowest, peak = max(x['slowest'] for x in mine), max(x['peak'] for x in mine)
        memory = f', at most {peak} MB in all' if peak else ''
        good = f'only errors of the package; no input took more than {slowest:.1f} s{memory}'
        rows[f'hostile input: {name}'] = {
            'what': f'hostile input: {name}',
            'how_often': ', '.join(f'{x["tried"]:,} ({x["engine"]})' for x in mine),
            'result': f'{failed} runs with a finding' if failed else good,
            'command': f'python benchmarks/reliability/fuzz.py --only {name}',
            'tried': sum(x['tried'] for x in mine),
            'failed': failed,
            'seconds': sum(x['seconds'] for x in mine),
        }
    parts = [rows[what] for what in (f'hostile input: {name}' for name in COUNTS) if what in rows]
    minutes = sum(row['seconds'] for row in parts) / 60
    whole = {
        'what': f'hostile input: all {len(parts)} readers',
        'how_often': f'{sum(row["tried"] for row in parts):,} inputs',
        'result': f'{sum(row["failed"] for row in parts)} runs with a finding; {minutes:.0f} min',
        'command': 'make fuzz',
    }
    return [*parts, whole]


def main() -> int:
    """Run the study; 1 when something was found."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--scale', type=float, default=1.0, help='of the number of inputs')
    parser.add_argument('--only', nargs='+', choices=list(COUNTS), default=list(COUNTS))
    parser.add_argument('--keep', type=Path, default=Path('fuzz_findings'), help='folder')
    parser.add_argument('--one', nargs=4, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        engine, name, count, folder = args.one
        ENGINES[engine](name, int(count), Path(folder))
        return 0
    found = []
    has_atheris = find_spec('atheris') is not None
    if not has_atheris:
        print('atheris is not installed (it has wheels for Python 3.11 to 3.13): hypothesis alone')
    for name in args.only:
        for engine, count in zip(ENGINES, COUNTS[name], strict=True):
            if engine == 'atheris' and not has_atheris:
                continue
            one = study(name, engine, max(10, int(count * args.scale)), args.keep)
            found.append(one)
            print(json.dumps({k: v for k, v in one.items() if k != 'failed'}), flush=True)
            if one['failed']:
                print(one['failed'], flush=True)
    if args.scale == 1.0 and has_atheris:
        write_rows('fuzz', refreshed(found, read_rows('fuzz')))
    return 1 if any(x['failed'] for x in found) else 0


if __name__ == '__main__':
    sys.exit(main())

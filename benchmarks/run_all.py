# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Runs every benchmark and writes docs/benchmarks.md.

    .venv-bench/bin/python benchmarks/run_all.py --out docs/benchmarks.md [--quick] [--only NAME]

A benchmark is a file ``bench_*.py`` beside this one with a function

    def sections(quick: bool = False) -> list[tuple[str, str]]

that returns titles and texts in Markdown.  Each runs in a process of its own, so that none
disturbs another and one that lacks a library fails alone: it becomes a section that says why, and
the exit code is 1.
"""

from __future__ import annotations

import argparse
import ast
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import importlib
import json
import os
from pathlib import Path
import shlex
import signal
import subprocess
import sys
import tempfile
import time

from side_by_side import machine, PEERS

HERE = Path(__file__).resolve().parent
#: benchmarks in the order of the page; others follow by name
ORDER = (
    'prediction',
    'export',
    'inverse',
    'identification',
    'peers_arx',
    'peers_swarm',
    'peers_hysteresis',
    'growth',
    'many',
)
#: longest that one benchmark may take [s]
LIMIT = 7200.0


@dataclass(frozen=True)
class Outcome:
    """What one benchmark gave: its sections, or why it has none; and how long it took [s]."""

    name: str
    sections: tuple[tuple[str, str], ...]
    reason: str
    seconds: float


def benchmarks(folder: Path = HERE) -> list[Path]:
    """Return the files with a function `sections`, in the order of the page, without running."""

    def has_sections(path: Path) -> bool:
        tree = ast.parse(path.read_text(encoding='utf-8'))
        return any(isinstance(n, ast.FunctionDef) and n.name == 'sections' for n in tree.body)

    place = {f'bench_{name}': i for i, name in enumerate(ORDER)}
    found = filter(has_sections, folder.glob('bench_*.py'))
    return sorted(found, key=lambda path: (place.get(path.stem, len(ORDER)), path.stem))


def work(path: Path, quick: bool, out: Path) -> None:
    """Run one benchmark in this process, and write what it returns as JSON."""
    sys.path.insert(0, str(path.parent))
    # a benchmark that starts processes of its own has to be found by its name there
    module = importlib.import_module(path.stem)
    pairs = [(str(title), str(text)) for title, text in module.sections(quick=quick)]
    out.write_text(json.dumps(pairs), encoding='utf-8')


def run(path: Path, quick: bool, limit: float = LIMIT) -> Outcome:
    """Run one benchmark in a process of its own."""
    began = time.perf_counter()
    sections: tuple[tuple[str, str], ...] = ()
    with tempfile.TemporaryDirectory() as folder:
        out, log = Path(folder, 'sections.json'), Path(folder, 'log')
        command = [sys.executable, str(Path(__file__).resolve()), '--work', str(path)]
        command += ['--out', str(out), *(['--quick'] if quick else [])]
        with log.open('wb') as target:
            process = subprocess.Popen(
                command,
                stdout=target,
                stderr=subprocess.STDOUT,
                # one thread of BLAS for ours and for the peers
                env=os.environ | {'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1'},
                start_new_session=True,
            )
            try:
                process.wait(limit)
                lines = log.read_text(encoding='utf-8', errors='replace').strip().splitlines()
                reason = (lines or ['no output'])[-1] if process.returncode else ''
            except subprocess.TimeoutExpired:
                reason = f'it took more than {limit:g} s'
            finally:
                if process.poll() is None:
                    # with all that it has started
                    os.killpg(process.pid, signal.SIGKILL)
                    process.wait()
        if not reason:
            sections = tuple(map(tuple, json.loads(out.read_text(encoding='utf-8'))))
    return Outcome(path.stem, sections, reason, time.perf_counter() - began)


def page(outcomes: Iterable[Outcome], command: str, load: float) -> str:
    """Return docs/benchmarks.md."""
    outcomes = list(outcomes)
    text = [
        '# Benchmarks',
        '',
        'This page shows how fast the package is and how large its errors are, beside other',
        'libraries, as written by',
        '',
        f'    {command}',
        '',
        f'Machine: {machine(PEERS)}. Load average before: {load:.2f}.',
        '',
        'The works of a table ran in turns in one process, with one thread of BLAS. Times and',
        'ratios are medians over the turns. Only ratios hold on another machine. Errors are those',
        'of free runs over data that were not fitted.',
    ]
    for outcome in outcomes:
        if outcome.reason:
            text += ['', f'## `{outcome.name}` failed', '', f'No result: {outcome.reason}']
        for title, body in outcome.sections:
            text += ['', f'## {title}', '', body.strip()]
    text += ['', f'All took {sum(outcome.seconds for outcome in outcomes):.0f} s.', '']
    return '\n'.join(text)


def main(argv: Sequence[str] | None = None, folder: Path = HERE) -> int:
    """Run what is asked for, and return the exit code."""
    parser = argparse.ArgumentParser(description='Runs the benchmarks and writes one page.')
    parser.add_argument('--out', type=Path, required=True, help='page to write')
    parser.add_argument('--quick', action='store_true', help='short versions of all')
    parser.add_argument(
        '--only', nargs='+', metavar='NAME', help='some of them: growth, many, ...'
    )
    parser.add_argument('--work', type=Path, help=argparse.SUPPRESS)
    given = list(sys.argv[1:] if argv is None else argv)
    args = parser.parse_args(given)
    if args.work:
        work(args.work, args.quick, args.out)
        return 0
    load = os.getloadavg()[0]
    names = {path.stem.removeprefix('bench_'): path for path in benchmarks(folder)}
    unknown = sorted(set(args.only or ()) - set(names))
    if unknown:
        parser.error(f'no benchmark {", ".join(unknown)}; there are {", ".join(names)}')
    outcomes = []
    for name, path in names.items():
        if args.only and name not in args.only:
            continue
        print(f'{name} ...', flush=True)
        outcomes.append(run(path, args.quick))
        failed = outcomes[-1].reason and f': failed: {outcomes[-1].reason}'
        print(f'{name} {outcomes[-1].seconds:.0f} s{failed}', flush=True)
    command = shlex.join(['python', 'benchmarks/run_all.py', *given])
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(page(outcomes, command, load), encoding='utf-8')
    return 1 if any(outcome.reason for outcome in outcomes) else 0


if __name__ == '__main__':
    # ended from outside it ends what it has started
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    sys.exit(main())

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""
Killed while writing: what stands there afterwards is the old, the new, or nothing.

    .venv/bin/python benchmarks/reliability/crash.py             100 kills, a few minutes
    .venv/bin/python benchmarks/reliability/crash.py --kills 5   a look whether it runs

Each command runs in a process of its own and gets SIGKILL: every second time at a random moment of
its run, else as soon as a temporary name shows that it writes.  Then, as root, the same commands
write to a disk without room and to a folder that cannot be written.
"""

from __future__ import annotations

import os

os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
import hashlib
import json
from pathlib import Path
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import numpy as np
import piezo_ident as pi
from piezo_ident.cli import main as piezo_ident
from piezo_ident.common.errors import PiezoIdentError
from piezo_ident.common.files import write_together
from piezo_ident.record.record import Piece, Record
from piezo_ident.report.figures import identification  # noqa: F401 - loaded once, not per copy
from reliability.rows import write_rows

#: kills of a whole study
KILLS = {'save': 16, 'report': 10, 'convert': 36, 'simulate': 10, 'predict': 10, 'identify': 10,
         'diagnose': 8}  # fmt: skip
#: what may stand there after a kill
GOOD = frozenset({'old', 'new', 'old and new'})
#: names of what a killed process may leave behind
LEFTOVER = re.compile(r'\..+\.tmp')
FORMATS = ('r.csv', 'r.npz', 'r.mat', 'r.mcap', 'r.db3', 'bag')
RATE = 20_000.0


@dataclass(frozen=True)
class Job:
    """Work that writes `outputs` into the folder that `run` is given; it returns the exit code."""

    kind: str
    name: str
    run: Callable[[Path], int]
    outputs: tuple[str, ...]


def record(n: int, seed: int = 1) -> Record:
    """Return a record of a sine."""
    rng = np.random.default_rng(seed)
    v = 5.0 + 4.0 * np.sin(np.arange(n) / 700.0)
    return Record((Piece(v, 7.5e-6 * v + 1e-9 * rng.standard_normal(n), RATE),))


def _save(folder: Path) -> int:
    model = pi.SimulatedStage.load('paper').model
    for _ in range(100):
        model.save(folder / 'model.yaml')
    return 0


def _report(folder: Path) -> int:
    files = {'numbers.json': b'{}', 'loops.png': bytes(300_000), 'report.html': b'x' * 300_000}
    for _ in range(40):
        write_together(folder, files)
    return 0


def jobs(inputs: Path, *, slow: bool) -> list[Job]:
    """Return the work, `slow` with identification and diagnosis, and make what it reads."""
    stage, samples, program = (inputs / x for x in ('model.yaml', 'record.npz', 'program.yaml'))
    pi.SimulatedStage.load('paper').model.save(stage)
    pi.write(record(60_000), samples, overwrite=True)
    program.write_text('{limits: [0, 10], segments: [{signal: hold, level: 5, duration: 2}]}')

    def command(kind: str, words: str, *outputs: str) -> Job:
        given = [word for word in words.split() if not word.startswith('-')]
        name = f'{kind} to {given[-1][4:]}' if kind == 'convert' else kind
        places = {'STAGE': stage, 'SAMPLES': samples, 'PROGRAM': program, 'IN': inputs}

        def run(folder: Path) -> int:
            line = [kind]
            for word in words.split():
                head, _, name = word.partition('/')
                place = {**places, 'OUT': folder}.get(head)
                line.append(word if place is None else str(place / name))
            return piezo_ident(line)

        return Job(kind, name, run, outputs)

    works = [
        Job('save', 'save', _save, ('model.yaml',)),
        Job('report', 'report', _report, ('numbers.json', 'loops.png', 'report.html')),
        *(command('convert', f'--overwrite SAMPLES OUT/{x}', x) for x in FORMATS),
        command('simulate', '--overwrite --program PROGRAM OUT/r.npz', 'r.npz'),
        command(
            'predict',
            'STAGE SAMPLES --overwrite --out OUT/p.csv --plot OUT/p.png',
            'p.csv',
            'p.png',
        ),
    ]
    if slow:
        for name, wanted in (('identification', 'learn.npz'), ('validation', 'check.npz')):
            assert not piezo_ident(
                ['simulate', '--program', name, str(inputs / wanted), '--overwrite']
            )
        works += [
            command('identify', 'IN/learn.npz --overwrite --model OUT/model.yaml '
                    '--report OUT/report',
                    'model.yaml', 'report/report.html', 'report/identification.json'),
            command('diagnose', 'STAGE IN/check.npz --only creep --model OUT/refined.yaml '
                    '--overwrite --report OUT/report',
                    'refined.yaml', 'report/report.html', 'report/diagnosis.json'),
        ]  # fmt: skip
    return works


def digest(path: Path) -> str:
    """Return what tells two outputs apart; a record by what it holds."""
    if not path.exists():
        return 'nothing'
    if path.is_dir() or path.suffix in ('.mcap', '.db3', '.npz', '.mat'):
        record = pi.read(path)
        return hashlib.sha1(b''.join(p.v.tobytes() + p.y.tobytes() for p in record)).hexdigest()
    if path.suffix == '.png' and path.parent.name != 'report':
        data = path.read_bytes()
        return 'picture' if data.endswith(b'IEND\xaeB`\x82') else hashlib.sha1(data).hexdigest()
    return hashlib.sha1(path.read_bytes()).hexdigest()


def _forked(job: Job, folder: Path, errors: int) -> int:
    """Start the work in a copy of this process, and return the id of that."""
    sys.stdout.flush()
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')  # threads of libraries, none of which is at work
        pid = os.fork()
    if pid:
        return pid
    code = 70
    try:
        os.dup2(os.open(os.devnull, os.O_RDWR), 1)
        os.dup2(errors, 2)
        # a test runner may have put others in their places
        sys.stdout, sys.stderr = os.fdopen(1, 'w'), os.fdopen(2, 'w')
        try:
            code = job.run(folder)
        except PiezoIdentError as error:
            print(error, file=sys.stderr)
            code = 2
        sys.stderr.flush()
    finally:
        os._exit(code)


@contextmanager
def _started(job: Job, folder: Path) -> Iterator[int]:
    """Run the work in a copy of this process, and end that in any case."""
    pid = _forked(job, folder, os.open(os.devnull, os.O_RDWR))
    try:
        yield pid
    finally:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)


def _leftovers(folder: Path) -> bool:
    return any(LEFTOVER.fullmatch(n) for _, d, f in os.walk(folder) for n in (*d, *f))


def _files(folder: Path) -> set[str]:
    """Return the names of the files that no killed process has left behind."""
    inside = (p.relative_to(folder) for p in folder.rglob('*') if p.is_file())
    return {str(p) for p in inside if not any(map(LEFTOVER.fullmatch, p.parts))}


@dataclass
class Tried:
    """Work that ran to its end once: its files, what its outputs may be, and its time [s]."""

    job: Job
    files: set[str]
    states: dict[str, set[str]]
    seconds: float


def rehearse(job: Job, folder: Path, old: Path) -> Tried | None:
    """Run the work once to its end: its outputs then are the new; None where it fails."""
    shutil.copytree(old, folder)
    before = {name: digest(folder / name) for name in job.outputs}
    start = time.perf_counter()
    with _started(job, folder) as pid:
        # not reaped yet: the end of the block does that
        status = os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT).si_status
        seconds = time.perf_counter() - start
    states = {name: {before[name], digest(folder / name)} for name in job.outputs}
    return None if status else Tried(job, _files(folder), states, seconds)


def kill(tried: Tried, folder: Path, old: Path, rng: random.Random, *, writing: bool) -> str:
    """Kill the work once, and say what is there: one of `GOOD`, or what is wrong."""
    shutil.copytree(old, folder)
    before = {name: digest(folder / name) for name in tried.job.outputs}
    with _started(tried.job, folder) as pid:
        end = time.perf_counter() + tried.seconds * (3.0 if writing else rng.random())
        while time.perf_counter() < end and not (writing and _leftovers(folder)):
            if os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT):
                break
        time.sleep(rng.random() * 0.05 if writing else 0.0)
    seen = set()
    for name, states in tried.states.items():
        try:
            now = digest(folder / name)
        except (PiezoIdentError, OSError) as error:
            return f'{name}: damaged ({error})'
        if now not in states:
            return f'{name}: neither the old nor the new'
        seen.add('old' if now == before[name] else 'new')
    strangers = _files(folder) - tried.files
    return f'unknown names {strangers}' if strangers else ' and '.join(sorted(seen, reverse=True))


def old_outputs(folder: Path, works: list[Job]) -> None:
    """Write what the work will replace."""
    folder.mkdir()
    old = record(500, 2)
    for job in works:
        for name in job.outputs:
            path = folder / name
            path.parent.mkdir(exist_ok=True)
            if name in FORMATS:
                pi.write(old, path, overwrite=True)
            else:
                path.write_text('old\n')


def kills(counts: dict[str, int], place: Path, works: list[Job]) -> Iterator[tuple[Job, str]]:
    """Yield the work that was killed and what was there afterwards."""
    rng = random.Random(1)
    for number, job in enumerate(works):
        old = place / f'old{number}'
        old_outputs(old, [job])
        tried = rehearse(job, place / f'whole{number}', old)
        if tried is None:
            yield job, 'does not run'
            continue
        same = sum(1 for other in works if other.kind == job.kind)
        for i in range(-(-counts.get(job.kind, 0) // same)):
            folder = place / f'kill{number}_{i}'
            yield job, kill(tried, folder, old, rng, writing=i % 2 == 1)
            shutil.rmtree(folder)


# --- no room, no right ----------------------------------------------------------------------


@contextmanager
def mounted(folder: Path, options: str) -> Iterator[bool]:
    """Mount a small disk in memory; False where that is not allowed."""
    folder.mkdir(exist_ok=True)
    done = subprocess.run(
        ['mount', '-t', 'tmpfs', '-o', options, 'tmpfs', str(folder)], capture_output=True
    )
    try:
        yield done.returncode == 0
    finally:
        if done.returncode == 0:
            subprocess.run(['umount', '-l', str(folder)], check=False)


def refused(job: Job, folder: Path) -> str:
    """Run work where it cannot write; return what is wrong, empty when it is refused well."""
    names = sorted(os.listdir(folder))
    before = {name: digest(folder / name) for name in job.outputs}
    reader, writer = os.pipe()
    pid = _forked(job, folder, writer)
    os.close(writer)
    with open(reader, errors='replace') as stream:
        message = stream.read()
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    wrong = [f'exit code {code}'] if code != 2 else []
    if message.count('\n') != 1 or 'cannot be written' not in message:
        wrong.append(f'message {message[-300:]!r}')
    if before != {name: digest(folder / name) for name in job.outputs}:
        wrong.append('lost what was there')
    if sorted(os.listdir(folder)) != names:
        wrong.append(f'left {sorted(set(os.listdir(folder)) - set(names))}')
    return ', '.join(wrong)


def without_room(place: Path, works: list[Job], options: str) -> Iterator[tuple[Job, str]]:
    """Yield work and what was wrong when its disk was full or read-only."""
    for number, job in enumerate(works):
        folder = place / f'full{number}'
        with mounted(folder, 'size=4m') as is_there:
            if not is_there:
                return
            out = folder / 'out'
            old_outputs(out, [job])
            if options == 'ro':
                subprocess.run(['mount', '-o', 'remount,ro', str(folder)], check=True)
            else:
                _fill(folder / 'filler')
            yield job, refused(job, out)


def _fill(path: Path) -> None:
    with suppress(OSError), path.open('wb', buffering=0) as file:
        while True:
            file.write(bytes(4096))


# --- the study ------------------------------------------------------------------------------


def rows_of(
    killed: list[tuple[Job, str]], starved: dict[str, list[tuple[Job, str]]]
) -> list[tuple[str, str, str]]:
    """Return the rows of the table."""
    counted = []
    for kind in KILLS:
        states = [state for job, state in killed if job.kind == kind]
        each = ', '.join(f'{n} {state}' for state, n in Counter(states).most_common())
        counted.append(f'{kind}: {each}')
    bad = sum(state not in GOOD for _, state in killed)
    result = f'the output is {"; ".join(counted)}; {bad} damaged'
    rows = [('SIGKILL while a command works', f'{len(killed)} kills', result)]
    for what, outcomes in starved.items():
        good = 'one line, exit code 2, nothing lost, nothing left'
        bad_ones = '; '.join(f'{job.name}: {wrong}' for job, wrong in outcomes if wrong)
        result = bad_ones or (good if outcomes else 'skipped: mounting is not allowed here')
        rows.append((what, f'{len(outcomes)} commands and formats', result))
    return rows


def main() -> int:
    """Run the study; 1 when something was lost."""
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument('--kills', type=int, help='of each kind, instead of 100 in all')
    args = parser.parse_args()
    counts = KILLS if args.kills is None else dict.fromkeys(KILLS, args.kills)
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (place / 'inputs').mkdir()
        works = jobs(place / 'inputs', slow=True)
        killed = []
        for job, state in kills(counts, place, works):
            killed.append((job, state))
            print(json.dumps([job.name, state]), flush=True)
        starved = {}
        for what, options in (('disk full', 'full'), ('read-only file system', 'ro')):
            starved[what] = list(without_room(place, works, options))
            for job, wrong in starved[what]:
                print(json.dumps([what, job.name, wrong or 'refused']), flush=True)
    rows = rows_of(killed, starved)
    if args.kills is None:
        write_rows('crash', rows, 'make crash')
    for what, how_often, result in rows:
        print(f'{what:28s} {how_often:26s} {result}')
    print(f'{time.perf_counter() - start:.0f} s')
    is_bad = any(x not in GOOD for _, x in killed)
    return 1 if is_bad or any(x for found in starved.values() for _, x in found) else 0


if __name__ == '__main__':
    sys.exit(main())

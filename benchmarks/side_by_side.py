# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Works timed side by side in one run, and what is written about them.

Whatever is compared runs in turns in one process, so that what else the machine does falls on all
of it alike.  Figures are medians over the turns; only their ratios travel to other machines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
import os
from pathlib import Path
import platform
import resource
import subprocess
import sys
import time
from typing import Any

import numpy as np

#: whose versions a page names, where they are installed; and those of the page with the peers
LIBRARIES = ('numpy', 'scipy', 'numba')
PEERS = (
    *('llvmlite', 'rosbags', 'sippy_unipi', 'sysidentpy', 'pysindy', 'scikit-learn', 'pyswarms'),
    *('control', 'dask', 'distributed'),
)


@dataclass
class Turn:
    """
    What came of one work over its turns.

    `times`: wall time of each turn [s]; `results`: what each turn returned.
    """

    times: list[float] = field(default_factory=list)
    results: list[Any] = field(default_factory=list)

    @property
    def median(self) -> float:
        """Median time [s]."""
        return float(np.median(self.times))

    def over(self, other: Turn) -> float:
        """Return the median of the ratios of the times turn by turn, this one's over another's."""
        n = min(len(self.times), len(other.times))
        return float(np.median(np.array(self.times[:n]) / np.array(other.times[:n])))


def take_turns(
    works: Mapping[str, Callable[[int], Any]], runs: int, *, warm: Iterable[str] = ()
) -> dict[str, Turn]:
    """
    Run every work in turns.

    `works`: each is given the number of the turn; `warm`: works that are run once before, untimed:
    what compiles on its first call.
    """
    for name in warm:
        works[name](0)
    turns = {name: Turn() for name in works}
    for k in range(runs):
        for name, work in works.items():
            start = time.perf_counter()
            result = work(k)
            turns[name].times.append(time.perf_counter() - start)
            turns[name].results.append(result)
    return turns


def seconds(t: float) -> str:
    """Return a time with its unit, three digits."""
    for unit, size in (('s', 1.0), ('ms', 1e-3), ('µs', 1e-6)):
        if t >= size:
            return f'{t / size:.3g} {unit}' if t / size < 1000 else f'{t / size:.0f} {unit}'
    return f'{1e9 * t:.3g} ns'


def ratio(x: float) -> str:
    """Return a ratio with a sensible number of digits."""
    return f'{x:.0f}' if x >= 100 else f'{x:.3g}'


def last_line(what: str, command: Sequence[str]) -> str:
    """Run a program, whose memory is its own, and return the last line that it prints."""
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        said = done.stderr.strip().splitlines() or [f'exit code {done.returncode}']
        raise RuntimeError(f'{what} failed: {said[-1]}')
    return (done.stdout.splitlines() or [''])[-1]


def peak_memory() -> float:
    """Return the peak resident memory of this process [MiB]."""
    try:
        # ru_maxrss would count what the parent had before this program was loaded
        status = Path('/proc/self/status').read_text(encoding='utf-8')
        return int(status.partition('VmHWM:')[2].split()[0]) / 1024.0
    except (OSError, ValueError, IndexError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def markdown(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table."""
    lines = ['| ' + ' | '.join(heads) + ' |', '|' + '---|' * len(heads)]
    lines += ['| ' + ' | '.join(str(cell) for cell in row) + ' |' for row in rows]
    return '\n'.join(lines)


def versions(*names: str) -> str:
    """Return the names with the versions of those that are installed."""
    found = []
    for name in names:
        with suppress(PackageNotFoundError):
            found.append(f'{name} {version(name)}')
    return ', '.join(found)


def machine(libraries: Sequence[str] = ()) -> str:
    """Return what is being measured on; further libraries may be named."""
    name, memory = platform.processor() or platform.machine(), ''
    try:
        lines = Path('/proc/cpuinfo').read_text(encoding='utf-8').splitlines()
        name = next(
            (s.partition(':')[2].strip() for s in lines if s.startswith('model name')), name
        )
        kilobytes = Path('/proc/meminfo').read_text(encoding='utf-8').split()[1]
        memory = f', {int(kilobytes) / 2**20:.0f} GiB of memory'
    except (OSError, ValueError, IndexError):
        pass
    return (
        f'{os.cpu_count()} cores of {name}{memory}, {platform.system()} {platform.release()}; '
        f'Python {platform.python_version()}, {versions("piezo_ident", *LIBRARIES, *libraries)}'
    )


def show(sections: Callable[[bool], Sequence[tuple[str, str]]]) -> None:
    """Print the sections of a benchmark, short ones with --quick."""
    for title, text in sections('--quick' in sys.argv[1:]):
        print(f'## {title}\n\n{text}\n')

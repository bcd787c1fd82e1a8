# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""The rows of docs/reliability.md, a file for each study that measured them."""

from __future__ import annotations

from collections.abc import Sequence
import json
import os
from pathlib import Path

KEYS = ('what', 'how_often', 'result', 'command')
ROWS = Path(__file__).resolve().parents[2] / 'docs' / 'reliability' / 'rows'


def write_rows(name: str, rows: Sequence[tuple[str, str, str]], command: str) -> None:
    """
    Write the rows of one study in place of those of an earlier run.

    `name`: of the study; `rows`: what was tried, how often, and what happened; `command`: does it
    again.
    """
    ROWS.mkdir(parents=True, exist_ok=True)
    data = [dict(zip(KEYS, (*row, command), strict=True)) for row in rows]
    text = json.dumps(data, indent=1, ensure_ascii=False)
    (ROWS / f'{name}.json').write_text(text + '\n', encoding='utf-8')


def crowd() -> str:
    """Return a remark for a row where other programs took the processors; empty when none did."""
    load, cores = os.getloadavg()[0], os.cpu_count() or 1
    return f', with {load:.0f} programs on {cores} processors' if load > 2 * cores else ''


def processors() -> tuple[int, int, int]:
    """Return the ticks of all processors so far: at work, taken away by the host, and in all."""
    line = Path('/proc/stat').read_text(encoding='ascii').partition('\n')[0]
    # user, nice, system, idle, waiting for a disk, interrupts, soft interrupts, stolen
    ticks = [int(x) for x in line.split()[1:9]]
    return sum(ticks[:3]) + sum(ticks[5:7]), ticks[7], sum(ticks)


def shares(before: tuple[int, int, int], after: tuple[int, int, int]) -> str:
    """Return a remark for a row: how busy the processors were between two looks."""
    work, stolen, total = (b - a for a, b in zip(before, after, strict=True))
    return (
        f'{os.cpu_count()} processors {100 * work / max(total, 1):.0f} % busy and '
        f'{100 * stolen / max(total, 1):.1f} % taken by the host'
    )

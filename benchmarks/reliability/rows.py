# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0
"""The rows of docs/reliability.md, a file for each study that measured them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import json
import os
from pathlib import Path
from typing import Any

__all__ = ['ROWS', 'crowd', 'processors', 'read_rows', 'shares', 'write_rows']

ROWS = Path(__file__).resolve().parents[2] / 'docs' / 'reliability' / 'rows'


def read_rows(name: str) -> list[dict[str, Any]]:
    """Return the rows of a study as it wrote them, none before its first run."""
    file = ROWS / f'{name}.json'
    return json.loads(file.read_text(encoding='utf-8')) if file.exists() else []


def write_rows(name: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """
    Write the rows of one study, those of an earlier run are replaced.

    Parameters
    ----------
    name : str
        Of the study.
    rows : sequence of mapping
        Each with what, how_often, result and command.
    """
    ROWS.mkdir(parents=True, exist_ok=True)
    text = json.dumps(list(rows), indent=1, ensure_ascii=False)
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

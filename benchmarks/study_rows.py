# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The rows of the studies: kept in a file, as tables, as CSV, and as a picture."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
import csv
from dataclasses import asdict, fields
import json
import multiprocessing
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
import numpy as np
from piezo_ident.report.figures import style
from side_by_side import markdown
from tqdm import tqdm


def part_of(count: int, whole: int) -> str:
    """Return a count with its share."""
    return f'{count} of {whole} ({count / whole:.0%})' if whole else '0 of 0'


def some(facts: Iterable[object]) -> str:
    """Return how many of them hold."""
    known = [bool(x) for x in facts]
    return part_of(sum(known), len(known))


def counts_of(outcomes: Iterable[str], order: Iterable[str]) -> str:
    """Return how often each outcome came, `6 exact, 3 class`."""
    known = list(outcomes)
    return ', '.join(f'{known.count(kind)} {kind}' for kind in order if kind in known)


def section(title: str, heads: str, rows: Iterable[Sequence[object]]) -> str:
    """Return a section with a table; the heads are separated by commas."""
    return f'## {title}\n\n{markdown(heads.split(", "), rows)}'


def write_csv(target: Path, heads: str, rows: Iterable[Sequence[object]]) -> None:
    """Write a table as CSV; the heads are separated by commas."""
    with target.open('w', encoding='utf-8', newline='') as file:
        csv.writer(file, lineterminator='\n').writerows([heads.split(', '), *rows])


def write_cases(page: Path, heads: str, rows: Iterable[Sequence[object]]) -> str:
    """Write one line for each case into a CSV file beside a page, and return the page's link."""
    target = page.with_suffix('.csv')
    lines = list(rows)
    write_csv(target, heads, lines)
    return (
        f'Every case: [{target.name}]({target.name}), {len(lines)} lines; errors in % of stroke.'
    )


def read_rows(path: Path, kind: type) -> dict[str, Any]:
    """Return the rows that are kept in a file, by key; a kind may have lost fields since."""
    known = {f.name for f in fields(kind)}
    # the names of the effects in files of old
    renamed = {'found': 'effects'} if 'found' not in known else {}
    rows = {}
    if path.exists():
        for text in path.read_text(encoding='utf-8').splitlines():
            data = {renamed.get(k, k): x for k, x in json.loads(text).items()}
            data = {k: x for k, x in data.items() if k in known}
            data = {k: tuple(x) if isinstance(x, list) else x for k, x in data.items()}
            rows[data['key']] = kind(**data)
    return rows


def all_rows(
    path: Path, kind: type, todo: Sequence[Any], judged: Callable[[Any], Any], processes: int
) -> dict[str, Any]:
    """Run the cases that a file does not hold yet, add them to it, and return all rows by key."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = read_rows(path, kind)
    left = [case for case in todo if case.key not in rows]
    with (
        multiprocessing.get_context('spawn').Pool(processes) as pool,
        path.open('a', encoding='utf-8') as kept,
    ):
        for row in tqdm(pool.imap_unordered(judged, left), total=len(left), unit='case'):
            rows[row.key] = row
            kept.write(json.dumps(asdict(row)) + '\n')
            kept.flush()
    return rows


def dots_and_ranges(
    errors: Mapping[str, Sequence[Sequence[float]]], heads: Sequence[str], label: str
) -> Figure:
    """
    Draw errors on a logarithmic axis, a line for each key: medians as dots, ranges as bars.

    `errors`: for each line its cases, each with an error for every head; `label`: name and unit of
    the errors.
    """
    fig = style.figure(0.8 + (0.2 + 0.08 * len(heads)) * len(errors))
    axes = fig.subplots()
    colours = ('GREY', 'VERMILION', 'BLUE', 'GREEN', 'BLACK', 'ORANGE')
    for j, (head, name) in enumerate(zip(heads, colours, strict=False)):
        colour = getattr(style, name)
        for i, cases in enumerate(errors.values()):
            own = [case[j] for case in cases]
            y = i + 0.14 * (j - 0.5 * (len(heads) - 1))
            axes.plot([min(own), max(own)], [y, y], color=colour, linewidth=2.0, alpha=0.5)
            axes.plot(
                np.median(own), y, 'o', color=colour, markersize=5, label=None if i else head
            )
    axes.set_xscale('log')
    axes.set_yticks(range(len(errors)), list(errors))
    axes.invert_yaxis()
    style.tidy(axes, label)
    style.plain_log(axes.xaxis, *axes.get_xlim())
    style.legend_above(axes)
    return fig

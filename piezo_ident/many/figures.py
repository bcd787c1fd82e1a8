# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures of many records: spread and drift of what was found, and of the errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.files import temporary_output
from piezo_ident.many.run import Row
from piezo_ident.many.spread import dates, in_order, QUANTITIES, Quantity, standing_out, values_of
from piezo_ident.report.figures.style import (
    BLUE,
    COLOURS,
    figure,
    GREY,
    legend_above,
    note,
    NothingToDraw,
    plain_log,
    safe,
    SMALL,
    tidy,
    VERMILION,
)

__all__ = [
    'PICTURES',
    'effects_figure',
    'error_spread_figure',
    'parameters_figure',
    'write_spread',
]

#: quantities of the picture of parameters
SHOWN = ('stroke', 'gain', 'loop_width', 'delay', 'bandwidth', 'resonance')
#: errors, with their colours; two of them are before and after
ERRORS = (
    ('error_before', COLOURS['static']),
    ('error_after', COLOURS['model']),
    ('error_held_out', COLOURS['model']),
    ('error_selection', COLOURS['model']),
    ('noise_floor', GREY),
)
#: names written into a panel, bins of a histogram, and records from which a median is drawn
NAMED, BINS, ENOUGH = 3, 24, 15
DPI = 160


def _good(rows: Sequence[Row]) -> list[Row]:
    good = [row for row in in_order(rows) if row.good]
    if len(good) < 2:
        raise NothingToDraw('spread needs two good records')
    return good


def _places(rows: Sequence[Row], good: Sequence[Row]) -> tuple[NDArray[np.float64], bool]:
    """Return where the good ones stand among all, and whether that is a date."""
    ordered = in_order(rows)
    when = dates([row.record for row in ordered])
    if when is None:
        at = np.arange(1.0, len(ordered) + 1.0)
    else:
        at = np.array(date2num(when), np.float64)  # type: ignore[no-untyped-call]
    number = {row.record: i for i, row in enumerate(ordered)}
    return at[[number[row.record] for row in good]], when is not None


def _records_axis(axes: Axes, rows: Sequence[Row], is_date: bool) -> None:
    if is_date:
        locator = AutoDateLocator(minticks=4, maxticks=9)  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_locator(locator)
        form = ConciseDateFormatter(locator)  # type: ignore[no-untyped-call]
        axes.xaxis.set_major_formatter(form)
        axes.set_xlabel('date in the name of the record')
        return
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    names = [row.record for row in in_order(rows)]
    said = safe(f'{names[0]} … {names[-1]}')
    axes.set_xlabel(f'record in the order of names: {said}')


def _running_median(x: NDArray[np.float64], y: NDArray[np.float64]) -> Any:
    known = np.isfinite(y)
    x, y = x[known], y[known]
    half = max(3, y.size // 16)
    middle = np.array([np.median(y[max(0, k - half) : k + half + 1]) for k in range(y.size)])
    return x, middle


def _name_far(
    axes: Axes, x: NDArray[np.float64], y: NDArray[np.float64], names: list[str]
) -> None:
    far = standing_out(y)
    axes.plot(x[far], y[far], 'o', color=VERMILION, markersize=4.5, zorder=4)
    left, right = axes.get_xlim()
    for k in far[:NAMED]:
        inside = x[k] < 0.5 * (left + right)
        axes.annotate(
            safe(names[k]),
            (x[k], y[k]),
            xytext=(5 if inside else -5, 0),
            textcoords='offset points',
            ha='left' if inside else 'right',
            va='center',
            fontsize=SMALL - 1.0,
            color=VERMILION,
        )


def _histogram(
    axes: Axes, y: NDArray[np.float64], bins: NDArray[np.float64], colour: str, alpha: float = 1.0
) -> None:
    axes.hist(
        y[np.isfinite(y)], bins.tolist(), orientation='horizontal', color=colour, alpha=alpha
    )
    tidy(axes)
    axes.grid(False)
    axes.tick_params(labelleft=False)
    axes.xaxis.set_major_locator(MaxNLocator(2, integer=True))


def parameters_figure(rows: Sequence[Row]) -> Figure:
    """
    Draw what the stages are like, over the records and as histograms beside.

    Parameters
    ----------
    rows : sequence of Row

    Raises
    ------
    NothingToDraw
        With less than two good records, or where none of the quantities was found.
    """
    good = _good(rows)
    known = [
        (q, y)
        for q in QUANTITIES
        if q.column in SHOWN and np.isfinite(y := values_of(good, q)).sum() > 1
    ]
    same = [(q, y) for q, y in known if np.nanmax(y) == np.nanmin(y)]
    known = [(q, y) for q, y in known if np.nanmax(y) > np.nanmin(y)]
    if not known:
        raise NothingToDraw('no record has a parameter that differs from that of another')
    x, is_date = _places(rows, good)
    fig = figure(0.7 + 1.25 * len(known))
    grid = fig.subplots(
        len(known), 2, sharex='col', sharey='row', squeeze=False, width_ratios=[5, 1]
    )
    if same:
        said = ', '.join(f'{q.name} {np.nanmax(y):.4g} {q.unit}' for q, y in same)
        note(grid[0, 0], f'the same in all records: {said}')
    for (trace, bars), (q, y) in zip(grid, known, strict=True):
        trace.plot(x, y, 'o', color=COLOURS['measured'], markersize=2.5, alpha=0.6)
        if np.isfinite(y).sum() >= ENOUGH:
            trace.plot(*_running_median(x, y), color=BLUE, linewidth=1.6, label='running median')
        tidy(trace, '', f'{q.name}\n{q.unit}')
        trace.margins(0.03, 0.1)
        trace.ticklabel_format(axis='y', useOffset=False)
        _name_far(trace, x, y, [row.record for row in good])
        _histogram(bars, y, np.linspace(np.nanmin(y), np.nanmax(y), BINS + 1), BLUE)
    _records_axis(grid[-1, 0], rows, is_date)
    grid[-1, 1].set_xlabel('records')
    if grid[0, 0].get_legend_handles_labels()[1]:
        legend_above(grid[0, 0])
    fig.align_ylabels(grid[:, 0])
    return fig


def _errors(good: Sequence[Row]) -> list[tuple[Quantity, str, NDArray[np.float64]]]:
    found = []
    for column, colour in ERRORS:
        (q,) = (q for q in QUANTITIES if q.column == column)
        y = values_of(good, q)
        # a logarithmic axis has no zero
        y[~(y > 0.0)] = np.nan
        if np.isfinite(y).any():
            found.append((q, colour, y))
    names = [q.column for q, *_ in found]
    # what was not fitted tells more than what chose
    if 'error_held_out' in names:
        found = [item for item in found if item[0].column != 'error_selection']
    return found


def error_spread_figure(rows: Sequence[Row]) -> Figure:
    """
    Draw the errors over the records and as histograms beside; failed records are marked.

    Parameters
    ----------
    rows : sequence of Row

    Raises
    ------
    NothingToDraw
        With less than two good records, or without errors.
    """
    good = _good(rows)
    found = _errors(good)
    if not found:
        raise NothingToDraw('no record has an error')
    x, is_date = _places(rows, good)
    bad = [row for row in rows if not row.good]
    fig = figure(3.4)
    trace, bars = fig.subplots(1, 2, sharey=True, width_ratios=[5, 1])
    for q, colour, y in found:
        size = 2.0 if q.column == 'noise_floor' else 3.0
        trace.plot(x, y, 'o', color=colour, markersize=size, alpha=0.75, label=q.name)
    pair = {q.column: y for q, _, y in found}
    if {'error_before', 'error_after'} <= set(pair):
        trace.vlines(x, pair['error_after'], pair['error_before'], color='#C8C8C8', zorder=0)
    trace.set_yscale('log')
    tidy(trace, '', 'rms error / % of stroke')
    trace.margins(0.03, 0.08)
    values = np.concatenate([y[np.isfinite(y)] for *_, y in found])
    low, high = float(values.min()), float(values.max())
    if high < 1.5 * low:
        low, high = low / 1.3, high * 1.3
        trace.set_ylim(low, high)
    for q, _, y in found:
        if q.column != 'noise_floor':
            _name_far(trace, x, y, [row.record for row in good])
    if bad:
        at, _ = _places(rows, bad)
        trace.plot(
            at,
            np.zeros(at.size),
            'x',
            color=VERMILION,
            markersize=5,
            transform=trace.get_xaxis_transform(),
            clip_on=False,
            label=f'failed ({len(bad)})',
        )
    plain_log(trace.yaxis, low, high)
    bins = np.geomspace(low, 1.0001 * high, BINS + 1)
    for _, colour, y in found:
        _histogram(bars, y, bins, colour, 0.75)
    bars.set_xlabel('records')
    _records_axis(trace, rows, is_date)
    legend_above(trace)
    return fig


def effects_figure(rows: Sequence[Row]) -> Figure:
    """
    Draw which effects the stages have, and how large they are.

    Parameters
    ----------
    rows : sequence of Row

    Raises
    ------
    NothingToDraw
        With less than two good records, or where no effect was found.
    """
    good = _good(rows)
    sizes: dict[str, NDArray[np.float64]] = {}
    for k, row in enumerate(good):
        for name in str(row.values.get('effects') or '').split():
            rms = row.values.get(f'{name}.rms')
            found = sizes.setdefault(name, np.full(len(good), np.nan))
            found[k] = rms if isinstance(rms, (int, float)) else np.nan
    if not sizes:
        raise NothingToDraw('no record shows an effect')
    x, is_date = _places(rows, good)
    names = sorted(sizes, key=lambda name: -int(np.isfinite(sizes[name]).sum()))
    fig = figure(1.0 + 0.42 * len(names))
    trace, bars = fig.subplots(1, 2, sharey=True, width_ratios=[4, 1])
    largest = max(float(np.nanmax(y)) for y in sizes.values())
    for i, name in enumerate(names):
        y = sizes[name]
        known = np.isfinite(y)
        area = 8.0 + 90.0 * y[known] / largest
        trace.scatter(x[known], np.full(known.sum(), i), area, color=BLUE, alpha=0.6, linewidths=0)
        bars.barh(i, known.sum(), 0.6, color=BLUE)
    tidy(trace)
    trace.set_yticks(range(len(names)), names)
    trace.set_ylim(len(names) - 0.4, -0.6)
    trace.set_title(
        f'area: rms of what the effect explains, largest {largest:.2g} % of stroke',
        fontsize=SMALL,
        loc='right',
        color='#444444',
    )
    trace.set_xlim(*_span(x))
    tidy(bars, 'records')
    bars.tick_params(labelleft=False)
    bars.xaxis.set_major_locator(MaxNLocator(3, integer=True))
    bars.grid(False, axis='y')
    _records_axis(trace, rows, is_date)
    return fig


def _span(x: NDArray[np.float64]) -> tuple[float, float]:
    low, high = float(x.min()), float(x.max())
    edge = 0.04 * (high - low) or 0.5
    return low - edge, high + edge


#: by file name
PICTURES: dict[str, Callable[[Sequence[Row]], Figure]] = {
    'errors.png': error_spread_figure,
    'parameters.png': parameters_figure,
    'effects.png': effects_figure,
}


def write_spread(rows: Sequence[Row], folder: Path) -> list[Path]:
    """
    Write the pictures that these rows allow; those of an earlier run go.

    Parameters
    ----------
    rows : sequence of Row
    folder : path
        Is there.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    DataError
        When the folder cannot be written.
    """
    written = []
    for name, draw in PICTURES.items():
        path = folder / name
        try:
            drawn = draw(rows)
        except NothingToDraw:
            path.unlink(missing_ok=True)
            continue
        with temporary_output(path, overwrite=True) as target:
            drawn.savefig(target, dpi=DPI)
        written.append(path)
    return written

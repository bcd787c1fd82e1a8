# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The picture of many records: each quantity over the records, with its histogram."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
import numpy as np
from numpy.typing import NDArray
from piezo_ident.many.table import Row
from piezo_ident.report.figures.style import (
    BLUE,
    COLOURS,
    figure,
    note,
    NothingToDraw,
    tidy,
    VERMILION,
)

__all__ = ['QUANTITIES', 'Quantity', 'spread_figure', 'values_of']

BINS = 24


@dataclass(frozen=True)
class Quantity:
    """
    A column of the table in a unit for people.

    Attributes
    ----------
    column : str
    name, unit : str
    factor : float
        From the unit of the table to `unit`.
    """

    column: str
    name: str
    unit: str
    factor: float = 1.0


#: errors first, then the figures of merit of the stage
QUANTITIES = (
    Quantity('error_held_out', 'held-out error', '% of stroke'),
    Quantity('error_selection', 'selection error', '% of stroke'),
    Quantity('error_before', 'error before', '% of stroke'),
    Quantity('error_after', 'error after', '% of stroke'),
    Quantity('unexplained', 'unexplained', '% of stroke'),
    Quantity('noise_floor', 'noise floor', '% of stroke'),
    Quantity('stroke', 'stroke', 'µm', 1e6),
    Quantity('gain', 'gain', 'µm/V', 1e6),
    Quantity('loop_width', 'loop width', '% of stroke'),
    Quantity('delay', 'delay', 'ms', 1e3),
    Quantity('bandwidth', 'bandwidth', 'Hz'),
    Quantity('resonance', 'resonance', 'Hz'),
)


def values_of(rows: Sequence[Row], quantity: Quantity) -> NDArray[np.float64]:
    """Return a quantity of rows in its unit, shape (n,); NaN where a row has none."""
    cells = [row.values.get(quantity.column) for row in rows]
    return quantity.factor * np.array(
        [float(x) if isinstance(x, (int, float)) else np.nan for x in cells]
    )


def spread_figure(rows: Sequence[Row]) -> Figure:
    """
    Draw each quantity that differs between records.

    Parameters
    ----------
    rows : sequence of Row
        In the order of the axis; failed rows are marked at its foot.

    Raises
    ------
    NothingToDraw
        When no quantity differs between two records.
    """
    columns = [(q, values_of(rows, q)) for q in QUANTITIES]
    columns = [(q, y) for q, y in columns if np.isfinite(y).sum() > 1]
    panels = [(q, y) for q, y in columns if np.nanmax(y) > np.nanmin(y)]
    if not panels:
        raise NothingToDraw('no quantity differs between the records')
    x = np.arange(1, len(rows) + 1)
    drawing = figure(0.7 + 1.15 * len(panels))
    grid = drawing.subplots(
        len(panels), 2, sharex='col', sharey='row', squeeze=False, width_ratios=[5, 1]
    )
    for (trace, bars), (q, y) in zip(grid, panels, strict=True):
        trace.plot(x, y, 'o', color=COLOURS['measured'], markersize=2.5, alpha=0.7)
        trace.axhline(float(np.nanmedian(y)), color=BLUE, linewidth=1.0, zorder=1)
        tidy(trace, '', f'{q.name}\n{q.unit}')
        trace.margins(0.03, 0.1)
        trace.ticklabel_format(axis='y', useOffset=False)
        edges = np.linspace(np.nanmin(y), np.nanmax(y), BINS + 1)
        bars.hist(y[np.isfinite(y)], edges.tolist(), orientation='horizontal', color=BLUE)
        tidy(bars)
        bars.grid(False)
        bars.tick_params(labelleft=False)
        bars.xaxis.set_major_locator(MaxNLocator(2, integer=True))
    failed = x[[not row.is_good for row in rows]]
    if failed.size:
        foot = grid[-1, 0]
        foot.plot(
            failed,
            np.zeros(failed.size),
            'x',
            color=VERMILION,
            transform=foot.get_xaxis_transform(),
            clip_on=False,
        )
        note(grid[0, 0], f'{failed.size} failed (crosses)')
    grid[-1, 0].xaxis.set_major_locator(MaxNLocator(integer=True))
    grid[-1, 0].set_xlabel('record, in the order of names; line: median')
    grid[-1, 1].set_xlabel('records')
    drawing.align_ylabels(grid[:, 0])
    return drawing

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What a model leaves of the measurement over time, before and after it was refined."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from piezo_ident.diagnosis.results import Residual
from piezo_ident.record.record import Piece
from piezo_ident.report.figures.style import (
    COLOURS,
    envelope,
    figure,
    legend_above,
    length_unit,
    note,
    NothingToDraw,
    percent_axis,
    safe,
    SMALL,
    tidy,
)

__all__ = ['STATES', 'differ', 'residual_figure']

#: attribute of `Residual` and `Diagnosis`, how it is called, colour
STATES = (
    ('given', 'as given', '#9A9A9A'),
    ('before', 'H refitted, nothing added', COLOURS['static']),
    ('after', 'refined', COLOURS['model']),
)
#: segments named above a picture, at most
NAMED = 14
#: characters of such a name
SHORT = 20
#: two segments side by side
TINTS = ('#E9EEF3', '#F4F0E6')
#: a part whose residual leaves this quantile far behind is cut
USUAL, FAR = 0.999, 2.5
#: so many times smaller, what is left is drawn once more on a scale of its own
ENLARGED = 4.0


def differ(residuals: Sequence[Residual]) -> bool:
    """Return whether the refined model is neither the one given nor the same with H refitted."""
    return not any(
        all(np.array_equal(getattr(r, name), r.after) for r in residuals)
        for name in ('given', 'before')
    )


def residual_figure(residual: Residual) -> Figure:
    """
    Draw the residual of a piece before and after, on one scale, its segments shaded.

    Parameters
    ----------
    residual : Residual

    Raises
    ------
    NothingToDraw
        When no sample counts.
    """
    if not residual.sound.any():
        raise NothingToDraw(f'{residual.record}: no sample counts')
    piece, stroke = residual.piece, float(np.ptp(residual.piece.y))
    largest, limit = _largest(residual, 'given', 'before', 'after')
    rows: list[tuple[tuple[str, ...], float, str]] = [(('given', 'before'), limit, '')]
    if differ([residual]):
        rows.append((('after',), limit, 'on the same scale'))
        _, small = _largest(residual, 'after')
        if 0.0 < small < limit / ENLARGED:
            rows.append((('after',), small, f'{limit / small:.2g} times enlarged'))
    fig = figure(1.2 + 1.6 * len(rows))
    axes = fig.subplots(
        1 + len(rows), 1, sharex=True, gridspec_kw={'height_ratios': [0.8, *[1.5] * len(rows)]}
    )
    t = piece.t
    k = envelope(piece.v)
    axes[0].plot(t[k], piece.v[k], color=COLOURS['measured'], linewidth=1.0)
    tidy(axes[0], '', 'voltage / V')
    _shade(list(axes), piece)
    for ax, (names, end, said) in zip(axes[1:], rows, strict=True):
        unit, scale = length_unit(end)
        for name, label, colour in STATES:
            if name in names:
                wide = 2.2 if name == 'given' else 0.8
                _trace(ax, t, scale * getattr(residual, name), residual.sound, colour, label, wide)
        end = 1.08 * scale * end if end > 0.0 else 1.0
        ax.set_ylim(-end, end)
        ax.axhline(0.0, color='#555555', linewidth=0.6, zorder=1)
        tidy(ax, 'time / s' if ax is axes[-1] else '', f'residual / {unit}')
        percent_axis(ax, scale * stroke)
        legend_above(ax)
        if said:
            note(ax, said)
    if largest > limit:
        note(axes[1], f'axis cut; largest {1e6 * largest:.3g} µm')
    axes[0].margins(x=0.005)
    fig.align_ylabels(list(axes))
    return fig


def _largest(residual: Residual, *names: str) -> tuple[float, float]:
    """Return the largest residual of some states, and where to end an axis; spikes may be cut."""
    sizes = [np.abs(getattr(residual, name)[residual.sound]) for name in names]
    largest = max(float(x.max()) for x in sizes)
    usual = FAR * max(float(np.quantile(x, USUAL)) for x in sizes)
    return largest, usual if 0.0 < usual < largest else largest


def _trace(
    axes: Axes,
    t: NDArray[np.float64],
    e: NDArray[np.float64],
    sound: NDArray[np.bool_],
    colour: str,
    label: str,
    width: float,
) -> None:
    """Draw a residual; samples that do not count leave a gap."""
    good = np.flatnonzero(sound)
    k = envelope(np.interp(np.arange(e.size), good, e[good]))
    y = np.where(sound, e, np.nan)[k]
    axes.plot(t[k], y, color=colour, linewidth=width, label=label)


def _shade(axes: Sequence[Axes], piece: Piece) -> None:
    """Shade the segments that drive the stage, and name them above the first of the axes."""
    stretches = [(s.label, s.start, s.stop) for s in piece.segments]
    if len(stretches) > NAMED:
        # many short ones of a kind are shown as one
        joined = []
        for kind, each in groupby(piece.segments, key=lambda s: s.kind):
            group = list(each)
            label = group[0].label if len(group) == 1 else f'{len(group)} × {kind}'
            joined.append((label, group[0].start, group[-1].stop))
        stretches = joined
    t, dt = piece.t, piece.dt
    longest = sorted(stretches, key=lambda s: s[1] - s[2])[:NAMED]
    driven = [s for s in stretches if s[0].partition(':')[0] not in ('idle', 'ramp')]
    for i, (label, start, stop) in enumerate(driven):
        first, last = t[start], t[stop - 1] + dt
        for each_axes in axes:
            each_axes.axvspan(first, last, color=TINTS[i % 2], linewidth=0.0, zorder=0)
        if (label, start, stop) in longest:
            axes[0].annotate(
                safe(label if len(label) <= SHORT else f'{label[: SHORT - 1]}…'),
                (0.5 * (first + last), 1.0),
                xycoords=('data', 'axes fraction'),
                xytext=(-3, 3),
                textcoords='offset points',
                ha='left',
                va='bottom',
                rotation=30,
                rotation_mode='anchor',
                fontsize=SMALL,
            )

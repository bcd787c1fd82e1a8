# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The looks of the pictures: colours, fonts, axes, and long traces without loss of their extremes.

Every setting is one of a figure: pyplot and the global settings stay as they are.  Pictures can
be drawn from any thread, and beside other pictures of a lab.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import io
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
import numpy as np
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.common.errors import printable

# Okabe and Ito's palette: told apart with every common colour vision, and by lightness in grey
BLACK, BLUE, VERMILION = '#000000', '#0072B2', '#D55E00'
GREEN, ORANGE, PURPLE = '#009E73', '#E69F00', '#CC79A7'
GREY, ZERO = '#7A7A7A', '#555555'

#: colour of each trace in every picture; 'under' is the measured trace below the model's
COLOURS = {
    'measured': BLACK,
    'under': '#B0B0B0',
    'model': BLUE,
    'static': VERMILION,
    'held out': '#FFF3D6',
    'band': '#C9C9C9',
    'mark': GREEN,
}

#: text width of an A4 page [inch]; pictures are drawn at the size at which they are read
WIDTH = 7.0
#: [points]
SMALL, NORMAL = 8.0, 9.0
#: points of one trace; two a pixel column are enough to show every extreme
POINTS = 3000
#: dots an inch: sharp in print at the size drawn
DPI = 160
#: an axis ends at this many times the usual error, if the largest one is this much further out
USUAL, ROOM, FAR = 0.995, 2.5, 1.6
#: largest error, in the unit of its axis, that floating-point numbers explain
ROUNDING = 1e-6


class NothingToDraw(Exception):
    """The data hold nothing for a picture; the message says why."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A drawn picture; its name is the file name without the ending."""

    name: str
    title: str
    caption: str
    figure: Figure


#: name, title and caption of a picture, and the function that draws it
Wanted = tuple[str, str, str, Callable[[], Figure]]


@dataclass(frozen=True, eq=False)
class Drawn:
    """Pictures of a result, and the title of each that the data do not allow, with the reason."""

    pictures: tuple[Picture, ...]
    left_out: tuple[tuple[str, str], ...]


def draw_each(wanted: Sequence[Wanted], tick: Callable[[float], None]) -> Drawn:
    """Draw what the data allow; `tick` takes the share that is done, and may raise."""
    pictures, left_out = [], []
    for i, (name, title, caption, make) in enumerate(wanted):
        tick(i / len(wanted))
        try:
            pictures.append(Picture(name, title, caption, make()))
        except NothingToDraw as reason:
            left_out.append((title, str(reason)))
    return Drawn(tuple(pictures), tuple(left_out))


def png(picture: Figure, dpi: int | None = None) -> bytes:
    """Render a figure as PNG."""
    buffer = io.BytesIO()
    picture.savefig(buffer, format='png', dpi=dpi or DPI)
    return buffer.getvalue()


def safe(text: str, longest: int = 60) -> str:
    """Escape mathematics and control characters in a text, and shorten it."""
    one_line = printable(text)
    if len(one_line) > longest:
        one_line = one_line[: longest - 3] + '...'
    return one_line.replace('$', r'\$')


def figure(height: float, width: float = WIDTH) -> Figure:
    """Make an empty white figure [inch] that keeps its labels apart."""
    return Figure(figsize=(width, height), layout='constrained', facecolor='white')


def tidy(axes: Axes, xlabel: str = '', ylabel: str = '', title: str = '') -> Axes:
    """Label an axes, and remove the spines at the top and at the right."""
    axes.set_xlabel(xlabel, fontsize=NORMAL)
    axes.set_ylabel(ylabel, fontsize=NORMAL)
    if title:
        axes.set_title(title, fontsize=NORMAL, loc='left')
    axes.tick_params(which='both', labelsize=SMALL, direction='out')
    axes.xaxis.get_offset_text().set_fontsize(SMALL)
    axes.yaxis.get_offset_text().set_fontsize(SMALL)
    for side in ('top', 'right'):
        axes.spines[side].set_visible(False)
    axes.grid(True, which='major', color='#E6E6E6', linewidth=0.6)
    axes.set_axisbelow(True)
    return axes


def legend(axes: Axes, **options: Any) -> None:
    """Add a legend where it covers the least."""
    defaults: dict[str, Any] = {'fontsize': SMALL, 'frameon': True, 'framealpha': 0.85}
    axes.legend(**{**defaults, 'edgecolor': 'none', 'borderpad': 0.3, **options})


def length_unit(largest: float) -> tuple[str, float]:
    """Choose the unit in which lengths up to `largest` [m] read best, and its factor."""
    if largest >= 1e-6:
        return 'µm', 1e6
    return ('nm', 1e9) if largest >= 1e-9 else ('pm', 1e12)


def axis_limit(errors: Array) -> tuple[float, float]:
    """Choose the end of an axis of errors, which cuts rare spikes; return it and the largest."""
    sizes = np.abs(errors[~np.isnan(errors)])
    largest = float(sizes.max(initial=0.0))
    usual = ROOM * float(np.quantile(sizes, USUAL)) if sizes.size else 0.0
    return (usual if 0.0 < FAR * usual < largest else largest), largest


def cut_text(largest: float, limit: float, unit: str, scale: float) -> str:
    """Say that an axis is cut at `limit`, and the largest error; empty if nothing is cut."""
    return f'axis cut; largest {scale * largest:.3g} {unit}' if largest > limit else ''


def symmetric(axes: Axes, limit: float) -> None:
    """Let an axis of errors end at `limit` to both sides, and mark zero."""
    end = 1.08 * limit if limit > ROUNDING else 1.0
    axes.set_ylim(-end, end)
    axes.axhline(0.0, color=ZERO, linewidth=0.6, zorder=1)


def envelope(y: Array, points: int = POINTS) -> Integers:
    """
    Choose the samples that show every extreme of a trace: about `points`, or all of a short one.

    A long trace keeps the smallest and the largest sample of each stretch.  A stretch of NaN keeps
    a NaN, which breaks the line.
    """
    if y.size <= points:
        return np.arange(y.size)
    stretch = -(-2 * y.size // points)
    whole = y.size // stretch * stretch
    above, below = (np.where(np.isnan(y), x, y) for x in (np.inf, -np.inf))
    first = np.arange(whole // stretch) * stretch
    kept = [
        first + above[:whole].reshape(-1, stretch).argmin(axis=1),
        first + below[:whole].reshape(-1, stretch).argmax(axis=1),
    ]
    if whole < y.size:
        kept.append(whole + np.array([above[whole:].argmin(), below[whole:].argmax()]))
    return np.unique(np.concatenate([*kept, [0, y.size - 1]]))


def line(
    axes: Axes, x: Array, y: Array, colour: str, label: str | None = None, **options: Any
) -> None:
    """Draw a trace by its envelope, shapes (n,)."""
    k = envelope(y)
    axes.plot(x[k], y[k], color=colour, label=label, **{'linewidth': 1.0, **options})


def plain_log(axis: Axis, low: float, high: float, most: float = 3.0) -> None:
    """Write plain numbers on a logarithmic axis; of more than `most` decades the tens alone."""
    decades = float(np.log10(high / low))
    subs: tuple[float, ...] = (1.0,) if decades > most else (1.0, 2.0, 5.0)
    if decades < 0.5:
        subs = tuple(float(k) for k in range(1, 10))
    axis.set_major_locator(LogLocator(subs=subs, numticks=20))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f'{value:g}'))
    axis.set_minor_locator(LogLocator(subs=tuple(float(k) for k in range(1, 10)), numticks=20))
    axis.set_minor_formatter(NullFormatter())


def log_range(axes: Axes, least: float) -> None:
    """Widen a logarithmic y axis that spans less than a factor, and write plain numbers on it."""
    low, high = axes.get_ylim()
    wider = max(1.0, float(np.sqrt(least * low / high)))
    axes.set_ylim(low / wider, high * wider)
    plain_log(axes.yaxis, *axes.get_ylim())


def percent_axis(axes: Axes, stroke: float) -> None:
    """Add a right-hand axis in % of stroke; `stroke` in the unit of the left one."""
    if stroke <= 0.0:
        return
    both = (lambda e: 100.0 * e / stroke, lambda p: p * stroke / 100.0)
    right = axes.secondary_yaxis('right', functions=both)
    right.set_ylabel('% of stroke', fontsize=NORMAL)
    right.tick_params(labelsize=SMALL)


def note(axes: Axes, text: str) -> None:
    """Write a remark above the right end of an axes, where it covers no data."""
    axes.set_title(text, fontsize=SMALL, loc='right', color='#444444', pad=3.0)


def legend_above(axes: Axes) -> None:
    """Add a legend in one line above the left end of an axes."""
    place: dict[str, Any] = {'loc': 'lower left', 'bbox_to_anchor': (0.0, 0.98), 'ncols': 4}
    legend(axes, borderaxespad=0.0, handlelength=1.6, columnspacing=1.4, **place)


def name_above(axes: Axes, text: str, x: float, rotation: float = 30.0, **options: Any) -> None:
    """Write a name above an axes at `x` in its data, at an angle unless that is zero."""
    at: dict[str, Any] = {'xycoords': ('data', 'axes fraction'), 'textcoords': 'offset points'}
    at |= {'xytext': (0, 2), 'ha': 'left' if rotation else 'center', 'va': 'bottom'}
    at |= {'rotation': rotation, 'rotation_mode': 'anchor', 'fontsize': SMALL}
    axes.annotate(safe(text, 20), (x, 1.0), **at, **options)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures of the residual before and after: over time, frequency, voltage, speed and lag."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.diagnosis.results import Residual
from piezo_ident.record.record import Piece
from piezo_ident.report.figures import style
from piezo_ident.report.figures.style import COLOURS, NothingToDraw, tidy
from piezo_ident.report.table import number
from piezo_ident.residual.analysis import Curve, ResidualAnalysis
from piezo_ident.residual.stretches import ResidualPart
from scipy import signal

#: attribute of `Residual`, name, colour
STATES = (
    ('given', 'as given', '#9A9A9A'),
    ('before', 'H refitted, nothing added', COLOURS['static']),
    ('after', 'refined', COLOURS['model']),
)
#: names of segments that have room above a picture
NAMES = 24
#: kinds of segments that are not shaded, and the shades of two side by side
UNSHADED = ('idle', 'ramp')
TINTS = ('#E9EEF3', '#F4F0E6')
#: so many times smaller, the rest is drawn once more on a scale of its own
ENLARGED = 4.0
#: points of a spectrum in a decade; samples that are transformed at once
PER_DECADE, LONGEST = 150, 2**17
#: title of the axis of each quantity
AXES = {
    'v': 'voltage / V',
    'dv/dt': 'dv/dt / V s$^{-1}$',
    'time since the step': 'time since the step / s',
}


def differ(residuals: Sequence[Residual]) -> bool:
    """Tell whether the refined model differs from the given model by more than a refitted H."""
    return not any(
        all(np.array_equal(getattr(r, name), r.after) for r in residuals)
        for name in ('given', 'before')
    )


def residual_figure(residual: Residual) -> Figure:
    """
    Draw the residual of a piece before and after, on one scale, its segments shaded.

    NothingToDraw when no sample counts.
    """
    if not residual.sound.any():
        raise NothingToDraw(f'{residual.record}: none of {residual.sound.size} samples counts')
    piece, stroke = residual.piece, float(np.ptp(residual.piece.y))
    e = {name: getattr(residual, name)[residual.sound] for name, _, _ in STATES}
    limit, _ = style.axis_limit(np.concatenate(list(e.values())))
    rows: list[tuple[tuple[str, ...], float, str]] = [(('given', 'before'), limit, '')]
    last = 'before'
    if differ([residual]):
        last = 'after'
        rows.append(((last,), limit, 'on the same scale'))
    small, _ = style.axis_limit(e[last])
    if 0.0 < small < limit / ENLARGED:
        rows.append(((last,), small, f'{number(limit / small, 2)} times enlarged'))
    fig = style.figure(1.2 + 1.6 * len(rows))
    ratios = {'height_ratios': [0.8, *[1.5] * len(rows)]}
    axes = fig.subplots(1 + len(rows), 1, sharex=True, gridspec_kw=ratios)
    k = style.envelope(piece.v)
    axes[0].plot(piece.t[k], piece.v[k], color=COLOURS['measured'], linewidth=1.0)
    tidy(axes[0], '', 'voltage / V')
    _shade(list(axes), piece)
    for ax, (names, end, remark) in zip(axes[1:], rows, strict=True):
        unit, scale = style.length_unit(end)
        largest = max(float(np.abs(e[name]).max()) for name in names)
        cut = style.cut_text(largest, end, unit, scale)
        for name, label, colour in STATES:
            if name in names:
                _trace(ax, residual, name, scale, colour, label)
        style.symmetric(ax, scale * end)
        tidy(ax, 'time / s' if ax is axes[-1] else '', f'residual / {unit}')
        style.percent_axis(ax, scale * stroke)
        style.legend_above(ax)
        style.note(ax, '; '.join(filter(None, (remark, cut))))
    axes[0].margins(x=0.005)
    fig.align_ylabels(list(axes))
    return fig


def _trace(
    axes: Axes, residual: Residual, name: str, scale: float, colour: str, label: str
) -> None:
    # samples that do not count leave a gap
    e, good = scale * getattr(residual, name), np.flatnonzero(residual.sound)
    k = style.envelope(np.interp(np.arange(e.size), good, e[good]))
    y = np.where(residual.sound, e, np.nan)[k]
    width = 2.2 if name == 'given' else 0.8
    axes.plot(residual.piece.t[k], y, color=colour, linewidth=width, label=label)


def _shade(axes: Sequence[Axes], piece: Piece) -> None:
    """Shade the segments that drive the stage, and name the longest that have room for it."""
    driven = [s for s in piece.segments if s.kind not in UNSHADED]
    for i, s in enumerate(driven):
        first, last = piece.t[s.start], piece.t[s.stop - 1] + piece.dt
        for each in axes:
            each.axvspan(first, last, color=TINTS[i % 2], linewidth=0.0, zorder=0)
    named: list[float] = []
    for s in sorted(driven, key=lambda s: -s.n):
        middle = 0.5 * (piece.t[s.start] + piece.t[s.stop - 1] + piece.dt)
        if all(abs(middle - other) >= piece.duration / NAMES for other in named):
            style.name_above(axes[0], s.label, middle)
            named.append(middle)


def _both(
    before: ResidualAnalysis, after: ResidualAnalysis | None
) -> list[tuple[ResidualAnalysis, str, str]]:
    """List the compared analyses with colours and names."""
    if after is None:
        return [(before, style.VERMILION, 'residual')]
    return [(before, style.VERMILION, 'before'), (after, style.BLUE, 'after')]


def _density(part: ResidualPart) -> tuple[Array, Array]:
    """Compute frequency [Hz] and amplitude density [m/sqrt(Hz)] of the longest sound stretch."""
    start, stop = max(part.runs(), key=lambda r: r[1] - r[0])
    n = min(stop - start, LONGEST)
    f, power = signal.welch(
        part.e[start:stop], part.piece.sample_rate, nperseg=n, detrend='linear'
    )
    # the first bins hold the rest of the trend; means over equal parts of a decade keep the power
    f, power = f[2:-1], power[2:-1]
    k = np.floor(PER_DECADE * np.log10(f / f[0])).astype(np.int64)
    count = np.bincount(k)
    means = [np.bincount(k, x)[count > 0] / count[count > 0] for x in (f, power)]
    return means[0], np.sqrt(means[1])


def residual_spectrum_figure(
    before: ResidualAnalysis, after: ResidualAnalysis | None = None
) -> Figure:
    """
    Draw the amplitude density of the longest residual, the noise floor, and the lines in it.

    NothingToDraw when no stretch is long enough for a spectrum.
    """
    i = max(range(len(before.parts)), key=lambda i: before.parts[i].piece.n)
    longest = before.parts[i]
    if max((b - a for a, b in longest.runs()), default=0) < 64 or not np.any(longest.e):
        raise NothingToDraw('no stretch is long enough for a spectrum')
    fig = style.figure(3.6)
    axes = fig.subplots()
    top, bottom, first, last = 0.0, np.inf, np.inf, 0.0
    for analysis, colour, label in _both(before, after):
        if not np.any(analysis.parts[i].e):
            continue
        f, density = _density(analysis.parts[i])
        axes.loglog(f, 1e9 * density, color=colour, linewidth=0.8, label=label)
        top, bottom = max(top, density.max()), min(bottom, float(np.quantile(density, 0.01)))
        first, last = min(first, f[0]), max(last, f[-1])
    floor = before.floor
    if floor.frequency.size > 2:
        noise = 1e9 * np.sqrt(floor.density[1:-1])
        axes.loglog(floor.frequency[1:-1], noise, 'k--', linewidth=1.0, label='noise floor')
    for each in before.lines:
        for order, tone in [(1, each), *each.harmonics]:
            _mark_line(axes, tone.frequency, tone.amplitude, order)
    if before.lines:
        axes.plot([], [], color=style.GREEN, linewidth=0.8, linestyle=':', label='lines')
    tidy(axes, 'frequency / Hz', 'residual / nm Hz$^{-1/2}$')
    axes.set_xlim(first, last)
    # room for the names of the lines
    reach = 3.0 if not before.lines else 30.0
    axes.set_ylim(0.3e9 * bottom, reach * 1e9 * top)
    style.plain_log(axes.xaxis, first, last)
    if np.log10(top / bottom) < 4.0:
        style.plain_log(axes.yaxis, 0.3e9 * bottom, reach * 1e9 * top)
    style.legend(axes, loc='lower left')
    return fig


def _mark_line(axes: Axes, frequency: float, amplitude: float, order: int) -> None:
    axes.axvline(frequency, color=style.GREEN, linewidth=0.8, linestyle=':', zorder=1)
    text = f'{frequency:.4g} Hz, {1e9 * amplitude:.2g} nm'
    at: dict[str, Any] = {'xycoords': ('data', 'axes fraction'), 'textcoords': 'offset points'}
    at |= {'xytext': (2, -2), 'ha': 'left', 'va': 'top', 'rotation': 90, 'color': style.GREEN}
    text = text if order == 1 else f'{text} (× {order})'
    axes.annotate(text, (frequency, 1.0), fontsize=style.SMALL - 1.0, **at)


def residual_dependence_figure(
    before: ResidualAnalysis, after: ResidualAnalysis | None = None
) -> Figure:
    """
    Draw the mean residual over voltage, speed, and the time since the last step.

    NothingToDraw when no curve has points.
    """
    names = [name for name in AXES if _curves(before, name)]
    if not names:
        raise NothingToDraw('the residual has no curve with two points or more')
    rows = -(-len(names) // 2)
    fig = style.figure(2.7 * rows)
    grid = fig.subplots(rows, min(2, len(names)), squeeze=False)
    means = [np.abs(c.mean).max(initial=0.0) for name in names for c in _curves(before, name)]
    unit, scale = style.length_unit(float(max(means)))
    for axes, name in zip(grid.ravel(), names, strict=False):
        sizes = []
        for analysis, colour, label in _both(before, after):
            curves = _curves(analysis, name)
            for curve in curves:
                _draw_curve(axes, curve, scale, colour, label if after is not None else '')
            if curves:
                mean = np.concatenate([curve.mean for curve in curves])
                sizes.append(f'{scale * float(np.sqrt(np.mean(mean**2))):.2g}')
        axes.axhline(0.0, color=style.ZERO, linewidth=0.6, zorder=1)
        tidy(axes, AXES[name], f'mean residual / {unit}')
        if name.startswith('time'):
            axes.set_xscale('log')
            low, high = axes.get_xlim()
            style.plain_log(axes.xaxis, low, high, 1.7)
        elif name == 'dv/dt':
            _signed_log(axes, _curves(before, name))
        # a share would be one of another residual before and after
        style.note(axes, f'rms of the curves: {" → ".join(sizes)} {unit}')
    free = grid.ravel()[len(names) :]
    for axes in free:
        axes.set_axis_off()
    entries: dict[str, Any] = {}
    for axes in grid.ravel()[: len(names)]:
        lines, labels = axes.get_legend_handles_labels()
        entries |= dict(zip(labels, lines, strict=True))
        if not free.size:
            style.legend(axes)
    if free.size:
        # an empty place holds the legend of all, and covers no curve
        style.legend(free[0], handles=list(entries.values()), labels=list(entries), loc='center')
    fig.align_ylabels(list(grid.ravel()))
    return fig


def _curves(analysis: ResidualAnalysis, against: str) -> list[Curve]:
    return [c for c in analysis.curves if c.against == against and c.x.size > 1]


def _draw_curve(axes: Axes, curve: Curve, scale: float, colour: str, label: str) -> None:
    branch = {'up': 'rising', 'down': 'falling', 'both': ''}[curve.branch]
    name = ', '.join(filter(None, (label, branch))) or 'along the drive'
    look: dict[str, Any] = {'color': colour, 'linewidth': 1.1, 'markersize': 3.0}
    if curve.branch == 'down':
        look |= {'linestyle': '--', 'marker': 'v', 'markerfacecolor': 'white'}
    else:
        look |= {'marker': '^' if curve.branch == 'up' else 'o'}
    mean, std = scale * curve.mean, scale * curve.std
    band: dict[str, Any] = {'color': colour, 'alpha': 0.18, 'linewidth': 0}
    axes.fill_between(curve.x, mean - 2 * std, mean + 2 * std, **band)
    axes.plot(curve.x, mean, label=name, **look)


def _signed_log(axes: Axes, curves: Sequence[Curve]) -> None:
    """Make an axis of speeds logarithmic to both sides where they span decades."""
    sizes = np.abs(np.concatenate([c.x for c in curves]))
    sizes = sizes[sizes > 0.0]
    if sizes.size == 0 or sizes.max() < 30.0 * np.quantile(sizes, 0.1):
        return
    # at most four decades to a side, and two ticks
    slowest = max(float(np.quantile(sizes, 0.1)), 1e-4 * float(sizes.max()))
    first, last = np.floor(np.log10(slowest)), np.floor(np.log10(sizes.max()))
    axes.set_xscale('symlog', linthresh=10.0**first, linscale=0.3)
    ticks = 10.0 ** np.array([np.ceil(0.5 * (first + last)), last])
    ticks = np.concatenate([-ticks[::-1], [0.0], ticks])
    axes.set_xticks(ticks, [f'{x:g}' for x in ticks])
    axes.minorticks_off()


def residual_coherence_figure(
    before: ResidualAnalysis, after: ResidualAnalysis | None = None
) -> Figure:
    """Draw the coherence of voltage and residual; NothingToDraw when there is too little data."""
    first = before.coherence
    if first is None:
        n = sum(part.piece.n for part in before.parts)
        raise NothingToDraw(f'{n} samples are too few for a coherence')
    fig = style.figure(2.7)
    axes = fig.subplots()
    shares = []
    for analysis, colour, label in _both(before, after):
        c = analysis.coherence
        if c is None:
            continue
        value = np.where(c.tested, c.coherence, np.nan)
        axes.plot(c.frequency, value, color=colour, linewidth=0.8, label=label)
        shares.append(f'{100.0 * c.share:.1f} %')
    axes.axhline(first.bound, color='k', linewidth=1.0, linestyle='--', label='99 % bound')
    tidy(axes, 'frequency / Hz', 'coherence with v')
    axes.set_xscale('log')
    axes.set_ylim(-0.02, 1.05)
    low = float(first.frequency[1])
    high = 1.1 * float(first.frequency[first.tested].max(initial=2.0 * low))
    axes.set_xlim(low, high)
    style.plain_log(axes.xaxis, low, high)
    style.note(axes, f'coherent share of the residual: {" → ".join(shares)}')
    style.legend_above(axes)
    return fig

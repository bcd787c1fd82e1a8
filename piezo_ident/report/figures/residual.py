# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""A residual before and after an effect was added: over time and frequency, by segment."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from piezo_ident.report.figures.style import (
    BLUE,
    COLOURS,
    envelope,
    figure,
    GREEN,
    GREY,
    legend,
    legend_above,
    length_unit,
    line,
    NORMAL,
    note,
    NothingToDraw,
    percent_axis,
    plain_log,
    safe,
    SMALL,
    tidy,
    VERMILION,
)
from piezo_ident.residual import ResidualAnalysis, ResidualPart
from scipy import fft, signal

__all__ = [
    'residual_errors_figure',
    'residual_spectrum_figure',
    'residual_time_figure',
]

BEFORE, AFTER = VERMILION, BLUE
#: at most so many segments are named over a trace, and have bars
NAMES, BARS = 24, 24
#: points of a spectrum in a decade; longest stretch that is transformed [samples]
PER_DECADE, LONGEST = 150, 2**21


def _limits(residuals: Sequence[NDArray[np.float64]]) -> tuple[float, float, float]:
    """Return the ends of an axis for some residuals, and the largest; rare spikes may be cut."""
    low = high = largest = 0.0
    for e in residuals:
        bottom, top = np.quantile(e, [0.0005, 0.9995])
        wide = 0.3 * (top - bottom)
        low = min(low, max(float(e.min()), float(bottom - wide)))
        high = max(high, min(float(e.max()), float(top + wide)))
        largest = max(largest, float(np.abs(e).max()))
    room = 0.06 * (high - low) or 1e-12
    return low - room, high + room, largest


def _matching(after: ResidualAnalysis | None, part: ResidualPart) -> ResidualPart | None:
    """Return the part of another analysis that comes from the same piece."""
    for other in after.parts if after is not None else ():
        same = other.record == part.record and other.piece.n == part.piece.n
        if same and other.piece.start_time == part.piece.start_time:
            return other
    return None


def residual_time_figure(
    before: ResidualAnalysis, after: ResidualAnalysis | None = None, part: int | None = None
) -> Figure:
    """
    Draw the residual over time, with the segments shaded.

    Parameters
    ----------
    before : ResidualAnalysis
    after : ResidualAnalysis, optional
        Of the refined model on the same records.
    part : int, optional
        Number of the part; the longest when absent.

    Raises
    ------
    NothingToDraw
        When the part has no sound sample.
    """
    shown = max(before.parts, key=lambda p: p.piece.n) if part is None else before.parts[part]
    if not shown.mask.any():
        raise NothingToDraw('no sample of this record is sound')
    other = _matching(after, shown)
    t, v = shown.piece.t, shown.piece.v
    fig = figure(4.2)
    drive, axes = fig.subplots(2, 1, sharex=True, gridspec_kw={'height_ratios': [1.0, 2.4]})
    line(drive, t, v, COLOURS['measured'], linewidth=0.8)
    low, high, largest = _limits([p.e[p.mask] for p in (shown, other) if p is not None])
    limit = max(-low, high)
    unit, scale = length_unit(limit)
    for each, colour, name in ((shown, BEFORE, 'before'), (other, AFTER, 'after')):
        if each is not None:
            e = np.where(each.mask, scale * each.e, np.nan)
            rms = scale * float(np.sqrt(np.mean(each.e[each.mask] ** 2)))
            label = f'{name if other is not None else "residual"}: rms {rms:.3g} {unit}'
            _broken_line(axes, t, e, colour, label)
    if before.floor.rms is not None and before.floor.rms > 0.01 * limit:
        floor = scale * before.floor.rms
        axes.axhspan(
            -2 * floor,
            2 * floor,
            color=COLOURS['band'],
            alpha=0.7,
            zorder=2.6,
            linewidth=0,
            label='± 2 noise floors',
        )
    tidy(drive, '', 'voltage / V')
    tidy(axes, 'time / s', f'residual / {unit}')
    axes.set_ylim(scale * low, scale * high)
    axes.axhline(0.0, color='#555555', linewidth=0.6, zorder=1)
    if largest > limit:
        note(axes, f'axis cut; largest {scale * largest:.3g} {unit}')
    drive.margins(x=0.005)
    _shade_segments(drive, axes, shown)
    percent_axis(axes, scale * before.stroke)
    legend_above(axes)
    fig.align_ylabels([drive, axes])
    return fig


def _broken_line(
    axes: Axes, t: NDArray[np.float64], e: NDArray[np.float64], colour: str, label: str
) -> None:
    """Draw the sound stretches of a trace by their envelopes."""
    known = np.isfinite(e)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], known.astype(np.int8), [0]])))
    stretches = list(zip(edges[::2], edges[1::2], strict=True))
    points = max(20, 6000 // max(len(stretches), 1))
    for i, (a, b) in enumerate(stretches):
        share = max(20, int(points * len(stretches) * (b - a) / e.size))
        _envelope_line(axes, t[a:b], e[a:b], colour, label if i == 0 else None, share)


def _envelope_line(
    axes: Axes,
    t: NDArray[np.float64],
    e: NDArray[np.float64],
    colour: str,
    label: str | None,
    points: int,
) -> None:
    k = envelope(e, points)
    axes.plot(t[k], e[k], color=colour, linewidth=0.6, label=label)


def _shade_segments(drive: Axes, axes: Axes, part: ResidualPart) -> None:
    """Shade every other segment, and name those that are long enough to carry a name."""
    segments = part.piece.segments
    t = part.piece.t
    whole = float(t[-1] - t[0]) or 1.0
    last = -np.inf
    shaded = False
    for s in segments:
        start, stop = float(t[s.start]), float(t[s.stop - 1])
        shaded = not shaded and s.kind not in ('idle', 'ramp')
        if shaded:
            for each in (drive, axes):
                each.axvspan(start, stop, color='#EFEFEF', linewidth=0, zorder=0)
        named = s.kind not in ('idle', 'ramp')
        # names stand at an angle: the next one needs some way to the right
        middle = 0.5 * (start + stop)
        if not named or middle - last < 0.03 * whole:
            continue
        last = middle
        drive.annotate(
            safe(s.label),
            (middle, 1.0),
            xycoords=('data', 'axes fraction'),
            xytext=(0, 2),
            textcoords='offset points',
            ha='left',
            va='bottom',
            rotation=35,
            rotation_mode='anchor',
            fontsize=SMALL - 1.0,
        )


def _density(part: ResidualPart) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frequency [Hz] and amplitude density [m/sqrt(Hz)] of the longest sound stretch."""
    start, stop = max(part.runs(), key=lambda r: r[1] - r[0])
    x = signal.detrend(part.e[start : min(stop, start + LONGEST)])
    window = signal.windows.hann(x.size)
    rate = part.piece.sample_rate
    size = fft.next_fast_len(x.size, real=True)
    power = 2.0 * np.abs(fft.rfft(window * x, size)) ** 2 / (rate * float(window @ window))
    f = np.arange(power.size) * rate / size
    # the first two bins are what is left of the trend
    f, power = f[2:-1], power[2:-1]
    k = np.floor(PER_DECADE * np.log10(f / f[0])).astype(np.int64)
    count = np.bincount(k)
    used = count > 0
    # the mean of a bin keeps its power, so a narrow line still stands out
    return (
        (np.bincount(k, f)[used] / count[used]),
        np.sqrt(np.bincount(k, power)[used] / count[used]),
    )


def residual_spectrum_figure(
    before: ResidualAnalysis, after: ResidualAnalysis | None = None, part: int | None = None
) -> Figure:
    """
    Draw the amplitude density of the residual, the noise floor, and the lines found.

    Parameters
    ----------
    before : ResidualAnalysis
    after : ResidualAnalysis, optional
    part : int, optional
        Number of the part; the longest when absent.

    Raises
    ------
    NothingToDraw
        When no stretch is long enough for a spectrum.
    """
    shown = max(before.parts, key=lambda p: p.piece.n) if part is None else before.parts[part]
    if max((b - a for a, b in shown.runs()), default=0) < 64 or not np.any(shown.e):
        raise NothingToDraw('no stretch is long enough for a spectrum')
    other = _matching(after, shown)
    fig = figure(3.6)
    axes = fig.subplots()
    top, bottom, first, last = 0.0, np.inf, np.inf, 0.0
    for each, colour, name in ((shown, BEFORE, 'before'), (other, AFTER, 'after')):
        if each is None or not np.any(each.e):
            continue
        f, density = _density(each)
        label = name if other is not None else 'residual'
        axes.loglog(f, 1e9 * density, color=colour, linewidth=0.8, label=label)
        top, bottom = max(top, density.max()), min(bottom, float(np.quantile(density, 0.01)))
        first, last = min(first, f[0]), max(last, f[-1])
    floor = before.floor
    if floor.frequency.size > 2:
        axes.loglog(
            floor.frequency[1:-1],
            1e9 * np.sqrt(floor.density[1:-1]),
            color='black',
            linewidth=1.0,
            linestyle='--',
            label='noise floor',
        )
    _mark_lines(axes, before)
    tidy(axes, 'frequency / Hz', 'residual / nm Hz$^{-1/2}$')
    axes.set_xlim(first, last)
    # room for the names of the lines
    reach = 3.0 if not before.lines.lines else 30.0
    axes.set_ylim(0.3e9 * bottom, reach * 1e9 * top)
    plain_log(axes.xaxis, first, last)
    if np.log10(top / bottom) < 4.0:
        plain_log(axes.yaxis, 0.3e9 * bottom, reach * 1e9 * top)
    legend(axes, loc='lower left')
    return fig


def _mark_lines(axes: Axes, analysis: ResidualAnalysis) -> None:
    for each in analysis.lines.lines:
        marks = [(1, each), *each.harmonics]
        for order, found in marks:
            axes.axvline(found.frequency, color=GREEN, linewidth=0.8, linestyle=':', zorder=1)
            text = f'{found.frequency:.4g} Hz, {1e9 * found.amplitude:.2g} nm'
            axes.annotate(
                text if order == 1 else f'{text} (× {order})',
                (found.frequency, 1.0),
                xycoords=('data', 'axes fraction'),
                xytext=(2, -2),
                textcoords='offset points',
                ha='left',
                va='top',
                rotation=90,
                fontsize=SMALL - 1.0,
                color=GREEN,
            )


def residual_errors_figure(
    before: ResidualAnalysis, after: ResidualAnalysis | None = None
) -> Figure:
    """
    Draw bars of the error by segment and by frequency, before and after.

    Parameters
    ----------
    before : ResidualAnalysis
    after : ResidualAnalysis, optional

    Raises
    ------
    NothingToDraw
        When there is no segment.
    """
    several = len({row.record for row in before.segments}) > 1
    keys = [
        (row.record, row.segment, row.start_time)
        for row in before.segments
        if row.segment.partition(':')[0] != 'ramp'
    ]
    keys = keys or [(row.record, row.segment, row.start_time) for row in before.segments]
    if not keys:
        raise NothingToDraw('there is no segment')
    own = {(r.record, r.segment, r.start_time): r.percent for r in before.segments}
    if len(keys) > BARS:
        largest = sorted(keys, key=lambda key: -own[key])[:BARS]
        keys = [key for key in keys if key in largest]
    other = {
        (r.record, r.segment, r.start_time): r.percent
        for r in (after.segments if after is not None else ())
    }
    frequencies = {
        (r.record, r.segment, r.frequency, r.amplitude): r.percent for r in before.frequencies
    }
    others = {
        (r.record, r.segment, r.frequency, r.amplitude): r.percent
        for r in (after.frequencies if after is not None else ())
    }
    height = 0.9 + 0.21 * max(len(keys), 6)
    fig = figure(height)
    wide = bool(frequencies)
    grid = fig.subplots(
        1, 2 if wide else 1, squeeze=False, gridspec_kw={'width_ratios': [1.25, 1.0][: 1 + wide]}
    )[0]
    names = [safe(f'{record}: {segment}' if several else segment) for record, segment, _ in keys]
    _bars(
        grid[0],
        names,
        [own[key] for key in keys],
        [other.get(key, np.nan) for key in keys] if after is not None else None,
        before.floor_percent,
    )
    grid[0].set_xlabel('rms error by segment / % of stroke', fontsize=NORMAL)
    if wide:
        shown = sorted(frequencies, key=lambda key: (key[2], key[3]))[:BARS]
        _bars(
            grid[1],
            [f'{key[2]:g} Hz, {key[3]:.3g} V' for key in shown],
            [frequencies[key] for key in shown],
            [others.get(key, np.nan) for key in shown] if after is not None else None,
            None,
        )
        grid[1].set_xlabel('steady sines: rms error / %', fontsize=NORMAL)
    legend_above(grid[0])
    return fig


def _bars(
    axes: Axes,
    names: Sequence[str],
    before: Sequence[float],
    after: Sequence[float] | None,
    floor: float | None,
) -> None:
    k = np.arange(len(names))
    thick = 0.38 if after is not None else 0.7
    shift = 0.5 * thick if after is not None else 0.0
    axes.barh(k - shift, before, thick, color=BEFORE, label='before' if after else 'model')
    values = list(before)
    if after is not None:
        axes.barh(k + shift, after, thick, color=AFTER, label='after')
        values += [x for x in after if np.isfinite(x)]
    positive = [x for x in values if x > 0.0]
    tidy(axes, 'rms error / % of stroke')
    if positive and max(positive) > 20.0 * min(positive):
        low = 0.5 * min([*positive, *([floor] if floor else [])])
        axes.set_xscale('log')
        axes.set_xlim(low, 1.6 * max(positive))
        plain_log(axes.xaxis, low, 1.6 * max(positive))
    if floor:
        axes.axvline(floor, color=GREY, linestyle='--', linewidth=1.1, label='noise floor')
    axes.set_yticks(k, names, fontsize=SMALL)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(False, axis='y')

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""On what a residual depends, before and after: curves, coherence and correlation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
import numpy as np
from piezo_ident.report.figures.style import (
    BLUE,
    figure,
    legend,
    legend_above,
    length_unit,
    note,
    NothingToDraw,
    plain_log,
    tidy,
    VERMILION,
)
from piezo_ident.residual import Coherence, CrossCorrelation, Curve, ResidualAnalysis

__all__ = ['residual_correlation_figure', 'residual_dependence_figure']

BEFORE, AFTER = VERMILION, BLUE
#: what each quantity is called on its axis
AXES = {
    'v': 'voltage / V',
    'dv/dt': 'dv/dt / V s$^{-1}$',
    'time since the turn': 'time since the turn / s',
    'time since the step': 'time since the step / s',
}


def residual_dependence_figure(
    before: ResidualAnalysis, after: ResidualAnalysis | None = None
) -> Figure:
    """
    Draw the mean residual over voltage, speed, and the time since the last turn and step.

    Parameters
    ----------
    before : ResidualAnalysis
    after : ResidualAnalysis, optional

    Raises
    ------
    NothingToDraw
        When no curve has points.
    """
    names = [name for name in AXES if any(c.x.size > 1 for c in _curves(before, name))]
    if not names:
        raise NothingToDraw('the residual has no curve with two points or more')
    rows = -(-len(names) // 2)
    fig = figure(2.7 * rows)
    grid = fig.subplots(rows, min(2, len(names)), squeeze=False)
    largest = max(
        float(np.abs(c.mean).max(initial=0.0)) for name in names for c in _curves(before, name)
    )
    unit, scale = length_unit(largest)
    for axes, name in zip(grid.ravel(), names, strict=False):
        own = [(before, BEFORE, 'before')]
        if after is not None:
            own.append((after, AFTER, 'after'))
        shares = []
        for analysis, colour, label in own:
            for curve in _curves(analysis, name):
                _draw_curve(axes, curve, scale, colour, label if after is not None else '')
            curves = _curves(analysis, name)
            if curves:
                shares.append(f'{100.0 * curves[0].share:.0f} %')
        axes.axhline(0.0, color='#555555', linewidth=0.6, zorder=1)
        tidy(axes, AXES[name], f'mean residual / {unit}')
        if name.startswith('time'):
            axes.set_xscale('log')
            low, high = axes.get_xlim()
            plain_log(axes.xaxis, low, high)
        elif name == 'dv/dt':
            _signed_log(axes, _curves(before, name))
        # means over lg t, in which a decade counts as much as any other
        what = 'the means' if name == 'time since the step' else 'the variance'
        note(axes, f'explains {" → ".join(shares)} of {what}')
        legend(axes)
    for axes in grid.ravel()[len(names) :]:
        axes.set_axis_off()
    fig.align_ylabels(list(grid.ravel()))
    return fig


def _curves(analysis: ResidualAnalysis, against: str) -> list[Curve]:
    return [c for c in analysis.curves if c.against == against and c.x.size > 1]


def _draw_curve(axes: Axes, curve: Curve, scale: float, colour: str, label: str) -> None:
    words = {'up': 'rising', 'down': 'falling', 'both': ''}[curve.branch]
    name = ', '.join(filter(None, (label, words))) or 'along the drive'
    style: dict[str, Any] = {'color': colour, 'linewidth': 1.1, 'markersize': 3.0}
    if curve.branch == 'down':
        style |= {'linestyle': '--', 'marker': 'v', 'markerfacecolor': 'white'}
    else:
        style |= {'marker': '^' if curve.branch == 'up' else 'o'}
    mean, std = scale * curve.mean, scale * curve.std
    axes.fill_between(
        curve.x, mean - 2 * std, mean + 2 * std, color=colour, alpha=0.18, linewidth=0
    )
    axes.plot(curve.x, mean, label=name, **style)


def _signed_log(axes: Axes, curves: Sequence[Curve]) -> None:
    """Make an axis of speeds logarithmic to both sides where they span decades."""
    sizes = np.abs(np.concatenate([c.x for c in curves]))
    sizes = sizes[sizes > 0.0]
    if sizes.size == 0 or sizes.max() < 30.0 * np.quantile(sizes, 0.1):
        return
    # four decades to a side, however slow the slowest is
    slowest = max(float(np.quantile(sizes, 0.1)), 1e-4 * float(sizes.max()))
    threshold = 10.0 ** np.floor(np.log10(slowest))
    axes.set_xscale('symlog', linthresh=threshold, linscale=0.3)
    decades = np.arange(np.log10(threshold), np.log10(sizes.max()) + 0.5)
    # ticks that would touch are left out
    decades = decades[1 :: max(1, -(-decades.size // 3))]
    ticks = 10.0**decades
    axes.set_xticks([*(-ticks[::-1]), 0.0, *ticks])
    axes.set_xticklabels([f'{x:g}' for x in (*(-ticks[::-1]), 0.0, *ticks)])
    axes.minorticks_off()


def residual_correlation_figure(
    before: ResidualAnalysis, after: ResidualAnalysis | None = None
) -> Figure:
    """
    Draw the coherence of voltage and residual, and their cross-correlations with their bands.

    Parameters
    ----------
    before : ResidualAnalysis
    after : ResidualAnalysis, optional

    Raises
    ------
    NothingToDraw
        When there is too little data for either.
    """
    if before.coherence is None and not before.correlations:
        raise NothingToDraw('too few samples for coherence and correlation')
    rows = int(before.coherence is not None) + int(bool(before.correlations))
    fig = figure(2.5 * rows)
    grid = fig.add_gridspec(rows, 2)
    at = 0
    both = [(before, BEFORE, 'before')]
    if after is not None:
        both.append((after, AFTER, 'after'))
    if before.coherence is not None:
        axes = fig.add_subplot(grid[0, :])
        at = 1
        shares = []
        for analysis, colour, label in both:
            if analysis.coherence is not None:
                _draw_coherence(axes, analysis.coherence, colour, label)
                shares.append(f'{100.0 * analysis.coherence.share:.1f} %')
        bound = before.coherence.bound
        axes.axhline(bound, color='black', linewidth=1.0, linestyle='--', label='99 % bound')
        tidy(axes, 'frequency / Hz', 'coherence with v')
        axes.set_xscale('log')
        axes.set_ylim(-0.02, 1.05)
        low = float(before.coherence.frequency[1])
        high = float(before.coherence.frequency[before.coherence.tested].max(initial=2.0 * low))
        axes.set_xlim(low, 1.1 * high)
        plain_log(axes.xaxis, low, 1.1 * high)
        note(axes, f'coherent share of the residual: {" → ".join(shares)}')
        legend_above(axes)
    for i, first in enumerate(before.correlations):
        axes = fig.add_subplot(grid[at, i])
        for analysis, colour, label in both:
            for c in analysis.correlations:
                if c.input == first.input:
                    _draw_correlation(axes, c, colour, label)
        tidy(axes, 'lag / ms', f'correlation with {first.input}')
        axes.axhline(0.0, color='#555555', linewidth=0.6, zorder=1)
        axes.margins(x=0.0)
        axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        note(axes, 'dashed: 99 % band of all lags')
        if before.coherence is None:
            legend(axes)
    return fig


def _draw_coherence(axes: Axes, c: Coherence, colour: str, label: str) -> None:
    value = np.where(c.tested, c.coherence, np.nan)
    axes.plot(c.frequency, value, color=colour, linewidth=0.8, label=label)


def _draw_correlation(axes: Axes, c: CrossCorrelation, colour: str, label: str) -> None:
    lag = 1e3 * c.lag
    axes.plot(lag, c.correlation, color=colour, linewidth=1.1, label=label, zorder=3)
    for sign in (-1.0, 1.0):
        axes.plot(lag, sign * c.band, color=colour, linewidth=0.8, linestyle='--', zorder=2)

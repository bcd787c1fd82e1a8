# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Bars: the errors before and after, and the ranking of the candidates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import textwrap
from typing import Any

from matplotlib.figure import Figure
import numpy as np
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.report.figures.residual_traces import differ, STATES
from piezo_ident.report.figures.style import (
    COLOURS,
    figure,
    GREY,
    legend,
    legend_above,
    NothingToDraw,
    plain_log,
    safe,
    SMALL,
    tidy,
)

__all__ = ['errors_figure', 'frequencies_figure', 'ranking_figure']

#: segments and candidates that are shown, at most
SEGMENTS, CANDIDATES = 18, 20
#: characters in a line of a reason
REASON = 66
NOISE: Mapping[str, Any] = {
    'color': GREY,
    'linestyle': ':',
    'linewidth': 1.3,
    'label': 'noise',
}


def _states(diagnosis: Diagnosis) -> Sequence[tuple[str, str, str]]:
    """Return what is compared: attribute of the errors, name and colour."""
    names = {'given': 'before', 'before': 'refit', 'after': 'after'}
    states = STATES if differ(diagnosis.residuals) else STATES[:2]
    return [(names[name], label, colour) for name, label, colour in states]


def errors_figure(diagnosis: Diagnosis) -> Figure:
    """Draw the error overall and of every segment as bars, before and after."""
    states = _states(diagnosis)
    by_segment = diagnosis.before.by_segment
    worst = sorted(by_segment, key=lambda label: -by_segment[label])[:SEGMENTS]
    # in the order in which they were measured
    labels = [label for label in by_segment if label in worst]
    fig = figure(0.9 + 0.36 * (1 + len(labels)))
    axes = fig.subplots()
    place = np.arange(1 + len(labels), dtype=np.float64)
    place[1:] += 0.4
    height = 0.8 / len(states)
    for i, (name, said, colour) in enumerate(states):
        errors = getattr(diagnosis, name)
        values = [errors.overall, *(errors.by_segment.get(label, np.nan) for label in labels)]
        at = place + (i - 0.5 * (len(states) - 1)) * height
        axes.barh(at, values, 0.92 * height, color=colour, label=said)
        for y, value in zip(at, values, strict=True):
            if np.isfinite(value):
                axes.annotate(
                    f'{value:.2g}',
                    (value, y),
                    xytext=(3, 0),
                    textcoords='offset points',
                    va='center',
                    fontsize=SMALL - 1.5,
                    color='#333333',
                )
    axes.set_yticks(place, ['overall', *map(safe, labels)])
    axes.invert_yaxis()
    if diagnosis.noise_floor is not None:
        axes.axvline(
            diagnosis.noise_floor, color=GREY, linestyle=':', linewidth=1.4, label='noise'
        )
    tidy(axes, 'rms error / % of stroke')
    axes.grid(False, axis='y')
    axes.margins(x=0.08, y=0.02)
    legend_above(axes)
    return fig


def frequencies_figure(diagnosis: Diagnosis) -> Figure:
    """
    Draw the error over the frequency of the sines, before and after.

    Raises
    ------
    NothingToDraw
        With sines of less than two frequencies.
    """
    keys = sorted(diagnosis.before.by_frequency, key=float)
    if len(keys) < 2:
        raise NothingToDraw('the records hold sines of less than two frequencies')
    fig = figure(3.0, 5.2)
    axes = fig.subplots()
    f = np.array([float(key) for key in keys])
    for (name, said, colour), shape in zip(_states(diagnosis), ('^:', 's--', 'o-'), strict=False):
        table = getattr(diagnosis, name).by_frequency
        values = [table.get(key, np.nan) for key in keys]
        axes.loglog(f, values, shape, color=colour, markersize=5, linewidth=1.3, label=said)
    if diagnosis.noise_floor:
        axes.axhline(
            diagnosis.noise_floor, color=GREY, linestyle=':', linewidth=1.3, label='noise'
        )
    tidy(axes, 'frequency of the sine / Hz', 'rms error / % of stroke')
    axes.margins(0.06)
    low, high = axes.get_ylim()
    plain_log(axes.yaxis, low, high)
    plain_log(axes.xaxis, f.min(), f.max() * 1.5)
    legend(axes, loc='best')
    return fig


def ranking_figure(diagnosis: Diagnosis) -> Figure:
    """
    Draw the share that every candidate explains, and why it was not taken.

    Raises
    ------
    NothingToDraw
        Without effects and candidates.
    """
    alike = () if diagnosis.group is None else diagnosis.group.names
    rows = [(e.name, e.share, 'added to the model', COLOURS['model']) for e in diagnosis.effects]
    found = {name for name, *_ in rows}
    rows += [
        (c.name, c.share, c.why_not, COLOURS['mark'] if c.name in alike else COLOURS['band'])
        for c in diagnosis.candidates
        if c.name not in found
    ]
    if not rows:
        raise NothingToDraw('there was nothing to be explained, so no candidate was tried')
    rows = rows[:CANDIDATES]
    words = [textwrap.wrap(safe_long(why), REASON) or [''] for _, _, why, _ in rows]
    size = np.array([max(1.5, len(lines)) for lines in words])
    place = np.cumsum(size) - 0.5 * size
    fig = figure(0.75 + 0.145 * float(size.sum()))
    axes, side = fig.subplots(1, 2, sharey=True, gridspec_kw={'width_ratios': [1.0, 1.55]})
    shares = [100.0 * min(1.0, max(0.0, share)) for _, share, _, _ in rows]
    axes.barh(place, shares, 0.95, color=[colour for *_, colour in rows])
    for y, value, lines in zip(place, shares, words, strict=True):
        axes.annotate(
            f'{value:.0f}',
            (value, y),
            xytext=(2, 0),
            textcoords='offset points',
            va='center',
            fontsize=SMALL - 1,
        )
        text = side.text(0.0, y, '\n'.join(lines), va='center', fontsize=SMALL - 1)
        text.set_in_layout(False)
    axes.set_yticks(place, [safe(name) for name, *_ in rows])
    axes.set_xlim(0.0, 108.0)
    axes.set_xticks([0, 25, 50, 75, 100])
    tidy(axes, 'share of the explainable part / %')
    axes.grid(False, axis='y')
    axes.set_ylim(float(size.sum()), 0.0)
    side.set_axis_off()
    side.set_xlim(0.0, 1.0)
    return fig


def safe_long(text: str) -> str:
    """Return a sentence that shows as it is, however long."""
    return ''.join(c if c.isprintable() else '?' for c in text).replace('$', r'\$')

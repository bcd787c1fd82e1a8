# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures of a diagnosis: errors before and after, ranking of the candidates, all in order."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
import textwrap
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.diagnosis.results import Diagnosis, Errors, Residual
from piezo_ident.report.figures import style
from piezo_ident.report.figures.free_run import finish_frequencies
from piezo_ident.report.figures.residual import (
    differ,
    residual_correlation_figure,
    residual_dependence_figure,
    residual_figure,
    residual_spectrum_figure,
    STATES,
)
from piezo_ident.report.figures.style import COLOURS, NothingToDraw, tidy
from piezo_ident.residual import analyse, ResidualAnalysis, ResidualPart

__all__ = ['DIAGNOSIS_NAMES', 'draw_diagnosis', 'errors_figure', 'ranking_figure', 'worst_pieces']

#: at most so many pieces get a picture of their own
TRACES = 4
#: segments and candidates that are shown, at most, and characters in a line of a reason
SEGMENTS, CANDIDATES, REASON = 18, 20, 66
#: names of all pictures that `draw_diagnosis` can give
DIAGNOSIS_NAMES = (
    'errors',
    'error_frequencies',
    *(f'residual_{i + 1}' for i in range(TRACES)),
    'signature',
    'spectrum',
    'coherence',
    'ranking',
)
SAME = 'Before: H refitted, nothing added; after: the refined model.'


def draw_diagnosis(
    diagnosis: Diagnosis, tick: Callable[[float], None] = lambda share: None
) -> style.Drawn:
    """Draw everything that the data allow; `tick` takes the share that is done, and may raise."""
    wanted: list[style.Wanted] = [
        (
            'errors',
            'Error before and after',
            'Free run. Of the model as it was given; of the same with H refitted to other parts '
            'of these data and nothing added; of the refined model, held out likewise.',
            lambda: errors_figure(diagnosis),
        ),
        (
            'error_frequencies',
            'Error over frequency',
            'The same errors for the sines among the segments.',
            lambda: _frequencies_figure(diagnosis),
        ),
    ]
    for i, residual in enumerate(worst_pieces(diagnosis), 1):
        wanted.append(
            (
                f'residual_{i}',
                f'Residual: {residual.record}',
                'Measured minus predicted, free run, both on one scale; segments are shaded in '
                'turn. Each column of a long trace shows its smallest and largest sample.',
                partial(residual_figure, residual),
            )
        )
    analyses = cache(lambda: _analyses(diagnosis))
    wanted += [
        (
            'signature',
            'What the residual depends on',
            f'{SAME} Mean over the voltage, its rate, and the time since a step '
            '(there multiplied by the size of the step), with two standard '
            'deviations; the share of variance is held out. What is left should be flat.',
            lambda: residual_dependence_figure(*analyses()),
        ),
        (
            'spectrum',
            'Spectrum of the residual',
            f'{SAME} Amplitude spectral density of the longest stretch; green: lines.',
            lambda: residual_spectrum_figure(*analyses()),
        ),
        (
            'coherence',
            'Does the residual follow the voltage?',
            f'{SAME} Coherence with the voltage, and correlation with it and its rate at a lag. '
            'Noise alone leaves the band of the correlation in one case of a hundred, and the '
            'bound of the coherence at one frequency of a hundred.',
            lambda: residual_correlation_figure(*analyses()),
        ),
        (
            'ranking',
            'Ranking of the candidates',
            'Share of the explainable part that each would explain; blue: added, green: cannot be '
            'told from what was added.',
            lambda: ranking_figure(diagnosis),
        ),
    ]
    return style.draw_each(wanted, tick)


def worst_pieces(diagnosis: Diagnosis, most: int = TRACES) -> list[Residual]:
    """Return the pieces that the model misses most, in the order in which they were measured."""
    missed = [-float(np.sum(r.before[r.sound] ** 2)) for r in diagnosis.residuals]
    return [diagnosis.residuals[i] for i in sorted(np.argsort(missed, kind='stable')[:most])]


def _analyses(diagnosis: Diagnosis) -> tuple[ResidualAnalysis, ResidualAnalysis | None]:
    """Return what the residual shows before, and after where something was added."""

    def analysed(name: str) -> ResidualAnalysis:
        return analyse(
            [
                ResidualPart(r.record, r.piece, getattr(r, name), r.sound)
                for r in diagnosis.residuals
            ]
        )

    try:
        after = analysed('after') if differ(diagnosis.residuals) else None
        return analysed('before'), after
    except DataError as error:
        raise NothingToDraw(str(error)) from None


def _states(diagnosis: Diagnosis) -> list[tuple[Errors, str, str]]:
    """Return the errors that are compared, with their names and colours."""
    errors = (diagnosis.before, diagnosis.refit, diagnosis.after)
    shown = 3 if differ(diagnosis.residuals) else 2
    return [
        (e, name, colour) for e, (_, name, colour) in zip(errors, STATES[:shown], strict=False)
    ]


def errors_figure(diagnosis: Diagnosis) -> Figure:
    """Draw the error overall and of every segment as bars, before and after."""
    states = _states(diagnosis)
    by_segment = diagnosis.before.by_segment
    worst = sorted(by_segment, key=lambda label: -by_segment[label])[:SEGMENTS]
    # in the order in which they were measured
    labels = [label for label in by_segment if label in worst]
    fig = style.figure(0.9 + 0.36 * (1 + len(labels)))
    axes = fig.subplots()
    place = np.arange(1 + len(labels), dtype=np.float64)
    place[1:] += 0.4
    height = 0.8 / len(states)
    for i, (errors, name, colour) in enumerate(states):
        values = [errors.overall, *(errors.by_segment.get(label, np.nan) for label in labels)]
        at = place + (i - 0.5 * (len(states) - 1)) * height
        axes.barh(at, values, 0.92 * height, color=colour, label=name)
        for y, value in zip(at, values, strict=True):
            if np.isfinite(value):
                _number(axes, f'{value:.2g}', value, y, style.SMALL - 1.5)
    axes.set_yticks(place, ['overall', *map(style.safe, labels)])
    axes.invert_yaxis()
    if diagnosis.noise_floor is not None:
        floor = diagnosis.noise_floor
        axes.axvline(floor, color=style.GREY, linestyle=':', linewidth=1.4, label='noise')
    tidy(axes, 'rms error / % of stroke')
    axes.grid(False, axis='y')
    axes.margins(x=0.08, y=0.02)
    style.legend_above(axes)
    return fig


def _number(axes: Axes, text: str, x: float, y: float, size: float) -> None:
    """Write a number beside the end of a bar."""
    offset: dict[str, Any] = {'xytext': (3, 0), 'textcoords': 'offset points', 'va': 'center'}
    axes.annotate(text, (x, y), fontsize=size, color='#333333', **offset)


def _frequencies_figure(diagnosis: Diagnosis) -> Figure:
    """Draw the error over the frequency of the sines, before and after."""
    keys = sorted(diagnosis.before.by_frequency, key=float)
    if len(keys) < 2:
        raise NothingToDraw('the records hold sines of less than two frequencies')
    fig = style.figure(3.0, 5.2)
    axes = fig.subplots()
    f = np.array([float(key) for key in keys])
    for (errors, name, colour), shape in zip(
        _states(diagnosis), ('^:', 's--', 'o-'), strict=False
    ):
        values = [errors.by_frequency.get(key, np.nan) for key in keys]
        axes.loglog(f, values, shape, color=colour, markersize=5, linewidth=1.3, label=name)
    finish_frequencies(axes, f, diagnosis.noise_floor, 'noise')
    return fig


def ranking_figure(diagnosis: Diagnosis) -> Figure:
    """
    Draw the share that every candidate explains, and why it was not added.

    Raises
    ------
    NothingToDraw
        Without effects and candidates.
    """
    alike = () if diagnosis.group is None else diagnosis.group.names
    rows = [(e.name, e.share, 'added to the model', COLOURS['model']) for e in diagnosis.effects]
    added = {name for name, *_ in rows}
    rows += [
        (c.name, c.share, c.why_not, COLOURS['mark'] if c.name in alike else COLOURS['band'])
        for c in diagnosis.candidates
        if c.name not in added
    ]
    if not rows:
        raise NothingToDraw('there was nothing to be explained, so no candidate was tried')
    rows = rows[:CANDIDATES]
    reasons = [textwrap.wrap(style.safe(why, 1000), REASON) or [''] for _, _, why, _ in rows]
    size = np.array([max(1.5, len(lines)) for lines in reasons])
    place = np.cumsum(size) - 0.5 * size
    fig = style.figure(0.75 + 0.145 * float(size.sum()))
    axes, side = fig.subplots(1, 2, sharey=True, gridspec_kw={'width_ratios': [1.0, 1.55]})
    shares = [100.0 * min(1.0, max(0.0, share)) for _, share, _, _ in rows]
    axes.barh(place, shares, 0.95, color=[colour for *_, colour in rows])
    for y, value, lines in zip(place, shares, reasons, strict=True):
        _number(axes, f'{value:.0f}', value, y, style.SMALL - 1.0)
        text = side.text(0.0, y, '\n'.join(lines), va='center', fontsize=style.SMALL - 1)
        text.set_in_layout(False)
    axes.set_yticks(place, [style.safe(name) for name, *_ in rows])
    axes.set_xlim(0.0, 108.0)
    axes.set_xticks([0, 25, 50, 75, 100])
    tidy(axes, 'share of the explainable part / %')
    axes.grid(False, axis='y')
    axes.set_ylim(float(size.sum()), 0.0)
    side.set_axis_off()
    side.set_xlim(0.0, 1.0)
    return fig

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""All pictures of a diagnosis, in the order in which they are read."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any

from matplotlib.figure import Figure
import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.diagnosis.results import Diagnosis, Errors, Residual
from piezo_ident.report.figures import style
from piezo_ident.report.figures.residual import (
    differ,
    residual_coherence_figure,
    residual_dependence_figure,
    residual_figure,
    residual_spectrum_figure,
    STATES,
    UNSHADED,
)
from piezo_ident.report.figures.style import NothingToDraw, tidy
from piezo_ident.residual.analysis import analyse, ResidualAnalysis
from piezo_ident.residual.stretches import ResidualPart

#: at most so many pieces get a picture of their own
TRACES = 4
#: segments that are shown, at most
SEGMENTS = 18
SAME = 'Before: H refitted, nothing added; after: the refined model.'
REFIT = 'Before: the model as given; after: H refitted, nothing added.'


def draw_diagnosis(
    diagnosis: Diagnosis, tick: Callable[[float], None] = lambda share: None
) -> style.Drawn:
    """Draw everything that the data allow; `tick` takes the share that is done, and may raise."""
    wanted: list[style.Wanted] = [
        (
            'errors',
            'Error before and after',
            'Free run of the given model, and of the refined model, fitted to other kinds of '
            'motion. With an added effect, the given model with H refitted to other blocks is '
            'drawn, too.',
            lambda: errors_figure(diagnosis),
        ),
    ]
    for i, residual in enumerate(worst_pieces(diagnosis), 1):
        shaded = any(s.kind not in UNSHADED for s in residual.piece.segments)
        wanted.append(
            (
                f'residual_{i}',
                f'Residual: {residual.record}',
                'Measured minus predicted, free run, on one scale where nothing else is said'
                + ('; segments are shaded in turn.' if shaded else '.')
                + ' Each column of a long trace shows its smallest and largest sample.',
                partial(residual_figure, residual),
            )
        )
    analyses = cache(lambda: _analyses(diagnosis))
    what = REFIT if _is_refit(diagnosis) else SAME
    wanted += [
        (
            'signature',
            'What the residual depends on',
            f'{what} Mean over the voltage, its rate, and the time since a step '
            '(there multiplied by the size of the step), with two standard '
            'deviations. A complete model leaves flat curves.',
            lambda: residual_dependence_figure(*analyses()),
        ),
        (
            'spectrum',
            'Spectrum of the residual',
            f'{what} Amplitude spectral density of the longest stretch.',
            lambda: residual_spectrum_figure(*analyses()),
        ),
        (
            'coherence',
            'Does the residual follow the voltage?',
            f'{what} Noise alone leaves the bound at one frequency of a hundred.',
            lambda: residual_coherence_figure(*analyses()),
        ),
    ]
    return style.draw_each(wanted, tick)


def worst_pieces(diagnosis: Diagnosis, most: int = TRACES) -> list[Residual]:
    """Choose the pieces that the model misses most, in the order in which they were measured."""
    missed = [-float(np.sum(r.before[r.sound] ** 2)) for r in diagnosis.residuals]
    return [diagnosis.residuals[i] for i in sorted(np.argsort(missed, kind='stable')[:most])]


def _analyses(diagnosis: Diagnosis) -> tuple[ResidualAnalysis, ResidualAnalysis | None]:
    """Analyse the residual before, and after if an effect was added."""

    def analysed(name: str) -> ResidualAnalysis:
        return analyse(
            [
                ResidualPart(r.record, r.piece, getattr(r, name), r.sound)
                for r in diagnosis.residuals
            ]
        )

    try:
        if _is_refit(diagnosis):
            return analysed('given'), analysed('after')
        after = analysed('after') if differ(diagnosis.residuals) else None
        return analysed('before'), after
    except DataError as error:
        raise NothingToDraw(str(error)) from None


def _is_refit(diagnosis: Diagnosis) -> bool:
    """Tell whether the refined model differs from the given model by its H alone."""
    return not differ(diagnosis.residuals) and not all(
        np.array_equal(r.given, r.after) for r in diagnosis.residuals
    )


def _states(diagnosis: Diagnosis) -> list[tuple[Errors, str, str]]:
    """List the errors that are compared, with their names and colours."""
    errors = (diagnosis.before, diagnosis.refit, diagnosis.after)
    if _is_refit(diagnosis):
        # of the refit, the error on kinds of motion that were held out
        return [(errors[0], STATES[0][1], STATES[0][2]), (errors[2], STATES[1][1], STATES[1][2])]
    count = 3 if differ(diagnosis.residuals) else 2
    return [
        (e, name, colour) for e, (_, name, colour) in zip(errors, STATES[:count], strict=False)
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
    beside: dict[str, Any] = {'xytext': (3, 0), 'textcoords': 'offset points', 'va': 'center'}
    for i, (errors, name, colour) in enumerate(states):
        values = [errors.overall, *(errors.by_segment.get(label, np.nan) for label in labels)]
        at = place + (i - 0.5 * (len(states) - 1)) * height
        axes.barh(at, values, 0.92 * height, color=colour, label=name)
        for y, value in zip(at, values, strict=True):
            if np.isfinite(value):
                axes.annotate(f'{value:.3g}', (value, y), fontsize=style.SMALL - 1.5, **beside)
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

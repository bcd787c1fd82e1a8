# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The pictures of a diagnosis."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from matplotlib.figure import Figure
import numpy as np
from piezo_ident.common.errors import DataError
from piezo_ident.diagnosis.results import Diagnosis
from piezo_ident.report.figures import Drawn
from piezo_ident.report.figures.refinement_bars import (
    errors_figure,
    frequencies_figure,
    ranking_figure,
)
from piezo_ident.report.figures.residual import residual_spectrum_figure
from piezo_ident.report.figures.residual_signature import (
    residual_correlation_figure,
    residual_dependence_figure,
)
from piezo_ident.report.figures.residual_traces import differ, residual_figure
from piezo_ident.report.figures.style import NothingToDraw, Picture
from piezo_ident.residual import analyse, ResidualAnalysis, ResidualPart

__all__ = ['DIAGNOSIS_NAMES', 'draw_diagnosis']

#: at most so many pieces get a picture of their own
TRACES = 4
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


def _analyses(diagnosis: Diagnosis) -> tuple[ResidualAnalysis, ResidualAnalysis | None]:
    """
    Return what the residual shows before, and after where something was added.

    Raises
    ------
    NothingToDraw
        When there is no residual that could be looked at.
    """

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


def draw_diagnosis(
    diagnosis: Diagnosis, tick: Callable[[float], None] = lambda share: None
) -> Drawn:
    """
    Draw everything that the data of a diagnosis allow.

    Parameters
    ----------
    diagnosis : Diagnosis
    tick : callable, optional
        Called with the share of the work done; may raise to stop it.

    Returns
    -------
    Drawn
    """
    wanted: list[tuple[str, str, str, Callable[[], Figure]]] = [
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
            lambda: frequencies_figure(diagnosis),
        ),
    ]
    # those that miss the most say the most
    worst = sorted(diagnosis.residuals, key=lambda r: -float(np.sum(r.before[r.sound] ** 2)))[
        :TRACES
    ]
    for i, residual in enumerate(r for r in diagnosis.residuals if any(r is w for w in worst)):
        wanted.append(
            (
                f'residual_{i + 1}',
                f'Residual: {residual.record}',
                'Measured minus predicted, free run, both on one scale; segments are shaded in '
                'turn. Each column of a long trace shows its smallest and largest sample.',
                lambda residual=residual: residual_figure(residual),  # type: ignore[misc]
            )
        )
    analyses = cache(lambda: _analyses(diagnosis))
    wanted += [
        (
            'signature',
            'What the residual depends on',
            f'{SAME} Mean over the voltage, its rate, and the time since it turned or stepped '
            '(there multiplied by the direction, and by the size of the step), with two standard '
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
    pictures, left_out = [], []
    for i, (name, title, caption, make) in enumerate(wanted):
        tick(i / len(wanted))
        try:
            pictures.append(Picture(name, title, caption, make()))
        except NothingToDraw as reason:
            left_out.append((title, str(reason)))
    return Drawn(tuple(pictures), tuple(left_out))

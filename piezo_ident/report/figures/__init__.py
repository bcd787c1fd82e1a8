# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Pictures for people: what was measured, what the model makes of it, and how far they differ."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import os
from pathlib import Path

from matplotlib.figure import Figure
import numpy as np
from piezo_ident.common.errors import ConfigError
from piezo_ident.common.files import temporary_output
from piezo_ident.identification.results import Identification
from piezo_ident.model.free_run import FreeRun, PieceRun, sine_frequency, sines_of
from piezo_ident.report.figures.errors import (
    loops_figure,
    overview_figure,
    segments_figure,
    sines_figure,
)
from piezo_ident.report.figures.steps import (
    delay_figure,
    orders_figure,
    response_figure,
    weights_figure,
)
from piezo_ident.report.figures.style import NothingToDraw, Picture

__all__ = [
    'NAMES',
    'Drawn',
    'NothingToDraw',
    'Picture',
    'delay_figure',
    'draw',
    'loops_figure',
    'orders_figure',
    'overview_figure',
    'response_figure',
    'segments_figure',
    'sines_figure',
    'weights_figure',
    'write_prediction_plot',
]

#: at most so many records get a picture of their own
OVERVIEWS = 4
#: strokes of sines that differ by no more than this factor have one level of noise in %
ALIKE = 1.1
#: names of all pictures that `draw` can give
NAMES = (
    'sines',
    'loops',
    'segments',
    *(f'overview_{i + 1}' for i in range(OVERVIEWS)),
    'delay',
    'response',
    'orders',
    'weights',
)
#: endings that a picture may have
ENDINGS = ('.png', '.pdf', '.svg')
#: dots an inch: sharp in print at the size drawn
DPI = 160


@dataclass(frozen=True, eq=False)
class Drawn:
    """
    The pictures of an identification.

    Attributes
    ----------
    pictures : tuple of Picture
    left_out : tuple of (str, str)
        Title of each picture that could not be drawn, and why.
    """

    pictures: tuple[Picture, ...]
    left_out: tuple[tuple[str, str], ...]


def held_out_from(identification: Identification, run: PieceRun) -> int | None:
    """Return the first held-out sample of a piece whose end was kept back, None otherwise."""
    if identification.dynamics.table is not None:
        return None
    rows = [row for row in identification.errors if row.record == run.record]
    fitted = sum(row.n for row in rows if row.data != 'held out')
    # of several pieces only one is fitted, and the rows do not say which
    if fitted == 0 or sum(row.n for row in rows) != run.piece.n:
        return None
    return fitted if fitted < run.piece.n else None


def response_caption(identification: Identification) -> str:
    """Return what the picture of the frequency response shows."""
    if identification.dynamics.response is None:
        return 'G(z) z^-d of the model; without a noise segment none was measured. Dotted: modes.'
    return (
        'Welch estimate from the noise segment with its standard deviation, and the slope of H at '
        'the bias times G(z) z^-d. Dotted: modes of G.'
    )


def _floor_of_sines(identification: Identification, runs: Sequence[PieceRun]) -> float | None:
    """Return the sensor noise in % of the stroke of the sines, None where these differ."""
    found = [
        float(np.ptp(run.piece.y[s.start : s.stop]))
        for run in runs
        for s in run.piece.segments
        if sine_frequency(s.label)
    ]
    floor = identification.noise_floor
    if floor is None or not found or max(found) > ALIKE * min(found) or max(found) == 0.0:
        return None
    return floor * identification.stroke / max(found)


def draw(
    identification: Identification,
    runs: Sequence[PieceRun],
    tick: Callable[[float], None] = lambda share: None,
) -> Drawn:
    """
    Draw everything that the data of an identification allow.

    Parameters
    ----------
    identification : Identification
    runs : sequence of PieceRun
        From `piezo_ident.model.free_run.piece_runs`.
    tick : callable, optional
        Called with the share of the work done; may raise to stop it.

    Returns
    -------
    Drawn
    """
    words: dict[tuple[str, str], str] = {}
    for row in identification.errors:
        said = words.get((row.record, row.segment), '')
        words[row.record, row.segment] = (
            f'{said}{", " if said else ""}{row.data} {row.percent:.2g} %'
        )
    edges = [held_out_from(identification, run) for run in runs]
    wanted: list[tuple[str, str, str, Callable[[], Figure]]] = [
        (
            'sines',
            'Error over frequency',
            'Steady state of each sine: rms error in % of its stroke, with and without G.',
            lambda: sines_figure(sines_of(runs), _floor_of_sines(identification, runs)),
        ),
        (
            'loops',
            'Hysteresis',
            'Displacement over voltage, free run, and what is left below.',
            lambda: loops_figure(runs, edges),
        ),
        (
            'segments',
            'Segments',
            'Free run and its error; that of the hysteresis alone is drawn where both can be read '
            'on one scale. Percentages are of the stroke of the whole record.',
            lambda: segments_figure(runs, words),
        ),
    ]
    # the last records are those that were measured for validation, more often than not
    widest = sorted(runs, key=lambda run: float(np.ptp(run.piece.v)), reverse=True)[:OVERVIEWS]
    for i, run in enumerate(run for run in runs if any(run is w for w in widest)):
        wanted.append(
            (
                f'overview_{i + 1}',
                f'Whole record: {run.record}',
                'Each column of a long trace shows its smallest and largest sample.',
                lambda run=run: overview_figure(  # type: ignore[misc]
                    run, held_out_from(identification, run)
                ),
            )
        )
    wanted += [
        (
            'delay',
            'Delay',
            'The delay is the first sample at which the averaged response leaves its noise.',
            lambda: delay_figure(identification, runs),
        ),
        (
            'response',
            'Frequency response',
            response_caption(identification),
            lambda: response_figure(identification),
        ),
        (
            'orders',
            'Orders of G',
            'Free-run error on held-out noise of least squares at every order; grey: unstable.',
            lambda: orders_figure(identification),
        ),
        (
            'weights',
            'Weights of the plays',
            'Bars: standard deviation for white residuals.',
            lambda: weights_figure(identification),
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


def write_prediction_plot(run: FreeRun, path: str | os.PathLike[str]) -> None:
    """
    Draw a record with its prediction and write the picture.

    Parameters
    ----------
    run : FreeRun
        From `piezo_ident.model.free_run.free_run`; the longest piece is drawn.
    path : path
        Ending in .png, .pdf or .svg.

    Raises
    ------
    ConfigError
        When the ending is another one.
    DataError
        When the file cannot be written.
    """
    target = Path(path)
    if target.suffix.lower() not in ENDINGS:
        raise ConfigError(f'{path}: a picture ends in {", ".join(ENDINGS)}')
    piece, y_hat = max(zip(run.record.pieces, run.pieces, strict=True), key=lambda pair: pair[0].n)
    drawn = overview_figure(PieceRun(run.record.name, piece, y_hat, y_hat))
    with temporary_output(target, overwrite=True) as file:
        drawn.savefig(file, dpi=DPI)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""All pictures of an identification, in the order in which they are read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from piezo_ident.identification.results import Identification
from piezo_ident.model.free_run import PieceRun
from piezo_ident.model.sines import sines_of
from piezo_ident.report.figures.delay_and_dynamics import (
    delay_figure,
    orders_figure,
    response_figure,
)
from piezo_ident.report.figures.free_run import (
    loops_figure,
    overview_figure,
    segments_figure,
    sines_figure,
)
from piezo_ident.report.figures.style import draw_each, Drawn, Wanted

__all__ = ['draw_identification']

#: at most so many records get a picture of their own
OVERVIEWS = 4


def draw_identification(
    identification: Identification,
    runs: Sequence[PieceRun],
    tick: Callable[[float], None] = lambda share: None,
) -> Drawn:
    """Draw everything that the data allow; `tick` takes the share that is done, and may raise."""
    texts: dict[tuple[str, str], list[str]] = {}
    for row in identification.errors:
        text = f'{row.data} {row.percent:.2g} %'
        texts.setdefault((row.record, row.segment), []).append(text)
    errors = {key: ', '.join(parts) for key, parts in texts.items()}
    dynamics = identification.dynamics
    if dynamics.response is None:
        response = (
            'G(z) z^-d of the model. Nothing that the voltage does has the breadth to measure it: '
            'add steps, noise or a multisine.'
        )
    elif np.isfinite(dynamics.slope_measured):
        response = (
            'Measured on the noise segment, bars of one standard deviation, and the slope of H at '
            'the bias times G(z) z^-d.'
        )
    else:
        response = (
            'Measured on all fast motion (Welch) from the voltage behind H to the displacement, '
            'where it errs by less than 10 %, and G(z) z^-d of the model.'
        )
    response += ' Where the two part, G lacks something. Dotted: modes of G.'
    wanted: list[Wanted] = [
        (
            'sines',
            'Error over frequency',
            'Steady state of each sine: rms error in % of its stroke, with and without G.',
            lambda: sines_figure(sines_of(runs)),
        ),
        (
            'loops',
            'Hysteresis',
            'Displacement over voltage, free run, and the error below.',
            lambda: loops_figure(runs),
        ),
        (
            'segments',
            'Segments',
            'Free run and its error; that of the hysteresis alone is drawn where both can be read '
            'on one scale. Percentages are of the stroke of the whole record.',
            lambda: segments_figure(runs, errors),
        ),
    ]
    by_width = sorted(range(len(runs)), key=lambda i: -float(np.ptp(runs[i].piece.v)))
    for number, i in enumerate(sorted(by_width[:OVERVIEWS]), 1):
        wanted.append(
            (
                f'overview_{number}',
                f'Whole record: {runs[i].record}',
                'Each column of a long trace shows its smallest and largest sample.',
                partial(overview_figure, runs[i], _held_out_from(identification, runs[i])),
            )
        )
    wanted += [
        (
            'delay',
            'Delay',
            'The delay is the first sample at which the averaged response leaves its noise. Also: '
            'the loss of least squares at each delay.',
            lambda: delay_figure(identification, runs),
        ),
        (
            'response',
            'Frequency response',
            response,
            lambda: response_figure(identification),
        ),
        (
            'orders',
            'Orders of G',
            'Free-run error on held-out noise of least squares at every order; grey: unstable.',
            lambda: orders_figure(identification),
        ),
    ]
    return draw_each(wanted, tick)


def _held_out_from(identification: Identification, run: PieceRun) -> int | None:
    """Return the first held-out sample of a piece whose end was held out, None otherwise."""
    if identification.dynamics.table is not None:
        return None
    rows = [row for row in identification.errors if row.record == run.record]
    fitted = sum(row.n for row in rows if row.data in ('fitted', 'selection'))
    # of several pieces only one is fitted, and the rows do not name it
    if fitted == 0 or sum(row.n for row in rows) != run.piece.n:
        return None
    return fitted if fitted < run.piece.n else None

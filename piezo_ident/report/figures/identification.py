# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""All pictures of an identification, in the order in which they are read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from piezo_ident.identification.results import Identification, rms_percent
from piezo_ident.identification.step1_delay import DelayResult
from piezo_ident.identification.step2_dynamics import DynamicsResult
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
from piezo_ident.report.table import number

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
    refitted = _refitted(identification)
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
            'Free run and its error, with the error of the hysteresis alone if one scale suits '
            'both. Percentages are of the stroke of the whole record'
            + (
                '; fitted and held-out errors belong to the model before H was fitted to all, the '
                'curves to the final model.'
                if refitted
                else '.'
            ),
            lambda: segments_figure(runs, errors),
        ),
        *_overviews(runs, refitted),
        (
            'delay',
            'Delay',
            _of_delay(identification.delay),
            lambda: delay_figure(identification, runs),
        ),
        (
            'response',
            'Frequency response',
            _of_response(identification.dynamics),
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


def _overviews(runs: Sequence[PieceRun], refitted: Mapping[str, float]) -> list[Wanted]:
    """List the pictures of the widest records as a whole."""
    wanted: list[Wanted] = []
    by_width = sorted(range(len(runs)), key=lambda i: -float(np.ptp(runs[i].piece.v)))
    for k, i in enumerate(sorted(by_width[:OVERVIEWS]), 1):
        caption = 'Each column of a long trace shows its smallest and largest sample.'
        remark = ''
        if runs[i].record in refitted:
            error = f'{number(refitted[runs[i].record])} %'
            caption += (
                ' In the end H was fitted to the whole record; the drawn error is one of the fit. '
                f'Samples held out before were missed by {error} of stroke.'
            )
            remark = f'H fitted to all of it; error of samples held out before: {error}'
        wanted.append(
            (
                f'overview_{k}',
                f'Whole record: {runs[i].record}',
                caption,
                partial(overview_figure, runs[i], remark),
            )
        )
    return wanted


def _of_response(dynamics: DynamicsResult) -> str:
    """Describe how the frequency response was measured, if it was."""
    if dynamics.response is None:
        response = (
            'G(z) z^-d of the model. The motion is too narrow in frequency to measure it: add '
            'steps, noise or a multisine.'
        )
    elif np.isfinite(dynamics.slope_measured):
        response = (
            'Measured on the noise segment, bars of one standard deviation, and the slope of H at '
            'the bias times G(z) z^-d.'
        )
    else:
        response = (
            'Measured on all fast motion (Welch) from the output of H to the displacement, at '
            'frequencies with errors below 10 %, and G(z) z^-d of the model.'
        )
    return f'{response} G lacks a part of the stage at frequencies of disagreement.'


def _refitted(identification: Identification) -> dict[str, float]:
    """Find the held-out error of each record to which H was fitted as a whole later."""
    # a table of orders comes with segments
    if identification.dynamics.table is not None or identification.shared is not None:
        return {}
    rows = identification.errors
    names = dict.fromkeys(row.record for row in rows if row.data == 'fitted')
    held = {
        name: [row for row in rows if row.record == name and row.data == 'held out' and row.driven]
        for name in names
    }
    return {name: rms_percent(rows) for name, rows in held.items() if rows}


def _of_delay(delay: DelayResult) -> str:
    """Describe how the delay was found."""
    parts = []
    step = delay.step
    if step is not None and step.repeats:
        parts.append(
            'Delay of the steps: the first of two samples in a row above the noise threshold, in '
            'the direction of the averaged response.'
        )
    if delay.loss is not None:
        parts.append('The loss of least squares, where it tells, rises behind the delay.')
    told = {step.samples if step is not None else None, delay.scan} - {None}
    if delay.samples in told and delay.agree is False:
        parts.append('The two differ: a free run decided which is used.')
    elif told and delay.samples not in told:
        parts.append('A free run decided for another delay, which is used.')
    return ' '.join(parts)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Steady-state errors of a model under sines, as in Table I of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import re

import numpy as np
from piezo_ident.model.free_run import piece_runs, PieceRun
from piezo_ident.model.metrics import percent_of_stroke
from piezo_ident.model.stage_model import StageModel
from piezo_ident.record.record import Record

#: time that is dropped at the start of a sine [s]; at least one period is dropped
SETTLING = 1.0

_SINE = re.compile(r'sine:([0-9]+(?:\.[0-9]*)?(?:e[+-]?[0-9]+)?) ?Hz(?![^-_. ])', re.IGNORECASE)


@dataclass(frozen=True)
class SineError:
    """
    Steady-state error of one sine segment.

    Attributes
    ----------
    frequency : float
        Frequency of the sine [Hz].
    percent, static_percent : float
        `piezo_ident.model.metrics.percent_of_stroke` of the whole model and of the hysteresis
        alone, with the stroke of the compared samples.
    n : int
        Number of compared samples.
    """

    frequency: float
    percent: float
    static_percent: float
    n: int


def sine_frequency(label: str) -> float | None:
    """
    Read the frequency in a segment label [Hz]; None if it does not name a sine.

    Examples
    --------
    >>> sine_frequency('sine:50Hz'), sine_frequency('noise')
    (50.0, None)
    """
    match = _SINE.match(label)
    frequency = float(match.group(1)) if match else 0.0
    return frequency if 0.0 < frequency < float('inf') else None


def sines_of(runs: Sequence[PieceRun]) -> tuple[SineError, ...]:
    """
    Compute the steady-state error of every sine segment, sorted by frequency.

    The first second and at least one period of each segment do not count.  A segment whose rest is
    shorter than a period is left out.
    """
    rows = []
    for run in runs:
        rate = run.piece.sample_rate
        for s in run.piece.segments:
            frequency = sine_frequency(s.label)
            if frequency is None:
                continue
            start = s.start + int(np.ceil(max(SETTLING, 1.0 / frequency) * rate))
            # tolerate half a sample: the period need not be a whole number of samples
            if s.stop - start < rate / frequency - 0.5:
                continue
            steady = slice(start, s.stop)
            sound = run.piece.mask[steady]
            y, y_hat, y_static = (x[steady][sound] for x in (run.piece.y, run.y_hat, run.y_static))
            if not y.size:
                continue
            rows.append(
                SineError(
                    frequency=frequency,
                    percent=percent_of_stroke(y, y_hat),
                    static_percent=percent_of_stroke(y, y_static),
                    n=y.size,
                )
            )
    return tuple(sorted(rows, key=lambda row: row.frequency))


def sine_errors(model: StageModel, record: Record) -> tuple[SineError, ...]:
    """
    Compute the errors of `sines_of` for a record with segment labels such as ``sine:50Hz``.

    Raises ModelError if a piece with sines has another sampling rate than the model.
    """
    for piece in record:
        if piece.find('sine'):
            model.check_rate(piece)
    return sines_of(piece_runs(model, record))

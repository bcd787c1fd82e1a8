# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The error numbers, each with its formula."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import math
from typing import TYPE_CHECKING

import numpy as np
from piezo_ident.common.arrays import Array, robust_range

if TYPE_CHECKING:
    from piezo_ident.model.stage_model import StageModel

#: times that a displacement moves as much, or as little, from which its unit is in doubt
UNIT = 30.0
#: how `percent_of_stroke` is defined, for tables and files
FORMULA = '100 rms(y - y_hat) / (max y - min y), free run'
#: kinds of data, in the order in which they are shown and in which an error is quoted of them
KINDS = ('validation', 'held out', 'selection', 'fitted')
#: what to say where `runs_against`
REVERSED = 'the displacement runs against the model: is a sign reversed, or are columns exchanged?'
#: correlation below which that is no matter of a poor model
AGAINST = -0.5
#: share of the span of a model below which a record does not move
STILL = 0.02


#: samples per block, so that temporaries stay small beside a long record
BLOCK = 1 << 20


def percent(rms: float, stroke: float) -> float:
    """
    Return ``100 rms / stroke``; infinite when the stroke is zero and the error is not.

    >>> percent(2.0, 50.0), percent(1e-9, 0.0)
    (4.0, inf)
    """
    if stroke == 0.0:
        return 0.0 if rms == 0.0 else float('inf')
    return 100.0 * float(rms) / stroke


def percent_of_stroke(y: Array, y_hat: Array, stroke: float | None = None) -> float:
    """
    Return ``100 rms(y - y_hat) / (max y - min y)``, shapes (n,).

    A `stroke` replaces ``max y - min y``, where a part of a record is judged by the whole.
    Infinite when the stroke is zero and the error is not.
    """
    span = strokes([('', y)])[''] if stroke is None else stroke
    return percent(float(np.sqrt(np.mean((y - y_hat) ** 2))), span)


def strokes(parts: Iterable[tuple[str, Array]]) -> dict[str, float]:
    """
    Return ``max y - min y`` of each record over all its parts, which come as (record, y).

    Single wild samples and empty parts do not count; see `piezo_ident.common.arrays.robust_range`.
    Between two records a sensor may be set to another zero, so their strokes are no common one.
    """
    of: dict[str, list[Array]] = {}
    for record, y in parts:
        if y.size:
            of.setdefault(record, []).append(y)
    ranges = {record: robust_range(pieces) for record, pieces in of.items()}
    return {record: high - low for record, (low, high) in ranges.items()}


def runs_against(
    parts: Iterable[tuple[Array, Array]], span: float, below: float = AGAINST
) -> bool:
    """
    Return whether measured and predicted displacement move in opposite directions.

    The pieces (y, y_hat) may have a zero of their own each.  A record that moves by little of
    `span`, the displacement of the model over its range, says nothing; `below` is the correlation
    from which they do.
    """
    yy = pp = yp = reach = 0.0
    for y, y_hat in parts:
        y_mean, mean = float(y.mean()), float(y_hat.mean())
        # in blocks, for the sake of memory
        for i in range(0, y.size, BLOCK):
            dy, dp = y[i : i + BLOCK] - y_mean, y_hat[i : i + BLOCK] - mean
            yy, pp, yp = yy + float(dy @ dy), pp + float(dp @ dp), yp + float(dy @ dp)
        reach = max(reach, float(np.ptp(y_hat)))
    return reach > STILL * abs(span) and yp < below * math.sqrt(yy * pp)


def doubts(parts: Sequence[tuple[Array, Array]], span: float) -> Iterator[str]:
    """Yield why measured displacement may not be the stage's; arguments as of `runs_against`."""
    if runs_against(parts, span):
        yield REVERSED
    squares = np.array([(y.size * np.var(y), y.size * np.var(y_hat)) for y, y_hat in parts])
    measured, predicted = np.sqrt(squares.sum(axis=0))
    # a record that moves by little says nothing
    reach = max((float(np.ptp(y_hat)) for _, y_hat in parts if y_hat.size), default=0.0)
    moves = reach > STILL * abs(span) and measured > 0.0
    if moves and not 1.0 / UNIT < measured / predicted < UNIT:
        yield (
            f'the displacement moves {measured / predicted:.3g} times as much as the model says; '
            'is its unit right, and is it the sensor of this stage?'
        )


def nrmse_fit(error: float, spread: float) -> float:
    """Return ``100 (1 - error / spread)`` of two norms; 100 for no error, whatever the spread."""
    if spread == 0.0:
        return 100.0 if error == 0.0 else float('-inf')
    return 100.0 * (1.0 - float(error) / float(spread))


def fit_percent(y: Array, y_hat: Array) -> float:
    """Return the NRMSE fit ``100 (1 - |y - y_hat| / |y - mean y|)`` of MATLAB's ``compare``."""
    return nrmse_fit(float(np.linalg.norm(y - y_hat)), float(np.linalg.norm(y - y.mean())))


def expected_error(model: StageModel) -> float | None:
    """
    Return the error to expect of a model in free run [% of stroke], None where it is not known.

    Of a refined model that of its diagnosis, on kinds of motion that were held out; else that of
    its identification, on data as far from the fit as there are.
    """
    return next((value for value, _ in _known_errors(model)), None)


def worst_error(model: StageModel) -> float | None:
    """Return the error on the kind of motion where it is largest, as `expected_error`."""
    return next((worst for _, worst in _known_errors(model)), None)


def _known_errors(model: StageModel) -> Iterator[tuple[float, float]]:
    """Yield the errors that a model holds, the first to be quoted, each with the worst."""
    found = model.identification
    diagnosis = found.get('diagnosis')
    places = (
        (diagnosis.get('errors') if isinstance(diagnosis, Mapping) else None, ('after', 'before')),
        (found.get('errors'), [kind.replace(' ', '_') for kind in KINDS]),
    )
    for errors, kinds in places:
        known = errors if isinstance(errors, Mapping) else {}
        for kind in kinds:
            value, worst = (
                float(x) if isinstance(x, int | float) and 0.0 < x < float('inf') else 0.0
                for x in (known.get(kind), known.get('worst'))
            )
            if value:
                yield value, max(value, worst)

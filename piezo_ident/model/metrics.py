# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Error numbers of a model, each with its formula."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import math
from typing import TYPE_CHECKING

import numpy as np
from piezo_ident.common.arrays import Array, CHUNK, robust_range

if TYPE_CHECKING:
    from piezo_ident.model.stage_model import StageModel

#: factor between measured and predicted motion, either way, from which the unit is in doubt
UNIT = 30.0
#: definition of `percent_of_stroke`, for tables and files
FORMULA = '100 rms(y - y_hat) / (max y - min y), free run'
#: kinds of data, in the order in which tables list them and quote an error of them
KINDS = ('validation', 'held out', 'selection', 'fitted')
#: message if `runs_against`
REVERSED = 'the displacement runs against the model: is a sign reversed, or are columns exchanged?'
#: correlation below which a wrong sign, not a poor model, is the cause
AGAINST = -0.5
#: share of the span of a model below which a record counts as at rest
STILL = 0.02


def percent(rms: float, stroke: float) -> float:
    """
    Compute ``100 rms / stroke``; infinite if the stroke is zero and the error is not.

    >>> percent(2.0, 50.0), percent(1e-9, 0.0)
    (4.0, inf)
    """
    if stroke == 0.0:
        return 0.0 if rms == 0.0 else float('inf')
    return 100.0 * float(rms) / stroke


def percent_of_stroke(y: Array, y_hat: Array, stroke: float | None = None) -> float:
    """
    Compute ``100 rms(y - y_hat) / (max y - min y)``, shapes (n,).

    A `stroke` replaces ``max y - min y``, so that the whole record judges its parts.  Without a
    stroke, wild samples do not count as max or min, as in `strokes`.  See `percent` for zero.
    """
    span = strokes([('', y)])[''] if stroke is None else stroke
    return percent(float(np.sqrt(np.mean((y - y_hat) ** 2))), span)


def strokes(parts: Iterable[tuple[str, Array]]) -> dict[str, float]:
    """
    Compute ``max y - min y`` of each record over all its parts, given as (record, y).

    Single wild samples and empty parts do not count; see `piezo_ident.common.arrays.robust_range`.
    Records are kept apart, because a sensor may be zeroed between two records.
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
    Tell whether measured and predicted displacement move in opposite directions.

    Each piece (y, y_hat) may have a zero of its own.  A prediction that moves by less than `STILL`
    of `span`, the displacement of the model over its range, never counts.  `below` is the
    correlation below which the directions are opposite.
    """
    yy = pp = yp = reach = 0.0
    for y, y_hat in parts:
        y_mean, mean = float(y.mean()), float(y_hat.mean())
        # in blocks, to save memory
        for i in range(0, y.size, CHUNK):
            dy, dp = y[i : i + CHUNK] - y_mean, y_hat[i : i + CHUNK] - mean
            yy, pp, yp = yy + float(dy @ dy), pp + float(dp @ dp), yp + float(dy @ dp)
        reach = max(reach, float(np.ptp(y_hat)))
    return reach > STILL * abs(span) and yp < below * math.sqrt(yy * pp)


def doubts(parts: Sequence[tuple[Array, Array]], span: float) -> Iterator[str]:
    """Yield doubts about the sensor or its unit; arguments as in `runs_against`."""
    if runs_against(parts, span):
        yield REVERSED
    squares = np.array([(y.size * np.var(y), y.size * np.var(y_hat)) for y, y_hat in parts])
    measured, predicted = np.sqrt(squares.sum(axis=0))
    # a record that hardly moves tells nothing
    reach = max((float(np.ptp(y_hat)) for _, y_hat in parts if y_hat.size), default=0.0)
    moves = reach > STILL * abs(span) and measured > 0.0
    if moves and not 1.0 / UNIT < measured / predicted < UNIT:
        yield (
            f'the displacement moves {measured / predicted:.3g} times as much as the model says; '
            'is its unit right, and is it the sensor of this stage?'
        )


def nrmse_fit(error: float, spread: float) -> float:
    """Compute ``100 (1 - error / spread)`` of two norms; 100 if the error is zero."""
    if spread == 0.0:
        return 100.0 if error == 0.0 else float('-inf')
    return 100.0 * (1.0 - float(error) / float(spread))


def fit_percent(y: Array, y_hat: Array) -> float:
    """Compute the NRMSE fit ``100 (1 - |y - y_hat| / |y - mean y|)`` of MATLAB's ``compare``."""
    return nrmse_fit(float(np.linalg.norm(y - y_hat)), float(np.linalg.norm(y - y.mean())))


def expected_error(model: StageModel) -> float | None:
    """
    Find the error to expect of a model in free run [% of stroke]; None if it is unknown.

    A refined model has the error of its diagnosis, on kinds of motion that were held out.
    Another model has the error of its identification, on the best available kind of data.
    """
    return next((value for value, _ in _known_errors(model)), None)


def worst_error(model: StageModel) -> float | None:
    """Find the error on the kind of motion where it is largest, as `expected_error`."""
    return next((worst for _, worst in _known_errors(model)), None)


def _known_errors(model: StageModel) -> Iterator[tuple[float, float]]:
    """Yield the errors stored in a model, in the order of quotation, each with the worst error."""
    origin = model.identification
    diagnosis = origin.get('diagnosis')
    places = (
        (diagnosis.get('errors') if isinstance(diagnosis, Mapping) else None, ('after', 'before')),
        (origin.get('errors'), [kind.replace(' ', '_') for kind in KINDS]),
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

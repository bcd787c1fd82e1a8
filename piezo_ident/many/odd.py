# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Which records of many stand out, and in what."""

from __future__ import annotations

from collections.abc import Sequence
import math
import statistics

from piezo_ident.many.table import Row

#: fewer values than these say little about how far others of the kind lie apart
FEWEST = 8
#: distance from the median that stands out: in standard deviations, as the median of the distances
#: gives them, and at least this share of the median
FAR, SHARE = 5.0, 0.02
#: a delay is a number of samples, and may come out as the next one
SAMPLES = 1.5
#: what is compared; errors and noise by their logarithm, and only above the others
COMPARED = (
    *('sample_rate', 'duration', 'voltage_high', 'stroke', 'gain', 'loop_width'),
    *('delay_samples', 'bandwidth', 'resonance'),
)
ABOVE = (
    *('error_held_out', 'error_fitted', 'error_before', 'error_after', 'unexplained'),
    'noise_floor',
)
#: an error that stands out is so many times that of the others at least
TIMES = 1.25


def stand_out(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """
    Return for each record that stands out the columns in which it does, with the medians of all.

    Examples
    --------
    >>> gains = [5.0, 5.1, 4.9, 5.2, 5.0, 4.8, 5.1, 3.9]
    >>> stand_out([Row(f'stage_{i}', {'gain': x}) for i, x in enumerate(gains, 1)])
    {'stage_8': {'gain': 5.0}}
    """
    found: dict[str, dict[str, float]] = {}
    for column in (*COMPARED, *ABOVE):
        values = {
            row.record: float(x)
            for row in rows
            if isinstance(x := row.values.get(column), (int, float))
            and (column in COMPARED or x > 0.0)
        }
        if len(values) < FEWEST:
            continue
        scaled = values if column in COMPARED else {k: math.log(x) for k, x in values.items()}
        middle = statistics.median(scaled.values())
        least = SHARE * abs(middle) if column in COMPARED else math.log(TIMES)
        if column == 'delay_samples':
            least = SAMPLES
        # 1.4826: the standard deviation of normal numbers over the median of their distances
        spread = 1.4826 * statistics.median(abs(x - middle) for x in scaled.values())
        for name, x in scaled.items():
            away = abs(x - middle) if column in COMPARED else x - middle
            if away > max(FAR * spread, least):
                found.setdefault(name, {})[column] = statistics.median(values.values())
    # in the order of the rows
    return {row.record: found[row.record] for row in rows if row.record in found}

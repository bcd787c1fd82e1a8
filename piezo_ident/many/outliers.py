# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Find outliers among many records, and their columns."""

from __future__ import annotations

from collections.abc import Sequence
import math
import statistics

from piezo_ident.many.table import Row

#: least values of a column that give its usual spread
FEWEST = 8
#: least distance of an outlier from the median, in standard deviations (from the median of the
#: distances), and as a share of the median
FAR, SHARE = 5.0, 0.02
#: least distance of an outlying delay [samples]: a whole number may come out as its neighbour
SAMPLES = 1.5
#: columns compared by value, and columns compared by logarithm, with outliers only above the
#: median (errors and noise)
COMPARED = (
    *('sample_rate', 'duration', 'voltage_high', 'stroke', 'gain', 'loop_width'),
    *('delay_samples', 'bandwidth', 'resonance'),
)
ABOVE = (
    *('error_held_out', 'error_fitted', 'error_before', 'error_after', 'unexplained'),
    'noise_floor',
)
#: least ratio of an outlying error to the median
TIMES = 1.25


def stand_out(rows: Sequence[Row]) -> dict[str, dict[str, float]]:
    """
    Find outlying records, and map them to their outlying columns with the medians.

    Examples
    --------
    >>> gains = [5.0, 5.1, 4.9, 5.2, 5.0, 4.8, 5.1, 3.9]
    >>> stand_out([Row(f'stage_{i}', {'gain': x}) for i, x in enumerate(gains, 1)])
    {'stage_8': {'gain': 5.0}}
    """
    medians: dict[str, dict[str, float]] = {}
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
        # 1.4826: ratio of the standard deviation of normal numbers to the median of their
        # distances
        spread = 1.4826 * statistics.median(abs(x - middle) for x in scaled.values())
        for name, x in scaled.items():
            away = abs(x - middle) if column in COMPARED else x - middle
            if away > max(FAR * spread, least):
                medians.setdefault(name, {})[column] = statistics.median(values.values())
    # in the order of the rows
    return {row.record: medians[row.record] for row in rows if row.record in medians}

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What many records say together: the spread of each quantity, its drift, and who stands out.

The order is that of the dates in the names where every name holds one, else that of the names.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
import re

import numpy as np
from numpy.typing import NDArray
from piezo_ident.many.run import Row
from piezo_ident.many.table import natural
from scipy import stats

__all__ = ['QUANTITIES', 'Quantity', 'Spread', 'dates', 'in_order', 'spread_of', 'values_of']

#: distance from the median from which a record stands out, in robust standard deviations
FAR = 5.0
#: and in shares of the median, so that nobody stands out of numbers that are all but equal
NEAR = 1e-3
#: chance at which a trend that is none is called one
CHANCE = 1e-3
#: records from which a trend is looked for, and to which more of them are thinned for it
FEWEST, MOST = 8, 1000
_DATE = re.compile(
    r'(?<!\d)((?:19|20)\d\d)([-_.]?)([01]\d)\2([0-3]\d)'
    r'(?:[T_ -]([0-2]\d)[-_.:h]?([0-5]\d)(?:[-_.:m]?([0-5]\d))?)?(?!\d)'
)


@dataclass(frozen=True)
class Quantity:
    """
    What is compared between records.

    Attributes
    ----------
    column : str
        Of the table.
    name, unit : str
        For people.
    factor : float
        From the unit of the table to `unit`.
    """

    column: str
    name: str
    unit: str
    factor: float = 1.0


#: errors first, then what the stage is like
QUANTITIES = (
    Quantity('error_held_out', 'held-out error', '% of stroke'),
    Quantity('error_selection', 'selection error', '% of stroke'),
    Quantity('error_before', 'error before', '% of stroke'),
    Quantity('error_after', 'error after', '% of stroke'),
    Quantity('unexplained', 'unexplained', '% of stroke'),
    Quantity('noise_floor', 'noise floor', '% of stroke'),
    Quantity('stroke', 'stroke', 'µm', 1e6),
    Quantity('gain', 'gain', 'µm/V', 1e6),
    Quantity('loop_width', 'loop width', '% of stroke'),
    Quantity('delay', 'delay', 'ms', 1e3),
    Quantity('bandwidth', 'bandwidth', 'Hz'),
    Quantity('resonance', 'resonance', 'Hz'),
)


@dataclass(frozen=True)
class Spread:
    """
    The spread of a quantity over records.

    Attributes
    ----------
    quantity : Quantity
    n : int
        Records that have it.
    lowest, low, median, high, highest : float
        In the unit of the quantity; `low` and `high` leave 5 % below and above.
    drift : float or None
        Change from the first to the last record after Theil and Sen; None where Kendall's test
        calls it chance.
    far : tuple of str
        Records that stand out, the farthest first.
    """

    quantity: Quantity
    n: int
    lowest: float
    low: float
    median: float
    high: float
    highest: float
    drift: float | None
    far: tuple[str, ...]


def dates(names: Sequence[str]) -> list[datetime] | None:
    """
    Return the dates in names; None unless all hold one, and not all the same.

    Examples
    --------
    >>> dates(['cal_2026-03-01', 'cal_2026-04-01_1730'])[1]
    datetime.datetime(2026, 4, 1, 17, 30)
    >>> dates(['cal_2026-03-01', 'stage_20260301999'])
    """
    found = []
    for name in names:
        match = _DATE.search(name)
        if match is None:
            return None
        year, _, month, day, *clock = match.groups()
        try:
            hour, minute, second = (int(x or 0) for x in clock)
            found.append(datetime(int(year), int(month), int(day), hour, minute, second))
        except ValueError:
            return None
    return found if len(set(found)) > 1 else None


def in_order(rows: Sequence[Row]) -> list[Row]:
    """Return rows by the dates in their names where all have one, else by their names."""
    ordered = sorted(rows, key=lambda row: natural(row.record))
    when = dates([row.record for row in ordered])
    if when is None:
        return ordered
    return [ordered[i] for i in sorted(range(len(ordered)), key=lambda i: when[i])]


def values_of(rows: Sequence[Row], quantity: Quantity) -> NDArray[np.float64]:
    """Return a quantity of rows in its unit, shape (n,), NaN where there is none."""
    cells = [row.values.get(quantity.column) for row in rows]
    return quantity.factor * np.array(
        [float(x) if isinstance(x, (int, float)) else np.nan for x in cells]
    )


def standing_out(x: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return where values stand out, shape (k,), the farthest first; NaN never does."""
    known = np.isfinite(x)
    if known.sum() < FEWEST:
        return np.zeros(0, dtype=np.int64)
    middle = float(np.median(x[known]))
    distance = np.where(known, np.abs(x - middle), 0.0)
    usual = 1.4826 * float(np.median(distance[known]))
    far = np.flatnonzero(distance > max(FAR * usual, NEAR * abs(middle)))
    return far[np.argsort(-distance[far], kind='stable')]


def _drift(x: NDArray[np.float64]) -> float | None:
    if x.size < FEWEST or np.ptp(x) == 0.0:
        return None
    k = np.unique(np.linspace(0, x.size - 1, min(x.size, MOST)).round().astype(int))
    tau = stats.kendalltau(k, x[k])
    if not tau.pvalue < CHANCE:
        return None
    return float(stats.theilslopes(x[k], k).slope) * (x.size - 1)


def spread_of(rows: Sequence[Row], quantity: Quantity) -> Spread | None:
    """
    Return the spread of a quantity over records, None where no record has it.

    Parameters
    ----------
    rows : sequence of Row
        In the order in which a drift is looked for.
    quantity : Quantity
    """
    x = values_of(rows, quantity)
    known = x[np.isfinite(x)]
    if not known.size:
        return None
    lowest, low, median, high, highest = np.quantile(known, [0.0, 0.05, 0.5, 0.95, 1.0])
    return Spread(
        quantity=quantity,
        n=int(known.size),
        lowest=float(lowest),
        low=float(low),
        median=float(median),
        high=float(high),
        highest=float(highest),
        drift=_drift(known),
        far=tuple(rows[i].record for i in standing_out(x)),
    )

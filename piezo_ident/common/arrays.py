# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Arrays: types, checks, runs of true values, straight lines, a range without wild numbers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.errors import DataError

#: real numbers, which ones count, and places
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Integers = NDArray[np.int64]

#: numbers that are looked at together, so that temporaries stay small beside a long record
CHUNK = 1 << 20
#: share of the range, and multiple of the usual step between two numbers, by which one without
#: neighbours may leave the range
_LONE, _STEPS = 0.25, 4.0
_FLOAT = np.dtype(np.float64)
#: types that numpy would turn into wrong numbers
_CURES = {
    'c': 'give its real part',
    **dict.fromkeys('mM', "give seconds, as in (t - t[0]) / np.timedelta64(1, 's')"),
}


def frozen_array(values: ArrayLike, where: str = 'array') -> Array:
    """Convert `values` to a read-only `real_array`, copied only when it must be."""
    array = real_array(values, where)
    if array.flags.writeable:
        # a view would leave the data open to its owner, so only already frozen arrays are shared
        array = array.copy()
        array.setflags(write=False)
    return array


def real_array(values: ArrayLike, where: str = 'array') -> Array:
    """
    Convert real numbers to float64, a masked number to NaN; raise DataError for other types.

    >>> real_array(np.ma.array([1, 2, 3], mask=[False, True, False]))
    array([ 1., nan,  3.])
    """
    # the common case costs nothing, for streams in small blocks
    if type(values) is np.ndarray and values.dtype == _FLOAT:
        return values
    got: object = type(values).__name__
    cure = 'give one number a sample'
    try:
        given: Any = np.ma.asarray(values)
        got = given.dtype
        if given.dtype.kind not in _CURES:
            return np.asarray(np.ma.filled(given.astype(np.float64, copy=False), np.nan))
        cure = _CURES[given.dtype.kind]
    except (TypeError, ValueError):
        pass
    raise DataError(f'{where}: expected real numbers, got {got}; {cure}')


def finite_vector(values: ArrayLike, verb: str, name: str, of: str, least: int = 0) -> Array:
    """Convert a signal of a verb to a vector of finite numbers, or raise DataError."""
    x = real_array(values, f'{verb}, {name}')
    if x.ndim != 1 or x.size < least or not np.isfinite(x).all():
        bad = np.count_nonzero(~np.isfinite(x))
        raise DataError(
            f'{verb}: the {name} has the shape {x.shape} and {bad} bad or masked numbers; it must '
            f'be a vector of {of}'
        )
    return x


def true_runs(mask: Mask) -> list[tuple[int, int]]:
    """List the runs of true values, each as its first place and the place behind its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(np.int8), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def closed(mask: Mask, most: int) -> Mask:
    """
    Close the gaps of up to `most` samples between two stretches of true ones.

    >>> closed(np.array([False, True, False, True, False, False, True]), 1).astype(int)
    array([0, 1, 1, 1, 0, 0, 1])
    """
    new = mask.copy()
    for a, b in true_runs(~mask):
        new[a:b] = b - a <= most and a > 0 and b < mask.size
    return new


def interpolated(x: Array, bad: Mask, usable: Mask | None = None) -> Array:
    """
    Replace bad numbers by straight lines between usable good ones.

    The same array comes back if all numbers are good, or all are bad.

    >>> interpolated(np.array([0.0, 9.0, 2.0]), np.array([False, True, False]))
    array([0., 1., 2.])
    """
    good = ~bad if usable is None else ~bad & usable
    if not bad.any() or not good.any():
        return x
    new = x.copy()
    new[bad] = np.interp(np.flatnonzero(bad), np.flatnonzero(good), x[good])
    return new


def line_between(before: float, after: float, missing: int) -> Array:
    """
    Compute the missing numbers on the straight line between two numbers.

    >>> line_between(1.0, 4.0, 2)
    array([2., 3.])
    """
    return before + (after - before) * (np.arange(1, missing + 1) / (missing + 1))


def lines_between(before: Iterable[float], after: Iterable[float], missing: int) -> Array:
    """Compute `line_between` for each of k signals, shape (k, missing)."""
    ends = zip(before, after, strict=True)
    return np.stack([line_between(*pair, missing) for pair in ends])


def robust_range(parts: Iterable[Array]) -> tuple[float, float]:
    """
    Find the smallest and largest of measured numbers, but for wild ones.

    Three samples in a row span the range.  One or two samples alone may leave the range by a
    quarter of its width and four times the usual step from sample to sample; wilder samples are
    left out.  The range of sound data, noise included, is from minimum to maximum.  The parts are
    samples in order of time; without any samples both ends are zero.

    >>> import numpy as np
    >>> robust_range([np.array([0.0, 0.0, 1.0, 3.0, 3.0, 3.0, 90.0, 2.0, 1.0, 0.0])])
    (0.0, 3.0)
    """
    filled = [x for x in parts if x.size]
    if not filled:
        return 0.0, 0.0
    low, high, step = np.inf, -np.inf, 0.0
    for x in _chunks(filled, overlap=2):
        if x.size >= 3:
            step = max(step, float(np.median(np.abs(np.diff(x)))))
            high = max(high, float(np.minimum(np.minimum(x[:-2], x[1:-1]), x[2:]).max()))
            low = min(low, float(np.maximum(np.maximum(x[:-2], x[1:-1]), x[2:]).min()))
    if low <= high:
        slack = _LONE * (high - low) + _STEPS * step
        low, high = low - slack, high + slack
    else:  # fewer than three, or no three alike
        low, high = -np.inf, np.inf
    smallest, largest = np.inf, -np.inf
    for x in _chunks(filled):
        kept = x[(x >= low) & (x <= high)]
        if kept.size:
            smallest, largest = min(smallest, float(kept.min())), max(largest, float(kept.max()))
    return smallest, largest


def _chunks(parts: Sequence[Array], overlap: int = 0) -> Iterator[Array]:
    for x in parts:
        for i in range(0, x.size, CHUNK):
            yield x[i : i + CHUNK + overlap]

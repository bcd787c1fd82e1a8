# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Blocks of samples: (t, value) rows as in a Float64MultiArray, without ROS.

A block is an N x 2 matrix, row by row::

    dim[0] = {label 'sample:<segment>', size N, stride 2N}
    dim[1] = {label 't,<quantity>',     size 2, stride 2}

A block thus names the segment and the quantity of its samples.  The quantity is ``voltage``,
``displacement``, ``voltage_<name>`` or ``displacement_<name>`` for a further axis, or ``x_<name>``
for a further channel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import DataError
from piezo_ident.record.record import Segment

#: samples in a block by default
BLOCK_SIZE = 100
#: labels of voltages that the driver chose: it holds the last voltage during a gap, and ramps to
#: rest when the commands end
HELD, RAMPED = 'hold:gap', 'ramp:silence'
#: share of a sample by which times of ticks may be rounded
ROUNDING = 1e-5
#: shortest sampling period of a block [s]: 10 MHz is the highest rate of a node; largest time [s]:
#: 300 years, where a double still resolves 2 us
SHORTEST, LATEST = 1e-7, 1e10
#: ratio of longest to shortest step that means a missing sample, not jitter (taste)
UNEVEN = 1.5


class Dimension(NamedTuple):
    """One dimension of a multi-array's layout."""

    label: str
    size: int
    stride: int


@dataclass(frozen=True, eq=False)
class Samples:
    """A block of one quantity: times [s], values [SI], shapes (n,), and label of its segment."""

    t: Array
    values: Array
    segment: str = ''
    quantity: str = 'voltage'

    @property
    def not_finite(self) -> int:
        """Number of values that are NaN or infinite."""
        return int(np.count_nonzero(~np.isfinite(self.values)))


def encode(samples: Samples) -> tuple[Array, tuple[Dimension, Dimension]]:
    """
    Return the data vector and the layout of a block.

    >>> data, dims = encode(Samples(np.array([0.0, 0.1]), np.array([5.0, 6.0]), 'noise'))
    >>> data.tolist(), dims[0]
    ([0.0, 5.0, 0.1, 6.0], Dimension(label='sample:noise', size=2, stride=4))
    """
    n = samples.t.size
    data = np.empty(2 * n)
    data[0::2] = samples.t
    data[1::2] = samples.values
    return data, (
        Dimension(f'sample:{samples.segment}', n, 2 * n),
        Dimension(f't,{samples.quantity}', 2, 2),
    )


def quantity_of(dims: Sequence[Any]) -> str | None:
    """Return the quantity of a layout, None for the layout of another message."""
    if len(dims) != 2 or not dims[1].label.startswith('t,'):
        return None
    return str(dims[1].label)[2:].strip()


def decode(data: ArrayLike, dims: Sequence[Any], data_offset: int = 0) -> Samples:
    """
    Return the samples of a block, from the numbers of its message, shape (2 n,), and their layout.

    The numbers are not copied; `data_offset` numbers stand in front of the matrix.  Times on ticks
    of a whole rate become k / rate, so that streams meet on equal numbers.  DataError for another
    layout than that of a block, or for a layout that does not fit the data.
    """
    flat = np.asarray(data, dtype=np.float64)
    quantity = quantity_of(dims)
    if quantity is None:
        labels = [d.label for d in dims]
        raise DataError(f"layout {labels} is not ['sample:<segment>', 't,<quantity>']")
    (n, outer), (width, inner) = ((int(d.size), int(d.stride)) for d in dims)
    if n < 0 or (outer, width, inner) != (2 * n, 2, 2):
        raise DataError(
            f'layout {n} x {width} with strides {outer}, {inner} is not N x 2 with strides 2N, 2'
        )
    if flat.size - data_offset != 2 * n or data_offset < 0:
        raise DataError(
            f'layout announces {n} x 2 numbers after {data_offset}, the message holds {flat.size}'
        )
    kind, _, segment = dims[0].label.partition(':')
    if kind != 'sample':
        raise DataError(f"first dimension is {dims[0].label!r}, not 'sample:<segment>'")
    matrix = flat[data_offset:].reshape(n, 2)
    return Samples(_on_ticks(matrix[:, 0]), matrix[:, 1], segment, quantity)


@np.errstate(over='ignore', invalid='ignore')
def time_problem(t: Array) -> str:
    """
    Return why time stamps [s] are not consecutive samples; empty if they are.

    >>> time_problem(np.array([0.0, 0.1, 0.2])), time_problem(np.array([0.0, np.nan]))
    ('', 'its time stamps are not finite, or more than 1e+10 s from zero')
    """
    if not t.size:
        return 'an empty block'
    step = np.diff(t)
    # NaN passes no comparison
    if not (abs(float(t[0])) < LATEST and abs(float(t[-1])) < LATEST and np.isfinite(step).all()):
        return f'its time stamps are not finite, or more than {LATEST:g} s from zero'
    low, high = (float(step.min()), float(step.max())) if step.size else (1.0, 1.0)
    if 0.999 * SHORTEST < low and high < UNEVEN * low:
        return ''
    steps = f'steps of {low:.6g} to {high:.6g} s'
    return f'its time stamps are not ticks of one rate in a row: {steps}'


@np.errstate(over='ignore', invalid='ignore')
def _on_ticks(t: Array) -> Array:
    """Replace times that are rounded ticks by ticks over their rate."""
    span = float(t[-1] - t[0]) if t.size > 1 else 0.0
    rate = (t.size - 1) / span if 0.0 < span < np.inf else 0.0
    # `time_problem` judges times that are no numbers, or jump
    if not 1.0 <= rate < 1e9 or abs(rate / round(rate) - 1.0) > ROUNDING:
        return t
    exact: Array = np.rint(t * round(rate)) / round(rate)
    return np.where(np.abs(t - exact) * rate < ROUNDING, exact, t)


def cut_blocks(
    n: int, segments: Sequence[Segment], size: int = BLOCK_SIZE
) -> Iterator[tuple[int, int, str]]:
    """
    Yield (start, stop, label) of blocks that cover `n` samples, none across two segments.

    >>> list(cut_blocks(7, [Segment('step', 2, 7)], size=4))
    [(0, 2, ''), (2, 6, 'step'), (6, 7, 'step')]
    """
    end = 0
    for s in (*segments, Segment('', n, n)):
        for label, start, stop in (('', end, s.start), (s.label, s.start, s.stop)):
            for i in range(start, stop, size):
                yield i, min(i + size, stop), label
        end = s.stop

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The best linear approximation of a stage of several axes, line by line.

Around each line the response is a polynomial of the frequency, fitted to all records at once by
least squares: y(k + d) = sum_p G_p d^p u(k + d), G(k) = G_0.  As many records as inputs determine
it without help of the neighbours; more of them, and the neighbours, average distortion and noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import DataError
from piezo_ident.fitting.modes.periods import PeriodicRecord

#: a line whose voltage is smaller than this part of the largest is not excited
EXCITED = 0.02


@dataclass(frozen=True, eq=False)
class LineResponse:
    """
    G at lines of a period.

    Attributes
    ----------
    lines : ndarray of int, shape (k,)
        Numbers of the lines, multiples of rate / samples.
    samples : int
        Samples a period.
    g : ndarray of complex, shape (k, outputs, inputs)
    """

    lines: NDArray[np.intp]
    samples: int
    g: NDArray[np.complex128]

    @property
    def z(self) -> NDArray[np.complex128]:
        """The lines on the unit circle."""
        return np.asarray(np.exp(2j * np.pi * self.lines / self.samples))

    @property
    def size(self) -> Array:
        """Compute the rms response of each output, shape (outputs, 1); a zero becomes 1."""
        size = np.sqrt(np.mean(np.abs(self.g) ** 2, axis=(0, 2)))[:, None]
        return np.where(size > 0, size, 1)


def excited_lines(records: Sequence[PeriodicRecord]) -> NDArray[np.intp]:
    """Return the lines, without the mean, that every input excites on average over the records."""
    power = np.mean([np.abs(np.fft.rfft(r.mean_u, axis=0)) ** 2 for r in records], axis=0)
    power[0] = 0
    # lines that few records excite are noise beside the common lines
    return np.flatnonzero((power > EXCITED**2 * power.max(axis=0)).all(axis=1))


def frequency_response(
    records: Sequence[PeriodicRecord], *, half_width: int = 4, degree: int = 2
) -> LineResponse:
    """
    Fit the response at each excited line by a local polynomial over its neighbours.

    The polynomial has a degree, and `half_width` neighbours on either side.
    """
    lines = excited_lines(records)
    u = np.array([np.fft.rfft(r.mean_u, axis=0)[lines] for r in records])
    y = np.array([np.fft.rfft(r.mean_y, axis=0)[lines] for r in records])
    inputs, outputs = u.shape[2], y.shape[2]
    width = 2 * half_width + 1
    if len(lines) < width:
        raise DataError(f'the inputs share {len(lines)} lines of a period, {width} are needed')
    unknown, known = inputs * (degree + 1), width * len(records)
    if known < unknown:
        raise DataError(
            f'{len(records)} records of {len(lines)} lines do not determine the response from '
            f'{inputs} inputs; take more records or a wider neighbourhood'
        )
    g = np.zeros((len(lines), outputs, inputs), complex)
    for i in range(len(lines)):
        low = max(0, min(i - half_width, len(lines) - width))
        near = slice(low, low + width)
        powers = np.vander((lines[near] - lines[i]) / half_width, degree + 1, increasing=True)
        columns = (u[:, near, None, :] * powers[None, :, :, None]).reshape(known, unknown)
        solution = np.linalg.lstsq(columns, y[:, near].reshape(-1, outputs), rcond=None)[0]
        g[i] = solution[:inputs].T
    return LineResponse(lines, len(records[0].mean_u), g)


def likeness(records: Sequence[PeriodicRecord]) -> float:
    """Compute the largest correlation of two voltages over all records, 0 to 1."""
    u = np.concatenate([r.mean_u for r in records])
    return float(np.abs(np.triu(np.corrcoef(u.T), 1)).max())

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
from piezo_ident.axes.periodic import PeriodicRecord
from piezo_ident.common.errors import DataError

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
    def size(self) -> NDArray[np.float64]:
        """The rms of the response of each output, 1 where there is none; shape (outputs, 1)."""
        size = np.sqrt(np.mean(np.abs(self.g) ** 2, axis=(0, 2)))[:, None]
        return np.where(size > 0, size, 1)


def excited_lines(records: Sequence[PeriodicRecord]) -> NDArray[np.intp]:
    """Return the lines, without the mean, that every input excites on average over the records."""
    power = np.mean([np.abs(np.fft.rfft(r.mean_u, axis=0)) ** 2 for r in records], axis=0)
    power[0] = 0
    # what a few records excite alone is noise beside what all of them do
    return np.flatnonzero((power > EXCITED**2 * power.max(axis=0)).all(axis=1))


def frequency_response(
    records: Sequence[PeriodicRecord], *, half_width: int = 4, degree: int = 2
) -> LineResponse:
    """
    Fit the response at each excited line by a local polynomial over its neighbours.

    Parameters
    ----------
    records : sequence of PeriodicRecord
        Of one rate and one number of samples.
    half_width : int
        Neighbours on either side.
    degree : int
        Degree of the polynomial.
    """
    shapes = {(r.u.shape[1:], r.y.shape[1:], r.rate) for r in records}
    if len(shapes) != 1:
        raise DataError(f'the records differ in samples, channels or rate: {sorted(shapes)}')
    lines = excited_lines(records)
    u = np.array([np.fft.rfft(r.mean_u, axis=0)[lines] for r in records])
    y = np.array([np.fft.rfft(r.mean_y, axis=0)[lines] for r in records])
    inputs, outputs = u.shape[2], y.shape[2]
    width = 2 * half_width + 1
    if len(lines) < width:
        raise DataError(
            f'the inputs share {len(lines)} lines of a period, {width} are needed; drive every '
            'axis by a multisine of its own of the same many lines (docs/two_axes.md)'
        )
    unknown, known = inputs * (degree + 1), width * len(records)
    if known < unknown:
        raise DataError(
            f'{len(records)} records of {len(lines)} lines do not determine the response from '
            f'{inputs} inputs; take more records or a wider neighbourhood'
        )
    g = np.zeros((len(lines), outputs, inputs), complex)
    for i in range(len(lines)):
        columns, near = neighbours(u, lines, i, half_width, degree)
        solution = np.linalg.lstsq(columns, y[:, near].reshape(-1, outputs), rcond=None)[0]
        g[i] = solution[:inputs].T
    return LineResponse(lines, len(records[0].mean_u), g)


def neighbours(
    u: NDArray[np.complex128], lines: NDArray[np.intp], at: int, half_width: int, degree: int
) -> tuple[NDArray[np.complex128], slice]:
    """
    Return the columns of a local polynomial, inputs first, and the lines that it is fitted to.

    u has the shape (records, lines, inputs), the middle is ``lines[at]``; a row of the columns is
    a line of a record.
    """
    width = 2 * half_width + 1
    low = max(0, min(at - half_width, len(lines) - width))
    near = slice(low, low + width)
    powers = np.vander((lines[near] - lines[at]) / half_width, degree + 1, increasing=True)
    columns = u[:, near, None, :] * powers[None, :, :, None]
    return columns.reshape(-1, u.shape[2] * (degree + 1)), near


def likeness(records: Sequence[PeriodicRecord], *, half_width: int = 4) -> NDArray[np.float64]:
    """
    Return how much the inputs are one signal, shape (inputs, inputs).

    Of each pair the coherence over the neighbours of a line and all records, 0 to 1, median over
    the lines: with 1 nothing tells what either of them moves.  0 where there are too few lines.
    """
    lines = excited_lines(records)
    width = 2 * half_width + 1
    if len(lines) < width:
        return np.zeros((records[0].u.shape[2],) * 2)
    u = np.array([np.fft.rfft(r.mean_u, axis=0)[lines] for r in records])
    products = np.einsum('rki,rkj->kij', u.conj(), u)
    sums = np.cumsum(np.concatenate([0 * products[:1], products]), axis=0)
    near = sums[width:] - sums[:-width]
    power = np.real(np.einsum('kii->ki', near))
    coherence = np.abs(near) ** 2 / (power[:, :, None] * power[:, None, :])
    return np.asarray(np.median(coherence, axis=0))

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Invert a linear model of several axes by filters that look ahead.

    Q(f) = (G* G + epsilon^2)^-1 G*

Inputs and outputs of G are motions in spans.  The input is the motion that the voltages cause at
rest, so the gain of G at rest is one.  `piezo_ident.control.linear_inverse` explains the filter
for one axis.
"""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.control.linear_inverse import cut, LinearInverse, LONGEST, SHORTEST
from piezo_ident.model.modes.modal import Modal
from scipy.signal import oaconvolve

#: largest condition of the gain at rest (taste: a motion of 0.1 um takes the voltage of 1 mm)
SINGULAR = 1e4


class AxesFilter(LinearInverse):
    """Filter of several axes, with taps of the shape (ahead + 1 + behind, outputs, inputs)."""

    @property
    def size(self) -> Array:
        """Sum of the sizes of each tap of all paths."""
        return np.asarray(np.abs(self.taps).sum(axis=(1, 2)))

    def with_gain(self, taps: Array) -> Array:
        """Scale other taps to the static gain of this filter."""
        return np.asarray(self.taps.sum(axis=0) @ np.linalg.inv(taps.sum(axis=0)) @ taps)

    def __call__(self, x: Array) -> Array:
        """Filter signals of shape (n, inputs) that rest before and after their samples."""
        padded = np.pad(x, ((self.behind, self.ahead), (0, 0)), mode='edge')
        return np.column_stack(
            [
                sum(oaconvolve(z, h, mode='valid') for z, h in zip(padded.T, row, strict=True))
                for row in self.taps.transpose(1, 2, 0)
            ]
        )


def static_gain(G: Modal, spans: Array) -> Array:
    """Compute the gain at rest [spans/V]; ModelError if it has no inverse."""
    static = G.response(np.ones(1, complex))[0].real / spans[:, None]
    condition = np.linalg.cond(static)
    if not condition < SINGULAR:
        raise ModelError(
            f'the shared modes have no inverse: their gain at rest has the condition '
            f'{condition:.3g}, the most is {SINGULAR:g}; two axes move as one, or one stands '
            'still: diagnose again from a record in which each axis moves alone'
        )
    return np.asarray(static)


def inverse_filters(G: Modal, spans: Array, least: float) -> tuple[AxesFilter, AxesFilter]:
    """
    Invert a linear model of several axes where its gain is not small.

    Parameters
    ----------
    G : Modal
    spans : ndarray, shape (axes,)
        Displacements by which errors of the axes are compared [m].
    least : float
        Share of the static gain below which G is not inverted.

    Returns
    -------
    Q, P : AxesFilter
        The inverse, and G Q.  Their static gains are exact.

    Raises
    ------
    ModelError
        When the static gain has no inverse, or the filter needs more than `LONGEST` samples.
    """
    static = static_gain(G, spans)
    n, left = SHORTEST, np.inf
    while n <= LONGEST:
        z = np.exp(2j * np.pi * np.fft.rfftfreq(n))
        whole = G.response(z) / spans[:, None] @ np.linalg.inv(static)
        back = whole.conj().swapaxes(1, 2)
        Q = np.linalg.solve(back @ whole + least**2 * np.eye(len(spans)), back)
        taps = [np.roll(np.fft.irfft(x, n, axis=0), n // 2, axis=0) for x in (Q, whole @ Q)]
        left, enough = cut(np.abs(taps[0]).sum(axis=(1, 2)), left)
        if enough is not None:
            parts = [x[enough.used] for x in taps]
            q, p = (x @ np.linalg.inv(x.sum(axis=0)) for x in parts)
            of_spans = np.linalg.inv(static) @ q / spans, spans[:, None] * p / spans
            inverse, passed = (AxesFilter(x, enough.ahead, enough.behind) for x in of_spans)
            return inverse, passed
        n *= 2
    raise ModelError(
        f'these modes have no inverse of less than {LONGEST} samples: a zero of the modes dies '
        'away too slowly; diagnose again with longer periods'
    )

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit the creep of each axis by the slow error of shared modes in free run.

The gain of the modes at rest turns slow errors of all displacements into voltages w, one an axis.
With elements l_ji of creep of the voltage u_j they are

    w_j = sum_i c_ji l_ji + g_j u_j + a constant of each piece

The gain g_j takes the error that follows the voltage at once, because a wide loop has another gain
than multisines.  The model leaves g_j out.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from piezo_ident.common.arrays import Array, Integers, interpolated, Mask
from piezo_ident.fitting.stage import CREEP_SPREAD, MOST_CREEP
from piezo_ident.model.modes.shared_modes import SharedModes
from piezo_ident.record.channels import Axes
from scipy.optimize import lsq_linear
from scipy.signal import lfilter


class SlowMotion(NamedTuple):
    """
    Errors of modes and elements of creep, averaged over blocks, about the mean of each piece.

    Attributes
    ----------
    w, u : ndarray, shape (blocks, axes)
        Errors and voltages [V].
    lags : ndarray, shape (blocks, axes, m)
        Elements of creep [V].
    """

    w: Array
    u: Array
    lags: Array

    @classmethod
    def of(cls, modes: SharedModes, axes: Axes, taus: Array, size: int) -> SlowMotion:
        """Average a piece over blocks of `size` samples; the elements have `taus` [samples]."""
        u, e = axes.inputs - modes.v0, axes.outputs - modes.simulate(axes.inputs)
        # the modes follow slow voltages at once
        known = np.column_stack([interpolated(x, np.isnan(x)) for x in e.T])
        w = known @ np.linalg.pinv(modes.linear.gain).T
        kept = np.exp(-1 / taus)
        lags = [lfilter([1 - a], [1, -a], u, axis=0, zi=a * u[:1])[0] for a in kept]
        n = len(u) // size
        means = (x[: n * size].reshape(n, size, -1).mean(axis=1) for x in (w, u, *lags))
        w, u, *lags = (x - x.mean(axis=0) for x in means)
        return cls(w, u, np.stack(lags, axis=-1))

    @classmethod
    def joined(cls, parts: Sequence[SlowMotion]) -> SlowMotion:
        """Join the blocks of several pieces."""
        return cls(*(np.concatenate(x) for x in zip(*parts, strict=True)))

    def of_axis(self, axis: int, scale: Array) -> SlowMotion:
        """Take an axis out, shapes (blocks,) and (blocks, m); each block counts by its scale."""
        return SlowMotion(*((x[:, axis].T / scale).T for x in self))

    def shares(self, chosen: Mask) -> Array:
        """Fit the shares of the creep of one axis to chosen blocks, shape (m,)."""
        w, u, lags = (x[chosen] for x in self)
        m = lags.shape[1]
        prior = np.sqrt(np.mean(self.w**2)) / CREEP_SPREAD * np.eye(m, m + 1)
        rows = np.vstack([np.column_stack([lags, u]), prior])
        low, high = np.full((2, m + 1), [[-np.inf], [np.inf]])
        low[:m], high[:m] = 0.0, MOST_CREEP
        # a share at its bound is exactly zero
        fit = lsq_linear(rows, np.append(w, np.zeros(m)), (low, high), method='bvls')
        return np.asarray(fit.x[:m])

    def held_out(self, sets: Integers) -> Array:
        """Compute the errors of one axis with creep, each set predicted by the others."""
        left = self.w.copy()
        for k in np.unique(sets):
            left[sets == k] -= self.lags[sets == k] @ self.shares(sets != k)
        return left

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""How much of an effect the best refit of a base model leaves."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from .cores import Array, plays, Row
from .stage import Base, Stage, VOLTS

#: thresholds of the refitted base
THRESHOLDS = 40
#: one sample in so many is compared
STRIDE = 8


def base_of(base: Base, v: ArrayLike) -> Array:
    """
    Return an orthonormal basis, shape (m, 43), of what a refit of the base can do.

    Offset, v, v^3 and 40 plays behind the stage's own dynamics and delay, one sample in `STRIDE`.

    Parameters
    ----------
    base : Base
    v : array_like, shape (n,)
        [V], at 20 kHz.
    """
    u = np.ascontiguousarray(v, dtype=np.float64) / VOLTS
    parts = [u, u**3]
    for r in (np.arange(THRESHOLDS) + 0.5) / THRESHOLDS:
        parts.append(plays(u, Row(np.array([r]), np.ones(1))))
    columns = [np.ones(u.size), *(base.carry(part) for part in parts)]
    Q, _ = np.linalg.qr(np.stack([c[::STRIDE] for c in columns], axis=1))
    return np.asarray(Q)


def left_over(
    stage: Stage, t: ArrayLike, v: ArrayLike, channels: Mapping[str, ArrayLike], basis: Array
) -> tuple[float, float]:
    """
    Return the rms of what the effects change, before and after a refit [% of stroke].

    Parameters
    ----------
    stage : Stage
    t, v : array_like, shape (n,)
        [s] and [V], at 20 kHz.
    channels : mapping
    basis : ndarray
        From `base_of`.
    """
    without = stage.without_effects().respond(t, v, clean=True)
    change = (stage.respond(t, v, channels=channels, clean=True) - without)[::STRIDE]
    rest = change - basis @ (basis.T @ change)
    stroke = float(np.ptp(without))
    raw, left = (100.0 * float(np.sqrt(np.mean(x**2))) / stroke for x in (change, rest))
    return raw, left

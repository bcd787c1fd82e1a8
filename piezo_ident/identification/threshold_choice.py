# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Number and places of the thresholds of H, chosen by the error on data that were not fitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from piezo_ident.identification.step3_hysteresis import (
    even_thresholds,
    Excerpt,
    factorise,
    fit_hysteresis,
    merged,
)
from piezo_ident.operators.dynamics import Delay, Dynamics

__all__ = ['choose_thresholds']

#: numbers of evenly spaced thresholds that are tried, one after the other
COUNTS = (10, 14, 20, 28, 40, 56, 80)
#: a larger number must lower the held-out error by this share
GAIN = 0.01


def _held_loss(
    fit: Sequence[Excerpt],
    held: Sequence[Excerpt],
    thresholds: NDArray[np.float64],
    dynamics: Dynamics,
    delay: Delay,
) -> tuple[float, NDArray[np.float64]]:
    n = int(sum(e.use.sum() for e in fit))
    result = fit_hysteresis(factorise(fit, thresholds, dynamics, delay), thresholds, n)
    h = result.hysteresis
    R = factorise(held, h.thresholds, dynamics, delay)
    x = np.concatenate([result.offsets, h.weights, [h.p1, h.p2]])
    return float(np.linalg.norm(R[:, :-1] @ x - R[:, -1])), merged(h)


def choose_thresholds(
    fit: Sequence[Excerpt],
    held: Sequence[Excerpt],
    swing: float,
    dynamics: Dynamics,
    delay: Delay,
    tick: Callable[[float], None] | None = None,
) -> NDArray[np.float64]:
    """
    Refine the thresholds until the held-out error stops falling.

    The grid grows; at each size the plays that least squares left without weight are dropped and
    neighbours merged, and the merged set is kept where it does no worse.

    Parameters
    ----------
    fit, held : sequence of Excerpt
        The same runs in the same order with the fitted and the held-out samples.
    swing : float
        Excited range of the normalised voltage.
    dynamics : Dynamics
    delay : Delay
    tick : callable, optional
        Called with the share of the work done; may raise to stop it.

    Returns
    -------
    ndarray
        Thresholds, normalised.
    """
    best = even_thresholds(swing, COUNTS[0])
    best_loss, places = _held_loss(fit, held, best, dynamics, delay)
    misses = 0
    for i, count in enumerate(COUNTS[1:]):
        if tick is not None:
            tick(i / len(COUNTS))
        even = even_thresholds(swing, count)
        loss, places = _held_loss(fit, held, even, dynamics, delay)
        candidates = [(loss, even)]
        if 1 < places.size < even.size:
            candidates.append((_held_loss(fit, held, places, dynamics, delay)[0], places))
        # the fewer thresholds win a tie
        loss, thresholds = min(
            candidates, key=lambda c: (c[0] * (1 + 1e-3 * c[1].size), c[1].size)
        )
        if loss < (1.0 - GAIN) * best_loss:
            best, best_loss, misses = thresholds, loss, 0
        else:
            misses += 1
            if misses == 2:
                break
    return best

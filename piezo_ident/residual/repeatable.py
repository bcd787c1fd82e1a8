# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""How much of a residual comes again each time the drive does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.residual.stretches import ResidualPart, Stretch

__all__ = ['Repeatability', 'repeatability']


@dataclass(frozen=True)
class Repeatability:
    """
    What a residual repeats where the drive does.

    Attributes
    ----------
    repeatable, unrepeatable : float or None
        Rms of what comes again in every period, which a model of the voltage could hold, and of
        what does not: noise, hum, drift, faults [m].  None when they are unknown.
    share : float or None
        Of the mean square that is repeatable, 0..1.
    seconds : float
        Time in which the drive repeats, the first periods left out.
    source : str
        Where it was read, in words.
    """

    repeatable: float | None
    unrepeatable: float | None
    share: float | None
    seconds: float
    source: str


def repeatability(parts: Sequence[ResidualPart], stretches: Sequence[Stretch]) -> Repeatability:
    """
    Return how much of residuals repeats, from all stretches in which v repeats three times.

    Of each stretch the first period, which may be settling, is left out.  The spread over the
    others at the same place of the period is what does not repeat.
    """
    again = apart = 0.0
    count, found, seconds = 0, 0, 0.0
    for s in stretches:
        periods = s.n // s.period - 1 if s.period else 0
        if periods < 2:
            continue
        start = s.start + s.period
        rows = parts[s.part].e[start : start + periods * s.period].reshape(periods, s.period)
        rows = rows - rows.mean()
        spread = float(np.mean(rows.var(axis=0, ddof=1)))
        # the mean over periods holds a share of the spread, too
        shared = max(float(np.mean(rows.mean(axis=0) ** 2)) - spread / periods, 0.0)
        again += shared * rows.size
        apart += spread * rows.size
        count += rows.size
        found += 1
        seconds += rows.size / parts[s.part].piece.sample_rate
    if count == 0:
        source = 'floor unknown: the voltage does not repeat three times'
        return Repeatability(None, None, None, 0.0, source)
    return Repeatability(
        repeatable=float(np.sqrt(again / count)),
        unrepeatable=float(np.sqrt(apart / count)),
        share=again / max(again + apart, 1e-300),
        seconds=seconds,
        source=f'periods of the voltage in {found} stretches, {seconds:.3g} s',
    )

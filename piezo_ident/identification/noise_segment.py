# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The segment of noise that the first two steps read delay and G from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import IdentificationError
from piezo_ident.identification.prepare import END_HELD, Run
from piezo_ident.identification.spectra import excited_band, prefilter


@dataclass(frozen=True, eq=False)
class NoiseSegment:
    """Input and output of a noise segment, prefiltered to its band [Hz]; the end is held out."""

    fitted: tuple[Array, Array]
    held: tuple[Array, Array]
    band: float


def noise_segment(run: Run, signal: Array, start: int, stop: int) -> NoiseSegment:
    """
    Return the noise between two samples, its input replaced by a signal.

    Noise in which nothing moves raises IdentificationError.
    """
    rate = run.piece.sample_rate
    if np.ptp(run.u[start:stop]) == 0.0 or np.ptp(run.x[start:stop]) == 0.0:
        raise IdentificationError(
            f'{run.record}: voltage or displacement is constant in the noise segment'
        )
    band = band_of(run, start, stop)
    u, y = (prefilter(x[start:stop], rate, band) for x in (signal, run.x))
    fit = slice(min(500, u.size // 20), u.size - int(END_HELD * u.size))
    return NoiseSegment((u[fit], y[fit]), (u[fit.stop :], y[fit.stop :]), band)


def band_of(run: Run, start: int, stop: int) -> float:
    """Return up to which frequency the voltage moves between two samples [Hz]."""
    u = run.u[start:stop]
    return excited_band(u - u.mean(), run.piece.sample_rate)


def longest_noise(runs: Sequence[Run]) -> tuple[Run, int, int]:
    """
    Return the longest unbroken noise: its run, first sample and the one behind the last.

    Where it is too short it raises IdentificationError.
    """
    found = [
        (stop - start, run, start, stop)
        for run in runs
        for s in run.piece.find('noise')
        for start, stop in run.unbroken(s.start, s.stop)
    ]
    n, run, start, stop = max(found, key=lambda item: item[0])
    if n < 2000:
        raise IdentificationError(
            f'{run.record}: the noise segment has {n} samples; at least 2000 are needed'
        )
    return run, start, stop

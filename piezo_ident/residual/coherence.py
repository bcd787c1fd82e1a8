# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Whether a residual follows the voltage: its coherence, with a bound."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from piezo_ident.residual.stretches import ResidualPart
from scipy import fft, signal

__all__ = ['Coherence', 'coherence']

Array = NDArray[np.float64]

#: of the bound
CONFIDENCE = 0.99
#: averages asked of a coherence, longest segment [samples]
AVERAGES, SEGMENT = 32, 8192
#: share of the input's largest density below which there is no input to cohere with
EXCITED = 1e-7
#: independent averages in one that overlaps by half, with a Hann window
OVERLAP = 1.0 / 1.056


@dataclass(frozen=True, eq=False)
class Coherence:
    """
    Coherence of voltage and residual.

    Attributes
    ----------
    frequency, coherence : ndarray, shape (p,)
        [Hz], and ``|S_ve|^2 / (S_vv S_ee)``.
    tested : ndarray of bool, shape (p,)
        Frequencies at which the voltage has power.
    bound : float
        ``1 - (1 - c)^(1/(L - 1))`` of L independent averages: unrelated signals stay below it in
        a share c of cases.
    share : float
        Share of the residual's power that is coherent with the voltage, bias taken away.
    """

    frequency: Array
    coherence: Array
    tested: NDArray[np.bool_]
    bound: float
    share: float


def _chosen(parts: Sequence[ResidualPart]) -> tuple[list[ResidualPart], float]:
    """Return the parts of the rate at which most was sampled."""
    rates: dict[float, int] = {}
    for part in parts:
        rates[part.piece.sample_rate] = rates.get(part.piece.sample_rate, 0) + part.piece.n
    if not rates:
        return [], 1.0
    rate = max(rates, key=lambda r: rates[r])
    return [p for p in parts if abs(p.piece.sample_rate / rate - 1.0) < 1e-6], rate


def coherence(parts: Sequence[ResidualPart]) -> Coherence | None:
    """
    Return the coherence of voltage and residual by Welch's method; None when too short.

    Notes
    -----
    Bendat and Piersol, Random Data, 4th ed. (2010), section 9.2, doi:10.1002/9781118032428.
    """
    chosen, rate = _chosen(parts)
    runs = [(p, a, b) for p in chosen for a, b in p.runs()]
    total = sum(b - a for _, a, b in runs)
    if total < 256:
        return None
    n = int(2 ** np.floor(np.log2(max(64, 2 * total // AVERAGES))))
    n = min(n, SEGMENT)
    window = signal.windows.hann(n, sym=False)
    vv, ee, ve, count = np.zeros(n // 2 + 1), np.zeros(n // 2 + 1), 0j, 0
    for part, start, stop in runs:
        for k in range(start, stop - n + 1, n // 2):
            v = window * signal.detrend(part.piece.v[k : k + n])
            e = window * signal.detrend(part.e[k : k + n])
            V, E = fft.rfft(v), fft.rfft(e)
            vv += np.abs(V) ** 2
            ee += np.abs(E) ** 2
            ve = ve + np.conj(V) * E
            count += 1
    if count < 4:
        return None
    averages = max(2.0, count * OVERLAP)
    tiny = np.finfo(float).tiny
    c = np.clip(np.abs(ve) ** 2 / np.maximum(vv * ee, tiny), 0.0, 1.0)
    tested = vv > EXCITED * float(vv.max())
    # the first bins are what detrending left
    tested[:2] = False
    bound = 1.0 - (1.0 - CONFIDENCE) ** (1.0 / (averages - 1.0))
    unbiased = np.clip((c - 1.0 / averages) / (1.0 - 1.0 / averages), 0.0, 1.0)
    power = float(ee[2:].sum())
    coherent = float(np.sum((unbiased * ee)[tested & (c > bound)]))
    return Coherence(
        frequency=np.arange(n // 2 + 1) * rate / n,
        coherence=c,
        tested=tested,
        bound=float(bound),
        share=coherent / power if power > 0.0 else 0.0,
    )

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The frequency response without a model: Welch's estimate, its coherence and its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

__all__ = ['FrequencyResponse', 'frequency_response']


@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """
    Response of an output to an input.

    Attributes
    ----------
    frequency : ndarray, shape (n,)
        [Hz]
    response : ndarray of complex, shape (n,)
        ``S_uy / S_uu``.
    coherence : ndarray, shape (n,)
        ``|S_uy|^2 / (S_uu S_yy)``.
    std : ndarray, shape (n,)
        Relative standard deviation of the magnitude, ``sqrt((1 - c) / (2 c L))``.
    averages : int
        Number L of segments.
    """

    frequency: NDArray[np.float64]
    response: NDArray[np.complex128]
    coherence: NDArray[np.float64]
    std: NDArray[np.float64]
    averages: int


def _straightened(x: NDArray[np.float64]) -> NDArray[np.float64]:
    # what `scipy.signal.detrend` does, without a least-squares problem for every segment
    t = np.arange(x.shape[-1]) - 0.5 * (x.shape[-1] - 1)
    x = x - x.mean(axis=-1, keepdims=True)
    return np.asarray(x - (x @ t)[..., None] / max(float(t @ t), 1.0) * t)


def frequency_response(
    u: NDArray[np.float64], y: NDArray[np.float64], sample_rate: float, band: float | None = None
) -> FrequencyResponse:
    """
    Estimate a frequency response by Welch's method.

    Parameters
    ----------
    u, y : ndarray, shape (n,)
        Input and output; linear trends are removed segment by segment.
    sample_rate : float
        [Hz]
    band : float, optional
        Highest frequency returned [Hz].

    Notes
    -----
    Bendat and Piersol, Random Data, 4th ed. (2010), table 9.6, doi:10.1002/9781118032428.
    """
    segment = int(2 ** np.floor(np.log2(max(u.size // 16, 16))))
    segment = min(segment, 8192)
    how: dict[str, Any] = {'fs': sample_rate, 'nperseg': segment, 'detrend': _straightened}
    f, s_uy = signal.csd(u, y, **how)
    _, s_uu = signal.welch(u, **how)
    _, s_yy = signal.welch(y, **how)
    averages = max(1, 2 * u.size // segment - 1)
    tiny = np.finfo(float).tiny
    coherence = np.clip(np.abs(s_uy) ** 2 / np.maximum(s_uu * s_yy, tiny), 0.0, 1.0)
    std = np.sqrt((1.0 - coherence) / (2.0 * np.maximum(coherence, 1e-12) * averages))
    keep = f > 0.0
    if band is not None:
        keep &= f <= band
    return FrequencyResponse(
        frequency=f[keep],
        response=(s_uy / np.maximum(s_uu, tiny))[keep],
        coherence=coherence[keep],
        std=std[keep],
        averages=averages,
    )

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Compute figures of merit of a stage: few numbers that can be compared between stages.

Coefficients of G cannot be compared, since two identifications of one stage may choose different
orders.  The figures are read from the responses of H and of G.
"""

from __future__ import annotations

import numpy as np
from piezo_ident.model.stage_model import StageModel

#: number of samples of a branch of the loop, and of frequencies at which G is evaluated
BRANCH, FREQUENCIES = 400, 4000
#: lowest of these frequencies, as a share of the highest
LOWEST = 1e-4
#: |G| from which a maximum counts as a resonance
PEAK = 1.05


def figures_of_merit(model: StageModel) -> dict[str, float | None]:
    """
    Compute the figures of merit of a stage, by the columns of `piezo_ident.many.table`.

    The gain [m/V] is negative for a stage that retracts.  The loop width is in % of the stroke
    over the identified range.  The bandwidth [Hz] is the frequency at which |G| falls to
    1/sqrt(2); it is None if |G| never falls so far.  The resonance [Hz] is the frequency of the
    largest |G|; the resonance and its peak are None without a peak.

    Examples
    --------
    >>> from piezo_ident.operators.dynamics import Delay, Dynamics
    >>> from piezo_ident.operators.hysteresis import Hysteresis
    >>> from piezo_ident.model.scaling import Scaling
    >>> scaling = Scaling(0.0, 10.0, 0.0, 70e-6, (0.0, 10.0))
    >>> line = Hysteresis([], [], 0.0, 1.0)
    >>> stage = figures_of_merit(StageModel(1e4, scaling, line, Dynamics.unit(), Delay(3)))
    >>> print(f'{stage["gain"]:.1e} {stage["loop_width"]:g} {stage["resonance"]}')
    7.0e-06 0 None
    """
    names = ('gain', 'loop_width', 'bandwidth', 'resonance', 'resonance_peak')
    return dict(zip(names, (*_loop(model), *_frequency_response(model)), strict=True))


def _loop(model: StageModel) -> tuple[float, float]:
    low, high = model.scaling.range
    first, last = model.scaling.u(np.array([low, high]))
    up = np.linspace(first, last, BRANCH)
    # the first rise is the virgin curve; the loop repeats from there on
    w = model.hysteresis(np.concatenate([up, up[-2::-1], up[1:]]))
    down, again = w[BRANCH - 1 : 2 * BRANCH - 1][::-1], w[2 * BRANCH - 2 :]
    span = float(again[-1] - again[0])
    width = float(np.max(np.abs(down - again)))
    stroke = float(np.ptp(again))
    return (
        span * model.dynamics.gain * model.scaling.Y / (high - low),
        100.0 * width / stroke if stroke > 0.0 else 0.0,
    )


def _frequency_response(model: StageModel) -> tuple[float | None, float | None, float | None]:
    if model.is_static:
        return None, None, None
    top = 0.5 * model.sample_rate
    f = np.geomspace(LOWEST * top, top, FREQUENCIES)
    size = np.abs(model.dynamics.response(f, model.sample_rate)) / abs(model.dynamics.gain)
    low = np.flatnonzero(size < np.sqrt(0.5))
    bandwidth = None
    if low.size and low[0] > 0:
        k = int(low[0])
        # |G| is nearly a straight line between neighbouring frequencies
        bandwidth = float(np.interp(-np.sqrt(0.5), -size[[k - 1, k]], f[[k - 1, k]]))
    k = int(np.argmax(size))
    if size[k] < PEAK or k in (0, f.size - 1):
        return bandwidth, None, None
    curve = np.polyfit(np.log(f[k - 1 : k + 2] / f[k]), size[k - 1 : k + 2], 2)
    at = -curve[1] / (2.0 * curve[0])
    return bandwidth, float(f[k] * np.exp(at)), float(np.polyval(curve, at))

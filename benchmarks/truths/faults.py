# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What goes wrong between a stage and a file."""

from __future__ import annotations

import numpy as np

from .cores import Array, Rng

#: by what names a fault may be reported
NAMES = {
    'stuck': ('missed_samples', 'stuck'),
    'repeated': ('missed_samples', 'stuck'),
    'jitter': ('timing_jitter',),
    'outliers': ('outliers', 'lost'),
    'clipping': ('clipping', 'stuck'),
}


def spoilt(y: Array, fault: str, rate: float, rng: Rng) -> Array:
    """
    Return readings with a fault.

    `y`: in parts of the stroke, as the sensor reads; `fault`: one of `NAMES`; `rate`: [Hz].
    """
    y = y.copy()
    n = y.size
    if fault == 'stuck':
        # the driver hangs for 30 to 150 ms at a time
        for start in rng.integers(n // 20, n - n // 20, int(rng.integers(3, 9))):
            y[start : start + round(rng.uniform(0.03, 0.15) * rate)] = y[start]
    elif fault == 'repeated':
        lost = np.flatnonzero(rng.random(n - 1) < rng.uniform(0.003, 0.02)) + 1
        y[lost] = y[lost - 1]
    elif fault == 'jitter':
        delta = rng.uniform(0.1, 0.4) * rng.standard_normal(n)
        y += np.gradient(y) * delta
    elif fault == 'outliers':
        at = rng.choice(n, int(rng.integers(10, 50)), replace=False)
        y[at] += rng.choice([-1.0, 1.0], at.size) * np.exp(
            rng.uniform(np.log(0.005), np.log(0.3), at.size)
        )
    elif fault == 'clipping':
        low, high = float(y.min()), float(y.max())
        cut = rng.uniform(0.02, 0.06) * (high - low)
        y = np.minimum(y, high - cut) if rng.random() < 0.5 else np.maximum(y, low + cut)
    else:
        raise ValueError(f'no fault {fault!r}; there are {", ".join(NAMES)}')
    return y

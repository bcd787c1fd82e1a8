# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Truth of a scanner."""

from __future__ import annotations

import functools

from foreign.cores import bouc_wen_of, Core, core_of, uneven
import numpy as np
from piezo_ident.common.arrays import Array
from truths.linear import Cascade, delayed, relaxation
from truths.linear import RATE as FINE

RATE = 10_000.0
STROKE, LIMITS = 50e-6, (0.0, 10.0)
NOISE, BITS = 2e-4, 16
CROSS = 0.015
CREEP = 0.0065


@functools.cache
def cores(seed: int = 0) -> tuple[Core, Core]:
    rng = np.random.default_rng([190, seed])
    first = None
    while first is None:
        first = core_of('preisach', uneven(rng), rng.uniform(0.12, 0.16))
    second = None
    while second is None:
        beta = rng.uniform(0.55, 1.0)
        law = bouc_wen_of(rng.uniform(1.0, 6.0), beta, 1.0 - beta, 1.0)
        second = core_of('bouc_wen', law, rng.uniform(0.12, 0.16))
    return first, second


#: modes of the axes
OWN = (
    Cascade(((190.0, 0.02, 0.93), (610.0, 0.02, 0.07)), (2000.0,)),
    Cascade(((240.0, 0.025, 0.95), (820.0, 0.02, 0.05)), (2500.0,)),
)
GUIDE = Cascade(((310.0, 0.03, 1.0),), ())


def respond(v: Array, rng: np.random.Generator, creep: int = 1) -> Array:
    """V (n, 2) at RATE -> y (n, 2) m."""
    fine = np.repeat(v / 10.0, 2, axis=0)
    # a stage in use has been driven before: the loops are steady
    way = np.linspace(0.0, 1.0, 2000)
    before = np.concatenate([*[way, way[::-1]] * 3, np.linspace(0.0, fine[0, 0], 500)])
    h = [
        core(np.concatenate([before, fine[:, i]]))[before.size :] for i, core in enumerate(cores())
    ]
    h[creep] = relaxation(h[creep], 'log', CREEP)
    h = [x - x[0] for x in h]
    own = [G(x) for G, x in zip(OWN, h, strict=True)]
    y = []
    for i in range(2):
        j = 1 - i
        cross = CROSS * (0.7 * OWN[i](own[j]) + 0.3 * GUIDE(h[j]))
        y.append(delayed(own[i] + cross, 0.23e-3, FINE)[::2])
    out = np.stack(y, axis=1)
    out += NOISE * rng.standard_normal(out.shape)
    step = 1.2 / 2**BITS
    return STROKE * step * np.round(out / step)

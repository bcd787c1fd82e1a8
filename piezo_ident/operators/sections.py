# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Run G as a cascade of second-order sections if eq. (5) would lose digits.

Each output of eq. (5) is rounded, and the rounding error passes through 1/A like noise.  A G with
many lightly damped modes amplifies it to 1e-10 of the stroke.  The rounding error of a section
only passes through two poles and the sections behind it: the same G then keeps 1e-13.
"""

from __future__ import annotations

import math

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import alive, ordered_kernel

#: share of the output that eq. (5) may lose by rounding
LOST = 2e-14
#: largest relative error of the static gain of the sections, and of their products against B and
#: A: a larger error means inaccurate roots
NEAR, SAME = 1e-2, 1e-12
#: share of the largest b up to which the first b counts as zero: its roots would overflow
NOTHING = 1e-300
#: number of samples after which a state that has died away is set to zero
STRETCH = 1024


def rounding_of(a: Array) -> float:
    """
    Estimate the rms rounding error of eq. (5) as a share of its output.

    The error is the rounding of one output times the rms gain of 1/A.  This gain is the product of
    1 / sqrt(1 - k^2) over its reflection coefficients k; infinite for an unstable G.
    """
    size, power, rest = 1.0 + float(a @ a), 1.0, a
    while rest.size:
        last, rest = float(rest[-1]), rest[:-1]
        if not abs(last) < 1.0:
            return math.inf
        share = 1.0 / (1.0 - last * last)
        power *= share
        rest = share * (rest - last * rest[::-1])
    return float(np.finfo(np.float64).eps) * math.sqrt(size * power)


def sections_of(a: Array, b: Array, gain: float) -> Array | None:
    """
    Factor G into sections with rows b_0, b_1, b_2, a_1, a_2; None if eq. (5) is accurate enough.

    The sections, shape (n, 5), keep the static gain to the last digit.
    """
    begins = abs(b[0]) > NOTHING * np.abs(b).max()
    if not begins or not math.isfinite(gain) or not LOST < rounding_of(a) < math.inf:
        return None
    # few models need scipy.signal, and its import takes half a second
    from scipy.signal import zpk2sos

    whole = np.concatenate([[1.0], a])
    made = zpk2sos(np.roots(b), np.roots(whole), b[0])
    # if B begins with a tiny coefficient, one zero is far out, and the other zeros are inaccurate
    if not (_is_product(made[:, :3], b) and _is_product(made[:, 3:], whole)):
        return None
    static = float(np.prod(made[:, :3].sum(axis=1) / made[:, 3:].sum(axis=1)))
    # roots close to each other may be too inaccurate as well
    if not abs(gain - static) < NEAR * abs(static):
        return None
    made[0, :3] *= gain / static
    return np.ascontiguousarray(made[:, [0, 1, 2, 4, 5]])


def _is_product(parts: Array, whole: Array) -> bool:
    product = np.ones(1)
    for part in parts:
        product = np.convolve(product, part)
    product[: whole.size] -= whole
    return bool(np.abs(product).max() <= SAME * np.abs(whole).max())


def sections_at_rest(c: Array, x: float) -> tuple[Array, float]:
    """Compute the state of sections at rest under x, shape (n, 2), and their output."""
    z = np.empty((c.shape[0], 2))
    for i, (b0, b1, b2, a1, a2) in enumerate(c):
        y = x * (b0 + b1 + b2) / (1.0 + a1 + a2)
        z[i] = y - b0 * x, b2 * x - a2 * y
        x = float(y)
    return z, x


@ordered_kernel
def run_sections(x: Array, c: Array, z: Array, out: Array) -> None:
    """Write the output of sections for x to `out`, shape (n,), and update z, shape (n, 2)."""
    for start in range(0, x.size, STRETCH):
        for k in range(start, min(start + STRETCH, x.size)):
            u = x[k]
            for i in range(c.shape[0]):
                y = c[i, 0] * u + z[i, 0]
                z[i, 0] = (c[i, 1] * u + z[i, 1]) - c[i, 3] * y
                z[i, 1] = c[i, 2] * u - c[i, 4] * y
                u = y
            out[k] = u
        # a test in every sample would delay the next sample
        for i in range(c.shape[0]):
            z[i, 0], z[i, 1] = alive(z[i, 0]), alive(z[i, 1])

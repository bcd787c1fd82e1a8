# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Tangent of H with plays that widen with speed, and its transpose.

A play at an edge of its band follows the voltage and the low-passed speed.  A play within its band
keeps its value.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import kernel, ordered_kernel
from piezo_ident.effects.moving_plays import edges, Growth
from piezo_ident.effects.rate_dependent_hysteresis import RateDependentHysteresis
from piezo_ident.operators.kernels import curve_slope, held
from scipy.sparse.linalg import LinearOperator

#: edges and weights of the plays, slopes of their lower and upper edges by the power of the speed,
#: slope of the remaining line, slope of the power, pole and gain of the low-pass of the speed
Parts = tuple[NDArray[np.int8], Array, Array, Array, Array, Array, float, float]


def tangent(effect: RateDependentHysteresis, u: Array, u0: float) -> LinearOperator:
    """
    Linearise H at a voltage u, shape (n,), that starts from rest at u0.

    The operator maps a small change of the voltage to the change of H.
    """
    h = effect.hysteresis
    r, q, p1, p2, p0, low, c = h.for_kernel
    power, slope = effect.power_and_slope(np.ascontiguousarray(u), u0)
    growth = effect.growth
    rest = h.initial_memory(u0)
    memory = np.append(rest, np.zeros(r.size - rest.size))
    edge = np.empty((u.size, r.size), dtype=np.int8)
    weight = np.tile(q, (u.size if c.size else 1, 1))
    line = (3.0 * p1 * u + 2.0 * p0) * u + p2
    _edges(u, power, r, growth, low, c, memory, edge, weight, line)
    lower, upper = r * growth[1] + growth[0], r * growth[3] + growth[2]
    gain = (1.0 - effect.pole) * effect.sample_rate
    parts = edge, weight, lower, upper, line, slope, effect.pole, gain

    def product(kernel: Callable[..., None], x: Array) -> Array:
        out = np.zeros(u.size)
        kernel(np.ascontiguousarray(x.ravel()), parts, out)
        return out

    products = partial(product, _forward), partial(product, _transposed)
    return LinearOperator((u.size, u.size), *products, dtype=np.float64)


@kernel
def _edges(
    u: Array,
    power: Array,
    r: Array,
    growth: Growth,
    low: float,
    c: Array,
    memory: Array,
    edge: NDArray[np.int8],
    weight: Array,
    line: Array,
) -> None:
    """Write the edge of each play (-1 lower, 1 upper, 0 none), and add the slopes of curves."""
    for k in range(u.size):
        x, s = u[k], power[k]
        for i in range(r.size):
            lower, upper = edges(0.0, r[i], s, growth)
            edge[k, i] = 1 if memory[i] > x + upper else -1 if memory[i] < x + lower else 0
            memory[i] = held(memory[i], x + lower, x + upper)
            if c.shape[0]:
                t = memory[i] - low
                line[k] += c[3, i] * t
                weight[k, i] += c[3, i] * (x - low) + curve_slope(c, i, t)


@ordered_kernel
def _forward(x: Array, parts: Parts, out: Array) -> None:
    edge, weight, lower, upper, line, slope, pole, gain = parts
    plays, speed, last = np.zeros(lower.size), 0.0, 0.0
    for k in range(x.size):
        speed = pole * speed + gain * (x[k] - last)
        last = x[k]
        power, w = slope[k] * speed, line[k] * x[k]
        row = weight[k if weight.shape[0] > 1 else 0]
        for i in range(lower.size):
            if edge[k, i] > 0:
                plays[i] = x[k] + upper[i] * power
            elif edge[k, i] < 0:
                plays[i] = x[k] - lower[i] * power
            w += row[i] * plays[i]
        out[k] = w


@ordered_kernel
def _transposed(x: Array, parts: Parts, out: Array) -> None:
    edge, weight, lower, upper, line, slope, pole, gain = parts
    plays, speed = np.zeros(lower.size), 0.0
    for k in range(x.size - 1, -1, -1):
        power, v = 0.0, line[k] * x[k]
        row = weight[k if weight.shape[0] > 1 else 0]
        for i in range(lower.size):
            plays[i] += row[i] * x[k]
            if edge[k, i] > 0:
                v += plays[i]
                power += upper[i] * plays[i]
                plays[i] = 0.0
            elif edge[k, i] < 0:
                v += plays[i]
                power -= lower[i] * plays[i]
                plays[i] = 0.0
        speed += slope[k] * power
        out[k] += v + gain * speed
        if k > 0:
            out[k - 1] -= gain * speed
        speed *= pole

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The compiled loops of `piezo_ident.fitting.adaptation`: recursive least squares in groups."""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import ordered_kernel

#: least squared signal of a measurement that is used, as a share of the variance of its noise
TELLS = 1e-2
#: share of refused measurements that is tolerated; a larger share means another stage
RARE = 0.1

# places in `now`: samples of the group, finite samples of it, refused measurements, scale of the
# variance, used measurements.  PIVOT is the learnt displacement at the average position
COUNT, FINITE, REFUSED, SCALE, LEARNT, PIVOT, PLACES = range(7)
# places in `law`: variance of a measurement, decay of the high-pass in a sample, decay of old
# information in a group, groups of patience, squared gate
ERROR, KEEP, KEPT, PATIENCE, GATE = range(5)


@ordered_kernel
def _invert(a: Array, out: Array) -> None:
    # Gauss-Jordan; a positive definite matrix needs no search for pivots
    n = a.shape[0]
    work = a.copy()
    out[:, :] = 0.0
    for i in range(n):
        out[i, i] = 1.0
    for i in range(n):
        pivot = work[i, i]
        for k in range(n):
            work[i, k] /= pivot
            out[i, k] /= pivot
        for j in range(n):
            if j != i:
                share = work[j, i]
                for k in range(n):
                    work[j, k] -= share * work[i, k]
                    out[j, k] -= share * out[i, k]


@ordered_kernel
def _times(a: Array, x: Array, out: Array) -> float:
    # writes a x, returns x a x
    total = 0.0
    for i in range(x.size):
        out[i] = 0.0
        for j in range(x.size):
            out[i] += a[i, j] * x[j]
        total += x[i] * out[i]
    return total


@ordered_kernel
def _constrain(theta: Array, P: Array, halves: Array, way: Array) -> None:
    # corrects the most violated half-space, at most ten times; theta = 0 fulfils all of them
    n = theta.size
    for _ in range(10):
        worst, at = 0.0, -1
        for k in range(halves.shape[0]):
            off = -halves[k, n]
            for i in range(n):
                off += halves[k, i] * theta[i]
            if off < worst:
                worst, at = off, k
        if at < 0:
            return
        share = worst / _times(P, halves[at, :n], way) * (1.0 + 1e-9)
        for i in range(n):
            theta[i] -= way[i] * share
    # some half-space is still violated: go halfway back to the unchanged model
    for i in range(n):
        theta[i] *= 0.5


@ordered_kernel
def _take(
    e: float,
    f: Array,
    law: Array,
    prior: Array,
    halves: Array,
    theta: Array,
    information: Array,
    now: Array,
) -> None:
    # learns from one measurement e = f theta
    n, power, patience = f.size, now[SCALE] * law[ERROR], law[PATIENCE]
    told, off = 0.0, e
    for i in range(n):
        off -= f[i] * theta[i]
        if i < n - 1:
            told += f[i] * f[i] / prior[i, i]
    if told < TELLS * power:
        return
    P, own, first = np.empty((n, n)), np.empty(n), np.empty(n)
    _invert(information, P)
    score = off * off / (_times(P, f, own) + power)
    if score > law[GATE]:
        now[REFUSED] += 1.0
        if now[REFUSED] < patience:
            return
        # another stage: return to the prior
        information[:, :] = prior
        now[REFUSED] = 0.0
        # the model may also lack an effect of the stage, which then counts as error
        now[SCALE] *= 2.0
    else:
        now[REFUSED] = max(0.0, now[REFUSED] - RARE)
        # the scale grows slowly, so that a step of the sensor hardly raises it
        now[SCALE] = max(1.0, now[SCALE] * (1.0 + RARE**2 * (score - 1.0) / patience))
    now[LEARNT] += 1.0
    power = now[SCALE] * law[ERROR]
    for i in range(n):
        size = f[i] * f[i] / prior[i, i]
        first[i] = (1.0 - law[KEPT]) * size / (size + TELLS * law[ERROR])
    for i in range(n):
        for j in range(n):
            left = np.sqrt((1.0 - first[i]) * (1.0 - first[j]))
            information[i, j] = left * information[i, j] + f[i] * f[j] / power
        information[i, i] += first[i] * prior[i, i]
    _invert(information, P)
    _times(P, f, own)
    for i in range(n):
        theta[i] += own[i] * off / power
    _constrain(theta, P, halves, own)


@ordered_kernel
def learn(
    y: Array,
    before: Array,
    new: Array,
    law: Array,
    prior: Array,
    halves: Array,
    theta: Array,
    information: Array,
    slow: Array,
    sums: Array,
    now: Array,
    group: int,
    out: Array,
) -> None:
    """
    Learn from y and the free run a horizon before; write the learnt displacement of now to `out`.

    The first row of `before` and `new` is the free run.  Each further row is the response to one
    change of the model.
    """
    n, keep = theta.size - 1, law[KEEP]
    for k in range(y.size):
        if np.isfinite(before[0, k]) and np.isfinite(y[k]):
            e = y[k] - before[0, k]
            for i in range(n + 1):
                x = e if i == n else before[1 + i, k]
                if np.isnan(slow[i]):
                    slow[i] = x
                slow[i] = x + keep * (slow[i] - x)
                sums[i] += x - slow[i]
            now[FINITE] += 1.0
        now[COUNT] += 1.0
        if now[COUNT] == group:
            if now[FINITE] == group:
                mean = sums / group
                f = np.ones(n + 1)
                f[:n] = mean[:n]
                old = theta.copy()
                _take(mean[n], f, law, prior, halves, theta, information, now)
                # a change of theta keeps the average position: the observer corrects the zero
                for i in range(n):
                    now[PIVOT] += (theta[i] - old[i]) * slow[i]
            sums[:] = 0.0
            now[COUNT] = now[FINITE] = 0.0
        add = -now[PIVOT]
        for i in range(n):
            add += theta[i] * new[1 + i, k]
        out[k] = add

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The compiled loops of `piezo_ident.model.observer`: a Kalman filter a hypothesis, in groups."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import ordered_kernel

#: motion of the free run under which a reading that does not change at all is stuck, in spans
STUCK = 0.05
#: log of the least weight of a hypothesis, from which it can still come back
FAINT = -30.0
#: variance of the offset, over the mean square of what was refused, once that is believed: nine
#: tenths of it count as offset, the rest as error of the model (taste)
JUMP = 9.0

# places of the numbers that `State.now` holds
COUNT, PATH, BAND, MOVED, SPREAD, SCALE, REFUSED, SCORES, READING, BEGAN = range(10)
OFFSET, OFFSET_VAR, CREEP, CREEP_VAR, VAR, MISFIT = range(10, 16)
# places of the numbers that `Law.numbers` holds
NOISE, ERROR, LENGTH, WALK, GATE, GROWTH, LAST, REACH = range(8)


class Law(NamedTuple):
    """What a filter knows from the start: rows of the states, and numbers."""

    row: Array  # of offset, creep and m in the mean of a group
    lead: Array  # of creep in the displacement a horizon later
    left: Array  # share of each element of creep after a sample
    kept: Array  # the same of offset, creep after a group
    numbers: Array


class State(NamedTuple):
    """What a filter has found so far: the states of b hypotheses, and the group under way."""

    x: Array  # (b, n)
    P: Array  # (b, n, n)
    weight: Array  # (b,), logarithms
    group: Array  # residual of the group, NaN where there is none
    coming: Array  # creep in the displacement a horizon later, by element
    now: Array


@ordered_kernel
def _typical(group: Array, noise: float) -> tuple[float, int]:
    # mean of the numbers that are not far from the median, and how many they are
    x = np.sort(group[np.isfinite(group)])
    n = x.size
    if n < 3:
        return (x.sum() / n if n else 0.0), n
    middle = 0.5 * (x[(n - 1) // 2] + x[n // 2])
    off = np.sort(np.abs(x - middle))
    # six standard deviations: 6 / 0.6745 medians of the size
    limit = 8.9 * off[n // 2] + 6.0 * noise
    total, count = 0.0, 0
    for k in range(n):
        if abs(x[k] - middle) <= limit:
            total += x[k]
            count += 1
    return total / count, count


@ordered_kernel
def _let_time_pass(law: Law, s: State) -> None:
    numbers, now = law.numbers, s.now
    hypotheses, n = s.x.shape
    phi = np.exp(-now[PATH] / numbers[LENGTH])
    for b in range(hypotheses):
        for i in range(n):
            one = law.kept[i] if i < n - 1 else phi
            s.x[b, i] *= one
            for j in range(n):
                s.P[b, i, j] *= one * (law.kept[j] if j < n - 1 else phi)
        # what unknown plays add has changed by anything up to the shrinking, equally likely
        s.P[b, 0, 0] += numbers[WALK] + (now[MOVED] ** 2 - now[SPREAD] ** 2) / 3.0
        s.P[b, n - 1, n - 1] += now[SCALE] * numbers[ERROR] * (1.0 - phi * phi)
    now[SPREAD], now[PATH] = now[MOVED], 0.0


@ordered_kernel
def _innovation(law: Law, s: State, b: int, mean: float, noise: float) -> tuple[float, float]:
    off, power = mean, noise
    for i in range(law.row.size):
        off -= law.row[i] * s.x[b, i]
        for j in range(law.row.size):
            power += law.row[i] * s.P[b, i, j] * law.row[j]
    return off, power


@ordered_kernel
def _rescale(law: Law, s: State, scale: float) -> None:
    # take another size of the errors; m is at once as large as that, or the size would run away
    scale = max(1.0, scale)
    more = max(0.0, scale - s.now[SCALE]) * law.numbers[ERROR]
    for b in range(s.weight.size):
        s.P[b, -1, -1] += more
    s.now[SCALE] = scale


@ordered_kernel
def _is_believed(law: Law, s: State, mean: float, count: int) -> bool:
    # judge a measurement by the hypothesis that it suits best; what lasts is believed in the end
    numbers, now = law.numbers, s.now
    noise = now[SCALE] * numbers[NOISE] / count
    score, power = np.inf, 0.0
    for b in range(s.weight.size):
        off, size = _innovation(law, s, b, mean, noise)
        if off * off < score * size:
            score, power = off * off / size, size
    if score <= numbers[GATE]:
        now[REFUSED] = max(0.0, now[REFUSED] - 1.0)
        if now[REFUSED] == 0.0:
            now[SCORES] = 0.0
        # a model that errs by more than it says is believed less
        _rescale(law, s, now[SCALE] * (1.0 + numbers[GROWTH] * (score - 1.0)))
        return True
    now[REFUSED] += 1.0
    now[SCORES] += score
    if now[REFUSED] < numbers[LAST]:
        return False
    score = now[SCORES] / now[REFUSED]
    _rescale(law, s, now[SCALE] * score)
    now[REFUSED] = now[SCORES] = 0.0
    for b in range(s.weight.size):
        s.P[b, 0, 0] += JUMP * score * power
        # what was found of creep may stand on an error of the model
        for i in range(1, s.x.shape[1] - 1):
            s.P[b, i, i] += numbers[REACH]
    return True


@ordered_kernel
def _measure(law: Law, s: State, mean: float, count: int) -> None:
    numbers, now = law.numbers, s.now
    hypotheses, n = s.x.shape
    noise = now[SCALE] * numbers[NOISE] / count
    for b in range(hypotheses):
        off, power = _innovation(law, s, b, mean, noise)
        shared = np.zeros(n)
        for i in range(n):
            for j in range(n):
                shared[i] += s.P[b, i, j] * law.row[j]
        for i in range(n):
            s.x[b, i] += shared[i] * off / power
            for j in range(n):
                s.P[b, i, j] -= shared[i] * shared[j] / power
        s.weight[b] -= 0.5 * (np.log(power) + min(off * off / power, numbers[GATE]))
    # mean square of m of late
    m = s.x[int(np.argmax(s.weight)), -1]
    now[MISFIT] += numbers[GROWTH] * (m * m - now[MISFIT])
    s.weight[:] = np.maximum(s.weight - s.weight.max(), FAINT)


@ordered_kernel
def tell(law: Law, s: State) -> None:
    """Note mean and variance, over the hypotheses, of what is corrected."""
    now = s.now
    share = np.exp(s.weight)
    share /= share.sum()
    offset, squares, creep, creeps, whole = 0.0, 0.0, 0.0, 0.0, 0.0
    s.coming[:] = 0.0
    for b in range(share.size):
        a, z, var, cross = s.x[b, 0], 0.0, 0.0, 0.0
        for i in range(law.lead.size):
            z += law.lead[i] * s.x[b, 1 + i]
            s.coming[i] += share[b] * law.lead[i] * s.x[b, 1 + i]
            cross += law.lead[i] * s.P[b, 0, 1 + i]
            for j in range(law.lead.size):
                var += law.lead[i] * s.P[b, 1 + i, 1 + j] * law.lead[j]
        offset += share[b] * a
        creep += share[b] * z
        squares += share[b] * (s.P[b, 0, 0] + a * a)
        creeps += share[b] * (var + z * z)
        whole += share[b] * (s.P[b, 0, 0] + 2.0 * cross + var + (a + z) ** 2)
    now[OFFSET], now[OFFSET_VAR] = offset, max(squares - offset * offset, 0.0)
    now[CREEP], now[CREEP_VAR] = creep, max(creeps - creep * creep, 0.0)
    now[VAR] = max(whole - (offset + creep) ** 2, 0.0)
    now[VAR] += max(now[SCALE] * law.numbers[ERROR], now[MISFIT])


@ordered_kernel
def follow(
    y: Array, free: Array, path: Array, band: Array, law: Law, s: State, out: Array
) -> None:
    """
    Take y, free run, path and band of a horizon before; write what is corrected, shapes (n,).

    Rows of out: the whole correction, offset and creep, with the standard deviation behind each.
    """
    now, size = s.now, s.group.size
    for k in range(y.size):
        if np.isnan(free[k]):  # before the start
            out[0, k], out[1, k] = 0.0, np.sqrt(now[VAR])
            out[2, k], out[3, k] = 0.0, np.sqrt(now[OFFSET_VAR])
            out[4, k], out[5, k] = 0.0, np.sqrt(now[CREEP_VAR])
            continue
        if y[k] != now[READING] and np.isfinite(y[k]):
            now[READING], now[BEGAN] = y[k], free[k]
        stuck = abs(free[k] - now[BEGAN]) > STUCK
        s.group[int(now[COUNT])] = np.nan if stuck else y[k] - free[k]
        now[COUNT] += 1.0
        now[PATH] += path[k]
        now[MOVED] += abs(now[BAND] - band[k])
        now[BAND] = band[k]
        for i in range(law.left.size):
            s.coming[i] *= law.left[i]
        if now[COUNT] == size:
            _let_time_pass(law, s)
            now[COUNT] = 0.0
            mean, count = _typical(s.group, np.sqrt(law.numbers[NOISE]))
            if 2 * count >= size and _is_believed(law, s, mean, count):
                _measure(law, s, mean, count)
                now[MOVED] = now[SPREAD] = 0.0
            tell(law, s)
        creep = 0.0
        for i in range(law.left.size):
            creep += s.coming[i]
        out[0, k] = now[OFFSET] + creep
        out[1, k] = np.sqrt(now[VAR])
        out[2, k], out[3, k] = now[OFFSET], np.sqrt(now[OFFSET_VAR])
        out[4, k], out[5, k] = creep, np.sqrt(now[CREEP_VAR])

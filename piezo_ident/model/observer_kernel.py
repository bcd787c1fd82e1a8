# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Compiled loops of `piezo_ident.model.observer`: a Kalman filter for each hypothesis."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import ordered_kernel

#: motion of the free run after which a constant reading counts as stuck, in spans
STUCK = 0.05
#: logarithm of the smallest weight of a hypothesis, from which it can still recover
FAINT = -30.0
#: variance added to the offset when refused measurements are believed, over their mean square:
#: nine tenths of them count as offset, the rest as error of the model (taste)
JUMP = 9.0
#: refused measurements count as a gain if a gain leaves at most this share of the squared error
#: that an offset leaves (taste)
EXPLAINED = 0.1
#: largest believable change of the gain, in rms sizes; a larger one is a fault of the sensor
#: (taste)
LIKELY = 3.0
#: path over which mean and variance of the free run are averaged, in correlation lengths of the
#: error (taste)
STROKES = 10.0

# places in `FilterState.now`
COUNT, PATH, BAND, MOVED, SPREAD, SCALE, REFUSED, SCORES, READING, BEGAN = range(10)
OFFSET, OFFSET_VAR, CREEP, CREEP_VAR, VAR, MISFIT = range(10, 16)
# for the gain: FREE, mean free run of the group; IDLE, variance of the gain that waits for motion;
# MEAN_X and VAR_X, mean and variance of the free run over the last few strokes
FREE, IDLE, GAIN, GAIN_VAR, CROSS, MEAN_X, VAR_X = range(16, 23)
# sums over refused measurements, of their innovations e and of the free run x
SEEN, SUM_E, SUM_EE, SUM_X, SUM_XX, SUM_XE = range(23, 29)
# fading sums over groups, for the drift of the gain g: number, weights w, w t, w t^2, w g, w t g;
# t is zero now.  Behind them the drift and its standard deviation
GROUPS, SUM_W, SUM_T, SUM_TT, SUM_G, SUM_TG, DRIFT, DRIFT_STD = range(29, 37)
# whether the free run has moved since the reading changed last; WAITING, time whose drift of the
# gain waits for motion [s]; ALONG, share by which the path of a group renews averages along it
STUCK_NOW, WAITING, ALONG, PLACES = range(37, 41)
# places in `Law.numbers`; STEP is the time of a group [s], FADE that of the fading sums [groups],
# DRIFT_VAR the variance of the drift of the gain, zero if it is not followed
NOISE, ERROR, LENGTH, WALK, GATE, GROWTH, LAST, REACH, GAIN_WALK, GAIN_SIZE, STEP, FADE = range(12)
DRIFT_VAR = 12


class Law(NamedTuple):
    """Constants of a filter: factors of its states, and numbers."""

    lead: Array  # Weight of each creep element in the displacement a horizon later.
    left: Array  # Decay of each creep element in a sample.
    kept: Array  # Decay of offset, creep and gain in a group.
    numbers: Array


class FilterState(NamedTuple):
    """Variables of a filter: the states of b hypotheses, and the present group of samples."""

    x: Array  # (b, n)
    P: Array  # (b, n, n)
    weight: Array  # (b,), logarithms.
    row: Array  # (n,), weights of offset, creep, gain and m in the mean of a group.
    group: Array  # (2, size), residual and free run of the group; NaN if missing.
    coming: Array  # Creep in the displacement a horizon later, by element.
    now: Array


@ordered_kernel
def _typical(group: Array, noise: float) -> tuple[float, float, int]:
    # mean of the residuals near their median, mean of the free run at these, and their count
    finite = np.isfinite(group[0])
    x = np.sort(group[0][finite])
    n = x.size
    middle, limit = 0.0, np.inf
    if n >= 3:
        middle = 0.5 * (x[(n - 1) // 2] + x[n // 2])
        off = np.sort(np.abs(x - middle))
        # six standard deviations are 6 / 0.6745 times the median deviation
        limit = 8.9 * off[n // 2] + 6.0 * noise
    total, free, count = 0.0, 0.0, 0
    for k in range(finite.size):
        if finite[k] and abs(group[0, k] - middle) <= limit:
            total += group[0, k]
            free += group[1, k]
            count += 1
    return total / max(count, 1), free / max(count, 1), count


@ordered_kernel
def _has_gain(law: Law, s: FilterState) -> bool:
    # the states are offset, creep, the gain behind its drift if they are followed, and m
    return s.row.size > law.lead.size + 2


@ordered_kernel
def _let_gain_drift(law: Law, s: FilterState, moved: float) -> None:
    # time makes the gain drift, and this counts along the path only, as the variance of the gain
    now, d = s.now, s.row.size - 3
    now[WAITING] += law.numbers[STEP]
    dt, now[WAITING] = moved * now[WAITING], (1.0 - moved) * now[WAITING]
    for b in range(s.weight.size):
        s.x[b, d + 1] += dt * s.x[b, d]
        s.P[b, d + 1] += dt * s.P[b, d]
        s.P[b, :, d + 1] += dt * s.P[b, :, d]


@ordered_kernel
def _let_time_pass(law: Law, s: FilterState) -> None:
    numbers, now = law.numbers, s.now
    hypotheses, n = s.x.shape
    phi = np.exp(-now[PATH] / numbers[LENGTH])
    now[ALONG] = 1.0 - phi ** (1.0 / STROKES)
    if numbers[DRIFT_VAR] > 0.0:
        _let_gain_drift(law, s, 1.0 - phi * phi)
    for b in range(hypotheses):
        for i in range(n):
            one = law.kept[i] if i < n - 1 else phi
            s.x[b, i] *= one
            for j in range(n):
                s.P[b, i, j] *= one * (law.kept[j] if j < n - 1 else phi)
        # unknown plays have moved the offset by up to the shrinking of their band, equally likely
        s.P[b, 0, 0] += numbers[WALK] + (now[MOVED] ** 2 - now[SPREAD] ** 2) / 3.0
        s.P[b, n - 1, n - 1] += now[SCALE] * numbers[ERROR] * (1.0 - phi * phi)
        if numbers[DRIFT_VAR] > 0.0:
            s.P[b, n - 3, n - 3] += numbers[DRIFT_VAR] * (1.0 - law.kept[n - 3] ** 2)
    if _has_gain(law, s):
        # time makes the gain less certain, and this variance counts along the path only
        d = now[FREE] - now[MEAN_X]
        now[MEAN_X] += now[ALONG] * d
        now[VAR_X] = (1.0 - now[ALONG]) * (now[VAR_X] + now[ALONG] * d * d)
        idle = min(now[IDLE] + numbers[GAIN_WALK], numbers[GAIN_SIZE])
        now[IDLE] = idle * phi * phi
        for b in range(hypotheses):
            room = max(0.0, numbers[GAIN_SIZE] - s.P[b, n - 2, n - 2])
            s.P[b, n - 2, n - 2] += min(idle - now[IDLE], room)
    now[SPREAD], now[PATH] = now[MOVED], 0.0


@ordered_kernel
def _innovation(s: FilterState, b: int, mean: float, noise: float) -> tuple[float, float]:
    off, power = mean, noise
    for i in range(s.row.size):
        off -= s.row[i] * s.x[b, i]
        for j in range(s.row.size):
            power += s.row[i] * s.P[b, i, j] * s.row[j]
    return off, power


@ordered_kernel
def _rescale(law: Law, s: FilterState, scale: float) -> None:
    # changes the scale of the errors; m grows at once with it, or the scale would run away
    scale = max(1.0, scale)
    more = max(0.0, scale - s.now[SCALE]) * law.numbers[ERROR]
    for b in range(s.weight.size):
        s.P[b, -1, -1] += more
    s.now[SCALE] = scale


@ordered_kernel
def forget_refused(now: Array) -> None:
    """Forget the refused measurements."""
    now[REFUSED] = now[SCORES] = 0.0
    now[SEEN:GROUPS] = 0.0


@ordered_kernel
def _note_refused(now: Array, e: float) -> None:
    x = now[FREE]
    now[SEEN] += 1.0
    now[SUM_E] += e
    now[SUM_EE] += e * e
    now[SUM_X] += x
    now[SUM_XX] += x * x
    now[SUM_XE] += x * e


@ordered_kernel
def _is_gain(law: Law, now: Array) -> bool:
    # whether the refused measurements are proportional to the displacement, unlike a step
    size, n = law.numbers[GAIN_SIZE], now[SEEN]
    swept = now[SUM_XX] - now[SUM_X] ** 2 / n
    # on a shorter path the error of the model looks proportional, too
    if 12.0 * swept < n * law.numbers[LENGTH] ** 2:
        return False
    by_gain = now[SUM_EE] - now[SUM_XE] ** 2 / now[SUM_XX]
    by_zero = now[SUM_EE] - now[SUM_E] ** 2 / n
    likely = now[SUM_XE] ** 2 <= LIKELY**2 * size * now[SUM_XX] ** 2
    return bool(likely and by_gain <= EXPLAINED * by_zero)


@ordered_kernel
def _is_believed(law: Law, s: FilterState, mean: float, count: int) -> bool:
    # the hypothesis that fits best judges a measurement; lasting refusals are believed in the end
    numbers, now = law.numbers, s.now
    noise = now[SCALE] * numbers[NOISE] / count
    score, power, e = np.inf, 0.0, 0.0
    for b in range(s.weight.size):
        off, size = _innovation(s, b, mean, noise)
        if off * off < score * size:
            score, power, e = off * off / size, size, off
    if score <= numbers[GATE]:
        now[REFUSED] = max(0.0, now[REFUSED] - 1.0)
        if now[REFUSED] == 0.0:
            forget_refused(now)
        # a model that errs by more than expected gets a larger error
        _rescale(law, s, now[SCALE] * (1.0 + numbers[GROWTH] * (score - 1.0)))
        return True
    now[REFUSED] += 1.0
    now[SCORES] += score
    _note_refused(now, e)
    if _has_gain(law, s) and _is_gain(law, now):
        for b in range(s.weight.size):
            s.P[b, -2, -2] += JUMP * (now[SUM_XE] / now[SUM_XX]) ** 2
        forget_refused(now)
        return True
    if now[REFUSED] < numbers[LAST]:
        return False
    score = now[SCORES] / now[REFUSED]
    _rescale(law, s, now[SCALE] * score)
    forget_refused(now)
    for b in range(s.weight.size):
        s.P[b, 0, 0] += JUMP * score * power
        # the creep found so far may have come from an error of the model
        for i in range(1, 1 + law.lead.size):
            s.P[b, i, i] += numbers[REACH]
    return True


@ordered_kernel
def _measure(law: Law, s: FilterState, mean: float, count: int) -> None:
    numbers, now = law.numbers, s.now
    hypotheses, n = s.x.shape
    noise = now[SCALE] * numbers[NOISE] / count
    for b in range(hypotheses):
        off, power = _innovation(s, b, mean, noise)
        shared = np.zeros(n)
        for i in range(n):
            for j in range(n):
                shared[i] += s.P[b, i, j] * s.row[j]
        for i in range(n):
            s.x[b, i] += shared[i] * off / power
            for j in range(n):
                s.P[b, i, j] -= shared[i] * shared[j] / power
        s.weight[b] -= 0.5 * (np.log(power) + min(off * off / power, numbers[GATE]))
    # mean square of m over the last few strokes; at rest m is one value again and again
    m = s.x[int(np.argmax(s.weight)), -1]
    now[MISFIT] += now[ALONG] * (m * m - now[MISFIT])
    s.weight[:] = np.maximum(s.weight - s.weight.max(), FAINT)


@ordered_kernel
def tell(law: Law, s: FilterState) -> None:
    """Average the corrections over the hypotheses, with their variances, and note them."""
    now = s.now
    share = np.exp(s.weight)
    share /= share.sum()
    offset, squares, creep, creeps, whole = 0.0, 0.0, 0.0, 0.0, 0.0
    gain, gains, crossed, drift, drifts = 0.0, 0.0, 0.0, 0.0, 0.0
    s.coming[:] = 0.0
    for b in range(share.size):
        a, z, var, cross = s.x[b, 0], 0.0, 0.0, 0.0
        for i in range(law.lead.size):
            z += law.lead[i] * s.x[b, 1 + i]
            s.coming[i] += share[b] * law.lead[i] * s.x[b, 1 + i]
            cross += law.lead[i] * s.P[b, 0, 1 + i]
            for j in range(law.lead.size):
                var += law.lead[i] * s.P[b, 1 + i, 1 + j] * law.lead[j]
        if _has_gain(law, s):
            g = s.x[b, -2]
            with_gain = s.P[b, 0, -2]
            for i in range(law.lead.size):
                with_gain += law.lead[i] * s.P[b, 1 + i, -2]
            gain += share[b] * g
            gains += share[b] * (s.P[b, -2, -2] + g * g)
            crossed += share[b] * (with_gain + (a + z) * g)
        if law.numbers[DRIFT_VAR] > 0.0:
            drift += share[b] * s.x[b, -3]
            drifts += share[b] * (s.P[b, -3, -3] + s.x[b, -3] ** 2)
        offset += share[b] * a
        creep += share[b] * z
        squares += share[b] * (s.P[b, 0, 0] + a * a)
        creeps += share[b] * (var + z * z)
        whole += share[b] * (s.P[b, 0, 0] + 2.0 * cross + var + (a + z) ** 2)
    now[OFFSET], now[OFFSET_VAR] = offset, max(squares - offset * offset, 0.0)
    now[CREEP], now[CREEP_VAR] = creep, max(creeps - creep * creep, 0.0)
    now[GAIN], now[GAIN_VAR] = gain, max(gains - gain * gain, 0.0)
    now[CROSS] = crossed - (offset + creep) * gain
    if law.numbers[DRIFT_VAR] > 0.0:
        now[DRIFT], now[DRIFT_STD] = drift, np.sqrt(max(drifts - drift * drift, 0.0))
    now[VAR] = max(whole - (offset + creep) ** 2, 0.0)
    now[VAR] += now[MISFIT]


@ordered_kernel
def _gain_std(law: Law, s: FilterState) -> float:
    # A repeated motion repeats the error of the model, so time does not average out its slope.
    # Each of the two branches of a loop holds one independent error for two correlation lengths.
    if not _has_gain(law, s):
        return 0.0
    now, size = s.now, law.numbers[GAIN_SIZE]
    values = max(1.0, np.sqrt(12.0 * now[VAR_X]) / law.numbers[LENGTH])
    slope = now[SCALE] * law.numbers[ERROR] / (values * max(now[VAR_X], 1e-12))
    return float(np.sqrt(min(now[GAIN_VAR] + now[IDLE] + slope, size)))


@ordered_kernel
def _follow_drift(law: Law, s: FilterState) -> None:
    # slope of the gain over time by weighted least squares; a gain of which little is known counts
    # little.  Neighbouring gains err alike, so their number does not reduce the deviation.
    now, dt, keep = s.now, law.numbers[STEP], 1.0 - 1.0 / law.numbers[FADE]
    now[SUM_TT] += dt * (dt * now[SUM_W] - 2.0 * now[SUM_T])
    now[SUM_T] -= dt * now[SUM_W]
    now[SUM_TG] -= dt * now[SUM_G]
    now[GROUPS:DRIFT] *= keep
    w = 1.0 / max(_gain_std(law, s) ** 2, 1e-30)
    now[GROUPS] += 1.0
    now[SUM_W] += w
    now[SUM_G] += w * now[GAIN]
    spread = now[SUM_TT] - now[SUM_T] ** 2 / now[SUM_W]
    now[DRIFT], now[DRIFT_STD] = 0.0, np.sqrt(law.numbers[GAIN_SIZE])
    # over less than a second a drift is no more than its prior
    if spread > now[SUM_W] / 12.0:
        now[DRIFT] = (now[SUM_TG] - now[SUM_T] * now[SUM_G] / now[SUM_W]) / spread
        now[DRIFT_STD] = min(now[DRIFT_STD], np.sqrt(now[GROUPS] / spread))


@ordered_kernel
def _end_group(law: Law, s: FilterState) -> None:
    now = s.now
    own = now[MOVED] - now[SPREAD]
    _let_time_pass(law, s)
    mean, free, count = _typical(s.group, np.sqrt(law.numbers[NOISE]))
    if count > 0:
        now[FREE] = free
    if _has_gain(law, s):
        s.row[-2] = now[FREE]
    enough = 2 * count >= s.group.shape[1]
    if enough and _is_believed(law, s, mean, count):
        _measure(law, s, mean, count)
        now[MOVED] = now[SPREAD] = 0.0
        # the mean of a group may lie anywhere in the change of the offset within the group
        for b in range(s.weight.size):
            s.P[b, 0, 0] += own * own / 3.0
    tell(law, s)
    if _has_gain(law, s) and law.numbers[DRIFT_VAR] == 0.0:
        _follow_drift(law, s)


@ordered_kernel
def follow(y: Array, before: Array, free: Array, law: Law, s: FilterState, out: Array) -> None:
    """
    Take y with free run, path and band of a horizon before; write the corrections to `out`.

    The rows of `out`, shape (10, n), are the whole correction of the present free run, offset,
    creep, gain, and drift of the gain [1/s].  The standard deviation of each follows it.
    """
    now, size = s.now, s.group.shape[1]
    gain_std = _gain_std(law, s)
    for k in range(y.size):
        then, x = before[0, k], free[k]
        creep = 0.0
        if not np.isnan(then):  # NaN comes before the start
            if y[k] != now[READING] and np.isfinite(y[k]):
                now[READING], now[BEGAN], now[STUCK_NOW] = y[k], then, 0.0
            if np.isfinite(y[k]) and abs(then - now[BEGAN]) > STUCK:
                now[STUCK_NOW] = 1.0
            s.group[0, int(now[COUNT])] = np.nan if now[STUCK_NOW] else y[k] - then
            s.group[1, int(now[COUNT])] = then
            now[COUNT] += 1.0
            now[PATH] += before[1, k]
            now[MOVED] += abs(now[BAND] - before[2, k])
            now[BAND] = before[2, k]
            for i in range(law.left.size):
                s.coming[i] *= law.left[i]
            if now[COUNT] == size:
                _end_group(law, s)
                gain_std = _gain_std(law, s)
                now[COUNT] = 0.0
            for i in range(law.left.size):
                creep += s.coming[i]
        out[0, k] = now[OFFSET] + creep + now[GAIN] * x
        whole = now[VAR] + 2.0 * now[CROSS] * x + now[GAIN_VAR] * x * x
        out[1, k] = np.sqrt(max(whole, 0.0))
        out[2, k], out[3, k] = now[OFFSET], np.sqrt(now[OFFSET_VAR])
        out[4, k], out[5, k] = creep, np.sqrt(now[CREEP_VAR])
        out[6, k], out[7, k] = now[GAIN], gain_std
        out[8, k], out[9, k] = now[DRIFT], now[DRIFT_STD]

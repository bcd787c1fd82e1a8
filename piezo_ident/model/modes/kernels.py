# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Run modes with softening and plays inside their loop, and compute their sensitivities.

`piezo_ident.model.modes.shared_modes` has the equations.  The plays are those of Gu, Li, Zhu and
Su (2016), doi:10.1109/TMECH.2015.2465868.  The squared level of the softening is a running mean:

    l(k+1) = kappa l(k) + (1 - kappa) mean_j z_j(k)^2

Sensitivities are derivatives of the displacements with respect to parameters.  They run beside the
trajectory, in single precision.  A few parameters run together, so that they stay in the cache.

A play that moves with z has the derivative of z.  A play that stands keeps its derivative.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import alive, kernel, ordered_kernel

#: kinds of parameters, by number: two numbers a block of A, then entries of matrices
KINDS = ('poles', 'b', 'e', 'f', 'g', 'mu')
#: parameters that run through the loop together
CHUNK = 64


class Loop(NamedTuple):
    """Arrays and numbers of `SharedModes`; s stays in `low` .. `high`, creep moves by `share`."""

    blocks: Array
    b: Array
    c: Array
    d: Array
    e: Array
    h: Array
    f: Array
    g: Array
    mu: Array
    r: Array
    levels: int
    low: float
    high: float
    kappa: float
    creep: Array
    share: Array


class LoopState(NamedTuple):
    """State between two runs: x, outputs of the plays, squared level, shape (1,), and creep."""

    x: Array
    memory: Array
    level: Array
    creep: Array

    @classmethod
    def at_zero(cls, loop: Loop) -> LoopState:
        """Make the state of a stage that never moved, at the level of the fit."""
        creep = np.zeros(loop.creep.shape)
        return cls(np.zeros(len(loop.b)), np.zeros(loop.mu.shape), np.ones(1), creep)


class Passage(NamedTuple):
    """States, signals, pushes, plays, gates, squared level, outputs, and voltages with creep."""

    x: Array
    z: Array
    p: Array
    plays: Array
    gates: NDArray[np.uint8]
    level: Array
    y: Array
    u: Array


@ordered_kernel
def trajectory(v: Array, loop: Loop, state: LoopState, run: Passage) -> int:
    """
    Run creep and loop over v, move `state` on, and write the signals into `run`.

    The result is the number of samples that were run: fewer than v if the stage runs away.
    """
    blocks, b, c, d, e, h = loop.blocks, loop.b, loop.c, loop.d, loop.e, loop.h
    f, g, mu, r, levels, kappa = loop.f, loop.g, loop.mu, loop.r, loop.levels, loop.kappa
    xs, zs, ps, plays, gates, ls, ys, u = run
    samples, inputs = v.shape
    order, signals = e.shape
    thresholds = len(r)
    x, memory, level = state.x, state.memory, state.level[0]
    p = np.zeros(signals)
    new = np.zeros(order)
    for t in range(samples):
        for i in range(inputs):
            crept = 0.0
            for k in range(len(loop.share)):
                held = state.creep[i, k]
                # a difference, so that an element at its input rests exactly
                held = alive(held + loop.share[k] * (v[t, i] - held))
                state.creep[i, k] = held
                crept += loop.creep[i, k] * held
            u[t, i] = v[t, i] + crept
        ls[t] = level
        softening = min(max(np.sqrt(level), loop.low), loop.high) - 1.0
        squares = 0.0
        for i in range(order):
            xs[t, i] = x[i]
        for j in range(signals):
            z = 0.0
            for i in range(order):
                z += f[j, i] * x[i]
            for i in range(inputs):
                z += g[j, i] * u[t, i]
            zs[t, j] = z
            if j < levels:
                squares += z * z
                p[j] = z * softening
            else:
                total = 0.0
                for k in range(thresholds):
                    m = memory[j, k]
                    gates[t, j, k] = 0
                    if z - m > r[k]:
                        m = z - r[k]
                        gates[t, j, k] = 1
                    elif z - m < -r[k]:
                        m = z + r[k]
                        gates[t, j, k] = 1
                    memory[j, k] = m
                    plays[t, j, k] = m
                    total += mu[j, k] * m
                p[j] = total
            ps[t, j] = p[j]
        for o in range(len(c)):
            y = 0.0
            for i in range(order):
                y += c[o, i] * x[i]
            for i in range(inputs):
                y += d[o, i] * u[t, i]
            for j in range(signals):
                y += h[o, j] * p[j]
            ys[t, o] = y
        if levels > 0:
            level = alive(kappa * level + (1.0 - kappa) * squares / levels)
        for i in range(0, order, 2):
            block = i // 2
            new[i] = blocks[block, 0, 0] * x[i] + blocks[block, 0, 1] * x[i + 1]
            new[i + 1] = blocks[block, 1, 0] * x[i] + blocks[block, 1, 1] * x[i + 1]
        for i in range(order):
            value = new[i]
            for j in range(inputs):
                value += b[i, j] * u[t, j]
            for j in range(signals):
                value += e[i, j] * p[j]
            x[i] = alive(value)
            if not abs(value) < 1e12:
                return t
    state.level[0] = level
    return int(samples)


@kernel
def sensitivities(
    kinds: NDArray[np.intp],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    loop: Loop,
    run: Passage,
    skip: int,
    out: NDArray[np.float32],
) -> None:
    """
    Write dy/dtheta after `skip` samples into `out`, shape (samples, outputs, parameters).

    A parameter is `kinds`, a number of `KINDS`, at `rows` and `columns` of its array.
    """
    blocks, e, f, mu, c, h = loop.blocks, loop.e, loop.f, loop.mu, loop.c, loop.h
    levels, low, high, kappa = loop.levels, loop.low, loop.high, loop.kappa
    xs, zs, ps, plays, gates, ls, _, u = run
    single = np.float32
    samples = len(u)
    order, signals = e.shape
    thresholds = mu.shape[1]
    outputs = len(c)
    many = len(kinds)
    e4, f4, c4, h4 = e.astype(single), f.astype(single), c.astype(single), h.astype(single)
    blocks4, mu4 = blocks.astype(single), mu.astype(single)
    s = np.zeros((order, many), single)
    new = np.zeros((order, many), single)
    d_play = np.zeros((signals, thresholds, many), single)
    dz = np.zeros((signals, many), single)
    dp = np.zeros((signals, many), single)
    dl = np.zeros(many, single)
    dy = np.zeros(many, single)
    for t in range(samples):
        root = np.sqrt(ls[t])
        softening = single(min(max(root, low), high) - 1.0)
        slope = 0.5 / root if low < root < high else 0.0
        for j in range(signals):
            row = dz[j]
            row[:] = 0
            for i in range(order):
                weight, state = f4[j, i], s[i]
                for q in range(many):
                    row[q] += weight * state[q]
        for q in range(many):
            if kinds[q] == 3:
                dz[rows[q], q] += single(xs[t, columns[q]])
            elif kinds[q] == 4:
                dz[rows[q], q] += single(u[t, columns[q]])
        for j in range(signals):
            row, push = dz[j], dp[j]
            if j < levels:
                by_level = single(zs[t, j] * slope)
                for q in range(many):
                    push[q] = softening * row[q] + by_level * dl[q]
            else:
                push[:] = 0
                for k in range(thresholds):
                    moved, weight = d_play[j, k], mu4[j, k]
                    if gates[t, j, k]:
                        for q in range(many):
                            moved[q] = row[q]
                    for q in range(many):
                        push[q] += weight * moved[q]
        for q in range(many):
            if kinds[q] == 5:
                dp[rows[q], q] += single(plays[t, rows[q], columns[q]])
        if levels > 0:
            keep = single(kappa)
            for q in range(many):
                dl[q] *= keep
            for j in range(levels):
                weight, row = single((1.0 - kappa) * 2.0 * zs[t, j] / levels), dz[j]
                for q in range(many):
                    dl[q] += weight * row[q]
        if t >= skip:
            for o in range(outputs):
                dy[:] = 0
                for i in range(order):
                    weight, state = c4[o, i], s[i]
                    for q in range(many):
                        dy[q] += weight * state[q]
                for j in range(signals):
                    weight, push = h4[o, j], dp[j]
                    for q in range(many):
                        dy[q] += weight * push[q]
                out[t - skip, o, :] = dy
        for i in range(0, order, 2):
            block = i // 2
            a00, a01 = blocks4[block, 0, 0], blocks4[block, 0, 1]
            a10, a11 = blocks4[block, 1, 0], blocks4[block, 1, 1]
            s0, s1, n0, n1 = s[i], s[i + 1], new[i], new[i + 1]
            for q in range(many):
                n0[q] = a00 * s0[q] + a01 * s1[q]
                n1[q] = a10 * s0[q] + a11 * s1[q]
        for i in range(order):
            row = new[i]
            for j in range(signals):
                weight, push = e4[i, j], dp[j]
                for q in range(many):
                    row[q] += weight * push[q]
        for q in range(many):
            i, j = rows[q], columns[q]
            if kinds[q] == 0:
                if blocks[i, 0, 1] != 0.0:
                    if j == 0:
                        new[2 * i, q] += single(xs[t, 2 * i])
                        new[2 * i + 1, q] += single(xs[t, 2 * i + 1])
                    else:
                        new[2 * i, q] += single(xs[t, 2 * i + 1])
                        new[2 * i + 1, q] -= single(xs[t, 2 * i])
                else:
                    new[2 * i + j, q] += single(xs[t, 2 * i + j])
            elif kinds[q] == 1:
                new[i, q] += single(u[t, j])
            elif kinds[q] == 2:
                new[i, q] += single(ps[t, j])
        s, new = new, s

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Compute the outputs of single parts of H for one input.

A fit needs a column for each coefficient of a law of H.  Consecutive parts often hold the same
plays with other curves, or lags of the same rate.  Such parts run side by side, so that plays and
exponentials are computed once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
import itertools

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import kernel, ordered_kernel, part_of_kernels
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.kernels import held, lag_after, path_lines
from piezo_ident.operators.play import play_columns

#: number of parts that run side by side
SIDE_BY_SIDE = 4

#: part of H, and the outputs of its plays before the first sample, shape (m,)
Part = tuple[Hysteresis, Array]


def in_groups(parts: Iterable[Part]) -> Iterator[list[Part]]:
    """Group up to `SIDE_BY_SIDE` consecutive parts with the same plays, or lags of one rate."""
    for _, some in itertools.groupby(parts, _kind):
        group = list(some)
        for k in range(0, len(group), SIDE_BY_SIDE):
            yield group[k : k + SIDE_BY_SIDE]


def has_curves_alone(h: Hysteresis) -> bool:
    """Tell whether H consists of plays with curves only."""
    others = (h.p0, h.p1, h.p2) == (0.0, 0.0, 0.0) and h.bias is None and h.relaxations is None
    return others and h.curves is not None


def is_single_play(h: Hysteresis) -> bool:
    """Tell whether H consists of one play only."""
    return h.is_plain and h.thresholds.size == 1 and (h.p1, h.p2) == (0.0, 0.0)


def weights_of(group: list[Part]) -> tuple[Array, Array]:
    """
    Collect the weights, shape (`SIDE_BY_SIDE`, m), and curves of a group for `four_sums`.

    m includes idle plays; a missing part has zero weights.
    """
    r, *_, c = group[0][0].for_kernel
    q, curves = np.zeros((SIDE_BY_SIDE, r.size)), np.zeros((SIDE_BY_SIDE, *c.shape))
    for j, (h, _) in enumerate(group):
        q[j], curves[j] = h.for_kernel[1], h.for_kernel[-1]
    return q, curves


def columns_of_parts(
    v: Array, parts: Iterable[Part], rest: float | None = None
) -> Iterator[Array]:
    """
    Yield the output of each part of H for a normalised input; shapes (n,).

    Lags along the path begin as `Hysteresis.settled` at `rest`, by default at the first input.

    >>> parts = [(Hysteresis([0.5], [q], 0.0, 0.0), np.zeros(1)) for q in (1.0, 2.0)]
    >>> [column.tolist() for column in columns_of_parts(np.array([0.0, 1.0]), parts)]
    [[0.0, 0.5], [0.0, 1.0]]
    """
    x = np.ascontiguousarray(v)
    for group in in_groups(parts):
        h, memory = group[0]
        if has_curves_alone(h):
            r, _, *_, low, _ = h.for_kernel
            held_at = np.zeros(r.size)
            held_at[: memory.size] = memory
            out = np.empty((SIDE_BY_SIDE, x.size))
            _plays_apart(x, r, low, *weights_of(group), held_at, out)
            yield from out[: len(group)]
        elif is_single_play(h):
            # a single play runs faster by itself
            for one, before in group:
                yield one.weights[0] * play_columns(x, one.thresholds, before)[0]
        elif _is_lags_alone(h):
            rows = [row for one, _ in group for row in one.relaxations]  # type: ignore[union-attr]
            whole = replace(h, relaxations=np.array(rows))
            out = np.empty((len(rows), x.size))
            start = whole.settled(float(x[0]) if rest is None else rest)
            _lags_apart(x, np.array(whole.relaxations), start, out)
            yield from out
        else:
            yield from (one(x, before) for one, before in group)


def _kind(part: Part) -> tuple[object, ...]:
    h, memory = part
    rates = b'' if h.relaxations is None else h.relaxations[:, 0].tobytes()
    form = has_curves_alone(h), is_single_play(h), _is_lags_alone(h)
    return form, h.span, h.thresholds.tobytes(), rates, memory.tobytes()


def _is_lags_alone(h: Hysteresis) -> bool:
    alone = h.thresholds.size == 0 and (h.p0, h.p1, h.p2) == (0.0, 0.0, 0.0)
    return alone and h.relaxations is not None and len(h.relaxations) == 1


@part_of_kernels
def four_sums(low: float, q: Array, c: Array, memory: Array) -> tuple[float, float, float, float]:
    """
    Compute ``sum_i q_i f_i + psi_i(f_i)`` of four parts, whose plays are at f, shape (m,).

    psi is `piezo_ident.operators.kernels.curve`; q and c come from `weights_of`.  A kernel of
    another file takes over a change of this function only when its own file changes.
    """
    # the sums are written out, so that the loop over plays vectorises
    s_0, s_1, s_2, s_3 = 0.0, 0.0, 0.0, 0.0
    for i in range(memory.size):
        f = memory[i]
        t = held(f - low, 0.0, c[0, 4, i])
        u = t * t
        s_0 += q[0, i] * f + u * (c[0, 0, i] + t * (c[0, 1, i] + t * c[0, 2, i]))
        s_1 += q[1, i] * f + u * (c[1, 0, i] + t * (c[1, 1, i] + t * c[1, 2, i]))
        s_2 += q[2, i] * f + u * (c[2, 0, i] + t * (c[2, 1, i] + t * c[2, 2, i]))
        s_3 += q[3, i] * f + u * (c[3, 0, i] + t * (c[3, 1, i] + t * c[3, 2, i]))
    return s_0, s_1, s_2, s_3


@kernel
def _plays_apart(
    v: Array, r: Array, low: float, q: Array, c: Array, memory: Array, out: Array
) -> None:
    for k in range(v.size):
        x = v[k]
        for i in range(r.size):
            memory[i] = held(memory[i], x - r[i], x)
        out[0, k], out[1, k], out[2, k], out[3, k] = four_sums(low, q, c, memory)


@ordered_kernel
def _lags_apart(v: Array, x: Array, state: Array, out: Array) -> None:
    # as `piezo_ident.operators.kernels.relaxing`, for lags of one rate that are not added up
    n = x.shape[0]
    lines = path_lines(x)
    last = float(state[n])
    for k in range(v.size):
        u = float(v[k])
        length = abs(u - last)
        line = lines[1 if u > last else 0]
        left = np.exp(-x[0, 0] * length) if length > 0.0 else 1.0
        for j in range(n):
            d1, d2, d3 = x[j, 1], x[j, 2], x[j, 3]
            if length > 0.0:
                c0, c1, c2 = line[0, j], line[1, j], line[2, j]
                state[j] = lag_after(state[j], c0, c1, c2, d3, last, u, left)
            out[j, k] = state[j] - u * (d1 + u * (d2 + u * d3))
        last = u
    state[n] = last

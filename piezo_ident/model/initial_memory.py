# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The memory of the plays at the start of a record.

It is known where the record starts at the lowest voltage.  Elsewhere each play keeps its unknown
start F_r(0) as long as the voltage allows,

    max(v so far) - r   <=   F_r(0)   <=   min(v so far),

so the starts are a few bounded numbers, which least squares finds from the early part of the
record.  Once the voltage has swept the width of a play, the play depends on its start no more.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.dynamics import filter_arx
from piezo_ident.record.gaps import follows
from piezo_ident.record.record import Piece, Record
from scipy.optimize import lsq_linear

__all__ = [
    'connected_pieces',
    'fit_memory',
    'forgotten',
    'is_at_rest',
    'start_memory',
]

#: share of its range that the voltage must sweep until the start is forgotten
SHARE = 0.98
#: samples that are searched together
WINDOW = 1 << 18
#: weight of the memory of a stage that came down to zero, as a share of the weight of the data
PULL = 1e-4


def forgotten(u: NDArray[np.float64], share: float = SHARE) -> int:
    """
    Return the first sample at which the voltage has swept a share of its range.

    Plays that are not wider than that share then no longer depend on their start.

    Parameters
    ----------
    u : ndarray, shape (n,)
        Voltage in any unit.
    share : float, optional
        Of the range of `u`.
    """
    goal = share * float(np.ptp(u))
    low, high = np.inf, -np.inf
    for start in range(0, u.size, WINDOW):
        part = u[start : start + WINDOW]
        top = np.maximum(np.maximum.accumulate(part), high)
        bottom = np.minimum(np.minimum.accumulate(part), low)
        swept = top - bottom >= goal
        if swept.any():
            return start + int(np.argmax(swept))
        low, high = float(bottom[-1]), float(top[-1])
    return 0


def is_at_rest(model: StageModel, piece: Piece) -> bool:
    """Return whether a piece starts near the lowest voltage, where the memory is known."""
    return abs(float(model.scaling.u(piece.v[0]))) < 0.01


def connected_pieces(record: Record) -> list[list[Piece]]:
    """Return the pieces of a record in groups; within a group, gaps are short."""
    groups: list[list[Piece]] = []
    for piece in record:
        last = groups[-1][-1] if groups else None
        if (
            last is not None
            and follows(last, piece) is not None
            and set(last.channels) == set(piece.channels)
        ):
            groups[-1].append(piece)
        else:
            groups.append([piece])
    return groups


def start_memory(model: StageModel, piece: Piece) -> NDArray[np.float64] | None:
    """Return the estimated memory at the start of a piece; None where it is known."""
    return None if is_at_rest(model, piece) else fit_memory(model, piece)


def fit_memory(model: StageModel, piece: Piece, stop: int | None = None) -> NDArray[np.float64]:
    """
    Estimate the play outputs before the first sample of a piece.

    Parameters
    ----------
    model : StageModel
    piece : Piece
    stop : int, optional
        Number of samples to use; those before the start is forgotten when absent.

    Returns
    -------
    ndarray, shape (m,)
        `start` of `StageModel.simulate`.
    """
    h = model.hysteresis
    end = max(forgotten(piece.v), 10) if stop is None else stop
    end = min(end, piece.n)
    part = piece.cut(0, end)
    # the plays follow the voltage behind the effects of the input slot
    u = model.hysteresis_input(part)
    x = model.scaling.x(part.y)
    memory = h.initial_memory(float(u[0]))
    low, high = float(u[0]) - h.thresholds, np.full(h.thresholds.size, float(u[0]))
    if not (h.weights.any() or h.rise(high).any()):
        return memory
    top, bottom = np.maximum.accumulate(u), np.minimum.accumulate(u)
    # rows are thinned: a few numbers do not need a hundred thousand samples
    keep = slice(None, None, max(1, end // 5000))
    for _ in range(8):
        e = (x - model.scaling.x(model.predict_piece(part, memory)))[keep]
        columns = []
        rise = h.rise(memory, float(u[0]))
        for r, q, m in zip(h.thresholds, rise, memory, strict=True):
            # the play follows its start only while neither bound has caught it
            moved = np.clip(m, np.minimum(top - r, bottom), bottom)
            free = ((np.abs(moved - m) < 1e-12) & (top - r < bottom)).astype(np.float64)
            filtered = filter_arx(
                model.dynamics.a, model.dynamics.b, model.total_delay.apply(free)
            )
            columns.append(q * filtered[keep])
        J = np.array(columns).T
        pull = np.sqrt(PULL * e.size) * np.maximum(rise, 1e-3)
        A = np.vstack([J, np.diag(pull)])
        target = np.concatenate([e, pull * (h.initial_memory(float(u[0])) - memory)])
        width = np.maximum(high - low, 1e-9)
        step = lsq_linear(A, target, (low - memory - 1e-9 * width, high - memory + 1e-9 * width)).x
        memory = np.clip(memory + step, low, high)
        if np.abs(step).max() < 1e-6:
            break
    return memory

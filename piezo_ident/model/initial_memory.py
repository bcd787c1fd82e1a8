# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The memory of a stage at the start of a record: unknown, unless it begins from a known rest.

Before the voltage has swept as far as its threshold, a play is its unknown start, held between

    max(v so far) - r   <=   F_r   <=   min(v so far),

and after that it has forgotten it.  So the start is a handful of bounded numbers, found by least
squares on the early part of a record.
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
    'SHARE',
    'Sweep',
    'connected_pieces',
    'fit_memory',
    'forgotten',
    'is_at_rest',
    'start_memory',
]

#: share of its range that a run must sweep to forget its start
SHARE = 0.98
#: samples that are looked at together for where the start is forgotten
WINDOW = 1 << 18
#: pull towards the memory of a stage that came down to zero, as a share of the data's weight
PULL = 1e-4


class Sweep:
    """
    How far a run has swept the range after which its start is forgotten.

    Parameters
    ----------
    goal : float
        What has to be swept, in the unit of the voltage.
    """

    def __init__(self, goal: float) -> None:
        self._goal = goal
        self._low, self._high = np.inf, -np.inf
        self.is_done = False

    def before(self, u: NDArray[np.float64]) -> int:
        """Return how many of the next samples come before the start is forgotten."""
        if self.is_done:
            return 0
        for start in range(0, u.size, WINDOW):
            part = u[start : start + WINDOW]
            top = np.maximum(np.maximum.accumulate(part), self._high)
            bottom = np.minimum(np.minimum.accumulate(part), self._low)
            swept = top - bottom >= self._goal
            if swept.any():
                self.is_done = True
                return start + int(np.argmax(swept))
            self._low, self._high = float(bottom[-1]), float(top[-1])
        return int(u.size)


def forgotten(u: NDArray[np.float64], share: float = SHARE, span: float | None = None) -> int:
    """
    Return the sample from which the start is forgotten.

    Parameters
    ----------
    u : ndarray, shape (n,)
        Voltage in any unit.
    share : float, optional
        Share of the record's range that must have been swept.
    span : float, optional
        That range, where `u` is the beginning of the record alone.
    """
    sweep = Sweep(share * (float(np.ptp(u)) if span is None else span))
    start = sweep.before(u)
    return start if sweep.is_done else 0


def is_at_rest(model: StageModel, piece: Piece) -> bool:
    """Return whether a piece starts near the lowest voltage, where the memory is known."""
    return abs(float(model.scaling.u(piece.v[0]))) < 0.01


def connected_pieces(record: Record) -> list[list[Piece]]:
    """Return the pieces of a record, those together that follow each other over short gaps."""
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
        Samples to use; up to where the start is forgotten when absent.

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
    if not h.weights.any():
        return memory
    top, bottom = np.maximum.accumulate(u), np.minimum.accumulate(u)
    # rows are thinned: a few numbers do not need a hundred thousand samples
    keep = slice(None, None, max(1, end // 5000))
    for _ in range(8):
        e = (x - model.scaling.x(model.predict_piece(part, memory)))[keep]
        columns = []
        for r, q, m in zip(h.thresholds, h.weights, memory, strict=True):
            # the play follows its start only while neither bound has caught it
            moved = np.clip(m, np.minimum(top - r, bottom), bottom)
            free = ((np.abs(moved - m) < 1e-12) & (top - r < bottom)).astype(np.float64)
            filtered = filter_arx(
                model.dynamics.a, model.dynamics.b, model.total_delay.apply(free)
            )
            columns.append(q * filtered[keep])
        J = np.array(columns).T
        pull = np.sqrt(PULL * e.size) * np.maximum(h.weights, 1e-3)
        A = np.vstack([J, np.diag(pull)])
        target = np.concatenate([e, pull * (h.initial_memory(float(u[0])) - memory)])
        width = np.maximum(high - low, 1e-9)
        step = lsq_linear(A, target, (low - memory - 1e-9 * width, high - memory + 1e-9 * width)).x
        memory = np.clip(memory + step, low, high)
        if np.abs(step).max() < 1e-6:
            break
    return memory

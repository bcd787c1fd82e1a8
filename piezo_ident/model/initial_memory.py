# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
The memory of the plays at the start of a record.

It is known where the record starts at the lowest voltage.  Elsewhere each play keeps its unknown
start F_r(0) as long as the voltage allows,

    max(v so far) - r   <=   F_r(0)   <=   min(v so far),

so the starts are a few bounded numbers, which least squares finds from the early part of the
record.  Once the voltage has swept the width of a play, the play depends on its start no more.

Lags along the path start anywhere between the least and the largest value that they follow.  What
they add by it decays along the path, ``exp(-a_j s)``: they are more numbers of the same problem.
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
    'forgetting',
    'forgotten',
    'is_at_rest',
    'start_memory',
]

#: share of its range that the voltage must sweep until the start is forgotten
SHARE = 0.98
#: share of a lag's start that may be left where it is forgotten
LEFT = 0.05
#: samples that are searched together
WINDOW = 1 << 18
#: linear steps towards the memory, at most
TRIALS = 20
#: weight of the memory of a stage that came down to zero, as a share of the weight of the data
PULL = 1e-4
#: the same of lags along the path: of several, together, far smaller sums are seen
LAG_PULL = 1e-6


def forgotten(u: NDArray[np.float64], share: float = SHARE, way: float = 0.0) -> int:
    """
    Return the first sample at which the voltage has swept a share of its range.

    Plays that are not wider than that share then no longer depend on their start.  Lags need a
    long path, too.

    Parameters
    ----------
    u : ndarray, shape (n,)
        Voltage in any unit.
    share : float, optional
        Of the range of `u`.
    way : float, optional
        Path that the voltage must travel, too, in its unit; `forgetting` of a model.

    Returns
    -------
    int
        The number of samples where the path is shorter.
    """
    goal = share * float(np.ptp(u))
    low, high, gone = np.inf, -np.inf, 0.0
    for start in range(0, u.size, WINDOW):
        part = u[start : start + WINDOW]
        top = np.maximum(np.maximum.accumulate(part), high)
        bottom = np.minimum(np.minimum.accumulate(part), low)
        path = gone + np.cumsum(np.abs(np.diff(part, prepend=u[max(start - 1, 0)])))
        swept = (top - bottom >= goal) & (path >= way)
        if swept.any():
            return start + int(np.argmax(swept))
        low, high, gone = float(bottom[-1]), float(top[-1]), float(path[-1])
    return u.size


def forgetting(model: StageModel) -> float:
    """Return the path over which the lags of a model forget their start [V]; 0 without lags."""
    x = model.hysteresis.relaxations
    if x is None or not x.size:
        return 0.0
    return float(-np.log(LEFT) / x[:, 0].min() * model.scaling.V)


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


def fit_memory(model: StageModel, piece: Piece) -> NDArray[np.float64]:
    """
    Estimate the play outputs, and the lags along the path, before the first sample of a piece.

    Parameters
    ----------
    model : StageModel
    piece : Piece

    Returns
    -------
    ndarray, shape (m + k,)
        `start` of `StageModel.simulate`.
    """
    h = model.hysteresis
    # by then what was before the start is forgotten
    end = min(max(forgotten(piece.v, way=forgetting(model)), 10), piece.n)
    part = piece.cut(0, end)
    # the plays follow the voltage behind the effects of the input slot
    u = model.hysteresis_input(part)
    x = model.scaling.x(part.y)
    u0, m = float(u[0]), h.thresholds.size
    rest = np.concatenate([h.initial_memory(u0), h.settled(u0)[:-1]])
    if not (h.weights.any() or h.rise(np.full(m, u0)).any() or h.lag_range.any()):
        return rest
    top, bottom = np.maximum.accumulate(u), np.minimum.accumulate(u)
    # rows are thinned: a few numbers do not need a hundred thousand samples
    keep = slice(None, None, max(1, end // 5000))

    def passed(signal: NDArray[np.float64]) -> NDArray[np.float64]:
        delayed = model.total_delay.apply(signal)
        return filter_arx(model.dynamics.a, model.dynamics.b, delayed)[keep]

    def error(memory: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((x - model.scaling.x(model.predict_piece(part, memory)))[keep])

    path = np.cumsum(np.abs(np.diff(u, prepend=u0)))
    rates = np.empty(0) if h.relaxations is None else h.relaxations[:, 0]
    lags = [passed(np.exp(-a * path)) for a in rates]
    # from one threshold to the next a play output falls by a share of the difference
    falls = np.diff(h.thresholds, prepend=0.0)
    whole = np.eye(rest.size)
    whole[:m, :m] = -np.tril(np.ones((m, m))) * falls
    low = np.concatenate([np.zeros(m), np.minimum(h.lag_range[0], rest[m:])])
    high = np.concatenate([np.ones(m), np.maximum(h.lag_range[1], rest[m:])])
    margin = 1e-9 * np.maximum(high - low, 1.0)
    origin = np.append(np.full(m, u0), np.zeros(rates.size))
    found: list[tuple[float, NDArray[np.float64]]] = []
    # a play that was caught at once tells nothing of where else it may have stood: both of its
    # ends are tried, those of a voltage that came up and of one that came down
    down = np.minimum(u0, max(u0, h.span[1]) - h.thresholds)
    for plays in (rest[:m], down):
        falls_of = np.diff(-plays, prepend=-u0) / falls
        number = np.clip(np.concatenate([falls_of, rest[m:]]), low, high)
        memory = origin + whole @ number
        e = error(memory)
        for _ in range(TRIALS):
            columns = []
            rise = h.rise(memory[:m], u0)
            for r, q, f in zip(h.thresholds, rise, memory[:m], strict=True):
                # the play follows its start only while neither bound has caught it
                moved = np.clip(f, np.minimum(top - r, bottom), bottom)
                free = ((np.abs(moved - f) < 1e-12) & (top - r < bottom)).astype(np.float64)
                columns.append(q * passed(free))
            pull = np.sqrt(PULL) * np.maximum(rise, 1e-3)
            pull = np.sqrt(e.size) * np.append(pull, np.full(rates.size, np.sqrt(LAG_PULL)))
            A = np.vstack([np.array([*columns, *lags]).T, np.diag(pull)]) @ whole
            target = np.concatenate([e, pull * (rest - memory)])
            step = lsq_linear(A, target, (low - number - margin, high - number + margin)).x
            # a play may be caught sooner or later than before: then the full step goes too far
            for share in (1.0, 0.5, 0.25, 0.125):
                trial = np.clip(number + share * step, low, high)
                new = error(origin + whole @ trial)
                if new @ new <= e @ e:
                    break
            else:
                break
            moved_by = np.abs(trial - number).max()
            number, e, memory = trial, new, origin + whole @ trial
            if moved_by < 1e-6:
                break
        found.append((float(e @ e), memory))
    return min(found, key=lambda one: one[0])[1]

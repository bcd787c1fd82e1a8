# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Estimate the state of a stage at the start of a record: the memory of its plays, and its creep.

The memory is known if the record starts at the lowest voltage and comes back to its displacement
there.  Otherwise each play keeps its unknown start F_r(0) as long as the voltage allows,

    max(v so far) - r   <=   F_r(0)   <=   min(v so far).

The starts are thus a few bounded numbers, which least squares fit to the early part of the record.
A play no longer depends on its start once the voltage has swept the width of the play.

Lags along the path start between the smallest and the largest value that they follow.  Their
contribution decays along the path as ``exp(-a_j s)``, so their starts are further numbers of the
same problem.  A model with creep adds the remaining creep of each element,
``c_i d_i exp(-t / tau_i)``.  A shifted zero of the sensor looks like slow creep.  The zero is
therefore fitted, too, unless creep within the range explains the record as well without it.

`piezo_ident.model.observer` follows the same state of a running stage, but it sees no later sample
and lumps unknown plays into an offset.  A smoother of its states (Rauch, Tung and Striebel) sees
the later samples, too.  Their errors over the error of this fit:

| estimate | samples | memory known | memory unknown |
|---|---|---|---|
| observer | behind the early part | 1 | 2 to 6 |
| observer | within the early part | 2 to 100 | 2 to 100 |
| smoother | within the early part | 0.6 to 1.3 | 1 to 5 |

An offset moves the whole early part, but a play moves it only until the voltage catches the play.
The priors of this fit are weak.  With the sizes, zeros and correlated error of the observer as
priors, and with a misfit of H that the motion repeats, creep errs 0.9 times as much if the memory
is known, and 1.0 times if it is not (0.4 to 1.4 and 0.4 to 2.2, 10th and 90th percentile, behind
the early part of 60 records of four stages of other laws).  That is no better, and three of twelve
shifted zeros of a stage at rest then count as creep.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.effects.creep import Creep
from piezo_ident.model.scaling import REST
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import Start
from piezo_ident.operators.dynamics import filter_arx
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.readings.gaps import connected_pieces
from piezo_ident.record.readings.suspicions import rises_first
from piezo_ident.record.record import Piece, Record
from scipy.optimize import lsq_linear

#: share of its range that the voltage sweeps until the start counts as forgotten
SHARE = 0.98
#: share of the range of a model that is enough for this: the few wider plays keep the start that
#: the early part gave
SWEPT = 0.8
#: share of the start of a lag that remains when it counts as forgotten
LEFT = 0.05
#: number of samples that are searched at once
WINDOW = 1 << 18
#: most linear steps towards the memory
TRIALS = 20
#: weight of the prior, the memory of a stage that came down to zero, as a share of the data's
#: weight
PULL = 1e-4
#: the same for lags along the path: the data show much smaller sums of several lags
LAG_PULL = 1e-6
#: the same for creep, for a start that is off by the range of H: the data hardly show some
#: elements
CREEP_PULL = 1e-8
#: largest shift of the zero of a sensor, in spans
FAR = 1e3
#: smallest share of a record from which creep of earlier motion is estimated
EARLY = 0.2
#: a start at rest is rejected if three conditions hold.  Its error on the early part is ERRS times
#: the error after it, and SEEN spans.  Another start reduces the error to LEAVES of it (taste:
#: creep that a model lacks also shows early, but less)
ERRS, SEEN, LEAVES = 5.0, 1e-3, 0.2
#: largest rms error with creep of earlier motion and a free zero, over the rms error without both
CREEP_LEAVES = 0.9
#: reduction of the rms error that creep must bring beyond this, in spans
FAINT = 1e-5
#: largest rms error with creep and the zero of the model, over the rms error with a free zero
SURE = 1.1
#: largest rms error with creep and a shifted zero, over the rms error without both
APART = 0.3


def forgotten(u: Array, share: float = SHARE, way: float = 0.0, enough: float = np.inf) -> int:
    """
    Find the first sample at which the voltage has swept a share of its range, or enough.

    Plays up to this width then no longer depend on their start.  Lags need a long path, too.

    Parameters
    ----------
    u : ndarray, shape (n,)
        Voltage in any unit.
    share : float, optional
        Share of the range of `u` to sweep.
    way : float, optional
        Path that the voltage must travel as well, in the unit of `u`; see `forgetting`.
    enough : float, optional
        Sweep that is enough in any case, in the unit of `u`.

    Returns
    -------
    int
        Index of the sample; the number of samples if the voltage never gets there.
    """
    goal = min(share * float(np.ptp(u)), enough)
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
    """Compute the path over which the lags of a model forget their start [V]; 0 without lags."""
    x = model.hysteresis.relaxations
    if x is None or not x.size:
        return 0.0
    return float(-np.log(LEFT) / x[:, 0].min() * model.scaling.V)


def is_at_rest(model: StageModel, piece: Piece) -> bool:
    """Tell whether a piece starts near the lowest voltage, having come down to it."""
    return abs(float(model.scaling.u(piece.v[0]))) < REST and not rises_first(piece)


def unknown_starts(model: StageModel, record: Record) -> tuple[str, ...]:
    """Warn if the voltage alone does not determine the memory at the start."""
    v = [pieces[0].v[0] for pieces in connected_pieces(record) if not is_at_rest(model, pieces[0])]
    if not v:
        return ()
    branches = [_branches(model.hysteresis, float(u)) for u in model.scaling.u(v)]
    widths = [abs(float(model.dynamics.gain * np.diff(both)[0])) for both in branches]
    return (
        f'{record.name}: starts at {v[int(np.argmax(widths))]:g} V; coming from below and from '
        f'above the stage stands {100.0 * max(widths):.2g} % of its span apart there, and without '
        'displacement nothing tells which. Start the record at '
        f'{model.scaling.range[0]:g} V, or measure the displacement, too',
    )


def begins_at_rest(model: StageModel, piece: Piece, sound: Mask | None = None) -> bool:
    """
    Tell whether a piece starts near the lowest voltage, and fits a start at rest there.

    A stage whose plays had not come down errs at first, until the start is forgotten.
    """
    if not is_at_rest(model, piece):
        return False
    end = early_part(model, piece, memory=True)
    part = piece.cut(0, min(2 * end, piece.n))
    use = part.mask if sound is None else sound[: part.n]
    early, late = (np.flatnonzero(use[a:b]) + a for a, b in ((0, end), (end, part.n)))
    if min(early.size, late.size) < 10 or not model.hysteresis.thresholds.size:
        return True
    e = model.scaling.x(part.y) - model.scaling.x(model.predict_piece(part))
    at_rest = float(np.sqrt(np.mean((e[early] - e[late].mean()) ** 2)))
    if at_rest < max(ERRS * float(np.std(e[late])), SEEN):
        return True
    left = _fit(model, piece, sound, memory=True)[1]
    return float(np.sqrt(np.mean(left**2))) > LEAVES * at_rest


def early_part(model: StageModel, piece: Piece, *, memory: bool) -> int:
    """Count the samples that serve to estimate the creep, or the `memory`."""
    creeps, end = _creeps(model), 10
    if memory:
        # later samples no longer depend on the start; with creep, sweep for wide plays, too, which
        # look like creep
        enough = np.inf if creeps else SWEPT * float(np.ptp(model.scaling.range))
        end = max(forgotten(piece.v, way=forgetting(model), enough=enough), end)
    if creeps:
        end = max(end, int(np.ceil(EARLY * piece.n)))
    return min(end, piece.n)


def fit_start(model: StageModel, piece: Piece, sound: Mask | None = None) -> Start | None:
    """
    Estimate the state of a stage at the start of a piece.

    Parameters
    ----------
    model : StageModel
    piece : Piece
        Piece with short gaps bridged by `piezo_ident.record.readings.gaps.bridged`.
    sound : ndarray of bool, shape (n,), optional
        Samples that were measured; all when absent.

    Returns
    -------
    Start or None
        None if the data agree with rest at the lowest voltage.
    """
    known = begins_at_rest(model, piece, sound)
    creeps = _creeps(model)
    if known and not creeps:
        return None
    still, e = _fit(model, piece, sound, memory=not known)
    if not creeps:
        return still
    free, left = _fit(model, piece, sound, memory=not known, creep=True, zero=True)
    if np.std(left) > CREEP_LEAVES * np.std(e) - FAINT:
        return None if known else still
    held, e_held = _fit(model, piece, sound, memory=not known, creep=True)
    if np.sqrt(np.mean(e_held**2)) <= SURE * np.std(left):
        return held
    # Zero and slow creep compensate each other, and an error of the model looks like their sum.
    # Only a sum that explains most of the error is therefore accepted.
    if np.std(left) <= APART * np.std(e):
        return free
    return None if known else still


def crept(model: StageModel, start: Start) -> float:
    """Compute the displacement by creep of earlier motion at a start [m]."""
    if not start.creep.size:
        return 0.0
    return float(model.scaling.Y * model.dynamics.gain * (creep_elements(model)[0] @ start.creep))


def creep_elements(model: StageModel) -> Array:
    """List gains and time constants [s] of the creep of a model, shape (2, c)."""
    creep = [e.parameters for e in model.effects if e.name == Creep.name]
    return np.array([creep[0]['gain'], creep[0]['time_constant']]) if creep else np.empty((2, 0))


def _creeps(model: StageModel) -> bool:
    return bool(creep_elements(model)[0].any())


def _branches(h: Hysteresis, u: float) -> Array:
    """Compute H at u after a rise from the lowest voltage, and after a fall from the highest."""
    low, high = h.span
    return np.array([h(np.array([*way, u]))[-1] for way in ([low], [low, high])])


class _EarlyPart:
    """
    Early part of a piece as a problem of least squares.

    A state holds m play outputs, k lags along the path, c distances of creep from its rest, and z
    zeros of the sensor (0 or 1).
    """

    def __init__(
        self, model: StageModel, piece: Piece, used: Mask | None, memory: bool, creep: bool, z: int
    ) -> None:
        h = model.hysteresis
        self.model, self.memory, self.z = model, memory, z
        self.part = piece.cut(0, early_part(model, piece, memory=memory))
        n = self.part.n
        # the plays follow the voltage behind the effects of the input slot
        self.u = model.hysteresis_input(self.part)
        u0 = self.u0 = float(self.u[0])
        # rows are thinned: a few numbers do not need a hundred thousand samples
        keep = np.arange(n) if used is None else np.flatnonzero(used[:n])
        keep = keep if keep.size else np.arange(n)
        self.keep = keep[:: max(1, keep.size // 5000)]
        self.x = model.scaling.x(self.part.y)[self.keep]
        m, k = (h.thresholds.size, h.lag_range.shape[1]) if memory else (0, 0)
        self.gains, self.times = creep_elements(model) if creep else np.empty((2, 0))
        self.m, self.k, self.c = m, k, self.gains.size
        rest = h.initial_memory(u0)[:m], h.settled(u0)[:k], np.zeros(self.c + z)
        self.rest, self.falls = np.concatenate(rest), np.diff(h.thresholds, prepend=0.0)[:m]

    def start(self, state: Array) -> Start:
        """Make the start of a run from a state."""
        both = self.m + self.k
        return Start(state[:both] if self.memory else None, state[both : both + self.c])

    def error(self, state: Array) -> Array:
        """Compute measured minus predicted displacement from a state, normalised."""
        y_hat = self.model.scaling.x(self.model.predict_piece(self.part, self.start(state)))
        return np.asarray(self.x - y_hat[self.keep] - (state[-1] if self.z else 0.0))

    def _passed(self, signal: Array) -> Array:
        g, delayed = self.model.dynamics, self.model.total_delay.apply(signal)
        return filter_arx(g.a, g.b, delayed)[self.keep]

    @cached_property
    def columns(self) -> list[Array]:
        """Derivatives by lags, creep and zero, which are the same at every state."""
        h, gain = self.model.hysteresis, self.model.dynamics.gain
        path = np.cumsum(np.abs(np.diff(self.u, prepend=self.u0)))
        rates = h.relaxations[:, 0] if self.k and h.relaxations is not None else np.empty(0)
        age = np.arange(self.part.n)[self.keep] / self.part.sample_rate
        by_lags = [self._passed(np.exp(-a * path)) for a in rates]
        # creep changes slowly, so it passes G with the static gain
        pairs = zip(self.gains, self.times, strict=True)
        by_creep = [gain * share * np.exp(-age / tau) for share, tau in pairs]
        return [*by_lags, *by_creep, *[np.ones(age.size)] * self.z]

    def play_columns(self, state: Array, rise: Array) -> list[Array]:
        """Compute the derivatives by the plays at a state; `rise` is the slope of H by each."""
        top, bottom = np.maximum.accumulate(self.u), np.minimum.accumulate(self.u)
        columns, thresholds = [], self.model.hysteresis.thresholds[: self.m]
        for r, q, f in zip(thresholds, rise, state[: self.m], strict=True):
            # the play follows its start only while neither bound has caught it
            moved = np.clip(f, np.minimum(top - r, bottom), bottom)
            free = ((np.abs(moved - f) < 1e-12) & (top - r < bottom)).astype(np.float64)
            columns.append(q * self._passed(free))
        return columns

    @cached_property
    def numbers(self) -> tuple[Array, Array, Array]:
        """
        Factors from the fitted numbers to a state, and lower and upper bounds of the numbers.

        The output of a play falls, from one threshold to the next, by a share of their difference.
        The numbers are these shares, and the other entries of the state.
        """
        h, m = self.model.hysteresis, self.m
        whole = np.eye(self.rest.size)
        whole[:m, :m] = -np.tril(np.ones((m, m))) * self.falls
        # creep has followed voltages of the range; H stands between its two branches
        reach = h(np.linspace(*h.span, 65))[:, None] - _branches(h, self.u0)
        far = np.repeat([[reach.min(), -FAR], [reach.max(), FAR]], [self.c, self.z], axis=1)
        lags = h.lag_range[:, : self.k]
        low = np.concatenate([np.zeros(m), np.minimum([*lags[0], *far[0]], self.rest[m:])])
        high = np.concatenate([np.ones(m), np.maximum([*lags[1], *far[1]], self.rest[m:])])
        return whole, low, high


def _fit(
    model: StageModel,
    piece: Piece,
    sound: Mask | None = None,
    *,
    memory: bool,
    creep: bool = False,
    zero: bool = False,
) -> tuple[Start, Array]:
    """Fit a start to the early part by least squares; return it with the error of some samples."""
    early = _EarlyPart(model, piece, sound, memory, creep, int(zero))
    h, m, u0, rest = model.hysteresis, early.m, early.u0, early.rest
    forgets = h.weights.any() or h.rise(np.full(h.thresholds.size, u0)).any() or h.lag_range.any()
    if not ((memory and forgets) or creep):
        return early.start(rest), early.error(rest)
    # A play that moves at once gives no derivative by its start.  The search therefore begins
    # twice: with plays after a rise of the voltage, and with plays after a fall.
    down = np.minimum(u0, max(u0, h.span[1]) - h.thresholds)
    fits = []
    for plays in (rest[:m], down) if m else (rest[:m],):
        shares = np.diff(-plays, prepend=-u0) / early.falls
        fits.append(_searched(early, np.concatenate([shares, rest[m:]])))
    _, state, e = min(fits, key=lambda one: one[0])
    return early.start(state), e


def _searched(early: _EarlyPart, number: Array) -> tuple[float, Array, Array]:
    """Improve the fitted numbers by linear steps; return the squared error, state and error."""
    (whole, low, high), m, rest = early.numbers, early.m, early.rest
    margin = 1e-9 * np.maximum(high - low, 1.0)
    weak = np.repeat(np.sqrt([LAG_PULL, CREEP_PULL, 0.0]), [early.k, early.c, early.z])
    origin = np.append(np.full(m, early.u0), np.zeros(rest.size - m))
    number = np.clip(number, low, high)
    state = origin + whole @ number
    e = early.error(state)
    for _ in range(TRIALS):
        rise = early.model.hysteresis.rise(state[:m], early.u0) if m else np.empty(0)
        columns = [*early.play_columns(state, rise), *early.columns]
        pull = np.sqrt(PULL) * np.maximum(rise, 1e-3)
        pull = np.sqrt(e.size) * np.append(pull, weak)
        A = np.vstack([np.array(columns).T, np.diag(pull)]) @ whole
        target = np.concatenate([e, pull * (rest - state)])
        # the triangular factor holds the same problem in a few rows
        R = np.asarray(np.linalg.qr(np.column_stack([A, target]), mode='r'))
        bounds = low - number - margin, high - number + margin
        step = lsq_linear(R[:, :-1], R[:, -1], bounds).x
        # a play may begin to move sooner or later than before; the full step then goes too far
        for share in (1.0, 0.5, 0.25, 0.125):
            trial = np.clip(number + share * step, low, high)
            new = early.error(origin + whole @ trial)
            if new @ new <= e @ e:
                break
        else:
            break
        moved_by = np.abs(trial - number).max()
        number, e, state = trial, new, origin + whole @ trial
        if moved_by < 1e-6:
            break
    return float(e @ e), state, e

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
What a stage keeps of its motion before a record: the memory of the plays, and creep.

The memory is known where the record starts at the lowest voltage, and comes back to its
displacement there.  Elsewhere each play keeps its unknown start F_r(0) as long as the voltage
allows,

    max(v so far) - r   <=   F_r(0)   <=   min(v so far),

so the starts are a few bounded numbers, which least squares finds from the early part of the
record.  Once the voltage has swept the width of a play, the play depends on its start no more.

Lags along the path start anywhere between the least and the largest value that they follow.  What
they add by it decays along the path, ``exp(-a_j s)``: they are more numbers of the same problem.

So is what each element of creep still has to go, ``c_i d_i exp(-t / tau_i)``, of a model that has
creep.  A sensor that was set to zero elsewhere looks like slow creep.  The zero is therefore free
first; it is held where creep within the range explains the record as well without it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from piezo_ident.effects.creep import Creep
from piezo_ident.model.stage_model import StageModel
from piezo_ident.model.stream import Start
from piezo_ident.operators.dynamics import filter_arx
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.record.readings.gaps import connected_pieces
from piezo_ident.record.readings.suspicions import rises_first
from piezo_ident.record.record import Piece, Record
from scipy.optimize import lsq_linear

#: share of its range that the voltage must sweep until the start is forgotten
SHARE = 0.98
#: and of the range of a model that is enough: wider plays are few, and stand where the early part
#: says
SWEPT = 0.8
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
#: the same of creep, for a start that is off by the range of H: some elements are hardly seen
CREEP_PULL = 1e-8
#: farthest that a sensor's zero may have moved, in spans
FAR = 1e3
#: share of a record from which creep of earlier motion is estimated, at least
EARLY = 0.2
#: a stage had not come down to the lowest voltage where a start at rest errs by so many times as
#: much on the early part as behind it, and by this share of the span, and another start leaves
#: this share of it (taste: creep that a model lacks shows early, too, but not as much)
ERRS, SEEN, LEAVES = 5.0, 1e-3, 0.2
#: rms that creep of earlier motion must leave there, over that without it, the zero free
WORTH = 0.9
#: and what it must gain, in spans
FAINT = 1e-5
#: rms that it may leave with the zero of the model, over that with a free zero
SURE = 1.1
#: rms that creep must leave there beside a zero that moved, over that without creep
APART = 0.3


def forgotten(
    u: NDArray[np.float64], share: float = SHARE, way: float = 0.0, enough: float = np.inf
) -> int:
    """
    Return the first sample at which the voltage has swept a share of its range, or enough.

    Plays that are not wider than that then no longer depend on their start.  Lags need a long
    path, too.

    Parameters
    ----------
    u : ndarray, shape (n,)
        Voltage in any unit.
    share : float, optional
        Of the range of `u`.
    way : float, optional
        Path that the voltage must travel, too, in its unit; `forgetting` of a model.
    enough : float, optional
        What it is enough to sweep, in its unit.

    Returns
    -------
    int
        The number of samples where the path is shorter.
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
    """Return the path over which the lags of a model forget their start [V]; 0 without lags."""
    x = model.hysteresis.relaxations
    if x is None or not x.size:
        return 0.0
    return float(-np.log(LEFT) / x[:, 0].min() * model.scaling.V)


def is_at_rest(model: StageModel, piece: Piece) -> bool:
    """Return whether a piece starts near the lowest voltage, having come down to it."""
    return abs(float(model.scaling.u(piece.v[0]))) < 0.01 and not rises_first(piece)


def unknown_starts(model: StageModel, record: Record) -> tuple[str, ...]:
    """Return a warning where the voltage alone does not tell the memory at the start."""
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


def begins_at_rest(
    model: StageModel, piece: Piece, sound: NDArray[np.bool_] | None = None
) -> bool:
    """
    Return whether a piece starts near the lowest voltage, and goes on as if it had come down.

    A stage that rises for the first time errs there, and no more once the start is forgotten.
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
    """Return the number of samples from which creep, or the `memory`, before is estimated."""
    creeps, end = _creeps(model), 10
    if memory:
        # later, what was before the start is forgotten; wide plays and creep look alike
        enough = np.inf if creeps else SWEPT * float(np.ptp(model.scaling.range))
        end = max(forgotten(piece.v, way=forgetting(model), enough=enough), end)
    if creeps:
        end = max(end, int(np.ceil(EARLY * piece.n)))
    return min(end, piece.n)


def fit_start(
    model: StageModel, piece: Piece, sound: NDArray[np.bool_] | None = None
) -> Start | None:
    """
    Estimate what a stage keeps of its motion before a piece.

    Parameters
    ----------
    model : StageModel
    piece : Piece
        With short gaps bridged, as of `piezo_ident.record.readings.gaps.bridged`.
    sound : ndarray of bool, shape (n,), optional
        Its samples that were measured; all when absent.

    Returns
    -------
    Start or None
        None for a stage that was at rest at the lowest voltage, as far as the data tell.
    """
    known = begins_at_rest(model, piece, sound)
    creeps = _creeps(model)
    if known and not creeps:
        return None
    still, e = _fit(model, piece, sound, memory=not known)
    if not creeps:
        return still
    free, left = _fit(model, piece, sound, memory=not known, creep=True, zero=True)
    if np.std(left) > WORTH * np.std(e) - FAINT:
        return None if known else still
    held, e_held = _fit(model, piece, sound, memory=not known, creep=True)
    if np.sqrt(np.mean(e_held**2)) <= SURE * np.std(left):
        return held
    # a zero and slow creep make up for each other: what the model lacks looks like both
    if np.std(left) <= APART * np.std(e):
        return free
    return None if known else still


def crept(model: StageModel, start: Start) -> float:
    """Return what creep of earlier motion adds to the displacement at a start [m]."""
    if not start.creep.size:
        return 0.0
    return float(model.scaling.Y * model.dynamics.gain * (creep_elements(model)[0] @ start.creep))


def creep_elements(model: StageModel) -> NDArray[np.float64]:
    """Return shares and time constants [s] of the creep of a model, shape (2, c)."""
    found = [e.parameters for e in model.effects if e.name == Creep.name]
    return np.array([found[0]['gain'], found[0]['time_constant']]) if found else np.empty((2, 0))


def _creeps(model: StageModel) -> bool:
    return bool(creep_elements(model)[0].any())


def _branches(h: Hysteresis, u: float) -> NDArray[np.float64]:
    """Return H at a voltage that came up from the lowest one, and down from the highest."""
    low, high = h.span
    return np.array([h(np.array([*way, u]))[-1] for way in ([low], [low, high])])


def _fit(
    model: StageModel,
    piece: Piece,
    sound: NDArray[np.bool_] | None = None,
    *,
    memory: bool,
    creep: bool = False,
    zero: bool = False,
) -> tuple[Start, NDArray[np.float64]]:
    """Return a start by least squares on the early part, and what it leaves of some samples."""
    h = model.hysteresis
    part = piece.cut(0, early_part(model, piece, memory=memory))
    # the plays follow the voltage behind the effects of the input slot
    u = model.hysteresis_input(part)
    u0 = float(u[0])
    # rows are thinned: a few numbers do not need a hundred thousand samples
    keep = np.arange(part.n) if sound is None else np.flatnonzero(sound[: part.n])
    keep = keep if keep.size else np.arange(part.n)
    keep = keep[:: max(1, keep.size // 5000)]
    x = model.scaling.x(part.y)[keep]
    m, k = (h.thresholds.size, h.lag_range.shape[1]) if memory else (0, 0)
    gains, times = creep_elements(model) if creep else np.empty((2, 0))
    c, z = gains.size, int(zero)
    rest = np.concatenate([h.initial_memory(u0)[:m], h.settled(u0)[:k], np.zeros(c + z)])

    def start(state: NDArray[np.float64]) -> Start:
        return Start(state[: m + k] if memory else None, state[m + k : m + k + c])

    def error(state: NDArray[np.float64]) -> NDArray[np.float64]:
        y_hat = model.scaling.x(model.predict_piece(part, start(state)))
        return np.asarray(x - y_hat[keep] - (state[-1] if zero else 0.0))

    forgets = h.weights.any() or h.rise(np.full(h.thresholds.size, u0)).any() or h.lag_range.any()
    if not ((memory and forgets) or creep):
        return start(rest), error(rest)
    top, bottom = np.maximum.accumulate(u), np.minimum.accumulate(u)

    def passed(signal: NDArray[np.float64]) -> NDArray[np.float64]:
        delayed = model.total_delay.apply(signal)
        return filter_arx(model.dynamics.a, model.dynamics.b, delayed)[keep]

    path = np.cumsum(np.abs(np.diff(u, prepend=u0)))
    rates = h.relaxations[:, 0] if k and h.relaxations is not None else np.empty(0)
    age = np.arange(part.n)[keep] / part.sample_rate
    others = [passed(np.exp(-a * path)) for a in rates]
    # creep goes on as it was, and so has passed G
    pairs = zip(gains, times, strict=True)
    others += [model.dynamics.gain * gain * np.exp(-age / tau) for gain, tau in pairs]
    others += [np.ones(age.size)] * z
    # from one threshold to the next a play output falls by a share of the difference
    falls = np.diff(h.thresholds, prepend=0.0)[:m]
    whole = np.eye(rest.size)
    whole[:m, :m] = -np.tril(np.ones((m, m))) * falls
    # creep has followed voltages of the range; H stands between its two branches
    reach = h(np.linspace(*h.span, 65))[:, None] - _branches(h, u0)
    far = np.repeat([[reach.min(), -FAR], [reach.max(), FAR]], [c, z], axis=1)
    lags = h.lag_range[:, :k]
    low = np.concatenate([np.zeros(m), np.minimum([*lags[0], *far[0]], rest[m:])])
    high = np.concatenate([np.ones(m), np.maximum([*lags[1], *far[1]], rest[m:])])
    margin = 1e-9 * np.maximum(high - low, 1.0)
    weak = np.repeat(np.sqrt([LAG_PULL, CREEP_PULL, 0.0]), [k, c, z])
    origin = np.append(np.full(m, u0), np.zeros(k + c + z))
    found: list[tuple[float, NDArray[np.float64], NDArray[np.float64]]] = []
    # a play that was caught at once tells nothing of where else it may have stood: both of its
    # ends are tried, those of a voltage that came up and of one that came down
    down = np.minimum(u0, max(u0, h.span[1]) - h.thresholds)
    for plays in (rest[:m], down) if m else (rest[:m],):
        falls_of = np.diff(-plays, prepend=-u0) / falls
        number = np.clip(np.concatenate([falls_of, rest[m:]]), low, high)
        state = origin + whole @ number
        e = error(state)
        for _ in range(TRIALS):
            columns = []
            rise = h.rise(state[:m], u0) if m else np.empty(0)
            for r, q, f in zip(h.thresholds[:m], rise, state[:m], strict=True):
                # the play follows its start only while neither bound has caught it
                moved = np.clip(f, np.minimum(top - r, bottom), bottom)
                free = ((np.abs(moved - f) < 1e-12) & (top - r < bottom)).astype(np.float64)
                columns.append(q * passed(free))
            pull = np.sqrt(PULL) * np.maximum(rise, 1e-3)
            pull = np.sqrt(e.size) * np.append(pull, weak)
            A = np.vstack([np.array([*columns, *others]).T, np.diag(pull)]) @ whole
            target = np.concatenate([e, pull * (rest - state)])
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
            number, e, state = trial, new, origin + whole @ trial
            if moved_by < 1e-6:
                break
        found.append((float(e @ e), state, e))
    _, state, e = min(found, key=lambda one: one[0])
    return start(state), e

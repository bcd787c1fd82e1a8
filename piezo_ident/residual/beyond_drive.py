# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Test further channels as causes of a residual that no function of the drive explains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from piezo_ident.common.arrays import Array, interpolated, Mask
from piezo_ident.operators.play import play_columns
from piezo_ident.record.channels import role_of
from piezo_ident.residual.coherence import coherence
from piezo_ident.residual.stretches import block_means, ResidualPart
from scipy import fft, linalg, signal, stats

#: approximate rate of the means of samples that are tested [Hz]
RATE = 2500.0
#: thresholds of the plays of the drive, and of a channel, as shares of the range
PLAYS, CHANNEL_PLAYS = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.75, 0.9), (0.1, 0.4)
#: corners of the low-passes behind each function [Hz]
CORNERS = (0.3, 2.0, 10.0, 50.0, 250.0)
#: least eigenvalue of a direction of drive or channel functions, as a share of the largest one
RANK, CHANNEL_RANK = 1e-6, 1e-3
#: number of cosines over a record that stand for drift, and settling time at its start [s]
SLOW, SETTLING = 24, 0.5
#: a channel follows the drive if less of its power is left without it, or if more is coherent
OWN, FOLLOWS = 0.01, 0.9
#: coefficients of the filter that makes a residual white, and window of the rms of a residual [s]
WHITE, LEVEL = 32, 0.1
#: chance that an unrelated channel is taken for a cause
SIGNIFICANT = 1e-5
#: least gain on held-out parts, as a share of the gain of the fit, and number of the parts
KEPT, FOLDS = 0.5, 5
#: least shift of a surrogate, as a share of a record
AROUND = 0.05


@dataclass(frozen=True)
class ChannelTest:
    """
    Whether a further channel explains residual that the drive does not explain.

    An unrelated channel is `significant` in one of 100,000 cases; `added` is its contribution to
    the residual of each part [m], empty without a test.
    """

    channel: str
    significant: bool = False
    added: tuple[Array | None, ...] = field(default=(), repr=False, compare=False)

    @property
    def tells(self) -> bool:
        """Whether the channel moves by itself and can be a cause; a displacement cannot."""
        return bool(self.added) and role_of(self.channel) != 'y'


def drive_functions(v: Array, rate: float) -> Array:
    """
    Compute functions of a drive whose sums imitate hysteresis, lag and creep, shape (n, k).

    The functions are the drive v, shape (n,), its square and cube, its plays, and every second
    play times the drive, which lets loops lean.  Differences of first and second order, and
    low-passes, of each function follow it.
    """
    span = float(np.ptp(v))
    u = (v - v.min()) / span if span > 0.0 else np.zeros(v.size)
    functions = [u, *play_columns(u, PLAYS)]
    functions += [u * u, u**3, *(u * f for f in functions[1::2])]
    columns = []
    for x in functions:
        columns += [x, np.diff(x, prepend=x[0]), np.diff(x, 2, prepend=(x[0], x[0]))]
        columns += _lagged(x, rate)
    return np.stack(columns, axis=1)


def without_drive(e: Array, v: Array, rate: float, use: Mask) -> Array:
    """Subtract the best sum of functions of the drive from a residual, shape (n,)."""
    A = np.hstack([drive_functions(v, rate), _slow(e.size)])
    return np.asarray(e - A @ _solve(A[use], e[use]))


def _slow(n: int) -> Array:
    """Compute slow cosines of time that stand for drift and creep, shape (n, k)."""
    return np.cos(np.pi * np.outer((np.arange(n) + 0.5) / n, np.arange(SLOW)))


def _solve(A: Array, e: Array) -> Array:
    """Solve least squares for the coefficients of columns (n, k), without tiny eigenvalues."""
    scale, values, vectors = _directions(A, RANK**1.5)
    return np.asarray(vectors @ ((vectors.T @ (A.T @ e / scale)) / values) / scale)


def _basis(A: Array, rank: float) -> tuple[Array, Array]:
    """Compute an orthonormal basis of columns (n, k), and the matrix that makes it of them."""
    scale, values, vectors = _directions(A, rank)
    made = vectors / np.sqrt(values) / scale[:, None]
    return A @ made, made


def _directions(A: Array, rank: float) -> tuple[Array, Array, Array]:
    """Compute the norms of columns, and eigenvalues and vectors of their scaled Gram matrix."""
    N = A.T @ A
    scale = np.maximum(np.sqrt(np.diag(N)), 1e-300)
    values, vectors = linalg.eigh(N / scale / scale[:, None])
    kept = values > rank * max(float(values[-1]), 1e-300)
    return scale, values[kept], vectors[:, kept]


@dataclass(frozen=True, eq=False)
class _Part:
    """Means of the sound samples of a part."""

    e: Array
    drive: Array
    channel: Array
    own: Array
    use: Mask
    rate: float

    def beyond(self, x: Array, channel: Array | None = None) -> Array:
        """Subtract the best functions of the drive, and of a channel if any, from a signal."""
        A = self.drive if channel is None else np.hstack([self.drive, channel])
        return np.asarray(x - A @ _solve(A[self.use], x[self.use]))


def channel_tests(parts: Sequence[ResidualPart]) -> tuple[ChannelTest, ...]:
    """
    Test whether each further channel explains residual that the drive does not explain.

    Functions of the drive (`drive_functions`) are subtracted from residual and channel.  Both are
    divided by the level of the residual nearby, so that quiet stretches count, and made white.
    The channel, its plays and its low-passes then explain a share of the residual.  Circular
    shifts of the residual give the share of an unrelated channel.  Partial coherence: Bendat and
    Piersol, Random Data, 4th ed. (2010), section 7.3, doi:10.1002/9781118032428.
    """
    names = dict.fromkeys(name for part in parts for name in part.piece.channels)
    return tuple(_tested(name, parts) for name in names)


def _tested(name: str, parts: Sequence[ResidualPart]) -> ChannelTest:
    having = [part for part in parts if name in part.piece.channels]
    every = [_part_of(part, name) if name in part.piece.channels else None for part in parts]
    rate = max((p.rate for p in every if p), default=0.0)
    judged = [p for p in every if p and p.rate == rate and p.use.sum() > 4 * WHITE]
    moves = any(np.ptp(p.own[p.use]) > 0.0 for p in judged)
    if not moves or _follows(having, name, judged):
        return ChannelTest(name)
    levels = [_level(p) for p in judged]
    # only the rest is made white: whitening would remove a channel that is a single tone
    at_level = [(p.beyond(p.e, p.channel) / s)[p.use] for p, s in zip(judged, levels, strict=True)]
    white = _whitening(np.concatenate(at_level))
    weighed = list(zip(judged, levels, strict=True))
    E = np.concatenate([_white(p.e[:, None], p, s, white)[:, 0] for p, s in weighed])
    B = linalg.block_diag(*(_white(p.drive, p, s, white) for p, s in weighed))
    C = np.vstack([_white(p.channel, p, s, white) for p, s in weighed])
    Q, _ = _basis(B, RANK)
    E, C = E - Q @ (Q.T @ E), C - Q @ (Q.T @ C)
    P, made = _basis(C, CHANNEL_RANK)
    chance, gain, bound = _chance(E, P)
    kept = _held_out(E, P) / max(float(np.sum((P.T @ E) ** 2)), 1e-300)
    coefficients = made @ (P.T @ E)
    added: list[Array | None] = []
    for part, p in zip(parts, every, strict=True):
        added.append(None)
        if any(p is one for one in judged) and p is not None:
            m = max(1, int(part.piece.sample_rate / RATE))
            means = p.channel @ coefficients
            middle = np.arange(means.size) * m + 0.5 * (m - 1)
            added[-1] = np.interp(np.arange(part.piece.n), middle, means - means.mean())
    is_cause = chance < SIGNIFICANT and gain > bound and kept > KEPT
    return ChannelTest(name, is_cause, tuple(added))


def without_channels(
    parts: Sequence[ResidualPart], tests: Sequence[ChannelTest]
) -> list[ResidualPart]:
    """Subtract the contributions of significant channels, so that their lines are not hum."""

    def squares(parts: Sequence[ResidualPart]) -> float:
        return sum(float(np.sum(part.e[part.mask] ** 2)) for part in parts)

    # voltage and displacement of one axis explain the same part: only the better one is subtracted
    of_axis: dict[str, list[list[ResidualPart]]] = {}
    for t in tests:
        if t.significant:
            axis = t.channel[2:] if role_of(t.channel) else t.channel
            pairs = zip(parts, t.added, strict=True)
            rest = [part if x is None else part.with_residual(part.e - x) for part, x in pairs]
            of_axis.setdefault(axis, []).append(rest)
    found = list(parts)
    for rivals in of_axis.values():
        least = min(rivals, key=squares)
        found = [
            part.with_residual(part.e + less.e - own.e)
            for part, less, own in zip(found, least, parts, strict=True)
        ]
    return found


def _follows(having: Sequence[ResidualPart], name: str, judged: Sequence[_Part]) -> bool:
    """Tell whether the drive, or drift, explains a channel."""
    left = sum(float(np.sum(p.beyond(p.own)[p.use] ** 2)) for p in judged)
    whole = sum(float(np.sum((x - x.mean()) ** 2)) for x in (p.own[p.use] for p in judged))
    signals = [(part, _known(part.piece.channels[name])) for part in having]
    of_drive = coherence([part.with_residual(c) for part, c in signals if np.isfinite(c).all()])
    return left < OWN * whole or (of_drive is not None and of_drive.share > FOLLOWS)


def _part_of(part: ResidualPart, name: str) -> _Part:
    """Average a part to `RATE`, and compute the functions of drive and channel `name`."""
    m = max(1, int(part.piece.sample_rate / RATE))
    rate = part.piece.sample_rate / m
    e, v, c = (block_means(x, m) for x in (part.e, part.piece.v, part.piece.channels[name]))
    use = part.joined[: e.size * m].reshape(-1, m).all(axis=1) & np.isfinite(c)
    use[: min(round(SETTLING * rate), e.size // 8)] = False
    c = _known(c)
    drive = np.hstack([drive_functions(v, rate), _slow(e.size)])
    # a stage may follow the channel, its lags, its rate, and its plays
    span = float(np.ptp(c))
    u = (c - c[0]) / span if span > 0.0 else np.zeros(c.size)
    columns = [u, np.diff(u, prepend=u[0]), *play_columns(u - u.min(), CHANNEL_PLAYS)]
    functions = np.stack([*columns, *_lagged(u, rate, CORNERS[1:])], axis=1)
    return _Part(np.where(use, e, 0.0), drive, functions, c, use, rate)


def _known(channel: Array) -> Array:
    """Replace the unknown samples of a channel by straight lines."""
    return interpolated(channel, ~np.isfinite(channel))


def _lagged(x: Array, rate: float, corners: Sequence[float] = CORNERS) -> list[Array]:
    """Pass a signal through low-passes, from rest at its first value."""
    lagged = []
    for corner in corners:
        if corner < 0.2 * rate:
            a = float(np.exp(-2.0 * np.pi * corner / rate))
            lagged.append(signal.lfilter([1.0 - a], [1.0, -a], x, zi=[a * x[0]])[0])
    return lagged


def _level(p: _Part) -> Array:
    """Compute the rms of a residual around each sample, at least a hundredth of the whole rms."""
    window = np.ones(max(8, round(LEVEL * p.rate)))
    e = np.where(p.use, p.beyond(p.e), 0.0)
    power = np.convolve(e * e, window, 'same')
    level = power / np.maximum(np.convolve(p.use.astype(np.float64), window, 'same'), 1.0)
    return np.asarray(np.sqrt(np.maximum(level, 1e-4 * float(level[p.use].mean()) + 1e-300)))


def _white(x: Array, p: _Part, level: Array, white: Array) -> Array:
    """Divide signals (n, k) by a level and whiten them, at samples that count."""
    # the filter needs as many samples that count as it has coefficients
    settled = np.convolve(p.use.astype(np.float64), np.ones(white.size))[: p.use.size]
    whitened = signal.lfilter(white, [1.0], x / level[:, None], axis=0)
    return np.asarray(whitened[settled > white.size - 0.5])


def _whitening(e: Array) -> Array:
    """Compute the prediction error filter of a residual (Levinson)."""
    n = e.size
    spectrum = np.abs(fft.rfft(e - e.mean(), 2 * n)) ** 2
    r = fft.irfft(spectrum)[: WHITE + 1] / n
    r[0] *= 1.0 + 1e-9
    if r[0] <= 0.0:
        return np.ones(1)
    return np.concatenate([[1.0], -linalg.solve_toeplitz(r[:-1], r[1:])])


def _held_out(e: Array, P: Array) -> float:
    """Compute the gain in squares on held-out stretches with equal squares of the columns P."""
    moved = np.cumsum(np.sum(P**2, axis=1))
    edges = np.searchsorted(moved, np.linspace(0.0, moved[-1], FOLDS + 1)[1:-1])
    total = 0.0
    for p, x in zip(np.split(P, edges), np.split(e, edges), strict=True):
        G = p.T @ p
        theta = linalg.solve(np.eye(P.shape[1]) * (1.0 + 1e-9) - G, P.T @ e - p.T @ x)
        total += float(2.0 * theta @ (p.T @ x) - theta @ G @ theta)
    return total


def _chance(e: Array, P: Array) -> tuple[float, float, float]:
    """
    Compute the chance of a gain, the gain as a share of the power of e, and its bound.

    The surrogates are the circular shifts of e without its projection on the columns of P.  Their
    gains on these columns are coherences.  A beta distribution with their mean and variance also
    gives chances that are smaller than one in their number.
    """
    n, k = P.shape
    power = float(e @ e)
    if power == 0.0 or k == 0:
        return 1.0, 0.0, 1.0
    size = fft.next_fast_len(n, real=True)
    # a few zeros behind a series hardly change its shifts
    rest = e - P @ (P.T @ e)
    E = np.conj(fft.rfft(rest, size))
    gains = np.zeros(size)
    for column in P.T:
        gains += fft.irfft(fft.rfft(column, size) * E, size) ** 2
    gains /= max(float(rest @ rest), 1e-300)
    away = max(2 * WHITE, round(AROUND * n))
    others = gains[away : size - away]
    gain = float(np.sum((P.T @ e) ** 2)) / power
    mean, spread = float(others.mean()), float(others.var())
    if spread == 0.0:
        return 1.0, gain, 1.0
    # a + b of the beta distribution; one column and L observations have a = 1 and b = L - 1
    total = mean * (1.0 - mean) / spread - 1.0
    law = stats.beta(mean * total, (1.0 - mean) * total)
    chance = max(float(law.sf(gain)), 1e-300)
    if gain <= float(others.max()):
        chance = max(chance, 1.0 / others.size)
    return chance, gain, float(law.isf(SIGNIFICANT))

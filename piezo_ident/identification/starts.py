# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Fit the unknown memory of runs that do not start at the lowest voltage, together with the plays.

Until the voltage has moved by the width of a play, the play may stand still at an unknown place.
The places are fitted with the weights, so no part of a run has to be dropped.  The outputs of all
plays are one curve over the threshold.  The curve starts at the voltage and falls no faster than
the threshold grows,

    F_r(0) = u(0) - int_0^r s(r') dr',      0 <= s <= 1.

The fit finds the shares s.  Gauss-Newton varies the weights and the shares, both bounded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.identification.prepare import Excerpt, Run
from piezo_ident.identification.solvers.least_squares import (
    bounded_least_squares,
    triangular_factor,
)
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.play import play_columns

Rule = Callable[[Array], Array]
#: share of each play, by the number of the run whose start is fitted
Shares = dict[int, Array]

#: number of blocks into which a run is thinned; each keeps its extremes and its last sample
BLOCKS = 4000
#: number of thresholds over the range of the voltage, for one or two unknown starts and for more
COUNT, COUNT_OF_MANY = 40, 20
#: first guesses: shares of the swing that the voltage has moved in one direction up to the start.
#: From a wrong guess Gauss-Newton ends at another, worse memory
TURNED = np.linspace(0.0, 1.0, 11)
#: first guesses: one share for all plays, of a stage that stands between its branches
BETWEEN = (0.5, 0.25, 0.75)
#: shares of plays at their upper and lower end; a play exactly at its end would not move in the
#: fit
ENDS = (0.1, 0.9)
#: number of best guesses from which Gauss-Newton starts, beside the plain guess
STARTS = 5
#: share by which another start must err less than the plain start: a record of steps alone cannot
#: tell the memory
CLEARLY = 0.02
#: weight that pulls the shares to the first guess, per row and threshold
PULL = 1e-3
#: most iterations
TURNS = 12
#: smallest fall of the loss that is worth another iteration, as a share of the loss
WORTH = 1e-3


class _Thinned:
    """Run thinned to its extremes, which alone move the plays."""

    def __init__(self, excerpt: Excerpt, lag: float) -> None:
        u, n = excerpt.u, excerpt.u.size
        size = max(1, n // BLOCKS)
        edges = np.arange(0, n - n % size, size)
        blocks = u[: edges.size * size].reshape(-1, size)
        last = edges + size - 1
        keep = np.unique([edges + blocks.argmin(axis=1), edges + blocks.argmax(axis=1), last])
        self.u = u[keep]
        at = last + lag
        inside = at <= n - 1
        near = np.minimum(np.rint(at).astype(int), n - 1)
        used = inside & excerpt.use[near]
        self.rows = np.searchsorted(keep, last[used])
        self.x = np.interp(at[used], np.arange(n), excerpt.x)
        self.top, self.bottom = np.maximum.accumulate(self.u), np.minimum.accumulate(self.u)

    def columns(self, r: Array, memory: Array) -> tuple[Array, Array]:
        """Compute the plays at the rows, and 1 if a play still stands at its start, else 0."""
        plays = play_columns(self.u, r, memory)[:, self.rows]
        top, bottom = self.top[self.rows], self.bottom[self.rows]
        at, width = memory[:, None], r[:, None]
        free = (top <= at + width + 1e-12) & (bottom >= at - 1e-12)
        return plays.T, free.T.astype(np.float64)


def _guesses(r: Array, swing: float) -> list[Array]:
    """
    Guess shares for a stage that last went up or down by some voltage, or stands between.

    The first guess is the plain one, with all shares in the middle.
    """
    low, high = ENDS
    up = [np.where(r < share * swing, high, low) for share in TURNED]
    down = [low + high - shares for shares in up[1:-1]]
    return [*(np.full(r.size, share) for share in BETWEEN), *up, *down]


class _Starts:
    """
    Least squares on the weights and the unknown starts of runs.

    The vector of unknowns holds offsets and weights first, then the shares of each start.
    """

    def __init__(
        self, excerpts: Sequence[Excerpt], thinned: Sequence[_Thinned], sought: Sequence[int]
    ) -> None:
        self.excerpts, self.thinned, self.sought = excerpts, thinned, sought
        self.swing = max(float(np.ptp(e.u)) for e in excerpts)
        count = COUNT if len(sought) < 3 else COUNT_OF_MANY
        self.r = self.swing * np.arange(1, count) / count
        self.steps = np.diff(self.r, prepend=0.0)
        n = sum(t.x.size for t in thinned)
        self.pull = PULL * np.sqrt(n) * self.steps
        k, m = len(excerpts), self.r.size
        self.weights = slice(k, k + m)
        self.known = known = k + m + 2
        self.places = {i: slice(known + m * j, known + m * (j + 1)) for j, i in enumerate(sought)}
        self.lower, self.upper = np.full(known, -np.inf), np.full(known, np.inf)
        self.lower[self.weights] = 0.0

    def memory(self, i: int, shares: Shares) -> Array:
        """Compute the memory at the start of a run."""
        if i in shares:
            return np.asarray(self.excerpts[i].u[0] - np.cumsum(shares[i] * self.steps))
        return self.excerpts[i].start(self.r)

    def rows(self, i: int, shares: Shares) -> tuple[Array, Array]:
        """Compute columns of offsets and weights with the target, and the plays that stand."""
        part = self.thinned[i]
        plays, still = part.columns(self.r, self.memory(i, shares))
        u = part.u[part.rows]
        block = np.zeros((u.size, self.known + 1))
        block[:, i] = 1.0
        block[:, len(self.thinned) : -1] = np.column_stack([plays, u**3, u])
        block[:, -1] = part.x
        return block, still

    def weighted(self, blocks: Sequence[Array]) -> tuple[Array, float]:
        """Fit offsets and weights to rows of all runs, or to their factors; also the loss."""
        R = triangular_factor(blocks, self.known + 1)
        return bounded_least_squares(R, self.lower, self.upper)

    def again(self) -> list[tuple[Shares, Array]]:
        """Turn memories that were found before with another G into first guesses, if all exist."""
        before = {i: rule for i in self.sought if (rule := self.excerpts[i].memory) is not None}
        if len(before) < len(self.sought):
            return []
        shares = {
            i: np.clip(
                -np.diff(rule(self.r), prepend=self.excerpts[i].u[0]) / self.steps, 0.0, 1.0
            )
            for i, rule in before.items()
        }
        blocks = [self.rows(i, shares)[0] for i in range(len(self.thinned))]
        return [(shares, self.weighted(blocks)[0])]

    def guessed(self) -> list[tuple[Shares, Array]]:
        """Find the plain guess and the best other guesses, each with its weights."""
        guesses = _guesses(self.r, self.swing)
        factors = [
            [
                triangular_factor([self.rows(i, {i: guess})[0]], self.known + 1)
                for guess in (guesses if i in self.places else guesses[:1])
            ]
            for i in range(len(self.thinned))
        ]

        def fit(places: Sequence[int]) -> tuple[Array, float]:
            return self.weighted([R[place] for R, place in zip(factors, places, strict=True)])

        def loss(places: Sequence[int]) -> float:
            return fit(places)[1]

        numbers = range(len(guesses))
        plain, *others = [
            [g if i in self.places else 0 for i in range(len(factors))] for g in numbers
        ]
        candidates = []
        for places in [plain, *sorted(others, key=loss)[:STARTS]]:
            for i in self.sought if len(self.sought) > 1 else ():
                places = min(([*places[:i], g, *places[i + 1 :]] for g in numbers), key=loss)
            candidates.append(({i: guesses[places[i]] for i in self.sought}, fit(places)[0]))
        return candidates

    def step(self, shares: Shares, weights: Array, prior: Shares) -> tuple[Array, Shares, float]:
        """Compute the next weights, the changes of the shares, and the loss before the step."""
        known, m = self.known, self.r.size
        width = known + m * len(self.places) + 1
        blocks = []
        loss = 0.0
        for i in range(len(self.thinned)):
            own, still = self.rows(i, shares)
            loss += float(np.sum((own[:, :-1] @ weights - own[:, -1]) ** 2))
            block = np.zeros((own.shape[0], width))
            block[:, :known], block[:, -1] = own[:, :-1], own[:, -1]
            if i in self.places:
                moved = still * weights[self.weights]
                block[:, self.places[i]] = -self.steps * np.cumsum(moved[:, ::-1], axis=1)[:, ::-1]
            blocks.append(block)
        lower, upper = (np.resize(x, width - 1) for x in (self.lower, self.upper))
        for i, at in self.places.items():
            ridge = np.zeros((m, width))
            ridge[:, at] = np.diag(self.pull)
            ridge[:, -1] = self.pull * (prior[i] - shares[i])
            loss += float(np.sum(ridge[:, -1] ** 2))
            blocks.append(ridge)
            lower[at], upper[at] = -shares[i] - 1e-9, 1.0 - shares[i] + 1e-9
        theta, _ = bounded_least_squares(triangular_factor(blocks, width), lower, upper)
        return theta[:known], {i: theta[at] for i, at in self.places.items()}, loss

    def fit(self, first: tuple[Shares, Array]) -> tuple[Shares, float]:
        """Run Gauss-Newton from a guess; the shares and their loss."""
        prior, weights = first
        best, best_loss, scale = prior, np.inf, 1.0
        shares, change = prior, prior
        for _ in range(TURNS):
            new_weights, new_change, loss = self.step(shares, weights, prior)
            if loss < best_loss:
                small = loss > (1.0 - WORTH) * best_loss
                best, best_loss, change, weights = shares, loss, new_change, new_weights
                if small:
                    break
                scale = 1.0
            else:
                scale *= 0.4
                if scale < 0.05:
                    break
            shares = {i: np.clip(best[i] + scale * change[i], 0.0, 1.0) for i in self.sought}
        return best, best_loss


def fit_starts(
    excerpts: Sequence[Excerpt], unknown: Sequence[bool], lag: float = 0.0
) -> list[Rule | None]:
    """
    Find the memory at the start of each run as a function of the thresholds.

    Parameters
    ----------
    excerpts : sequence of Excerpt
        Runs with the samples to use, preferably slow motion; each gets an offset.  A memory that
        was found before is the first guess.
    unknown : sequence of bool
        Whether the memory of a run is fitted; the other runs keep theirs.
    lag : float, optional
        Samples by which the displacement follows slow motion, through the delay and G.

    Returns
    -------
    list of callable or None
        `Excerpt.memory` of each run.
    """
    rules = [e.memory for e in excerpts]
    if not any(unknown):
        return rules
    thinned = [_Thinned(e, lag) for e in excerpts]
    sought = [i for i, is_sought in enumerate(unknown) if is_sought and thinned[i].x.size]
    if not sought:
        return rules
    starts = _Starts(excerpts, thinned, sought)
    plain, *others = map(starts.fit, starts.again() or starts.guessed())
    best, loss = min([plain, *others], key=lambda one: one[1])
    if loss > (1.0 - CLEARLY) * plain[1]:
        best = plain[0]
    for i in sought:
        rules[i] = _rule(float(excerpts[i].u[0]), starts.r, starts.memory(i, best))
    return rules


def lag_of(G: Dynamics, delay: Delay) -> float:
    """Compute the number of samples by which the displacement follows slow motion."""
    a = np.concatenate([[1.0], G.a])
    k_b, k_a = np.arange(G.b.size), np.arange(a.size)
    return delay.total + float(k_b @ G.b / G.b.sum() - k_a @ a / a.sum())


def with_starts(runs: Sequence[Run], lag: float = 0.0) -> list[Run]:
    """
    Fit the memory at the start of runs to the fitted samples of their triangles.

    All samples of a run count as known once its memory is fitted.  `lag` is as in `fit_starts`.
    """
    excerpts = [run.excerpt(run.mask('triangle') & run.use & ~run.held_out()) for run in runs]
    driven = [i for i, e in enumerate(excerpts) if e.use.any()]
    unknown = [not bool(np.array_equal(runs[i].known, runs[i].use)) for i in driven]
    fitted_runs = list(runs)
    rules = fit_starts([excerpts[i] for i in driven], unknown, lag)
    for i, rule in zip(driven, rules, strict=True):
        if rule is not None:
            fitted_runs[i] = replace(runs[i], memory=rule, known=runs[i].use)
    return fitted_runs


def _rule(u0: float, r: Array, memory: Array) -> Rule:
    places, curve = np.concatenate([[0.0], r]), np.concatenate([[u0], memory])

    def rule(thresholds: Array) -> Array:
        outputs = np.interp(thresholds, places, curve)
        return np.asarray(np.clip(outputs, u0 - thresholds, u0))

    return rule

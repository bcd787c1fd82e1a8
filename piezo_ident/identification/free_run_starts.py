# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Search for H, G and the delay by free-run fits from several starts.

The starts are H alone, G from the voltage with a straight line for H, and G from the output of H.
Least squares (ARX) gives each G at several orders and delays.  A free-run fit from each start
varies H, G and the memory at the start together.  `selection.comparison` chooses one fit.  From
this fit, creep and wider laws of H are tried, and the comparison chooses among all fits again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from piezo_ident.common.arrays import Array, Integers, true_runs
from piezo_ident.common.errors import IdentificationError
from piezo_ident.fitting.free_run import Fit, fit
from piezo_ident.fitting.stage import MOST_CREEP, Stage
from piezo_ident.fitting.stretch import delayed, Stretch
from piezo_ident.identification.solvers.arx import factor_of, stabilised
from piezo_ident.identification.step1_delay import MAX_DELAY
from piezo_ident.operators.dynamics import Dynamics, filter_arx
from piezo_ident.operators.hysteresis_law import HysteresisLaw, LawName
from piezo_ident.selection.comparison import ALIKE, best_of, rated, RatedFit, shown_effect
from scipy.signal import butter, sosfilt

#: orders na of G that are tried, with nb = na + 1 or the largest, and the orders of rough fits
ORDERS, ROUGH = (1, 2, 3, 4, 6, 8, 10), (2, 4, 8)
#: laws of H that are tried besides sums of plays
WIDER: tuple[LawName, ...] = ('preisach', 'duhem')
#: span of these laws, normalised: it exceeds the range, so their densities are smooth at its ends
WIDE = (-0.15, 1.15)
#: first guess of an unknown memory at a start: all shares m (`fitting.stage`) in the middle
UNKNOWN = 0.5
#: iterations of a rough fit and of a final fit
FEW, MANY = 6, 15
#: high-pass corner, as a share of the sampling rate, that uncovers modes which slow motion hides
HIGH_PASS = 0.01
#: number of delays of smallest one-step loss that are tried in free run, at each order
NEAR = 3
#: delays of H alone that are tried first [samples]
COARSE = (0, 1, 2, 4, 8, 16, 32, 64)


@dataclass(frozen=True)
class Allowed:
    """Choices of the user: a delay [samples], an order (na, nb), the largest order."""

    delay: int | None = None
    order: tuple[int, int] | None = None
    largest: int = 15

    @property
    def is_free(self) -> bool:
        """Whether the search may choose both the delay and the order."""
        return self.delay is None and self.order is None

    @property
    def delays(self) -> Sequence[int]:
        """Delays that may be tried."""
        return range(MAX_DELAY) if self.delay is None else (self.delay,)

    def orders(self, of: Sequence[int]) -> list[tuple[int, int]]:
        """Select the orders of a list that may be tried."""
        if self.order is not None:
            return [self.order]
        return [(n, min(n + 1, self.largest)) for n in of if n <= self.largest]


def linear_starts(
    inputs: Sequence[Array], stretches: Sequence[Stretch], allowed: Allowed, of: Sequence[int]
) -> dict[tuple[int, int], tuple[int, Dynamics]]:
    """
    Find the delay and the G of least squares with the smallest free-run error, for each order.

    `inputs` holds the input of G on each stretch, normalised.
    """
    orders = allowed.orders(of)
    rate = stretches[0].rate
    sos = butter(2, HIGH_PASS * rate, 'highpass', fs=rate, output='sos')
    best: dict[tuple[int, int], tuple[float, int, Dynamics]] = {}
    raw = [(w, s.x) for w, s in zip(inputs, stretches, strict=True)]
    for pairs in (
        [(w - w[0], x - x[0]) for w, x in raw],
        # a start in motion is not a state of rest
        [(w - w.mean(), x - x.mean()) for w, x in raw],
        [(sosfilt(sos, w - w[0]), sosfilt(sos, x - x[0])) for w, x in raw],
    ):
        for (na, nb), d, G in _by_least_squares(pairs, stretches, orders, allowed.delays):
            left = _free_run_left(G, d, inputs, stretches)
            if (na, nb) not in best or left < best[na, nb][0]:
                best[na, nb] = left, d, G
    return {order: (d, G) for order, (_, d, G) in best.items()}


def _by_least_squares(
    pairs: Sequence[tuple[Array, Array]],
    stretches: Sequence[Stretch],
    orders: Sequence[tuple[int, int]],
    delays: Sequence[int],
) -> list[tuple[tuple[int, int], int, Dynamics]]:
    """Fit a stable G at each order and its `NEAR` best delays, by least squares (ARX)."""
    # lags cover the delays that differ; a delay that all candidates share shifts the input
    least = min(delays)
    parts = [
        (delayed(w, least)[a:b], x[a:b])
        for (w, x), s in zip(pairs, stretches, strict=True)
        for a, b in true_runs(s.use)
    ]
    fits = []
    # a long order needs long parts; use the largest order for which a part is long enough
    for most in sorted({na for na, _ in orders}, reverse=True):
        lags = max(nb for na, nb in orders if na <= most) + max(delays) - least + 1
        long = [(w, x) for w, x in parts if w.size > 3 * (most + lags)]
        if long:
            break
    else:
        return []
    factor = factor_of(long, most, lags)
    for na, nb in (order for order in orders if order[0] <= most):
        # the one-step loss points to the delay; a neighbour may have the smaller free-run error
        losses = {d: factor.fit(na, nb, d - least)[1] for d in delays}
        for d in sorted(losses, key=lambda d: losses[d])[:NEAR]:
            G = stabilised(factor.dynamics(na, nb, d - least))
            if G.is_stable and 0.0 < G.gain < np.inf:
                fits.append(((na, nb), d, G))
    return fits


def _free_run_left(
    G: Dynamics, d: int, inputs: Sequence[Array], stretches: Sequence[Stretch]
) -> float:
    """Sum the squared free-run errors of G, around the mean of each stretch."""
    left = 0.0
    for w, s in zip(inputs, stretches, strict=True):
        e = (s.x - filter_arx(G.a, G.b, delayed(w, d)))[s.use]
        if e.size:
            left += float(np.sum((e - e.mean()) ** 2))
    return left


@dataclass(frozen=True, eq=False)
class Search:
    """
    Search for H, G and the delay on a few stretches.

    `sets` and `kinds` hold the set and the kind of motion of each block, for the comparison.
    `guesses`, shape (records, PARTS), holds the guessed memory at the start of each record; a row
    of zeros is a known start.  `law` is the law of plays.  The search calls `tick` between its
    steps; `tick` may raise to stop the work.
    """

    stretches: Sequence[Stretch]
    sets: Integers
    kinds: Integers | None
    law: HysteresisLaw
    guesses: Array
    allowed: Allowed
    tick: Callable[[], None]

    def best(self) -> tuple[RatedFit, tuple[RatedFit, ...]]:
        """
        Find the best candidate, and list all candidates.

        A start at rest has a known memory.  The search also fits this memory.  All starts count as
        unknown if the fitted memory lowers the mean square to `selection.comparison.EFFECT`.
        """
        alone = self._hysteresis_alone()
        if self._needs_fitted_starts(self._candidate('hysteresis', alone)):
            return self._unknown_starts.best()
        candidates = self._orders(alone)
        best = best_of(candidates)
        if self._needs_fitted_starts(best):
            return self._unknown_starts.best()
        return best, tuple(candidates)

    @property
    def _unknown_starts(self) -> Search:
        return replace(self, guesses=np.where(self.guesses > 0.0, self.guesses, UNKNOWN))

    def _needs_fitted_starts(self, one: RatedFit) -> bool:
        """Tell whether a fitted memory at the starts at rest lowers the error enough."""
        if self.guesses.any(axis=1).all():
            return False
        stage = replace(one.fit.stage, guesses=self._unknown_starts.guesses)
        free = self._candidate('free start', self._fit(stage, FEW), 1)
        return best_of([one, free]) is free

    def at_rest(self, candidates: Sequence[RatedFit]) -> RatedFit:
        """
        Choose the best candidate; its starts are at rest unless fitted memories lower its error.

        The memories were first fitted with an H of plays.  With a wider law of H, the same starts
        may be at rest.
        """
        best = best_of(candidates)
        if np.array_equal(best.fit.stage.guesses, self.guesses):
            return best
        wide = [c for c in candidates if c.fit.stage.law.name in WIDER]
        rests = []
        for one in dict.fromkeys([best, *wide]):
            stage = replace(one.fit.stage, guesses=self.guesses, starts=self.guesses.copy())
            fit = self._fit(stage.on_other(self.stretches), MANY)
            rests.append(self._candidate(f'{one.name}, at rest', fit, one.effects))
        free = replace(best, effects=best.effects + 1)
        known = best_of([*rests, free])
        return best if known is free else known

    def _orders(self, alone: Fit) -> list[RatedFit]:
        # an order that is given decides against H alone
        is_given = self.allowed.order is not None
        candidates = [] if is_given else [self._candidate('hysteresis', alone)]
        rough = [alone, *self._rough([s.u for s in self.stretches], None)]
        rough += self._rough(self._inputs(alone.stage), alone.stage)
        first = min(rough, key=lambda one: one.loss)
        starts = linear_starts(self._inputs(first.stage), self.stretches, self.allowed, ORDERS)
        for (na, _), (d, G) in sorted(starts.items()):
            one = self._fit(_with_dynamics(first.stage, d, G), MANY)
            candidates.append(self._candidate(f'order {na}', one))
        if not candidates:
            raise IdentificationError(
                f'order: least squares finds no stable G of order {self.allowed.order} in the '
                'fitted parts; record longer, or give another order (--order) or none'
            )
        return candidates + self._with_longer_delays(best_of(candidates))

    def wider(self, best: RatedFit, taus: Array) -> list[RatedFit]:
        """Fit candidates with creep, with wider laws of H, and with both."""
        stage = best.fit.stage
        creeping = [self._more(best, 'creep', self._crept(stage, taus))]
        laws = [HysteresisLaw(name, stage.law.thresholds, WIDE) for name in WIDER]
        wider = [self._more(best, law.name, stage.with_law(law)) for law in laws]
        if shown_effect(creeping, best) is not None:
            law = min([best, *wider], key=lambda c: c.price).fit.stage.law
            if law.name in WIDER:
                crept = self._crept(stage.with_law(law), taus)
                creeping.append(self._more(best, f'{law.name}, creep', crept))
        return [*creeping, *wider, *self._crept_before(creeping)]

    def _more(self, best: RatedFit, name: str, stage: Stage) -> RatedFit:
        effects = int(stage.taus.size > 0)
        return self._candidate(f'{best.name}, {name}', self._fit(stage, MANY), effects)

    def _crept_before(self, creeping: Sequence[RatedFit]) -> list[RatedFit]:
        """Add creep of earlier motion to the best candidate with creep, if the error falls."""
        known = min(creeping, key=lambda c: c.error)
        if not known.fit.stage.resting.any():
            return []
        stage = replace(known.fit.stage, rested=False)
        lags, stage = stage.lags, stage.on_other(self.stretches)
        fit = self._fit(replace(stage, lags=lags), FEW)
        free = self._candidate(f'{known.name} from before', fit, known.effects)
        return [free] if ALIKE * free.error < known.error else []

    def _crept(self, stage: Stage, taus: Array) -> Stage:
        """Add creep to a stage; remove the slow poles of G if creep may have their gain."""
        crept, G = stage.with_creep(taus, self.stretches), stage.dynamics
        faster = G.without_slow_poles(1.0 / (2.0 * np.pi * taus[0]), self.stretches[0].rate)
        share = abs(G.gain / faster.gain - 1.0)
        if self.allowed.order is not None or not share <= MOST_CREEP * taus.size:
            return crept
        return replace(crept, dynamics=faster.normalised())

    def _with_longer_delays(self, best: RatedFit) -> list[RatedFit]:
        """Replace the first coefficient of B by a sample of delay, while `best_of` prefers it."""
        accepted: list[RatedFit] = []
        one = best
        while one.fit.stage.dynamics.b.size > 1 and self.allowed.is_free:
            stage = one.fit.stage
            shorter = Dynamics(stage.dynamics.a, stage.dynamics.b[1:])
            if not shorter.gain > 0.0:
                break
            start = _with_dynamics(stage, stage.delay + 1, shorter)
            one = self._candidate(f'{best.name}, later', self._fit(start, FEW))
            if best_of([best, one]) is best:
                break
            accepted.append(one)
        return accepted

    def _candidate(self, name: str, one: Fit, effects: int = 0) -> RatedFit:
        return rated(name, one, self.sets, self.kinds, effects)

    def _fit(self, stage: Stage, steps: int) -> Fit:
        return fit(stage, self.stretches, iterations=steps, tick=self.tick)

    def _inputs(self, stage: Stage) -> list[Array]:
        return [stage.hysteresis(s.u, stage.memory(s)) for s in self.stretches]

    def _hysteresis_alone(self) -> Fit:
        """Fit H and a pure delay, first at coarse delays and then between the best neighbours."""
        tried: dict[int, Fit] = {}

        def at(d: int) -> Fit:
            if d not in tried:
                start = min(tried.values(), key=lambda one: one.loss).stage if tried else None
                if start is None:
                    start = Stage.linear(self.law, Dynamics.unit(), d, self.guesses)
                tried[d] = self._fit(replace(start, delay=d), FEW)
            return tried[d]

        if self.allowed.delay is not None:
            return at(self.allowed.delay)
        for i, d in enumerate(COARSE):
            at(d)
            if i > 1 and tried[COARSE[i]].loss > tried[COARSE[i - 1]].loss:
                break
        while True:
            best = min(tried, key=lambda d: tried[d].loss)
            below = max((d for d in tried if d < best), default=best)
            above = min((d for d in tried if d > best), default=best)
            gaps = [(a + b) // 2 for a, b in ((below, best), (best, above)) if b - a > 1]
            if not gaps:
                return tried[best]
            for d in gaps:
                at(d)

    def _rough(self, inputs: Sequence[Array], stage: Stage | None) -> list[Fit]:
        fits = []
        for d, G in linear_starts(inputs, self.stretches, self.allowed, ROUGH).values():
            start = Stage.linear(self.law, G, d, self.guesses)
            if stage is not None:
                start = _with_dynamics(stage, d, G)
            # a start that diverges is dropped
            with suppress(IdentificationError):
                fits.append(self._fit(start, FEW))
        return fits


def _with_dynamics(stage: Stage, d: int, G: Dynamics) -> Stage:
    """Replace G of a stage; the gain of G goes into H."""
    gain = G.gain
    return replace(stage, dynamics=G.normalised(), delay=d, coefficients=stage.coefficients * gain)

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
A stage of one axis as a free-run fit sees it: its numbers, its prediction, and the derivatives.

    h = sum_j c_j phi_j[v]                               columns of a law of H
    w = h + sum_k s_k L_k h                              creep, L_k = 1 / (1 + tau_k p)
    y = B(z)/A(z) z^-d w + offset + sum_k e_k exp(-t / tau_k)

The numbers are c, s, a and b, the offset of each record, the decays e_k of creep from before each
stretch, and the memory at the start of each stretch,

    F_r(0) = v(0) - int_0^r m(r') dr',      0 <= m <= 1,

with m constant on `PARTS` even parts of the thresholds.  With w_f = z^-d w/A and y_f = y/A the
derivatives by b_j and a_i are shifts of two filtered signals, w_f(k-j+1) and -y_f(k-i): Ljung,
System Identification, 2nd ed. (1999), section 10.3.

H rises with the voltage.  Right behind a turning point only its powers of v move; their slope is
a quadratic in v, and its coefficients in the basis of Bernstein, (1-v)^2, 2v(1-v) and v^2, are
the numbers of the fit, at least `LEAST_SLOPE` each.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import ModelError
from piezo_ident.fitting.stretch import delayed, Stretch
from piezo_ident.operators.dynamics import Dynamics, filter_arx
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import HysteresisLaw

#: poles beyond this radius count as unstable: they would ring for longer than any record
RADIUS = 0.99999
#: parts of the memory at a start (taste: a record tells a few numbers of it)
PARTS = 6
#: least slope of H behind a turning point, share of stroke over range; piezo ceramics have more
#: than a third, and an inverse would jump where it is zero (taste)
LEAST_SLOPE = 0.05
#: largest share of one element of creep: piezo ceramics creep by 1 to 5 % of a step in all
MOST_CREEP = 0.1
#: rms size of a share, of a decay of earlier creep, and of a share of the memory at a start about
#: its first guess, known before
CREEP_SPREAD, DECAY_SPREAD, START_SPREAD = 0.02, 0.02, 0.5
#: step of the finite difference by a share of the memory
STEP = 1e-3
#: maps the slopes of Bernstein to the powers v^2, v^3 and v
_POWERS = np.array([[-1.0, 1.0, 0.0], [1.0 / 3.0, -2.0 / 3.0, 1.0 / 3.0], [1.0, 0.0, 0.0]])
#: the same of a law without v^2, whose middle slope is the first one
_ODD_POWERS = np.array([[-1.0 / 3.0, 1.0 / 3.0], [1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Stage:
    """
    Numbers of a stage, normalised; G has gain one.

    Attributes
    ----------
    law : HysteresisLaw
    coefficients : ndarray, shape (size,)
        Of the law.
    dynamics : Dynamics
        G without its delay; ``Dynamics.unit()`` has no free number.
    delay : int
        [samples]
    offsets : ndarray, shape (records,)
    taus, creep : ndarray, shape (k,)
        Time constants of creep [s] and their shares.
    decays : ndarray, shape (stretches, k)
    starts, guesses : ndarray, shape (stretches, PARTS)
        Shares m of the memory, and what they are drawn to.
    """

    law: HysteresisLaw
    coefficients: Array
    dynamics: Dynamics
    delay: int
    offsets: Array
    taus: Array
    creep: Array
    decays: Array
    starts: Array
    guesses: Array

    @classmethod
    def linear(
        cls,
        law: HysteresisLaw,
        dynamics: Dynamics,
        delay: int,
        guesses: Array,
        records: int,
    ) -> Stage:
        """Return a stage whose H is a straight line with the gain of `dynamics`."""
        c = np.zeros(law.size)
        c[-1] = dynamics.gain
        none = np.empty(0)
        return cls(
            law,
            c,
            dynamics.normalised(),
            delay,
            np.zeros(records),
            none,
            none,
            np.empty((guesses.shape[0], 0)),
            guesses.copy(),
            guesses,
        )

    def with_creep(self, taus: Array) -> Stage:
        """Return the stage with elements of creep that have no share yet."""
        k = taus.size
        return replace(
            self, taus=taus, creep=np.zeros(k), decays=np.zeros((self.starts.shape[0], k))
        )

    def with_law(self, law: HysteresisLaw) -> Stage:
        """Return the stage with a wider law of H on the same thresholds."""
        c = np.zeros(law.size)
        c[self.law.within(law)] = self.coefficients
        return replace(self, law=law, coefficients=c)

    def on_other(self, guesses: Array) -> Stage:
        """Return the stage for other stretches, of which nothing is known yet."""
        decays = np.zeros((guesses.shape[0], self.taus.size))
        return replace(self, starts=guesses.copy(), guesses=guesses, decays=decays)

    @property
    def hysteresis(self) -> Hysteresis:
        """H."""
        return self.law.hysteresis(self.coefficients)

    @property
    def size(self) -> int:
        """Number of parameters that are not zero and no start: what a comparison counts."""
        G = 0 if self.dynamics.is_static else self.dynamics.a.size + self.dynamics.b.size
        return int(np.count_nonzero(self.coefficients)) + G + int(np.count_nonzero(self.creep))

    @property
    def values(self) -> Array:
        """All numbers of the fit, shape (p,)."""
        G = self.dynamics
        return np.concatenate(
            [
                self._sloped(self.coefficients),
                self.creep,
                *(() if G.is_static else (G.a, G.b)),
                self.offsets,
                self.decays.ravel(),
                self.starts.ravel(),
            ]
        )

    @property
    def _powers(self) -> Array:
        return _ODD_POWERS if self.law.name == 'plays' else _POWERS

    def _sloped(self, c: Array) -> Array:
        """Return coefficients of the law with slopes in the place of its powers."""
        T = self._powers
        return np.concatenate([c[: -len(T)], np.linalg.solve(T, c[-len(T) :])])

    def _unsloped(self, values: Array) -> Array:
        T = self._powers
        return np.concatenate([values[: -len(T)], T @ values[-len(T) :]])

    def _parts(self) -> list[slice]:
        """Return the places of c, s, a and b, offsets, decays and starts among the values."""
        G = self.dynamics
        sizes = [
            self.law.size,
            self.creep.size,
            0 if G.is_static else G.a.size + G.b.size,
            self.offsets.size,
            self.decays.size,
            self.starts.size,
        ]
        ends = np.cumsum([0, *sizes])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the values, shapes (p,)."""
        h, creep, *_, starts = self._parts()
        p, n = starts.stop, len(self._powers)
        lower, upper = np.full(p, -np.inf), np.full(p, np.inf)
        lower[h] = self.law.lower
        lower[h.stop - n : h.stop] = LEAST_SLOPE
        lower[creep], upper[creep] = 0.0, MOST_CREEP
        lower[starts], upper[starts] = 0.0, 1.0
        return lower, upper

    @property
    def prior(self) -> tuple[Array, Array]:
        """What the values are drawn to, and the spread of each about it; shapes (p,)."""
        _, creep, _, _, decays, starts = self._parts()
        middle, spread = np.zeros(starts.stop), np.full(starts.stop, np.inf)
        middle[starts], spread[starts] = self.guesses.ravel(), START_SPREAD
        spread[creep], spread[decays] = CREEP_SPREAD, DECAY_SPREAD
        return middle, spread

    def moved(self, values: Array) -> Stage:
        """
        Return the stage with other values.

        ModelError where G is unstable, or its gain is none.
        """
        h, creep, poles, offsets, decays, starts = self._parts()
        lower, upper = self.bounds
        values = np.clip(values, lower, upper)
        c, G = self._unsloped(values[h]), self.dynamics
        if not G.is_static:
            na = G.a.size
            G = Dynamics(values[poles][:na], values[poles][na:])
            if not G.is_within(RADIUS) or not 0.0 < G.gain < np.inf:
                raise ModelError('dynamics: unstable, or without a gain above zero')
            # H holds the gain
            c, G = c * G.gain, G.normalised()
        return replace(
            self,
            coefficients=c,
            creep=values[creep],
            dynamics=G,
            offsets=values[offsets],
            decays=values[decays].reshape(self.decays.shape),
            starts=values[starts].reshape(self.starts.shape),
        )

    def memory(self, stretch: Stretch) -> Array:
        """Return the play outputs before the first sample of a stretch, shape (m,)."""
        return self._memory(stretch, self.starts[stretch.number])

    def _memory(self, stretch: Stretch, shares: Array) -> Array:
        r = self.law.thresholds
        return memory_of(float(stretch.u[0]), float(r[-1]), shares, r)

    def signals(self, stretch: Stretch) -> tuple[Array, Array, Array]:
        """Return h, the delayed w, and y without offset and decays; shapes (n,)."""
        h = self.hysteresis(stretch.u, self.memory(stretch))
        w = delayed(self._crept(h, stretch), self.delay)
        return h, w, filter_arx(self.dynamics.a, self.dynamics.b, w)

    def added(self, stretch: Stretch) -> Array:
        """Return offset and decays of a stretch, shape (n,)."""
        total = np.full(stretch.u.size, self.offsets[stretch.record])
        for tau, left in zip(self.taus, self.decays[stretch.number], strict=True):
            total += left * np.exp(-stretch.times / tau)
        return total

    def _crept(self, h: Array, stretch: Stretch) -> Array:
        seen = [(share, tau) for share, tau in zip(self.creep, self.taus, strict=True) if share]
        return h + sum(share * stretch.lagged(h, tau) for share, tau in seen) if seen else h

    def _behind(self, h: Array, stretch: Stretch) -> Array:
        """Return what creep, delay and G make of a change of h."""
        w = delayed(self._crept(h, stretch), self.delay)
        return filter_arx(self.dynamics.a, self.dynamics.b, w)

    def columns(
        self, stretch: Stretch, signals: tuple[Array, Array, Array]
    ) -> Iterator[Array | None]:
        """Give the derivative of the prediction by each value, shape (n,); None for all zeros."""
        h, w, y = signals
        T, G = self._powers, self.dynamics
        powers = []
        for j, column in enumerate(self.law.columns(stretch.u, self.memory(stretch))):
            behind = self._behind(column, stretch)
            if j < self.law.size - len(T):
                yield behind
            else:
                powers.append(behind)
        for slope in T.T:
            yield np.asarray(slope @ np.array(powers))
        for tau in self.taus:
            lagged = delayed(stretch.lagged(h, tau), self.delay)
            yield filter_arx(G.a, G.b, lagged)
        if not G.is_static:
            one = np.ones(1)
            y_f, w_f = -filter_arx(G.a, one, y), filter_arx(G.a, one, w)
            yield from (delayed(y_f, i) for i in range(1, G.a.size + 1))
            yield from (delayed(w_f, j) for j in range(G.b.size))
        for record in range(self.offsets.size):
            yield np.ones(h.size) if record == stretch.record else None
        for number in range(self.decays.shape[0]):
            for tau in self.taus:
                yield np.exp(-stretch.times / tau) if number == stretch.number else None
        H = self.hysteresis
        for number, shares in enumerate(self.starts):
            for j, share in enumerate(shares):
                if number != stretch.number:
                    yield None
                    continue
                step = STEP if share < 0.5 else -STEP
                other = shares.copy()
                other[j] += step
                change = H(stretch.u, self._memory(stretch, other)) - h
                yield self._behind(change / step, stretch)

    def free(self, values: Array) -> Mask:
        """Return which values are not on a bound, shape (p,)."""
        lower, upper = self.bounds
        return np.asarray((values > lower + 1e-12) & (values < upper - 1e-12))


def memory_of(u0: float, widest: float, shares: Array, thresholds: Array) -> Array:
    """
    Return ``F_r(0) = u0 - int_0^r m(r') dr'`` of thresholds r, shape (m,).

    The shares m are constant on even parts between 0 and the widest threshold.

    Examples
    --------
    >>> memory_of(1.0, 1.0, np.array([0.0, 1.0]), np.array([0.5, 1.0])).tolist()
    [1.0, 0.5]
    """
    edges = np.linspace(0.0, widest, shares.size + 1)
    depth = np.concatenate([[0.0], np.cumsum(shares * np.diff(edges))])
    return np.asarray(u0 - np.interp(thresholds, edges, depth))

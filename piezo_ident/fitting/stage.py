# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
Stage of one axis in a free-run fit: its parameters, its prediction, and the derivatives.

    h = sum_j c_j phi_j[v]                               columns of a law of H
    w = h + sum_k s_k L_k h                              creep, L_k = 1 / (1 + tau_k p)
    y = B(z)/A(z) z^-d w + offset + sum_k s_k l_k exp(-t / tau_k)

The parameters are c, s, a, b and the offset of each record.  Each stretch adds the lags l_k of
creep at its first sample.  Each record adds the memory at its start,

    F_r(0) = v(0) - int_0^r m(r') dr',      0 <= m <= 1,

with m constant on `PARTS` even parts of the thresholds.  A record that begins at rest, at zero,
begins with m = 0 and l = 0, as a simulation does.  Free values would absorb errors of H.  If
`rested` is false, its l is free: a voltage at rest does not exclude creep of earlier motion.

With w_f = z^-d w/A and y_f = y/A the derivatives by b_j and a_i are shifts of two filtered
signals, w_f(k-j+1) and -y_f(k-i): Ljung, System Identification, 2nd ed. (1999), section 10.3.

H rises with the voltage.  Right behind a turning point only its powers of v move.  Their slope is
a quadratic in v.  The fit uses its coefficients in the basis of Bernstein, (1-t)^2, 2t(1-t) and
t^2, where t runs from 0 to 1 over the span of the law.  Each is at least `LEAST_SLOPE`.  With lags
along the path the slope depends on the whole past.  The slope is still linear in c, and is held
above `LEAST_SLOPE` on sweeps between any two of a few voltages.  The gain of G may lower a slope
further when this gain moves into H.  The lowered slope then stays.  A step that had to raise the
slope could increase the loss, and the fit would end at its start.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import functools
import itertools

import numpy as np
from piezo_ident.common.arrays import Array, Mask
from piezo_ident.common.errors import ModelError
from piezo_ident.fitting.stretch import delayed, Stretch
from piezo_ident.operators.dynamics import Dynamics, filter_arx
from piezo_ident.operators.hysteresis import Hysteresis
from piezo_ident.operators.hysteresis_law import HysteresisLaw
from piezo_ident.operators.play import play_columns

#: poles beyond this radius, a decay of 100,000 samples, count as unstable
RADIUS = 0.99999
#: number of parts of the memory at a start (taste: a record tells only a few)
PARTS = 6
#: smallest slope of H behind a turning point, as a share of stroke over range (taste).  Piezo
#: ceramics have more than a third.  An inverse would jump at a slope of zero
LEAST_SLOPE = 0.05
#: largest share of one element of creep: piezo ceramics creep by 1 to 5 % of a step in all
MOST_CREEP = 0.1
#: prior rms of three parameters: an element of creep, a lag of creep as a share of the range, and
#: a share of the memory at a start around its guess
CREEP_SPREAD, LAG_SPREAD, START_SPREAD = 0.02, 0.5, 0.5
#: prior rms of three quantities: the density of H, the change of the density over the range, and
#: the change of the slope behind a turning point over the range.  The even density that makes the
#: whole stroke is 2 (taste: a quarter of it, and a third of the mean slope)
DENSITY_SPREAD, DENSITY_CHANGE, SLOPE_CHANGE = 2.0, 0.5, 0.3
#: step of the finite difference over a share of the memory
STEP = 1e-3


@dataclass(frozen=True, eq=False)
class Stage:
    """
    Parameters of a stage, normalised; G has gain one.

    Attributes
    ----------
    law : HysteresisLaw
    coefficients : ndarray, shape (size,)
        Coefficients of the law.
    dynamics : Dynamics
        G without its delay; ``Dynamics.unit()`` has no free parameter.
    delay : int
        Delay [samples].
    offsets : ndarray, shape (records,)
    taus, creep : ndarray, shape (k,)
        Time constants of creep [s] and their shares.
    lags : ndarray, shape (stretches, k)
        Distance of each element of creep from rest at the first sample.
    resting : ndarray of bool, shape (stretches,)
        Stretches that begin with all creep at rest.
    rested : bool
        Whether creep is at rest at the start of a record whose memory is known.
    starts, guesses : ndarray, shape (records, PARTS)
        Shares m of the memory, and their first guesses in the prior; guesses of zero are known.
    """

    law: HysteresisLaw
    coefficients: Array
    dynamics: Dynamics
    delay: int
    offsets: Array
    taus: Array
    creep: Array
    lags: Array
    resting: Mask
    starts: Array
    guesses: Array
    rested: bool = True

    @classmethod
    def linear(cls, law: HysteresisLaw, dynamics: Dynamics, delay: int, guesses: Array) -> Stage:
        """Make a stage whose H is a straight line with the gain of `dynamics`."""
        c = np.zeros(law.size)
        c[-1] = dynamics.gain
        G, none, offsets = dynamics.normalised(), np.empty(0), np.zeros(guesses.shape[0])
        lags, resting = np.empty((0, 0)), np.empty(0, dtype=bool)
        return cls(law, c, G, delay, offsets, none, none, lags, resting, guesses.copy(), guesses)

    def with_creep(self, taus: Array, stretches: Sequence[Stretch]) -> Stage:
        """Add elements of creep that have no share yet."""
        return replace(self, taus=taus, creep=np.zeros(taus.size)).on_other(stretches)

    def with_law(self, law: HysteresisLaw) -> Stage:
        """Replace the law of H by a wider law on the same thresholds."""
        c = np.zeros(law.size)
        c[self.law.within(law)] = self.coefficients
        return replace(self, law=law, coefficients=c)

    def on_other(self, stretches: Sequence[Stretch]) -> Stage:
        """Move the stage to other stretches of the same records."""
        known = self._known & self.rested
        resting = [bool(known[s.record]) and not s.before.size for s in stretches]
        lags = np.zeros((len(stretches), self.taus.size))
        return replace(self, lags=lags, resting=np.array(resting))

    @property
    def _known(self) -> Mask:
        """Mask of the records whose memory at the start is known, shape (records,)."""
        return np.logical_not(self.guesses.any(axis=1))

    @property
    def hysteresis(self) -> Hysteresis:
        """H."""
        return self.law.hysteresis(self.coefficients)

    @property
    def size(self) -> int:
        """Number of nonzero parameters of H, G and creep, which a comparison counts."""
        G = 0 if self.dynamics.is_static else self.dynamics.a.size + self.dynamics.b.size
        return int(np.count_nonzero(self.coefficients)) + G + int(np.count_nonzero(self.creep))

    @property
    def values(self) -> Array:
        """All parameters of the fit, shape (p,)."""
        G = self.dynamics
        return np.concatenate(
            [
                self._sloped(self.coefficients),
                self.creep,
                *(() if G.is_static else (G.a, G.b)),
                self.offsets,
                self.lags.ravel(),
                self.starts.ravel(),
            ]
        )

    def _sloped(self, c: Array) -> Array:
        """Replace the powers among the coefficients of the law by slopes."""
        T = _powers(self.law)
        return np.concatenate([c[: -len(T)], np.linalg.solve(T, c[-len(T) :])])

    def unsloped(self, values: Array) -> Array:
        """Replace the slopes among values of H by powers, for the coefficients of the law."""
        T = _powers(self.law)
        return np.concatenate([values[: -len(T)], T @ values[-len(T) :]])

    def _parts(self) -> list[slice]:
        """List the places of c, s, a and b, offsets, lags and starts among the values."""
        own = self.dynamics
        G = np.empty(0) if own.is_static else np.append(own.a, own.b)
        parts = self.coefficients, self.creep, G, self.offsets, self.lags, self.starts
        ends = np.cumsum([0, *(part.size for part in parts)])
        return [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]

    @property
    def places(self) -> tuple[slice, slice]:
        """Places of a and b, and of the offsets, among the values."""
        _, _, G, offsets, *_ = self._parts()
        return G, offsets

    @property
    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of the values, shapes (p,)."""
        h, creep, *_, lags, starts = self._parts()
        p, n = starts.stop, len(_powers(self.law))
        lower, upper = np.full(p, -np.inf), np.full(p, np.inf)
        lower[h] = self.law.lower
        slopes = slice(h.stop - n, h.stop)
        lower[slopes] = np.minimum(LEAST_SLOPE, self.values[slopes])
        lower[creep], upper[creep] = 0.0, MOST_CREEP
        lower[lags], upper[lags] = -1.0, 1.0
        lower[starts], upper[starts] = 0.0, 1.0
        for part, known in ((lags, self.resting), (starts, self._known)):
            held = np.repeat(known, (part.stop - part.start) // max(known.size, 1))
            lower[part] = np.where(held, 0.0, lower[part])
            upper[part] = np.where(held, 0.0, upper[part])
        return lower, upper

    @property
    def rising(self) -> tuple[Array, Array] | None:
        """
        Rows, shape (k, size), and their smallest products with a step of H for which H rises.

        A law without lags along the path gives None, because `bounds` suffice.
        """
        if not self.law.lags:
            return None
        rows = _slopes(self.law)
        slopes = rows @ self._sloped(self.coefficients)
        return rows, np.minimum(LEAST_SLOPE, slopes) - slopes

    @property
    def prior(self) -> tuple[Array, Array]:
        """
        Centre of the prior, shape (p,), and its information, shape (p, p).

        The prior counts like one observation with the rms residual of the fit.
        """
        h, creep, _, _, lags, starts = self._parts()
        middle, spread = np.zeros(starts.stop), np.full(starts.stop, np.inf)
        middle[starts], spread[starts] = self.guesses.ravel(), START_SPREAD
        spread[creep], spread[lags] = CREEP_SPREAD, LAG_SPREAD
        information = np.diag(spread**-2.0)
        T = len(_powers(self.law))
        bend = np.diff(np.eye(h.stop)[h.stop - T :], axis=0) / SLOPE_CHANGE
        shape = np.vstack([self.law.roughness(DENSITY_SPREAD, DENSITY_CHANGE), bend])
        information[h, h] = shape.T @ shape
        return middle, information

    def moved(self, values: Array) -> Stage:
        """
        Set other values.

        Raises ModelError if G is unstable, its gain is not positive, or H falls.
        """
        h, creep, poles, offsets, lags, starts = self._parts()
        lower, upper = self.bounds
        values = np.clip(values, lower, upper)
        c, G = self.unsloped(values[h]), self.dynamics
        if not G.is_static:
            na = G.a.size
            G = Dynamics(values[poles][:na], values[poles][na:])
            if not G.is_within(RADIUS) or not 0.0 < G.gain < np.inf:
                raise ModelError('dynamics: unstable, or without a gain above zero')
            # H takes the gain of G
            c, G = c * G.gain, G.normalised()
        if not self.law.hysteresis(c).lowest_slope() > 0.0:
            raise ModelError('hysteresis: H falls under a rising voltage')
        return replace(
            self,
            coefficients=c,
            creep=values[creep],
            dynamics=G,
            offsets=values[offsets],
            lags=values[lags].reshape(self.lags.shape),
            starts=values[starts].reshape(self.starts.shape),
        )

    def memory(self, stretch: Stretch) -> Array:
        """Compute the play outputs before the first sample of a stretch, shape (m,)."""
        return self._memory(stretch, self.starts[stretch.record])

    def _memory(self, stretch: Stretch, shares: Array) -> Array:
        r, before = self.law.thresholds, stretch.before
        if not before.size:
            return memory_of(float(stretch.u[0]), float(r[-1]), shares, r)
        start = memory_of(float(before[0]), float(r[-1]), shares, r)
        return play_columns(before, r, start)[:, -1]

    def signals(self, stretch: Stretch) -> tuple[Array, Array, Array]:
        """Compute h, the delayed w, and y without offset and lags; shapes (n,)."""
        h = self.hysteresis(stretch.u, self.memory(stretch))
        w = delayed(self._crept(h, stretch), self.delay)
        return h, w, filter_arx(self.dynamics.a, self.dynamics.b, w)

    def added(self, stretch: Stretch) -> Array:
        """Compute offset and lags of a stretch, shape (n,)."""
        total = np.full(stretch.u.size, self.offsets[stretch.record])
        for share, tau, lag in self._unrest(stretch):
            total += share * lag * np.exp(-stretch.times / tau)
        return total

    def _unrest(self, stretch: Stretch) -> list[tuple[float, float, float]]:
        """List share, time constant and lag of each element of creep of a stretch."""
        if not self.taus.size:
            return []
        return list(zip(self.creep, self.taus, self.lags[stretch.number], strict=True))

    def _crept(self, h: Array, stretch: Stretch) -> Array:
        seen = [(share, tau) for share, tau in zip(self.creep, self.taus, strict=True) if share]
        return h + sum(share * stretch.lagged(h, tau) for share, tau in seen) if seen else h

    def _behind(self, h: Array, stretch: Stretch) -> Array:
        """Pass a change of h through creep, delay and G."""
        w = delayed(self._crept(h, stretch), self.delay)
        return filter_arx(self.dynamics.a, self.dynamics.b, w)

    def columns(
        self, stretch: Stretch, signals: tuple[Array, Array, Array]
    ) -> Iterator[Array | None]:
        """Yield the derivative of the prediction by each value, shape (n,); None if it is zero."""
        h, w, y = signals
        T, G = _powers(self.law), self.dynamics
        powers = []
        for j, column in enumerate(self.law.columns(stretch.u, self.memory(stretch))):
            behind = self._behind(column, stretch)
            if j < self.law.size - len(T):
                yield behind
            else:
                powers.append(behind)
        for slope in T.T:
            yield np.asarray(slope @ np.array(powers))
        for _, tau, lag in self._unrest(stretch):
            behind = filter_arx(G.a, G.b, delayed(stretch.lagged(h, tau), self.delay))
            yield behind + lag * np.exp(-stretch.times / tau) if lag else behind
        if not G.is_static:
            one = np.ones(1)
            y_f, w_f = -filter_arx(G.a, one, y), filter_arx(G.a, one, w)
            yield from (delayed(y_f, i) for i in range(1, G.a.size + 1))
            yield from (delayed(w_f, j) for j in range(G.b.size))
        for record in range(self.offsets.size):
            yield np.ones(h.size) if record == stretch.record else None
        for number in range(self.lags.shape[0]):
            for share, tau, _ in self._unrest(stretch):
                seen = number == stretch.number and share > 0.0 and not self.resting[number]
                yield share * np.exp(-stretch.times / tau) if seen else None
        H, known = self.hysteresis, self._known
        for record, shares in enumerate(self.starts):
            for j, share in enumerate(shares):
                if record != stretch.record or known[record]:
                    yield None
                    continue
                step = STEP if share < 0.5 else -STEP
                other = shares.copy()
                other[j] += step
                change = H(stretch.u, self._memory(stretch, other)) - h
                yield self._behind(change / step, stretch)

    def free(self, values: Array) -> Mask:
        """Mark the values that are not on a bound, shape (p,)."""
        lower, upper = self.bounds
        return np.asarray((values > lower + 1e-12) & (values < upper - 1e-12))


@functools.lru_cache(maxsize=8)
def _powers(law: HysteresisLaw) -> Array:
    """Map slopes to the powers v^2, v^3 and v, or v^3 and v, of a law; shape (3, 3) or (2, 2)."""
    low, high = law.span
    if law.name == 'plays':
        # the slope is smallest or largest at zero and at the largest |v|
        widest = 3.0 * max(-low, high) ** 2
        return np.array([[-1.0 / widest, 1.0 / widest], [1.0, 0.0]])
    # slopes of v^2, v^3 and v as Bernstein coefficients over the span
    pairs = ((low, low), (low, high), (high, high))
    return np.asarray(np.linalg.inv([[a + b, 3.0 * a * b, 1.0] for a, b in pairs]))


@functools.lru_cache(maxsize=8)
def _slopes(law: HysteresisLaw) -> Array:
    """Compute the slopes of H on sweeps by each value of H in a fit; shape (k, size)."""
    T = _powers(law)
    return np.hstack([law.slopes[:, : -len(T)], law.slopes[:, -len(T) :] @ T])


def memory_of(u0: float, widest: float, shares: Array, thresholds: Array) -> Array:
    """
    Compute ``F_r(0) = u0 - int_0^r m(r') dr'`` of thresholds r, shape (m,).

    The shares m are constant on even parts between 0 and the widest threshold.

    Examples
    --------
    >>> memory_of(1.0, 1.0, np.array([0.0, 1.0]), np.array([0.5, 1.0])).tolist()
    [1.0, 0.5]
    """
    edges = np.linspace(0.0, widest, shares.size + 1)
    depth = np.concatenate([[0.0], np.cumsum(shares * np.diff(edges))])
    return np.asarray(u0 - np.interp(thresholds, edges, depth))

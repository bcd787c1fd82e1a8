# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
H: a polynomial and functions of play operators, with their memory.

    w = p1 v^3 + p2 v + sum_i q_i F_ri[v],        q_i >= 0                           (eqs. 3, 6)

of Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868, in normalised units.  A wider H adds

    p0 v^2 + sum_i (c_i1 t_i^2 + c_i2 t_i^3 + c_i3 t_i^4) + sum_i kappa_i (v - low) (F_ri[v] - low)

over a span low .. high of v, with ``t_i = F_ri[v] - low`` held in 0 .. ``high - low - r_i``.  A
sum of functions of play outputs is a Preisach operator.  Its density over threshold and output is
the derivative of these functions: Brokate and Sprekels, "Hysteresis and Phase Transitions", 1996,
sections 2.3 to 2.5, doi:10.1007/978-1-4612-4048-8.  Plays weighted by the voltage (kappa) are no
Preisach operator.  The memory of all these terms is the play outputs.

A semilinear Duhem model adds ``sum_j z_j - phi_j(v)`` with ``dz_j = a_j |dv| (phi_j(v) - z_j)``
and cubic phi_j.  A lag z_j decays along the path of v, at any speed, and has no return point
memory.  J. Oh and D. S. Bernstein, "Semilinear Duhem model for rate-independent and
rate-dependent hysteresis", IEEE Trans. Automatic Control 50(5), 2005,
doi:10.1109/TAC.2005.847035; Bouc-Wen and Coleman-Hodgdon loops are of this kind.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import functools
import itertools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from piezo_ident.common.arrays import Array, frozen_array
from piezo_ident.common.errors import ModelError
from piezo_ident.operators.chain import Block
from piezo_ident.operators.kernels import hysteresis, relaxing, wide_hysteresis
from piezo_ident.operators.play import initial_memory

#: number of powers t^2 .. t^4 in the curve of a play
POWERS = 3
#: number of plays that run side by side in vector lanes; plays without weight fill the last group
LANES = 8
#: largest negative density that counts as rounding, as a share of the largest density
ROUNDING = 1e-9
#: threshold [spans] below which a play is a line, F = v: no converter makes so small a step
LINE = 1e-9


@dataclass(frozen=True, eq=False)
class Hysteresis:
    """
    Parameters of H, in normalised units; a weight at threshold 0 joins `p2`, as ``F_0[v] = v``.

    Parameters
    ----------
    thresholds, weights : array_like, shape (m,)
        Thresholds r_i > 0, ascending, and weights q_i >= 0.
    p1, p2 : float
        Cubic and linear coefficient.
    p0 : float, optional
        Square coefficient.
    curves : array_like, shape (m, 1) to (m, 3), optional
        Coefficients c_i1 .. of t_i^2 .. of each play; the density ``q_i + 2 c_i1 t + ...`` must
        not be negative.
    bias : array_like, shape (m,), optional
        Growth kappa_i of the weight of a play with the voltage.
    span : tuple of float, optional
        Voltages low and high between which curves and bias hold; a curve is flat beyond them.
    relaxations : array_like, shape (k, 4), optional
        Rate a_j of each lag along the path, and the coefficients of v, v^2 and v^3 of its phi_j.

    Raises
    ------
    ModelError
        For different lengths, a weight or density < 0, or thresholds < 0 or not ascending.

    Examples
    --------
    >>> h = Hysteresis([0.5], [1.0], 0.0, 1.0, curves=[[0.5]])
    >>> h([0.0, 1.0, 0.5]).tolist()
    [0.0, 1.625, 1.125]
    """

    thresholds: Array
    weights: Array
    p1: float
    p2: float
    p0: float = 0.0
    curves: Array | None = None
    bias: Array | None = None
    span: tuple[float, float] = (0.0, 1.0)
    relaxations: Array | None = None

    def __post_init__(self) -> None:
        r, q = frozen_array(self.thresholds), frozen_array(self.weights)
        if r.ndim != 1 or r.shape != q.shape:
            raise ModelError(
                f'hysteresis: thresholds of shape {r.shape}, weights of shape {q.shape}; give two '
                'lists of one length'
            )
        if not (np.isfinite(r).all() and np.isfinite(q).all() and (q >= 0).all()):
            bad = {'thresholds': ~np.isfinite(r), 'weights': ~(np.isfinite(q) & (q >= 0))}
            each = [f'{name}[{i}]' for name, x in bad.items() for i in np.flatnonzero(x)]
            raise ModelError(
                f'hysteresis: {", ".join(each[:8])} must be finite, and weights not negative'
            )
        if np.any(r < 0) or np.any(np.diff(r) <= 0):
            i = int(np.argmax((r < 0) | (np.diff(r, prepend=-np.inf) <= 0)))
            raise ModelError(
                f'hysteresis: thresholds[{i}] = {r[i]:g} is negative, or not above the one before'
            )
        p2 = float(self.p2)
        if r.size and r[0] == 0.0:
            if self.curves is not None or self.bias is not None:
                raise ModelError('hysteresis: with curves or bias, thresholds must be positive')
            p2 += float(q[0])
            r, q = frozen_array(r[1:].copy()), frozen_array(q[1:].copy())
        if not (np.isfinite(self.p1) and np.isfinite(p2) and np.isfinite(self.p0)):
            raise ModelError(
                f'hysteresis: p0 = {self.p0:g}, p1 = {self.p1:g} and p2 = {p2:g} must be finite'
            )
        powers = {'p0': float(self.p0), 'p1': float(self.p1), 'p2': p2}
        for name, value in {'thresholds': r, 'weights': q, **powers}.items():
            object.__setattr__(self, name, value)
        if self.relaxations is not None:
            x = frozen_array(self.relaxations)
            if x.ndim != 2 or x.shape[1] != 4 or not np.isfinite(x).all() or (x[:, 0] <= 0).any():
                raise ModelError(
                    'hysteresis: relaxations must be rows of a rate > 0 and three coefficients'
                )
            object.__setattr__(self, 'relaxations', x)
        if self.curves is not None or self.bias is not None:
            self._check_wide(r, q)

    def _check_wide(self, r: Array, q: Array) -> None:
        """Check span, curves and bias, and freeze them."""
        low, high = map(float, self.span)
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise ModelError('hysteresis: span must be [lowest, highest] voltage')
        object.__setattr__(self, 'span', (low, high))
        for name, shape in (('curves', (r.size, POWERS)), ('bias', (r.size,))):
            if getattr(self, name) is None:
                continue
            values = frozen_array(getattr(self, name))
            fits = values.ndim == len(shape) and values.shape[0] == r.size
            if r.size and not (fits and 0 < values.shape[-1] <= max(shape[-1], 1)):
                each = '1 to 3 numbers' if name == 'curves' else 'one number'
                raise ModelError(
                    f'hysteresis: {name} of shape {values.shape} for {r.size} thresholds; give '
                    f'{each} each'
                )
            if not np.all(np.isfinite(values)):
                raise ModelError(f'hysteresis: {name} must be finite numbers')
            object.__setattr__(self, name, values)
        places = np.linspace(0.0, 1.0, 33)[:, None]
        rises = self.rise(low + places * self._wide[4], low + places * (high - low))
        least = float(np.min(rises, initial=0.0))
        if least < -ROUNDING * max(1.0, float(q.max(initial=0.0))):
            raise ModelError(
                'hysteresis: curves and bias must not make the weight of a play negative'
            )

    @property
    def is_plain(self) -> bool:
        """Whether H is only a cubic and a sum of plays."""
        return not self._is_curved and self.relaxations is None

    @property
    def _is_curved(self) -> bool:
        return self.p0 != 0.0 or self.curves is not None or self.bias is not None

    @functools.cached_property
    def _wide(self) -> Array:
        """Rows c_1 .. c_3, kappa and widths of `wide_hysteresis`; no rows if H has no curves."""
        m, low, high = self.thresholds.size, *self.span
        if not self._is_curved:
            return np.empty((0, m))
        rows = np.zeros((POWERS + 2, m))
        if self.curves is not None and m:
            rows[: self.curves.shape[1]] = self.curves.T
        if self.bias is not None:
            rows[POWERS] = self.bias
        rows[-1] = np.maximum(high - low - self.thresholds, 0.0)
        return rows

    @functools.cached_property
    def for_kernel(self) -> tuple[Array, Array, float, float, float, float, Array]:
        """Arguments ``r, q, p1, p2, p0, low, c`` of the kernels, with idle plays in free lanes."""
        m = self.thresholds.size
        # a frozen array would be another type to the compiler
        rows = np.zeros((2 + len(self._wide), m + -m % LANES))
        rows[:2, :m], rows[2:, :m] = (self.thresholds, self.weights), self._wide
        return rows[0], rows[1], self.p1, self.p2, self.p0, self.span[0], rows[2:]

    def rise(self, outputs: ArrayLike, v: Array | float = 0.0) -> Array:
        """Compute dw/dF_i of plays at their outputs, shapes (..., m); only a bias depends on v."""
        if not self._is_curved:
            return self.weights
        c1, c2, c3, bias, width = self._wide
        t = np.asarray(outputs, dtype=np.float64) - self.span[0]
        curved = t * (2.0 * c1 + t * (3.0 * c2 + t * 4.0 * c3))
        inside = (t >= 0.0) & (t <= width)
        return np.asarray(self.weights + bias * (v - self.span[0]) + np.where(inside, curved, 0.0))

    def lowest_slope(self) -> float:
        """Compute a lower bound of dw/dv over the span; H has an inverse if it is positive."""
        return self.flattest[0]

    @functools.cached_property
    def flattest(self) -> tuple[float, float]:
        """Lower bound of dw/dv over the span, and the voltage at which it occurs."""
        places, slope = self.slopes(sweeps=self.relaxations is not None)
        k = int(np.argmin(slope))
        return float(slope[k]), float(places[k])

    def slopes(self, sweeps: bool) -> tuple[Array, Array]:
        """
        Compute voltages over the span, and dw/dv right after a turn at each; shapes (k,).

        `sweeps` adds slopes between any two of nine voltages: lags along the path need them.
        """
        low, high = self.span
        places = np.linspace(low, high, 129)
        slope = self.slope_at_turns(places)
        if sweeps:
            # a frozen array would be another type to the compiler
            v = np.array(_sweeps(low, high))
            places = np.append(places, v[1:])
            slope = np.append(slope, np.diff(self(v)) / np.diff(v))
        return places, slope

    def slope_at_turns(self, v: Array) -> Array:
        """
        Bound dw/dv from below right after a turn of the voltage, where plays stand; shapes (n,).

        Plays that are lines move even there.  The lags z_j count as constant.
        """
        slope = self.p2 + (2.0 * self.p0 + 3.0 * self.p1 * v) * v
        low, high = self.span
        r = self.thresholds
        lines = r < LINE * (high - low)
        if lines.any():
            # slightly below the voltage, as a curve is flat beyond its width
            slope = slope + [float(self.rise(x - 2.0 * r, x)[lines].sum()) for x in v]
        if self.bias is not None:
            # a play may stand anywhere in its band
            down, up = np.minimum(self.bias, 0.0), np.maximum(self.bias, 0.0)
            least = np.maximum(v[:, None] - low - r, 0.0)
            most = np.minimum(v[:, None] - low, self._wide[4])
            slope = slope + least @ up + most @ down
        if self.relaxations is not None:
            d1, d2, d3 = self.relaxations[:, 1:].sum(axis=0)
            slope = slope - (d1 + (2.0 * d2 + 3.0 * d3 * v) * v)
        return np.asarray(slope)

    def with_lines(self, count: int) -> Hysteresis:
        """Replace the `count` narrowest plays by lines, each with the stroke of its play."""
        low, high = self.span
        r, share = self.thresholds.copy(), np.ones(self.thresholds.size)
        r[:count] *= 0.5 * LINE * (high - low) / r[max(count, 1) - 1]
        # a line moves over the whole span, a play over the span minus its threshold
        share[:count] = (high - low - self.thresholds[:count]) / (high - low - r[:count])
        curves, bias = self.curves, self.bias
        if curves is not None:
            curves = curves * share[:, None] ** np.arange(2, 2 + curves.shape[1])
        if bias is not None:
            bias = bias * share
        return replace(self, thresholds=r, weights=self.weights * share, curves=curves, bias=bias)

    def without_idle(self, nothing: float = 0.0) -> Hysteresis:
        """Drop the plays whose weight nowhere exceeds `nothing`."""
        low, high = self.span
        ends = (self.rise(np.full(self.thresholds.size, low), v) for v in (low, high))
        alive = np.maximum(*ends) > nothing
        if self.curves is not None:
            alive |= np.abs(self.curves).max(axis=1, initial=0.0) > nothing
        names = ('thresholds', 'weights', 'curves', 'bias')
        own: dict[str, Any] = {k: x for k in names if (x := getattr(self, k)) is not None}
        return replace(self, **{name: x[alive] for name, x in own.items()})

    def scaled(self, gain: float) -> Hysteresis:
        """Multiply H by a gain >= 0."""
        scaled: dict[str, Any] = {'p0': gain * self.p0, 'p1': gain * self.p1, 'p2': gain * self.p2}
        for name in ('weights', 'curves', 'bias', 'relaxations'):
            if (values := getattr(self, name)) is not None:
                scaled[name] = gain * values
        if self.relaxations is not None:
            scaled['relaxations'][:, 0] = self.relaxations[:, 0]
        return replace(self, **scaled)

    @property
    def numbers(self) -> Array:
        """All parameters in a row: r, q, p0, p1, p2, curves, bias and widths, then lags."""
        polynomial = np.array([self.p0, self.p1, self.p2])
        parts = [self.thresholds, self.weights, polynomial, self._wide.ravel()]
        if self.relaxations is not None:
            parts.append(self.relaxations.ravel())
        return np.concatenate(parts)

    def initial_memory(self, v0: float) -> Array:
        """Compute the play outputs at `v0` of a stage that last came down to zero."""
        return initial_memory(v0, self.thresholds)

    def __call__(self, v: ArrayLike, memory: ArrayLike | None = None) -> Array:
        """Compute w for a normalised v, shapes (n,), from a memory as in `follow`."""
        x = np.asarray(v, dtype=np.float64)
        start = self.initial_memory(float(x[0])) if memory is None else np.asarray(memory, float)
        return self.follow(x, start)[0]

    @functools.cached_property
    def lag_range(self) -> Array:
        """Smallest and largest phi_j over the span, which bound a lag; shape (2, k)."""
        if self.relaxations is None:
            return np.empty((2, 0))
        v = np.linspace(*self.span, 65)
        phi = self.relaxations[:, 1:] @ np.array([v, v**2, v**3])
        return np.array([phi.min(axis=1), phi.max(axis=1)])

    def settled(self, v0: float) -> Array:
        """
        Compute the lags along the path of a stage that was swept, came down, and went to `v0`.

        The sweeps cover the span.  The result, shape (k + 1,), holds the lags and then `v0`, as
        `follow` expects them.  The plays of `initial_memory` last came down, too.
        """
        if self.relaxations is None:
            return np.array([v0])
        low, high = self.span
        phi = self.relaxations[:, 1:] @ np.array([low, low * low, low**3])
        lags, way = np.append(phi, low), np.array([high, low, high, low, v0])
        relaxing(way, np.array(self.relaxations), lags, np.zeros(way.size))
        return lags

    def follow(self, v: Array, memory: Array) -> tuple[Array, Array]:
        """
        Compute w for the next inputs, shape (n,), and the memory after them.

        The memory holds the play outputs, shape (m,), the lags along the path and the last input.
        Missing lags begin as `settled` at the first input, which replaces a missing last input.
        """
        x, m = np.ascontiguousarray(v), self.thresholds.size
        out, end = np.empty(x.size), np.zeros(self.for_kernel[0].size)
        end[:m] = memory[:m]
        if self._is_curved:
            wide_hysteresis(x, *self.for_kernel, end, out)
        else:
            hysteresis(x, *self.for_kernel[:4], end, out)
        end = end[:m]
        if self.relaxations is None:
            return out, end
        if not x.size:
            return out, memory
        lags = memory[m:].copy() if memory.size > m else self.settled(float(x[0]))
        if lags.size == len(self.relaxations):
            lags = np.append(lags, x[0])
        relaxing(x, np.array(self.relaxations), lags, out)
        return out, np.concatenate([end, lags])


@functools.lru_cache(maxsize=8)
def _sweeps(low: float, high: float) -> Array:
    """Compute voltages that sweep between any two of nine voltages of a span."""
    levels = np.linspace(low, high, 9)
    ends = [e for a in levels for b in levels if b > a for e in (low, high, a, b, a, high)]
    legs = [np.linspace(a, b, 33)[1:] for a, b in itertools.pairwise(ends) if a != b]
    return frozen_array(np.concatenate(legs))


class HysteresisOperator:
    """H as an operator with its memory."""

    def __init__(self, hysteresis: Hysteresis, memory: ArrayLike | None = None) -> None:
        self.hysteresis = hysteresis
        self._start = None if memory is None else np.array(memory, np.float64)
        m, k = hysteresis.thresholds.size, hysteresis.lag_range.shape[1]
        sizes = {m, m + k, m + k + 1} if k else {m}
        if self._start is not None and (self._start.ndim != 1 or self._start.size not in sizes):
            also = f', and behind them the value of each of {k} lags' if k else ''
            raise ModelError(
                f'hysteresis: {self._start.size} play outputs at the start for {m} thresholds; '
                f'give one each{also}'
            )
        self.memory = hysteresis.initial_memory(0.0)

    def reset(self, v0: float, x0: float) -> float:
        """Take the memory of the constructor, or of a stage that last came down to zero."""
        start = self.hysteresis.initial_memory(x0) if self._start is None else self._start
        w, self.memory = self.hysteresis.follow(np.array([x0]), start)
        return float(w[0])

    def process(self, block: Block) -> Block:
        """Apply H to the signal of the next block."""
        w, self.memory = self.hysteresis.follow(block.x, self.memory)
        return block.with_signal(w)

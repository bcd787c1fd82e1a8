# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""
G and z^-d: the linear dynamics and the pure delay, as parameters and as operators.

    y(k) = - sum_{i=1..na} a_i y(k-i) + sum_{j=1..nb} b_j w(k-d-j+1)                    (eqs. 4-5)

of Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from piezo_ident.common.arrays import Array, frozen_array
from piezo_ident.common.errors import ModelError
from piezo_ident.common.kernel import kernel
from piezo_ident.operators.chain import Block
from piezo_ident.operators.kernels import dynamics as run_dynamics
from piezo_ident.operators.sections import run_sections, sections_at_rest, sections_of

#: longest pure delay of a model [samples]
MAX_DELAY = 1_000_000
#: upper limit of `Dynamics.memory` [samples], longer than any record
MAX_MEMORY = 2**40


@dataclass(frozen=True)
class Mode:
    """Oscillating pair of poles: natural frequency [Hz], damping ratio, standard deviations."""

    frequency: float
    frequency_std: float
    damping: float
    damping_std: float


@dataclass(frozen=True, eq=False)
class Dynamics:
    """
    Rational part of G: ``A(z) = 1 + a_1 z^-1 + ...`` and ``B(z) = b_1 + b_2 z^-1 + ...``.

    a and b, shapes (na,) and (nb,), are a_1 .. a_na and b_1 .. b_nb.  Raises ModelError if a
    coefficient is not finite, or b is empty.
    """

    a: Array
    b: Array

    def __post_init__(self) -> None:
        a, b = frozen_array(self.a), frozen_array(self.b)
        if a.ndim != 1 or b.ndim != 1 or b.size == 0:
            raise ModelError('dynamics: a and b are lists, and b has at least one number')
        if not (np.all(np.isfinite(a)) and np.all(np.isfinite(b))):
            raise ModelError('dynamics: a and b must be finite numbers')
        object.__setattr__(self, 'a', a)
        object.__setattr__(self, 'b', b)

    @classmethod
    def unit(cls) -> Dynamics:
        """Make G = 1."""
        return cls(a=np.empty(0), b=np.ones(1))

    @property
    def is_static(self) -> bool:
        """Whether G is a gain alone."""
        return self.a.size == 0 and self.b.size == 1

    @property
    def gain(self) -> float:
        """Static gain G(1); infinite for an integrator."""
        return _static_gain(self.b, self.a)

    @cached_property
    def sections(self) -> Array | None:
        """Second-order sections, shape (n, 5), if eq. (5) would lose digits; else None."""
        return sections_of(self.a, self.b, self.gain)

    @property
    def poles(self) -> NDArray[np.complex128]:
        """Poles of G in the z plane."""
        return np.asarray(np.roots(np.concatenate([[1.0], self.a])), dtype=np.complex128)

    @property
    def radius(self) -> float:
        """Largest magnitude of a pole; 0 without poles."""
        return float(np.abs(self.poles).max(initial=0.0))

    @property
    def is_stable(self) -> bool:
        """Whether every pole lies inside the unit circle."""
        return self.is_within(1.0)

    def is_within(self, radius: float) -> bool:
        """Tell whether every pole is smaller than a radius, without computing the poles."""
        return _is_stable(self.a / radius ** np.arange(1, self.a.size + 1))

    def memory(self, share: float) -> int:
        """Count the samples in which the slowest pole decays to a share of its start."""
        radius = self.radius
        if radius >= 1.0:
            return MAX_MEMORY
        if radius < share:
            return self.b.size
        return min(MAX_MEMORY, self.b.size + int(np.log(share) / np.log(radius)))

    def normalised(self) -> Dynamics:
        """Scale G to G(1) = 1; raises ModelError for a gain of zero or infinity."""
        gain = self.gain
        if not np.isfinite(gain) or gain == 0.0:
            raise ModelError(f'dynamics: static gain {gain} cannot be scaled to one')
        return Dynamics(a=self.a, b=self.b / gain)

    def without_slow_poles(self, slowest: float, sample_rate: float) -> Dynamics:
        """
        Remove real poles below a frequency [Hz], each with the nearest real zero.

        The gain at ten times that frequency stays.  Dynamics without such poles, or with too few
        real zeros, stay unchanged.
        """
        radius = np.exp(-2.0 * np.pi * slowest / sample_rate)
        poles, zeros = self.poles, np.roots(self.b)
        slow = (poles.imag == 0.0) & (poles.real > radius)
        if not slow.any() or zeros.size < slow.sum():
            return self
        for pole in poles[slow]:
            # complex zeros come in pairs; only a real zero may be removed alone
            real = np.flatnonzero(np.abs(zeros.imag) == 0.0)
            if not real.size:
                return self
            zeros = np.delete(zeros, real[np.argmin(np.abs(zeros[real] - pole))])
        a = np.atleast_1d(np.real(np.poly(poles[~slow])))[1:]
        faster = Dynamics(a=a, b=np.atleast_1d(np.real(np.poly(zeros))))
        before, after = (g.response([10.0 * slowest], sample_rate)[0] for g in (self, faster))
        gain = abs(before) / abs(after) * np.sign(np.real(before / after))
        return Dynamics(a=faster.a, b=faster.b * float(gain))

    def response(self, frequency: ArrayLike, sample_rate: float) -> NDArray[np.complex128]:
        """Compute the complex frequency response at frequencies [Hz], shape (n,)."""
        z = np.exp(-2j * np.pi * np.asarray(frequency, dtype=np.float64) / sample_rate)
        denominator = np.polyval(np.concatenate([[1.0], self.a])[::-1], z)
        return np.asarray(np.polyval(self.b[::-1], z) / denominator, dtype=np.complex128)

    def modes(self, sample_rate: float, covariance: Array | None = None) -> list[Mode]:
        """
        List the oscillating pairs of poles as modes, sorted by frequency.

        A covariance of (a, b) gives their standard deviations, which are NaN otherwise.  To first
        order, a change of a_i moves a pole p by ``-p^(na-i) / A'(p)``.
        """
        na = self.a.size
        block = np.full((na, na), math.nan)
        if covariance is not None and covariance.shape[0] >= na:
            block = covariance[:na, :na]
        slope = np.polyder(np.concatenate([[1.0], self.a])) if na else np.zeros(1)
        rate = sample_rate / (2.0 * math.pi)
        modes = []
        for pole in self.poles[self.poles.imag > 0.0]:
            s = np.log(pole)
            ds = -(pole ** np.arange(na - 1, -1, -1)) / np.polyval(slope, pole) / pole
            size = abs(s)
            d_size = np.real(np.conj(s) * ds) / size
            d_damping = -ds.real / size + s.real * d_size / size**2
            std = [float(np.sqrt(np.maximum(d @ block @ d, 0.0))) for d in (d_size, d_damping)]
            modes.append(Mode(float(rate * size), rate * std[0], float(-s.real / size), std[1]))
        return sorted(modes, key=lambda mode: mode.frequency)


def filter_arx(a: Array, b: Array, x: Array, at_rest: bool = True) -> Array:
    """Filter x by B(z)/A(z), shape (n,), from equilibrium with its first sample or from zero."""
    past_w, past_y = b.size - 1, a.size
    w, y = np.empty(past_w + x.size), np.empty(past_y + x.size)
    w[past_w:] = x
    w[:past_w] = x[0] if at_rest else 0.0
    y[:past_y] = x[0] * _static_gain(b, a) if at_rest else 0.0
    run_dynamics(w, b[::-1].copy(), a[::-1].copy(), y)
    return y[past_y:]


@kernel
def _is_stable(a: Array) -> bool:
    # Schur-Cohn test: all roots of A lie inside the unit circle if and only if the last
    # coefficient is smaller than one, and the polynomial of the next lower order passes
    a = a.copy()
    for n in range(a.size, 0, -1):
        last = a[n - 1]
        if not abs(last) < 1.0:
            return False
        share = 1.0 / (1.0 - last * last)
        for i in range(n // 2):
            k = n - 2 - i
            a[i], a[k] = share * (a[i] - last * a[k]), share * (a[k] - last * a[i])
    return True


def _static_gain(b: Array, a: Array) -> float:
    denominator = 1.0 + float(a.sum())
    return float(b.sum()) / denominator if denominator != 0.0 else math.inf


class DynamicsOperator:
    """
    G as an operator, with coefficients b and a from the oldest sample to the newest.

    `change` has the meaning of `piezo_ident.effects.effect.Effect.change`.
    """

    change = 'linear'

    def __init__(self, dynamics: Dynamics) -> None:
        self.dynamics = dynamics
        self.b, self.a = dynamics.b[::-1].copy(), dynamics.a[::-1].copy()
        self._past_w, self._past_y = np.zeros(self.b.size - 1), np.zeros(self.a.size)
        self._sections = dynamics.sections
        self._z = np.zeros((0 if self._sections is None else len(self._sections), 2))

    def reset(self, v0: float, x0: float) -> float:
        """Come to equilibrium with a constant signal."""
        if self._sections is not None:
            self._z, rest = sections_at_rest(self._sections, x0)
            return rest
        rest = x0 * self.dynamics.gain
        self._past_w[:], self._past_y[:] = x0, rest
        return rest

    def process(self, block: Block) -> Block:
        """Filter the next block."""
        n, na = block.x.size, self.a.size
        if self._sections is not None:
            out = np.empty(n)
            run_sections(np.ascontiguousarray(block.x), self._sections, self._z, out)
            return block.with_signal(out)
        w = np.concatenate([self._past_w, block.x])
        y = np.empty(na + n)
        y[:na] = self._past_y
        run_dynamics(w, self.b, self.a, y)
        self._past_w, self._past_y = w[n:].copy(), y[n:].copy()
        return block.with_signal(y[na:])


@dataclass(frozen=True)
class Delay:
    """Pure delay: whole samples d >= 0, and a fraction 0 <= f < 1 by linear interpolation."""

    samples: int
    fraction: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.samples <= MAX_DELAY or int(self.samples) != self.samples:
            raise ModelError(
                f'delay: samples must be a whole number, 0 to {MAX_DELAY}, got {self.samples}'
            )
        if not 0.0 <= self.fraction < 1.0:
            raise ModelError(f'delay: fraction must be in [0, 1), got {self.fraction}')

    @property
    def total(self) -> float:
        """Delay in samples, including its fraction."""
        return self.samples + self.fraction

    def apply(self, x: Array) -> Array:
        """Delay a signal that was constant before its first sample; shape (n,)."""
        operator = DelayOperator(self)
        operator.reset(0.0, float(x[0]))
        return operator.shift(x)


class DelayOperator:
    """z^-d as an operator."""

    change = 'linear'

    def __init__(self, delay: Delay) -> None:
        self.delay = delay
        self._past = np.zeros(delay.samples + 1)

    def reset(self, v0: float, x0: float) -> float:
        """Fill the buffer with a constant signal."""
        self._past = np.full(self.delay.samples + 1, x0)
        return x0

    def process(self, block: Block) -> Block:
        """Delay the next block."""
        return block.with_signal(self.shift(block.x))

    def shift(self, x: Array) -> Array:
        """Delay the next samples of a signal; shape (n,)."""
        if self.delay.total == 0.0:
            return x
        line = np.concatenate([self._past, x])
        # a copy, because a view would keep every past block in memory
        self._past = line[x.size :].copy()
        f = self.delay.fraction
        if f == 0.0:
            return line[1 : 1 + x.size]
        return np.asarray((1.0 - f) * line[1 : 1 + x.size] + f * line[: x.size])

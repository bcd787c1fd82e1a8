# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Rate dependence: the loops widen with speed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import STILL
from piezo_ident.effects.effect import Effect, NAN, Parameter, Trial, View
from piezo_ident.effects.moving_plays import (
    growth_of_plays,
    growth_slopes,
    moved_play,
    moved_plays_apart,
    speed_of,
)
from piezo_ident.operators.c_code import CCode, Numbers, read_c
from piezo_ident.operators.chain import Block
from piezo_ident.operators.hysteresis import Hysteresis, HysteresisOperator, LANES
from piezo_ident.operators.parts import (
    columns_of_parts,
    has_curves_alone,
    in_groups,
    is_single_play,
    Part,
    SIDE_BY_SIDE,
    weights_of,
)

#: relative step of the cutoff, for the derivative of the power by the cutoff
NEAR = 1e-5
#: parameters that scale the growth, and parameters that shape it, in the order of the kernels
AMPLITUDES = ('gain', 'stretch', 'lead', 'lead_stretch')
SHAPE = ('exponent', 'levelling', 'cutoff')
#: the slope of the power below this speed is taken at this speed [spans/s]
SLOW = 1e-3


class RateDependentHysteresis(Effect):
    """
    Prandtl-Ishlinskii plays whose thresholds grow with the speed of the input.

    ``r_i(k) = r_i (1 + sigma |s(k)|^eps) + beta |s(k)|^eps`` for every play of H, never below
    zero.  ``s`` is the speed of the input behind a first-order low-pass.  beta widens all plays by
    the same amount, sigma each play in proportion to its threshold.  The band of a play of H
    reaches from v - r to v.  Its upper edge may also move, to
    ``v + (lambda_0 + lambda_1 r_i) |s(k)|^eps``; a band that widens evenly to both sides is a
    special case.  A `levelling` c replaces ``|s|`` by ``|s| / (1 + c |s|)``, so that the growth
    levels off.  The speed is filtered before its magnitude is taken: converter steps and noise
    then cancel instead of adding up.  Weights, p1 and p2 remain those of H.  The effect adds the
    difference between the widened plays and the fixed plays, so it combines with other effects of
    its slot in any order.

    Notes
    -----
    Speed is in spans a second: a sine over the full range at f Hz peaks at ``pi f``.  A play with
    r = 0 is part of p2 and remains a straight line.  Plays whose thresholds depend on time:
    Al Janaideh, Krejci and Monteiro, "Inverse rate-dependent Prandtl-Ishlinskii operators and
    applications", Applications of Mathematics, 2023, doi:10.21136/AM.2023.0231-22.
    """

    name = 'rate_dependent_hysteresis'
    slot = 'hysteresis'
    of_hysteresis = 'linear'
    description = 'loops that widen with speed; 10 .. 30 % a decade of frequency above 10 .. 50 Hz'
    needs = 'two amplitudes at one fast frequency, a slow sweep, and a hold of 2 s'
    parameters = (
        Parameter('gain', 's^eps', 'growth beta of all thresholds', 0.0, -1.0, 1.0, step=1e-5),
        Parameter('exponent', '1', 'power eps of the speed', NAN, 0.05, 2.0, scale='log'),
        Parameter(
            'levelling', 's', 'growth levels off above a speed of 1/c', NAN, 0.0, 1e3, default=0.0
        ),
        Parameter('cutoff', 'Hz', 'low-pass of the speed', NAN, 1e-3, 1e5, scale='log'),
        Parameter('stretch', 's^eps', 'relative growth sigma', 0.0, -1.0, 10.0, step=1e-4),
        Parameter('lead', 's^eps', 'growth lambda_0 of the upper edge', 0.0, -1.0, 1.0, step=1e-5),
        Parameter(
            'lead_stretch',
            's^eps',
            'relative growth lambda_1 of the upper edge',
            0.0,
            -1.0,
            10.0,
            step=1e-4,
        ),
    )

    def prepare(self) -> None:
        """Read the amplitudes as `growth`, and compute the pole of the low-pass of the speed."""
        gain, stretch, lead, lead_stretch = map(self.number, AMPLITUDES)
        self.growth = gain, stretch, lead, lead_stretch
        self.pole = float(np.exp(-2 * np.pi * self.number('cutoff') / self.sample_rate))

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List several laws of the speed, with growth of the lower edge or of both edges."""
        if not np.any(view.thresholds > 0):
            return ()
        trials = []
        fast = max(view.speed, *view.speeds)
        laws = [(0.3, 0.0), (0.6, 0.0), (1.0, 0.0), (1.5, 0.0)]
        laws += [(1.0, 5.0 / fast), (1.0, 50.0 / fast)]
        for exponent, levelling in laws:
            unit = ((1.0 + levelling * fast) / fast) ** exponent
            small, large = min(0.1, 2e-3 * unit), min(0.5, 1e-2 * unit)
            steps = {'gain': small, 'stretch': large, 'lead': small, 'lead_stretch': large}
            for cutoff in (2000.0, 400.0):
                shape = {
                    'exponent': exponent,
                    'levelling': levelling,
                    'cutoff': min(view.sample_rate / 10, cutoff),
                }
                trials.append(cls.trial(shape, ['gain', 'stretch'], steps))
            trials.append(cls.trial(shape, steps=steps))
        return tuple(trials)

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest: no speed, and plays as in H."""
        w = self.inner.reset(v0, x0)
        plays = self.core
        if isinstance(plays, HysteresisOperator):
            self._memory = plays.memory[: self.hysteresis.thresholds.size].copy()
        else:
            self._memory = self.hysteresis.initial_memory(x0)
        self._memory = np.append(self._memory, np.zeros(-self._memory.size % LANES))
        self._still = self._memory.copy()
        self._speed = np.array([x0, 0.0])
        return w

    def process(self, block: Block) -> Block:
        """Apply H to the block and widen its plays."""
        v = np.ascontiguousarray(block.x)
        r, q, *_, low, c = self.hysteresis.for_kernel
        power = self._power(v, self._speed)
        more = np.empty(v.size)
        growth_of_plays(v, r, q, low, c, power, self.growth, self._memory, self._still, more)
        inner = self.inner.process(block)
        return inner.with_signal(inner.x + more)

    def slopes(self, block: Block) -> dict[str, Array]:
        """Compute the derivatives by all parameters in one pass; see `Effect.slopes`."""
        v = np.ascontiguousarray(block.x)
        r, q, *_, low, c = self.hysteresis.for_kernel
        power, bends = self._bent_power(v)
        out = np.empty((len(AMPLITUDES) + len(SHAPE), v.size))
        growth_slopes(v, r, q, low, c, power, bends, self.growth, self._memory.copy(), out)
        return dict(zip((*AMPLITUDES, *SHAPE), out, strict=True))

    def of_parts(
        self, block: Block, rest: float, parts: Iterable[tuple[Hysteresis, Array]]
    ) -> Iterator[Array]:
        """Yield the output for each part of H; see `Effect.of_parts`."""
        v = np.ascontiguousarray(block.x)
        power = self.power(v, rest)
        for group in in_groups(parts):
            h, _ = group[0]
            if not h.thresholds.size:
                # a part without plays does not grow
                yield from columns_of_parts(v, group, rest)
            elif is_single_play(h):
                for one, start in group:
                    out = np.empty(v.size)
                    moved_play(v, one.thresholds[0], power, self.growth, start[0], out)
                    yield one.weights[0] * out
            elif has_curves_alone(h):
                yield from self._moved_apart(v, power, group)
            else:
                yield from super().of_parts(block, rest, group)

    def _moved_apart(self, v: Array, power: Array, group: list[Part]) -> Array:
        """Compute up to four parts of the same plays, with growth, as rows."""
        h, memory = group[0]
        r, *_, low, _ = h.for_kernel
        moved, out = np.zeros(r.size), np.empty((SIDE_BY_SIDE, v.size))
        moved[: memory.size] = memory
        q, curves = weights_of(group)
        moved_plays_apart(v, r, low, q, curves, power, self.growth, moved, out)
        return out[: len(group)]

    def c_code(self) -> CCode:
        """Write the effect in C."""
        h = self.hysteresis
        m = h.thresholds.size
        if m == 0:
            return CCode()
        names = ('gain', 'stretch', 'lead', 'lead_stretch', 'levelling', 'exponent')
        numbers: Numbers = {name: self.number(name) for name in names}
        r, q, *_, low, c = h.for_kernel
        numbers |= {'m': m, 'r': r[:m], 'q': q[:m], 'low': low, 'pole': self.pole}
        numbers |= {'per_second': self.sample_rate}
        if c.size:
            rows = ('c1', 'c2', 'c3', 'kappa', 'width')
            numbers |= {name: row[:m] for name, row in zip(rows, c, strict=True)}
        return read_c(__package__, self.name, numbers, has_curves=c.size > 0)

    def power(self, v: Array, v0: float) -> Array:
        """Compute ``|s|^eps`` for an input from rest at v0, both shapes (n,)."""
        return self._power(np.ascontiguousarray(v), np.array([v0, 0.0]))

    def power_and_slope(self, v: Array, v0: float) -> tuple[Array, Array]:
        """Compute `power`, and its derivative by the speed s."""
        speed = speed_of(np.ascontiguousarray(v), self.pole, self.sample_rate, np.array([v0, 0.0]))
        exponent, levelled = (
            self.number('exponent'),
            1.0 + self.number('levelling') * np.abs(speed),
        )
        # the slope of a small power is infinite at rest
        near = np.maximum(np.abs(speed) / levelled, SLOW) ** (exponent - 1.0)
        slope = exponent * near * np.sign(speed) / levelled**2
        return (np.abs(speed) / levelled) ** exponent, slope

    def _bent_power(self, v: Array) -> tuple[Array, Array]:
        """Compute `_power` and its derivatives by exponent, levelling and cutoff, shape (3, n)."""
        exponent, levelling, cutoff = map(self.number, SHAPE)
        near = float(np.exp(-2 * np.pi * cutoff * (1.0 + NEAR) / self.sample_rate))
        speed, other = (
            np.abs(speed_of(v, pole, self.sample_rate, self._speed.copy()))
            for pole in (self.pole, near)
        )
        levelled = 1.0 + levelling * speed
        base = np.maximum(speed / levelled, STILL)
        log = np.log(base)
        power = np.exp(exponent * log)
        slope = exponent * power / (base * levelled**2)
        bends = [
            power * log,
            -exponent * power * base,
            slope * (other - speed) / (NEAR * cutoff),
        ]
        return power, np.stack(bends)

    def _power(self, v: Array, state: Array) -> Array:
        power = np.abs(speed_of(v, self.pole, self.sample_rate, state))
        if self.number('levelling') > 0.0:
            power /= 1.0 + self.number('levelling') * power
        if self.number('exponent') != 1.0:
            power **= self.number('exponent')
        return power

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Stages whose hysteresis is a sum of plays, at rest at 0 V before each record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
import math
from types import MappingProxyType
import zlib

import numpy as np
from numpy.typing import ArrayLike

from . import laws
from .cores import Array, Density, everett, plays, Rng
from .effects import Affected, Gains
from .linear import ARX, Cascade, delayed, pink, RATE, ridden
from .table import EFFECTS, gain_of, LATER, OUTSIDE, VARIANTS

#: displacement [m] and voltage [V] of the whole range
SPAN = 75e-6
VOLTS = 10.0
NOISES = ('white', '1/f', '10-bit', 'none')
#: these need thresholds one by one; the others leave the core as it is
_PLAYS = ('rate_dependent_hysteresis', 'memory_fade')


@dataclass(frozen=True)
class Base:
    """
    The stage without any effect.

    `core`: {'plays', 'everett'}: How the hysteresis is computed; `density`: of the thresholds;
    `polynomial`: factors of u, u^3 and u^5; `delay`: [s].
    """

    core: str
    density: Density
    polynomial: tuple[float, float, float]
    dynamics: Cascade | ARX
    delay: float

    def single_valued(self, u: Array) -> Array:
        """Return the part of the hysteresis block that has no memory."""
        c1, c3, c5 = self.polynomial
        square = u * u
        return np.asarray(u * (c1 + square * (c3 + square * c5)))


def make_base(seed: int) -> Base:
    """Draw a stage; the same seed gives the same stage, whatever effect is added."""
    rng = np.random.default_rng([7321, seed])
    core = ('plays', 'everett')[int(rng.integers(2))]
    n = int(rng.integers(2, 4))
    density = Density(
        rng.uniform(0.3, 1.0, n),
        rng.integers(1, 4, n).astype(np.float64),
        rng.uniform(0.03, 0.16, n) * np.array([1.0, 1.6, 2.2])[:n],
    )
    density = density.scaled(rng.uniform(0.10, 0.15) / density.width())
    rest = rng.uniform(0.93, 0.96) - density.everett(1.0)
    # what a fall from the top begins with: the slope of the part without memory, never negative
    end, c5 = rest * rng.uniform(0.4, 0.8), rng.uniform(-0.01, 0.01)
    c3 = 0.5 * (end - rest) - 2.0 * c5
    c1 = rest - c3 - c5
    first = rng.uniform(300.0, 1500.0)
    modes = [(first, math.exp(rng.uniform(math.log(0.02), math.log(0.1))), 1.0)]
    if rng.random() < 0.5:
        share = rng.uniform(0.05, 0.2)
        modes[0] = (first, modes[0][1], 1.0 - share)
        modes.append((first * rng.uniform(1.8, 3.0), rng.uniform(0.02, 0.1), share))
    poles = (rng.uniform(2000.0, 5000.0), rng.uniform(3000.0, 8000.0))
    paper = rng.random() < 0.25
    return Base(
        core,
        density,
        (c1, c3, c5),
        ARX() if paper else Cascade(tuple(modes), poles),
        int(rng.integers(2, 6)) / RATE,
    )


@dataclass(frozen=True)
class Stage(Affected):
    """
    A stage, perhaps with effects, behind a sampled sensor.

    `gains`: parameter of every effect's law; 0 (infinity for slew_limit) is none; `variants`:
    which form of its law every effect takes; `noise`: {'white', '1/f', '10-bit', 'none'}: White,
    or with a density of 1/f, of the same rms over a record; or white, and then rounded to 1/1024
    of the span; `noise_rms`: share of the span.
    """

    base: Base
    gains: Mapping[str, float] = field(default_factory=dict)
    variants: Mapping[str, int] = field(default_factory=dict)
    seed: int = 0
    noise: str = 'none'
    noise_rms: float = 2e-5
    rate = RATE

    def respond(
        self,
        t: ArrayLike,
        v: ArrayLike,
        changed: bool = True,
        channels: Mapping[str, ArrayLike] | None = None,
        *,
        take: int = 0,
        clean: bool = False,
    ) -> Array:
        """
        Return the measured displacement [m], shape (n,), of a stage that was at rest at 0 V.

        `t`: time [s], at `RATE`; `v`: command held between samples [V], 0 .. 10; `changed`: False:
        as it was before the effects of `LATER` set in; `channels`: ``other``: voltage of another
        axis [V]; at rest when absent; `take`: another draw of noise, phases and drifts for the
        same voltage; `clean`: without sensor noise.
        """
        time = np.asarray(t, dtype=np.float64)
        volts = np.ascontiguousarray(v, dtype=np.float64)
        other = (channels or {}).get('other')
        if other is not None:
            other = np.ascontiguousarray(other, dtype=np.float64) / VOLTS
        # a record's own draws: its phases are not those of the next
        key = zlib.crc32(volts.tobytes())

        def draw(name: str) -> Rng:
            return np.random.default_rng([zlib.crc32(name.encode()), self.seed, key, take])

        gains = {n: g for n, g in self.gains.items() if changed or n not in LATER}
        y = self.displacement(time, volts / VOLTS, gains, other, draw)
        if not clean:
            y = y + self._sensor_noise(y, np.random.default_rng([3, self.seed, key, take]))
        return np.asarray(y * SPAN)

    def hysteresis(self, drive: Array, gains: Gains) -> Array:
        u, base, kind = drive, self.base, self.variants
        h = base.single_valued(u)
        if 'even_nonlinearity' in gains:
            h = h + laws.bent(u, gains['even_nonlinearity'], kind['even_nonlinearity'])
        kappa = gains.get('noncongruent_minor_loops', 0.0)
        if base.core == 'everett':
            return h + everett(u, base.density, kappa)
        low = high = None
        follow, rate = 1.0, gains.get('rate_dependent_hysteresis', 0.0)
        if rate:
            variant, speed = kind['rate_dependent_hysteresis'], np.abs(laws.velocity(u))
            if variant == 2:
                follow = -math.expm1(-1.0 / (RATE * rate))
            else:
                low = rate * speed / (speed + 60.0)
                if variant == 0:
                    low = high = 0.5 * low
        forget = -math.expm1(-gains.get('memory_fade', 0.0) / RATE)
        return h + plays(u, base.density, low, high, follow=follow, forget=forget, curve=kappa)

    def motion(self, h: Array, gains: Gains) -> Array:
        dynamics, delay = self.base.dynamics, self.base.delay
        amount = gains.get('changed_dynamics', 0.0)
        if amount and self.variants['changed_dynamics'] == 0 and isinstance(dynamics, Cascade):
            dynamics = dynamics.loaded(amount)
        y = dynamics(h)
        if amount and self.variants['changed_dynamics'] == 1:
            y = y + ridden(h, amount, 260.0 + 14.0 * (self.seed % 7))
        return delayed(y, delay + gains.get('delay_change', 0.0))

    def other_axis(self, other: Array) -> Array:
        density = make_base(self.seed + 1000).density
        moved = 0.8 * other + everett(np.maximum(other, 0.0), density)
        frequency = 180.0 + 60.0 * (self.seed % 5)
        return Cascade(((frequency, 0.04, 1.0),), (2500.0,))(moved)

    def _sensor_noise(self, y: Array, rng: Rng) -> Array:
        if self.noise == 'none' or self.noise_rms == 0:
            return np.zeros(y.size)
        white = rng.standard_normal(y.size)
        if self.noise == '1/f':
            coloured = pink(white)
            return np.asarray(self.noise_rms * coloured / coloured.std())
        noise = self.noise_rms * white
        if self.noise == '10-bit':
            noise = np.rint((y + noise) * 1024) / 1024 - y
        return np.asarray(noise)


def make_stage(
    effect: str | tuple[str, ...] | None,
    strength: float = 0.3,
    seed: int = 0,
    noise: str = 'white',
    noise_rms: float = 2e-5,
) -> Stage:
    """
    Return a stage with undeclared effects.

    `effect`: names out of `EFFECTS` and `OUTSIDE`; `strength`: what about is left of each effect
    on the diagnosis program after the best refit of weights, polynomial and offset of the base [%
    of stroke, rms]; `seed`: of the stage, and of the form of each law; `noise`: {'white', '1/f',
    '10-bit', 'none'}; `noise_rms`: share of the span.
    """
    names = () if effect is None else (effect,) if isinstance(effect, str) else tuple(effect)
    for name in names:
        if name not in EFFECTS + OUTSIDE:
            raise ValueError(f'no law for {name!r}; there are {", ".join(EFFECTS + OUTSIDE)}')
    if noise not in NOISES:
        raise ValueError(f'noise must be one of {NOISES}, got {noise!r}')
    kind = {n: seed % VARIANTS[n] for n in names}
    base = make_base(seed)
    if kind.get('changed_dynamics') == 0 and isinstance(base.dynamics, ARX):
        kind['changed_dynamics'] = 1
    if 'noncongruent_minor_loops' in kind:
        form = ('everett', 'plays')[kind['noncongruent_minor_loops']]
        base = replace(base, core=form)
    if any(n in _PLAYS for n in names):
        base = replace(base, core='plays')
    gains = {n: gain_of(n, kind[n], strength) for n in names}
    kinds = MappingProxyType(kind)
    return Stage(base, MappingProxyType(gains), kinds, seed, noise, noise_rms)

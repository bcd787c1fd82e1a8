# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Stages with hysteresis of another family, light modes and a past that goes on in each record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
import math
import zlib

import numpy as np

from . import laws
from .cores import Array, Rng
from .effects import Affected, Gains
from .families import Core, make_core
from .linear import Linear, make_linear, pink
from .table import FAMILY_VARIANTS, FURTHER, SETS_IN

#: what a stage has gone through before a record [s] after its last move, at rest
RESTED = 0.4
#: speed of the moves before a record [spans/s]
MOVES = 3.0


@dataclass(frozen=True, eq=False)
class FamilyStage(Affected):
    """
    A stage that is measured.

    `rate`: [Hz]; `limits`: [V]; `stroke`: [m], negative where the sensor looks the other way;
    `offset`: reading at the lowest voltage [m]; `noise`: {'white', '1/f', '10-bit', '12-bit'};
    `noise_rms`: share of the stroke; `gains`, `variants`: parameter and form of the law of every
    effect.
    """

    core: Core
    linear: Linear
    rate: float
    limits: tuple[float, float]
    stroke: float
    offset: float
    noise: str
    noise_rms: float
    gains: Mapping[str, float] = field(default_factory=dict)
    variants: Mapping[str, int] = field(default_factory=dict)
    seed: int = 0

    def before(self, start: float, name: str) -> Array:
        """Return what u did before a record: full sweeps, some turns, and rest at its start."""
        rng = self._draw('before', name)
        levels = [0.0, 1.0, 0.0]
        if start > 0.02:
            levels += [rng.uniform(0.7, 1.0), rng.uniform(0.0, 0.3), rng.uniform(0.4, 0.8)]
        parts = [np.zeros(2)]
        for a, b in zip(levels, [*levels[1:], start], strict=True):
            n = max(1, round(abs(b - a) / MOVES * self.rate))
            parts.append(a + (b - a) * 0.5 * (1 - np.cos(np.pi * np.arange(1, n + 1) / n)))
        parts.append(np.full(round(RESTED * self.rate), start))
        return np.concatenate(parts)

    def respond(
        self,
        v: Array,
        name: str,
        gains: Gains | None = None,
        other: Array | None = None,
        *,
        clean: bool = False,
    ) -> Array:
        """
        Return the displacement [m], shape (n,).

        `v`: command held between samples [V]; `name`: {'identification', 'diagnosis', 'unseen'}:
        Of the record: its own noise, phases and past. What is in `SETS_IN` sets in behind the
        identification; `gains`: instead of the stage's own; `other`: voltage of another axis [V];
        `clean`: without the sensor's noise, in parts of the stroke and without offset.
        """
        gains = dict(self.gains if gains is None else gains)
        if name == 'identification':
            gains = {k: x for k, x in gains.items() if k not in SETS_IN}
        low, high = self.limits
        u = (v - low) / (high - low)
        before = self.before(float(u[0]), name)
        t = np.arange(u.size) / self.rate
        y = self.displacement(
            t, np.concatenate([before, u]), gains, other, lambda what: self._draw(what, name)
        )
        return y if clean else np.asarray(self.offset + self.stroke * self.read(y, name))

    def read(self, y: Array, name: str) -> Array:
        """Return a displacement with the sensor's noise, in parts of the stroke."""
        white = self._draw('noise', name).standard_normal(y.size)
        if self.noise == '1/f':
            white = pink(white)
            white /= white.std()
        y = y + self.noise_rms * white
        if self.noise.endswith('-bit'):
            # a converter's range is wider than the stroke
            steps = 2 ** int(self.noise[:2]) / 1.2
            y = np.rint(y * steps) / steps
        return np.asarray(y)

    def _draw(self, what: str, name: str) -> Rng:
        return np.random.default_rng([zlib.crc32(f'{what} {name}'.encode()), self.seed])

    def hysteresis(self, drive: Array, gains: Gains) -> Array:
        kind, moved = self.variants, drive
        if 'rate_dependent_hysteresis' in gains:
            amount, form = gains['rate_dependent_hysteresis'], kind['rate_dependent_hysteresis']
            moved = drive - laws.spent_on_speed(drive, amount, form, self.rate)
        h = self.core(moved)
        if 'noncongruent_minor_loops' in gains:
            amount = gains['noncongruent_minor_loops']
            # loops are wider the higher the voltage, or the further the stage is out
            place = drive if kind['noncongruent_minor_loops'] == 0 else h
            h = h + amount * (2.0 * place - 1.0) * (h - drive)
        if 'even_nonlinearity' in gains:
            h = h + laws.bent(drive, gains['even_nonlinearity'], kind['even_nonlinearity'])
        return h

    def motion(self, h: Array, gains: Gains) -> Array:
        linear, later = self.linear, gains.get('delay_change', 0.0)
        amount = gains.get('changed_dynamics', 0.0)
        if amount:
            (frequency, zeta, share), *others = linear.modes
            if self.variants['changed_dynamics'] == 0:
                # the same dashpot on more mass
                ratio = 1.0 / (1.0 + amount)
                modes = ((frequency * ratio, zeta * ratio, share), *others)
            elif self.variants['changed_dynamics'] == 2:
                # a stiffer or lighter platform: every mode moves up
                modes = tuple((f * (1.0 + 0.5 * amount), z, k) for f, z, k in linear.modes)
            else:
                # a part of the platform rides on a mode of its own
                modes = ((frequency, zeta, share - amount), (0.7 * frequency, 0.02, amount))
                modes = (*modes, *others)
            linear = Linear(modes, linear.pole, linear.delay)
        return linear(h, self.rate, later)

    def other_axis(self, other: Array) -> Array:
        low, high = self.limits
        u = other / (high - low)
        moved = 0.85 * u + 0.15 * u**2
        rng = self._draw('other', '')
        return Linear(((rng.uniform(150.0, 400.0), 0.03, 1.0),), 2500.0, 0.0)(moved, self.rate)


def _form(effect: str, rng: Rng, further: bool) -> int:
    known = FAMILY_VARIANTS[effect]
    if not further or effect not in FURTHER:
        return int(rng.integers(known))
    return min(int(rng.integers(known + 2)), known)


def make_family_stage(
    core: str, seed: int, effects: tuple[str, ...] = (), further: bool = False
) -> FamilyStage:
    """
    Draw a stage; the gains of its effects are still to be found.

    `core`: one of `families.LAWS`; `effects`: of which the forms are drawn; `further`: also draw
    from `FURTHER`, which counts twice.
    """
    rng = np.random.default_rng([8812, seed])
    rate = float(rng.choice([10_000.0, 20_000.0, 20_000.0, 50_000.0]))
    limits = ((0.0, 10.0), (0.0, 100.0), (-20.0, 130.0))[int(rng.integers(3))]
    stroke = math.exp(rng.uniform(math.log(5e-6), math.log(200e-6)))
    sign = -1.0 if rng.random() < 0.2 else 1.0
    noise = str(rng.choice(['white', 'white', '1/f', '1/f', '10-bit', '12-bit']))
    return FamilyStage(
        core=make_core(core, rng),
        # a change of a high mode shows in nothing that a stage is driven with
        linear=make_linear(rng, rate, 600.0 if 'changed_dynamics' in effects else 1500.0),
        rate=rate,
        limits=limits,
        stroke=sign * stroke,
        offset=stroke * rng.uniform(-0.3, 0.3),
        noise=noise,
        noise_rms=math.exp(rng.uniform(math.log(2e-5), math.log(2e-4))),
        variants={n: _form(n, rng, further) for n in effects},
        seed=seed,
    )

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Cross-coupling: another axis moves this axis slightly."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from piezo_ident.common.errors import ModelError
from piezo_ident.effects.effect import Effect, NAN, Parameter, Trial, View
from piezo_ident.effects.second_order import SecondOrderSection, sections_in_c, slope_of_mode
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block
from piezo_ident.record.channels import role_of

#: lowest plausible corner: below it only heat follows another axis [Hz]
SLOWEST = 0.5


class CrossCoupling(Effect):
    """
    Voltage of another axis, through a second-order low-pass, added to the displacement.

    ``y = x + (g + g' d/dt) M(s) (c - c0)`` with ``M = w^2 / (s^2 + 2 zeta w s + w^2)`` by the
    bilinear transform, prewarped at w; the rate is exact at low frequencies.  c is a further
    channel of the record in its own unit, and c0 its value without effect.  The channel counts
    as constant before the first sample.

    Notes
    -----
    Coupling between the axes of a scanner: A. J. Fleming and K. K. Leang, "Design, Modeling and
    Control of Nanopositioning Systems", Springer, 2014, doi:10.1007/978-3-319-06617-2.
    """

    name = 'cross_coupling'
    slot = 'output'
    change = 'passed'
    description = "motion that follows another axis's voltage; 0.5 .. 3 % of that axis's stroke"
    needs = "the other axis's voltage as a further channel, while that axis moves by itself"
    parameters = (
        Parameter(
            'channel',
            'name',
            'further channel of the record: x_<name> without its x_',
            NAN,
            -np.inf,
            np.inf,
            kind='text',
            scale='fixed',
        ),
        Parameter('gain', '1/unit', 'static gain g', 0.0, -1e9, 1e9, step=1e-3),
        Parameter('rate_gain', 's/unit', "gain g' of the rate", 0.0, -1e9, 1e9, step=1e-5),
        Parameter('frequency', 'Hz', 'corner of the low-pass', NAN, 1e-3, 1e6, scale='log'),
        Parameter('damping', '1', 'damping ratio', NAN, 1e-3, 100.0, default=0.7, scale='log'),
        Parameter(
            'offset', 'unit', 'value c0 without effect', NAN, -1e9, 1e9, default=0.0, scale='fixed'
        ),
    )

    def prepare(self) -> None:
        """Build the filter of the channel."""
        frequency, gain = self.number('frequency'), self.number('gain')
        # g M + g' s M = g + g (M - 1) + g' (s/S) R with S as in `SecondOrderSection`.  The value
        # of s/S at low frequencies makes the rate exact there for any prewarping
        slope = 2.0 * self.sample_rate / slope_of_mode(frequency, self.sample_rate)
        rate = self.number('rate_gain') * slope
        self._section = SecondOrderSection(
            frequency, self.number('damping'), gain, rate, self.sample_rate
        )
        self._gain = gain
        self._started = False

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List every channel that moves, with three corners."""
        trials = []
        for name, (rest, std) in view.channels.items():
            # the displacement of another axis answers shared motion, and does not cause it
            if role_of(name) == 'y' or not (np.isfinite(std) and std > 0):
                continue
            for f in (10.0, 100.0, 1000.0):
                if f >= 0.4 * view.sample_rate:
                    continue
                shape = {'channel': name, 'frequency': f, 'damping': 0.7, 'offset': rest}
                steps = {'gain': 1e-3 / std, 'rate_gain': 1e-3 / (2 * np.pi * f * std)}
                trials.append(cls.trial(shape, steps=steps))
        return tuple(trials)

    @classmethod
    def is_plausible(cls, values: Mapping[str, Any]) -> bool:
        """Tell whether the low-pass is as fast as mechanics; a slower low-pass is a drift."""
        frequency, damping = float(values['frequency']), float(values['damping'])
        # overdamped, the low-pass has two real poles, and the slower pole counts
        slow = 1.0 if damping <= 1.0 else damping - np.sqrt(damping**2 - 1.0)
        return bool(slow * frequency >= SLOWEST)

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest; the rest value of the channel is only known with its first sample."""
        self._started = False
        return x0

    def process(self, block: Block) -> Block:
        """Add the share of the other axis; raises ModelError without its channel."""
        name = self.text('channel')
        if name not in block.channels:
            has = ', '.join(sorted(block.channels)) or 'none'
            raise ModelError(
                f'effect cross_coupling needs the further channel {name!r}; the data have {has}; '
                'record that channel, or take the effect out of the model'
            )
        if block.x.size == 0:
            return block
        c = np.asarray(block.channels[name], dtype=np.float64) - self.number('offset')
        if not self._started:
            self._section.reset(float(c[0]))
            self._started = True
        return block.with_signal(block.x + (self._gain * c + self._section.process(c)))

    def c_code(self) -> CCode:
        """Write the effect in C."""
        code = sections_in_c([self._section], 'z')
        return CCode(
            {**code.numbers, 'gain': self._gain, 'offset': self.number('offset')},
            f'{code.state}int started;\n',
            's->started = 0;\n',
            'const double z = c - offset;\n'
            f'if (!s->started) {{\n{code.rest}s->started = 1;\n}}\n{code.step}x += gain * z;\n',
            self.text('channel'),
        )

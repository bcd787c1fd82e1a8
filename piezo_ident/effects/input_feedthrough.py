# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Input feed-through: the drive leaks into the electronics of the sensor."""

from __future__ import annotations

import numpy as np
from piezo_ident.effects.effect import Effect, Parameter, Trial, View
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block


class InputFeedthrough(Effect):
    """
    Command and its rate in the reading, without any delay.

    ``y = x + k0 v + k1 dv/dt``, with the rate as a backward difference.  The terms are a resistive
    and a capacitive path from the drive into the electronics of the sensor.  The feed-through
    arrives before the displacement, at lags shorter than the delay.

    Notes
    -----
    A capacitance C into an input of resistance R adds R C dv/dt, a common ground a share of v:
    H. W. Ott, "Electromagnetic Compatibility Engineering", Wiley, 2009, chapters 2 and 3.
    """

    name = 'input_feedthrough'
    slot = 'acquisition'
    change = 'passed'
    in_dynamics = True
    description = 'the drive leaks into the reading, ahead of the motion; up to 0.5 % of stroke'
    needs = 'steps or wide-band noise, sampled faster than the delay'
    parameters = (
        Parameter('gain', '1', 'share k0 of the command', 0.0, -1.0, 1.0, step=1e-3),
        Parameter('rate_gain', 's', 'share k1 of its rate', 0.0, -1.0, 1.0, step=1e-6),
    )

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List both paths together."""
        return (cls.trial({}, steps={'rate_gain': min(0.1, 1e-3 / view.speed)}),)

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest: the command has no rate."""
        self._last = v0
        return x0 + self.number('gain') * v0

    def process(self, block: Block) -> Block:
        """Add the share of the command to the block."""
        if block.v.size == 0:
            return block
        k0, k1 = self.number('gain'), self.number('rate_gain') * self.sample_rate
        before, self._last = self._last, float(block.v[-1])
        y = block.x + k0 * block.v
        if k1 != 0.0:
            y[0] += k1 * (block.v[0] - before)
            y[1:] += k1 * np.diff(block.v)
        return block.with_signal(y)

    def c_code(self) -> CCode:
        """Write the effect in C."""
        return CCode(
            {
                'gain': self.number('gain'),
                'rate_gain': self.number('rate_gain') * self.sample_rate,
            },
            'double last;\n',
            's->last = v;\nx += gain * v;\n',
            'x += gain * v + rate_gain * (v - s->last);\ns->last = v;\n',
        )

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Slew limit: the current of the amplifier limits how fast it charges the piezo."""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import kernel
from piezo_ident.effects.effect import Effect, Parameter, Trial, View
from piezo_ident.effects.trials import ladder
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block


@kernel
def _limit(x: Array, most: float, state: Array) -> Array:
    out = np.empty(x.size)
    y = state[0]
    for k in range(x.size):
        d = x[k] - y
        if d > most:
            y += most
        elif d < -most:
            y -= most
        else:
            y = x[k]
        out[k] = y
    state[0] = y
    return out


class SlewLimit(Effect):
    """
    Voltage that changes by at most S a second.

    ``va(k) = va(k-1) + clip(v(k) - va(k-1), -S / f_s, S / f_s)`` with S = I / C, the largest
    current of the amplifier over the capacitance of the piezo: 0.5 A on 20 uF make 75 V in 3 ms.

    Notes
    -----
    Slew rate and current limit of amplifiers for capacitive loads: A. J. Fleming and K. K. Leang,
    "Design, Modeling and Control of Nanopositioning Systems", Springer, 2014,
    doi:10.1007/978-3-319-06617-2.
    """

    name = 'slew_limit'
    slot = 'input'
    description = (
        'the amplifier charges the piezo no faster than its current allows; acts on jumps and on '
        'fast, large motion alone'
    )
    needs = 'steps or sines fast and large enough to pass the limit, and the same at a tenth'
    parameters = (
        Parameter(
            'limit',
            '1/s',
            'largest speed S, in spans a second',
            float('inf'),
            1e-6,
            float('inf'),
            default=float('inf'),
            scale='log',
        ),
    )

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List limits at the speeds of the data, and up to the speed of a jump."""
        speeds = np.unique(view.speeds[view.speeds > 0])
        if speeds.size == 0:
            return ()
        fastest = float(speeds[-1])
        # jumps are too rare to show in the quantiles of the speed
        jump = max(fastest, 0.5 * view.span * view.sample_rate)
        limits = [*speeds[:-1].tolist(), *(np.array([0.7, 0.8, 0.9]) * fastest)]
        limits += ladder(fastest, jump, 6)[1:]
        return tuple(cls.trial({'limit': limit}) for limit in limits)

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest with the voltage at the command."""
        self._state = np.array([x0])
        return x0

    def process(self, block: Block) -> Block:
        """Limit the speed of the signal of the block."""
        most = self.number('limit') / self.sample_rate
        if np.isinf(most):
            return block
        return block.with_signal(_limit(np.ascontiguousarray(block.x), most, self._state))

    def c_code(self) -> CCode:
        """Write the effect in C."""
        most = self.number('limit') / self.sample_rate
        if np.isinf(most):
            return CCode()
        return CCode(
            {'most': most},
            'double y;\n',
            's->y = x;\n',
            'x = s->y = piezo_held(x, s->y - most, s->y + most);\n',
        )

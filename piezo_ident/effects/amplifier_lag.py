# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Amplifier lag: the voltage on the piezo lags behind the command."""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import alive, kernel
from piezo_ident.effects.effect import Effect, Parameter, Trial, View
from piezo_ident.effects.trials import ladder
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block


@kernel
def _follow(x: Array, pole: float, state: Array) -> Array:
    out = np.empty(x.size)
    y, share = state[0], 1.0 - pole
    for k in range(x.size):
        y = alive(y + share * (x[k] - y))
        out[k] = y
    state[0] = y
    return out


class AmplifierLag(Effect):
    """
    First-order lag of the amplifier, in front of H.

    ``va(k) = a va(k-1) + (1 - a) v(k)`` with ``a = exp(-1 / (f_s tau))``.  The time constant
    tau = R C is the output resistance of the amplifier times the capacitance of the piezo.  An
    identification puts most of the lag into G.  The loops of H still follow the lagged voltage,
    not the command.

    Notes
    -----
    Amplifier and capacitive load: A. J. Fleming and K. K. Leang, "Design, Modeling and Control of
    Nanopositioning Systems", Springer, 2014, doi:10.1007/978-3-319-06617-2.  The filter is the
    exact response of the continuous lag to a command held between samples, seen at the end of
    each hold.
    """

    name = 'amplifier_lag'
    slot = 'input'
    in_dynamics = True
    description = 'RC lag of amplifier and piezo before the hysteresis; corner at 0.5 .. 10 kHz'
    needs = 'a fast sine at two amplitudes, or a multisine up to a tenth of the corner'
    parameters = (
        Parameter(
            'time_constant', 's', 'time constant tau', 0.0, 0.0, 1.0, step=1e-4, scale='linear'
        ),
    )

    def prepare(self) -> None:
        """Compute the pole."""
        tau = self.number('time_constant')
        self.pole = float(np.exp(-1.0 / (self.sample_rate * tau))) if tau > 0.0 else 0.0

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List lags from 0.7 of a sample: the effect of a smaller lag is not linear in it."""
        sample = 1.0 / view.sample_rate
        lags = ladder(0.7 * sample, max(1e-3, 10.0 * sample), 4)
        return tuple(cls.trial({}, steps={'time_constant': min(tau, 0.5)}) for tau in lags)

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest, with the voltage at the command."""
        self._state = np.array([x0])
        return x0

    def process(self, block: Block) -> Block:
        """Lag the signal of the block."""
        if self.pole == 0.0:
            return block
        x = np.ascontiguousarray(block.x)
        return block.with_signal(_follow(x, self.pole, self._state))

    def c_code(self) -> CCode:
        """Write the effect in C."""
        if self.pole == 0.0:
            return CCode()
        return CCode(
            {'share': 1.0 - self.pole},
            'double y;\n',
            's->y = x;\n',
            'x = s->y = piezo_alive(s->y + share * (x - s->y));\n',
        )

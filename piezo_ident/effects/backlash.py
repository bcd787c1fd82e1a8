# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Backlash: a guide or a joint moves some way before it carries the stage."""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import kernel
from piezo_ident.effects.effect import Effect, NAN, Parameter, Trial, View
from piezo_ident.effects.trials import ladder
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block
from piezo_ident.operators.kernels import held


@kernel
def _play(x: Array, width: float, state: Array) -> Array:
    out = np.empty(x.size)
    p = state[0]
    for k in range(x.size):
        p = held(p, x[k] - width, x[k] + width)
        out[k] = p
    state[0] = p
    return out


class Backlash(Effect):
    """
    Play on the displacement.

    ``y = x + g (P[x] - x)`` with the symmetric play ``P(k) = max(x(k) - rho, min(x(k) + rho,
    P(k-1)))`` of half-width rho.  g = 1 is pure backlash; a smaller g is the share of the stage
    behind the play.  After each turn of the displacement, not of the voltage, a distance of
    2 rho is lost.

    Notes
    -----
    M. Nordin and P.-O. Gutman, "Controlling mechanical systems with backlash - a survey",
    Automatica 38(10), 2002, doi:10.1016/S0005-1098(02)00047-X.  Dry friction on an elastic guide
    gives the same loop.
    """

    name = 'backlash'
    slot = 'output'
    rate_independent = True
    description = 'lost motion after each turn of the displacement; 0.1 .. 2 % of stroke'
    needs = 'sweeps with turns in the middle and at the ends, slow and near the first resonance'
    parameters = (
        Parameter('width', '1', 'half-width rho of the play', NAN, 0.0, 2.0, scale='log'),
        Parameter('gain', '1', 'share g of the stage behind the play', 0.0, 0.0, 10.0, step=0.1),
    )

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List widths from 0.2 % to 10 % of the range."""
        if view.span <= 0.0:
            return ()
        widths = ladder(0.002 * view.span, 0.1 * view.span, 6)
        return tuple(cls.trial({'width': w}, steps={'gain': min(0.5, 1e-3 / w)}) for w in widths)

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest in the middle of the play."""
        self._state = np.array([x0])
        return x0

    def process(self, block: Block) -> Block:
        """Apply the lost motion to the block."""
        gain = self.number('gain')
        p = _play(np.ascontiguousarray(block.x), self.number('width'), self._state)
        return block.with_signal(p if gain == 1.0 else block.x + gain * (p - block.x))

    def c_code(self) -> CCode:
        """Write the effect in C."""
        gain = self.number('gain')
        lost = 's->p' if gain == 1.0 else 'x + gain * (s->p - x)'
        return CCode(
            {'width': self.number('width'), 'gain': gain},
            'double p;\n',
            's->p = x;\n',
            f's->p = piezo_held(s->p, x - width, x + width);\nx = {lost};\n',
        )

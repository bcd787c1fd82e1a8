# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Even nonlinearity: even part of the static curve, which the odd H cannot describe."""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.effects.effect import Effect, Parameter, Trial, View
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block


class EvenNonlinearity(Effect):
    """
    Even powers of the voltage, added to H.

    ``w = H[v] + p0 v^2 + p4 v^4 + p6 v^6``.  The static part of H is ``p1 v^3 + p2 v``, odd
    about v = 0.  Two causes are not odd: electrostriction, which grows with the square of the
    field, and the unequal stiffness of a preloaded stack.

    Notes
    -----
    Electrostriction as a square added to the linear piezoelectric effect: D. Damjanovic,
    "Ferroelectric, dielectric and piezoelectric properties of ferroelectric thin films and
    ceramics", Rep. Prog. Phys. 61, 1998, doi:10.1088/0034-4885/61/9/002.  H without even terms:
    Gu, Li, Zhu and Su (2016), doi:10.1109/TMECH.2015.2465868, eqs. 3 and 6.
    """

    name = 'even_nonlinearity'
    slot = 'hysteresis'
    of_hysteresis = 'not'
    rate_independent = True
    description = 'even powers of the voltage in the static curve; 0.1 .. 2 % of stroke'
    needs = 'slow sweeps over the full range, and equal minor loops at several biases'
    parameters = (
        Parameter('square', '1', 'coefficient p0 of v^2', 0.0, -1.0, 1.0, step=1e-3),
        Parameter('fourth', '1', 'coefficient p4 of v^4', 0.0, -1.0, 1.0, step=1e-3),
        Parameter('sixth', '1', 'coefficient p6 of v^6', 0.0, -1.0, 1.0, step=1e-3),
    )

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List the square alone, with the fourth power, and all three powers."""
        return cls.trial({}, ['square']), cls.trial({}, ['square', 'fourth']), cls.trial({})

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest; the effect itself has no memory."""
        return self.inner.reset(v0, x0) + float(self._even(np.array([x0]))[0])

    def process(self, block: Block) -> Block:
        """Apply H to the block and add the even powers."""
        inner = self.inner.process(block)
        return inner.with_signal(inner.x + self._even(block.x))

    def c_code(self) -> CCode:
        """Write the effect in C."""
        names = ('square', 'fourth', 'sixth')
        step = 'x += u * u * (square + u * u * (fourth + u * u * sixth));\n'
        return CCode({name: self.number(name) for name in names}, rest=step, step=step)

    def _even(self, x: Array) -> Array:
        p0, p4, p6 = (self.number(name) for name in ('square', 'fourth', 'sixth'))
        square = x * x
        return square * (p0 + square * (p4 + square * p6))

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Preload loss: below some voltage the spring no longer holds the stack."""

from __future__ import annotations

import numpy as np
from piezo_ident.effects.effect import Effect, NAN, Parameter, Trial, View
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block


class PreloadLoss(Effect):
    """
    Kink in the static curve at the voltage where the preload runs out.

    ``x = h - k max(0, theta - v)``: below theta the joint opens and its stiffness changes, so the
    displacement follows the command with a slope larger by k.  The kink stays at the same voltage
    on every loop.

    Notes
    -----
    A stack takes no tension, hence the preload: A. J. Fleming and K. K. Leang, "Design, Modeling
    and Control of Nanopositioning Systems", Springer, 2014, doi:10.1007/978-3-319-06617-2.  The
    two stiffnesses joined at theta are the piecewise linear spring of a contact.
    """

    name = 'preload_loss'
    slot = 'hidden'
    change = 'passed'
    rate_independent = True
    description = (
        'another slope below the voltage at which the preload runs out; 0.1 .. 2 % of stroke'
    )
    needs = 'slow sweeps over the full range, and minor loops on both sides of the kink'
    parameters = (
        Parameter('gain', '1', 'slope k added below theta', 0.0, 0.0, 1.0, step=3e-3),
        Parameter('threshold', '1', 'voltage theta of the kink', NAN, -10.0, 10.0),
    )

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List kinks at seven voltages within the range."""
        places = view.low + view.span * np.arange(1, 8) / 8
        return tuple(cls.trial({'threshold': float(theta)}) for theta in places)

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest; the effect has no memory."""
        return x0 - self.number('gain') * max(0.0, self.number('threshold') - v0)

    def process(self, block: Block) -> Block:
        """Add the slope below the kink to the block."""
        loss = np.maximum(0.0, self.number('threshold') - block.v)
        return block.with_signal(block.x - self.number('gain') * loss)

    def c_code(self) -> CCode:
        """Write the effect in C."""
        step = 'x -= gain * (threshold > v ? threshold - v : 0.0);\n'
        names = ('gain', 'threshold')
        return CCode({name: self.number(name) for name in names}, rest=step, step=step)

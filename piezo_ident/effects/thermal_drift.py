# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Drift: the stage and its mount change length with temperature."""

from __future__ import annotations

import numpy as np
from piezo_ident.effects.effect import Effect, NAN, Parameter, Trial, View
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block


class ThermalDrift(Effect):
    """
    Displacement that grows with time, independent of the command.

    ``d(t) = b t + c (1 - exp(-t / tau))``: a steady drift, and a first-order approach to a new
    temperature, as after switching on.  Time is the time of the sample clock.  The clock starts
    with the record, not with the last reset, so a gap in a record does not stop the drift.  The
    drift is zero before time zero.  Rate and size hold for one record.  The drift in another
    record, or after the end, does not follow from them.

    Notes
    -----
    Size: c is ``alpha L dT / Y``; 0.1 K on 2 cm of aluminium, alpha = 23e-6 / K, make about 50 nm.
    First-order exchange of heat with the surroundings is Newton's law of cooling.
    """

    name = 'thermal_drift'
    slot = 'output'
    change = 'passed'
    description = 'displacement that grows with time whatever the voltage does; 1 .. 100 nm/min'
    needs = 'rests at one voltage at the start and at the end'
    time_driven = True
    parameters = (
        Parameter('rate', '1/s', 'steady drift b', 0.0, -1.0, 1.0, step=1e-4),
        Parameter('amplitude', '1', 'final size c of the approach', 0.0, -1.0, 1.0, step=1e-3),
        Parameter(
            'time_constant', 's', 'tau of the approach', NAN, 1e-3, 1e7, default=60.0, scale='log'
        ),
    )

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List the steady drift, approaches to a new temperature, and both."""
        long = max(view.duration, 1e-2)
        steps = {'rate': min(0.1, 1e-3 / long)}
        trials = [cls.trial({'time_constant': long}, ['rate'], steps)]
        for moved in (['amplitude'], ['rate', 'amplitude']):
            for share in (0.1, 1 / 3, 1.0):
                trials.append(cls.trial({'time_constant': share * long}, moved, steps))
        return tuple(trials)

    def process(self, block: Block) -> Block:
        """Add the drift to the block."""
        t = np.maximum(block.t, 0.0)
        x = block.x + self.number('rate') * t
        if self.number('amplitude'):
            x -= self.number('amplitude') * np.expm1(-t / self.number('time_constant'))
        return block.with_signal(x)

    def c_code(self) -> CCode:
        """Write the effect in C."""
        names = ('rate', 'amplitude', 'time_constant')
        return CCode(
            {name: self.number(name) for name in names},
            step="""
        const double since = t > 0.0 ? t : 0.0;
        x += rate * since - amplitude * expm1(-since / time_constant);
        """,
        )

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Hum: lines in the displacement that do not depend on the command."""

from __future__ import annotations

import math

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.kernel import ordered_kernel
from piezo_ident.effects.effect import Effect, NAN, Parameter, Trial, View
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block

#: coefficients of x^21, x^19, ..., x of the sine, exact to rounding up to a quarter of a turn
SINE = tuple((-1.0) ** k / math.factorial(2 * k + 1) for k in range(10, -1, -1))


@ordered_kernel
def _add_lines(t: Array, frequency: Array, amplitude: Array, phase: Array, y: Array) -> None:
    # phases in turns.  A sine of the mathematical library takes ten times as long
    for i in range(frequency.size):
        f, a, p = frequency[i], amplitude[i], phase[i]
        if a == 0.0:
            continue
        for k in range(t.size):
            turn = f * t[k] + p
            turn -= math.floor(turn + 0.5)
            half = 0.5 if turn > 0.0 else -0.5
            turn = half - turn if abs(turn) > 0.25 else turn
            x = 2.0 * math.pi * turn
            z, s = x * x, 0.0
            for c in SINE:
                s = s * z + c
            y[k] += a * (x * s)


class PeriodicDisturbance(Effect):
    """
    Mains hum or a machine nearby: a sum of sines added to the displacement.

    ``d(t) = sum_i A_i sin(2 pi m_i f t + phi_i)`` with a base frequency f and chosen harmonics
    m_i.  Time is the time of the sample clock, so the phase is the same in all pieces of a record
    but differs from record to record.

    Notes
    -----
    Detection of such lines: Fisher, "Tests of significance in harmonic analysis", Proc. R. Soc. A
    125, 1929, doi:10.1098/rspa.1929.0151.
    """

    name = 'periodic_disturbance'
    slot = 'output'
    change = 'passed'
    description = 'lines in the displacement, from the mains or a machine; 0.01 .. 0.2 % of stroke'
    needs = 'a rest of 2 s, or motion at frequencies other than its lines'
    time_driven = True
    parameters = (
        # a spectral line gives the frequency far more sharply than a fit could
        Parameter('frequency', 'Hz', 'base frequency f', NAN, 1e-3, 1e6, scale='fixed'),
        Parameter('harmonic', '1', 'multiple m_i of f', NAN, 1.0, 1e3, True, scale='fixed'),
        Parameter('amplitude', '1', 'amplitude A_i of each', 0.0, -1.0, 1.0, True, step=1e-3),
        Parameter(
            'phase', 'rad', 'phase phi_i of each', NAN, -1e3, 1e3, True, default=0.0, scale='fixed'
        ),
    )

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List one trial for each line, with up to three harmonics as sine and cosine."""
        trials = []
        for f in view.lines:
            harmonics = [m for m in (1.0, 2.0, 3.0) if m * f < view.nyquist]
            if f > 0 and harmonics:
                shape = {
                    'frequency': f,
                    'harmonic': np.repeat(harmonics, 2),
                    'phase': np.tile([0.0, np.pi / 2], len(harmonics)),
                }
                trials.append(cls.trial(shape))
        return tuple(trials)

    def process(self, block: Block) -> Block:
        """Add the lines to the block."""
        y, t = block.x.copy(), np.ascontiguousarray(block.t)
        m, amplitude, phase = (self.array(name) for name in ('harmonic', 'amplitude', 'phase'))
        _add_lines(t, self.number('frequency') * m, amplitude, phase / (2.0 * np.pi), y)
        return block.with_signal(y)

    def c_code(self) -> CCode:
        """Write the effect in C."""
        turn = 2 * np.pi * self.number('frequency')
        m, amplitude, phase = (self.array(name) for name in ('harmonic', 'amplitude', 'phase'))
        return CCode(
            {'n': m.size, 'turn': turn * m, 'amplitude': amplitude, 'phase': phase},
            step="""
        int i;
        for (i = 0; i < n; i++)
            x += amplitude[i] * sin(turn[i] * t + phase[i]);
        """,
        )

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Sensor nonlinearity: the reading is a curved function of the displacement."""

from __future__ import annotations

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.effects.effect import Effect, Parameter, Trial, View
from piezo_ident.operators.c_code import CCode
from piezo_ident.operators.chain import Block


class SensorNonlinearity(Effect):
    """
    Polynomial between displacement and reading.

    ``y = x + c2 x^2 + c3 x^3 + c4 x^4``, with x and y as shares of the output span.  The error
    is the same function of the displacement at every frequency, behind G and the delay.  Close
    to a resonance this distinguishes it from a curvature in front of G.

    Notes
    -----
    Strain gauges are off by 0.1 .. 1 % of full scale, capacitive sensors by 0.01 .. 0.1 %:
    A. J. Fleming, "A review of nanometer resolution position sensors: operation and performance",
    Sensors and Actuators A 190, 2013, doi:10.1016/j.sna.2012.10.016.  The curve maps
    displacement to reading, and the error is the part that calibration leaves.
    """

    name = 'sensor_nonlinearity'
    slot = 'output'
    rate_independent = True
    description = (
        'a curved characteristic of the sensor; strain gauge 0.1 .. 1 %, capacitive 0.01 .. 0.1 %'
    )
    needs = 'the full range both slowly and near the first resonance, and loops at five biases'
    parameters = (
        Parameter('square', '1', 'coefficient c2 of x^2', 0.0, -1.0, 1.0, step=1e-3),
        Parameter('cubic', '1', 'coefficient c3 of x^3', 0.0, -1.0, 1.0, step=1e-3),
        Parameter('fourth', '1', 'coefficient c4 of x^4', 0.0, -1.0, 1.0, step=1e-3),
    )

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List the square alone, with the cubic, and all three powers."""
        return cls.trial({}, ['square']), cls.trial({}, ['square', 'cubic']), cls.trial({})

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest; the effect has no memory."""
        return float(self._read(np.array([x0]))[0])

    def process(self, block: Block) -> Block:
        """Apply the curve of the sensor to the block."""
        return block.with_signal(self._read(block.x))

    def c_code(self) -> CCode:
        """Write the effect in C."""
        step = 'x += x * x * (square + x * (cubic + x * fourth));\n'
        names = ('square', 'cubic', 'fourth')
        return CCode({name: self.number(name) for name in names}, rest=step, step=step)

    def _read(self, x: Array) -> Array:
        c2, c3, c4 = (self.number(name) for name in ('square', 'cubic', 'fourth'))
        return x + x * x * (c2 + x * (c3 + x * c4))

# Copyright 2026 The piezo_ident authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Hum: lines in the displacement that have nothing to do with the command."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from piezo_ident.block import Block, Slot
from piezo_ident.effects.base import Effect, Parameter
from piezo_ident.errors import ModelError

__all__ = ['PeriodicDisturbance']


class PeriodicDisturbance(Effect):
    """
    Mains hum or a machine nearby: a sum of sines added to the displacement.

    ``d(t) = sum_i A_i sin(2 pi m_i f t + phi_i)`` with a free base frequency f and the harmonics
    m_i that are wanted.  Time is that of the sample clock, so the phase holds across the pieces
    of a record but is another in each record.

    Notes
    -----
    Detection of such lines: Fisher, "Tests of significance in harmonic analysis", Proc. R. Soc. A
    125, 1929, doi:10.1098/rspa.1929.0151.
    """

    name: ClassVar[str] = 'periodic_disturbance'
    slot: ClassVar[Slot] = 'output'
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter('frequency', 'Hz', 'base frequency f', float('nan'), 1e-3, 1e6),
        Parameter('harmonic', '1', 'multiple m_i of f', float('nan'), 1.0, 1e3, vector=True),
        Parameter('amplitude', '1', 'amplitude A_i of each', 0.0, -1.0, 1.0, vector=True),
        Parameter('phase', 'rad', 'phase phi_i of each', float('nan'), -1e3, 1e3, vector=True),
    )

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]
        self._lines = [self.array(name) for name in ('harmonic', 'amplitude', 'phase')]
        sizes = {x.size for x in self._lines}
        if len(sizes) > 1:
            raise ModelError(
                'effect periodic_disturbance: harmonic, amplitude and phase differ in length; '
                'give one of each a line'
            )

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest: the mean of the disturbance is zero."""
        return x0

    def process(self, block: Block) -> Block:
        """Return the block with the lines added."""
        y = block.x.copy()
        turn = 2 * np.pi * self.number('frequency')
        for m, amplitude, phase in zip(*self._lines, strict=True):
            y += amplitude * np.sin(turn * m * block.t + phase)
        return block.with_signal(y)

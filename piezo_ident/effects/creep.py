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

"""Creep: domains keep turning after the voltage has stopped."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from piezo_ident.block import Block, Slot
from piezo_ident.effects.base import Effect, Parameter
from piezo_ident.errors import ModelError
from scipy.signal import lfilter

__all__ = ['Creep']


class Creep(Effect):
    """
    Linear creep as a sum of slow first-order elements behind H.

    Each element follows ``x_i(k) = a_i x_i(k-1) + (1 - a_i) h(k)`` with
    ``a_i = exp(-1 / (f_s tau_i))``, and the output is ``h + sum_i c_i x_i``.  Time constants
    spread over decades imitate the logarithmic law of piezo ceramics: one element a decade with
    ``c_i = gamma`` is a creep of gamma a decade.

    Notes
    -----
    Logarithmic law: Jung and Gweon, "Creep characteristics of piezoelectric actuators", Rev. Sci.
    Instrum. 71(4), 2000.  Operator form: Krejci and Kuhnen, "Inverse control of systems with
    hysteresis and creep", IEE Proc. Control Theory Appl. 148(3), 2001,
    doi:10.1049/ip-cta:20010375.
    """

    name: ClassVar[str] = 'creep'
    slot: ClassVar[Slot] = 'hidden'
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter('gain', '1', 'share c_i of each element', 0.0, -1.0, 1.0, vector=True),
        Parameter(
            'time_constant',
            's',
            'time constant tau_i',
            float('nan'),
            1e-4,
            1e6,
            vector=True,
        ),
    )

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]
        self._c, tau = self.array('gain'), self.array('time_constant')
        if self._c.size != tau.size:
            raise ModelError(
                f'effect creep: {self._c.size} gains and {tau.size} time constants; give one each'
            )
        self._pole = np.exp(-1.0 / (self.sample_rate * tau))
        self._state = np.zeros(tau.size)

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest: every element has caught up."""
        self._state = np.full(self._c.size, x0)
        return float(x0 * (1.0 + self._c.sum()))

    def process(self, block: Block) -> Block:
        """Return the block with the crept part added."""
        y = block.x.copy()
        state = self._state.copy()
        for i, (c, pole) in enumerate(zip(self._c, self._pole, strict=True)):
            x, _ = lfilter([1.0 - pole], [1.0, -pole], block.x, zi=[pole * state[i]])
            state[i] = x[-1]
            y += c * x
        self._state = state
        return block.with_signal(y)

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

"""Rate dependence: the loops widen with speed."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from piezo_ident.block import Block, Operator, Slot
from piezo_ident.effects.base import Effect, Parameter
from piezo_ident.hysteresis import HysteresisOperator
from piezo_ident.kernel import kernel

__all__ = ['RateDependentHysteresis']


@kernel
def _widened(
    v: NDArray[np.float64],
    r: NDArray[np.float64],
    q: NDArray[np.float64],
    growth: NDArray[np.float64],
    memory: NDArray[np.float64],
    still: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    # memory: plays with growing thresholds; still: the same plays with fixed ones
    n_r = r.size
    for k in range(v.size):
        x = v[k]
        more = growth[k]
        w = 0.0
        for i in range(n_r):
            low = x - r[i]
            g = still[i]
            g = x if g > x else g
            g = low if g < low else g
            still[i] = g
            low = x - (r[i] + more)
            f = memory[i]
            f = x if f > x else f
            f = low if f < low else f
            memory[i] = f
            w += q[i] * (f - g)
        out[k] = w


@kernel
def _low_pass(
    v: NDArray[np.float64], pole: float, rate: float, state: NDArray[np.float64]
) -> NDArray[np.float64]:
    # state: the last input and the last speed
    speed = np.empty(v.size)
    last, s = state[0], state[1]
    for k in range(v.size):
        s = pole * s + (1.0 - pole) * (v[k] - last) * rate
        last = v[k]
        speed[k] = s
    state[0], state[1] = last, s
    return speed


class RateDependentHysteresis(Effect):
    """
    Prandtl-Ishlinskii plays whose thresholds grow with the speed of the input.

    ``r_i(k) = r_i + beta |s(k)|^eps`` for every play of H, where ``s`` is the input's speed behind
    a first-order low-pass.  The speed is filtered before its magnitude is taken, so that
    converter steps and noise cancel instead of adding up.  Weights, p1 and p2 stay those of H;
    what is added to the signal is the difference between the widened plays and the fixed ones,
    so the effect stacks with others of its slot in any order.

    Notes
    -----
    Speed is in spans a second: a sine over the full range at f Hz peaks at ``pi f``.  A play with
    r = 0 is part of p2 and stays a straight line.  Plays whose thresholds are functions of time:
    Al Janaideh, Krejci and Monteiro, "Inverse rate-dependent Prandtl-Ishlinskii operators and
    applications", Applications of Mathematics, 2023, doi:10.21136/AM.2023.0231-22.
    """

    name: ClassVar[str] = 'rate_dependent_hysteresis'
    slot: ClassVar[Slot] = 'hysteresis'
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter('gain', 's^eps', 'growth beta of the thresholds with speed', 0.0, 0.0, 1.0),
        Parameter('exponent', '1', 'power eps of the speed', float('nan'), 0.05, 2.0),
        Parameter('cutoff', 'Hz', 'low-pass of the speed', float('nan'), 1.0, 1e5),
    )

    def __init__(self, *args: object, **kwargs: object) -> None:
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]
        self._pole = float(np.exp(-2 * np.pi * self.number('cutoff') / self.sample_rate))
        self._memory = self.hysteresis.initial_memory(0.0)
        self._still = self._memory.copy()
        self._speed = np.zeros(2)

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest: no speed, and the plays where H has them."""
        w = self.inner.reset(v0, x0)
        plays: Operator = self.inner
        while isinstance(plays, Effect):
            plays = plays.inner
        if isinstance(plays, HysteresisOperator):
            self._memory = plays.memory.copy()
        else:
            self._memory = self.hysteresis.initial_memory(x0)
        self._still = self._memory.copy()
        self._speed = np.array([x0, 0.0])
        return w

    def process(self, block: Block) -> Block:
        """Return the block with H applied and its plays widened."""
        h, v = self.hysteresis, np.ascontiguousarray(block.x)
        speed = _low_pass(v, self._pole, self.sample_rate, self._speed)
        growth = self.number('gain') * np.abs(speed) ** self.number('exponent')
        more = np.empty(v.size)
        _widened(v, h.thresholds, h.weights, growth, self._memory, self._still, more)
        inner = self.inner.process(block)
        return inner.with_signal(inner.x + more)

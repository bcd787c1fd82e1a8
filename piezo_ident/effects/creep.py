# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Creep of a piezo ceramic: slow first-order elements that the output of H drives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.common.kernel import alive, kernel
from piezo_ident.effects.effect import Effect, NAN, Parameter, Trial, View
from piezo_ident.effects.trials import ladder
from piezo_ident.operators.c_code import CCode, Numbers, read_c
from piezo_ident.operators.chain import Block

#: time after a step up to which motion may belong to the dynamics [s]
AT_ONCE = 0.05
#: largest creep against the direction of a step, as a share of the creep along it
BACK = 0.5
#: prior rms of c_i.  Neighbouring elements hardly differ: large c_i of opposite sign could cancel
#: each other in data of a few seconds, but not in other data
SPREAD = 0.02


@kernel
def _crept(h: Array, c: Array, rate: Array, state: Array) -> Array:
    # rate: 1 - a_i; the update is a difference, so that an element at its input rests exactly
    out = np.empty(h.size)
    for k in range(h.size):
        x = h[k]
        w = 0.0
        for i in range(c.size):
            s = state[i]
            s = alive(s + rate[i] * (x - s))
            state[i] = s
            w += c[i] * s
        out[k] = x + w
    return out


class Creep(Effect):
    """
    Linear creep: H plus a sum of slow first-order elements that H drives.

    Each element follows the output h of H, ``x_i(k) = a_i x_i(k-1) + (1 - a_i) h(k)`` with
    ``a_i = exp(-1 / (f_s tau_i))``.  The output is ``h + sum_i c_i x_i``.  Time constants
    that are spread over decades imitate the logarithmic law of piezo ceramics: one element a
    decade with ``c_i = gamma`` creeps by gamma a decade.

    Notes
    -----
    Logarithmic law: Jung and Gweon, "Creep characteristics of piezoelectric actuators", Rev. Sci.
    Instrum. 71(4), 2000, pp. 1896-1900.  Operator form: Krejci and Kuhnen, "Inverse control of
    systems with hysteresis and creep", IEE Proc. Control Theory Appl. 148(3), 2001,
    doi:10.1049/ip-cta:20010375.
    """

    name = 'creep'
    slot = 'hidden'
    change = 'linear'
    description = (
        'slow motion after each change of the voltage; 1 .. 2 % a decade of time, 1 .. 5 % in all'
    )
    needs = 'holds of 2 s and more after steps of both signs'
    parameters = (
        Parameter(
            'gain',
            '1',
            'share c_i of each element',
            0.0,
            -1.0,
            1.0,
            vector=True,
            step=1e-3,
            spread=SPREAD,
        ),
        Parameter(
            'time_constant', 's', 'time constant tau_i', NAN, 1e-4, 1e6, vector=True, scale='fixed'
        ),
    )

    def prepare(self) -> None:
        """Drop elements with c_i = 0."""
        self._active = np.flatnonzero(self.array('gain'))
        self._c = self.array('gain')[self._active]
        times = self.array('time_constant')[self._active]
        self._rate = -np.expm1(-1.0 / (self.sample_rate * times))
        self._distance = np.zeros(self._c.size)

    def start_from(self, beyond: Array) -> None:
        """
        Set ``x_i - h`` of each element after a reset, normalised; empty for elements at rest.

        Raises ModelError if the number of distances is not the number of elements.
        """
        if beyond.size not in (0, self.array('gain').size):
            raise ModelError(
                f'creep: a start of {beyond.size} elements for {self.array("gain").size}; '
                'take the start from this model'
            )
        self._distance = beyond[self._active] if beyond.size else np.zeros(self._c.size)

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List two sets of elements, seven and four, spread over all times of the data."""
        # faster elements would imitate the dynamics, or a gain of H if the data are slow
        shortest = max(5.0 / view.sample_rate, 0.01 if view.is_fast else AT_ONCE)
        # a time constant far beyond the judged data would imitate a drift
        longest = max(min(view.duration, view.judged), 10.0 * shortest)
        # a single time constant would fit one decade better and the next decade worse
        sets = [ladder(shortest, longest, 7), ladder(3 * shortest, longest / 3, 4)]
        return tuple(cls.trial({'time_constant': taus}) for taus in sets)

    @classmethod
    def is_plausible(cls, values: Mapping[str, Any]) -> bool:
        """
        Tell whether the creep after a step mainly continues in the direction of the step.

        A single c_i may be negative, as neighbouring elements compensate each other.  The first
        `AT_ONCE` after the step does not count, as fast elements may correct the dynamics.
        """
        gain, tau = (np.asarray(values[name], np.float64) for name in ('gain', 'time_constant'))
        t = np.geomspace(min(AT_ONCE, tau.max()), tau.max(), 100)
        steps = np.diff(-np.expm1(-t[:, None] / tau) @ gain)
        return bool(-steps[steps < 0.0].sum() <= BACK * steps[steps > 0.0].sum())

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest, with every element at its input plus the distance of `start_from`."""
        self._state = x0 + self._distance
        return float(x0 + self._c @ self._state)

    def process(self, block: Block) -> Block:
        """Add the creep to the block."""
        if self._c.size == 0:
            return block
        x = np.ascontiguousarray(block.x)
        return block.with_signal(_crept(x, self._c, self._rate, self._state))

    def c_code(self) -> CCode:
        """Write the effect in C."""
        n = self._c.size
        if n == 0:
            return CCode()
        numbers: Numbers = {'n': n, 'gain': self._c, 'share': self._rate}
        return read_c(__package__, 'creep', {**numbers, 'rest': 1.0 + self._c.sum()})

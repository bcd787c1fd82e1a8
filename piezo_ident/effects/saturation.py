# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Saturation: the amplifier reaches the end of its voltage range."""

from __future__ import annotations

from collections.abc import Mapping
from math import exp, inf, log1p

import numpy as np
from piezo_ident.common.arrays import Array
from piezo_ident.common.errors import ModelError
from piezo_ident.common.kernel import kernel
from piezo_ident.effects.effect import Effect, NAN, Parameter, Trial, Value, View
from piezo_ident.operators.c_code import CCode, Numbers, read_c
from piezo_ident.operators.chain import Block

#: beyond this many knees from an end, the rounding of the knee is below the precision of a float
FAR = 40.0


@kernel
def _soften(x: Array, low: float, high: float, knee: float) -> Array:
    out = np.empty(x.size)
    for k in range(x.size):
        v = x[k]
        y = v
        z = (v - high) / knee
        if z > FAR:
            y = high
        elif z > -FAR:
            y = v - knee * (log1p(exp(z)) if z < 0.0 else z + log1p(exp(-z)))
        z = (low - v) / knee
        if z > FAR:
            y += low - v
        elif z > -FAR:
            y += knee * (log1p(exp(z)) if z < 0.0 else z + log1p(exp(-z)))
        out[k] = y
    return out


class Saturation(Effect):
    """
    Voltage between two ends, which are reached sharply or with a rounded knee.

    ``va = v - k L((v - high)/k) + k L((low - v)/k)`` with ``L(z) = ln(1 + exp z)`` and the knee k.
    The curve is a straight line of slope one between the ends and flat beyond them, rounded over
    a few k.  For k = 0 it is ``clip(v, low, high)``.  An infinite end does not limit the voltage.

    Notes
    -----
    L is the smooth maximum of 0 and z: C. Chen and O. L. Mangasarian, "A class of smoothing
    functions for nonlinear and mixed complementarity problems", Comput. Optim. Appl. 5, 1996.
    Voltage ends of amplifiers for piezo actuators: A. J. Fleming and K. K. Leang, "Design,
    Modeling and Control of Nanopositioning Systems", Springer, 2014,
    doi:10.1007/978-3-319-06617-2.
    """

    name = 'saturation'
    slot = 'input'
    rate_independent = True
    description = (
        'the amplifier goes flat at the ends of its range; nothing elsewhere, large there'
    )
    needs = 'slow sweeps out to both ends of the range, and turns short of them'
    parameters = (
        Parameter('low', '1', 'lower end', -inf, -inf, inf, default=-inf),
        Parameter('high', '1', 'upper end', inf, -inf, inf, default=inf),
        Parameter('knee', '1', 'width k of the rounding', NAN, 0.0, 10.0, default=0.0),
    )

    @classmethod
    def agree(cls, values: Mapping[str, Value]) -> None:
        """Refuse ends in the wrong order; see `Effect.agree`."""
        super().agree(values)
        low, high = values['low'], values['high']
        if not low < high:  # type: ignore[operator]
            raise ModelError(f'effect saturation: low = {low} must lie below high = {high}')

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """List one end at a time, at several voltages near it, sharp and round."""
        trials = []
        for inside in (0.02, 0.05, 0.1, 0.2, 0.3):
            for knee in (0.02, 0.2):
                round_off = {'knee': knee * view.span}
                trials.append(cls.trial({'high': view.high - inside * view.span, **round_off}))
                trials.append(cls.trial({'low': view.low + inside * view.span, **round_off}))
        return tuple(trials)

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest; the effect has no memory."""
        return float(self._limited(np.array([x0]))[0])

    def process(self, block: Block) -> Block:
        """Limit the signal of the block."""
        return block.with_signal(self._limited(block.x))

    def c_code(self) -> CCode:
        """Write the effect in C."""
        numbers: Numbers = {name: self.number(name) for name in ('low', 'high', 'knee')}
        finite = {f'has_{name}': np.isfinite(self.number(name)) for name in ('low', 'high')}
        return read_c(__package__, self.name, {**numbers, 'knees': FAR}, **finite)

    def _limited(self, x: Array) -> Array:
        low, high, knee = (self.number(name) for name in ('low', 'high', 'knee'))
        if low == -inf and high == inf:
            return x
        if knee == 0.0:
            return np.clip(x, low, high)
        out: Array = _soften(np.ascontiguousarray(x), low, high, knee)
        return out

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Gain drift: the sensitivity of piezo or sensor changes with temperature and age."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from piezo_ident.common.arrays import Array, Integers
from piezo_ident.common.errors import ModelError
from piezo_ident.common.kernel import ordered_kernel
from piezo_ident.effects.effect import Effect, NAN, Parameter, Trial, Value, View
from piezo_ident.operators.c_code import CCode, read_c
from piezo_ident.operators.chain import Block


@ordered_kernel
def _with_gain(x: Array, t: Array, at: Integers, knots: Array, gains: Array) -> Array:
    # t ascends; at: first sample of each knot; the gain between two knots is a straight line
    out = x.copy()
    for i in range(-1, knots.size):
        start, stop = at[i] if i >= 0 else 0, at[i + 1] if i + 1 < at.size else x.size
        knot, gain, slope = knots[max(i, 0)], gains[max(i, 0)], 0.0
        if 0 <= i < knots.size - 1:
            slope = (gains[i + 1] - gain) / (knots[i + 1] - knot)
        # slices have no negative indices, which lets the compiler vectorise the loop
        now, before, after = t[start:stop], x[start:stop], out[start:stop]
        for k in range(now.size):
            after[k] = before[k] * (1.0 + (gain + slope * (now[k] - knot)))
    return out


class GainDrift(Effect):
    """
    Gain that changes slowly with time.

    ``y = x (1 + a(t))`` with a piecewise linear between knots and constant beyond them.  Time is
    the time of the sample clock.  The knots hold for one record.  The gain in another record, or
    after the last knot, does not follow from them.

    Notes
    -----
    Dependence of sensitivity on temperature: A. J. Fleming, "A review of nanometer resolution
    position sensors: operation and performance", Sensors and Actuators A 190, 2013,
    doi:10.1016/j.sna.2012.10.016.  Piecewise linear functions between knots are splines of the
    first degree: C. de Boor, "A Practical Guide to Splines", Springer, 1978.
    """

    name = 'gain_drift'
    slot = 'output'
    change = 'linear'
    description = 'a gain that wanders during the record with temperature or age'
    needs = 'the same motion at the start and at the end of a long record'
    time_driven = True
    parameters = (
        Parameter(
            'time', 's', 'time of each knot, ascending', NAN, -1e9, 1e9, True, scale='fixed'
        ),
        Parameter(
            'gain',
            '1',
            'change a of the gain there',
            0.0,
            -1.0,
            10.0,
            True,
            step=1e-3,
            first_stays=True,
        ),
    )

    @classmethod
    def agree(cls, values: Mapping[str, Value]) -> None:
        """Refuse knots that do not ascend; see `Effect.agree`."""
        super().agree(values)
        time = np.atleast_1d(np.asarray(values['time'], dtype=np.float64))
        if time.size == 0 or np.any(np.diff(time) <= 0):
            raise ModelError(f'effect gain_drift: time = {time.tolist()} must ascend')

    @classmethod
    def trials(cls, view: View) -> tuple[Trial, ...]:
        """
        List one to twelve stretches; the first knot stays fixed, as H holds a constant gain.

        The first knot lies at the first sample that counts: the gain before it is unknown.
        """
        trials = []
        last = view.duration if view.last is None else view.last
        for stretches in (1, 3, 6, 12):
            knots = np.linspace(view.first, max(last, view.first + 1e-6), stretches + 1)
            full = cls.trial({'time': knots})
            trials.append(Trial(full.values, full.moves[1:], full.steps[1:]))
        return tuple(trials)

    @classmethod
    def elsewhere(cls, values: Mapping[str, Any]) -> dict[str, Value]:
        """Give the mean gain of the record, relative to the gain that the fitted H has."""
        checked = cls.check(values)
        time, gain = (np.asarray(checked[name], dtype=np.float64) for name in ('time', 'gain'))
        at = np.linspace(time[0], time[-1], 1000)
        mean = float(np.interp(at, time, gain).mean())
        return cls.check({'time': time[:1], 'gain': [mean]})

    def reset(self, v0: float, x0: float) -> float:
        """Come to rest with the gain before the first knot."""
        return x0 * (1.0 + float(self.array('gain')[0]))

    def process(self, block: Block) -> Block:
        """Multiply the block by the gain at each time."""
        time, gain = self.array('time'), self.array('gain')
        if not gain.any():
            return block
        x, t = np.ascontiguousarray(block.x), np.ascontiguousarray(block.t)
        return block.with_signal(_with_gain(x, t, np.searchsorted(t, time), time, gain))

    def c_code(self) -> CCode:
        """Write the effect in C."""
        time, gain = self.array('time'), self.array('gain')
        if not gain.any():
            return CCode()
        return read_c(__package__, 'gain_drift', {'n': gain.size, 'knot': time, 'gain': gain})

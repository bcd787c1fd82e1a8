# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""Where each effect acts between the command and the reading of a stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math

from . import laws
from .cores import Array, Rng
from .linear import relaxation

Gains = Mapping[str, float]


class Affected:
    """
    A stage with effects; all in parts of the span.

    A stage has `rate` [Hz], `variants` (the form of the law of each effect), and says what its
    hysteresis, its linear part and another axis do.
    """

    rate: float
    variants: Mapping[str, int]

    def hysteresis(self, drive: Array, gains: Gains) -> Array:
        raise NotImplementedError

    def motion(self, h: Array, gains: Gains) -> Array:
        raise NotImplementedError

    def other_axis(self, other: Array) -> Array:
        raise NotImplementedError

    def displacement(
        self,
        t: Array,
        u: Array,
        gains: Gains,
        other: Array | None,
        draw: Callable[[str], Rng],
    ) -> Array:
        """
        Return the displacement at times t, shape (n,), without the sensor's noise.

        `u`: command, m >= n: what came before the record is at its beginning; `gains`: parameter
        of the law of every effect; `other`: command of another axis; `draw`: returns the generator
        of an effect.
        """
        kind, rate = self.variants, self.rate

        drive = u
        if 'slew_limit' in kind:
            slew = gains.get('slew_limit', math.inf)
            drive = laws.current_limited(drive, slew, kind['slew_limit'], rate)
        if 'saturation' in gains:
            drive = laws.limited(drive, gains['saturation'], kind['saturation'])
        if 'amplifier_lag' in gains:
            drive = laws.charged(drive, gains['amplifier_lag'], kind['amplifier_lag'], rate)
        h = self.hysteresis(drive, gains)
        if 'creep' in gains:
            h = relaxation(h, ('log', 'power')[kind['creep']], gains['creep'], rate=rate)
        if 'asymmetric_relaxation' in gains:
            h = relaxation(h, 'log', gains['asymmetric_relaxation'], up=0.0, rate=rate)
        if 'preload_loss' in gains:
            h = h + laws.hinge(drive, gains['preload_loss'], kind['preload_loss'])
        y = self.motion(h, gains)
        if 'backlash' in gains:
            y = y + laws.friction(y, gains['backlash'], kind['backlash'], rate)
        y, u = y[u.size - t.size :], u[u.size - t.size :]
        if 'gain_drift' in gains:
            rng = draw('gain_drift')
            y = y * (1.0 + laws.wander(t, gains['gain_drift'], kind['gain_drift'], rng))
        if 'cross_coupling' in gains and other is not None:
            y = y + gains['cross_coupling'] * self.other_axis(other)
        for name, of_time in (('thermal_drift', laws.drift), ('periodic_disturbance', laws.hum)):
            if name in gains:
                y = y + of_time(t, gains[name], kind[name], draw(name))
        if 'stick_jumps' in gains:
            y = y + laws.jumps(u, gains['stick_jumps'], draw('stick_jumps'))
        if 'floor_vibration' in gains:
            y = y + laws.vibration(u.size, gains['floor_vibration'], draw('floor_vibration'))
        if 'input_ripple' in gains:
            y = y + laws.ripple(t, u, gains['input_ripple'], draw('input_ripple'))
        if 'sensor_nonlinearity' in gains:
            y = laws.bridge(y, gains['sensor_nonlinearity'], kind['sensor_nonlinearity'])
        if 'input_feedthrough' in gains:
            amount, form = gains['input_feedthrough'], kind['input_feedthrough']
            y = y + laws.fed_through(u, amount, form, rate)
        return y

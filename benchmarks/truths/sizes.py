# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""How strong an effect must be for a wanted size, within what stages show."""

from __future__ import annotations

import math

import numpy as np

from .cores import Array
from .family_stage import FamilyStage

#: of each law the parameter that hardly shows, and the largest that a stage would have; see
#: `laws` and `family_stage`
AMOUNTS = {
    'creep': (1e-5, 0.012),
    'thermal_drift': (1e-5, 0.06),
    'periodic_disturbance': (1e-5, 0.006),
    'rate_dependent_hysteresis': (1e-4, 0.08),
    'amplifier_lag': (2e-6, 6e-4),
    # spans a second: the lower, the stronger
    'slew_limit': (2000.0, 60.0),
    'saturation': (1e-4, 0.25),
    'even_nonlinearity': (1e-4, 0.3),
    'noncongruent_minor_loops': (1e-3, 0.6),
    'preload_loss': (1e-3, 0.6),
    'changed_dynamics': (1e-3, 0.4),
    'sensor_nonlinearity': (1e-3, 0.25),
    'backlash': (1e-4, 0.03),
    'input_feedthrough': (1e-4, 0.5),
    'delay_change': (1e-6, 4e-4),
    'gain_drift': (1e-4, 0.03),
    'cross_coupling': (1e-4, 0.06),
}
#: of the parameter of an inverse tangent
STEEPER = {('sensor_nonlinearity', 1): 4.0, ('even_nonlinearity', 1): 0.3}
#: a size below this is below what sensors show, and one above this is another stage [% of stroke]
LEAST, LARGEST = 0.06, 2.0


def size_of(change: Array, without: Array) -> float:
    """
    Return the rms of a change behind the best offset and gain [% of stroke].

    `change`, `without`: what the effect adds, and the answer without it.
    """
    x = without - without.mean()
    e = change - change.mean()
    e = e - x * (x @ e) / (x @ x)
    return float(100.0 * np.sqrt(np.mean(e**2)) / np.ptp(without))


def scaled(
    stage: FamilyStage, effect: str, wanted: float, v: Array, other: Array | None = None
) -> tuple[float, float]:
    """
    Return the parameter of an effect and the size that it has on the diagnosis record.

    `wanted`: size [% of stroke], kept within `LEAST` and `LARGEST` and what the law may reach;
    `v`: command of the diagnosis record [V]; `other`: voltage of the other axis [V].
    """
    wanted = min(max(wanted, LEAST), LARGEST)
    weak, strong = AMOUNTS[effect]
    strong *= STEEPER.get((effect, stage.variants[effect]), 1.0)
    without = stage.respond(v, 'diagnosis', {}, clean=True)

    def size(amount: float) -> float:
        with_it = stage.respond(v, 'diagnosis', {effect: amount}, other, clean=True)
        return size_of(with_it - without, without)

    low, high = math.log(weak), math.log(strong)
    reached = size(strong)
    if reached <= wanted:
        return strong, reached
    # false position in the logarithms; the weak end is far below
    bottom, top = math.log(max(size(weak), 1e-6)), math.log(reached)
    goal, amount = math.log(wanted), strong
    for _ in range(12):
        share = min(max((goal - bottom) / max(top - bottom, 1e-9), 0.05), 0.95)
        middle = low + share * (high - low)
        amount = math.exp(middle)
        reached = size(amount)
        if abs(reached / wanted - 1.0) < 0.04:
            break
        if reached > wanted:
            high, top = middle, math.log(reached)
        else:
            low, bottom = middle, math.log(max(reached, 1e-6))
    return amount, reached

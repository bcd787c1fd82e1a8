# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""The program of excitation and the slow stage that tests of several rooms share."""

from functools import cache

import numpy as np
from piezo_ident.model.scaling import Scaling
from piezo_ident.model.stage_model import StageModel
from piezo_ident.operators.dynamics import Delay, Dynamics
from piezo_ident.operators.hysteresis import Hysteresis

#: sampling rate of `slow_model` [Hz]
SLOW = 2000.0


def identification_program(
    *,
    rate: float = 20_000,
    rest: float = 0.1,
    slew: float = 40,
    hold: float = 0.03,
    steps: int = 16,
    cycles: int = 24,
    frequency: float = 60,
    cutoff: float = 3000,
    noise: float = 1.5,
    slope: float = 20,
) -> str:
    """Return all that the three steps need, in a few seconds."""
    return f"""
limits: [0, 10]
sample_rate: {rate}
seed: 1
slew: {slew}
segments:
  - {{signal: idle, duration: {rest}}}
  - {{signal: step, bias: 5, size: 1, hold: {hold}, count: {steps}}}
  - {{signal: settle, bias: 5, amplitude: 0.48, cycles: {cycles}, frequency: {frequency}}}
  - {{signal: noise, bias: 5, amplitude: 0.4, cutoff: {cutoff}, duration: {noise}}}
  - {{signal: triangle, slope: {slope}}}
  - {{signal: idle, duration: {rest}}}
"""


#: the three steps on `slow_model`
SLOW_PROGRAM = identification_program(
    rate=SLOW,
    rest=0.3,
    slew=20,
    hold=0.06,
    steps=8,
    cycles=12,
    frequency=20,
    cutoff=600,
    noise=3,
    slope=10,
)


@cache
def slow_model() -> StageModel:
    """Return a stage with one slow mode, without any effect."""
    return StageModel(
        sample_rate=SLOW,
        scaling=Scaling(0.0, 10.0, 0.0, 75e-6, (0.0, 10.0)),
        hysteresis=Hysteresis(
            np.array([0.2, 0.4, 0.6]), np.array([0.3, 0.2, 0.1]), p1=-0.2, p2=0.9
        ),
        dynamics=Dynamics(np.array([-1.2, 0.5]), np.array([0.2, 0.1])),
        delay=Delay(2),
    )

# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""How strong each law must be for a wanted left-over; measured, see `truths.leftover`."""

from __future__ import annotations

import math

import numpy as np

__all__ = ['SIZES', 'STRENGTHS', 'gain_of']

#: left-over sizes [% of stroke, rms] at which the gains below were found
STRENGTHS = (0.1, 0.3, 1.0)

#: gain of each variant at each of STRENGTHS; the median over stages
SIZES: dict[str, tuple[tuple[float, float, float], ...]] = {
    'creep': (
        (0.00176, 0.00527, 0.0176),
        (0.00109, 0.00327, 0.0109),
    ),
    'thermal_drift': (
        (0.00425, 0.0127, 0.0425),
        (0.0035, 0.0105, 0.0351),
        (0.00994, 0.0298, 0.0994),
    ),
    'periodic_disturbance': (
        (0.0011, 0.00331, 0.011),
        (0.00109, 0.00328, 0.0109),
    ),
    'rate_dependent_hysteresis': (
        (0.114, 0.355, 1.34),
        (0.0704, 0.252, 0.997),
        (6.45e-05, 0.000159, 0.000522),
    ),
    'amplifier_lag': (
        (3.71e-05, 8.02e-05, 0.000218),
        (5.91e-05, 0.000108, 0.000278),
    ),
    'slew_limit': (
        (318, 266, 201),
        (327, 271, 203),
    ),
    'saturation': (
        (0.0168, 0.0499, 0.203),
        (0.00778, 0.0379, 0.155),
    ),
    'even_nonlinearity': (
        (0.0643, 0.193, 0.643),
        (0.0108, 0.0323, 0.108),
        (0.0239, 0.0718, 0.239),
    ),
    'noncongruent_minor_loops': (
        (0.0957, 0.287, 0.957),
        (0.143, 0.43, 1),
    ),
    'preload_loss': (
        (0.037, 0.111, 0.37),
        (0.054, 0.162, 0.54),
    ),
    'changed_dynamics': (
        (0.226, 0.696, 1.66),
        (0.136, 0.407, 1.36),
    ),
    'sensor_nonlinearity': (
        (0.0581, 0.174, 0.581),
        (0.568, 1.07, 2.48),
    ),
    'backlash': (
        (0.00392, 0.0118, 0.0392),
        (0.0041, 0.0123, 0.041),
    ),
    'input_feedthrough': (
        (0.0735, 0.221, 0.735),
        (0.0314, 0.0942, 0.314),
    ),
    'delay_change': ((2.21e-05, 6.64e-05, 0.000221),),
    'gain_drift': (
        (0.00277, 0.00848, 0.0283),
        (0.00277, 0.00811, 0.027),
    ),
    'cross_coupling': ((0.00735, 0.0221, 0.0735),),
    'stick_jumps': ((0.000989, 0.00297, 0.00989),),
    'floor_vibration': ((0.00157, 0.00471, 0.0157),),
    'input_ripple': ((0.00208, 0.00625, 0.0208),),
    'asymmetric_relaxation': ((0.00235, 0.00704, 0.0235),),
    'memory_fade': ((0.0382, 0.113, 0.479),),
}


def gain_of(effect: str, variant: int, strength: float) -> float:
    """Return the law's parameter for a wanted left-over [% of stroke, rms]."""
    if strength <= 0:
        return math.inf if effect == 'slew_limit' else 0.0
    logs = np.log(SIZES[effect][variant])
    x, at = math.log(strength), np.log(STRENGTHS)
    # straight lines between the sizes, and on beyond them
    i = 0 if x < at[1] else 1
    slope = (logs[i + 1] - logs[i]) / (at[i + 1] - at[i])
    return float(math.exp(logs[i] + slope * (x - at[i])))

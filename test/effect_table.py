# Copyright 2026 The piezo_ident authors
# SPDX-License-Identifier: Apache-2.0

"""What the tests of the effects share: a setting of each that can be seen, signals, a runner."""

from dataclasses import replace

import numpy as np
from paper_stage import FS, PAPER
from piezo_ident.effects import find_effect, View
from piezo_ident.model.stage_model import EffectSetting, StageModel
from piezo_ident.operators.chain import Block

H = PAPER.hysteresis

#: a setting of each effect that can be seen
VISIBLE = {
    'amplifier_lag': {'time_constant': 1e-3},
    'backlash': {'width': 0.01, 'gain': 0.6},
    'changed_dynamics': {
        'frequency': [400.0, 2500.0],
        'damping': [0.05, 0.02],
        'gain': [0.05, 0.01],
        'rate_gain': [0.0, 0.02],
    },
    'creep': {'gain': [0.012, 0.02], 'time_constant': [0.1, 1.0]},
    'cross_coupling': {
        'channel': 'other_axis',
        'gain': 0.01,
        'rate_gain': 1e-5,
        'frequency': 300.0,
        'damping': 0.3,
        'offset': 0.25,
    },
    'delay_change': {'samples': 1.3},
    'even_nonlinearity': {'square': 0.01, 'fourth': -0.004},
    'gain_drift': {'time': [0.0, 0.05, 0.2], 'gain': [0.0, 0.01, -0.02]},
    'input_feedthrough': {'gain': 0.003, 'rate_gain': 1e-6},
    'loop_hysteresis': {
        'frequency': 400.0,
        'damping': 0.05,
        'elastic': -0.1,
        'viscous': -0.02,
        'square': -0.05,
        'cubic': 0.1,
        'stiffness': [0.2, 0.1],
        'threshold': [0.0, 0.05],
        'gamma': [0.8, 0.0],
        'skew': [-1.4, 0.0],
    },
    'noncongruent_minor_loops': {'threshold': [0.03, 0.2], 'slope': [0.04, -0.02], 'bias': 0.4},
    'periodic_disturbance': {
        'frequency': 50.0,
        'harmonic': [1.0, 3.0],
        'amplitude': [1e-3, 3e-4],
        'phase': [0.4, 1.1],
    },
    'preload_loss': {'gain': 0.05, 'threshold': 0.3},
    'rate_dependent_hysteresis': {
        'gain': 1e-4,
        'exponent': 1.0,
        'cutoff': 1000.0,
        'stretch': 2e-4,
    },
    'saturation': {'low': 0.05, 'high': 0.55, 'knee': 0.02},
    'sensor_nonlinearity': {'square': 0.004, 'cubic': -0.002},
    'slew_limit': {'limit': 60.0},
    'thermal_drift': {'rate': 1e-3, 'amplitude': 0.01, 'time_constant': 0.5},
}

#: what effects may know of `rich`
VIEW = View(
    sample_rate=FS,
    low=0.0,
    high=1.0,
    speeds=np.geomspace(1.0, 400.0, 8),
    duration=0.6,
    channels={'other_axis': (0.25, 0.5)},
    lines=(50.0, 150.0),
    modes=tuple((m.frequency, m.damping) for m in PAPER.dynamics.modes(FS)),
    max_frequency=2000.0,
    thresholds=H.thresholds,
)


def signal(n: int = 4000, f: float = 40.0) -> np.ndarray:
    """Return a sine that grows from rest, in volts."""
    t = np.arange(n) / FS
    return 5 * (1 - np.cos(2 * np.pi * f * t)) * np.minimum(1.0, 0.3 + 4 * t)


def rich() -> np.ndarray:
    """Return 0.6 s of a sweep with biased minor loops, jumps and holds, in volts."""
    t = np.arange(int(0.2 * FS)) / FS
    sweep = 5 - 5 * np.cos(2 * np.pi * (10 * t + 250 * t * t))
    loops = 5 - 3 * np.cos(2 * np.pi * 5 * t) + 1.5 * np.sin(2 * np.pi * 40 * t)
    steps = np.repeat([0.0, 10.0, 4.0, 7.0], t.size // 4)
    return np.concatenate([sweep, loops, steps])


def other(n: int) -> np.ndarray:
    """Return another axis's voltage, shape (n,)."""
    t = np.arange(n) / FS
    return 0.25 + 0.7 * np.sin(2 * np.pi * 130 * t) + 0.3 * np.sin(2 * np.pi * 17 * t)


def with_effects(*names: str, model: StageModel = PAPER) -> StageModel:
    return replace(model, effects=tuple(EffectSetting(n, VISIBLE[n]) for n in names))


def played(model: StageModel, v: np.ndarray) -> np.ndarray:
    """Return what a model makes of a voltage, beside the other axis [m]."""
    return model.stream().process(v, channels={'other_axis': other(v.size)})


def alone(name: str, values: dict, u: np.ndarray, fs: float = FS, t0: float = 0.0, **channels):
    """Return what one effect makes of a normalised signal, starting at rest."""
    effect = find_effect(name)(fs, values, H)
    effect.reset(float(u[0]), float(u[0]))
    return effect.process(Block(t0 + np.arange(u.size) / fs, u, u, channels)).x
